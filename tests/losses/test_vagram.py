"""VaGraM: float64 twins of its four forms, their inequalities, and their gradients."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from vawm import losses

FORMS = {
    "diagonal": losses.vagram_loss,
    "taylor": losses.vagram_taylor_loss,
    "second order": losses.vagram_second_order_loss,
    "joint": losses.vagram_joint_loss,
}


def tanh_value(critic, x):
    """V(x) = sum_k out_k tanh(weight_k . x), of any leading dims."""
    weight, out = critic
    return jnp.tanh(x @ weight.T) @ out


def tanh_derivatives(critic, x):
    """Gradient and Hessian of `tanh_value` at one state, written out in float64."""
    weight, out = (np.asarray(a, np.float64) for a in critic)
    t = np.tanh(weight @ x)
    return weight.T @ (out * (1 - t**2)), weight.T @ np.diag(-2 * out * t * (1 - t**2)) @ weight


def twin(form, gradient, hessian, error):
    first = sum(g * e for g, e in zip(gradient, error, strict=True)) ** 2
    diagonal = sum((g * e) ** 2 for g, e in zip(gradient, error, strict=True))
    product = hessian @ error
    return {
        "diagonal": diagonal,
        "taylor": first,
        "second order": 2 * first + 0.5 * (error @ product) ** 2,
        "joint": 2 * diagonal + 0.5 * (product @ product),
    }[form]


def batch(shape=(2, 3), size=4):
    """A critic of five units, predictions and targets."""
    rng = np.random.default_rng(0)
    critic, states = rng.normal(size=(5, size + 1)), rng.normal(size=(2, *shape, size))
    parts = critic[:, 1:], critic[:, 0], *states
    weight, out, prediction, target = (jnp.asarray(x, jnp.float32) for x in parts)
    return (weight, out), prediction, target


def summed(form):
    """The sum of the losses, jitted, of (critic, prediction, target)."""

    def loss(critic, prediction, target):
        return FORMS[form](lambda x: tanh_value(critic, x), prediction, target).sum()

    return loss


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("shape", [(), (2, 3)])
def test_losses_match_their_sums_over_written_out_derivatives(form, shape):
    critic, prediction, target = batch(shape)
    loss = jax.jit(lambda *x: FORMS[form](lambda x: tanh_value(critic, x), *x))
    actual = loss(prediction, target)
    assert actual.shape == shape
    for index in np.ndindex(shape):
        state, guess = (np.asarray(x[index], np.float64) for x in (target, prediction))
        expected = twin(form, *tanh_derivatives(critic, state), guess - state)
        np.testing.assert_allclose(actual[index], expected, rtol=1e-4)


@pytest.mark.parametrize(
    ("form", "expected"),
    [("diagonal", 13.0), ("taylor", 1.0), ("second order", 2.125), ("joint", 26.5)],
)
def test_losses_by_hand(form, expected):
    # V = x_0^2 + 3 x_1 at (2, 1): g = (4, 3), H = diag(2, 0). e = (1/2, -1), so g . e = -1,
    # e' H e = 1/2 and H e = (1, 0).
    value = lambda x: jnp.square(x[..., 0]) + 3 * x[..., 1]  # noqa: E731
    actual = FORMS[form](value, jnp.array([[2.5, 0.0]]), jnp.array([[2.0, 1.0]]))
    np.testing.assert_allclose(actual, [expected], rtol=1e-6)


def test_the_first_order_form_is_blind_along_a_plane_and_the_diagonal_one_is_not():
    value = lambda x: x[..., 0] + 2 * x[..., 1]  # noqa: E731
    prediction, target = jnp.array([2e3, -1e3]), jnp.zeros(2)
    assert losses.vagram_taylor_loss(value, prediction, target) == 0
    assert losses.vagram_second_order_loss(value, prediction, target) == 0
    np.testing.assert_allclose(losses.vagram_loss(value, prediction, target), 8e6)


def test_the_gradient_of_the_diagonal_form_is_the_weighted_error():
    critic, prediction, target = batch(())
    actual = jax.jit(jax.grad(summed("diagonal"), argnums=1))(critic, prediction, target)
    gradient, _ = tanh_derivatives(critic, np.asarray(target, np.float64))
    np.testing.assert_allclose(actual, 2 * gradient**2 * (prediction - target), rtol=1e-4)


def test_the_gradient_of_the_second_order_form_goes_through_both_sides_of_the_hessian():
    critic, prediction, target = batch(())
    actual = jax.jit(jax.grad(summed("second order"), argnums=1))(critic, prediction, target)
    gradient, hessian = tanh_derivatives(critic, np.asarray(target, np.float64))
    error = np.asarray(prediction, np.float64) - np.asarray(target, np.float64)
    product = hessian @ error
    expected = 4 * (gradient @ error) * gradient + 2 * (error @ product) * product
    np.testing.assert_allclose(actual, expected, rtol=1e-4)


@pytest.mark.parametrize("form", FORMS)
def test_no_gradient_reaches_the_target(form):
    gradient = jax.jit(jax.grad(summed(form), argnums=(1, 2)))
    to_prediction, to_target = gradient(*batch())
    np.testing.assert_array_equal(to_target, np.zeros_like(to_target))
    assert (np.abs(to_prediction) > 0).all()


@pytest.mark.parametrize("form", ["diagonal", "taylor"])
def test_no_gradient_reaches_the_critic_of_a_first_order_form(form):
    for gradient in jax.jit(jax.grad(summed(form)))(*batch()):
        np.testing.assert_array_equal(gradient, np.zeros_like(gradient))


@pytest.mark.parametrize("form", ["second order", "joint"])
def test_a_second_order_form_leaves_its_critic_to_the_caller(form):
    loss = summed(form)
    live = jax.jit(jax.grad(loss))(*batch())
    assert all((np.abs(gradient) > 0).any() for gradient in live)
    frozen = jax.jit(jax.grad(lambda critic, *x: loss(jax.lax.stop_gradient(critic), *x)))
    for gradient in frozen(*batch()):
        np.testing.assert_array_equal(gradient, np.zeros_like(gradient))


@pytest.mark.parametrize("form", FORMS)
def test_jit_equals_eager(form):
    jitted = jax.jit(summed(form))(*batch())
    np.testing.assert_allclose(jitted, summed(form)(*batch()), rtol=1e-5)


@pytest.mark.parametrize("form", FORMS)
def test_losses_refuse_another_shape(form):
    critic, prediction, target = batch()
    value = lambda x: tanh_value(critic, x)  # noqa: E731
    with pytest.raises(AssertionError):
        FORMS[form](value, prediction, target[:1])
    with pytest.raises(AssertionError):
        FORMS[form](lambda x: value(x)[..., None], prediction, target)


SIZE = 4
numbers = st.floats(-3, 3, width=32)


@jax.jit
def all_forms(gradient, hessian, error):
    """Every form at x = 0 for V = g . x + 1/2 x' H x, with the given derivatives."""

    def value(x):
        return x @ gradient + 0.5 * ((x @ hessian) * x).sum(-1)

    return {form: loss(value, error, jnp.zeros(SIZE)) for form, loss in FORMS.items()}


