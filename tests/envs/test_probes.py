"""Probes: their closed-form values, by playing them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vawm.envs import probes
from vawm.errors import InvalidInput

N, T, DISCOUNT = 64, 4, 0.9


def play(name, policy, steps, *, num_envs=N):
    """`[steps + 1, N]` time steps and the visible signal, under `policy(state)`."""
    env = probes.make(name, num_envs=num_envs, episode_length=T)

    def body(carry, _):
        state, timestep = carry
        return env.step(state, policy(state)), (timestep, state.data, state.steps)

    start = env.reset(jax.random.key(0))
    return jax.jit(lambda start: jax.lax.scan(body, start, None, length=steps + 1)[1])(start)


@pytest.mark.parametrize("name", probes.PROBES)
def test_known_values_are_the_discounted_returns_of_the_best_policy(name):
    """Averaged over environments where rewards are random beyond the visible signal."""
    timestep, signal, steps = play(name, lambda s: probes.optimal_action(name, s.target), T)
    reward = np.asarray(timestep.reward, float)
    for t in range(T):
        returns = sum(DISCOUNT**k * reward[t + 1 + k] for k in range(T - t))
        if name == "truncation":  # truncation bootstraps: the value continues
            returns += DISCOUNT ** (T - t) / (1 - DISCOUNT)
        expected = probes.known_value(
            name, steps=steps[t], signal=signal[t], discount=DISCOUNT, episode_length=T
        )
        if name == "observation_reward":
            returns = [returns[signal[t] == s].mean() for s in (-1, 1)]
            np.testing.assert_allclose(returns, [-1, 1], atol=0.6)  # noise of later steps
            np.testing.assert_array_equal(expected, signal[t])
            np.testing.assert_array_equal(reward[t + 1], signal[t])
        else:
            np.testing.assert_allclose(returns, expected, rtol=1e-6)


@pytest.mark.parametrize("name", probes.PROBES)
def test_episodes_end_and_start_again(name):
    timestep, _, steps = play(name, lambda s: probes.optimal_action(name, s.target), 2 * T + 1)
    index = np.arange(2 * T + 2) % (T + 1)
    np.testing.assert_array_equal(steps[:, 0], index)
    np.testing.assert_array_equal(timestep.is_first[:, 0], index == 0)
    np.testing.assert_array_equal(timestep.is_last[:, 0], index == T)
    ends = (index == T) & (name != "truncation")
    np.testing.assert_array_equal(timestep.is_terminal[:, 0], ends)
    np.testing.assert_array_equal(timestep.obs[:, 0, 1], index / np.float32(T))
    assert not timestep.reward[index == 0].any()


@pytest.mark.parametrize("name", ["memory", "memory_discrete"])
def test_without_memory_the_memory_probe_is_worth_less(name):
    """The signal is gone after the first observation; the best blind guess is halfway."""

    def blind(state):
        if name.endswith("discrete"):
            return jax.nn.one_hot(jnp.ones(N, jnp.int32), 2)
        return jnp.zeros((N, 1))

    timestep, signal, _ = play(name, blind, T)
    assert not signal[1:].any()
    np.testing.assert_array_equal(np.abs(signal[0]), 1)
    assert not timestep.reward[:T].any()
    assert timestep.reward[T].mean() < 0.75


def test_compiled_and_eager_steps_are_equal():
    env = probes.make("memory", num_envs=N)
    start = [env.reset(jax.random.key(0))[0] for _ in range(2)]
    action = jnp.full((N, 1), 0.3)
    with jax.disable_jit():
        eager = env.step(start[0], action)[1]
    jax.tree.map(np.testing.assert_array_equal, eager, jax.jit(env.step)(start[1], action)[1])


def test_the_fit_of_an_action_by_hand():
    fit = probes.fit(jnp.array([[0.5], [-0.5], [0.0], [9.0]]), jnp.ones(4), False)
    np.testing.assert_allclose(fit, [1.0, -3.0, 0.0, 0.0])
    choices = jnp.array([[0.0, 1.0], [1.0, 0.0], [0.0, 1.0], [1.0, 0.0]])
    target = jnp.array([1.0, 1.0, -1.0, -1.0])
    np.testing.assert_array_equal(probes.fit(choices, target, True), [1, 0, 0, 1])
    np.testing.assert_allclose(probes.fit(jnp.array([[jnp.nan]]), jnp.ones(1), False), 0.0)


def test_signals_differ_between_environments_and_episodes():
    _, signal, steps = play("memory", lambda s: jnp.zeros((N, 1)), 4 * T)
    first = np.asarray(signal)[np.asarray(steps) == 0].reshape(-1, N)
    assert 0 < (first > 0).mean() < 1
    assert (first[0] != first[1]).any()


@pytest.mark.parametrize(
    ("arguments", "field"),
    [
        ({"name": "memroy"}, "probe"),
        ({"num_envs": 0}, "num_envs"),
        ({"episode_length": 0}, "episode_length"),
    ],
)
def test_bad_arguments_are_refused(arguments, field):
    with pytest.raises(InvalidInput) as refusal:
        probes.make(**({"name": "memory", "num_envs": 1} | arguments))
    assert refusal.value.field == field
