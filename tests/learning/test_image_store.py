"""Images of replay in host memory: the same ring, taken apart and put together."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import toy

from vawm.learning import image_store, replay
from vawm.learning.replay import Positions
from vawm.runs import resume
from vawm.types import Batch, Latent, Trajectory, image, vector

SPEC = {"picture": image(4), "state": vector(2), "top": image(4, 1)}
NUM_ENVS, CAPACITY = 2, 5


def obs_at(time):
    """What N environments show at a time: numbers that tell environment and time."""
    base = np.arange(NUM_ENVS)[:, None] * 100 + time
    return {
        "picture": np.broadcast_to(base[..., None, None], (NUM_ENVS, 4, 4, 3)).astype(np.uint8),
        "state": np.repeat(base, 2, axis=1).astype(np.float32),
        "top": np.broadcast_to(base[..., None, None], (NUM_ENVS, 4, 4, 1)).astype(np.uint8) + 1,
    }


def filled(steps):
    """A store and a replay without images that have taken the same steps."""
    store = image_store.init(SPEC, num_envs=NUM_ENVS, capacity=CAPACITY)
    flag, action = jnp.zeros(NUM_ENVS, bool), jnp.zeros((NUM_ENVS, 1))
    latent = Latent(jnp.zeros((NUM_ENVS, 1)), jnp.zeros((NUM_ENVS, 1, 2)))

    def trajectory(time):
        obs = image_store.without_images(jax.tree.map(jnp.asarray, obs_at(time)))
        return Trajectory(obs, jnp.full(NUM_ENVS, float(time)), flag, flag, flag, action)

    buffer = replay.init(trajectory(0), latent, capacity=CAPACITY)
    for time in range(steps):
        image_store.add(store, obs_at(time), at=int(buffer.head))
        one = jax.tree.map(lambda x: x[:, None], (trajectory(time), latent))
        buffer = replay.add(buffer, *one)
    return store, buffer


def test_a_store_holds_images_and_nothing_else():
    store, buffer = filled(3)
    shapes = image_store.specs(SPEC, num_envs=NUM_ENVS, capacity=CAPACITY)
    assert {k: (x.shape, x.dtype) for k, x in store.items()} == {
        k: (x.shape, x.dtype) for k, x in shapes.items()
    }
    assert store["picture"].shape == (NUM_ENVS, CAPACITY, 4, 4, 3)
    assert store["state"].size == 0
    stored = buffer.trajectory.obs
    assert stored["picture"].size == stored["top"].size == 0
    assert stored["state"].shape == (NUM_ENVS, CAPACITY, 2)


@pytest.mark.parametrize("steps", [5, 8])
def test_what_is_taken_apart_is_whole_again_also_after_the_ring_has_wrapped(steps):
    store, buffer = filled(steps)
    positions = replay.draw_on_host(
        np.random.default_rng(0),
        *(NUM_ENVS, CAPACITY, int(buffer.head), int(buffer.size)),
        batch_size=6,
        length=3,
    )
    read = replay.read(buffer, positions)
    whole = image_store.complete(read, image_store.read(store, positions))
    trajectory, context = whole
    toy.assert_equal(context, read.context)
    toy.assert_equal(trajectory._replace(obs=read.trajectory.obs), read.trajectory)
    obs = image_store.merge(read.trajectory.obs, image_store.read(store, positions))
    toy.assert_equal(trajectory.obs, obs)
    times = np.asarray(trajectory.reward).astype(int)
    for b, env in enumerate(positions.env):
        for t, time in enumerate(times[b]):
            for name, x in obs_at(time).items():
                np.testing.assert_array_equal(obs[name][b, t], x[env], err_msg=name)


def test_drawing_on_the_host_covers_all_starts_and_never_crosses_the_write_head():
    _, buffer = filled(8)
    positions = replay.draw_on_host(
        np.random.default_rng(1),
        *(NUM_ENVS, CAPACITY, int(buffer.head), int(buffer.size)),
        batch_size=600,
        length=3,
    )
    reward = np.asarray(buffer.trajectory.reward)[positions.env[:, None], positions.time]
    assert (np.diff(reward, axis=1) == 1).all()
    starts, counts = np.unique(
        np.stack([positions.env, reward[:, 0]]), axis=1, return_counts=True
    )
    assert starts[1].tolist() == [3, 4, 5] * 2
    assert (abs(counts - 100) < 50).all()


def test_what_is_read_is_a_copy():
    store, _ = filled(5)
    read = image_store.read(store, Positions(np.zeros(1, int), np.zeros((1, 1), int)))
    store["picture"][:] = 7
    assert (read["picture"] == 0).all()


def test_vectors_pass_as_they_are():
    obs = jnp.ones((2, 3, 1)), jnp.zeros((2, 3, 0), jnp.uint8)
    images = jnp.zeros((2, 3, 0)), jnp.ones((2, 3, 4, 4, 1), jnp.uint8)
    batch = image_store.complete(Batch(Trajectory(obs, *[None] * 5), ()), images)
    assert batch.trajectory.obs[0] is obs[0]
    assert batch.trajectory.obs[1] is images[1]


@pytest.mark.parametrize("steps", [3, 8])
def test_a_store_grows_as_replay_does(steps):
    store, buffer = filled(steps)
    grown, images = resume.grow(buffer, 9), resume.grow_images(store, buffer, 9)
    held = int(grown.size)
    times = np.asarray(grown.trajectory.reward)[0, :held].astype(int)
    assert images["picture"].shape[1] == 9
    assert images["state"].size == 0
    np.testing.assert_array_equal(images["picture"][0, :held, 0, 0, 0], times)
    np.testing.assert_array_equal(images["top"][1, :held, 0, 0, 0], times + 101)
