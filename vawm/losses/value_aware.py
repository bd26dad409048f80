"""Value-aware model learning: predict next states with the value of the true next state.

Values are passed in, computed by the same critic on both sides. The caller stops the critic's
parameters; otherwise the critic would learn to ignore the model's errors.
"""

from __future__ import annotations

import chex
import jax
import jax.numpy as jnp

from .transforms import at_least_float32, floored

Array = jax.Array


def vaml_loss(prediction_values: Array, target_values: Array) -> Array:
    """Value-aware model learning (Farahmand et al., 2017), over an ensemble of critics.

        L = max_{k=1..K} (1/M sum_{m=1..M} V_k(x^_m) - sg V_k(x'))^2

    The original takes the supremum, over a class of value functions, of the squared error of
    the expected value. Here the maximum over K critics replaces it, at each element: the mean
    of these maxima is at least the largest mean error of any critic. The noise of M samples
    raises L, as in `iter_vaml_loss`.

    Args:
      prediction_values: `[K, M, ...]`: critics, samples, then one entry per transition, such
        as `[K, M, B, T]`. V_k at samples x^_1..x^_M of the model's next state; M = 1 for a
        deterministic model.
      target_values: `[K, ...]`, such as `[K, B, T]`: V_k at the true next state x', without an
        axis of samples.

    Returns:
      `[...]` losses, such as `[B, T]`, in squared units of the values. Targets are stopped. At
      each transition, only the critic with the largest error sends a gradient to the
      predictions (shared if critics tie); the caller stops the critics' parameters.

    Raises:
      AssertionError: the shapes do not fit each other.
    """
    chex.assert_equal_shape_prefix([prediction_values, target_values], 1)
    return jax.vmap(iter_vaml_loss)(prediction_values, target_values).max(0)


def iter_vaml_loss(prediction_values: Array, target_value: Array) -> Array:
    """Iterative VAML (Farahmand, 2018): VAML with the single critic that is being learned.

        L = (mean_m V(x^_m) - sg V(x'))^2

    The mean over samples estimates the expectation under the model. Its noise raises L by
    Var[V(x^)] / M on average, which rewards a model for being too certain; `cvaml_loss`
    removes that bias.

    Args:
      prediction_values: `[M, ...]` V at M samples of the model's next state.
      target_value: `[...]` V at the true next state.

    Returns:
      `[...]` losses, in squared units of the values. The target is stopped; the caller stops
      the critic's parameters.

    Raises:
      AssertionError: there is no sample, or the shapes do not fit each other.
    """
    chex.assert_axis_dimension_gt(prediction_values, 0, 0)
    return jnp.square(_deviations(prediction_values, target_value).mean(0))


def cvaml_loss(prediction_values: Array, target_value: Array) -> Array:
    """IterVAML without the bias of its samples: calibrated VAML (Voelcker et al., 2025b).

        L = (mean_m V(x^_m) - sg y)^2 - Var[V(x^)] / M
          = sum over i != j of (V(x^_i) - y) (V(x^_j) - y) / (M (M - 1))

    Var is the unbiased variance of the M samples. Given y, the mean of L over independent
    samples is (E V(x^) - y)^2. The full paper was not available to us: the correction is
    derived here from the bias that it describes.

    With y = V(x') this corrects IterVAML; y may also be a value bootstrapped from later steps
    of experience. The noise of y adds its variance, whatever the model.

    Args:
      prediction_values: `[M, ...]` V at M >= 2 independent samples of the model's next state.
      target_value: `[...]` y.

    Returns:
      `[...]` losses, in squared units of the values; they can be negative. The target is
      stopped; the caller stops the critic's parameters.

    Raises:
      ValueError: fewer than two samples.
      AssertionError: the shapes do not fit each other.
    """
    samples = prediction_values.shape[0]
    if samples < 2:
        raise ValueError(f"prediction_values has {samples} sample: a variance needs two")
    deviations = _deviations(prediction_values, target_value)
    bias = deviations.var(0, ddof=1) / samples
    return jnp.square(deviations.mean(0)) - bias


def categorical_iter_vaml_loss(prediction_logits: Array, target_logits: Array) -> Array:
    """IterVAML for distributions of values, as in MAD-TD's code (Voelcker et al., 2025a).

        L = -sum_k sg v_k(x') log v_k(x^)

    This is the first term of `value_alignment_loss`, KL[sg v(x') || v(x^)], plus the entropy
    of the target: it is not 0 if both are equal, but has the same gradient. In MAD-TD's public
    code, the target critic gives both logits.

    Args:
      prediction_logits: `[..., bins]` critic logits at the model's next state.
      target_logits: `[..., bins]` logits of the same critic at the true next state.

    Returns:
      `[...]` losses in nats; a bin of target 0 adds nothing, and the loss is infinite if the
      prediction excludes a bin, by -inf, that the target does not. The target is stopped; the
      caller stops the critic's parameters.

    Raises:
      AssertionError: the shapes differ.
    """
    chex.assert_equal_shape([prediction_logits, target_logits])
    target = jax.nn.softmax(at_least_float32(jax.lax.stop_gradient(target_logits)))
    log_prob = jax.nn.log_softmax(floored(prediction_logits, where=target == 0))
    return -(target.astype(log_prob.dtype) * log_prob).sum(-1)


def _deviations(prediction_values: Array, target_value: Array) -> Array:
    """`[M, ...]` difference of each sample's value from the stopped target."""
    chex.assert_shape(prediction_values, (None, *target_value.shape))
    return prediction_values - jax.lax.stop_gradient(target_value)[None]
