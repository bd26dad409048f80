"""The runs of a sweep, the command of each, and whether it is finished."""

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
    """One side of a comparison: its name in tables and folders, and its flags."""

    name: str
    flags: tuple[str, ...]


@dataclass(frozen=True)
class Sweep:
    """Runs that differ only in variant, task and seed."""

    program: tuple[str, ...]
    """words that start a program which trains, or one that takes the same flags"""
    folder: pathlib.Path
    """parent of the folders of the runs"""
    variants: tuple[Variant, ...]
    tasks: tuple[str, ...]
    seeds: tuple[int, ...]
    flags: tuple[str, ...] = ()
    """of all runs; those of a variant come after them"""
    env_steps: int | None = None
    """length of a run; None for the length in its preset"""


@dataclass(frozen=True)
class Run:
    """One run of a sweep."""

    task: str
    variant: str
    seed: int

    def __str__(self) -> str:
        return f"{self.task} {self.variant} seed={self.seed}"


def trains(suite: str) -> tuple[str, ...]:
    """The words that start the program of a suite, in this Python."""
    return sys.executable, "-m", "vawm", "train", suite


def named_tasks(suite: str, tasks: tuple[str, ...]) -> tuple[str, ...]:
    """The tasks of a sweep as they were asked for; `all` stands for all of the suite.

    Raises:
      InvalidInput: `all`, where nobody can list them.
    """
    if tasks != ("all",):
        return tasks
    if not suites.SUITES[suite].tasks:
        raise InvalidInput("tasks", "all", f"{suite} has no list of its tasks; name them")
    return suites.SUITES[suite].tasks


def all_runs(sweep: Sweep) -> list[Run]:
    """All runs, ordered by seed: a sweep that stops early has complete comparisons."""
    names = [variant.name for variant in sweep.variants]
    product = itertools.product(sweep.seeds, names, sweep.tasks)
    return [Run(task, name, seed) for seed, name, task in product]


def folder(sweep: Sweep, run: Run) -> pathlib.Path:
    """The folder of a run."""
    name = f"{run.task}-{run.variant}-seed{run.seed}"
    return sweep.folder / re.sub(r"[^\w.]+", "-", name)


def log(sweep: Sweep, run: Run) -> pathlib.Path:
    """The file that takes the output of a run."""
    path = folder(sweep, run)
    return path.with_name(path.name + ".log")


def flags(sweep: Sweep, run: Run) -> tuple[str, ...]:
    """The flags of a run, without its folder."""
    own = next(variant.flags for variant in sweep.variants if variant.name == run.variant)
    length = () if sweep.env_steps is None else ("--env-steps", str(sweep.env_steps))
    return ("--task", run.task, "--seed", str(run.seed), *sweep.flags, *own, *length)


def command(sweep: Sweep, run: Run) -> list[str]:
    """The command that starts the run, or resumes it."""
    path = folder(sweep, run)
    again = [] if run_folder.read_config(path) is None else ["--resume"]
    words = [*flags(sweep, run), "--logdir", str(path), "--no-film", *again]
    return [*sweep.program, *words]


def finished(sweep: Sweep, run: Run) -> bool:
    """Whether the newest checkpoint is at the end of the run."""
    newest, length = checkpoint.latest(folder(sweep, run)), env_steps(sweep, run)
    return newest is not None and length is not None and int(newest.name) >= length


def env_steps(sweep: Sweep, run: Run) -> int | None:
    """Length of the run; None if it is that of the preset and the run was not started."""
    if sweep.env_steps is not None:
        return sweep.env_steps
    config = run_folder.read_config(folder(sweep, run))
    return config.env_steps if config else None


def unfinished_jobs(sweep: Sweep) -> list[Job]:
    """A job for each run that is not finished."""
    return [
        Job(str(run), command(sweep, run), log(sweep, run), folder(sweep, run))
        for run in all_runs(sweep)
        if not finished(sweep, run)
    ]


def check(sweep: Sweep, suite: str) -> None:
    """Refuses what would fail in every run, or only after hours.

    Raises:
      InvalidInput: names the option, its value and the remedy.
    """
    for name in ("tasks", "seeds"):
        check_distinct(name, getattr(sweep, name))
    for variant in sweep.variants:
        config = parsed(sweep, Run(sweep.tasks[0], variant.name, sweep.seeds[0]), suite)
        for task in sweep.tasks:
            suites.check_task(dataclasses.replace(config, task=task))
        for seed in sweep.seeds:
            validate.check(dataclasses.replace(config, seed=seed))
        check_episodes(config)
        for run in all_runs(sweep):
            if run.variant == variant.name:
                own = dataclasses.replace(config, task=run.task, seed=run.seed)
                check_started(folder(sweep, run), own)


def check_episodes(config: Config) -> None:
    """Refuses a run in which no episode can end, so that it would have no return.

    Raises:
      InvalidInput: names the length of the run, and the smallest that has a return.
    """
    steps = suites.of(config).episode_steps
    if steps is None or config.env_steps >= steps * config.num_envs:
        return
    remedy = (
        f"no episode ends in such a run, so it has no return: {steps} control steps in each of "
        f"{config.num_envs} environments; use at least {steps * config.num_envs}, or fewer "
        "--num-envs"
    )
    raise InvalidInput("env_steps", config.env_steps, remedy)


def check_started(path: pathlib.Path, config: Config) -> None:
    """Refuses a run that was started with other settings than `config`.

    A resumed run keeps its settings, so one table would mix two of them. This happens when a
    sweep of a small preset is made longer: the warm-up of value alignment is a share of the
    length, so runs that were started before have a shorter warm-up than new ones.

    Raises:
      InvalidInput: names the first setting that differs.
    """
    started = run_folder.read_config(path)
    if started is None:
        return
    saved = dict(validate.values(started))
    for name, value in validate.values(config):
        if name not in resume.MAY_DIFFER and value != saved.get(name):
            remedy = f"{path} was started with {saved.get(name)!r}; use another --runs"
            if started.env_steps != config.env_steps:
                remedy += f", or its --env-steps {started.env_steps}"
            raise InvalidInput(name, value, remedy)


def parsed(sweep: Sweep, run: Run, suite: str) -> Config:
    """The config that the flags of a run give."""
    return command_line.parse(flags(sweep, run), suite=suite, description="").config


def check_distinct(name: str, values: Collection) -> None:
    """Refuses an empty option, and one that names something twice."""
    if not values or len(set(values)) < len(values):
        raise InvalidInput(name, values, "use at least one, and each only once")


def check_places(*, jobs: int, runs: pathlib.Path | None, results: pathlib.Path) -> None:
    """Refuses folders that are not writable, and a missing matplotlib.

    Args:
      jobs: number of runs at the same time.
      runs: folder of the runs; None if none will be started.
      results: folder of tables and figures.

    Raises:
      InvalidInput: names the option, its value and the remedy; or matplotlib is missing.
    """
    check_positive("jobs", jobs)
    run_folder.check_writable(results, "results")
    if runs is not None:
        run_folder.check_writable(runs, "runs")
    analysis_figures.check()
