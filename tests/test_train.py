"""The training step: counting, determinism, donation, vmapping."""

import dataclasses

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tiny

from vawm import envs, train
from vawm.agent import make_agent
from vawm.envs import probes


def make(config=tiny.CONFIG, env=None):
    env = env or tiny.env()
    agent = make_agent(config, env.spec)
    return (
        lambda key: train.init(env, agent, config, key),
        train.make_train_step(env, agent, config),
    )


@pytest.fixture(scope="module")
def compiled():
    """`init` and `train_step` of the tiny configuration; a second trace of it is an error."""
    init, step = make()
    return jax.jit(init), jax.jit(chex.assert_max_traces(step, n=1), donate_argnums=0)


def copy(state):
    """The state survives this step, which takes its input by donation."""
    return jax.tree.map(jnp.copy, state)


def roll(step, state, count):
    history = []
    for _ in range(count):
        state, metrics = step(state)
        history.append({name: float(value) for name, value in metrics.items()})
    return state, history


def test_the_number_of_updates_follows_the_train_ratio_exactly(compiled):
    init, step = compiled
    _, history = roll(step, init(jax.random.key(0)), 20)
    config = tiny.CONFIG
    per_chunk = config.collect_steps * config.num_envs
    batch = config.replay.batch_size * config.replay.batch_length
    # 2 streams of 4 steps a chunk: with runs of 9 steps, 16 starts exist after 16 steps.
    ready = [chunk for chunk in range(1, 21) if 2 * (4 * chunk - 8) >= batch]
    expected = [
        max(0, chunk - ready[0] + 1) * per_chunk * config.train_ratio // batch
        for chunk in range(1, 21)
    ]
    assert per_chunk * config.train_ratio % batch != 0  # so a remainder is carried over
    assert [h["updates"] for h in history] == expected
    assert [h["chunk/updates"] for h in history] == list(np.diff(expected, prepend=0))
    assert set(np.diff(expected)) == {0, 1, 2}


