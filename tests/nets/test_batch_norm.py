"""Batch normalisation against float64 numpy, in training and with running statistics."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vawm.nets import batch_norm
from vawm.nets.batch_norm import BatchNorm

FEATURES = 3


def module_and_variables():
    module = BatchNorm(FEATURES)
    variables = {
        "params": {"scale": jnp.array([0.5, 1.0, -2.0]), "bias": jnp.array([0.1, -0.2, 0.3])},
        "statistics": {"mean": jnp.array([1.0, 0.0, -1.0]), "var": jnp.array([2.0, 0.5, 3.0])},
    }
    return module, variables


def images(key=0, offset=0.0):
    x = jax.random.normal(jax.random.key(key), (4, 2, 3, FEATURES))
    return offset + x * jnp.array([0.5, 1.0, 3.0]).reshape(1, 1, 1, -1)


def normalised(x, scale, bias):
    """In float64, over all axes but the last."""
    x = np.asarray(x, np.float64).reshape(-1, FEATURES)
    y = (x - x.mean(0)) / np.sqrt(x.var(0) + 1e-5)
    return y * np.asarray(scale, np.float64) + np.asarray(bias, np.float64)


@pytest.mark.parametrize("axes", [1, 2, 3])
def test_training_normalises_by_the_batch_and_moves_the_statistics_by_a_tenth(axes):
    module, variables = module_and_variables()
    x = images().reshape(*((24,), (4, 6), (4, 2, 3))[axes - 1], FEATURES)
    y, updated = module.apply(variables, x, train=True, mutable=["statistics"])
    expected = normalised(x, *(variables["params"][name] for name in ("scale", "bias")))
    np.testing.assert_allclose(y, expected.reshape(x.shape), atol=2e-6)
    flat = np.asarray(x, np.float64).reshape(-1, FEATURES)
    for name, batch in (("mean", flat.mean(0)), ("var", flat.var(0, ddof=1))):
        before = np.asarray(variables["statistics"][name], np.float64)
        after = updated["statistics"][name]
        np.testing.assert_allclose(after, 0.9 * before + 0.1 * batch, rtol=1e-6)


def test_otherwise_the_running_statistics_normalise_and_do_not_change():
    module, variables = module_and_variables()
    x = images()
    y, updated = module.apply(variables, x, train=False, mutable=["statistics"])
    p, s = variables["params"], variables["statistics"]
    mean, var = (np.asarray(s[name], np.float64) for name in ("mean", "var"))
    expected = (np.asarray(x) - mean) / np.sqrt(var + 1e-5) * np.asarray(p["scale"])
    np.testing.assert_allclose(y, expected + np.asarray(p["bias"]), atol=2e-6)
    np.testing.assert_array_equal(updated["statistics"]["mean"], s["mean"])
    np.testing.assert_array_equal(updated["statistics"]["var"], s["var"])


@pytest.mark.parametrize("train", [False, True])
def test_statistics_start_at_0_and_1_whatever_the_input_of_init(train):
    variables = BatchNorm(FEATURES).init(jax.random.key(0), images(offset=5.0), train=train)
    np.testing.assert_array_equal(variables["statistics"]["mean"], np.zeros(FEATURES))
    np.testing.assert_array_equal(variables["statistics"]["var"], np.ones(FEATURES))


def test_a_mean_of_a_thousand_deviations_causes_no_cancellation():
    x = jax.random.normal(jax.random.key(0), (64, 4, FEATURES)) + 1000.0
    _, mean, var = batch_norm.normalise(x, jnp.ones(FEATURES), jnp.zeros(FEATURES))
    flat = np.asarray(x, np.float64).reshape(-1, FEATURES)
    np.testing.assert_allclose(mean, flat.mean(0), rtol=1e-6)
    np.testing.assert_allclose(var, flat.var(0), rtol=1e-4)


def test_gradients_pass_through_the_batch_s_mean_and_variance():
    """The gradient written by hand equals the one through the written-out formula."""

    def plain(x, scale, bias):
        mean, var = x.mean((0, 1, 2), keepdims=True), x.var((0, 1, 2), keepdims=True)
        y = (x - mean) / jnp.sqrt(var + 1e-5) * scale.reshape(1, 1, 1, -1)
        return y + bias.reshape(1, 1, 1, -1)

    _, variables = module_and_variables()
    inputs = (images(), variables["params"]["scale"], variables["params"]["bias"])
    weights = images(key=1)

    def loss(function):
        return lambda *inputs: (jnp.sin(function(*inputs)) * weights).sum()

    actual = jax.grad(loss(lambda *inputs: batch_norm.normalise(*inputs)[0]), (0, 1, 2))
    expected = jax.grad(loss(plain), (0, 1, 2))
    for a, b in zip(actual(*inputs), expected(*inputs), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-5)


def test_statistics_have_no_gradient():
    module, variables = module_and_variables()

    def moved(x):
        _, updated = module.apply(variables, x, train=True, mutable=["statistics"])
        return sum(leaf.sum() for leaf in jax.tree.leaves(updated))

    np.testing.assert_array_equal(jax.grad(moved)(images()), np.zeros(images().shape))


def test_a_batch_of_one_value_keeps_statistics_finite():
    module, variables = module_and_variables()
    _, updated = module.apply(
        variables, jnp.ones((1, FEATURES)), train=True, mutable=["statistics"]
    )
    before = variables["statistics"]["var"]
    np.testing.assert_allclose(updated["statistics"]["var"], 0.9 * before, rtol=1e-6)


def test_bfloat16_images_are_normalised_in_float32():
    module, variables = module_and_variables()
    x = images(offset=2.0).astype(jnp.bfloat16)
    y, updated = module.apply(variables, x, train=True, mutable=["statistics"])
    assert y.dtype == jnp.bfloat16
    assert all(leaf.dtype == jnp.float32 for leaf in jax.tree.leaves(updated))
    wide = x.astype(jnp.float32)
    z, expected = module.apply(variables, wide, train=True, mutable=["statistics"])
    np.testing.assert_array_equal(y, z.astype(jnp.bfloat16))
    for a, b in zip(jax.tree.leaves(updated), jax.tree.leaves(expected), strict=True):
        np.testing.assert_array_equal(a, b)
