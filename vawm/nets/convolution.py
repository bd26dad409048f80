"""Encoder and decoder of images: 5 x 5 convolutions, each with a halving or a doubling.

No convolution runs at the finer of its two resolutions. A 5 x 5 kernel on pixels is a 3 x 3
kernel on blocks of 2 x 2 pixels, so

    convolve, then take the maximum of 2 x 2   = one 3 x 3 convolution of blocks with 4 output
                                                 phases, and the maximum of the phases
    repeat every pixel 2 x 2, then convolve    = one 3 x 3 convolution with 4 output phases

and both give the results of the 5 x 5 kernel, including zero padding. The second needs 2.8
times fewer multiplications. The first needs a few more, but in wider products and without a
window reduction, whose gradient is slow. Kernels keep the official layout `[5, 5, in, out]`,
on which AGC and the initial scale are defined, and are rearranged at every use.

Images are `[N, H, W, C]`. Phases are the last axis but one, row-major: (0, 0), (0, 1), (1, 0),
(1, 1) of (row, column) within a block.
"""

from __future__ import annotations

import math

import flax.linen as nn
import jax
import jax.numpy as jnp
import numpy as np

from vawm.nets.layers import Layer, Linear, rms_norm, truncated_normal_in
from vawm.nets.recurrent import block_product
from vawm.types import Array

TAPS = 5  # rows and columns of a kernel
STAGE_WIDTHS = (2, 3, 4, 4)  # channels of the encoder's stages, in units of `depth`
HALVINGS = len(STAGE_WIDTHS)
IMAGES_AT_ONCE = 16  # such that the inputs of a product stay in the cache


def _pooled_taps() -> np.ndarray:
    """`[out phase, block, in phase, tap]`: 1 for the tap that meets a pixel, in one dimension.

    Output pixel p of block 0 sees pixel q of block b (-1, 0, 1) through tap 2 b + q - p + 2.
    """
    taps = np.zeros((2, 3, 2, TAPS), np.float32)
    for p, block, q in np.ndindex(2, 3, 2):
        tap = 2 * (block - 1) + q - p + 2
        if 0 <= tap < TAPS:
            taps[p, block, q, tap] = 1
    return taps


