"""Distributions of latents and of actions. The only module that imports distrax."""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable
from typing import NamedTuple

import chex
import jax
import jax.numpy as jnp

from vawm.errors import InvalidInput
from vawm.losses.transforms import unimix_logits

if sys.flags.optimize > 1:
    remedy = (
        "TensorFlow Probability, which distrax imports, needs docstrings; use 1, or unset it"
    )
    raise InvalidInput("PYTHONOPTIMIZE", sys.flags.optimize, remedy)
with warnings.catch_warnings():
    warnings.filterwarnings("ignore", category=DeprecationWarning)
    import distrax

__all__ = [
    "ActionDistribution",
    "bounded_normal",
    "on_simplex",
    "one_hot_categorical",
    "probabilities",
    "sample_index",
    "sample_one_hot",
    "unimix_logits",
]

Array = jax.Array
Key = jax.Array


def sample_index(logits: Array, uniform: Array, *, unimix: float) -> Array:
    """Draw a class by inverting the cumulative distribution at `uniform`.

    This needs one random number per categorical, where Gumbel noise needs K. Equal logits with
    the same random numbers give equal samples.

    Args:
      logits: `[..., K]`, before unimix.
      uniform: `[...]` in [0, 1).
      unimix: share of the uniform distribution mixed into softmax(logits).

    Returns:
      `[...]` int32 in [0, K).
    """
    return _invert(probabilities(logits, unimix=unimix), uniform)


def on_simplex(stoch: Array) -> Array:
    """The same z, but with gradients that have mean 0 over the classes of each categorical.

    A gradient with respect to z is defined only up to a constant per categorical, because the
    entries of a categorical always sum to 1. This function sets that constant to 0.

    Args:
      stoch: `[..., S, K]`, summing to 1 over K.
    """
    return stoch - stoch.mean(-1, keepdims=True) + 1 / stoch.shape[-1]


def sample_one_hot(logits: Array, uniform: Array, *, unimix: float) -> Array:
    """A one-hot sample with the gradient of its probabilities (straight-through).

        z = onehot(sample) + p - sg(p),   p = (1 - u) * softmax(logits) + u / K

    Args:
      logits: `[..., K]`, before unimix.
      uniform: `[...]` in [0, 1); see `sample_index`.
      unimix: share of the uniform distribution mixed into softmax(logits).

    Returns:
      `[..., K]` float32, exactly 0 and 1. The logits receive the gradient of p.
    """
    probs = probabilities(logits, unimix=unimix)
    one_hot = jax.nn.one_hot(_invert(probs, uniform), logits.shape[-1], dtype=probs.dtype)
    # p - sg(p) is exactly 0. Computed first, it adds no rounding error to the sample.
    return one_hot + (probs - jax.lax.stop_gradient(probs))


def probabilities(logits: Array, *, unimix: float) -> Array:
    """(1 - u) * softmax(logits) + u / K over the last axis, float32."""
    probs = jax.nn.softmax(logits.astype(jnp.float32))
    return (1 - unimix) * probs + unimix / logits.shape[-1]


class ActionDistribution(NamedTuple):
    """A distribution of actions as pure functions, for any leading dims."""

    sample: Callable[[Key], Array]  # [..., A]
    log_prob: Callable[[Array], Array]  # [..., A] -> [...]
    entropy: Callable[[], Array]  # [...]
    mode: Callable[[], Array]  # [..., A]


def bounded_normal(
    mean: Array, std_logit: Array, *, min_std: float, max_std: float
) -> ActionDistribution:
    """Normal(tanh(mean), std), std = (max - min) * sigmoid(std_logit + 2) + min.

    Samples are neither squashed nor clipped: log-probabilities are of the raw sample, and the
    environment clips the action. Log-probability and entropy are summed over the A entries.

    Args:
      mean: `[..., A]` before tanh.
      std_logit: `[..., A]`; 0 gives a std of 0.89 between 0.1 and 1.
      min_std: smallest standard deviation.
      max_std: largest standard deviation.
    """
    chex.assert_equal_shape([mean, std_logit])
    mean, std_logit = mean.astype(jnp.float32), std_logit.astype(jnp.float32)
    std = (max_std - min_std) * jax.nn.sigmoid(std_logit + 2.0) + min_std
    normal = distrax.Normal(jnp.tanh(mean), std)
    return ActionDistribution(
        sample=lambda key: normal.sample(seed=key),
        log_prob=lambda action: normal.log_prob(action).sum(-1),
        entropy=lambda: normal.entropy().sum(-1),
        mode=normal.mode,
    )


def one_hot_categorical(logits: Array, *, unimix: float) -> ActionDistribution:
    """Categorical over one-hot actions `[..., A]`, mixed with the uniform distribution."""
    categorical = distrax.OneHotCategorical(
        logits=unimix_logits(logits, unimix), dtype=jnp.float32
    )
    return ActionDistribution(
        sample=lambda key: categorical.sample(seed=key),
        log_prob=categorical.log_prob,
        entropy=categorical.entropy,
        mode=categorical.mode,
    )


def _invert(probs: Array, uniform: Array) -> Array:
    """The first class whose cumulative probability exceeds `uniform`."""
    chex.assert_equal_shape([probs[..., 0], uniform])
    # The last sum may round to less than 1. Without it the index cannot reach K.
    passed = jnp.cumsum(probs, axis=-1)[..., :-1] <= uniform[..., None]
    return passed.sum(-1, dtype=jnp.int32)
