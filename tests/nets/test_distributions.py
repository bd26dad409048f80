"""Sampling by inversion, and policies against float64 formulas."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from vawm.nets import distributions

sample_index = jax.jit(distributions.sample_index, static_argnames="unimix")
sample_one_hot = jax.jit(distributions.sample_one_hot, static_argnames="unimix")


def slow_probs(logits, unimix):
    logits = np.asarray(logits, np.float64)
    probs = np.exp(logits - logits.max(-1, keepdims=True))
    probs /= probs.sum(-1, keepdims=True)
    return (1 - unimix) * probs + unimix / logits.shape[-1]


def slow_index(probs, uniform):
    """Walk along the classes until the cumulated probability exceeds `uniform`."""
    cumulated = 0.0
    for k, p in enumerate(probs):
        cumulated += p
        if uniform < cumulated:
            return k
    return len(probs) - 1


@pytest.mark.parametrize("unimix", [0.0, 0.01])
def test_sampling_inverts_the_distribution_function(unimix):
    rng = np.random.default_rng(0)
    logits, uniform = rng.normal(size=(200, 6)) * 3, rng.random(200)
    actual = sample_index(jnp.asarray(logits), jnp.asarray(uniform), unimix=unimix)
    twin = [slow_index(p, u) for p, u in zip(slow_probs(logits, unimix), uniform, strict=True)]
    np.testing.assert_array_equal(actual, twin)


def test_a_grid_of_uniforms_gives_exact_frequencies():
    logits = jnp.tile(jnp.log(jnp.array([0.5, 0.25, 0.125, 0.125])), (1000, 1))
    uniform = (jnp.arange(1000.0) + 0.5) / 1000
    index = sample_index(logits, uniform, unimix=0.0)
    np.testing.assert_array_equal(np.bincount(index, minlength=4), [500, 250, 125, 125])


def test_a_grid_of_uniforms_gives_unimix_its_share():
    logits = jnp.tile(jnp.array([100.0, 0.0, 0.0, 0.0]), (1000, 1))
    uniform = (jnp.arange(1000.0) + 0.5) / 1000
    index = sample_index(logits, uniform, unimix=0.04)
    np.testing.assert_array_equal(np.bincount(index, minlength=4), [970, 10, 10, 10])


@pytest.mark.parametrize("uniform", [0.0, 1 - 2**-24])
def test_the_ends_of_the_interval_are_inside_the_classes(uniform):
    logits = 3 * jax.random.normal(jax.random.key(0), (512, 64))
    index = sample_index(logits, jnp.full(512, uniform), unimix=0.01)
    assert index.dtype == jnp.int32
    np.testing.assert_array_equal(index, np.full(512, 0 if uniform == 0 else 63))


def test_an_impossible_class_is_never_drawn():
    logits = jnp.array([[-1e9, 0.0, 0.0]])
    assert sample_index(logits, jnp.zeros(1), unimix=0.0)[0] == 1


@pytest.mark.parametrize("jit", [False, True])
def test_samples_are_exactly_one_hot(jit):
    sample = sample_one_hot if jit else distributions.sample_one_hot
    logits = 5 * jax.random.normal(jax.random.key(0), (64, 32, 7))
    uniform = jax.random.uniform(jax.random.key(1), (64, 32))
    actual = sample(logits, uniform, unimix=0.01)
    index = sample_index(logits, uniform, unimix=0.01)
    np.testing.assert_array_equal(actual, np.eye(7)[index])
    assert actual.dtype == jnp.float32


def test_samples_carry_the_gradient_of_their_probabilities():
    logits = jax.random.normal(jax.random.key(0), (5,))
    weight = jnp.array([3.0, -1.0, 0.5, 2.0, 0.0])
    actual = jax.grad(lambda x: sample_one_hot(x, jnp.array(0.3), unimix=0.1) @ weight)(logits)
    probs, w = slow_probs(logits, 0.0), np.asarray(weight)
    np.testing.assert_allclose(actual, 0.9 * probs * (w - probs @ w), rtol=1e-5, atol=1e-6)


def test_shared_noise_under_equal_logits_gives_equal_samples():
    logits = jax.random.normal(jax.random.key(0), (100, 8))
    uniform = jax.random.uniform(jax.random.key(1), (100,))
    first = sample_one_hot(logits, uniform, unimix=0.01)
    shifted = sample_one_hot(logits + 2.0, uniform, unimix=0.01)
    np.testing.assert_array_equal(first, sample_one_hot(logits, uniform, unimix=0.01))
    assert (first == shifted).mean() > 0.99  # the same distribution, rounded otherwise


def test_sampling_refuses_one_uniform_for_many():
    with pytest.raises(AssertionError):
        sample_one_hot(jnp.zeros((4, 3, 5)), jnp.zeros((4, 1)), unimix=0.0)


def normal_policy(shape=(6, 3)):
    key_mean, key_std = jax.random.split(jax.random.key(0))
    mean = 2 * jax.random.normal(key_mean, shape)
    std_logit = 2 * jax.random.normal(key_std, shape)
    policy = distributions.bounded_normal(mean, std_logit, min_std=0.1, max_std=1.0)
    loc = np.tanh(np.asarray(mean, np.float64))
    scale = 0.9 / (1 + np.exp(-np.asarray(std_logit, np.float64) - 2)) + 0.1
    return policy, loc, scale


def test_bounded_normal_starts_wide():
    zero = jnp.zeros((1, 1))
    policy = distributions.bounded_normal(zero, zero, min_std=0.1, max_std=1.0)
    std = np.exp(policy.entropy()[0] - 0.5 * np.log(2 * np.pi * np.e))
    assert std == pytest.approx(0.8927, abs=1e-4)


def test_bounded_normal_matches_the_density_and_entropy():
    policy, loc, scale = normal_policy()
    action = jnp.asarray(np.random.default_rng(0).normal(size=loc.shape) * 2, jnp.float32)
    z = (np.asarray(action, np.float64) - loc) / scale
    density = (-0.5 * z**2 - np.log(scale) - 0.5 * np.log(2 * np.pi)).sum(-1)
    entropy = (np.log(scale) + 0.5 * np.log(2 * np.pi * np.e)).sum(-1)
    np.testing.assert_allclose(policy.log_prob(action), density, rtol=1e-5)
    np.testing.assert_allclose(policy.entropy(), entropy, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(policy.mode(), loc, rtol=1e-5)


def test_bounded_normal_samples_have_the_moments_and_leave_the_unit_box():
    mean = jnp.full((20_000, 1), 0.5)
    policy = distributions.bounded_normal(mean, jnp.zeros_like(mean), min_std=0.1, max_std=1.0)
    sample = np.asarray(policy.sample(jax.random.key(0)))
    assert sample.mean() == pytest.approx(np.tanh(0.5), abs=0.02)
    assert sample.std() == pytest.approx(0.8927, abs=0.02)
    assert np.abs(sample).max() > 1.5


def test_bounded_normal_refuses_unequal_shapes():
    with pytest.raises(AssertionError):
        distributions.bounded_normal(
            jnp.zeros((6, 3)), jnp.zeros((1, 3)), min_std=0.1, max_std=1.0
        )


def test_categorical_policy_matches_its_probabilities():
    logits = 2 * jax.random.normal(jax.random.key(0), (6, 4))
    policy = distributions.one_hot_categorical(logits, unimix=0.01)
    probs = slow_probs(logits, 0.01)
    action = jnp.eye(4)[jnp.array([0, 1, 2, 3, 0, 1])]
    np.testing.assert_allclose(
        policy.log_prob(action), np.log((probs * np.asarray(action)).sum(-1)), rtol=1e-5
    )
    np.testing.assert_allclose(policy.entropy(), -(probs * np.log(probs)).sum(-1), rtol=1e-5)
    np.testing.assert_array_equal(policy.mode(), np.eye(4)[probs.argmax(-1)])


def test_categorical_policy_samples_one_hot_floats_with_the_right_frequencies():
    logits = jnp.tile(jnp.log(jnp.array([0.6, 0.3, 0.1])), (20_000, 1))
    policy = distributions.one_hot_categorical(logits, unimix=0.0)
    sample = policy.sample(jax.random.key(0))
    assert sample.dtype == jnp.float32
    np.testing.assert_array_equal(np.unique(sample), [0.0, 1.0])
    np.testing.assert_allclose(np.mean(sample, 0), [0.6, 0.3, 0.1], atol=0.015)


def test_policies_have_gradients_under_jit():
    def loss(mean, std_logit, action):
        policy = distributions.bounded_normal(mean, std_logit, min_std=0.1, max_std=1.0)
        return (policy.log_prob(action) + policy.entropy()).sum()

    gradients = jax.jit(jax.grad(loss, argnums=(0, 1)))(
        jnp.zeros((5, 2)), jnp.zeros((5, 2)), jnp.ones((5, 2))
    )
    for gradient in gradients:
        assert np.isfinite(gradient).all()
        assert (np.asarray(gradient) != 0).all()


def test_on_the_simplex_nothing_changes_but_that_gradients_are_centred():
    z = jax.nn.softmax(jax.random.normal(jax.random.key(0), (2, 3, 4)))
    np.testing.assert_allclose(distributions.on_simplex(z), z, rtol=1e-6)
    slope = jax.random.normal(jax.random.key(1), z.shape)
    gradient = jax.grad(lambda z: (slope * distributions.on_simplex(z)).sum())(z)
    centred = slope - slope.mean(-1, keepdims=True)
    np.testing.assert_allclose(gradient, centred, rtol=1e-5, atol=1e-6)
