"""What an update draws from replay: a batch, and contexts of their own where it needs some."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tiny

from vawm.learning import from_replay, replay
from vawm.types import Latent, Trajectory

NUM_ENVS, CAPACITY, STEPS = 2, 32, 40
FROM_CONTEXTS = tiny.config(
    imagination=dataclasses.replace(
        tiny.CONFIG.imagination, starts="contexts", batch_size=5, context_length=3
    )
)


def full():
    """A replay that has wrapped; rewards say which step it is."""
    time = jnp.broadcast_to(jnp.arange(float(STEPS)), (NUM_ENVS, STEPS))
    flag = jnp.zeros(time.shape, bool)
    trajectory = Trajectory(time[..., None], time, flag, flag, flag, time[..., None])
    latent = Latent(time[..., None], jnp.zeros((*time.shape, 1, 4)))
    buffer = replay.init(
        *jax.tree.map(lambda x: x[:, 0], (trajectory, latent)), capacity=CAPACITY
    )
    for chunk in range(0, STEPS, 8):
        buffer = replay.add(
            buffer, *jax.tree.map(lambda x, c=chunk: x[:, c : c + 8], (trajectory, latent))
        )
    return buffer


def on_device(config, seed):
    return from_replay.draw(config, full(), jax.random.key(seed))


def on_host(config, seed):
    buffer, rng = full(), np.random.default_rng(seed)
    ring = NUM_ENVS, CAPACITY, int(buffer.head), int(buffer.size)
    return from_replay.draw_on_host(config, rng, *ring)


@pytest.mark.parametrize("draw", [on_device, on_host])
def test_a_batch_has_a_step_more_than_it_replays_and_contexts_have_their_own_length(draw):
    drawn = draw(FROM_CONTEXTS, 0)
    assert from_replay.shapes(FROM_CONTEXTS) == ((2, 8 + 1), (5, 3))
    assert drawn.batch.time.shape == (2, 8 + 1)
    assert drawn.contexts.time.shape == (5, 3)
    for positions in drawn:
        assert positions.env.shape == positions.time.shape[:1]
        reward = replay.read(full(), positions).trajectory.reward
        assert (np.diff(reward, axis=1) == 1).all()  # consecutive, in one stream


@pytest.mark.parametrize("draw", [on_device, on_host])
def test_without_contexts_only_a_batch_is_drawn(draw):
    drawn = draw(tiny.CONFIG, 0)
    assert from_replay.shapes(tiny.CONFIG) == ((2, 9), ())
    assert drawn.batch.time.shape == (2, 9)
    assert drawn.contexts == ()


@pytest.mark.parametrize("draw", [on_device, on_host])
def test_contexts_begin_elsewhere_than_the_batch_and_everywhere(draw):
    first = [draw(FROM_CONTEXTS, seed) for seed in range(40)]
    same = [np.isin(d.contexts.time[:, 0], d.batch.time[:, 0]).all() for d in first]
    assert not any(same)
    starts = {
        (int(env), int(time))
        for drawn in first
        for env, time in zip(drawn.contexts.env, drawn.contexts.time[:, 0], strict=True)
    }
    # 2 streams of 30 starts; 200 draws leave each out with 1 in 29.
    assert len(starts) > 50
