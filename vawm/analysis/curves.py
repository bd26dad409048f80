"""Losses and the weight of value alignment in training, from `metrics.jsonl`: Figs 8, 9, 12.

Runs that differ only in their seed, or in fields that a resumed run may change, are one group.
The curve of a group is the mean over its runs, with a band from the lowest to the highest run.
"""

from __future__ import annotations

import pathlib
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple, Protocol, TypeVar

import numpy as np

from vawm.config import Config
from vawm.errors import InvalidInput
from vawm.runs import resume, run_folder, validate
from vawm.runs.reports import tracking
from vawm.runs.reports.tracking import Line

METRICS = (
    "loss/dynamics",
    "loss/value_gradient",
    "latent/kl",
    "value_alignment/loss",
    "value_alignment/kl",
    "value_alignment/weight",
)
"""The dynamics loss, the loss of VaGraM, the KL of z; L_var of Eq. 4 without its weight (also
logged if it is off), the KL of the critic's distributions, the weight of Eq. 5."""


class Run(NamedTuple):
    """A run's config and its lines of metrics."""

    config: Config
    lines: list[Line]


class Curve(NamedTuple):
    """One metric of one group of runs over env steps; all `[P]` except `seeds`."""

    env_steps: np.ndarray
    mean: np.ndarray
    low: np.ndarray
    high: np.ndarray
    seeds: int


def read(logdir: pathlib.Path) -> Run:
    """Reads the run in `logdir`.

    Raises:
      InvalidInput: there is no run, or it has no metrics.
    """
    config, path = run_folder.read_config(logdir), logdir / "metrics.jsonl"
    lines = tracking.read(path) if path.exists() else []
    if config is None or not lines:
        remedy = "contains no metrics; use the folder of a run that has written some"
        raise InvalidInput("logdirs", str(logdir), remedy)
    return Run(config, lines)


def describe(config: Config) -> str:
    """Task, agent, and kind of value alignment."""
    alignment = config.value_alignment
    weight = f" {alignment.static_weight:g}" if alignment.weight == "static" else ""
    return f"{config.task}, {config.agent}, alignment {alignment.weight}{weight}"


class Configured(Protocol):
    """Anything with the config of a run."""

    @property
    def config(self) -> Config: ...


AnyRun = TypeVar("AnyRun", bound=Configured)


def group(runs: Sequence[AnyRun]) -> dict[str, list[AnyRun]]:
    """Groups runs by their common choices, in the order of each group's first run.

    Groups with the same description that differ in other choices are numbered.
    """
    groups: list[list[AnyRun]] = []
    for run in runs:
        own = next((g for g in groups if _alike(g[0].config, run.config)), None)
        if own is None:
            groups.append([run])
        else:
            own.append(run)
    names = [describe(runs[0].config) for runs in groups]
    numbered = [
        name if names.count(name) == 1 else f"{name} ({names[: i + 1].count(name)})"
        for i, name in enumerate(names)
    ]
    return dict(zip(numbered, groups, strict=True))


def _alike(a: Config, b: Config) -> bool:
    return _choices(a) == _choices(b)


def _choices(config: Config) -> dict[str, Any]:
    """The choices that the runs of a group have in common."""
    free = {"seed", *resume.MAY_DIFFER}
    return {name: value for name, value in validate.values(config) if name not in free}


def curve(runs: Sequence[Run], metric: str) -> Curve | None:
    """Mean and range of a metric over runs; None if a run never measured it.

    Covers the env steps of all runs in their common range; a run is interpolated linearly
    between its lines.
    """
    points = [
        [
            (line["env_steps"], line[metric])
            for line in run.lines
            if line.get(metric) is not None
        ]
        for run in runs
    ]
    if not all(points):
        return None
    steps, values = aligned([np.asarray(own, np.float64).T for own in points])
    if not len(steps):
        return None
    return Curve(steps, values.mean(0), values.min(0), values.max(0), len(runs))


def aligned(series: Sequence[np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Interpolates series linearly onto common steps.

    Args:
      series: each `[2, n]`, steps and values; at least one, none empty.

    Returns:
      `[P]` the steps of all series within their common range, and `[S, P]` the value of each
      series there.
    """
    begin, end = max(s[0][0] for s in series), min(s[0][-1] for s in series)
    steps = np.unique(np.concatenate([s[0] for s in series]))
    steps = steps[(steps >= begin) & (steps <= end)]
    return steps, np.stack([np.interp(steps, *s) for s in series])


Curves = dict[str, dict[str, Curve]]
"""Group -> metric -> curve, without metrics that were not measured."""


def curves(groups: Mapping[str, Sequence[Run]]) -> Curves:
    """The curves of all `METRICS`."""
    found = {
        name: {metric: curve(runs, metric) for metric in METRICS}
        for name, runs in groups.items()
    }
    return {
        name: {metric: c for metric, c in own.items() if c is not None}
        for name, own in found.items()
    }


def rows(all_curves: Curves) -> list[dict[str, Any]]:
    """Rows for a CSV, one per group, metric and point."""
    return [
        {
            "group": name,
            "metric": metric,
            "env_steps": int(line.env_steps[i]),
            "mean": float(line.mean[i]),
            "min": float(line.low[i]),
            "max": float(line.high[i]),
            "seeds": line.seeds,
        }
        for name, own in all_curves.items()
        for metric, line in own.items()
        for i in range(len(line.env_steps))
    ]
