"""Screens made smaller, byte for byte as Pillow or OpenCV do it, without either.

Both weigh rows and columns apart with weights that never change, so a resize is two
products with sparse matrices: faster than Pillow, and no threads that workers would fight
for.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy import sparse

from vawm.errors import InvalidInput

RESIZES = ("bilinear", "area")
SCREEN_WIDTH = 160  # of ALE in every game; a screen is higher than wide
PRECISION = 22  # bits after the point in Pillow's weights of 8-bit images


def make_resize(
    method: str, *, height: int, width: int, size: int
) -> Callable[[np.ndarray], np.ndarray]:
    """Builds the function that brings RGB frames to `size` x `size` pixels.

    bilinear: Pillow's `Image.resize(..., BILINEAR)`. A triangle as wide as the reduction
      asks for (antialiased), across and then down, rounded to bytes after each, all in
      fixed point: exact.
    area: OpenCV's `INTER_AREA`. The mean over the area that a pixel covers, rounded once.
      Exact for 160 x 210 to 64 x 64, where it cannot fall on a half: it is a multiple of
      1 / 525. At sizes where it can, OpenCV's float32 decides and may differ by 1.

    Args:
      method: one of `RESIZES`.
      height: rows of a frame.
      width: pixels in a row of a frame.
      size: pixels a side of the result.

    Returns:
      `(frame [height, width, 3] uint8) -> [size, size, 3] uint8`, a fresh array.

    Raises:
      InvalidInput: an unknown method, or "area" asked to enlarge (OpenCV interpolates then).
    """
    if method not in RESIZES:
        raise InvalidInput("resize", method, f"choose one of {', '.join(RESIZES)}")
    if method == "area":
        check_smaller("image_size", size, largest=min(height, width))
    weights = fixed_triangle if method == "bilinear" else overlap
    between = to_byte if method == "bilinear" else unchanged
    end = to_byte if method == "bilinear" else np.rint
    down = sparse.csr_array(weights(height, size))
    # Colours stay side by side: a row is `width * 3` numbers, a column of pixels three.
    across = sparse.csr_array(np.kron(weights(width, size), np.eye(3, dtype=down.dtype)))

    def resize(frame: np.ndarray) -> np.ndarray:
        columns = frame.reshape(height, width * 3).T.astype(down.dtype, order="C")
        columns = between(across @ columns)  # [size * 3, height]
        return end(down @ columns.T).astype(np.uint8).reshape(size, size, 3)

    return resize


def check_smaller(field: str, size: int, *, largest: int = SCREEN_WIDTH) -> None:
    """Refuses a size that "area" does not reach, because it only makes smaller.

    Raises:
      InvalidInput: names the largest.
    """
    if size > largest:
        remedy = f'resize="area" only makes smaller: use at most {largest}'
        raise InvalidInput(field, size, remedy)


def fixed_triangle(source: int, target: int) -> np.ndarray:
    """Pillow's bilinear weights `[target, source]`, int32 in units of 2**-22.

        w(i, j) ~ max(0, 1 - |j + 1/2 - c_i| / s),  c_i = (i + 1/2) source / target

    with s = max(1, source / target), so that a smaller image misses no pixel. A weighted
    sum of bytes stays below 2**31.
    """
    scale = source / target
    centre = (np.arange(target)[:, None] + 0.5) * scale
    distance = np.abs(np.arange(source) - centre + 0.5) / max(scale, 1.0)
    weights = np.maximum(1 - distance, 0)
    weights /= weights.sum(axis=1, keepdims=True)
    return np.floor(weights * 2**PRECISION + 0.5).astype(np.int32)


def overlap(source: int, target: int) -> np.ndarray:
    """OpenCV's area weights `[target, source]`, float32: shares of a new pixel's length."""
    scale = source / target
    begin = np.arange(target)[:, None] * scale
    pixel = np.arange(source)
    covered = np.minimum(begin + scale, pixel + 1) - np.maximum(begin, pixel)
    return (np.maximum(covered, 0) / scale).astype(np.float32)


def to_byte(total: np.ndarray) -> np.ndarray:
    """Rounds sums in units of 2**-22 to whole numbers, halves up; in place."""
    total += 1 << (PRECISION - 1)
    total >>= PRECISION
    return total


def unchanged(total: np.ndarray) -> np.ndarray:
    """Area averages are rounded at the end only."""
    return total
