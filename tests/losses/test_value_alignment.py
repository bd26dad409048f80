"""Value alignment: twins of Eq. 4 and Eq. 5, and the routes of its gradient."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from transforms_twin import slow_log_softmax

from vawm import losses

SCALES = {"dynamics_scale": 0.5, "representation_scale": 0.1}


value_alignment_loss = jax.jit(losses.value_alignment_loss, static_argnames=tuple(SCALES))


def pair(shape=(2, 3, 41)):
    return 2 * jax.random.normal(jax.random.key(0), (2, *shape))


def gradients(value, prior, **scales):
    """With respect to the logits at s_t and at s~_t."""
    loss = lambda v, p: value_alignment_loss(v, p, **scales).sum()  # noqa: E731
    return jax.jit(jax.grad(loss, argnums=(0, 1)))(value, prior)


@pytest.mark.parametrize("shape", [(41,), (5, 41), (2, 3, 255)])
@pytest.mark.parametrize(("dynamics", "representation"), [(0.5, 0.1), (1.0, 0.0), (0.0, 1.0)])
def test_loss_matches_its_sum(shape, dynamics, representation):
    value, prior = pair(shape)
    log_v, log_p = slow_log_softmax(value), slow_log_softmax(prior)
    # Both terms have the same value; only their gradients differ.
    twin = (dynamics + representation) * (np.exp(log_v) * (log_v - log_p)).sum(-1)
    actual = value_alignment_loss(
        value, prior, dynamics_scale=dynamics, representation_scale=representation
    )
    np.testing.assert_allclose(actual, twin, rtol=1e-5)


def test_loss_by_hand():
    value, prior = jnp.log(jnp.array([0.5, 0.5])), jnp.log(jnp.array([0.25, 0.75]))
    kl = 0.5 * np.log(2) + 0.5 * np.log(2 / 3)
    actual = value_alignment_loss(value, prior, **SCALES)
    np.testing.assert_allclose(actual, 0.6 * kl, rtol=1e-6)


@pytest.mark.parametrize("scale", [0.0, 3.0])
def test_loss_of_equal_logits_is_exactly_zero(scale):
    value = scale * pair()[0]
    np.testing.assert_array_equal(value_alignment_loss(value, value, **SCALES), 0.0)


def test_loss_and_gradient_of_a_zero_initialised_critic_are_exactly_zero():
    kernel = jnp.zeros((8, 255))
    features = jax.random.normal(jax.random.key(0), (2, 6, 8))

    def loss(features):
        value, prior = features @ kernel
        return value_alignment_loss(value, prior, **SCALES).sum()

    value, gradient = jax.jit(jax.value_and_grad(loss))(features)
    assert value == 0
    np.testing.assert_array_equal(gradient, np.zeros_like(features))


def test_first_term_moves_only_the_prediction():
    value, prior = pair()
    to_value, to_prior = gradients(value, prior, dynamics_scale=0.5, representation_scale=0.0)
    np.testing.assert_array_equal(to_value, np.zeros_like(value))
    twin = 0.5 * (np.exp(slow_log_softmax(prior)) - np.exp(slow_log_softmax(value)))
    np.testing.assert_allclose(to_prior, twin, atol=1e-6)


def test_second_term_moves_only_the_inference():
    value, prior = pair()
    to_value, to_prior = gradients(value, prior, dynamics_scale=0.0, representation_scale=0.1)
    np.testing.assert_array_equal(to_prior, np.zeros_like(prior))
    log_v, log_p = slow_log_softmax(value), slow_log_softmax(prior)
    kl = (np.exp(log_v) * (log_v - log_p)).sum(-1, keepdims=True)
    np.testing.assert_allclose(to_value, 0.1 * np.exp(log_v) * (log_v - log_p - kl), atol=1e-6)


def test_no_gradient_reaches_a_critic_whose_parameters_are_stopped():
    features = jax.random.normal(jax.random.key(0), (2, 6, 8))
    critic = jax.random.normal(jax.random.key(1), (8, 41))

    def loss(critic, features):
        value, prior = features @ jax.lax.stop_gradient(critic)
        return value_alignment_loss(value, prior, **SCALES).sum()

    to_critic, to_features = jax.jit(jax.grad(loss, argnums=(0, 1)))(critic, features)
    np.testing.assert_array_equal(to_critic, np.zeros_like(critic))
    assert (np.abs(to_features).sum(-1) > 0).all()


def test_loss_is_finite_for_certain_critics_that_disagree():
    value, prior = jnp.eye(255)[:2] * 1e4
    actual = value_alignment_loss(value, prior, **SCALES)
    np.testing.assert_allclose(actual, 0.6e4, rtol=1e-5)
    for gradient in gradients(value, prior, **SCALES):
        assert np.isfinite(gradient).all()


def test_loss_under_jit_equals_eager():
    value, prior = pair()
    eager = losses.value_alignment_loss(value, prior, **SCALES)
    np.testing.assert_allclose(value_alignment_loss(value, prior, **SCALES), eager, rtol=1e-5)


@pytest.mark.parametrize("shape", [(2, 3, 40), (3, 41), (1, 3, 41)])
def test_loss_refuses_logits_of_another_shape(shape):
    with pytest.raises(AssertionError):
        value_alignment_loss(pair()[0], jnp.zeros(shape), **SCALES)


@pytest.mark.parametrize(("step", "open_"), [(0, 0), (9_999, 0), (10_000, 0), (10_001, 1)])
def test_weight_is_zero_up_to_and_including_the_warm_up(step, open_):
    kl = jnp.array([0.0, 0.5, 1.0, 2.0, 40.0])
    actual = losses.value_alignment_weight(kl, jnp.array(step), warmup_steps=10_000)
    np.testing.assert_allclose(actual, open_ * np.array([1, 1, 1, 0.5, 0.025]), rtol=1e-6)


def test_weight_takes_a_plain_step():
    weight = losses.value_alignment_weight(jnp.ones((2, 3)), 1, warmup_steps=0)
    np.testing.assert_array_equal(weight, np.ones((2, 3)))


def test_weight_has_no_gradient():
    weight = lambda kl: losses.value_alignment_weight(  # noqa: E731
        kl, jnp.array(7), warmup_steps=0
    ).sum()
    np.testing.assert_array_equal(jax.grad(weight)(jnp.array([0.5, 2.0, 9.0])), np.zeros(3))


def test_weight_refuses_a_step_per_state():
    with pytest.raises(AssertionError):
        losses.value_alignment_weight(jnp.ones(3), jnp.arange(3), warmup_steps=0)
