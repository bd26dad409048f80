"""Losses and the weight of value alignment in training, from `metrics.jsonl`: Figs 8, 9, 12.

Runs that differ in nothing but their seed, and in what a resumed run may change, are one group:
its curve is their mean, with the lowest and the highest of them around it.
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
"""Dynamics loss, that of VaGraM, and KL; L_var of Eq. 4 without its weight, logged also where
it is off; the KL of the critic's distributions; the weight of Eq. 5."""


class Run(NamedTuple):
    """What a folder holds: the choices of a run, and its lines of metrics."""

    config: Config
    lines: list[Line]


class Curve(NamedTuple):
    """One metric of one group of runs, over env steps; all `[P]` but the number of seeds."""

    env_steps: np.ndarray
    mean: np.ndarray
    low: np.ndarray
    high: np.ndarray
    seeds: int


def read(logdir: pathlib.Path) -> Run:
    """The run in `logdir`.

    Raises:
      InvalidInput: there is none that measured anything.
    """
    config, path = run_folder.read_config(logdir), logdir / "metrics.jsonl"
    lines = tracking.read(path) if path.exists() else []
    if config is None or not lines:
        remedy = "holds no metrics; name the folder of a run that wrote some"
        raise InvalidInput("logdirs", str(logdir), remedy)
    return Run(config, lines)


def describe(config: Config) -> str:
    """Task, agent, and what its value alignment is."""
    alignment = config.value_alignment
    weight = f" {alignment.static_weight:g}" if alignment.weight == "static" else ""
    return f"{config.task}, {config.agent}, alignment {alignment.weight}{weight}"


class Configured(Protocol):
    """A run, whatever else is known of it."""

    @property
    def config(self) -> Config: ...


AnyRun = TypeVar("AnyRun", bound=Configured)


def group(runs: Sequence[AnyRun]) -> dict[str, list[AnyRun]]:
    """Runs by what they share, in the order of the first of each.

    Groups of one description that differ in other choices get numbers.
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
    """All that the runs of a group have in common."""
    free = {"seed", *resume.MAY_DIFFER}
    return {name: value for name, value in validate.values(config) if name not in free}


def curve(runs: Sequence[Run], metric: str) -> Curve | None:
    """Mean and range of a metric over runs; None where some run never measured it.

    On the env steps of all of them, where all have begun and none has ended; between its own
    lines a run is interpolated linearly.
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
    """`[P]` steps at which any of the series has a value and which all reach around, and
    `[S, P]` the values of each there, straight between its own.

    Args:
      series: each `[2, n]`, steps and values; at least one, none empty.
    """
    begin, end = max(s[0][0] for s in series), min(s[0][-1] for s in series)
    steps = np.unique(np.concatenate([s[0] for s in series]))
    steps = steps[(steps >= begin) & (steps <= end)]
    return steps, np.stack([np.interp(steps, *s) for s in series])


Curves = dict[str, dict[str, Curve]]
"""Group -> metric -> curve; metrics that were not measured are left out."""


def curves(groups: Mapping[str, Sequence[Run]]) -> Curves:
    """All of `METRICS`."""
    found = {
        name: {metric: curve(runs, metric) for metric in METRICS}
        for name, runs in groups.items()
    }
    return {
        name: {metric: c for metric, c in own.items() if c is not None}
        for name, own in found.items()
    }


def rows(all_curves: Curves) -> list[dict[str, Any]]:
    """For a CSV: one row per group, metric and point."""
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
