"""Maximum likelihood of experience: predictions of the heads, and prior against posterior."""

from __future__ import annotations

import functools
from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp

from .transforms import (
    LOWEST,
    at_least_float32,
    categorical_kl,
    finite_kl,
    symlog,
    two_hot_cross_entropy,
    unimix_logits,
)

Array = jax.Array
PyTree = Any


class PredictionLoss(NamedTuple):
    """The terms of Eq. 3a, each `[...]`; the caller scales and averages them.

    Attributes:
      reconstruction: squared error, in symlog units or of pixels in [0, 1], summed.
      reward: cross-entropy in nats.
      cont: cross-entropy in nats.
    """

    reconstruction: Array
    reward: Array
    cont: Array


def prediction_loss(
    obs_prediction: PyTree,
    reward_logits: Array,
    cont_logit: Array,
    obs: PyTree,
    reward: Array,
    is_terminal: Array,
    *,
    bins: Array,
    discount: float,
) -> PredictionLoss:
    """The errors of the heads about what arrived with o_t, Eq. 3a.

        reconstruction = |o^ - symlog(o)|^2,  for images |o^ - o / 255|^2
        reward = CE(r^, twohot(r)),  cont = CE(c^, discount * (1 - terminal))

    All at the same index: the reward r_t and the flag arrive with o_t and are predicted from
    s_t. The paper's text has a squared error for the reward; its table and all public codes
    have the two-hot cross-entropy used here.

    Args:
      obs_prediction: `[..., D]` in symlog units, or `[..., H, W, C]` in [0, 1] for images; or
        a tree of these, whose losses are summed; `()` for none, with a loss of 0.
      reward_logits: `[..., bins]`.
      cont_logit: `[...]`.
      obs: `[..., D]` floats in raw units, or `[..., H, W, C]` uint8; the same tree.
      reward: `[...]` in the units of `bins`.
      is_terminal: `[...]` bool.
      bins: `[bins]` of the reward head, rewards or their symlogs.
      discount: gamma, if the continue head learns it together with the end of episodes; 1 if
        it only learns the end of episodes.

    Returns:
      `PredictionLoss` of `[...]` losses. Gradients reach the predictions; the reward is
      stopped, and the other targets are data.

    Raises:
      AssertionError: predictions and targets have different shapes.
    """
    chex.assert_equal_shape([cont_logit, reward, is_terminal])
    chex.assert_trees_all_equal_structs(obs_prediction, obs)
    parts = jax.tree.leaves(jax.tree.map(reconstruction_loss, obs_prediction, obs))
    chex.assert_equal_shape([cont_logit, *parts])
    if len(parts) == 0:
        parts = [jnp.zeros_like(cont_logit)]
    alive = 1.0 - is_terminal.astype(at_least_float32(cont_logit).dtype)
    return PredictionLoss(
        reconstruction=functools.reduce(jnp.add, parts),
        reward=two_hot_cross_entropy(reward_logits, reward, bins),
        cont=continue_loss(cont_logit, discount * alive),
    )


def reconstruction_loss(prediction: Array, target: Array) -> Array:
    """Reconstruction of Eq. 3a for one array: `image_mse` for uint8, `symlog_mse` for floats.

    Args:
      prediction: `[..., D]` in symlog units, or `[..., H, W, C]` in [0, 1].
      target: `[..., D]` floats, or `[..., H, W, C]` uint8.

    Returns:
      `[...]` losses.

    Raises:
      AssertionError: the shapes differ.
    """
    is_image = jnp.issubdtype(target.dtype, jnp.integer)
    return image_mse(prediction, target) if is_image else symlog_mse(prediction, target)


def symlog_mse(prediction: Array, target: Array) -> Array:
    """Summed squared error in symlog units: the reconstruction of vectors, Eq. 3a.

        L = sum_j (o^_j - symlog(o_j))^2

    Args:
      prediction: `[..., D]` in symlog units.
      target: `[..., D]` in raw units.

    Returns:
      `[...]` losses, in squared symlog units. Nothing is stopped: the target is data.

    Raises:
      AssertionError: the shapes differ.
    """
    chex.assert_equal_shape([prediction, target])
    prediction = at_least_float32(prediction)
    return jnp.square(prediction - symlog(target).astype(prediction.dtype)).sum(-1)


def image_mse(prediction: Array, target: Array) -> Array:
    """Summed squared error of pixels in [0, 1]: the reconstruction of images.

        L = sum (o^ - o / 255)^2

    As in both official codes; Eq. 3a in the paper's text has symlogs for images too.

    Args:
      prediction: `[..., H, W, C]` in [0, 1].
      target: `[..., H, W, C]` uint8, from 0 to 255.

    Returns:
      `[...]` losses, in squared units of a pixel in [0, 1]. Nothing is stopped: the target is
      data.

    Raises:
      AssertionError: the shapes differ.
    """
    chex.assert_equal_shape([prediction, target])
    prediction = at_least_float32(prediction)
    scaled = target.astype(prediction.dtype) / 255.0
    return jnp.square(prediction - scaled).sum((-3, -2, -1))


