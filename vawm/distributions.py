"""Distributions of latents and policies. The only module that imports distrax."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from typing import NamedTuple

import chex
import jax
import jax.numpy as jnp

from vawm.losses.transforms import unimix_logits

with warnings.catch_warnings():
    warnings.filterwarnings("ignore", category=DeprecationWarning)
    import distrax

__all__ = [
    "Policy",
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
    """Draw a class by inverting the distribution function at `uniform`.

    One uniform per categorical costs K times less randomness than Gumbel noise, and the same
    uniforms under equal logits give equal samples.

    Args:
      logits: `[..., K]`, before unimix.
      uniform: `[...]` in [0, 1).
      unimix: uniform share mixed into softmax(logits).

    Returns:
      `[...]` int32 in [0, K).
    """
    return _invert(probabilities(logits, unimix=unimix), uniform)


def on_simplex(stoch: Array) -> Array:
    """The same z, for what sums to 1 in each categorical; gradients by it are centred there.

    What depends on z alone has a gradient that is open up to a number for all classes of a
    categorical, as nothing moves z off the simplex. Through here that number is 0.

    Args:
      stoch: `[..., S, K]`.
    """
    return stoch - stoch.mean(-1, keepdims=True) + 1 / stoch.shape[-1]


def sample_one_hot(logits: Array, uniform: Array, *, unimix: float) -> Array:
    """A one-hot sample with the gradient of its probabilities (straight-through).

        z = onehot(sample) + p - sg(p),   p = (1 - u) * softmax(logits) + u / K

    Args:
      logits: `[..., K]`, before unimix.
      uniform: `[...]` in [0, 1); see `sample_index`.
      unimix: uniform share mixed into softmax(logits).

    Returns:
      `[..., K]` float32, exactly 0 and 1. The gradient to the logits is that of p.
    """
    probs = probabilities(logits, unimix=unimix)
    one_hot = jax.nn.one_hot(_invert(probs, uniform), logits.shape[-1])
    # p - sg(p) is exactly 0: added first, it leaves no rounding in the sample.
    return one_hot + (probs - jax.lax.stop_gradient(probs))


def probabilities(logits: Array, *, unimix: float) -> Array:
    """(1 - u) * softmax(logits) + u / K over the last axis, float32."""
    probs = jax.nn.softmax(logits.astype(jnp.float32))
    return (1 - unimix) * probs + unimix / logits.shape[-1]


class Policy(NamedTuple):
    """Pure functions of an action distribution, for any leading dims."""

    sample: Callable[[Key], Array]  # [..., A]
    log_prob: Callable[[Array], Array]  # [..., A] -> [...]
    entropy: Callable[[], Array]  # [...]
    mode: Callable[[], Array]  # [..., A]


def bounded_normal(mean: Array, std_logit: Array, *, min_std: float, max_std: float) -> Policy:
    """Normal(tanh(mean), std), std = (max - min) * sigmoid(std_logit + 2) + min.

    Samples are neither squashed nor clipped, and log-probabilities are of the raw sample: the
    environment clips what it receives. Log-probability and entropy are sums over actions.

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
    return Policy(
        sample=lambda key: normal.sample(seed=key),
        log_prob=lambda action: normal.log_prob(action).sum(-1),
        entropy=lambda: normal.entropy().sum(-1),
        mode=normal.mode,
    )


def one_hot_categorical(logits: Array, *, unimix: float) -> Policy:
    """Categorical over one-hot actions `[..., A]`, with a uniform share mixed in."""
    categorical = distrax.OneHotCategorical(
        logits=unimix_logits(logits, unimix), dtype=jnp.float32
    )
    return Policy(
        sample=lambda key: categorical.sample(seed=key),
        log_prob=categorical.log_prob,
        entropy=categorical.entropy,
        mode=categorical.mode,
    )


def _invert(probs: Array, uniform: Array) -> Array:
    """The first class whose cumulated probability exceeds `uniform`."""
    chex.assert_equal_shape([probs[..., 0], uniform])
    # Without the last sum, which may round to less than 1, the index cannot reach K.
    passed = jnp.cumsum(probs, axis=-1)[..., :-1] <= uniform[..., None]
    return passed.sum(-1, dtype=jnp.int32)
