"""The metrics of a sweep's runs: rows, aggregates over seeds, tables."""

from __future__ import annotations

import itertools
import statistics
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from vawm.analysis.values import mean_and_error
from vawm.runs.reports import tracking
from vawm.runs.runner import RunError
from vawm.sweep import runs
from vawm.sweep.runs import Run, Sweep

Rows = list[dict[str, Any]]

RETURN = {"return": "episode/return"}
"""Column -> metric, for every sweep."""


class Summary(NamedTuple):
    """One variant in one task; lists have one entry per seed with a finished run.

    Attributes:
      task, variant: their names.
      seeds: seeds with a finished run.
      missing: other seed -> why it is missing.
      last: the last return.
      best: the highest return.
      area: the area under the curve of returns per env step: the mean return.
      minutes: wall time of the run.
      late: other column -> means over the last tenth of the runs that have it.
    """

    task: str
    variant: str
    seeds: tuple[int, ...]
    missing: dict[int, str]
    last: list[float]
    best: list[float]
    area: list[float]
    minutes: list[float]
    late: dict[str, list[float]]


def read(sweep: Sweep, columns: Mapping[str, str] = RETURN) -> Rows:
    """A row per line of metrics with at least one of `columns`; missing ones are None.

    Stops at the sweep's length if a run is longer.
    """
    rows = []
    for run in runs.all_runs(sweep):
        path = runs.folder(sweep, run) / "metrics.jsonl"
        length, reached = runs.env_steps(sweep, run), 0
        for metrics in tracking.read(path):
            if length is not None and reached >= length:
                break
            reached = metrics["env_steps"]
            measured = {
                name: rounded(name, metrics.get(metric)) for name, metric in columns.items()
            }
            if any(value is not None for value in measured.values()):
                counted = {name: metrics[name] for name in ("env_steps", "updates")}
                minutes = round(metrics["time"] / 60, 2)
                rows.append(vars(run) | counted | {"minutes": minutes} | measured)
    return rows


def read_some(sweep: Sweep, columns: Mapping[str, str] = RETURN) -> Rows:
    """`read`, but refuses to replace earlier results by empty ones.

    Raises:
      RunError: there are no metrics yet.
    """
    if rows := read(sweep, columns):
        return rows
    raise RunError(f"no run in {sweep.folder} has any metrics yet; no results were written")


def rounded(column: str, value: float | None) -> float | None:
    """Rounds returns to one decimal, all else to 5 digits."""
    if value is None:
        return None
    return round(value, 1) if column == "return" else float(f"{value:.5g}")


def of_run(rows: Rows, run: Run, column: str = "return") -> Rows:
    """The rows of one run that have `column`."""
    return [row for row in rows if row.items() >= vars(run).items() and row[column] is not None]


def area(rows: Rows) -> float:
    """Area under the returns per env step, by the trapezoidal rule; needs at least one row."""
    width = rows[-1]["env_steps"] - rows[0]["env_steps"]
    if not width:
        return rows[0]["return"]
    parts = [
        (b["env_steps"] - a["env_steps"]) * (a["return"] + b["return"]) / 2
        for a, b in itertools.pairwise(rows)
    ]
    return sum(parts) / width


def late_mean(rows: Rows, column: str) -> float:
    """Mean of a column over the last tenth of a run's env steps; needs at least one row."""
    end = rows[-1]["env_steps"]
    return statistics.fmean(row[column] for row in rows if end - row["env_steps"] < end / 10)


def missing(sweep: Sweep, rows: Rows, run: Run) -> str | None:
    """Why a run is missing from the table; None if it is not."""
    own, length = of_run(rows, run), runs.env_steps(sweep, run)
    if not own or length is None:
        return "has no returns"
    if own[-1]["env_steps"] < length and not runs.finished(sweep, run):
        return f"is at {own[-1]['env_steps']:,} of {length:,} env steps"
    return None


def summarise(sweep: Sweep, rows: Rows, columns: Mapping[str, str] = RETURN) -> list[Summary]:
    """A summary for each task and variant, with the missing seeds."""
    summaries = []
    for task in sweep.tasks:
        for variant in sweep.variants:
            chosen = {seed: Run(task, variant.name, seed) for seed in sweep.seeds}
            absent = {seed: missing(sweep, rows, run) for seed, run in chosen.items()}
            counted = [run for seed, run in chosen.items() if absent[seed] is None]
            returns = [of_run(rows, run) for run in counted]
            late = {
                name: [
                    late_mean(own, name) for run in counted if (own := of_run(rows, run, name))
                ]
                for name in columns
                if name not in RETURN
            }
            summaries.append(
                Summary(
                    task=task,
                    variant=variant.name,
                    seeds=tuple(run.seed for run in counted),
                    missing={seed: why for seed, why in absent.items() if why is not None},
                    last=[own[-1]["return"] for own in returns],
                    best=[max(row["return"] for row in own) for own in returns],
                    area=[area(own) for own in returns],
                    minutes=[own[-1]["minutes"] for own in returns],
                    late=late,
                )
            )
    return summaries


def with_error(values: Sequence[float]) -> str:
    """Mean and its standard error; only the mean for a single value."""
    if not values:
        return "-"
    mean, error = mean_and_error(np.asarray(values))
    style = ".1f" if abs(mean) >= 10 else ".3g"
    return f"{mean:{style}}" if np.isnan(error) else f"{mean:{style}} +- {error:{style}}"


def markdown(summaries: Sequence[Summary], *, factor: str, command: str, notes: str) -> str:
    """A table of means over seeds, with the missing seeds and the command that made it.

    Args:
      summaries: at least one.
      factor: what differs between variants, as a column heading.
      command: that makes the table again.
      notes: a paragraph before the table.
    """
    names = [name.replace("_", " ") for name in summaries[0].late]
    heads = ["task", factor, "seeds", "last return", "best", "mean return", *names, "minutes"]
    lines = [notes, "", line(heads), line(["---"] * len(heads))]
    for s in summaries:
        total = len(s.seeds) + len(s.missing)
        count = f"{total}" if not s.missing else f"**{len(s.seeds)} of {total}**"
        measured = [s.last, s.best, s.area, *s.late.values()]
        minutes = f"{statistics.mean(s.minutes):.1f}" if s.minutes else "-"
        cells = [s.task, s.variant, count, *map(with_error, measured), minutes]
        lines.append(line(cells))
    lines.append("")
    for s in summaries:
        for seed, why in s.missing.items():
            lines.append(f"- Not in the means: {s.task}, {s.variant}, seed {seed}: {why}.")
    if any(s.missing for s in summaries):
        lines.append("")
    return "\n".join([*lines, f"Made by `{command}`.", ""])


def line(cells: Sequence[str]) -> str:
    """A line of a table in Markdown."""
    return "| " + " | ".join(cells) + " |"


def headed(rows: Rows, factor: str) -> Rows:
    """The rows of `read`, with "variant" renamed to `factor`."""
    return [{{"variant": factor}.get(name, name): row[name] for name in row} for row in rows]
