"""Batch normalisation as torch defines it, with a gradient written by hand.

Parameters `scale` (1) and `bias` (0) are in the collection "params"; the running `mean` (0)
and `var` (1) are in "statistics", and nobody differentiates them. All of them are float32, and
so is what is computed with them, whatever the input is.
"""

from __future__ import annotations

import math

import flax.linen as nn
import jax
import jax.numpy as jnp

from vawm.types import Array

EPSILON = 1e-5
MOMENTUM = 0.1  # how much of the running statistics a batch replaces


def batch_mean(x: Array) -> Array:
    """Mean over all axes but the last, in float32: first of every x[i], then over i.

    In one go a CPU would add up everything on a single core.
    """
    x = x.astype(jnp.float32)
    if x.ndim > 2:
        x = x.mean(tuple(range(1, x.ndim - 1)))
    return x.mean(0)


def per_channel(x: Array, like: Array) -> Array:
    return x.reshape((1,) * (like.ndim - 1) + x.shape)


@jax.custom_vjp
def normalise(x: Array, scale: Array, bias: Array) -> tuple[Array, Array, Array]:
    """(x - mean) / sqrt(var + 1e-5) * scale + bias; mean; var, of all axes but the last.

    `var` divides by the count and is taken around the mean, in a second pass: nothing
    cancels where the mean is large. The gradient of the first result is exact, through mean
    and var; `mean` and `var` as results pass none on.
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
    """BatchNorm over all axes but the last, `[..., features]` -> the same.

    With `train=True` the batch's own mean and biased variance normalise, gradients pass
    through both, and the running statistics become 0.9 running + 0.1 batch, the batch's
    variance unbiased there (count - 1; of a batch of one value it stays biased). That takes
    `mutable=["statistics"]`; `init` leaves them at 0 and 1. With `train=False` the running
    statistics normalise.
    """

    features: int

    def setup(self):
        shape = (self.features,)
        self.scale = self.param("scale", nn.initializers.ones, shape)
        self.bias = self.param("bias", nn.initializers.zeros, shape)
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
        """Factor and shift: what `train=False` does is x * factor + shift."""
        factor = self.scale * jax.lax.rsqrt(self.var.value + EPSILON)
        return factor, self.bias - self.mean.value * factor
