"""Which runs a sweep has, the command of each, and whether it is finished."""

from __future__ import annotations

import dataclasses
import itertools
import pathlib
import re
import sys
from collections.abc import Collection
from dataclasses import dataclass
from typing import NamedTuple

from vawm.analysis import figures as analysis_figures
from vawm.cli import command_line
from vawm.config import Config
from vawm.envs.protocol import check_positive
from vawm.errors import InvalidInput
from vawm.runs import checkpoint, resume, run_folder, suites, validate
from vawm.sweep.children import Job


class Variant(NamedTuple):
    """What is compared: its name, in tables and folders, and the flags that make it."""

    name: str
    flags: tuple[str, ...]


@dataclass(frozen=True)
class Sweep:
    """Runs that differ in variant, task and seed, and in nothing else."""

    program: pathlib.Path
    """a program of `experiments`, or one that takes the same flags"""
    folder: pathlib.Path
    """where the folders of the runs are"""
    variants: tuple[Variant, ...]
    tasks: tuple[str, ...]
    seeds: tuple[int, ...]
    flags: tuple[str, ...] = ()
    """of every run, before those of its variant"""
    env_steps: int | None = None
    """length of every run; that of its preset if None"""


@dataclass(frozen=True)
class Run:
    """One of a sweep."""

    task: str
    variant: str
    seed: int

    def __str__(self) -> str:
        return f"{self.task} {self.variant} seed={self.seed}"


def all_runs(sweep: Sweep) -> list[Run]:
    """Seeds outermost, so that an early stop leaves whole comparisons."""
    names = [variant.name for variant in sweep.variants]
    product = itertools.product(sweep.seeds, names, sweep.tasks)
    return [Run(task, name, seed) for seed, name, task in product]


def folder(sweep: Sweep, run: Run) -> pathlib.Path:
    """Where the run writes."""
    name = f"{run.task}-{run.variant}-seed{run.seed}"
    return sweep.folder / re.sub(r"[^\w.]+", "-", name)


def log(sweep: Sweep, run: Run) -> pathlib.Path:
    """Where what it prints goes."""
    path = folder(sweep, run)
    return path.with_name(path.name + ".log")


def flags(sweep: Sweep, run: Run) -> tuple[str, ...]:
    """What its program is told of the run, but for the folder."""
    own = next(variant.flags for variant in sweep.variants if variant.name == run.variant)
    length = () if sweep.env_steps is None else ("--env-steps", str(sweep.env_steps))
    return ("--task", run.task, "--seed", str(run.seed), *sweep.flags, *own, *length)


def command(sweep: Sweep, run: Run) -> list[str]:
    """What begins the run, or goes on with it where it was begun."""
    path = folder(sweep, run)
    again = [] if run_folder.read_config(path) is None else ["--resume"]
    words = [*flags(sweep, run), "--logdir", str(path), *again]
    return [sys.executable, str(sweep.program), *words]


def finished(sweep: Sweep, run: Run) -> bool:
    """Whether the newest checkpoint is at the end already."""
    newest, length = checkpoint.latest(folder(sweep, run)), env_steps(sweep, run)
    return newest is not None and length is not None and int(newest.name) >= length


def env_steps(sweep: Sweep, run: Run) -> int | None:
    """How long the run is to be; None where only its preset knows, and it was not begun."""
    if sweep.env_steps is not None:
        return sweep.env_steps
    config = run_folder.read_config(folder(sweep, run))
    return config.env_steps if config else None


def unfinished_jobs(sweep: Sweep) -> list[Job]:
    """What is left to do."""
    return [
        Job(str(run), command(sweep, run), log(sweep, run))
        for run in all_runs(sweep)
        if not finished(sweep, run)
    ]


def check(sweep: Sweep, suite: str) -> None:
    """Refuses what would only fail in every run, or after hours of them.

    Raises:
      InvalidInput: names the option, its value and the remedy.
    """
    for name in ("tasks", "seeds"):
        check_distinct(name, getattr(sweep, name))
    for variant in sweep.variants:
        config = parsed(sweep, Run(sweep.tasks[0], variant.name, sweep.seeds[0]), suite)
        for seed in sweep.seeds:
            validate.check(dataclasses.replace(config, seed=seed))
        for task in sweep.tasks:
            suites.check_task(dataclasses.replace(config, task=task))
        for run in all_runs(sweep):
            if run.variant == variant.name:
                own = dataclasses.replace(config, task=run.task, seed=run.seed)
                check_begun(folder(sweep, run), own)


def check_begun(path: pathlib.Path, config: Config) -> None:
    """Refuses a run that was begun with other settings than it would begin with now.

    It keeps its own when it is resumed, so a table would mix them. That happens when a sweep
    of a small preset is made longer: the warm-up of value alignment follows the length of a
    run, and those that were begun before have a shorter one than those that were not.

    Raises:
      InvalidInput: names the first setting that differs.
    """
    begun = run_folder.read_config(path)
    if begun is None:
        return
    saved = dict(validate.values(begun))
    for name, value in validate.values(config):
        if name not in resume.MAY_DIFFER and value != saved.get(name):
            remedy = f"{path} was begun with {saved.get(name)!r}; use another --runs"
            if begun.env_steps != config.env_steps:
                remedy += f", or its --env-steps {begun.env_steps}"
            raise InvalidInput(name, value, remedy)


def parsed(sweep: Sweep, run: Run, suite: str) -> Config:
    """The config that the flags of the run amount to."""
    return command_line.parse(flags(sweep, run), suite=suite, description="").config


def check_distinct(name: str, values: Collection) -> None:
    """Refuses an option of which there is none, or something twice."""
    if not values or len(set(values)) < len(values):
        raise InvalidInput(name, values, "use at least one, and each once")


def check_places(*, jobs: int, runs: pathlib.Path | None, results: pathlib.Path) -> None:
    """Refuses folders that cannot be written to, and figures that cannot be drawn.

    Args:
      jobs: runs side by side.
      runs: None where none will be started.
      results: where tables and figures go.

    Raises:
      InvalidInput: names the option, its value and the remedy.
      RunError: matplotlib is missing.
    """
    check_positive("jobs", jobs)
    run_folder.check_writable(results, "results")
    if runs is not None:
        run_folder.check_writable(runs, "runs")
    analysis_figures.check()
