"""STORM's encoder and decoder of images: 4 x 4 convolutions of stride 2 and batch norms.

Four halvings, Conv -> BatchNorm -> ReLU, and their mirror image. Both convolutions have padding
1 and even sides, so between a fine image of side 2 s and a coarse one of side s:

    halve    coarse[i] = sum over t of  fine[2 i + t - 1] kernel[t],  t = 0..3, zeros outside
    double   fine[2 i + t - 1] += coarse[i] kernel[t]

in both dimensions. Each is the gradient of the other with respect to its input, and the
gradient of the kernel is the same. Kernels are `[4, 4, in, out]`, with rows and columns t as
above. From torch: `weight.transpose(2, 3, 1, 0)` of a Conv2d, and `.transpose(2, 3, 0, 1)` of a
ConvTranspose2d.

XLA's convolutions are slow on CPU, their gradients are slower, and both are slowest in loops.
So on CPU both are computed by matrix products, a few images at a time such that they stay in
the cache. A 4 x 4 kernel of stride 2 is a 2 x 2 kernel of stride 1 on blocks of 2 x 2 pixels.
Two neighbouring results of a kernel with two taps take three products (Winograd, "Arithmetic
Complexity of Computations", 1980) instead of four:

    a u + b v = (a - b) u + b (u + v)
    b u + c v = b (u + v) - (b - c) v

In two dimensions this needs 9 products instead of 16, and the intermediate arrays are smaller
than the patches of a direct product. Sums are computed before products, so rounding errors are
slightly larger, about 1e-6 of the largest value. Images with few channels or an odd coarse side
use a direct product. Other devices use XLA's convolutions.

Images are `[N, H, W, C]`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import flax.linen as nn
import jax
import jax.numpy as jnp

from vawm.nets.batch_norm import BatchNorm
from vawm.nets.relu import uniform_in
from vawm.types import Array

TAPS = 4  # rows and columns of a kernel
STAGE_WIDTHS = (1, 2, 4, 8)  # channels of the encoder's stages, in units of `depth`
HALVINGS = len(STAGE_WIDTHS)
IMAGES_AT_ONCE = 32  # such that the inputs of a product stay in the cache
FEW_CHANNELS = 16  # of the fine image; below, a direct product is used
LAYOUT = ("NHWC", "HWIO", "NHWC")


# On other devices than CPU: convolutions.


def plain_halve(x: Array, kernel: Array) -> Array:
    return jax.lax.conv_general_dilated(
        x, kernel, (2, 2), ((1, 1), (1, 1)), dimension_numbers=LAYOUT
    )


def plain_double(x: Array, kernel: Array) -> Array:
    return jax.lax.conv_general_dilated(
        x,
        kernel[::-1, ::-1],
        (1, 1),
        ((2, 2), (2, 2)),
        lhs_dilation=(2, 2),
        dimension_numbers=LAYOUT,
    )


# On CPU: matrix products.
# A scheme defines matrices for the fine image, the coarse one and the kernel
# `[4, 4, fine channels, coarse channels]`:
#
#     coarse = from_products(fine_k @ kernel_k)         over k
#     fine   = from_products(coarse_k @ kernel_k^T)
#     kernel = from_products(fine_k^T @ coarse_k)
#
# with rows for pixels (or tiles of them) and columns for channels. `to_...` and `of_...` of the
# same array are transposes of each other.

Matrices = list[Array]


class Scheme(NamedTuple):
    of_kernel: Callable[[Array], Matrices]
    to_kernel: Callable[[Matrices], Array]
    of_fine: Callable[[Array], Matrices]
    to_fine: Callable[[Matrices, int, int, int], Array]  # with count, coarse height, width
    of_coarse: Callable[[Array], Matrices]
    to_coarse: Callable[[Matrices, int, int, int], Array]


def scheme_of(fine_channels: int, height: int, width: int) -> Scheme:
    """The scheme for a coarse image of `height`, `width`."""
    even = height % 2 == 0 and width % 2 == 0
    return SAVING if even and fine_channels >= FEW_CHANNELS else WRITTEN_OUT


def shifted(x: Array, axis: int, by: int) -> Array:
    """`x` with one more zero along `axis`: first if `by` is 1, else last."""
    pads = [(0, 0)] * x.ndim
    pads[axis] = (by, 1 - by)
    return jnp.pad(x, pads)


# WRITTEN_OUT: one direct product of all 4 x 4 pixels that a coarse pixel meets.


def patches(fine: Array) -> Matrices:
    count, height, width, channels = fine.shape
    height, width = height // 2, width // 2
    x = jnp.pad(fine, ((0, 0), (1, 1), (1, 1), (0, 0)))
    x = x.reshape(count, height + 1, 2, width + 1, 2 * channels)
    pairs = [
        x[:, t // 2 : t // 2 + height, t % 2, j : j + width]
        for t in range(TAPS)
        for j in range(2)
    ]
    return [jnp.concatenate(pairs, -1).reshape(-1, TAPS * TAPS * channels)]


def add_patches(products: Matrices, count: int, height: int, width: int) -> Array:
    x = products[0].reshape(count, height, width, TAPS, 2, -1)
    rows = [shifted(x[..., p, :, :], 1, 0) + shifted(x[..., p + 2, :, :], 1, 1) for p in (0, 1)]
    x = jnp.stack(rows, 2)  # [N, H + 1, 2, W, 2, 2 C]
    x = shifted(x[..., 0, :], 3, 0) + shifted(x[..., 1, :], 3, 1)
    return x.reshape(count, 2 * height + 2, 2 * width + 2, -1)[:, 1:-1, 1:-1]


def flat_kernel(kernel: Array) -> Matrices:
    return [kernel.reshape(-1, kernel.shape[-1])]


def unflat_kernel(products: Matrices) -> Array:
    return products[0].reshape(TAPS, TAPS, -1, products[0].shape[-1])


def pixels(coarse: Array) -> Matrices:
    return [coarse.reshape(-1, coarse.shape[-1])]


def from_pixels(products: Matrices, count: int, height: int, width: int) -> Array:
    return products[0].reshape(count, height, width, -1)


# SAVING: nine products, k = (row, column) in 3 x 3, of tiles of 2 x 2 coarse pixels and the
# 3 x 3 blocks of 2 x 2 fine pixels that they meet; neighbouring tiles share the outer blocks.


def differences(a: Array, b: Array, c: Array) -> Matrices:
    return [a - b, b, b - c]


def tiles_of_blocks(fine: Array) -> Matrices:
    count, height, width, channels = fine.shape
    height, width = height // 4, width // 4
    x = jnp.pad(fine, ((0, 0), (1, 3), (1, 3), (0, 0)))
    # The two columns of a block and their channels are already adjacent.
    x = x.reshape(count, height + 1, 4, width + 1, 2, 2 * channels)

    def pair(row: int, block: int) -> Array:  # row 0..5 and column of blocks 0..2 of all tiles
        rows, columns = (
            slice(row // 4, row // 4 + height),
            slice(block // 2, block // 2 + width),
        )
        return x[:, rows, row % 4, columns, block % 2]

    phases = []  # [row of a block][k]
    for p in (0, 1):
        blocks = [[pair(2 * i + p, j) for i in range(3)] for j in range(3)]
        columns = [differences(*column) for column in blocks]
        rows = zip(*columns, strict=True)
        phases.append([entry for row in rows for entry in differences(*row)])
    return [
        jnp.concatenate([phase[k] for phase in phases], -1).reshape(-1, 4 * channels)
        for k in range(9)
    ]


def add_tiles_of_blocks(products: Matrices, count: int, height: int, width: int) -> Array:
    height, width, channels = height // 2, width // 2, products[0].shape[-1] // 4

    def outer_and_middle(axis: int, a: Array, b: Array, c: Array) -> tuple[Array, Array]:
        return shifted(a, axis, 0) - shifted(c, axis, 1), b + c - a

    entries = [x.reshape(count, height, width, -1) for x in products]
    columns = [outer_and_middle(1, *entries[j::3]) for j in range(3)]
    rows = zip(*columns, strict=True)
    blocks = [outer_and_middle(2, *row) for row in rows]
    # For each of a tile's four pixels: outer or middle block, first or next, phase.
    places = ((0, 0, 1), (1, 0, 0), (1, 0, 1), (0, 1, 0))

    def pixel(i: int, j: int) -> Array:
        (row, down, p), (column, right, q) = places[i], places[j]
        block = blocks[row][column][:, down : down + height, right : right + width]
        start = (2 * p + q) * channels
        return block[..., start : start + channels]

    sides = range(4)
    rows_of_pixels = [jnp.concatenate([pixel(i, j) for j in sides], -1) for i in sides]
    return jnp.stack(rows_of_pixels, 2).reshape(count, 4 * height, 4 * width, channels)


def sums_of_taps(kernel: Array) -> Matrices:
    _, _, inputs, outputs = kernel.shape
    x = kernel.reshape(2, 2, 2, 2, inputs, outputs).transpose(0, 2, 1, 3, 4, 5)
    x = x.reshape(2, 2, 4 * inputs, outputs)
    rows = (x[0], x[0] + x[1], x[1])
    return [entry for row in rows for entry in (row[0], row[0] + row[1], row[1])]


def add_sums_of_taps(products: Matrices) -> Array:
    rows = [
        (products[i] + products[i + 1], products[i + 1] + products[i + 2]) for i in (0, 3, 6)
    ]
    taps = [*(a + b for a, b in zip(*rows[:2], strict=True))]
    taps += [*(a + b for a, b in zip(*rows[1:], strict=True))]
    x = jnp.stack(taps).reshape(2, 2, 2, 2, -1, taps[0].shape[-1])
    return x.transpose(0, 2, 1, 3, 4, 5).reshape(TAPS, TAPS, -1, x.shape[-1])


def tiles_of_pixels(coarse: Array) -> Matrices:
    count, height, width, channels = coarse.shape
    x = coarse.reshape(count, height // 2, 2, width // 2, 2, channels)
    rows = (x[:, :, 0], x[:, :, 0] + x[:, :, 1], -x[:, :, 1])
    entries = [
        entry
        for row in rows
        for entry in (row[..., 0, :], row[..., 0, :] + row[..., 1, :], -row[..., 1, :])
    ]
    return [entry.reshape(-1, channels) for entry in entries]


def add_tiles_of_pixels(products: Matrices, count: int, height: int, width: int) -> Array:
    entries = [x.reshape(count, height // 2, width // 2, -1) for x in products]
    rows = [(a + b, b - c) for a, b, c in (entries[:3], entries[3:6], entries[6:])]
    top = [a + b for a, b in zip(*rows[:2], strict=True)]
    bottom = [b - c for b, c in zip(*rows[1:], strict=True)]
    x = jnp.stack([jnp.stack(row, 3) for row in (top, bottom)], 2)
    return x.reshape(count, height, width, -1)


WRITTEN_OUT = Scheme(flat_kernel, unflat_kernel, patches, add_patches, pixels, from_pixels)
SAVING = Scheme(
    sums_of_taps,
    add_sums_of_taps,
    tiles_of_blocks,
    add_tiles_of_blocks,
    tiles_of_pixels,
    add_tiles_of_pixels,
)


def scan_images(step: Callable, start: Any, *images: Array) -> tuple[Any, Array]:
    """Scans `step(total, *some images) -> (total, images)` over images, a few at a time."""
    count = images[0].shape[0]
    loops = count // IMAGES_AT_ONCE
    if loops * IMAGES_AT_ONCE == count and loops > 1:
        shape = (loops, IMAGES_AT_ONCE)
        chunks = tuple(x.reshape(*shape, *x.shape[1:]) for x in images)
        total, result = jax.lax.scan(lambda total, few: step(total, *few), start, chunks)
        return total, result.reshape(count, *result.shape[2:])
    if loops == 0 or count == IMAGES_AT_ONCE:
        return step(start, *images)
    whole = loops * IMAGES_AT_ONCE
    total, first = scan_images(step, start, *(x[:whole] for x in images))
    total, last = scan_images(step, total, *(x[whole:] for x in images))
    return total, jnp.concatenate([first, last])


def map_images(function: Callable[[Array], Array], images: Array) -> Array:
    """Applies `function` to all images, a few at a time."""
    nothing = jnp.zeros((), jnp.float32)
    return scan_images(lambda nothing, few: (nothing, function(few)), nothing, images)[1]


def halve_by_products(x: Array, kernel: Array) -> Array:
    size = x.shape[1] // 2, x.shape[2] // 2
    scheme = scheme_of(kernel.shape[2], *size)
    matrices = scheme.of_kernel(kernel)

    def some(x: Array) -> Array:
        products = [a @ b for a, b in zip(scheme.of_fine(x), matrices, strict=True)]
        return scheme.to_coarse(products, x.shape[0], *size)

    return map_images(some, x)


def double_by_products(x: Array, kernel: Array) -> Array:
    size = x.shape[1:3]
    scheme = scheme_of(kernel.shape[3], *size)
    matrices = scheme.of_kernel(kernel.swapaxes(2, 3))

    def some(x: Array) -> Array:
        products = [a @ b.T for a, b in zip(scheme.of_coarse(x), matrices, strict=True)]
        return scheme.to_fine(products, x.shape[0], *size)

    return map_images(some, x)


def product_of_columns(a: Array, b: Array) -> Array:
    return jax.lax.dot_general(
        a, b, (((0,), (0,)), ((), ())), preferred_element_type=jnp.float32
    )


def halve_gradients_by_products(
    x: Array, kernel: Array, gradient: Array
) -> tuple[Array, Array]:
    size = gradient.shape[1:3]
    scheme = scheme_of(kernel.shape[2], *size)
    matrices = scheme.of_kernel(kernel)

    def some(total: Matrices, x: Array, gradient: Array):
        fine, coarse = scheme.of_fine(x), scheme.of_coarse(gradient)
        total = [
            t + product_of_columns(a, b) for t, a, b in zip(total, fine, coarse, strict=True)
        ]
        products = [a @ b.T for a, b in zip(coarse, matrices, strict=True)]
        return total, scheme.to_fine(products, x.shape[0], *size)

    start = [jnp.zeros(m.shape, jnp.float32) for m in matrices]
    total, of_x = scan_images(some, start, x, gradient)
    return of_x, scheme.to_kernel(total).astype(kernel.dtype)


def double_gradients_by_products(
    x: Array, kernel: Array, gradient: Array
) -> tuple[Array, Array]:
    size = x.shape[1:3]
    scheme = scheme_of(kernel.shape[3], *size)
    matrices = scheme.of_kernel(kernel.swapaxes(2, 3))

    def some(total: Matrices, x: Array, gradient: Array):
        fine, coarse = scheme.of_fine(gradient), scheme.of_coarse(x)
        total = [
            t + product_of_columns(a, b) for t, a, b in zip(total, fine, coarse, strict=True)
        ]
        products = [a @ b for a, b in zip(fine, matrices, strict=True)]
        return total, scheme.to_coarse(products, x.shape[0], *size)

    start = [jnp.zeros(m.shape, jnp.float32) for m in matrices]
    total, of_x = scan_images(some, start, x, gradient)
    return of_x, scheme.to_kernel(total).swapaxes(2, 3).astype(kernel.dtype)


# The two convolutions.


@jax.custom_vjp
def halve(x: Array, kernel: Array) -> Array:
    """`[N, 2 H, 2 W, in]` with `[4, 4, in, out]` -> `[N, H, W, out]`, stride 2, padding 1."""
    return jax.lax.platform_dependent(x, kernel, cpu=halve_by_products, default=plain_halve)


@jax.custom_vjp
def double(x: Array, kernel: Array) -> Array:
    """`[N, H, W, in]` with `[4, 4, in, out]` -> `[N, 2 H, 2 W, out]`, the transpose."""
    return jax.lax.platform_dependent(x, kernel, cpu=double_by_products, default=plain_double)


def _gradients(plain: Callable, by_products: Callable) -> Callable:
    def by_convolution(x: Array, kernel: Array, gradient: Array) -> tuple[Array, Array]:
        return jax.vjp(plain, x, kernel)[1](gradient)

    def backward(saved: tuple[Array, Array], gradient: Array) -> tuple[Array, Array]:
        return jax.lax.platform_dependent(
            *saved, gradient, cpu=by_products, default=by_convolution
        )

    return backward


halve.defvjp(
    lambda x, kernel: (halve(x, kernel), (x, kernel)),
    _gradients(plain_halve, halve_gradients_by_products),
)
double.defvjp(
    lambda x, kernel: (double(x, kernel), (x, kernel)),
    _gradients(plain_double, double_gradients_by_products),
)


# The two networks.


class Stage(nn.Module):
    """`convolve` -> BatchNorm -> ReLU, where `convolve` is `halve` or `double`."""

    convolve: Callable[[Array, Array], Array]
    inputs: int
    outputs: int
    fan_in: int
    dtype: jnp.dtype = jnp.float32

    def setup(self):
        shape = (TAPS, TAPS, self.inputs, self.outputs)
        self.kernel = self.param("kernel", uniform_in(self.fan_in), shape)
        self.norm = BatchNorm(self.outputs)

    def __call__(self, x: Array) -> Array:
        """For training: normalises by the batch's statistics and updates the running ones."""
        x = self.convolve(x, self.kernel.astype(self.dtype))
        return nn.relu(self.norm(x, train=True))

    def frozen(self) -> tuple[Array, Array]:
        """Kernel and bias that combine convolution and norm, with the running statistics."""
        factor, shift = self.norm.running()
        kernel = self.kernel * factor.reshape(1, 1, 1, -1)
        return kernel.astype(self.dtype), shift.astype(self.dtype)