def test_env_steps_leave_resets_out(compiled):
    init, step = compiled
    # Episodes of 4 steps: every fifth call is a reset.
    _, history = roll(step, init(jax.random.key(0)), 10)
    calls = np.arange(1, 11) * tiny.CONFIG.collect_steps
    np.testing.assert_array_equal([h["env_steps"] for h in history], 2 * (calls - calls // 5))
    assert sum(h["episode/count"] for h in history) == 2 * (40 // 5)
    assert sum(h["episode/length"] for h in history) == 4 * 2 * (40 // 5)
    assert sum(h["env/nonfinite"] for h in history) == 0


def test_metrics_of_updates_are_nan_without_an_update_and_finite_with_one(compiled):
    init, step = compiled
    _, history = roll(step, init(jax.random.key(0)), 8)
    assert np.isnan(history[0]["loss/total"])
    assert all(np.isfinite(value) for value in history[-1].values())
    assert {"value_alignment/loss", "value_alignment/weight", "latent/kl"} <= set(history[0])


def test_value_alignment_starts_after_its_warmup(compiled):
    init, step = compiled
    _, history = roll(step, init(jax.random.key(0)), 10)
    for line in history:
        if line["chunk/updates"]:
            active = line["env_steps"] > tiny.CONFIG.value_alignment.warmup_steps
            assert (line["value_alignment/weight"] > 0) == active
            assert active or line["loss/value_alignment"] == 0
    assert history[-1]["loss/value_alignment"] > 0


def test_the_step_is_deterministic_and_seeds_differ(compiled):
    init, step = compiled
    first, history = roll(step, init(jax.random.key(0)), 6)
    again, _ = roll(step, init(jax.random.key(0)), 6)
    chex.assert_trees_all_equal(first, again)
    _, other = roll(step, init(jax.random.key(1)), 6)
    assert history[-1]["loss/total"] != other[-1]["loss/total"]


def test_the_step_takes_its_state_by_donation(compiled):
    init, step = compiled
    state = init(jax.random.key(0))
    step(state)
    assert state.replay.trajectory.obs.is_deleted()
    assert all(x.is_deleted() for x in jax.tree.leaves(state.learner.opt_state))


@pytest.fixture(scope="module")
def two_seeds():
    """`init` and `train_step` over two seeds, lowered for a state of theirs."""
    init, step = train.over_seeds(*make())
    init, step = jax.jit(init), jax.jit(step)
    # The checker takes a slice of a batch of keys for all of them.
    with jax.debug_key_reuse(False):
        yield init, step, step.lower(jax.eval_shape(init, keys_of_two()))


def keys_of_two():
    return jax.random.split(jax.random.key(3), 2)


def test_two_seeds_vmapped_equal_the_two_runs_alone(compiled, two_seeds):
    init, step = compiled
    init_both, step_both, _ = two_seeds
    together = init_both(keys_of_two())
    for _ in range(7):
        together, _ = step_both(together)
    for seed in range(2):
        alone, _ = roll(step, init(keys_of_two()[seed]), 7)
        one = jax.tree.map(lambda x, seed=seed: x[seed], unshare(together, 2))
        np.testing.assert_array_equal(one.learner.step, alone.learner.step)
        np.testing.assert_array_equal(one.credit, alone.credit)
        # Batched products round differently; 4 updates stay within 1e-4.
        chex.assert_trees_all_close(one.learner.params, alone.learner.params, atol=1e-4)
        chex.assert_trees_all_close(one.replay.trajectory, alone.replay.trajectory, atol=1e-3)


def unshare(state, seeds):
    """A state over seeds with an axis for the seed on every leaf."""
    stack = jax.vmap(lambda state: state, in_axes=(train.SEED_AXES,), axis_size=seeds)
    return stack(state)


def test_seeds_vmapped_never_copy_replay(two_seeds):
    *_, lowered = two_seeds
    text = lowered.as_text()
    shape = lowered.args_info[0][0].replay.latent.deter.shape
    name = "x".join(map(str, shape)) + "xf32"
    assert f"tensor<{name}>" in text
    assert not [line for line in text.splitlines() if "select" in line and name in line]


def test_the_slow_critic_is_a_moving_average_of_the_critic(compiled):
    init, step = compiled
    before, _ = roll(step, init(jax.random.key(0)), 7)  # one update follows
    after, _ = step(copy(before))
    rate = tiny.CONFIG.critic.slow_rate
    expected = jax.tree.map(
        lambda new, slow: rate * new + (1 - rate) * slow,
        after.learner.params.critic,
        before.learner.slow_critic,
    )
    chex.assert_trees_all_close(after.learner.slow_critic, expected, atol=1e-7)


def test_the_first_update_has_learning_rate_zero(compiled):
    init, step = compiled
    start = init(jax.random.key(0))
    state, history = roll(step, copy(start), 4)
    assert history[-1]["updates"] == 1
    chex.assert_trees_all_equal(state.learner.params, start.learner.params)
    state, _ = step(copy(state))
    changed = jax.tree.map(lambda a, b: (a != b).any(), state.learner, start.learner)
    assert any(jax.tree.leaves(changed.params))


def test_inferred_latents_are_written_back(compiled):
    init, step = compiled
    before, _ = roll(step, init(jax.random.key(0)), 6)
    after, _ = step(copy(before))
    old, new = (np.asarray(s.replay.latent.deter) for s in (before, after))
    assert (old[:, 24:28] == 0).all()  # the seventh chunk is new, and nothing wrapped
    assert (new[:, 24:28] != 0).any()
    assert (old[:, :24] != new[:, :24]).any()


def test_physics_that_fails_is_counted_and_never_stored():
    def breaks(env):
        def step(state, action):
            """Every third call ends the episode early, as a non-finite state does."""
            state, timestep = env.step(state, action)
            failed = state.steps == 3
            state = state._replace(steps=jnp.where(failed, -3, state.steps))
            return state, timestep._replace(is_last=timestep.is_last | failed)

        return env._replace(step=step)

    env = breaks(probes.make("truncation", num_envs=2, episode_length=10))
    init, _ = make(env=env)
    agent = make_agent(tiny.CONFIG, env.spec)
    state = init(jax.random.key(0))
    collect = jax.jit(train.make_collect(env, agent, tiny.CONFIG))
    _, buffer, metrics = collect(
        state.learner.params, state.collector, state.replay, jax.random.key(1)
    )
    assert int(metrics["env/nonfinite"]) == 2
    assert all(jnp.isfinite(x).all() for x in jax.tree.leaves(buffer.trajectory))


def test_a_task_on_mjx_trains_in_the_same_step():
    config = dataclasses.replace(tiny.CONFIG, task="pendulum_swingup", collect_steps=8)
    env = envs.make("pendulum_swingup", num_envs=2, action_repeat=2)
    init, step = make(config, env)
    state, history = roll(jax.jit(step, donate_argnums=0), jax.jit(init)(jax.random.key(0)), 3)
    assert history[-1]["env_steps"] == 3 * 8 * 2 * 2
    assert history[-1]["updates"] > 0
    assert all(np.isfinite(value) for value in history[-1].values())
    assert int(state.replay.size) == 24
