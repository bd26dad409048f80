"""Writes frames to MP4, with imageio and its ffmpeg, and to GIF."""

from __future__ import annotations

import importlib.util
import pathlib
import warnings

import numpy as np
from PIL import Image

from vawm.errors import InvalidInput
from vawm.runs.reports.video import FRAMES_PER_SECOND

PACKAGES = {"imageio": "imageio", "imageio_ffmpeg": "imageio-ffmpeg"}


def check() -> None:
    """Checks that the packages for films are installed.

    Raises:
      InvalidInput: names the package and the command that installs it.
    """
    for module, package in PACKAGES.items():
        if importlib.util.find_spec(module) is None:
            raise InvalidInput(package, "not installed", "pip install 'vawm[analysis]'")


def check_name(field: str, path: pathlib.Path) -> None:
    """Refuses the name of a film that is neither an MP4 nor a GIF.

    Raises:
      InvalidInput: names the endings, or the package that an MP4 needs.
    """
    if path.suffix not in (".mp4", ".gif"):
        raise InvalidInput(field, str(path), "use a name that ends with .mp4 or .gif")
    if path.suffix == ".mp4":
        check()


def write(frames: np.ndarray, path: pathlib.Path) -> None:
    """Writes `[T, H, W, 3]` uint8 frames to what the name of the file says.

    Raises:
      InvalidInput: a package is not installed.
      OSError: the file could not be written.
    """
    if path.suffix == ".gif":
        write_gif(frames, path, per_second=FRAMES_PER_SECOND)
    else:
        write_mp4(frames, path, enlarge=1)


def write_mp4(
    frames: np.ndarray,
    path: pathlib.Path,
    *,
    per_second: int = FRAMES_PER_SECOND,
    enlarge: int = 3,
) -> None:
    """Writes `[T, H, W, 3]` uint8 frames as H.264, each pixel as `enlarge` x `enlarge` pixels.

    Odd sides are padded by repeating the last row or column, because the codec needs even ones.

    Raises:
      InvalidInput: a package is not installed.
      OSError: the file could not be written.
    """
    check()
    import imageio.v3 as imageio

    large = frames.repeat(enlarge, axis=1).repeat(enlarge, axis=2)
    odd = [(0, size % 2) for size in large.shape[1:3]]
    even = np.pad(large, [(0, 0), *odd, (0, 0)], mode="edge")
    with warnings.catch_warnings():
        # JAX warns of every fork; this one only starts ffmpeg and does not use JAX.
        warnings.filterwarnings("ignore", message=r"os\.fork\(\)", category=RuntimeWarning)
        imageio.imwrite(
            path,
            even,
            plugin="FFMPEG",
            fps=per_second,
            codec="libx264",
            macro_block_size=1,
            ffmpeg_log_level="error",
        )


def write_gif(
    frames: np.ndarray, path: pathlib.Path, *, per_second: int, colors: int = 256
) -> None:
    """Writes `[T, H, W, 3]` uint8 frames as a GIF that repeats; needs no extra package.

    All frames share one palette, made from every sixth frame, and are not dithered; both keep
    the file small. The palette is an octree's, which keeps colours that few pixels have.

    Raises:
      OSError: the file could not be written.
    """
    together = Image.fromarray(np.concatenate(list(frames[::6])))
    palette = together.quantize(colors, method=Image.Quantize.FASTOCTREE)
    first, *rest = (
        Image.fromarray(frame).quantize(palette=palette, dither=Image.Dither.NONE)
        for frame in frames
    )
    first.save(path, save_all=True, append_images=rest, duration=1000 // per_second, loop=0)