@given(arrays(np.float32, SIZE, elements=numbers), arrays(np.float32, SIZE, elements=numbers))
def test_n_diagonal_forms_bound_the_first_order_form(gradient, error):
    found = all_forms(gradient, np.zeros((SIZE, SIZE), np.float32), error)
    assert SIZE * found["diagonal"] >= found["taylor"] * (1 - 1e-5)


def test_the_bound_of_the_diagonal_form_is_tight():
    gradient, error = np.ones(SIZE, np.float32), np.full(SIZE, 2, np.float32)
    found = all_forms(gradient, np.zeros((SIZE, SIZE), np.float32), error)
    assert SIZE * found["diagonal"] == found["taylor"] == 64


@given(
    arrays(np.float32, SIZE, elements=numbers),
    arrays(np.float32, (SIZE, SIZE), elements=numbers),
    arrays(np.float32, SIZE, elements=numbers),
)
def test_second_order_forms_bound_the_squared_expansion_of_the_value(gradient, root, error):
    hessian = root + root.T
    found = all_forms(gradient, hessian, error)
    g, h, e = (np.asarray(a, np.float64) for a in (gradient, hessian, error))
    first, second = g @ e, e @ h @ e
    expansion = (first + 0.5 * second) ** 2
    # In float32 a sum of n^2 terms is as exact as its terms are large.
    slack = 1e-4 * (1e-6 + (abs(g) @ abs(e)) ** 2 + (abs(e) @ abs(h) @ abs(e)) ** 2)
    assert found["second order"] >= expansion - slack
    assert max(SIZE, e @ e) * found["joint"] >= expansion - slack


def test_the_bound_of_the_second_order_form_is_tight():
    # a = b: g . e = 1/2 e' H e = 2.
    gradient = np.array([2, 0, 0, 0], np.float32)
    hessian = np.diag(np.array([4, 0, 0, 0], np.float32))
    found = all_forms(gradient, hessian, np.array([1, 0, 0, 0], np.float32))
    assert found["second order"] == (2 + 2) ** 2