def _repeated_taps() -> np.ndarray:
    """`[out phase, pixel, tap]`: 1 for the taps that meet a pixel that is repeated twice.

    Output pixel p of the pair 0 sees pixel (p + tap - 2) // 2, counted from -1, through `tap`.
    """
    taps = np.zeros((2, 3, TAPS), np.float32)
    for p, tap in np.ndindex(2, TAPS):
        taps[p, (p + tap - 2) // 2 + 1, tap] = 1
    return taps


POOLED_TAPS, REPEATED_TAPS = _pooled_taps(), _repeated_taps()


def pooled_kernel(kernel: Array) -> Array:
    """`[5, 5, in, out]` on pixels -> `[3, 3, 4 in, 4 out]` on blocks of 2 x 2 pixels."""
    _, _, inputs, outputs = kernel.shape
    taps = jnp.asarray(POOLED_TAPS, kernel.dtype)
    blocks = jnp.einsum("prqt,PRQT,tTio->rRqQipPo", taps, taps, kernel)
    return blocks.reshape(3, 3, 4 * inputs, 4 * outputs)


def repeated_kernel(kernel: Array) -> Array:
    """`[5, 5, in, out]` on repeated pixels -> `[3, 3, in, 4 out]` on the pixels."""
    _, _, inputs, outputs = kernel.shape
    taps = jnp.asarray(REPEATED_TAPS, kernel.dtype)
    pixels = jnp.einsum("prt,PRT,tTio->rRipPo", taps, taps, kernel)
    return pixels.reshape(3, 3, inputs, 4 * outputs)


def to_blocks(x: Array) -> Array:
    """`[N, H, W, C]` -> `[N, H / 2, W / 2, 4 C]`: the pixels of a block side by side."""
    count, height, width, channels = x.shape
    x = x.reshape(count, height // 2, 2, width // 2, 2, channels)
    return x.transpose(0, 1, 3, 2, 4, 5).reshape(count, height // 2, width // 2, 4 * channels)


def from_phases(x: Array) -> Array:
    """`[N, H, W, 4, C]` -> `[N, 2 H, 2 W, C]`: every phase at its pixel."""
    count, height, width, _, channels = x.shape
    x = x.reshape(count, height, width, 2, 2, channels).transpose(0, 1, 3, 2, 4, 5)
    return x.reshape(count, 2 * height, 2 * width, channels)


def convolve(x: Array, kernel: Array) -> Array:
    """`[N, H, W, in]` with `[3, 3, in, 4 out]`, zero padding -> `[N, H, W, 4, out]`."""
    x = convolve_3x3(x, kernel)
    return x.reshape(*x.shape[:3], 4, -1)


def plain_convolve_3x3(x: Array, kernel: Array) -> Array:
    return jax.lax.conv_general_dilated(
        x, kernel, (1, 1), "SAME", dimension_numbers=("NHWC", "HWIO", "NHWC")
    )


@jax.custom_vjp
def convolve_3x3(x: Array, kernel: Array) -> Array:
    """`[N, H, W, in]` with `[3, 3, in, out]`, zero padding -> `[N, H, W, out]`.

    The gradient of the kernel is a sum over all pixels of all images. On CPU it is computed
    by matrix products, one per row of the kernel: a whole update from pixels takes half the
    time that it takes with XLA's convolution.
    """
    return plain_convolve_3x3(x, kernel)


def _forward(x: Array, kernel: Array):
    return plain_convolve_3x3(x, kernel), (x, kernel)


def _backward(saved: tuple[Array, Array], gradient: Array) -> tuple[Array, Array]:
    x, kernel = saved
    of_x = jax.vjp(lambda x: plain_convolve_3x3(x, kernel), x)[1](gradient)[0]

    def by_convolution(x: Array, gradient: Array) -> Array:
        zero = jnp.zeros_like(kernel)
        return jax.vjp(lambda k: plain_convolve_3x3(x, k), zero)[1](gradient)[0]

    of_kernel = jax.lax.platform_dependent(
        x, gradient, cpu=kernel_gradient_by_products, default=by_convolution
    )
    return of_x, of_kernel


convolve_3x3.defvjp(_forward, _backward)


def kernel_gradient_by_products(x: Array, gradient: Array) -> Array:
    """The gradient of the kernel, `[3, 3, in, out]`, computed a few images at a time.

        sum over n, i, j of x[n, i + r - 1, j + s - 1, :, None] * gradient[n, i, j, None, :]

    With rows as the first axis, rows shifted by r are a slice; shifts by s are concatenated.
    """
    count, height, width, inputs = x.shape
    outputs, few = gradient.shape[-1], math.gcd(count, IMAGES_AT_ONCE)
    pixels = height * few * width

    def add(total: Array, images: tuple[Array, Array]) -> tuple[Array, None]:
        x, gradient = (image.transpose(1, 0, 2, 3) for image in images)
        x = jnp.pad(x, ((1, 1), (0, 0), (1, 1), (0, 0)))
        columns = jnp.concatenate([x[:, :, s : s + width] for s in range(3)], axis=-1)
        rows = [columns[r : r + height].reshape(pixels, 3 * inputs) for r in range(3)]
        products = [row.T @ gradient.reshape(pixels, outputs) for row in rows]
        return total + jnp.stack(products).reshape(total.shape), None

    chunks = [image.reshape(-1, few, *image.shape[1:]) for image in (x, gradient)]
    start = jnp.zeros((3, 3, inputs, outputs), x.dtype)
    return jax.lax.scan(add, start, (chunks[0], chunks[1]))[0]


class Kernel(nn.Module):
    """Kernel and bias of one 5 x 5 convolution, in `dtype`."""

    inputs: int
    outputs: int
    dtype: jnp.dtype = jnp.float32

    @nn.compact
    def __call__(self) -> tuple[Array, Array]:
        shape = (TAPS, TAPS, self.inputs, self.outputs)
        init = truncated_normal_in(TAPS * TAPS * self.inputs, 1.0)
        kernel = self.param("kernel", init, shape)
        bias = self.param("bias", nn.initializers.zeros, (self.outputs,), jnp.float32)
        return kernel.astype(self.dtype), bias.astype(self.dtype)


class Halve(nn.Module):
    """Convolution -> maximum of 2 x 2 -> RMSNorm over channels -> SiLU."""

    inputs: int
    outputs: int
    dtype: jnp.dtype = jnp.float32

    @nn.compact
    def __call__(self, x: Array) -> Array:
        kernel, bias = Kernel(self.inputs, self.outputs, self.dtype, name="conv")()
        norm = self.param("norm", nn.initializers.ones, (self.outputs,), jnp.float32)
        x = convolve(to_blocks(x), pooled_kernel(kernel)).max(-2)
        return nn.silu(rms_norm(x + bias.reshape(1, 1, 1, -1), norm))


class Double(nn.Module):
    """Every pixel 2 x 2 -> convolution -> RMSNorm over channels -> SiLU."""

    inputs: int
    outputs: int
    dtype: jnp.dtype = jnp.float32

    @nn.compact
    def __call__(self, x: Array) -> Array:
        kernel, bias = Kernel(self.inputs, self.outputs, self.dtype, name="conv")()
        norm = self.param("norm", nn.initializers.ones, (self.outputs,), jnp.float32)
        x = convolve(x, repeated_kernel(kernel)) + bias.reshape(1, 1, 1, 1, -1)
        return from_phases(nn.silu(rms_norm(x, norm)))


class ImageEncoder(nn.Module):
    """DreamerV3's CNN: four halvings, then the rest flattened to a vector.

    `[N, size, size, C]` floats -> `[N, (size / 16)^2 * 4 * depth]`.
    """

    channels: int
    depth: int
    dtype: jnp.dtype = jnp.float32

    @nn.compact
    def __call__(self, x: Array) -> Array:
        x, inputs = x.astype(self.dtype), self.channels
        for i, width in enumerate(STAGE_WIDTHS):
            outputs = width * self.depth
            x = Halve(inputs, outputs, self.dtype, name=f"stages_{i}")(x)
            inputs = outputs
        return x.reshape(x.shape[0], -1)


class ImageDecoder(nn.Module):
    """DreamerV3's decoder: a small map from h and z, then four doublings.

    The map is SiLU(norm(W h + V layer(z))), with W block-diagonal: block k of h makes the
    k-th group of channels. `[N, D]`, `[N, S K]` -> `[N, size, size, C]` in (0, 1).
    """

    deter: int
    stoch: int
    units: int
    blocks: int
    size: int
    channels: int
    depth: int
    dtype: jnp.dtype = jnp.float32

    @nn.compact
    def __call__(self, deter: Array, stoch: Array) -> Array:
        side, top = self.size // 2**HALVINGS, STAGE_WIDTHS[-1] * self.depth
        init = truncated_normal_in(self.deter, 1.0)
        shape = (self.blocks, self.deter // self.blocks, side * side * top // self.blocks)
        kernel = self.param("deter_kernel", init, shape)
        bias = self.param(
            "deter_bias", nn.initializers.zeros, (side * side * top,), jnp.float32
        )
        blocks = deter.reshape(-1, self.blocks, shape[1]).swapaxes(0, 1)
        x = block_product(blocks, kernel, self.dtype)  # [blocks, N, side * side * group]
        x = x + bias.astype(self.dtype).reshape(self.blocks, 1, -1)
        x = x.reshape(self.blocks, -1, side, side, top // self.blocks)
        x = x.transpose(1, 2, 3, 0, 4).reshape(-1, side, side, top)
        z = Layer(self.stoch, 2 * self.units, self.dtype, name="stoch_layer")(stoch)
        z = Linear(2 * self.units, side * side * top, dtype=self.dtype, name="stoch_out")(z)
        norm = self.param("norm", nn.initializers.ones, (top,), jnp.float32)
        x = nn.silu(rms_norm(x + z.reshape(x.shape), norm))
        inputs = top
        for i, width in enumerate(STAGE_WIDTHS[-2::-1]):
            outputs = width * self.depth
            x = Double(inputs, outputs, self.dtype, name=f"stages_{i}")(x)
            inputs = outputs
        kernel, bias = Kernel(inputs, self.channels, self.dtype, name="conv")()
        x = convolve(x, repeated_kernel(kernel)) + bias.reshape(1, 1, 1, 1, -1)
        return from_phases(nn.sigmoid(x))