def continue_loss(logit: Array, target: Array) -> Array:
    """Logistic regression of whether the episode continues, Eq. 3a.

        L = -(c log p + (1 - c) log(1 - p)),  p = sigmoid(logit)

    c may be any probability. In the official DreamerV3 it is gamma, and 0 if terminal; in the
    official STORM it is 1 and 0. 0 log 0 is 0.

    Args:
      logit: `[...]`; infinite ones, for a p of exactly 0 or 1, count as -1e30 and 1e30: the
        loss is 0 where that is right, and huge where it is wrong; the gradient is 0.
      target: `[...]` c, in [0, 1].

    Returns:
      `[...]` losses in nats. Nothing is stopped: the target is data.

    Raises:
      AssertionError: the shapes differ.
    """
    chex.assert_equal_shape([logit, target])
    logit = at_least_float32(logit)
    logit = jnp.where(jnp.isinf(logit), jnp.sign(logit) * -LOWEST, logit)
    return jax.nn.softplus(logit) - target.astype(logit.dtype) * logit


def dynamics_loss(
    post_logits: Array,
    prior_logits: Array,
    *,
    unimix: float,
    free_nats: float,
    dynamics_scale: float,
    representation_scale: float,
) -> tuple[Array, Array]:
    """KL divergence of posterior and prior, Eq. 3b.

        L = dynamics_scale * max(free, KL[sg q || p])
            + representation_scale * max(free, KL[q || sg p])

    The paper prints a stop-gradient on both arguments of the second term, which gives no
    gradient; we follow DreamerV3 and stop only the prior.

    Args:
      post_logits: `[..., S, K]` of q(z|h,o), before unimix.
      prior_logits: `[..., S, K]` of p(z|h), before unimix.
      unimix: uniform share mixed into both.
      free_nats: floor of each term at each state, after summing over the S categoricals.
      dynamics_scale: weight of the term that moves the prior.
      representation_scale: weight of the term that moves the posterior.

    Returns:
      `[...]` losses in nats, and `[...]` the raw KL in nats, summed over the categoricals and
      stopped.

    Raises:
      AssertionError: the shapes differ.
    """
    dynamics, representation = balanced_kl(post_logits, prior_logits, unimix=unimix)
    loss = dynamics_scale * jnp.maximum(free_nats, dynamics)
    loss += representation_scale * jnp.maximum(free_nats, representation)
    return loss, jax.lax.stop_gradient(dynamics)


def batch_dynamics_loss(
    post_logits: Array,
    prior_logits: Array,
    *,
    unimix: float,
    free_nats: float,
    dynamics_scale: float,
    representation_scale: float,
) -> tuple[Array, Array]:
    """As `dynamics_loss`, with free nats for the mean over the batch, as STORM's official code.

        L = dynamics_scale * max(free, mean KL[sg q || p])
            + representation_scale * max(free, mean KL[q || sg p])

    If the mean is below the free nats, no state has a gradient, however wrong its prior is.
    Means are over all leading dims; otherwise as Eq. 3b.

    Args:
      post_logits: `[..., S, K]` of q(z|h,o), before unimix.
      prior_logits: `[..., S, K]` of p(z|h), before unimix.
      unimix: uniform share mixed into both.
      free_nats: floor of each term's mean, after summing over the S categoricals.
      dynamics_scale: weight of the term that moves the prior.
      representation_scale: weight of the term that moves the posterior.

    Returns:
      `[]` the loss in nats, and `[...]` the raw KL in nats, summed over the categoricals and
      stopped.

    Raises:
      AssertionError: the shapes differ.
    """
    dynamics, representation = balanced_kl(post_logits, prior_logits, unimix=unimix)
    loss = dynamics_scale * jnp.maximum(free_nats, dynamics.mean())
    loss += representation_scale * jnp.maximum(free_nats, representation.mean())
    return loss, jax.lax.stop_gradient(dynamics)


def balanced_kl(
    post_logits: Array, prior_logits: Array, *, unimix: float
) -> tuple[Array, Array]:
    """Both terms of Eq. 3b without scales and free nats: equal values, different gradients.

        KL[sg q || p]  and  KL[q || sg p],  summed over the categoricals

    Args:
      post_logits: `[..., S, K]` of q(z|h,o), before unimix.
      prior_logits: `[..., S, K]` of p(z|h), before unimix.
      unimix: uniform share mixed into both; if it is above 0, no class stays excluded.

    Returns:
      `[...]` and `[...]`, both in nats: the first moves the prior, the second the posterior.

    Raises:
      AssertionError: the shapes differ.
    """
    chex.assert_equal_shape([post_logits, prior_logits])
    stop = jax.lax.stop_gradient
    post, prior = unimix_logits(post_logits, unimix), unimix_logits(prior_logits, unimix)
    kl = finite_kl if unimix else categorical_kl
    dynamics = kl(stop(post), prior).sum(-1)
    representation = kl(post, stop(prior)).sum(-1)
    return dynamics, representation
