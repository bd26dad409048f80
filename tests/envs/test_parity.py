"""One control step of every task against dm_control's C physics, from the same state."""

import functools

import envs_dmc
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vawm import envs
from vawm.envs import TASKS, split
from vawm.envs.mjx import environment, physics


@functools.partial(jax.jit, static_argnames="substeps")
def control_step(model, blank, state, ctrl, *, substeps):
    """Compiled once per domain: the tasks of a domain differ in leaves of `model` only."""

    def one(state, ctrl):
        data = physics.control_step(model, blank.replace(**state), ctrl, substeps=substeps)
        return physics.keep(blank, data)

    return jax.vmap(one)(state, ctrl)


def state_of(seen):
    """The start states of `seen`, as fields of MJX's data."""
    return {
        "qpos": seen.qpos.astype(np.float32),
        "qvel": seen.qvel.astype(np.float32),
        "qacc_warmstart": seen.qacc_warmstart.astype(np.float32),
    }


def step_on_mjx(loaded, task, seen):
    """The same step as `seen`, on MJX."""
    ctrl, substeps = seen.action.astype(np.float32), task.substeps
    return control_step(loaded.model, loaded.blank, state_of(seen), ctrl, substeps=substeps)


@functools.cache
def compare(name):
    """(C's transitions, MJX's data, observations and rewards)."""
    seen = envs_dmc.transitions(name)
    task, loaded = environment.load(*split(name))
    data = step_on_mjx(loaded, task, seen)
    target = seen.target.astype(np.float32)
    obs = jax.jit(jax.vmap(task.observe))(data, target)
    reward = jax.jit(jax.vmap(task.reward))(data, target)
    return seen, data, np.asarray(obs), np.asarray(reward)


def assert_close(obs, reward, expected_obs, expected_reward):
    assert obs.shape == expected_obs.shape
    scale = np.maximum(np.sqrt(np.mean(expected_obs**2, axis=0)), 1e-3)
    assert (np.median(np.abs(obs - expected_obs) / scale, axis=0) <= 1e-4).all()
    p95, p99 = np.quantile(np.abs(reward - expected_reward), [0.95, 0.99])
    assert p95 <= 1e-3
    assert p99 <= 1e-2


@pytest.mark.parametrize("name", TASKS)
def test_one_control_step_equals_dm_control(name):
    seen, _, obs, reward = compare(name)
    assert len(seen.reward) >= 200
    assert_close(obs, reward, seen.obs, seen.reward)


# One task whose reward reads the control, without contacts; one with contacts and a target
# outside qpos. Compiling `step` costs too much to do it for every domain, and no domain has
# actuators with another range than [-1, 1].
@pytest.mark.parametrize("name", ["cartpole_balance", "finger_turn_easy"])
def test_a_repeated_step_of_the_environment_equals_dm_control_and_its_clipping(name):
    seen, *_ = compare(name)
    count = len(seen.reward)
    action = np.random.default_rng(0).uniform(-2, 2, seen.action.shape)
    env = envs.make(name, num_envs=count, action_repeat=2)
    blank = environment.load(*split(name))[1].blank
    data = jax.tree.map(lambda x: jnp.broadcast_to(x, (count, *x.shape)), blank)
    state = envs.EnvState(
        data=data.replace(**state_of(seen)),
        target=seen.target.astype(np.float32),
        steps=jnp.zeros(count, jnp.int32),
        key=jax.random.split(jax.random.key(0), count),
    )
    step = jax.jit(env.step, compiler_options={"xla_backend_optimization_level": 0})
    _, timestep = step(state, action.astype(np.float32))
    expected = envs_dmc.hold(name, seen, action, steps=2)
    assert_close(timestep.obs, timestep.reward, *expected)
    assert expected[1].max() > 1  # a reward in both steps


@pytest.mark.parametrize("name", TASKS)
def test_the_compared_states_cover_reward(name):
    seen, *_ = compare(name)
    assert np.mean(seen.reward > 0) > 0.01
    assert seen.reward.max() > seen.reward.min()


@pytest.mark.parametrize("name", ["finger_spin", "hopper_hop"])
def test_the_compared_states_cover_touch(name):
    seen, _, obs, _ = compare(name)
    touch = seen.obs[:, 7:9] if name == "finger_spin" else seen.obs[:, -2:]
    actual = obs[:, 7:9] if name == "finger_spin" else obs[:, -2:]
    felt = touch > 0
    assert felt.sum() >= 10
    np.testing.assert_allclose(np.quantile(np.abs(actual - touch)[felt], 0.9), 0, atol=1e-2)


@pytest.mark.parametrize("domain", physics.SOLVER)
def test_fewer_solver_iterations_leave_the_step_unchanged(domain):
    """The error in velocity against C is that of the XML's own solver settings."""
    name = next(task for task in TASKS if task.startswith(domain))
    seen, reduced, *_ = compare(name)
    task, _ = environment.load(*split(name))
    full = step_on_mjx(physics.put(physics.load_host(domain)), task, seen)

    def error(data):
        return np.quantile(np.abs(data.qvel - seen.next_qvel).max(axis=1), [0.5, 0.9, 0.99])

    assert (error(reduced) <= 1.2 * error(full) + 1e-6).all()


@pytest.mark.parametrize("domain", sorted({split(name)[0] for name in TASKS}))
def test_tasks_of_a_domain_share_one_compiled_step(domain):
    """Everything that compilation depends on, apart from the shapes of states, is equal."""
    loaded = [environment.load(*split(name)) for name in TASKS if split(name)[0] == domain]
    kinds = [jax.tree.flatten((physics.model, physics.blank)) for _, physics in loaded]
    for leaves, structure in kinds:
        assert structure == kinds[0][1]
        assert list(map(jax.typeof, leaves)) == list(map(jax.typeof, kinds[0][0]))
    assert len({task.substeps for task, _ in loaded}) == 1


@pytest.mark.parametrize("domain", sorted({split(name)[0] for name in TASKS}))
def test_only_the_energy_flag_and_solver_iterations_differ_from_the_xml(domain):
    name = next(task for task in TASKS if task.startswith(domain))
    theirs = envs_dmc.load(name).physics.model.ptr
    ours = physics.load_host(domain)
    for field in ("timestep", "integrator", "cone", "disableflags", "solver", "tolerance"):
        assert getattr(ours.opt, field) == getattr(theirs.opt, field)
    np.testing.assert_array_equal(ours.body_mass, theirs.body_mass)
    np.testing.assert_array_equal(ours.actuator_ctrlrange, theirs.actuator_ctrlrange)
