"""Losses of behaviour in imagination: the critic's and the actor's."""

from __future__ import annotations

import chex
import jax
import jax.numpy as jnp

from .transforms import two_hot_cross_entropies

Array = jax.Array


def critic_loss(
    value_logits: Array,
    slow_target: Array,
    returns: Array,
    *,
    bins: Array,
    slow_scale: float,
) -> Array:
    """Distributional value loss, Eq. 7, with a second target from the slow critic.

        L = CE(V(s), twohot(R)) + slow_scale * CE(V(s), twohot(y_slow))

    In the official DreamerV3, y_slow is the slow critic's mean (encoded again as two-hot); in
    the official STORM, it is the lambda-return of the slow critic's values.

    Args:
      value_logits: `[..., bins]` critic logits at s_t.
      slow_target: `[...]` y_slow, in the units of `bins`.
      returns: `[...]` lambda-returns R_t, in the units of `bins`, not normalised.
      bins: `[bins]` of the critic, values or their symlogs.
      slow_scale: weight of the second target.

    Returns:
      `[...]` losses in nats. Both targets are stopped.

    Raises:
      AssertionError: the shapes do not fit each other, or the logits the bins.
    """
    to_returns, to_slow = two_hot_cross_entropies(value_logits, (returns, slow_target), bins)
    return to_returns + slow_scale * to_slow


def actor_loss(
    log_prob: Array, entropy: Array, advantage: Array, *, entropy_scale: float
) -> Array:
    """REINFORCE with an entropy bonus, Eq. 8, for discrete and continuous actions.

        L = -(sg(A) * log pi(a | s) + entropy_scale * H[pi(. | s)])

    Args:
      log_prob: `[...]` of the imagined action in nats, summed over action dims; finite, as that
        of an action that the policy has sampled.
      entropy: `[...]` of the policy at the same state in nats, summed over action dims.
      advantage: `[...]` A = (R_t - v_t) / S, unitless; S is the scale of Eq. 9.
      entropy_scale: weight of the bonus.

    Returns:
      `[...]` losses. The advantage is stopped. The caller stops the action; otherwise a
      reparametrised action sends gradients through log_prob.

    Raises:
      AssertionError: the shapes differ.
    """
    chex.assert_equal_shape([log_prob, entropy, advantage])
    return -(jax.lax.stop_gradient(advantage) * log_prob + entropy_scale * entropy)


def discount_weights(cont: Array) -> Array:
    """Discounted probability of reaching each imagined state.

        w_t = prod_{i<=t} c_i

    The official DreamerV3 weights the losses of Eq. 7 and 8 by it; the equations have no
    weights. c_0, predicted at the replayed start, is included: a rollout from a terminal state
    has weight 0.

    Args:
      cont: `[H, ...]` gamma * P(continue) at s_0..s_{H-1}, in [0, 1].

    Returns:
      `[H, ...]` weights in [0, 1], without gradient.
    """
    return jnp.cumprod(jax.lax.stop_gradient(cont), axis=0)
