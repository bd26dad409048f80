"""The tasks through Gymnasium."""

import subprocess
import sys
import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode
from refusals import refused

from vawm.envs import TASKS, registration


def test_all_tasks_are_registered_and_registering_twice_does_not_warn():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        registration.register(TASKS)
    assert all(f"vawm/{task}-v0" in gymnasium.registry for task in TASKS)


def test_an_id_that_names_the_module_needs_no_import_and_loads_no_physics():
    code = """
import gymnasium, sys
assert "vawm/GridWorld-v0" not in gymnasium.registry
env = gymnasium.make("vawm.envs:vawm/GridWorld-v0")
import vawm.envs
assert {f"vawm/{task}-v0" for task in vawm.envs.TASKS} < set(gymnasium.registry)
assert not {"mujoco", "dm_control", "flax"} & set(sys.modules)
"""
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=False
    )
    assert (done.returncode, done.stderr) == (0, "")


# All tasks share the Gymnasium wrapper: test one task without contacts and one with.
@pytest.mark.parametrize("task", ["cartpole_swingup", "hopper_hop"])
def test_a_single_environment_passes_the_checker(task):
    env = gymnasium.make(f"vawm/{task}-v0")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message=".*infinity")  # velocities are unbounded
        check_env(env.unwrapped, skip_render_check=True)


def test_a_single_episode_is_truncated_after_1000_control_steps():
    env = gymnasium.make("vawm/pendulum_swingup-v0", action_repeat=100)
    env.reset(seed=0)
    outcomes = [env.step(np.zeros(1, np.float32)) for _ in range(10)]
    assert [truncated for *_, truncated, _ in outcomes] == [False] * 9 + [True]
    assert not any(terminated for _, _, terminated, _, _ in outcomes)


def test_a_vector_environment_resets_at_the_next_step():
    env = gymnasium.make_vec("vawm/pendulum_swingup-v0", num_envs=3, action_repeat=500)
    assert env.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
    assert env.num_envs == 3
    obs, info = env.reset(seed=0)
    assert env.observation_space.contains(obs)
    assert info == {}
    for end in (False, True, False, False, True):
        obs, reward, terminated, truncated, info = env.step(env.action_space.sample())
        assert env.observation_space.contains(obs)
        assert reward.shape == (3,)
        assert not terminated.any()
        assert (truncated == end).all()
        assert info == {}
    again, _ = env.reset(seed=0)
    np.testing.assert_array_equal(again, env.reset(seed=0)[0])


def test_a_vector_environment_equals_the_single_one():
    single = gymnasium.make("vawm/pendulum_swingup-v0", action_repeat=500)
    vector = gymnasium.make_vec("vawm/pendulum_swingup-v0", num_envs=1, action_repeat=500)
    np.testing.assert_array_equal(single.reset(seed=3)[0], vector.reset(seed=3)[0][0])
    np.testing.assert_allclose(
        single.step(np.float32([0.3]))[0], vector.step(np.float32([[0.3]]))[0][0], rtol=1e-5
    )


def test_failed_physics_truncates_and_is_reported():
    env = gymnasium.make_vec("vawm/pendulum_swingup-v0", num_envs=3, action_repeat=500)
    env.reset(seed=0)
    data = env.unwrapped._state.data
    broken = data.replace(qvel=data.qvel.at[1].set(np.nan))
    env.unwrapped._state = env.unwrapped._state._replace(data=broken)
    _, _, terminated, truncated, info = env.step(np.zeros((3, 1), np.float32))
    np.testing.assert_array_equal(truncated, [False, True, False])
    np.testing.assert_array_equal(info["physics_failed"], [False, True, False])
    assert not terminated.any()


def test_bad_arguments_are_refused():
    with refused("action_repeat", 3):
        gymnasium.make("vawm/pendulum_swingup-v0", action_repeat=3)
