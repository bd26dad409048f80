"""Returns against the recursion written out, and by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from returns_twin import slow_lambda_returns, slow_replay_returns

from vawm.losses import returns


@pytest.mark.parametrize("shape", [(5,), (5, 3), (1, 2), (4, 2, 3)])
@pytest.mark.parametrize("lambda_", [0.0, 0.95, 1.0])
def test_lambda_returns_match_the_recursion(shape, lambda_):
    key_reward, key_discount, key_value = jax.random.split(jax.random.key(0), 3)
    reward = jax.random.normal(key_reward, shape)
    discount = jax.random.uniform(key_discount, shape)
    value = jax.random.normal(key_value, shape)
    actual = returns.lambda_returns(reward, discount, value, lambda_=lambda_)
    twin = slow_lambda_returns(reward, discount, value, lambda_)
    np.testing.assert_allclose(actual, twin, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("shape", [(5,), (5, 3), (1, 2)])
@pytest.mark.parametrize("lambda_", [0.0, 0.95, 1.0])
def test_lambda_returns_of_current_values_match_the_recursion(shape, lambda_):
    """STORM's official code: R_t = r + d ((1 - l) v_t + l R_{t+1}), R_H = v_H."""
    rng = np.random.default_rng(0)
    reward, discount = rng.normal(size=shape), rng.uniform(size=shape)
    value = rng.normal(size=(shape[0] + 1, *shape[1:]))
    as_float32 = (jnp.asarray(x, jnp.float32) for x in (reward, discount, value[:-1]))
    bootstrap = jnp.asarray(value[-1], jnp.float32)
    actual = returns.lambda_returns(*as_float32, bootstrap, lambda_=lambda_)
    twin, following = np.zeros(shape), value[-1]
    for t in reversed(range(shape[0])):
        mixed = (1 - lambda_) * value[t] + lambda_ * following
        twin[t] = following = reward[t] + discount[t] * mixed
    np.testing.assert_allclose(actual, twin, rtol=1e-5, atol=1e-6)


def test_a_last_value_as_bootstrap_changes_nothing():
    reward, discount, value = jax.random.uniform(jax.random.key(0), (3, 5, 2))
    usual = returns.lambda_returns(reward, discount, value, lambda_=0.9)
    given = returns.lambda_returns(reward, discount, value, value[-1], lambda_=0.9)
    np.testing.assert_array_equal(given, usual)


def test_lambda_returns_stop_at_a_terminal_state():
    reward = jnp.array([1.0, 10.0, 100.0])
    discount = jnp.array([1.0, 0.0, 1.0])  # s_2 is terminal
    value = jnp.full(3, 7.0)
    actual = returns.lambda_returns(reward, discount, value, lambda_=1.0)
    np.testing.assert_allclose(actual, [11.0, 10.0, 107.0])


def test_lambda_zero_is_one_step_temporal_difference():
    reward, discount, value = (
        jnp.array([1.0, 2.0]),
        jnp.array([0.5, 0.5]),
        jnp.array([4.0, 8.0]),
    )
    actual = returns.lambda_returns(reward, discount, value, lambda_=0.0)
    np.testing.assert_allclose(actual, [3.0, 6.0])


def test_gradients_pass_through_lambda_returns():
    reward, discount, value = jnp.array([1.0, 2.0]), jnp.array([0.5, 0.25]), jnp.array([4.0, 8])
    first = lambda *x: returns.lambda_returns(*x, lambda_=0.5)[0]  # noqa: E731
    to_reward, to_discount, to_value = jax.grad(first, argnums=(0, 1, 2))(
        reward, discount, value
    )
    # R_0 = r_1 + d_1 (v_1 / 2 + R_1 / 2), R_1 = r_2 + d_2 v_2 = 4
    np.testing.assert_allclose(to_reward, [1.0, 0.25])
    np.testing.assert_allclose(to_discount, [4.0, 2.0])
    np.testing.assert_allclose(to_value, [0.25, 0.0625])


def test_lambda_returns_refuse_shapes_that_would_broadcast():
    with pytest.raises(AssertionError):
        returns.lambda_returns(
            jnp.zeros((5, 3)), jnp.zeros((5, 1)), jnp.zeros((5, 3)), lambda_=1
        )


