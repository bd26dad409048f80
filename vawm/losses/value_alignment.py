"""Value alignment: gives the predicted state the same value as the inferred state."""

from __future__ import annotations

import chex
import jax
import jax.numpy as jnp

from .transforms import at_least_float32, categorical_kl, finite_kl

Array = jax.Array


def value_alignment_loss(
    value_logits: Array,
    prior_value_logits: Array,
    *,
    dynamics_scale: float,
    representation_scale: float,
    finite: bool = False,
) -> Array:
    """KL divergence of the value distributions at s_t and at its prediction s~_t, Eq. 4.

        L = dynamics_scale * KL[sg V(s) || V(s~)] + representation_scale * KL[V(s) || sg V(s~)]

    s = (h, z) with z from the posterior and s~ = (h, z~) with z~ from the prior. The paper
    prints a stop-gradient on both arguments of the second term, which gives no gradient; as in
    its Eq. 3 we stop only the prediction. `representation_scale=0` gives the gradient as
    printed.

    There are no free nats. The loss is exactly 0 if both logits are equal, as with a
    zero-initialised critic. Bins with logit -inf on both sides add nothing; it is infinite
    where only one side has it, see `categorical_kl`.

    Args:
      value_logits: `[..., bins]` critic logits at s_t.
      prior_value_logits: `[..., bins]` logits of the same critic at s~_t.
      dynamics_scale: weight of the term that moves the prediction.
      representation_scale: weight of the term that moves the inference.
      finite: spares the search for -inf, where all logits are finite, as a critic's are.

    Returns:
      `[...]` losses in nats. Gradients reach both logits: the caller stops the critic's
      parameters; otherwise the critic would learn to ignore the difference.

    Raises:
      AssertionError: the shapes differ.
    """
    stop = jax.lax.stop_gradient
    kl = finite_kl if finite else categorical_kl
    dynamics = kl(stop(value_logits), prior_value_logits)
    representation = kl(value_logits, stop(prior_value_logits))
    return dynamics_scale * dynamics + representation_scale * representation


def value_alignment_weight(latent_kl: Array, step: Array, *, warmup_steps: int) -> Array:
    """Weight of the loss at each state, Eq. 5: small if the prediction is poor.

        beta_t = [step > warmup_steps] / max(1, sg KL_t)

    Args:
      latent_kl: `[...]` KL[q || p] in nats, summed over the categoricals of z_t; raw, without
        free nats. Its gradient is stopped.
      step: `[]` steps so far, in the unit of `warmup_steps`.
      warmup_steps: the weight is 0 up to and including this step.

    Returns:
      `[...]` weights in [0, 1], without gradient.

    Raises:
      AssertionError: `step` is not a scalar.
    """
    chex.assert_rank(step, 0)
    latent_kl = at_least_float32(jax.lax.stop_gradient(latent_kl))
    active = jnp.asarray(step > warmup_steps, latent_kl.dtype)
    return active / jnp.maximum(1.0, latent_kl)
