"""STORM in the same training step: contexts, two optimisers, nothing written back."""

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tiny
import tiny_storm

from vawm.agent import make_agent
from vawm.learning import from_replay, train

RANDOM_STEPS = 24
CONFIG = tiny_storm.config(random_steps=RANDOM_STEPS)


@pytest.fixture(scope="module")
def compiled():
    """`init` and `train_step`; a second trace is an error."""
    env = tiny.env()
    agent = make_agent(CONFIG, env.spec)
    step = train.make_train_step(env, agent, CONFIG)
    return (
        jax.jit(lambda key: train.init(env, agent, CONFIG, key)),
        jax.jit(chex.assert_max_traces(step, n=1), donate_argnums=0),
    )


def roll(compiled, seed, count):
    """States after every chunk, and what was measured."""
    init, step = compiled
    states, history = [init(jax.random.key(seed))], []
    for _ in range(count):
        state, metrics = step(jax.tree.map(jnp.copy, states[-1]))
        states.append(state)
        history.append({name: float(value) for name, value in metrics.items()})
    return states, history


def test_it_learns_from_the_first_full_batch_on_and_repeats_itself(compiled):
    states, history = roll(compiled, 0, 8)
    assert history[-1]["updates"] > 2
    assert all(np.isfinite(value) for value in history[-1].values())
    warmup = CONFIG.value_alignment.warmup_steps
    for line in (line for line in history if line["chunk/updates"]):
        assert (line["loss/value_alignment"] > 0) == (line["env_steps"] > warmup)
    again, _ = roll(compiled, 0, 8)
    chex.assert_trees_all_equal(states[-1], again[-1])


def test_an_update_moves_all_that_learns_with_an_optimiser_each(compiled):
    states, history = roll(compiled, 0, 5)
    at = next(i for i, line in enumerate(history) if line["chunk/updates"])
    before, after = states[at].learner, states[at + 1].learner
    for part in before.params._fields:
        moved = jax.tree.map(
            lambda a, b: float(abs(a - b).max()),
            getattr(before.params, part),
            getattr(after.params, part),
        )
        rate = 1e-3 if part == "world_model" else 1e-2
        largest = max(jax.tree.leaves(moved))
        assert 0.9 * rate < largest < 2.1 * rate, part  # by one or two updates of Adam
        assert all(x > 0 for x in jax.tree.leaves(moved)), part
    assert {"optimizer/gradient_norm", "optimizer/behaviour/gradient_norm"} <= set(history[0])
    rate = CONFIG.critic.slow_rate
    slow = jax.tree.map(
        lambda new, slow: rate * new + (1 - rate) * slow,
        after.params.critic,
        before.slow_critic,
    )
    chex.assert_trees_all_close(after.slow_critic, slow, atol=1e-7)


def test_observations_and_rewards_of_1e30_leave_all_that_is_learned_finite(compiled):
    states, _ = roll(compiled, 0, 5)
    state = jax.tree.map(jnp.copy, states[-1])
    stored = state.replay.trajectory
    obs, reward = stored.obs.at[:, ::3].set(1e30), stored.reward.at[:, ::3].set(-1e30)
    huge = stored._replace(obs=obs, reward=reward)
    state = state._replace(replay=state.replay._replace(trajectory=huge))
    for _ in range(3):
        state, metrics = compiled[1](state)
        assert all(np.isfinite(value) for value in metrics.values())
    assert state.learner.step >= states[-1].learner.step + 3
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(state.learner))


def test_replay_keeps_no_latents(compiled):
    init, _ = compiled
    state = jax.eval_shape(init, jax.random.key(0))
    assert state.replay.latent == ()
    # Both acting and replay have the observations, and only the window has several at once.
    assert state.collector.carry.memory.obs.shape[1] == CONFIG.world_model.act_context


def test_actions_are_random_at_first_and_the_policys_then(compiled):
    """Uniform actions are within 1; those of a policy of std 0.9 are often beyond."""
    states, _ = roll(compiled, 0, 8)
    action = np.asarray(states[-1].replay.trajectory.action)[..., 0]
    steps = np.asarray([s.collector.env_steps for s in states])
    chunks = int(np.searchsorted(steps, RANDOM_STEPS, side="left"))
    early = action[:, : chunks * CONFIG.collect_steps]
    late = action[:, chunks * CONFIG.collect_steps : 8 * CONFIG.collect_steps]
    assert abs(early).max() <= 1 < abs(late).max()
    assert len(np.unique(early)) > early.size // 2


def test_contexts_are_drawn_apart_from_the_batch():
    shapes = from_replay.shapes(CONFIG)
    assert shapes == ((2, 9), (6, 4))
    assert from_replay.shapes(tiny.CONFIG) == ((2, 9), ())
    rng = np.random.default_rng(0)
    positions = from_replay.draw_on_host(CONFIG, rng, 2, 64, 40, 40)
    assert positions.batch.time.shape == (2, 9)
    assert positions.contexts.time.shape == (6, 4)
