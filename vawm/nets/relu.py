"""STORM's linear layers and MLPs: LayerNorm, ReLU, and PyTorch's initialisation.

Parameters are float32; products run in `dtype`, norms in float32. Inputs that are
concatenations are passed as tuples, as in `vawm.nets.layers`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import flax.linen as nn
import jax
import jax.numpy as jnp

from vawm.types import Array

NORM_EPSILON = 1e-5


def uniform_in(fan_in: int):
    """Initialiser: uniform within 1 / sqrt(fan_in), PyTorch's for weights and biases."""

    def init(key, shape, dtype=jnp.float32):
        bound = 1.0 / math.sqrt(fan_in)
        return jax.random.uniform(key, shape, dtype, -bound, bound)

    return init


class LayerNorm(nn.Module):
    """(x - mean) / sqrt(variance + epsilon) * scale + bias over the last axis, in float32."""

    width: int
    epsilon: float = NORM_EPSILON

    @nn.compact
    def __call__(self, x: Array) -> Array:
        scale = self.param("scale", nn.initializers.ones, (self.width,), jnp.float32)
        bias = self.param("bias", nn.initializers.zeros, (self.width,), jnp.float32)
        leading = (1,) * (x.ndim - 1)
        y = x.astype(jnp.float32)
        y = y - y.mean(-1, keepdims=True)
        y = y * jax.lax.rsqrt(jnp.square(y).mean(-1, keepdims=True) + self.epsilon)
        return (y * scale.reshape(*leading, -1) + bias.reshape(*leading, -1)).astype(x.dtype)


class UniformLinear(nn.Module):
    """y = x @ W, or x @ W + b, with x the concatenation of the inputs."""

    in_features: int
    out_features: int
    use_bias: bool = True
    dtype: jnp.dtype = jnp.float32

    @nn.compact
    def __call__(self, *inputs: Array) -> Array:
        init = uniform_in(self.in_features)
        kernel = self.param("kernel", init, (self.in_features, self.out_features))
        kernel, start = kernel.astype(self.dtype), 0
        parts = []
        for x in inputs:
            parts.append(x.astype(self.dtype) @ kernel[start : start + x.shape[-1]])
            start += x.shape[-1]
        if start != self.in_features:
            raise ValueError(f"UniformLinear takes {self.in_features} features, got {start}")
        y = sum(parts[1:], start=parts[0])
        if not self.use_bias:
            return y
        bias = self.param("bias", init, (self.out_features,)).astype(self.dtype)
        return y + bias.reshape((1,) * (y.ndim - 1) + (-1,))


class ReluMLP(nn.Module):
    """`layers` of Linear -> LayerNorm -> ReLU, and one linear output per entry of `outputs`.

    Returns a tuple of outputs, or the last hidden layer if there are no outputs.
    """

    in_features: int
    layers: int
    units: int
    outputs: Sequence[int] = ()
    dtype: jnp.dtype = jnp.float32

    @nn.compact
    def __call__(self, *inputs: Array) -> Array | tuple[Array, ...]:
        widths = [self.in_features] + [self.units] * self.layers
        for i, width in enumerate(widths[:-1]):
            linear = UniformLinear(width, self.units, False, self.dtype, name=f"hidden_{i}")
            x = LayerNorm(self.units, name=f"norm_{i}")(linear(*inputs))
            inputs = (nn.relu(x),)
        if not self.outputs:
            return inputs[0]
        return tuple(
            UniformLinear(widths[-1], out, True, self.dtype, name=f"heads_{i}")(*inputs)
            for i, out in enumerate(self.outputs)
        )
