"""TEMPO's meta gradient: by hand, against its closed form, and against finite differences."""

import doctest

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vawm import losses

STEP = 0.3


def model_losses(params, x, y):
    """`[N]` squared errors of a small network."""
    hidden = jnp.tanh(x @ params["in"])
    return jnp.square(hidden @ params["out"] - y)


def problem():
    """A model, two batches, and weights of six samples as a softmax of phi's features."""
    rng = np.random.default_rng(0)
    params = {"in": rng.normal(size=(3, 4)), "out": rng.normal(size=4)}
    phi = {"weight": rng.normal(size=(3, 1)), "bias": rng.normal(size=6)}
    batch = rng.normal(size=(6, 3)), rng.normal(size=6)
    task = rng.normal(size=(5, 3)), rng.normal(size=5)
    return params, phi, batch, task


def functions(batch, task):
    x = jnp.asarray(batch[0])
    return (
        lambda params: model_losses(params, *map(jnp.asarray, batch)),
        lambda phi: jax.nn.softmax((x @ phi["weight"])[:, 0] + phi["bias"]),
        lambda params: model_losses(params, *map(jnp.asarray, task)).mean(),
    )


@jax.jit
def gradient_of(params, phi, batch, task):
    return losses.tempo_meta_gradient(*functions(batch, task), params, phi, step_size=STEP)


def task_loss_after_a_step(params, phi, batch, task):
    """L_task(theta'), written out in numpy with the model's derivatives by hand."""
    x, y = batch
    score = (x @ phi["weight"])[:, 0] + phi["bias"]
    weight = np.exp(score) / np.exp(score).sum()
    to_in, to_out = np.zeros((3, 4)), np.zeros(4)
    for x_i, y_i, w_i in zip(x, y, weight, strict=True):
        hidden = np.tanh(x_i @ params["in"])
        error = 2 * w_i * (hidden @ params["out"] - y_i)
        to_out += error * hidden
        to_in += error * np.outer(x_i, params["out"] * (1 - hidden**2))
    updated = {"in": params["in"] - STEP * to_in, "out": params["out"] - STEP * to_out}
    hidden = np.tanh(task[0] @ updated["in"])
    return ((hidden @ updated["out"] - task[1]) ** 2).mean()


def one_at(leaf, index):
    unit = np.zeros_like(leaf)
    unit[index] = 1.0
    return unit


def test_gradient_is_that_of_finite_differences_in_float64():
    params, phi, batch, task = problem()
    with jax.enable_x64(True):
        value, gradient = gradient_of(*problem())
        assert value.dtype == jnp.float64
    expected = task_loss_after_a_step(params, phi, batch, task)
    np.testing.assert_allclose(value, expected, rtol=1e-12)
    for name, leaf in phi.items():
        for i in np.ndindex(leaf.shape):
            above, below = (
                task_loss_after_a_step(
                    params, phi | {name: leaf + shift * one_at(leaf, i)}, batch, task
                )
                for shift in (1e-5, -1e-5)
            )
            difference = (above - below) / 2e-5
            np.testing.assert_allclose(gradient[name][i], difference, rtol=1e-6, atol=1e-9)


def scalar_gradient(*, step_size):
    """Of L = (theta - 1)^2 / 2 and (theta + 1)^2 / 2 at theta = 0, weighed by 3/4 and 1/4."""
    return losses.tempo_meta_gradient(
        lambda theta: jnp.square(theta - jnp.array([1.0, -1.0])) / 2,
        lambda phi: phi,
        lambda theta: jnp.square(theta[0] - 2) / 2,
        jnp.zeros(1),
        jnp.array([0.75, 0.25]),
        step_size=step_size,
    )


def test_gradient_by_hand():
    # The inner gradient is -1/2, so theta' = 1/4; the task wants theta = 2.
    value, gradient = scalar_gradient(step_size=0.5)
    np.testing.assert_allclose(value, 1.75**2 / 2)
    # -1/2 * (theta' - 2) * (-1, 1): more weight on the sample that pulls towards 2.
    np.testing.assert_allclose(gradient, [-0.875, 0.875])