def a_few_at_once(network: Callable[[Any, Array], Array], parameters: Any, x: Array) -> Array:
    """`network(parameters, x)`; on CPU a few images go through all of it, then the next few.

    Between its layers, the images that imagination encodes would take gigabytes.
    """

    def mapped(parameters: Any, x: Array) -> Array:
        return map_images(lambda few: network(parameters, few), x)

    return jax.lax.platform_dependent(parameters, x, cpu=mapped, default=network)


def to_unit(pixels: Array, dtype: jnp.dtype) -> Array:
    """Numbers from 0 to 255 as numbers from 0 to 1."""
    return pixels.astype(dtype) / 255.0


def encode(layers: Sequence[tuple[Array, Array]], pixels: Array) -> Array:
    """ReLU(halve(x, kernel) + bias) through all layers; starts from uint8, to save memory."""
    x = to_unit(pixels, layers[0][0].dtype)
    for kernel, bias in layers:
        x = nn.relu(halve(x, kernel) + bias.reshape(1, 1, 1, -1))
    return x.reshape(x.shape[0], -1)


def decode(layers: Sequence[tuple[Array, Array]], z: Array) -> Array:
    """A map from z by the first kernel `[F, side, side, C]`, then doublings; no last ReLU."""
    (kernel, bias), *doublings = layers
    x = (z @ kernel.reshape(z.shape[-1], -1)).reshape(-1, *kernel.shape[1:])
    x = x + bias.reshape(1, 1, 1, -1)
    for kernel, bias in doublings:
        x = double(nn.relu(x), kernel) + bias.reshape(1, 1, 1, -1)
    return x