@pytest.mark.parametrize("lambda_", [0.0, 0.95, 1.0])
def test_replay_returns_match_the_recursion(lambda_):
    rng = np.random.default_rng(0)
    reward, bootstrap = rng.normal(size=(2, 6, 12))
    is_last = rng.random((6, 12)) < 0.3
    is_terminal = is_last & (rng.random((6, 12)) < 0.5)
    actual = returns.replay_returns(
        jnp.asarray(reward),
        jnp.asarray(is_last),
        jnp.asarray(is_terminal),
        jnp.asarray(bootstrap),
        discount=0.9,
        lambda_=lambda_,
    )
    twin = slow_replay_returns(reward, is_last, is_terminal, bootstrap, 0.9, lambda_)
    np.testing.assert_allclose(actual, twin, rtol=1e-5, atol=1e-6)


def test_replay_returns_bootstrap_at_truncation_and_not_at_termination():
    reward = jnp.array([[100.0, 1.0, 2.0, 4.0], [100.0, 1.0, 2.0, 4.0]])
    is_last = jnp.array([[False, False, True, False]] * 2)
    is_terminal = is_last & jnp.array([[False], [True]])
    bootstrap = jnp.full((2, 4), 10.0)
    actual = returns.replay_returns(
        reward, is_last, is_terminal, bootstrap, discount=0.5, lambda_=1.0
    )
    # R_2 = 4 + 5; R_1 = 2 + 5 when cut, 2 when terminal; R_0 = 1 + R_1 / 2.
    np.testing.assert_allclose(actual, [[4.5, 7.0, 9.0], [2.0, 2.0, 9.0]])


def test_replay_returns_ignore_steps_after_the_end_of_an_episode():
    reward = jnp.zeros((1, 5))
    is_last = jnp.array([[False, False, True, False, False]])
    bootstrap = jnp.zeros((1, 5))

    def first(reward, bootstrap):
        result = returns.replay_returns(
            reward, is_last, jnp.zeros((1, 5), bool), bootstrap, discount=0.9, lambda_=0.95
        )
        return result[0, 0]

    by_reward, by_bootstrap = jax.grad(first, argnums=(0, 1))(reward, bootstrap)
    np.testing.assert_array_equal(by_reward[0, 3:], [0.0, 0.0])
    np.testing.assert_array_equal(by_bootstrap[0, 3:], [0.0, 0.0])
    assert by_reward[0, 0] == 0  # r_0 arrived before any scored state
    assert by_bootstrap[0, 2] == pytest.approx(0.95 * 0.9**2)


def test_lambda_returns_refuse_a_bootstrap_of_another_shape():
    steps = [jnp.zeros((5, 3))] * 3
    with pytest.raises(AssertionError):
        returns.lambda_returns(*steps, jnp.zeros(1), lambda_=1)


def test_replay_returns_refuse_time_first_flags():
    flags = jnp.zeros((5, 2), bool)
    with pytest.raises(AssertionError):
        returns.replay_returns(
            jnp.zeros((2, 5)), flags, flags, jnp.zeros((2, 5)), discount=0.9, lambda_=0.9
        )


def test_return_scale_moves_from_zero_by_the_decay():
    batch = jnp.arange(101.0)
    state = returns.init_return_scale()
    state = returns.update_return_scale(state, batch, decay=0.99, low=0.05, high=0.95)
    np.testing.assert_allclose(state, (0.05, 0.95), rtol=1e-5)
    state = returns.update_return_scale(state, batch + 100, decay=0.99, low=0.05, high=0.95)
    np.testing.assert_allclose(state, (1.0995, 2.8905), rtol=1e-5)


def test_return_scale_pools_every_axis():
    batch = jax.random.normal(jax.random.key(0), (15, 4, 8))
    state = returns.update_return_scale(
        returns.init_return_scale(), batch, decay=0.0, low=0.05, high=0.95
    )
    np.testing.assert_allclose(state, np.percentile(batch, [5, 95]), rtol=1e-5)


@pytest.mark.parametrize(("high", "expected"), [(0.5, 1.0), (9.0, 10.0)])
def test_return_scale_never_falls_below_its_limit(high, expected):
    state = returns.ReturnScale(low=jnp.array(-1.0 if high > 1 else 0.0), high=jnp.array(high))
    np.testing.assert_allclose(returns.return_scale(state, limit=1.0), expected)


def test_return_scale_has_no_gradient():
    def scale(batch):
        state = returns.update_return_scale(
            returns.init_return_scale(), batch, decay=0.0, low=0.05, high=0.95
        )
        return returns.return_scale(state, limit=1.0)

    np.testing.assert_array_equal(jax.grad(scale)(10 * jnp.arange(20.0)), np.zeros(20))
