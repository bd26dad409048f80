"""Maximum likelihood of experience: what the heads predict, and prior against posterior."""

from __future__ import annotations

from typing import Any, NamedTuple

import chex
import jax
import jax.numpy as jnp

from vawm.transforms import categorical_kl, symlog, two_hot_cross_entropy, unimix_logits

Array = jax.Array
PyTree = Any


class PredictionLoss(NamedTuple):
    """The parts of Eq. 3a, each `[...]`; the caller scales and averages them."""

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
    """How badly the heads predict what arrived with o_t, Eq. 3a.

    All at the same index: the reward r_t and the flag arrive with o_t and are read from s_t.
    The paper's text has squared error for the reward; its table and every public code have
    the two-hot cross-entropy used here.

    Args:
      obs_prediction: `[..., D]` in symlog units, or `[..., H, W, C]` in [0, 1] for images; or
        a tree of such, whose losses are added up.
      reward_logits: `[..., bins]`.
      cont_logit: `[...]`.
      obs: `[..., D]` floats in raw units, or `[..., H, W, C]` uint8; the same tree.
      reward: `[...]` in the units of `bins`.
      is_terminal: `[...]` bool.
      bins: `[bins]` of the reward head: of rewards, or of their symlogs.
      discount: gamma, which the continue head learns along with the end of episodes; 1 where it
        learns that alone.
    """
    chex.assert_equal_shape([cont_logit, reward, is_terminal])
    parts = jax.tree.map(reconstruction_loss, obs_prediction, obs)
    reconstruction = jax.tree.reduce(jnp.add, parts)
    return PredictionLoss(
        reconstruction=reconstruction,
        reward=two_hot_cross_entropy(reward_logits, reward, bins),
        cont=continue_loss(cont_logit, discount * (1.0 - is_terminal)),
    )


def reconstruction_loss(prediction: Array, target: Array) -> Array:
    """`[...]` of one array: `image_mse` of bytes, `symlog_mse` of floats."""
    is_image = jnp.issubdtype(target.dtype, jnp.integer)
    return image_mse(prediction, target) if is_image else symlog_mse(prediction, target)


def symlog_mse(prediction: Array, target: Array) -> Array:
    """`[...]` squared error to symlog(target), summed over the last axis."""
    chex.assert_equal_shape([prediction, target])
    return jnp.square(prediction.astype(jnp.float32) - symlog(target)).sum(-1)


def image_mse(prediction: Array, target: Array) -> Array:
    """`[...]` squared error of `[..., H, W, C]` in [0, 1] to bytes / 255, summed."""
    chex.assert_equal_shape([prediction, target])
    scaled = target.astype(jnp.float32) / 255.0
    return jnp.square(prediction.astype(jnp.float32) - scaled).sum((-3, -2, -1))


def continue_loss(logit: Array, target: Array) -> Array:
    """`[...]` binary cross-entropy to a probability `target`, usually gamma or 0."""
    chex.assert_equal_shape([logit, target])
    logit = logit.astype(jnp.float32)
    return jax.nn.softplus(logit) - target * logit


def dynamics_loss(
    post_logits: Array,
    prior_logits: Array,
    *,
    unimix: float,
    free_nats: float,
    dynamics_scale: float,
    representation_scale: float,
) -> tuple[Array, Array]:
    """Divergence of posterior and prior, Eq. 3b.

        L = dynamics_scale * max(free, KL[sg q || p])
            + representation_scale * max(free, KL[q || sg p])

    The paper prints a stop-gradient on both arguments of the second term, which leaves it
    without a gradient; we follow DreamerV3 and stop only the prior.

    Args:
      post_logits: `[..., S, K]` of q(z|h,o), before unimix.
      prior_logits: `[..., S, K]` of p(z|h), before unimix.
      unimix: uniform share mixed into both.
      free_nats: floor of each term at each state, after summing over the S categoricals.
      dynamics_scale: weight of the term that moves the prior.
      representation_scale: weight of the term that moves the posterior.

    Returns:
      `[...]` losses, and `[...]` the raw KL in nats, summed over the categoricals.
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
    """As `dynamics_loss`, with the free nats of the mean over the batch: STORM's official code.

        L = dynamics_scale * max(free, mean KL[sg q || p])
            + representation_scale * max(free, mean KL[q || sg p])

    Below the free nats no state has a gradient, however far its own prior is off.

    Returns:
      `[]` the loss, and `[...]` the raw KL in nats.
    """
    dynamics, representation = balanced_kl(post_logits, prior_logits, unimix=unimix)
    loss = dynamics_scale * jnp.maximum(free_nats, dynamics.mean())
    loss += representation_scale * jnp.maximum(free_nats, representation.mean())
    return loss, jax.lax.stop_gradient(dynamics)


def balanced_kl(
    post_logits: Array, prior_logits: Array, *, unimix: float
) -> tuple[Array, Array]:
    """`[...]` KL[sg q || p] and KL[q || sg p], summed over the categoricals: equal numbers."""
    chex.assert_equal_shape([post_logits, prior_logits])
    stop = jax.lax.stop_gradient
    post, prior = unimix_logits(post_logits, unimix), unimix_logits(prior_logits, unimix)
    dynamics = categorical_kl(stop(post), prior).sum(-1)
    representation = categorical_kl(post, stop(prior)).sum(-1)
    return dynamics, representation
