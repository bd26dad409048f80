"""Symlog, the two-hot code over symexp-spaced bins, and categorical arithmetic.

The bins reach +-4.85e8 and are exactly symmetric, and sums over them are arranged such that
symmetric terms cancel exactly. Everything is computed in the dtype of the logits, but never in
less than float32; see `at_least_float32`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Literal, NamedTuple

import chex
import jax
import jax.numpy as jnp
import numpy as np

Array = jax.Array

LOWEST = -1e30
"""Stands for a logit of -inf inside of sums: its probability is 0 too, but 0 * LOWEST is 0."""


def at_least_float32(x: Array) -> Array:
    """`x` in float64 if it is that already, as under `jax_enable_x64`; else in float32."""
    return x.astype(jnp.float64 if x.dtype == jnp.float64 else jnp.float32)


def symlog(x: Array) -> Array:
    """Compresses magnitude, keeps sign and slope around 0 (DreamerV3; Hafner et al., 2025).

        symlog(x) = sign(x) * log(1 + |x|)

    At exactly 0, JAX's gradient is 0 instead of 1, as for the absolute value.

    Args:
      x: `[...]` in raw units.

    Returns:
      `[...]` in symlog units. Nothing is stopped.
    """
    return jnp.sign(x) * jnp.log1p(jnp.abs(x))


def symexp(x: Array) -> Array:
    """The inverse of `symlog` (DreamerV3; Hafner et al., 2025).

        symexp(x) = sign(x) * (exp(|x|) - 1)

    Args:
      x: `[...]` in symlog units.

    Returns:
      `[...]` in raw units. Nothing is stopped. As for `symlog`, the gradient at 0 is 0.
    """
    return jnp.sign(x) * jnp.expm1(jnp.abs(x))


def symexp_bins(n: int) -> Array:
    """`[n]` increasing values from -symexp(20) to symexp(20), evenly spaced in symlog.

    The upper half is the negated lower half, bit for bit. Odd `n` has 0 in the middle; even
    `n` has it twice, as in the official DreamerV3.

    Raises:
      ValueError: fewer than two bins.
    """
    if n < 2:
        raise ValueError(f"symexp_bins needs at least 2 bins, got n={n}")
    lower = -np.expm1(-np.linspace(-20.0, 0.0, (n + 1) // 2, dtype=np.float64))
    upper = -lower[::-1]
    bins = np.concatenate([lower, upper[n % 2 :]]).astype(np.float32)
    return jnp.asarray(bins + 0.0)  # -0.0 becomes 0.0


class TwoHot(NamedTuple):
    """A two-hot code of real numbers.

    Attributes:
      bins: `[n]` increasing values of the classes.
      encode: `[...]` numbers -> `[...]` targets of a cross-entropy, in the units of `bins`.
      mean: `[..., n]` logits -> `[...]` numbers: the mean over `bins`, decoded.
    """

    bins: Array
    encode: Callable[[Array], Array]
    mean: Callable[[Array], Array]


def make_two_hot(n: int, spacing: Literal["symexp", "symlog"]) -> TwoHot:
    """A two-hot code with `n` bins up to +-symexp(20).

    "symexp", as in DreamerV3: the bins are raw numbers, spaced by symexp, and the mean is over
    raw numbers. "symlog", as in STORM: the bins are symlogs, evenly spaced, and the mean over
    symlogs is decoded. For spread-out distributions the latter is nearer to 0.

    Args:
      n: number of bins; odd for a bin at 0.
      spacing: of the bins.

    Returns:
      `TwoHot` of `[n]` bins, in raw units or in symlogs, and two functions for any leading
      dims. Neither function stops gradients.

    Raises:
      ValueError: fewer than two bins spaced by symexp.
    """
    if spacing == "symexp":
        bins = symexp_bins(n)
        return TwoHot(bins, lambda y: y, lambda logits: two_hot_mean(logits, bins))
    bins = jnp.linspace(-20.0, 20.0, n, dtype=jnp.float32)

    def mean(logits: Array) -> Array:
        # Not a matrix product, which accelerators would round to fewer bits.
        probs = jax.nn.softmax(at_least_float32(logits))
        values = jnp.expand_dims(bins.astype(probs.dtype), tuple(range(logits.ndim - 1)))
        return symexp((probs * values).sum(-1))

    return TwoHot(bins, symlog, mean)


def two_hot(y: Array, bins: Array) -> Array:
    """The distribution `[..., n]` on the two bins around `y` with mean `y`.

    Weights are linear in raw distance; a `y` beyond the ends is put on the end bin. Losses do
    not build this array: see `two_hot_cross_entropy`.
    """
    below, above, share = _neighbours(at_least_float32(y), bins)
    n, share = bins.shape[0], share[..., None]
    below, above = (jax.nn.one_hot(index, n, dtype=share.dtype) for index in (below, above))
    return (1 - share) * below + share * above


def two_hot_mean(logits: Array, bins: Array) -> Array:
    """Mean of softmax(logits) over `bins`, in raw space: sum_i p_i * bins_i.

    Mirrored bins are paired before summing, (p_{n-1-i} - p_i) * bins_{n-1-i}, so that
    symmetric logits, such as those of a zero-initialised head, give exactly 0.

    Args:
      logits: `[..., n]`.
      bins: `[n]` from `symexp_bins`, exactly symmetric.

    Returns:
      `[...]` means in the units of `bins`.
    """
    chex.assert_equal(logits.shape[-1:], bins.shape)
    half = bins.shape[0] // 2
    logits = at_least_float32(logits)
    exp = jnp.exp(logits - jax.lax.stop_gradient(logits.max(-1, keepdims=True)))
    odd = exp[..., -half:] - exp[..., :half][..., ::-1]
    upper = jnp.expand_dims(bins[-half:].astype(logits.dtype), tuple(range(logits.ndim - 1)))
    return (odd * upper).sum(-1) / exp.sum(-1)


def two_hot_cross_entropy(logits: Array, target: Array, bins: Array) -> Array:
    """Cross-entropy of softmax(logits) to the two-hot code of a number, as in Eq. 7.

        CE = logsumexp(logits) - (1 - w) * logits[below] - w * logits[above]

    w is the target's fractional position between the two bins. This is
    `two_hot_cross_entropies` for a single target.

    Args:
      logits: `[..., n]`.
      target: `[...]` in the units of `bins`; clipped to the end bins.
      bins: `[n]` increasing, such as `TwoHot.bins`.

    Returns:
      `[...]` losses in nats. Gradients reach the logits only; the target is stopped.

    Raises:
      AssertionError: the shapes do not fit each other.
    """
    (loss,) = two_hot_cross_entropies(logits, (target,), bins)
    return loss


def two_hot_cross_entropies(
    logits: Array, targets: Sequence[Array], bins: Array
) -> tuple[Array, ...]:
    """Cross-entropies of one set of logits to several two-hot targets.

        CE_k = logsumexp(logits) - (1 - w_k) * logits[below_k] - w_k * logits[above_k]

    The two logits are read by index and the log-sum-exp is shared, so neither dense targets
    nor a log-softmax are built. 0 log 0 is 0.

    Args:
      logits: `[..., n]`; -inf for an impossible bin counts as `LOWEST`, so weight of a target
        on one costs 1e30 nats.
      targets: each `[...]`, in the units of `bins`; clipped to the end bins.
      bins: `[n]` increasing.

    Returns:
      One `[...]` loss in nats per target. Gradients reach the logits only; targets are stopped.

    Raises:
      AssertionError: the shapes do not fit each other.
    """
    chex.assert_equal(logits.shape[-1:], bins.shape)
    logits = floored(logits)
    normalizer = jax.nn.logsumexp(logits, axis=-1)
    chex.assert_equal_shape([normalizer, *targets])

    def score(target):
        below, above, share = _neighbours(
            jax.lax.stop_gradient(target).astype(logits.dtype), bins
        )
        return (1 - share) * _pick(logits, below) + share * _pick(logits, above)

    return tuple(normalizer - score(target) for target in targets)


def unimix_logits(logits: Array, unimix: float) -> Array:
    """log((1 - u) * softmax(logits) + u / K): normalised, each class at least u / K.

    So for u > 0 a class with logit -inf, such as an action that is masked, is possible again.
    """
    log_prob = jax.nn.log_softmax(at_least_float32(logits))
    if unimix == 0:
        return log_prob
    return jnp.log((1 - unimix) * jnp.exp(log_prob) + unimix / logits.shape[-1])


def categorical_kl(p_logits: Array, q_logits: Array) -> Array:
    """KL[softmax(p) || softmax(q)] over the last axis, as in Eq. 3b, 4 and 5.

        KL = sum_k p_k (log p_k - log q_k)

    0 log 0 is 0: a class that p excludes adds nothing, whatever q says of it, and p gets no
    gradient there.

    Args:
      p_logits: `[..., K]`, normalised or not; -inf excludes a class.
      q_logits: `[..., K]`, likewise. At least one class is not excluded.

    Returns:
      `[...]` in nats; exactly 0 for equal logits. Infinite where q excludes a class that p
      does not; the gradient has no meaning there. Nothing is stopped.

    Raises:
      AssertionError: the shapes differ.
    """
    chex.assert_equal_shape([p_logits, q_logits])
    missed = ((p_logits > -jnp.inf) & (q_logits == -jnp.inf)).any(-1)
    return finite_kl(floored(p_logits), floored(q_logits)) + jnp.where(missed, jnp.inf, 0.0)


def finite_kl(p_logits: Array, q_logits: Array) -> Array:
    """`categorical_kl` of logits that are all finite, as those of a head or after unimix."""
    log_p = jax.nn.log_softmax(at_least_float32(p_logits))
    log_q = jax.nn.log_softmax(at_least_float32(q_logits))
    return (jnp.exp(log_p) * (log_p - log_q)).sum(-1)


def categorical_entropy(logits: Array) -> Array:
    """Entropy of softmax(logits) in nats, over the last axis; 0 log 0 is 0.

    A class with logit -inf adds nothing and gets no gradient.
    """
    log_prob = jax.nn.log_softmax(floored(logits))
    return -(jnp.exp(log_prob) * log_prob).sum(-1)


def floored(logits: Array, where: Array | bool = True) -> Array:
    """The logits, at least in float32, with `LOWEST` for -inf `where` this is true.

    Replaced before any sum, so that finite logits keep every bit of a loss and of its gradient.
    """
    logits = at_least_float32(logits)
    return jnp.where((logits == -jnp.inf) & where, LOWEST, logits)


def _neighbours(y: Array, bins: Array) -> tuple[Array, Array, Array]:
    """Indices of the bins below and above `y`, and the weight of the one above."""
    # Clipping keeps NaN, and the weight becomes NaN: a broken target is not hidden.
    bins = bins.astype(y.dtype)
    y = jnp.clip(y, bins[0], bins[-1])
    after = jnp.searchsorted(bins, y, side="right")
    last = bins.shape[0] - 1
    below, above = jnp.clip(after - 1, 0, last), jnp.clip(after, 0, last)
    # At the upper end both are the last bin, whose weight is 1 for any share.
    gap = jnp.where(below == above, 1.0, bins[above] - bins[below])
    return below, above, (y - bins[below]) / gap


def _pick(x: Array, index: Array) -> Array:
    return jnp.take_along_axis(x, index[..., None], axis=-1, mode="clip")[..., 0]
