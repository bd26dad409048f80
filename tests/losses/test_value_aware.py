"""VAML, IterVAML and CVAML: float64 twins, unbiasedness by enumeration, and gradients."""

import itertools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from vawm import losses

iter_vaml_loss = jax.jit(losses.iter_vaml_loss)
cvaml_loss = jax.jit(losses.cvaml_loss)
categorical_iter_vaml_loss = jax.jit(losses.categorical_iter_vaml_loss)


def values(samples, shape=(4, 3)):
    rng = np.random.default_rng(0)
    prediction = 3 * rng.normal(size=(*samples, *shape))
    target = 3 * rng.normal(size=(*samples[:-1], *shape))
    return prediction.astype(np.float32), target.astype(np.float32)


def slow_square(samples, target):
    """IterVAML of one element, from its M values."""
    return (sum(samples) / len(samples) - target) ** 2


def slow_pairs(samples, target):
    """CVAML of one element: the mean over ordered pairs of different samples."""
    pairs = list(itertools.permutations(samples, 2))
    return sum((a - target) * (b - target) for a, b in pairs) / len(pairs)


@pytest.mark.parametrize("shape", [(), (4, 3)])
@pytest.mark.parametrize(
    ("loss", "twin"), [(iter_vaml_loss, slow_square), (cvaml_loss, slow_pairs)]
)
@pytest.mark.parametrize("samples", [2, 5])
def test_sampled_losses_match_their_sums(shape, loss, twin, samples):
    prediction, target = values((samples,), shape)
    actual = loss(prediction, target)
    assert actual.shape == shape
    for i in np.ndindex(shape):
        expected = twin(prediction[:, *i].astype(np.float64), np.float64(target[i]))
        np.testing.assert_allclose(actual[i], expected, rtol=1e-4, atol=1e-5)


def test_sampled_losses_by_hand():
    prediction, target = jnp.array([[1.0, 3.0], [3.0, -3.0]]), jnp.array([5.0, 0.0])
    np.testing.assert_allclose(losses.iter_vaml_loss(prediction, target), [9.0, 0.0])
    # Variances 2 and 18, halved; pairs (1 - 5)(3 - 5) = 8 and 3 * -3 = -9.
    np.testing.assert_allclose(losses.cvaml_loss(prediction, target), [8.0, -9.0])


@pytest.mark.parametrize("loss", [losses.iter_vaml_loss, losses.cvaml_loss])
def test_sampled_losses_stop_their_target_alone(loss):
    gradient = jax.grad(lambda *x: loss(*x).sum(), argnums=(0, 1))
    to_prediction, to_target = jax.jit(gradient)(*values((3,)))
    np.testing.assert_array_equal(to_target, np.zeros_like(to_target))
    assert (np.abs(to_prediction) > 0).all()


def test_gradients_of_sampled_losses_by_hand():
    prediction, target = jnp.array([1.0, 3.0]), jnp.array(5.0)
    np.testing.assert_allclose(jax.grad(losses.iter_vaml_loss)(prediction, target), [-3, -3])
    # Of the product of both deviations, -4 and -2: each has the other.
    np.testing.assert_allclose(jax.grad(losses.cvaml_loss)(prediction, target), [-2, -4])


def test_with_equal_samples_both_losses_are_the_squared_error():
    prediction, target = jnp.full((4, 2), 3.0), jnp.array([1.0, 3.0])
    np.testing.assert_allclose(losses.iter_vaml_loss(prediction, target), [4.0, 0.0])
    np.testing.assert_allclose(losses.cvaml_loss(prediction, target), [4.0, 0.0])


OUTCOMES = 3
numbers = st.floats(-3, 3, width=32)


