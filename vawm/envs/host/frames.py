"""Resizes screens, byte for byte as Pillow or OpenCV would, without either.

Both weight rows and columns separately with constant weights, so a resize is two products
with sparse matrices. That is faster than Pillow and starts no threads that would compete
with those of other workers.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy import sparse

from vawm.errors import InvalidInput

RESIZES = ("bilinear", "area")
SCREEN_WIDTH = 160  # pixels, of ALE in every game; a screen is taller than wide
PRECISION = 22  # fractional bits of Pillow's weights for 8-bit images


def make_resize(
    method: str, *, height: int, width: int, size: int, channels: int = 3
) -> Callable[[np.ndarray], np.ndarray]:
    """Builds the function that resizes frames to `size` x `size` pixels, each channel alone.

    bilinear: Pillow's `Image.resize(..., BILINEAR)`. An antialiased triangle filter, first
      across, then down, rounded to bytes after each, in fixed point. Exact.
    area: OpenCV's `INTER_AREA`. The mean over the area of a new pixel, rounded once. Exact
      for 160 x 210 to 64 x 64: means are multiples of 1 / 525, so none lies halfway between
      two bytes. At sizes where one does, OpenCV's float32 rounding may differ by 1.

    Args:
      method: one of `RESIZES`.
      height: rows of a frame.
      width: pixels in a row of a frame.
      size: pixels per side of the result.
      channels: numbers per pixel.

    Returns:
      `(frame [height, width, channels] uint8) -> [size, size, channels] uint8`, a fresh array.

    Raises:
      InvalidInput: an unknown method, or "area" with a larger size (OpenCV interpolates).
    """
    if method not in RESIZES:
        raise InvalidInput("resize", method, f"choose one of {', '.join(RESIZES)}")
    if method == "area":
        check_smaller("image_size", size, largest=min(height, width))
    weights = fixed_triangle if method == "bilinear" else overlap
    between = to_byte if method == "bilinear" else unchanged
    end = to_byte if method == "bilinear" else np.rint
    down = sparse.csr_array(weights(height, size))
    # Channels stay adjacent: a row has `width * channels` numbers, a pixel `channels` columns.
    apart = sparse.eye_array(channels, dtype=down.dtype)
    across = sparse.csr_array(sparse.kron(sparse.csr_array(weights(width, size)), apart))

    def resize(frame: np.ndarray) -> np.ndarray:
        columns = frame.reshape(height, width * channels).T.astype(down.dtype, order="C")
        columns = between(across @ columns)  # [size * channels, height]
        return end(down @ columns.T).astype(np.uint8).reshape(size, size, channels)

    return resize


def check_smaller(field: str, size: int, *, largest: int = SCREEN_WIDTH) -> None:
    """Refuses a size above `largest`, because "area" can only shrink.

    Raises:
      InvalidInput: names the largest size.
    """
    if size > largest:
        remedy = f'resize="area" can only shrink frames: use at most {largest}'
        raise InvalidInput(field, size, remedy)


def fixed_triangle(source: int, target: int) -> np.ndarray:
    """Pillow's bilinear weights `[target, source]`, int32 in units of 2**-22.

        w(i, j) ~ max(0, 1 - |j + 1/2 - c_i| / s),  c_i = (i + 1/2) source / target

    with s = max(1, source / target), so that shrinking skips no pixel. A weighted sum of
    bytes stays below 2**31.
    """
    scale = source / target
    centre = (np.arange(target)[:, None] + 0.5) * scale
    distance = np.abs(np.arange(source) - centre + 0.5) / max(scale, 1.0)
    weights = np.maximum(1 - distance, 0)
    weights /= weights.sum(axis=1, keepdims=True)
    return np.floor(weights * 2**PRECISION + 0.5).astype(np.int32)


def overlap(source: int, target: int) -> np.ndarray:
    """OpenCV's area weights `[target, source]`, float32: fractions of a new pixel's length."""
    scale = source / target
    begin = np.arange(target)[:, None] * scale
    pixel = np.arange(source)
    covered = np.minimum(begin + scale, pixel + 1) - np.maximum(begin, pixel)
    return (np.maximum(covered, 0) / scale).astype(np.float32)


def to_byte(total: np.ndarray) -> np.ndarray:
    """Rounds sums in units of 2**-22 to integers, halves up; in place."""
    total += 1 << (PRECISION - 1)
    total >>= PRECISION
    return total


def unchanged(total: np.ndarray) -> np.ndarray:
    """Does nothing: area averages are rounded only at the end."""
    return total
