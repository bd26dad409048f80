"""The first state and observation of an episode, against dm_control's."""

import functools

import envs_dmc
import jax
import numpy as np
import pytest
import scipy.stats

from vawm import envs
from vawm.envs import TASKS, split
from vawm.envs.mjx import environment

RESETS = 500


@functools.cache
def starts(name):
    """500 first states on MJX, and their observations."""
    env = envs.make(name, num_envs=RESETS)
    state, timestep = jax.jit(env.reset)(jax.random.key(0))
    return state, timestep


@functools.cache
def reference_starts(name):
    """500 first states of dm_control: `[500, nq + nv + G]`."""
    env, rows = envs_dmc.load(name, seed=1), []
    for _ in range(RESETS):
        env.reset()
        data = env.physics.data
        rows.append(np.concatenate([data.qpos, data.qvel, envs_dmc.target(env, name)]))
    return np.stack(rows)


@pytest.mark.parametrize("name", TASKS)
def test_initial_states_are_distributed_as_in_dm_control(name):
    """Kolmogorov-Smirnov test of every coordinate of qpos, qvel and target.

    Under equality one p-value in a thousand falls below the bound; about 120 are computed.
    """
    state, _ = starts(name)
    ours = np.concatenate([state.data.qpos, state.data.qvel, state.target], axis=1)
    theirs = reference_starts(name)
    assert ours.shape == theirs.shape
    for column in range(ours.shape[1]):
        a, b = ours[:, column], theirs[:, column].astype(np.float32)
        if np.ptp(b) == 0:  # a constant has no distribution to compare
            np.testing.assert_array_equal(a, b)
        else:
            assert scipy.stats.ks_2samp(a, b).pvalue > 1e-3, f"coordinate {column}"


def reference_obs(name, rows):
    """dm_control's first observations of the states of `starts` at `rows`."""
    state, _ = starts(name)
    env, parts = envs_dmc.load(name), (state.data.qpos, state.data.qvel, state.target)
    parts = [np.asarray(part, float) for part in parts]
    return np.stack([envs_dmc.place(env, name, *(part[i] for part in parts)) for i in rows])


@pytest.mark.parametrize("name", TASKS)
def test_first_observations_equal_those_of_dm_control(name):
    _, timestep = starts(name)
    expected = reference_obs(name, range(60))
    scale = np.maximum(np.sqrt(np.mean(expected**2, axis=0)), 1e-3)
    error = np.abs(np.asarray(timestep.obs[:60]) - expected) / scale
    assert np.quantile(error, 0.98) <= 1e-4
    assert error.max() <= 1e-2
    assert timestep.is_first.all()
    assert not timestep.is_last.any()
    assert not timestep.reward.any()


@pytest.mark.parametrize("name", ["hopper_hop", "hopper_stand"])
def test_a_hopper_that_starts_in_the_floor_feels_it(name):
    _, timestep = starts(name)
    touch = np.asarray(timestep.obs[:, -2:])
    felt = np.flatnonzero(touch.any(axis=1))
    assert len(felt) > 0
    np.testing.assert_allclose(touch[felt], reference_obs(name, felt)[:, -2:], rtol=1e-3)


@pytest.mark.parametrize("name", ["ball_in_cup_catch", "finger_spin"])
def test_no_episode_starts_in_a_collision(name):
    state, _ = starts(name)
    env = envs_dmc.load(name)
    for qpos in np.asarray(state.data.qpos[:100], float):
        envs_dmc.place(env, name, qpos, np.zeros(env.physics.model.nv), np.zeros(2))
        assert env.physics.data.ncon == 0


def test_a_cheetah_settles_as_in_dm_control():
    """From the same random joints, through the 200 steps before an episode."""
    state, _ = starts("cheetah_run")
    task, loaded = environment.load(*split("cheetah_run"))
    keys = jax.random.split(jax.random.key(0), RESETS)  # as `reset` and `renew` split them
    drawn = jax.jit(jax.vmap(lambda key: task.draw(jax.random.split(key)[1])))(keys)
    first_move = loaded.host.opt.timestep * np.asarray(drawn.qvel)
    joints = (np.asarray(drawn.qpos) - first_move)[:50, 3:]

    physics, expected = envs_dmc.load("cheetah_run").physics, []
    for row in joints:
        physics.reset()
        physics.data.qpos[3:] = row
        physics.step(nstep=200)
        expected.append(np.concatenate([physics.data.qpos, physics.data.qvel]))
    settled = np.concatenate([state.data.qpos, state.data.qvel], axis=1)[:50]
    error = np.abs(settled - np.stack(expected))
    assert np.median(error) <= 1e-4
