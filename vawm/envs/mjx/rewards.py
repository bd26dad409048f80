"""`dm_control.utils.rewards.tolerance` in JAX, with the three sigmoids that the tasks use."""

from __future__ import annotations

import math

import jax.numpy as jnp

from vawm.types import Array

VALUE_AT_MARGIN = 0.1


def tolerance(
    x: Array,
    bounds: tuple[float, float] = (0.0, 0.0),
    *,
    margin: float = 0.0,
    value_at_margin: float = VALUE_AT_MARGIN,
    sigmoid: str = "gaussian",
) -> Array:
    """1 inside `bounds`; falls to `value_at_margin` at a distance of `margin` from them.

    Args:
      x: `[...]`, any unit; `bounds` and `margin` share it.
      bounds: inclusive interval, possibly infinite.
      margin: 0 makes the value 0 everywhere outside.
      value_at_margin: value at distance `margin`.
      sigmoid: "gaussian", "linear" or "quadratic".

    Returns:
      `[...]` values in [0, 1].
    """
    lower, upper = bounds
    outside = jnp.maximum(jnp.maximum(lower - x, x - upper), 0.0)
    if margin == 0:
        return jnp.where(outside == 0, 1.0, 0.0)
    return _sigmoid(outside / margin, value_at_margin, sigmoid)


def _sigmoid(distance: Array, value_at_1: float, kind: str) -> Array:
    """1 at distance 0 and `value_at_1` at distance 1."""
    if kind == "gaussian":
        return jnp.exp(math.log(value_at_1) * distance**2)
    if kind == "linear":
        return jnp.maximum(1 - (1 - value_at_1) * distance, 0.0)
    if kind == "quadratic":
        return jnp.maximum(1 - (1 - value_at_1) * distance**2, 0.0)
    raise ValueError(f"sigmoid={kind!r}: use 'gaussian', 'linear' or 'quadratic'")