class StridedEncoder(nn.Module):
    """STORM's CNN: four halvings, then the rest flattened to a vector.

    `[N, size, size, channels]` pixels from 0 to 255, as uint8 or floats, which it divides by
    255 -> `[N, (size / 16)^2 * 8 * depth]`, in the order rows, columns, channels.
    `train=True` normalises by the statistics of the batch and needs `mutable=["statistics"]`;
    `train=False` uses the running ones. Source: `EncoderBN` of weipu-zhang/STORM. Raises
    ValueError unless sides are multiples of 16.
    """

    channels: int
    depth: int = 32
    dtype: jnp.dtype = jnp.float32

    def setup(self):
        widths = [self.channels, *(width * self.depth for width in STAGE_WIDTHS)]
        self.stages = [
            Stage(halve, inputs, outputs, TAPS * TAPS * inputs, self.dtype)
            for inputs, outputs in pairwise(widths)
        ]

    def __call__(self, x: Array, *, train: bool) -> Array:
        for side in x.shape[1:3]:
            side_of_map(side)
        if not train:
            return a_few_at_once(encode, [stage.frozen() for stage in self.stages], x)
        x = to_unit(x, self.dtype)
        for stage in self.stages:
            x = stage(x)
        return x.reshape(x.shape[0], -1)


