"""Critic and actor losses against float64 twins, and by hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from transforms_twin import slow_log_softmax, slow_two_hot

from vawm import losses
from vawm.losses import transforms

BINS = transforms.symexp_bins(41)


critic_loss = jax.jit(losses.critic_loss, static_argnames="slow_scale")


def batch(shape=(4, 3)):
    key_logits, key_slow, key_returns = jax.random.split(jax.random.key(0), 3)
    return (
        jax.random.normal(key_logits, (*shape, 41)),
        10 * jax.random.normal(key_slow, shape),
        10 * jax.random.normal(key_returns, shape),
    )


@pytest.mark.parametrize("slow_scale", [0.0, 1.0, 0.3])
def test_critic_loss_is_the_sum_of_both_cross_entropies(slow_scale):
    logits, slow_value, target = batch()
    log_prob = slow_log_softmax(logits).reshape(-1, 41)
    codes = (slow_two_hot(x.ravel(), BINS) for x in (target, slow_value))
    to_returns, to_slow = (-(code * log_prob).sum(-1).reshape(4, 3) for code in codes)
    actual = critic_loss(logits, slow_value, target, bins=BINS, slow_scale=slow_scale)
    np.testing.assert_allclose(actual, to_returns + slow_scale * to_slow, rtol=1e-5)


def test_critic_loss_of_a_zero_critic_is_two_log_bins():
    zeros = jnp.zeros((4, 3))
    actual = critic_loss(jnp.zeros((4, 3, 41)), zeros, zeros + 9.0, bins=BINS, slow_scale=1.0)
    np.testing.assert_allclose(actual, 2 * np.log(41), rtol=1e-6)


def test_critic_loss_moves_the_logits_alone():
    loss = lambda *x: critic_loss(*x, bins=BINS, slow_scale=1.0).sum()  # noqa: E731
    to_logits, to_slow, to_returns = jax.jit(jax.grad(loss, argnums=(0, 1, 2)))(*batch())
    np.testing.assert_array_equal(to_slow, np.zeros((4, 3)))
    np.testing.assert_array_equal(to_returns, np.zeros((4, 3)))
    assert (np.abs(to_logits).sum(-1) > 0).all()


def test_critic_loss_is_least_where_the_mean_is_the_return():
    bins = jnp.array([-1.0, 0.0, 1.0])
    zero, code = jnp.zeros(()), jnp.log(jnp.array([1e-9, 0.25, 0.75]))
    gradient = jax.grad(critic_loss)(code, zero, jnp.array(0.75), bins=bins, slow_scale=0.0)
    np.testing.assert_allclose(gradient, np.zeros(3), atol=1e-6)


def test_critic_loss_refuses_a_bootstrap_value_too_many():
    logits, slow_value, target = batch()
    with pytest.raises(AssertionError):
        critic_loss(logits, slow_value, target[:-1], bins=BINS, slow_scale=1.0)


@pytest.mark.parametrize("shape", [(), (5,), (4, 3)])
def test_actor_loss_matches_its_sum(shape):
    log_prob, entropy, advantage = np.random.default_rng(0).normal(size=(3, *shape))
    as_float32 = (jnp.asarray(x, jnp.float32) for x in (log_prob, entropy, advantage))
    actual = np.asarray(jax.jit(losses.actor_loss)(*as_float32, entropy_scale=0.3))
    assert actual.shape == shape
    for i in np.ndindex(shape):
        twin = -advantage[i] * log_prob[i] - 0.3 * entropy[i]
        np.testing.assert_allclose(actual[i], twin, rtol=1e-5, atol=1e-6)


def test_actor_loss_by_hand():
    actual = losses.actor_loss(
        jnp.array([-1.0, -2.0]),
        jnp.array([0.5, 3.0]),
        jnp.array([4.0, -1.0]),
        entropy_scale=0.1,
    )
    np.testing.assert_allclose(actual, [3.95, -2.3], rtol=1e-6)


def test_actor_loss_raises_the_probability_of_good_actions_and_stops_the_advantage():
    loss = lambda *x: losses.actor_loss(*x, entropy_scale=1e-3).sum()  # noqa: E731
    advantage = jnp.array([2.0, -3.0])
    gradients = jax.grad(loss, argnums=(0, 1, 2))(jnp.zeros(2), jnp.zeros(2), advantage)
    np.testing.assert_allclose(gradients[0], [-2.0, 3.0])
    np.testing.assert_allclose(gradients[1], [-1e-3, -1e-3])
    np.testing.assert_array_equal(gradients[2], [0.0, 0.0])


def test_actor_loss_refuses_a_log_prob_per_action_dimension():
    with pytest.raises(AssertionError):
        losses.actor_loss(jnp.zeros((4, 6)), jnp.zeros(4), jnp.zeros(4), entropy_scale=1e-3)


def test_discount_weights_include_the_start():
    cont = jnp.array([[0.5, 0.0], [0.8, 0.9], [0.0, 0.9]])
    actual = losses.discount_weights(cont)
    np.testing.assert_allclose(actual, [[0.5, 0.0], [0.4, 0.0], [0.0, 0.0]], rtol=1e-6)


@pytest.mark.parametrize("shape", [(15,), (6, 2, 3)])
def test_discount_weights_match_their_product(shape):
    cont = np.random.default_rng(0).random(shape)
    actual = np.asarray(jax.jit(losses.discount_weights)(jnp.asarray(cont, jnp.float32)))
    assert actual.shape == shape
    for i in np.ndindex(shape):
        twin = 1.0
        for t in range(i[0] + 1):
            twin *= cont[t, *i[1:]]
        np.testing.assert_allclose(actual[i], twin, rtol=1e-5)


def test_discount_weights_have_no_gradient():
    cont = jnp.full((5, 2), 0.9)
    gradient = jax.grad(lambda c: losses.discount_weights(c).sum())(cont)
    np.testing.assert_array_equal(gradient, np.zeros((5, 2)))


def test_critic_loss_under_jit_equals_eager():
    eager = losses.critic_loss(*batch(), bins=BINS, slow_scale=0.3)
    np.testing.assert_allclose(
        critic_loss(*batch(), bins=BINS, slow_scale=0.3), eager, rtol=1e-5
    )
