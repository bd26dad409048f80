"""Episodes as a stream: ends, resets, action repeat, failures, bad actions, refusals."""

import functools
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from refusals import refused

from vawm import envs
from vawm.envs.mjx.environment import rescale
from vawm.envs.mjx.rewards import tolerance

NAME, N = "pendulum_swingup", 3


@functools.cache
def compiled(num_envs=N, action_repeat=1):
    env = envs.make(NAME, num_envs=num_envs, action_repeat=action_repeat)
    return env.spec, jax.jit(env.reset), jax.jit(env.step)


def again(state):
    """A copy of the state that can be stepped again."""
    return state._replace(key=jax.random.clone(state.key))


def actions(seed, num_envs=N):
    return jax.random.uniform(jax.random.key(seed), (num_envs, 1), minval=-1, maxval=1)


def assert_trees_equal(a, b, **tolerances):
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        if jnp.issubdtype(x.dtype, jax.dtypes.prng_key):
            x, y = jax.random.key_data(x), jax.random.key_data(y)
        np.testing.assert_allclose(x, y, **tolerances)


def test_an_episode_is_cut_after_1000_control_steps():
    spec, reset, step = compiled()
    assert spec.episode_length == 1000
    state, first = reset(jax.random.key(0))
    assert first.is_first.all()
    steps = jnp.zeros((1001, N, 1))
    state, timestep = jax.jit(lambda state: jax.lax.scan(step, state, steps))(state)
    index = np.arange(1, 1002)[:, None].repeat(N, axis=1)
    np.testing.assert_array_equal(timestep.is_last, index == 1000)
    np.testing.assert_array_equal(timestep.is_first, index == 1001)
    assert not timestep.is_terminal.any()

    assert not timestep.reward[-1].any()
    assert (state.steps == 0).all()
    starts = np.concatenate([first.obs, timestep.obs[-1]])
    assert np.unique(starts, axis=0).shape[0] == 2 * N
    assert not starts[:, 2].any()  # at rest: the new episode keeps nothing of the old one


def test_only_the_environment_that_is_due_is_reset():
    _, reset, step = compiled()
    state, _ = reset(jax.random.key(1))
    state = state._replace(steps=jnp.array([5, 999, 7]))
    state, timestep = step(state, actions(0))
    np.testing.assert_array_equal(timestep.is_last, [False, True, False])
    before, (state, timestep) = again(state), step(state, actions(1))
    np.testing.assert_array_equal(timestep.is_first, [False, True, False])
    np.testing.assert_array_equal(state.steps, [7, 0, 9])
    alone, _ = step(before._replace(steps=jnp.array([6, 6, 8])), actions(1))
    np.testing.assert_array_equal(state.data.qpos[0], alone.data.qpos[0])
    np.testing.assert_array_equal(state.data.qpos[2], alone.data.qpos[2])


def test_a_reset_step_ignores_its_action():
    _, reset, step = compiled()
    state, _ = reset(jax.random.key(2))
    state = state._replace(steps=jnp.full(N, 1000))
    assert_trees_equal(step(again(state), actions(0)), step(state, actions(1)), rtol=0)


def test_action_repeat_sums_the_rewards_of_single_steps():
    _, reset, step = compiled()
    spec, _, step_twice = compiled(action_repeat=2)
    assert spec.episode_length == 500
    state, _ = reset(jax.random.key(3))
    state = state._replace(data=state.data.replace(qpos=jnp.array([[0.1], [0.14], [2.0]])))
    repeated, timestep = step_twice(again(state), actions(0))
    state, first = step(state, actions(0))
    state, second = step(state, actions(0))
    assert first.reward.any()
    np.testing.assert_allclose(timestep.reward, first.reward + second.reward)
    np.testing.assert_allclose(timestep.obs, second.obs, rtol=1e-5, atol=1e-6)
    np.testing.assert_array_equal(repeated.steps, state.steps)


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e20, 2e10])
@pytest.mark.parametrize("field", ["qpos", "qvel"])
def test_failed_physics_ends_the_episode_and_the_next_step_resets_it(field, value):
    _, reset, step = compiled()
    state, _ = reset(jax.random.key(4))
    state, _ = step(state, actions(0))
    broken = getattr(state.data, field).at[1].set(value)
    faulty = state._replace(data=state.data.replace(**{field: broken}))
    state, timestep = step(faulty, actions(1))
    np.testing.assert_array_equal(timestep.is_last, [False, True, False])
    assert not timestep.is_terminal.any()
    assert timestep.reward[1] == 0
    assert np.isfinite(timestep.obs).all()
    np.testing.assert_array_equal(state.steps, [2, -2, 2])  # negative: failed in step 2

    state, timestep = step(state, actions(2))
    np.testing.assert_array_equal(timestep.is_first, [False, True, False])
    np.testing.assert_array_equal(state.steps, [3, 0, 3])
    assert np.isfinite(timestep.obs).all()
    assert np.isfinite(state.data.qpos).all()


