"""Symlog, the two-hot code and categorical arithmetic against slow numpy twins."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from transforms_twin import slow_log_softmax, slow_two_hot

from vawm.losses import transforms

BINS = transforms.symexp_bins(255)
cross_entropy = jax.jit(transforms.two_hot_cross_entropy)
mean = jax.jit(transforms.two_hot_mean)
two_hot = jax.jit(transforms.two_hot)


def extremes(bins):
    """Every bin, its float32 neighbours, both beyond-the-end sides, and ordinary values."""
    values = np.asarray(bins)
    rng = np.random.default_rng(0)
    return jnp.concatenate(
        [
            values,
            np.nextafter(values, np.float32(-np.inf)),
            np.nextafter(values, np.float32(np.inf)),
            np.array([-np.inf, -1e12, 1e12, np.inf, -0.0, 1e-30, 1e-45], np.float32),
            rng.normal(size=50).astype(np.float32) * 10 ** rng.uniform(-3, 8, 50),
        ]
    ).astype(jnp.float32)


def test_symlog_has_slope_one_at_zero_and_keeps_sign():
    x = jnp.array([-1e6, -1.0, -1e-6, 0.0, 1e-6, 1.0, 1e6])
    twin = np.sign(x) * np.log1p(np.abs(np.float64(x)))
    np.testing.assert_allclose(transforms.symlog(x), twin, rtol=1e-6)
    assert jax.grad(transforms.symlog)(1e-9) == pytest.approx(1.0)
    assert jax.grad(transforms.symlog)(0.0) == 0.0


def test_symexp_inverts_symlog():
    x = jnp.linspace(-15.0, 15.0, 61)
    np.testing.assert_allclose(transforms.symlog(transforms.symexp(x)), x, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("n", [2, 3, 4, 41, 254, 255])
def test_bins_are_exactly_symmetric_and_sorted(n):
    bins = np.asarray(transforms.symexp_bins(n))
    assert bins.shape == (n,)
    assert bins.dtype == np.float32
    np.testing.assert_array_equal(bins, -bins[::-1])
    assert np.all(np.diff(bins) >= 0)
    assert not np.signbit(bins[bins == 0]).any()


def test_bins_are_even_in_symlog_and_end_at_symexp_of_twenty():
    bins = np.asarray(BINS, np.float64)
    np.testing.assert_allclose(bins[-1], np.expm1(20.0), rtol=1e-7)
    spacing = np.diff(np.sign(bins) * np.log1p(np.abs(bins)))
    np.testing.assert_allclose(spacing, 20 / 127, rtol=1e-6)
    assert bins[127] == 0


def test_an_even_number_of_bins_holds_zero_twice():
    bins = transforms.symexp_bins(6)
    np.testing.assert_array_equal(bins[2:4], [0.0, 0.0])
    np.testing.assert_array_equal(two_hot(jnp.zeros(1), bins), np.eye(6)[3:4])
    np.testing.assert_allclose(bins[4], np.expm1(10.0), rtol=1e-6)


def test_bins_refuse_a_single_bin():
    with pytest.raises(ValueError, match="n=1"):
        transforms.symexp_bins(1)


def test_two_hot_by_hand():
    bins = jnp.array([-2.0, 0.0, 1.0, 5.0])
    actual = two_hot(jnp.array([0.25, 2.0, 1.0, 9.0, -9.0]), bins)
    expected = [
        [0.0, 0.75, 0.25, 0.0],
        [0.0, 0.0, 0.75, 0.25],
        [0.0, 0.0, 1.0, 0.0],
        [0.0, 0.0, 0.0, 1.0],
        [1.0, 0.0, 0.0, 0.0],
    ]
    np.testing.assert_allclose(actual, expected)


@pytest.mark.parametrize("n", [3, 41, 255])
def test_two_hot_matches_search_at_every_extreme(n):
    bins = transforms.symexp_bins(n)
    y = extremes(bins)
    # Smaller than float32 can subtract from its neighbours, hence an absolute tolerance.
    np.testing.assert_allclose(two_hot(y, bins), slow_two_hot(y, bins), atol=1e-6)


def test_two_hot_is_exact_on_the_bins():
    np.testing.assert_array_equal(two_hot(BINS, BINS), np.eye(255))


def test_two_hot_keeps_the_mean():
    y = jnp.array([-3e4, -1.5, 0.0, 0.01, 7.0, 123.0])
    encoded = np.asarray(two_hot(y, BINS), np.float64)
    np.testing.assert_allclose(encoded @ np.asarray(BINS, np.float64), y, rtol=1e-5, atol=1e-6)


@pytest.mark.parametrize("n", [2, 6, 41, 255])
@pytest.mark.parametrize("shape", [(), (3,), (2, 3)])
def test_mean_matches_softmax_in_raw_space(n, shape):
    bins = transforms.symexp_bins(n)
    # A sharp peak: with a flat one the mean is rounding noise of bins near 1e8.
    centre = np.random.default_rng(0).uniform(0.6 * n, 0.9 * n, shape)
    logits = jnp.asarray(-np.square(np.arange(n) - centre[..., None]), jnp.float32)
    twin = (np.exp(slow_log_softmax(logits)) * np.asarray(bins, np.float64)).sum(-1)
    actual = mean(logits, bins)
    assert actual.shape == shape
    np.testing.assert_allclose(actual, twin, rtol=1e-4)


@pytest.mark.parametrize("n", [4, 41, 254, 255])
@pytest.mark.parametrize("jit", [False, True])
def test_mean_of_zero_logits_is_exactly_zero(n, jit):
    two_hot_mean = mean if jit else transforms.two_hot_mean
    bins = transforms.symexp_bins(n)
    np.testing.assert_array_equal(two_hot_mean(jnp.zeros((65, n)), bins), np.zeros(65))
    np.testing.assert_array_equal(two_hot_mean(jnp.full((65, n), 3.7), bins), np.zeros(65))


def test_mean_of_a_zero_head_stays_zero_when_fused_with_its_matrix_product():
    features = jax.random.normal(jax.random.key(0), (64, 16))
    fused = jax.jit(lambda x, w: transforms.two_hot_mean(x @ w, BINS))
    np.testing.assert_array_equal(fused(features, jnp.zeros((16, 255))), np.zeros(64))


def test_mean_of_mirrored_logits_is_the_negative():
    logits = 5 * jax.random.normal(jax.random.key(0), (7, 255))
    np.testing.assert_allclose(
        mean(logits[:, ::-1], BINS),
        -mean(logits, BINS),
        rtol=1e-5,
    )


def test_mean_survives_huge_logits():
    logits = jnp.zeros(255).at[127 + 20].set(1e4)
    np.testing.assert_allclose(mean(logits, BINS), BINS[147], rtol=1e-6)


def test_mean_has_the_gradient_of_softmax():
    bins = transforms.symexp_bins(5) / 1e4
    logits = jax.random.normal(jax.random.key(0), (5,))
    actual = jax.grad(lambda x: mean(x, bins))(logits)
    probs = np.exp(slow_log_softmax(logits))
    b = np.asarray(bins, np.float64)
    np.testing.assert_allclose(actual, probs * (b - probs @ b), rtol=1e-4, atol=1e-2)


@pytest.mark.parametrize("n", [3, 41, 255])
def test_cross_entropy_matches_the_dense_twin_at_every_extreme(n):
    bins = transforms.symexp_bins(n)
    y = extremes(bins)
    logits = 3 * jax.random.normal(jax.random.key(0), (*y.shape, n))
    twin = -(slow_two_hot(y, bins) * slow_log_softmax(logits)).sum(-1)
    actual = cross_entropy(logits, y, bins)
    np.testing.assert_allclose(actual, twin, rtol=1e-5, atol=1e-5)


def test_cross_entropy_has_the_gradient_softmax_minus_target():
    y = extremes(BINS)
    logits = 3 * jax.random.normal(jax.random.key(0), (*y.shape, 255))
    actual = jax.grad(lambda x: cross_entropy(x, y, BINS).sum())(logits)
    twin = np.exp(slow_log_softmax(logits)) - slow_two_hot(y, BINS)
    np.testing.assert_allclose(actual, twin, atol=1e-6)


def test_cross_entropies_share_logits_and_add_their_gradients():
    y = jnp.array([-3.0, 0.0, 100.0])
    other = jnp.array([5.0, -2.0, 100.5])
    logits = jax.random.normal(jax.random.key(0), (3, 255))

    def loss(logits):
        first, second = transforms.two_hot_cross_entropies(logits, (y, other), BINS)
        return (first + 0.25 * second).sum()

    probs = np.exp(slow_log_softmax(logits))
    twin = 1.25 * probs - slow_two_hot(y, BINS) - 0.25 * slow_two_hot(other, BINS)
    np.testing.assert_allclose(jax.jit(jax.grad(loss))(logits), twin, atol=1e-6)


def test_cross_entropy_stops_its_target():
    logits = jax.random.normal(jax.random.key(0), (3, 255))
    target = jnp.array([-3.0, 0.0, 100.0])
    gradient = jax.grad(lambda y: cross_entropy(logits, y, BINS).sum())
    np.testing.assert_array_equal(gradient(target), np.zeros(3))


def test_cross_entropy_under_jit_equals_eager():
    logits = jax.random.normal(jax.random.key(0), (4, 3, 255))
    target = 10 * jax.random.normal(jax.random.key(1), (4, 3))
    np.testing.assert_allclose(
        cross_entropy(logits, target, BINS),
        transforms.two_hot_cross_entropy(logits, target, BINS),
        rtol=1e-6,
    )


def test_cross_entropy_of_half_precision_logits_is_float32():
    loss = cross_entropy(jnp.zeros((2, 255), jnp.bfloat16), jnp.zeros(2), BINS)
    assert loss.dtype == jnp.float32
    np.testing.assert_allclose(loss, np.log(255), rtol=1e-6)


def test_cross_entropy_shows_a_target_that_is_not_a_number():
    loss = cross_entropy(jnp.zeros((2, 255)), jnp.array([0, jnp.nan]), BINS)
    np.testing.assert_array_equal(np.isnan(loss), [False, True])


@pytest.mark.parametrize("shape", [(3,), (4, 1), (1, 4, 3)])
def test_cross_entropy_refuses_targets_of_another_shape(shape):
    with pytest.raises(AssertionError):
        transforms.two_hot_cross_entropy(jnp.zeros((4, 3, 255)), jnp.zeros(shape), BINS)


def test_cross_entropy_refuses_another_number_of_bins():
    with pytest.raises(AssertionError):
        transforms.two_hot_cross_entropy(jnp.zeros((4, 254)), jnp.zeros(4), BINS)


@pytest.mark.parametrize("unimix", [0.0, 0.01, 1.0])
def test_unimix_mixes_probabilities(unimix):
    logits = 10 * jax.random.normal(jax.random.key(0), (5, 4))
    twin = (1 - unimix) * np.exp(slow_log_softmax(logits)) + unimix / 4
    actual = transforms.unimix_logits(logits, unimix)
    np.testing.assert_allclose(np.exp(actual), twin, rtol=1e-5, atol=1e-7)


def test_unimix_bounds_every_class_from_below():
    actual = transforms.unimix_logits(jnp.array([0.0, -1e4, -1e4, -1e4]), 0.01)
    np.testing.assert_allclose(actual[1:], np.log(0.0025), rtol=1e-6)
    gradient = jax.jit(jax.grad(lambda x: transforms.unimix_logits(x, 0.01).sum()))
    assert np.isfinite(gradient(jnp.array([0.0, -1e4, -1e4, -1e4]))).all()


def test_categorical_kl_matches_its_sum():
    p, q = 3 * jax.random.normal(jax.random.key(0), (2, 6, 5))
    log_p, log_q = slow_log_softmax(p), slow_log_softmax(q)
    twin = (np.exp(log_p) * (log_p - log_q)).sum(-1)
    np.testing.assert_allclose(transforms.categorical_kl(p, q), twin, rtol=1e-5)


def test_categorical_kl_by_hand():
    p, q = jnp.log(jnp.array([0.5, 0.5])), jnp.log(jnp.array([0.25, 0.75]))
    expected = 0.5 * np.log(2) + 0.5 * np.log(2 / 3)
    np.testing.assert_allclose(transforms.categorical_kl(p, q), expected, rtol=1e-6)


def test_categorical_kl_of_equal_logits_is_exactly_zero():
    logits = 5 * jax.random.normal(jax.random.key(0), (6, 255))
    np.testing.assert_array_equal(transforms.categorical_kl(logits, logits), np.zeros(6))


def test_categorical_kl_refuses_shapes_that_would_broadcast():
    with pytest.raises(AssertionError):
        transforms.categorical_kl(jnp.zeros((6, 5)), jnp.zeros((1, 5)))


def test_categorical_entropy_matches_its_sum_and_is_known_at_the_ends():
    logits = 3 * jax.random.normal(jax.random.key(0), (6, 5))
    log_prob = slow_log_softmax(logits)
    twin = -(np.exp(log_prob) * log_prob).sum(-1)
    np.testing.assert_allclose(transforms.categorical_entropy(logits), twin, rtol=1e-5)
    ends = jnp.array([[0.0, 0.0, 0.0, 0.0], [1e4, 0.0, 0.0, 0.0]])
    np.testing.assert_allclose(
        transforms.categorical_entropy(ends), [np.log(4), 0.0], rtol=1e-6, atol=1e-7
    )


def numbers():
    """Numbers that both codes distinguish in float32: small, ordinary and huge, both signs."""
    y = np.array([0.0, 1e-3, 0.4, 1.0, 7.3, 250.0, 1e5, 4e8], np.float32)
    return jnp.asarray(np.concatenate([-y[::-1], y]))


@pytest.mark.parametrize("spacing", ["symexp", "symlog"])
@pytest.mark.parametrize("n", [41, 255])
def test_a_code_decodes_what_it_encodes(spacing, n):
    code = transforms.make_two_hot(n, spacing)
    share = two_hot(code.encode(numbers()), code.bins)
    # Where a share is 0 its logarithm is not finite; exp(-1e4) is 0 too.
    logits = jnp.where(share > 0, jnp.log(jnp.maximum(share, 1e-37)), -1e4)
    np.testing.assert_allclose(jax.jit(code.mean)(logits), numbers(), rtol=1e-3, atol=1e-5)


def test_the_symexp_code_is_the_one_of_values():
    code = transforms.make_two_hot(41, "symexp")
    logits = jax.random.normal(jax.random.key(0), (3, 41))
    np.testing.assert_array_equal(code.bins, transforms.symexp_bins(41))
    np.testing.assert_array_equal(code.encode(numbers()), numbers())
    np.testing.assert_array_equal(code.mean(logits), transforms.two_hot_mean(logits, code.bins))


@pytest.mark.parametrize("n", [3, 41, 255])
@pytest.mark.parametrize("shape", [(), (3,), (2, 3)])
def test_the_symlog_code_matches_its_twin(n, shape):
    code = transforms.make_two_hot(n, "symlog")
    bins = np.linspace(-20, 20, n)
    np.testing.assert_allclose(code.bins, bins, rtol=1e-6, atol=1e-6)
    y = np.asarray(numbers(), np.float64)
    twin = np.sign(y) * np.log1p(np.abs(y))
    np.testing.assert_allclose(code.encode(numbers()), twin, rtol=1e-6)

    logits = 3 * jax.random.normal(jax.random.key(0), (*shape, n))
    mean_symlog = np.exp(slow_log_softmax(logits)) @ bins
    twin = np.sign(mean_symlog) * np.expm1(np.abs(mean_symlog))
    actual = code.mean(logits)
    assert actual.shape == shape
    np.testing.assert_allclose(actual, twin, rtol=1e-4, atol=1e-5)


def test_for_spread_out_distributions_the_symlog_code_is_nearer_to_zero():
    """Even odds of 0 and of symexp(20), by hand."""
    logits = jnp.full(41, -1e4).at[jnp.array([20, 40])].set(0.0)
    values, symlogs = (
        transforms.make_two_hot(41, spacing).mean(logits) for spacing in ("symexp", "symlog")
    )
    np.testing.assert_allclose(values, np.expm1(20.0) / 2, rtol=1e-5)
    np.testing.assert_allclose(symlogs, np.expm1(10.0), rtol=1e-5)


def test_the_mean_of_a_symlog_code_is_float32_whatever_the_logits_are():
    actual = transforms.make_two_hot(41, "symlog").mean(jnp.zeros((2, 41), jnp.bfloat16))
    assert actual.dtype == jnp.float32
    np.testing.assert_allclose(actual, [0.0, 0.0], atol=1e-5)


def test_float64_stays_float64_and_is_more_exact():
    """Under x64 the losses follow the dtype of the logits, not that of bins and targets."""
    rng = np.random.default_rng(0)
    with jax.enable_x64(True):
        p, q = (jnp.asarray(rng.normal(size=(3, 41))) for _ in range(2))
        code = transforms.make_two_hot(41, "symexp")
        target = jnp.asarray(rng.normal(size=3), jnp.float32)
        wide = (
            transforms.categorical_kl(p, q),
            transforms.two_hot_cross_entropy(p, target, code.bins),
            code.mean(p),
            transforms.make_two_hot(41, "symlog").mean(p),
            transforms.unimix_logits(p, 0.01),
            transforms.categorical_entropy(p),
            transforms.two_hot(target.astype("float64"), code.bins),
        )
        narrow = transforms.categorical_kl(p.astype("float32"), q.astype("float32"))
        assert {x.dtype for x in wide} == {np.dtype("float64")}
        assert narrow.dtype == np.float32
        assert (wide[0] != narrow).any()
        np.testing.assert_allclose(wide[0], narrow, rtol=1e-5)
        np.testing.assert_allclose(
            wide[1], numpy_cross_entropy(p, target, code.bins), rtol=1e-12
        )


def numpy_cross_entropy(logits, target, bins):
    logits, target, bins = (np.asarray(x, np.float64) for x in (logits, target, bins))
    code = np.zeros(logits.shape)
    for row, y in enumerate(target):
        above = np.searchsorted(bins, y, side="right")
        share = (y - bins[above - 1]) / (bins[above] - bins[above - 1])
        code[row, above - 1], code[row, above] = 1 - share, share
    log_prob = logits - np.log(np.exp(logits).sum(-1, keepdims=True))
    return -(code * log_prob).sum(-1)
