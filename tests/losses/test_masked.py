"""Logits of -inf, such as those of actions that are masked: 0 log 0 is 0, also in gradients."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from transforms_twin import slow_log_softmax, slow_two_hot

from vawm import losses
from vawm.losses import likelihood, transforms, value_aware
from vawm.nets import distributions

CLASSES = 6
ALLOWED = np.array([0, 2, 3, 5])
SCALES = {"dynamics_scale": 0.5, "representation_scale": 0.1}
BINS = jnp.array([-9.0, -2.0, -0.1, 0.4, 3.0, 9.0])


def masked(logits):
    """The logits, but -inf for every class that is not allowed."""
    return jnp.full_like(logits, -jnp.inf).at[..., ALLOWED].set(logits[..., ALLOWED])


def entropy(p, _):
    return transforms.categorical_entropy(p)


def policy_entropy(p, _):
    return distributions.one_hot_categorical(p, unimix=0.0).entropy()


def policy_log_prob(p, _):
    policy = distributions.one_hot_categorical(p, unimix=0.0)
    return policy.log_prob(jax.lax.stop_gradient(policy.mode()))


def alignment(p, q):
    return losses.value_alignment_loss(p, q, **SCALES)


def balanced(p, q):
    first, second = likelihood.balanced_kl(p[..., None, :], q[..., None, :], unimix=0.0)
    return first + 0.1 * second


LOSSES = {
    "kl": transforms.categorical_kl,
    "alignment": alignment,
    "balanced": balanced,
    "iter_vaml": value_aware.categorical_iter_vaml_loss,
    "entropy": entropy,
    "policy's entropy": policy_entropy,
    "policy's log prob": policy_log_prob,
}


def pair():
    return 2 * jax.random.normal(jax.random.key(0), (2, 2, CLASSES))


@pytest.mark.parametrize("loss", LOSSES.values(), ids=LOSSES)
def test_classes_that_are_excluded_on_both_sides_do_not_count(loss):
    """Value and gradient are those of the classes that are left; 0 for the others."""

    def total(p, q):
        return loss(p, q).sum()

    p, q = pair()
    both = jax.jit(jax.value_and_grad(total, argnums=(0, 1)))
    value, gradients = both(masked(p), masked(q))
    expected, wanted = both(p[..., ALLOWED], q[..., ALLOWED])
    np.testing.assert_allclose(value, expected, rtol=1e-5)
    for gradient, twin in zip(gradients, wanted, strict=True):
        np.testing.assert_allclose(gradient[..., ALLOWED], twin, rtol=1e-4, atol=1e-6)
        assert not np.delete(gradient, ALLOWED, axis=-1).any()


def test_what_only_the_other_side_allows_adds_nothing_to_the_kl():
    p, q = pair()
    log_p, log_q = slow_log_softmax(masked(p)), slow_log_softmax(q)
    left_p, left_q = log_p[..., ALLOWED], log_q[..., ALLOWED]
    terms = np.exp(left_p) * (left_p - left_q)
    kl = lambda p, q: transforms.categorical_kl(p, q).sum()  # noqa: E731
    value, (to_p, to_q) = jax.value_and_grad(kl, argnums=(0, 1))(masked(p), q)
    np.testing.assert_allclose(value, terms.sum(), rtol=1e-5)
    np.testing.assert_allclose(to_q, np.exp(log_q) - np.exp(log_p), atol=1e-6)
    twin = terms - np.exp(left_p) * terms.sum(-1, keepdims=True)
    np.testing.assert_allclose(to_p[..., ALLOWED], twin, atol=1e-5)
    assert not np.delete(to_p, ALLOWED, axis=-1).any()


def test_kl_by_hand_where_classes_are_excluded():
    log = lambda *p: jnp.log(jnp.array(p))  # noqa: E731
    kl = transforms.categorical_kl
    np.testing.assert_allclose(
        kl(log(0.5, 0.5, 0.0), log(0.25, 0.75, 0.0)), 0.1438410, rtol=1e-6
    )
    np.testing.assert_allclose(kl(log(1.0, 0.0), log(0.5, 0.5)), np.log(2), rtol=1e-6)
    assert kl(log(0.5, 0.5), log(1.0, 0.0)) == np.inf
    assert kl(log(1.0, 0.0), log(1.0, 0.0)) == 0
    assert kl(log(1.0, 0.0), log(0.0, 1.0)) == np.inf
    assert np.isnan(kl(log(0.5, 0.5), jnp.array([0.0, jnp.nan])))


def test_a_class_too_unlikely_for_float32_is_not_excluded():
    p, q = jnp.array([0.0, -200.0]), jnp.array([0.0, -jnp.inf])
    assert transforms.categorical_kl(p, q) == np.inf
    assert transforms.categorical_kl(q, p) == 0
    assert not np.any(jax.grad(transforms.categorical_kl, argnums=(0, 1))(q, p))


@pytest.mark.parametrize("unimix", [0.0, 0.1])
def test_latents_with_excluded_classes_have_finite_losses(unimix):
    post, prior = (masked(x)[..., None, :] for x in pair())

    def loss(post, prior):
        return likelihood.balanced_kl(post, prior, unimix=unimix)[0].sum()

    p, q = (slow_log_softmax(x) for x in (post, prior))
    p, q = ((1 - unimix) * np.exp(x) + unimix / CLASSES for x in (p, q))
    twin = np.sum(p * np.log(np.where(p > 0, p, 1) / np.where(p > 0, q, 1)))
    value, gradients = jax.value_and_grad(loss, argnums=(0, 1))(post, prior)
    np.testing.assert_allclose(value, twin, rtol=1e-5)
    assert all(np.isfinite(gradient).all() for gradient in gradients)


@pytest.mark.parametrize(
    "loss", [transforms.categorical_kl, value_aware.categorical_iter_vaml_loss, alignment]
)
def test_a_loss_is_infinite_if_only_the_prediction_excludes_a_class(loss):
    p, q = pair()
    first, second = (
        (masked(p), q) if loss is value_aware.categorical_iter_vaml_loss else (p, masked(q))
    )
    np.testing.assert_array_equal(loss(first, second), [np.inf, np.inf])


def test_bins_without_weight_may_have_logits_of_minus_infinity():
    logits = jax.random.normal(jax.random.key(0), (2, CLASSES))
    target = jnp.array([BINS[2], BINS[5]])  # exactly on bins: no weight on their neighbours
    logits = logits.at[0, 3].set(-jnp.inf).at[1, 0].set(-jnp.inf)

    def loss(logits):
        return transforms.two_hot_cross_entropy(logits, target, BINS)

    code = slow_two_hot(target, BINS)
    log_prob = slow_log_softmax(logits)
    twin = -np.where(code > 0, code * np.where(code > 0, log_prob, 0), 0).sum(-1)
    np.testing.assert_allclose(loss(logits), twin, rtol=1e-5)
    gradient = jax.grad(lambda x: loss(x).sum())(logits)
    np.testing.assert_allclose(gradient, np.exp(log_prob) - code, atol=1e-6)
    between = transforms.two_hot_cross_entropy(logits[:1], (BINS[2:3] + BINS[3:4]) / 2, BINS)
    np.testing.assert_allclose(between, 5e29, rtol=1e-6)


@pytest.mark.parametrize(
    ("logit", "target", "expected"),
    [
        (np.inf, 1.0, 0.0),
        (-np.inf, 0.0, 0.0),
        (np.inf, 0.75, 2.5e29),
        (np.inf, 0.0, 1e30),
        (-np.inf, 0.25, 2.5e29),
        (-np.inf, 1.0, 1e30),
    ],
)
def test_the_end_of_an_episode_may_be_certain(logit, target, expected):
    loss, gradient = jax.value_and_grad(losses.continue_loss)(*jnp.array([logit, target]))
    np.testing.assert_allclose(loss, expected, rtol=1e-6)
    assert gradient == 0


def test_an_excluded_class_is_possible_again_after_unimix():
    logits = masked(pair()[0])
    mixed = transforms.unimix_logits(logits, 0.1)
    np.testing.assert_allclose(np.exp(mixed)[:, 1], 0.1 / CLASSES, rtol=1e-6)
    gradient = jax.grad(lambda x: transforms.unimix_logits(x, 0.1).sum())(logits)
    assert np.isfinite(gradient).all()


def test_an_action_that_is_excluded_is_never_sampled():
    policy = distributions.one_hot_categorical(masked(jnp.zeros((500, CLASSES))), unimix=0.0)
    sampled = policy.sample(jax.random.key(0))
    assert not np.delete(np.asarray(sampled), ALLOWED, axis=-1).any()
    index = distributions.sample_index(
        masked(jnp.zeros((500, CLASSES))),
        jax.random.uniform(jax.random.key(0), (500,)),
        unimix=0.0,
    )
    assert set(np.asarray(index)) <= set(ALLOWED)
