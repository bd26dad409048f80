"""Makes a film of vectors: named coordinates over time, truth against what was imagined.

It shows the first window of `vawm.analysis.trajectories`, in the units of the environment. The
lines grow with time; they are green while the world model observes, red while it imagines.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from vawm.analysis.film import INK, PAPER
from vawm.analysis.trajectories import Trajectories, vectors
from vawm.losses.transforms import symexp
from vawm.runs.reports import video

COLUMNS, ROWS = 2, 4  # panels, at most
WIDTH, HEIGHT = 320, 110  # pixels of a panel
MARGIN, TITLE = 10, 22
TRUTH = (150, 150, 150)


def frames(trajectories: Trajectories, names: Sequence[str]) -> np.ndarray:
    """The frames `[T, H, W, 3]` uint8, one per step of the window inside its episode.

    Args:
      trajectories: of observations with vectors.
      names: of all coordinates; those that vary most are shown.
    """
    inside = trajectories.inside[0]
    truth, guess = (np.asarray(symexp(x[0][inside])) for x in vectors(trajectories))
    most = np.argsort(-truth.std(0), kind="stable")[: COLUMNS * ROWS]
    moving = np.sort(most)
    columns = min(COLUMNS, len(moving))
    rows = -(-len(moving) // columns)
    size = columns * WIDTH, TITLE + rows * HEIGHT
    pictures = []
    for step in range(1, len(truth) + 1):
        canvas = Image.new("RGB", size, PAPER)
        draw = ImageDraw.Draw(canvas)
        _head(draw, step - trajectories.context, size[0])
        for i, coordinate in enumerate(moving):
            corner = WIDTH * (i % columns), TITLE + HEIGHT * (i // columns)
            lines = truth[:, coordinate], guess[:, coordinate]
            _panel(draw, corner, names[coordinate], lines, step, trajectories.context)
        pictures.append(np.asarray(canvas))
    return np.stack(pictures)


def _head(draw: ImageDraw.ImageDraw, ahead: int, width: int) -> None:
    color = video.IMAGINED if ahead > 0 else video.SEEN
    text = f"world model imagines, step {ahead}" if ahead > 0 else "world model observes"
    font = ImageFont.load_default(size=13)
    draw.text((width * 0.35, TITLE / 2), "truth", fill=TRUTH, font=font, anchor="mm")
    draw.text((width * 0.6, TITLE / 2), text, fill=color, font=font, anchor="mm")


def _panel(
    draw: ImageDraw.ImageDraw,
    corner: tuple[int, int],
    name: str,
    lines: tuple[np.ndarray, np.ndarray],
    step: int,
    context: int,
) -> None:
    """One coordinate up to `step`, on an axis that fits the whole window."""
    low, high = (float(f(np.concatenate(lines))) for f in (np.min, np.max))
    room = max(high - low, 1e-6)
    left, top = corner[0] + MARGIN, corner[1] + TITLE
    width, height = WIDTH - 2 * MARGIN, HEIGHT - TITLE - MARGIN

    def points(line: np.ndarray, start: int, end: int) -> list[tuple[float, float]]:
        return [
            (left + width * t / max(1, len(line) - 1), top + height * (high - line[t]) / room)
            for t in range(start, end)
        ]

    font = ImageFont.load_default(size=12)
    draw.rectangle((left, top, left + width, top + height), outline=(225, 225, 225))
    draw.text((left, corner[1] + TITLE / 2), name, fill=INK, font=font, anchor="lm")
    bounds = f"{low:.2g} to {high:.2g}"
    draw.text((left + width, corner[1] + TITLE / 2), bounds, fill=TRUTH, font=font, anchor="rm")
    truth, guess = lines
    draw.line(points(truth, 0, step), fill=TRUTH, width=3)
    draw.line(points(guess, 0, min(step, context)), fill=video.SEEN, width=2)
    draw.line(points(guess, context - 1, step), fill=video.IMAGINED, width=2)
