"""Linear layers and MLPs.

Every hidden layer is Linear -> RMSNorm -> SiLU with biases, initialised as the official
DreamerV3 code does. Parameters are float32; products run in `dtype`, norms in float32.

Inputs that are concatenations are passed as tuples and never concatenated: the product with
[x, y] is x @ W[:m] + y @ W[m:]. This avoids copying wide features, and a caller can compute
the part of a layer that does not depend on the recurrence outside the time loop.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import flax.linen as nn
import jax
import jax.numpy as jnp

from vawm.types import Array

NORM_EPSILON = 1e-4
UNIT_VARIANCE = 1.1368  # 1 / std of a standard normal truncated to [-2, 2]


def truncated_normal_in(fan_in: int, scale: float):
    """Initialiser: normal truncated at two deviations, std = scale / sqrt(fan_in)."""

    def init(key, shape, dtype=jnp.float32):
        std = UNIT_VARIANCE * scale * math.sqrt(1.0 / fan_in)
        return std * jax.random.truncated_normal(key, -2.0, 2.0, shape, dtype)

    return init


def rms_norm(x: Array, scale: Array, axes: int | tuple[int, ...] = -1) -> Array:
    """x / sqrt(mean(x^2) + 1e-4) * scale, the mean in float32 over `axes`."""
    y = x.astype(jnp.float32)
    y = y * jax.lax.rsqrt(jnp.mean(y * y, axes, keepdims=True) + NORM_EPSILON)
    return (y * scale.reshape((1,) * (y.ndim - scale.ndim) + scale.shape)).astype(x.dtype)


class Linear(nn.Module):
    """y = x @ W + b, with x the concatenation of the inputs."""

    in_features: int
    out_features: int
    scale: float = 1.0
    dtype: jnp.dtype = jnp.float32

    def setup(self):
        init = truncated_normal_in(self.in_features, self.scale)
        self.kernel = self.param("kernel", init, (self.in_features, self.out_features))
        self.bias = self.param("bias", nn.initializers.zeros, (self.out_features,), jnp.float32)

    def rows(self, x: Array, start: int) -> Array:
        """x @ W[start : start + width(x)], without bias."""
        kernel = self.kernel[start : start + x.shape[-1]]
        return x.astype(self.dtype) @ kernel.astype(self.dtype)

    def add_bias(self, y: Array) -> Array:
        return y + self.bias.astype(self.dtype).reshape((1,) * (y.ndim - 1) + (-1,))

    def __call__(self, *inputs: Array) -> Array:
        widths = [x.shape[-1] for x in inputs]
        if sum(widths) != self.in_features:
            raise ValueError(f"Linear takes {self.in_features} features, got {widths}")
        starts = [sum(widths[:i]) for i in range(len(widths))]
        first, *rest = (self.rows(x, s) for x, s in zip(inputs, starts, strict=True))
        return self.add_bias(sum(rest, start=first))


class Layer(nn.Module):
    """Linear -> RMSNorm -> SiLU."""

    in_features: int
    units: int
    dtype: jnp.dtype = jnp.float32

    def setup(self):
        self.linear = Linear(self.in_features, self.units, dtype=self.dtype)
        self.norm = self.param("norm", nn.initializers.ones, (self.units,), jnp.float32)

    def activate(self, y: Array) -> Array:
        return nn.silu(rms_norm(y, self.norm))

    def __call__(self, *inputs: Array) -> Array:
        return self.activate(self.linear(*inputs))


class MLP(nn.Module):
    """`layers` hidden layers and one linear output per entry of `outputs`.

    `outputs` are widths, `scales` the initial scales of their kernels (0 for zeros).
    Returns a tuple of outputs, or the last hidden layer if there are no outputs.
    """

    in_features: int
    layers: int
    units: int
    outputs: Sequence[int] = ()
    scales: Sequence[float] = ()
    dtype: jnp.dtype = jnp.float32

    def setup(self):
        widths = [self.in_features] + [self.units] * self.layers
        self.hidden = [Layer(w, self.units, self.dtype) for w in widths[:-1]]
        self.heads = [
            Linear(widths[-1], out, scale, self.dtype)
            for out, scale in zip(self.outputs, self.scales, strict=True)
        ]

    def __call__(self, *inputs: Array) -> Array | tuple[Array, ...]:
        for layer in self.hidden:
            inputs = (layer(*inputs),)
        if not self.heads:
            return inputs[0]
        return tuple(head(*inputs) for head in self.heads)