def test_physics_that_blows_up_within_a_step_keeps_the_observation_before_it():
    """MuJoCo accepts the state, but one step leads out of all bounds."""
    _, reset, step = compiled()
    state, _ = reset(jax.random.key(5))
    fast = state.data.qvel.at[0].set(9.9e9)
    racing = state._replace(data=state.data.replace(qvel=fast, qpos=fast))
    state, timestep = step(racing, actions(0))
    assert timestep.is_last[0]
    assert np.isfinite(timestep.obs).all()
    np.testing.assert_array_equal(timestep.obs[0, 2], fast[0, 0])
    np.testing.assert_array_equal(state.data.qvel[0], fast[0])


def test_a_nan_action_counts_as_zero_and_a_large_one_is_clipped():
    _, reset, step = compiled()
    state, _ = reset(jax.random.key(6))
    bad = jnp.array([[np.nan], [np.inf], [-5.0]])
    good = jnp.array([[0.0], [1.0], [-1.0]])
    assert_trees_equal(step(again(state), bad), step(state, good), rtol=0)


def test_actions_are_rescaled_to_the_actuator_range():
    low, high = np.float32([0, -2]), np.float32([1, 6])
    action = jnp.array([[-1.0, -1.0], [0.0, 0.5], [3.0, 1.0]])
    actual = jax.vmap(lambda action: rescale(action, low, high))(action)
    np.testing.assert_allclose(actual, [[0, -2], [0.5, 4], [1, 6]])


def test_seeds_vmapped_equal_seeds_alone():
    env = envs.make(NAME, num_envs=N)

    def rollout(key):
        state, first = env.reset(key)
        state = state._replace(steps=jnp.array([998, 3, 999]))

        def body(state, _):
            return env.step(state, jnp.full((N, 1), 0.5))

        return first, jax.lax.scan(body, state, None, length=5)[1]

    keys = jax.random.split(jax.random.key(8), 2)
    together = jax.jit(jax.vmap(rollout))(keys)
    rollout = jax.jit(rollout)
    alone = [rollout(key) for key in jax.random.split(jax.random.key(8), 2)]
    for seed in range(2):
        mine = jax.tree.map(lambda x, seed=seed: x[seed], together)
        assert_trees_equal(mine, alone[seed], rtol=1e-5, atol=1e-6)
    assert together[1].is_first.sum() == 4


def test_equal_keys_give_equal_episodes_and_different_keys_do_not():
    _, reset, _ = compiled()
    assert_trees_equal(reset(jax.random.key(9)), reset(jax.random.key(9)), rtol=0)
    assert (reset(jax.random.key(9))[1].obs != reset(jax.random.key(10))[1].obs).any()


def test_an_ordinary_step_does_not_compute_reset_draws():
    """The draws sit in a while loop, which vmap keeps; a cond would become a select."""
    env = envs.make(NAME, num_envs=N)
    states = jax.eval_shape(jax.vmap(env.reset), jax.random.split(jax.random.key(0), 2))[0]
    jaxpr = jax.make_jaxpr(jax.vmap(env.step))(states, jnp.zeros((2, N, 1)))
    outside = {equation.primitive.name for equation in jaxpr.eqns}
    assert "while" in outside
    assert not {"random_bits", "random_split", "cond"} & outside


@pytest.mark.parametrize("name", envs.TASKS)
def test_every_task_has_a_spec(name):
    spec = envs.make(name, num_envs=1).spec
    assert spec.task == name
    assert spec.action_size > 0
    assert len(spec.obs.shape) == 1


@pytest.mark.parametrize(
    ("field", "value", "named"),
    [
        ("task", "walker_wlak", "'walker_walk'"),
        ("task", "humanoid_run", "acrobot_swingup"),
        ("num_envs", 0, "1"),
        ("num_envs", 2.0, ()),
        ("action_repeat", -1, "1"),
        ("action_repeat", 3, "1000"),
    ],
)
def test_bad_arguments_are_refused(field, value, named):
    arguments = {"task": NAME, "num_envs": 1, "action_repeat": 1} | {field: value}
    with refused(field, value, naming=named):
        envs.make(arguments.pop("task"), **arguments)


def test_task_names_are_known_without_mujoco():
    code = "import sys; from vawm.envs import TASKS; print(len(TASKS), 'mujoco' in sys.modules)"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True
    )
    assert done.stdout == "18 False\n"


def test_loading_a_model_prints_and_writes_nothing(tmp_path):
    code = "import vawm.envs; vawm.envs.make('cheetah_run', num_envs=1)"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=tmp_path
    )
    assert done.stdout == ""
    assert "WARNING: compiler" not in done.stderr
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("sigmoid", ["gaussian", "linear", "quadratic"])
@pytest.mark.parametrize("bounds", [(0.0, 0.0), (-1.0, 2.0), (1.0, float("inf"))])
@pytest.mark.parametrize("margin", [0.0, 0.5, 3.0])
def test_tolerance_equals_that_of_dm_control(sigmoid, bounds, margin):
    from dm_control.utils import rewards

    x = np.linspace(-5, 5, 101)
    expected = rewards.tolerance(x, bounds, margin, sigmoid, 0.3)
    actual = tolerance(
        jnp.asarray(x, jnp.float32), bounds, margin=margin, value_at_margin=0.3, sigmoid=sigmoid
    )
    np.testing.assert_allclose(actual, expected, atol=2e-6)