def test_the_example_of_the_docstring_runs():
    names = {}
    (example,) = doctest.DocTestFinder(recurse=False).find(
        losses.tempo_meta_gradient, "tempo", globs=names
    )
    outcome = doctest.DocTestRunner().run(example, clear_globs=False)
    assert outcome.failed == 0 < outcome.attempted
    names = example.globs
    # By then the third sample, which has pulled away from the task, weighs least.
    assert names["weights"](names["phi"]).argmin() == 2
    assert names["theta"] > 1.0 - 0.1 * 8 / 3  # where equal weights lead


def test_the_example_of_the_docstring_by_hand():
    x, y = np.array([1.0, 2.0, 3.0]), np.array([2.0, 4.0, 0.0])
    pull = 2 * x * (x - y)  # at theta = 1: (-2, -8, 18)
    theta = 1 - 0.1 * pull.mean()
    np.testing.assert_allclose((theta - 2) ** 2, 1.6044, atol=5e-5)
    to_weights = -0.1 * 2 * (theta - 2) * pull
    to_scores = (to_weights - to_weights.mean()) / 3  # through a softmax of equal scores
    np.testing.assert_allclose([to_scores @ x, to_scores @ y], [1.6889, -4.3911], atol=5e-5)


def test_a_step_of_size_zero_has_no_gradient():
    value, gradient = scalar_gradient(step_size=0.0)
    assert value == 2
    np.testing.assert_array_equal(gradient, np.zeros(2))


def test_gradient_is_its_closed_form():
    params, phi, batch, task = jax.tree.map(jnp.float32, problem())
    sample_losses, weights, task_loss = functions(batch, task)
    _, gradient = gradient_of(params, phi, batch, task)

    @jax.jit
    def closed_form(params, phi):
        each, weight = jax.jacobian(sample_losses)(params), weights(phi)
        updated = jax.tree.map(
            lambda p, g: p - STEP * jnp.tensordot(weight, g, 1), params, each
        )
        wanted = jax.grad(task_loss)(updated)
        agreement = sum(
            (each[k].reshape(6, -1) * wanted[k].reshape(1, -1)).sum(-1) for k in params
        )
        return jax.vjp(weights, phi)[1](-STEP * agreement)[0]

    expected = closed_form(params, phi)
    for name in phi:
        np.testing.assert_allclose(gradient[name], expected[name], rtol=1e-4, atol=1e-6)


def test_a_layer_without_a_second_derivative_is_enough():
    @jax.custom_vjp
    def sin(x):
        return jnp.sin(x)

    def no_more(x):
        raise AssertionError("a second derivative")

    @jax.custom_jvp
    def slope(x):
        return jnp.cos(x)

    slope.defjvp(lambda primals, tangents: no_more(primals))
    sin.defvjp(lambda x: (jnp.sin(x), x), lambda x, g: (g * slope(x),))

    def gradient(layer):
        return losses.tempo_meta_gradient(
            lambda theta: jnp.square(layer(theta) - jnp.array([1.0, -1.0])),
            lambda phi: phi,
            lambda theta: jnp.square(theta[0] - 2),
            jnp.full(1, 0.3),
            jnp.array([0.75, 0.25]),
            step_size=0.5,
        )[1]

    np.testing.assert_allclose(gradient(sin), gradient(jnp.sin), rtol=1e-6)


def test_weights_and_task_losses_of_another_shape_are_refused():
    params, phi, batch, task = jax.tree.map(jnp.float32, problem())
    sample_losses, weights, task_loss = functions(batch, task)

    def traced(weights, task_loss):
        return jax.eval_shape(
            lambda params, phi: losses.tempo_meta_gradient(
                sample_losses, weights, task_loss, params, phi, step_size=STEP
            ),
            params,
            phi,
        )

    traced(weights, task_loss)
    with pytest.raises(AssertionError):
        traced(lambda phi: weights(phi)[:1], task_loss)
    with pytest.raises(AssertionError):
        traced(weights, lambda params: task_loss(params)[None])