@pytest.mark.parametrize("samples", [2, 3])
@given(
    outcomes=arrays(np.float32, OUTCOMES, elements=numbers),
    odds=arrays(np.float32, OUTCOMES, elements=st.floats(0.125, 1, width=32)),
    target=numbers,
)
def test_cvaml_is_unbiased_and_iter_vaml_is_inflated_by_the_variance_of_its_mean(
    samples, outcomes, odds, target
):
    """Over every draw of M samples from three outcomes, each weighted by its probability."""
    draws = np.array(list(itertools.product(range(OUTCOMES), repeat=samples))).T
    probability = odds.astype(np.float64) / odds.sum(dtype=np.float64)
    weight = probability[draws].prod(0)
    targets = np.full(draws.shape[1], target, np.float32)
    naive = weight @ np.asarray(iter_vaml_loss(outcomes[draws], targets), np.float64)
    corrected = weight @ np.asarray(cvaml_loss(outcomes[draws], targets), np.float64)
    mean = probability @ outcomes
    variance = probability @ (outcomes - mean) ** 2
    np.testing.assert_allclose(corrected, (mean - target) ** 2, rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(
        naive, (mean - target) ** 2 + variance / samples, rtol=1e-4, atol=1e-4
    )


@pytest.mark.parametrize("samples", [0, 1])
def test_cvaml_refuses_fewer_than_two_samples(samples):
    with pytest.raises(ValueError, match=f"prediction_values .*{samples} sample"):
        losses.cvaml_loss(jnp.zeros((samples, 3)), jnp.zeros(3))


@pytest.mark.parametrize("shape", [(2, 4, 2), (4, 3), (2, 4, 1)])
@pytest.mark.parametrize("loss", [losses.iter_vaml_loss, losses.cvaml_loss])
def test_sampled_losses_refuse_a_target_of_another_shape(loss, shape):
    with pytest.raises(AssertionError):
        loss(jnp.zeros(shape), jnp.zeros((4, 3)))


def test_vaml_is_the_worst_critic_at_each_element():
    prediction, target = values((5, 2))
    actual = jax.jit(losses.vaml_loss)(prediction, target)
    assert actual.shape == (4, 3)
    for i in np.ndindex(4, 3):
        expected = max(
            slow_square(prediction[k, :, *i].astype(np.float64), np.float64(target[k, *i]))
            for k in range(5)
        )
        np.testing.assert_allclose(actual[i], expected, rtol=1e-5)


def test_vaml_by_hand():
    # Two critics, one sample: errors -2 and 1 in the first element, 0 and -3 in the second.
    prediction = jnp.array([[[1.0, 2.0]], [[5.0, 1.0]]])
    target = jnp.array([[3.0, 2.0], [4.0, 4.0]])
    np.testing.assert_allclose(losses.vaml_loss(prediction, target), [4.0, 9.0])
    gradient = jax.grad(lambda *x: losses.vaml_loss(*x).sum(), argnums=(0, 1))
    to_prediction, to_target = gradient(prediction, target)
    np.testing.assert_allclose(to_prediction, [[[-4.0, 0.0]], [[0.0, -6.0]]])
    np.testing.assert_array_equal(to_target, np.zeros((2, 2)))


def test_the_mean_of_the_worst_is_no_less_than_the_worst_mean():
    prediction, target = values((5, 1))
    worst = losses.vaml_loss(prediction, target).mean()
    means = jax.vmap(losses.iter_vaml_loss)(prediction, target).mean((1, 2))
    assert means.max() < worst


def test_critics_that_tie_share_the_gradient():
    prediction, target = jnp.array([[[3.0]], [[-1.0]]]), jnp.array([[1.0], [1.0]])
    gradient = jax.grad(lambda x: losses.vaml_loss(x, target).sum())(prediction)
    np.testing.assert_allclose(gradient, [[[2.0]], [[-2.0]]])  # half of 4 and of -4


def test_vaml_refuses_critics_without_targets():
    with pytest.raises(AssertionError):
        losses.vaml_loss(jnp.zeros((5, 2, 3)), jnp.zeros((4, 3)))


def test_vaml_refuses_a_mean_over_no_samples():
    with pytest.raises(AssertionError):
        losses.iter_vaml_loss(jnp.zeros((0, 3)), jnp.zeros(3))


def logits(shape=(2, 3, 41)):
    return jnp.asarray(2 * np.random.default_rng(0).normal(size=(2, *shape)), jnp.float32)


def test_categorical_loss_matches_its_sum():
    prediction, target = np.asarray(logits(), np.float64)
    log_v = prediction - np.log(np.exp(prediction).sum(-1, keepdims=True))
    code = np.exp(target) / np.exp(target).sum(-1, keepdims=True)
    actual = categorical_iter_vaml_loss(*logits())
    np.testing.assert_allclose(actual, -(code * log_v).sum(-1), rtol=1e-5)


def test_categorical_loss_by_hand():
    prediction, target = jnp.log(jnp.array([0.25, 0.75])), jnp.log(jnp.array([0.5, 0.5]))
    actual = categorical_iter_vaml_loss(prediction, target)
    np.testing.assert_allclose(actual, -0.5 * np.log(0.25 * 0.75), rtol=1e-6)


def test_categorical_loss_has_the_gradient_of_the_first_term_of_value_alignment():
    prediction, target = logits()
    gradient = jax.grad(lambda *x: categorical_iter_vaml_loss(*x).sum(), argnums=(0, 1))
    to_prediction, to_target = jax.jit(gradient)(prediction, target)
    first = lambda p: losses.value_alignment_loss(  # noqa: E731
        target, p, dynamics_scale=1.0, representation_scale=0.0
    ).sum()
    np.testing.assert_allclose(to_prediction, jax.grad(first)(prediction), atol=1e-6)
    assert (np.abs(to_prediction) > 0).any()
    np.testing.assert_array_equal(to_target, np.zeros_like(target))


def test_categorical_loss_is_finite_for_certain_critics_that_disagree():
    actual = categorical_iter_vaml_loss(*jnp.eye(255)[:2] * 1e4)
    np.testing.assert_allclose(actual, 1e4, rtol=1e-5)


@pytest.mark.parametrize("shape", [(2, 3, 40), (3, 41), (1, 3, 41)])
def test_categorical_loss_refuses_logits_of_another_shape(shape):
    with pytest.raises(AssertionError):
        losses.categorical_iter_vaml_loss(logits()[0], jnp.zeros(shape))


@pytest.mark.parametrize(("jitted", "samples"), [(iter_vaml_loss, (3,)), (cvaml_loss, (3,))])
def test_jit_equals_eager(jitted, samples):
    eager = jitted.__wrapped__(*map(jnp.asarray, values(samples)))
    np.testing.assert_allclose(jitted(*values(samples)), eager, rtol=1e-5, atol=1e-6)
