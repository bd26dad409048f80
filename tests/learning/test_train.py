"""The training step: counting, determinism, donation, vmapping."""

import functools

import chex
import jax
import jax.numpy as jnp
import numpy as np
import pytest
import scalar_agent
import tiny

from vawm import envs
from vawm.agent import make_agent
from vawm.learning import replay, train
from vawm.learning.from_replay import make_learn
from vawm.learning.state import init_learner
from vawm.types import Trajectory
from vawm.world_model.packing import pack


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


def test_metrics_of_updates_are_0_without_an_update_and_finite_with_one(compiled):
    init, step = compiled
    _, history = roll(step, init(jax.random.key(0)), 8)
    assert history[0]["chunk/updates"] == history[0]["loss/total"] == 0
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
        together, metrics = step_both(together)
    assert metrics["chunk/nonfinite"].tolist() == [0, 0]
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


def scalar_experience():
    """A full buffer of the scalar agent that has wrapped; z is 1 in what is stored."""
    rng, shape = np.random.default_rng(0), (2, 8)
    no = jnp.zeros(shape, bool)
    obs, action = (jnp.asarray(rng.normal(size=(*shape, 1)), jnp.float32) for _ in range(2))
    trajectory = Trajectory(obs, jnp.zeros(shape), no, no, no, action)
    latent = scalar_agent.latent(jnp.asarray(rng.normal(size=shape)), jnp.ones(shape))
    return replay.Replay(trajectory, pack(latent), head=jnp.int32(3), size=jnp.int32(8))


def test_latents_are_written_back_to_exactly_the_steps_they_were_inferred_at():
    agent, config = scalar_agent.AGENT, scalar_agent.CONFIG
    learner = init_learner(agent, config, jax.random.key(0))
    before, one = scalar_experience(), jnp.asarray(1)
    learn = jax.jit(make_learn(agent, config))
    _, after, _ = learn(learner, before, jax.random.key(1), one, one)

    length = config.replay.batch_length + 1
    draw = functools.partial(replay.draw, batch_size=2, length=length)
    key_draw = jax.random.split(jax.random.key(1), 3)[1]
    env, time = positions = jax.device_get(jax.jit(draw)(before, key_draw))
    trajectory, context = jax.device_get(replay.read(before, positions))
    assert env[0] != env[1]  # no step is in both samples
    deter, stoch = (np.array(x) for x in before.latent)
    for b in range(2):
        h = context.deter[b]
        for t in range(1, length):
            h = h / 2 + trajectory.action[b, t - 1] + trajectory.obs[b, t]
            deter[env[b], time[b, t]] = h
            stoch[env[b], time[b, t]] = 0
    np.testing.assert_allclose(after.latent.deter, deter, rtol=1e-5)
    np.testing.assert_array_equal(after.latent.stoch, stoch)


def test_in_bfloat16_a_step_changes_no_shape_and_no_dtype():
    init, step = make(tiny.config(compute_dtype="bfloat16"))
    before = jax.eval_shape(init, jax.random.key(0))
    after, _ = jax.eval_shape(step, before)
    chex.assert_trees_all_equal_shapes_and_dtypes(after, before)
    assert before.replay.latent.deter.dtype == jnp.bfloat16
    learned = jax.tree.leaves((before.learner.params, before.learner.opt_state))
    assert jnp.bfloat16 not in {leaf.dtype for leaf in learned}


@pytest.fixture(scope="module")
def pendulum():
    """`init` and `train_step` of a task on MJX, 8 calls of 2 control steps in a chunk."""
    config = tiny.config(task="pendulum_swingup", action_repeat=2, collect_steps=8)
    init, step = make(config, envs.make("pendulum_swingup", num_envs=2, action_repeat=2))
    return jax.jit(init), jax.jit(step, donate_argnums=0)


def test_a_task_on_mjx_trains_in_the_same_step(pendulum):
    init, step = pendulum
    state, history = roll(step, init(jax.random.key(0)), 3)
    assert history[-1]["env_steps"] == 3 * 8 * 2 * 2
    assert history[-1]["updates"] > 0
    assert all(np.isfinite(value) for value in history[-1].values())
    assert int(state.replay.size) == 24


def test_a_nan_in_the_physics_ends_that_episode_and_is_never_stored(pendulum):
    init, step = pendulum
    state, _ = roll(step, init(jax.random.key(0)), 2)
    data = state.collector.env_state.data
    broken = data.replace(qvel=data.qvel.at[1].set(jnp.nan))
    env_state = state.collector.env_state._replace(data=broken)
    state = state._replace(collector=state.collector._replace(env_state=env_state))
    state, history = roll(step, state, 1)
    assert history[-1]["env/nonfinite"] == 1
    assert history[-1]["episode/count"] == 1

    stored = state.replay.trajectory
    # Step 16 was observed before the failure, step 17 is the end of it and step 18 a reset.
    assert np.argwhere(stored.is_last).tolist() == [[1, 17]]
    assert np.argwhere(stored.is_first).tolist() == [[0, 0], [1, 0], [1, 18]]
    assert not stored.is_terminal.any()
    physics = state.collector.env_state.data
    for leaf in jax.tree.leaves((state.replay, state.learner, physics.qpos, physics.qvel)):
        assert np.isfinite(leaf).all()