class StridedDecoder(nn.Module):
    """STORM's decoder: a small map from z, then four doublings; the last has only a bias.

    `[N, features]` -> `[N, size, size, channels]`, unbounded, the mean of pixels / 255.
    Linear without bias -> BatchNorm -> ReLU makes the map `[size / 16, size / 16, 8 * depth]`.
    `train` is as in StridedEncoder. Source: `DecoderBN` of weipu-zhang/STORM. Kernels of its
    transposed convolutions are initialised with torch's fan-in, 16 * outputs.
    Raises ValueError unless `size` is a multiple of 16.
    """

    features: int
    size: int
    channels: int
    depth: int = 32
    dtype: jnp.dtype = jnp.float32

    def setup(self):
        side, top = side_of_map(self.size), STAGE_WIDTHS[-1] * self.depth
        shape = (self.features, side, side, top)
        self.kernel = self.param("kernel", uniform_in(self.features), shape)
        self.norm = BatchNorm(top)
        widths = [width * self.depth for width in STAGE_WIDTHS[::-1]]
        self.stages = [
            Stage(double, inputs, outputs, TAPS * TAPS * outputs, self.dtype)
            for inputs, outputs in pairwise(widths)
        ]
        init = uniform_in(TAPS * TAPS * self.channels)
        shape = (TAPS, TAPS, widths[-1], self.channels)
        self.out_kernel = self.param("out_kernel", init, shape)
        self.out_bias = self.param("out_bias", init, (self.channels,))

    def __call__(self, z: Array, *, train: bool) -> Array:
        z = z.astype(self.dtype)
        out = self.out_kernel.astype(self.dtype), self.out_bias.astype(self.dtype)
        if not train:
            factor, shift = self.norm.running()
            kernel = self.kernel * factor.reshape(1, 1, 1, -1)
            first = kernel.astype(self.dtype), shift.astype(self.dtype)
            layers = [first, *(stage.frozen() for stage in self.stages), out]
            return a_few_at_once(decode, layers, z)
        kernel = self.kernel.astype(self.dtype)
        x = (z @ kernel.reshape(self.features, -1)).reshape(-1, *kernel.shape[1:])
        x = nn.relu(self.norm(x, train=True))
        for stage in self.stages:
            x = stage(x)
        return double(x, out[0]) + out[1].reshape(1, 1, 1, -1)


def side_of_map(size: int) -> int:
    """The side of an image after all halvings."""
    side, rest = divmod(size, 2**HALVINGS)
    if rest or not side:
        raise ValueError(f"image sides are multiples of {2**HALVINGS}, got {size}")
    return side
