"""Batch normalisation as defined by torch, with a hand-written gradient.

Parameters `scale` (initially 1) and `bias` (0) are in the collection "params". The running
`mean` (0) and `var` (1) are in "statistics" and are never differentiated. All are float32, and
computations with them are in float32, whatever the input's dtype.
"""

from __future__ import annotations

import math

import flax.linen as nn
import jax
import jax.numpy as jnp

from vawm.types import Array

EPSILON = 1e-5
MOMENTUM = 0.1  # fraction of the running statistics that a batch replaces


def batch_mean(x: Array) -> Array:
    """Mean over all axes but the last, in float32: first within every x[i], then over i.

    In one step, a CPU would compute the sum on a single core.
    """
    x = x.astype(jnp.float32)
    if x.ndim > 2:
        x = x.mean(tuple(range(1, x.ndim - 1)))
    return x.mean(0)


def per_channel(x: Array, like: Array) -> Array:
    return x.reshape((1,) * (like.ndim - 1) + x.shape)


@jax.custom_vjp
def normalise(x: Array, scale: Array, bias: Array) -> tuple[Array, Array, Array]:
    """(x - mean) / sqrt(var + 1e-5) * scale + bias; mean; var, over all axes but the last.

    `var` divides by the count and is computed around the mean in a second pass, which avoids
    cancellation if the mean is large. The gradient of the first result is exact, through mean
    and var; the results `mean` and `var` have no gradient.
    """
    return _forward(x, scale, bias)[0]


def _forward(x: Array, scale: Array, bias: Array):
    mean = batch_mean(x)
    var = batch_mean(jnp.square(x.astype(jnp.float32) - per_channel(mean, x)))
    inverse = jax.lax.rsqrt(var + EPSILON)
    y = affine(x.astype(jnp.float32) - per_channel(mean, x), scale * inverse, bias)
    return (y.astype(x.dtype), mean, var), (x, scale, mean, inverse)


def _backward(saved: tuple[Array, ...], gradients: tuple[Array, Array, Array]):
    """With u = (x - mean) / std:  std / scale * dx = g - mean(g) - u mean(g u)."""
    x, scale, mean, inverse = saved
    g = gradients[0].astype(jnp.float32)
    centred = x.astype(jnp.float32) - per_channel(mean, x)
    mean_g, mean_gu = batch_mean(g), batch_mean(g * centred) * inverse
    of_x = g - per_channel(mean_g, x) - centred * per_channel(inverse * mean_gu, x)
    of_x = (of_x * per_channel(scale * inverse, x)).astype(x.dtype)
    count = math.prod(x.shape[:-1])
    return of_x, mean_gu * count, mean_g * count


normalise.defvjp(_forward, _backward)


def affine(x: Array, factor: Array, shift: Array) -> Array:
    """x * factor + shift per channel, computed in float32."""
    y = x.astype(jnp.float32) * per_channel(factor, x) + per_channel(shift, x)
    return y.astype(x.dtype)


class BatchNorm(nn.Module):
    """BatchNorm over all axes but the last, `[..., features]` -> `[..., features]`.

    `train=True` normalises by the mean and the biased variance of the batch, with gradients
    through both. It sets the running statistics to 0.9 running + 0.1 batch, with the unbiased
    variance of the batch (count - 1; biased if there is only one value). That needs
    `mutable=["statistics"]`; `init` leaves them at 0 and 1. `train=False` normalises by the
    running statistics.
    """

    features: int

    def setup(self):
        shape = (self.features,)
        self.scale = self.param("scale", nn.initializers.ones, shape, jnp.float32)
        self.bias = self.param("bias", nn.initializers.zeros, shape, jnp.float32)
        self.mean = self.variable("statistics", "mean", jnp.zeros, shape, jnp.float32)
        self.var = self.variable("statistics", "var", jnp.ones, shape, jnp.float32)

    def __call__(self, x: Array, *, train: bool) -> Array:
        if not train:
            return affine(x, *self.running())
        y, mean, var = normalise(x, self.scale, self.bias)
        if not self.is_initializing():
            count = math.prod(x.shape[:-1])
            unbiased = jax.lax.stop_gradient(var) * (count / max(count - 1, 1))
            self.mean.value += MOMENTUM * (jax.lax.stop_gradient(mean) - self.mean.value)
            self.var.value += MOMENTUM * (unbiased - self.var.value)
        return y

    def running(self) -> tuple[Array, Array]:
        """Factor and shift of `train=False`, which computes x * factor + shift."""
        factor = self.scale * jax.lax.rsqrt(self.var.value + EPSILON)
        return factor, self.bias - self.mean.value * factor
