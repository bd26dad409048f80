"""Learning curves: a panel per task and quantity, a colour per variant."""

from __future__ import annotations

import itertools
import pathlib
from collections.abc import Sequence
from typing import Any, Literal

import numpy as np

from vawm.analysis.curves import aligned
from vawm.analysis.figures import panels
from vawm.sweep.results import Rows, missing, of_run
from vawm.sweep.runs import Run, Sweep

OF_MANY_SIZES = ("weight",)
"""Columns whose axis is linear up to 1 and logarithmic above."""


def plot(
    rows: Rows,
    sweep: Sweep,
    path: pathlib.Path,
    *,
    quantities: Sequence[str] = ("return",),
    label: str = "{}",
    seeds: Literal["lines", "band"] = "lines",
    returns: tuple[float, float] | None = None,
) -> None:
    """Draws `rows` of `results.read` and writes a PNG.

    Args:
      rows: the measurements.
      sweep: the sweep with their tasks, variants and seeds.
      path: of the PNG.
      quantities: columns, with a row of panels each.
      label: of a variant in the legend, with `{}` for its name.
      seeds: "lines" for a line per seed; "band" for the mean of the seeds in the table, with
        a band from the lowest to the highest.
      returns: limits of the axis of returns; from the data if None.
    """
    draw = {"lines": _lines, "band": _band}[seeds]
    with panels(path, len(quantities), len(sweep.tasks), size=(4.5, 3.2)) as axes:
        for (quantity, task), ax in zip(
            itertools.product(quantities, sweep.tasks), axes.ravel(), strict=True
        ):
            for color, variant in enumerate(sweep.variants):
                owned = [Run(task, variant.name, seed) for seed in sweep.seeds]
                # In a band, an unfinished run would cut off the curves of the others.
                left_out = [
                    run for run in owned if seeds == "band" and missing(sweep, rows, run)
                ]
                curves = [
                    [] if run in left_out else of_run(rows, run, quantity) for run in owned
                ]
                draw(ax, curves, quantity, f"C{color}", label.format(variant.name))
            named = quantity.replace("_", " ")
            ax.set(title=task, xlabel="thousand environment steps", ylabel=named)
            if quantity in OF_MANY_SIZES:
                ax.set_yscale("symlog", linthresh=1)
            if seeds == "band" or ax is axes[0, 0]:
                ax.legend(**_place(len(sweep.variants)))
            if quantity == "return" and returns is not None:
                ax.set_ylim(*returns)


def _place(lines: int) -> dict[str, Any]:
    """The place of a legend with this many lines: beside the panel if it is large."""
    return {"loc": "upper left", "bbox_to_anchor": (1, 1)} if lines > 4 else {}


def _lines(panel, curves: Sequence[Rows], quantity: str, color: str, label: str) -> None:
    for number, rows in enumerate(curves):
        steps = [row["env_steps"] / 1000 for row in rows]
        values = [row[quantity] for row in rows]
        panel.plot(steps, values, color=color, label=None if number else label)


def _band(panel, curves: Sequence[Rows], quantity: str, color: str, label: str) -> None:
    """Draws mean and band; the legend has the number of seeds if some are missing."""
    steps, values = interpolated([rows for rows in curves if rows], quantity)
    if len(values) < len(curves):
        label += f" ({len(values)} of {len(curves)} seeds)"
    panel.plot(steps / 1000, values.mean(0) if len(values) else [], color=color, label=label)
    if len(values) > 1:
        low, high = values.min(0), values.max(0)
        panel.fill_between(steps / 1000, low, high, color=color, alpha=0.2, linewidth=0)


def interpolated(curves: Sequence[Rows], quantity: str) -> tuple[np.ndarray, np.ndarray]:
    """`aligned` values of a quantity: `[N]` env steps and `[S, N]`; empty without curves."""
    if not curves:
        return np.zeros(0), np.zeros((0, 0))
    return aligned(
        [np.array([(row["env_steps"], row[quantity]) for row in own]).T for own in curves]
    )
