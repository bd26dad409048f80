"""Learning curves of an experiment: tasks x seeds, with and without value alignment.

    python experiments/learning_curves.py --jobs 2
    python experiments/learning_curves.py --experiment gymnasium_task --preset pixels
    python experiments/learning_curves.py --agent storm --tasks cartpole_balance

Runs what is missing under `--runs`, `--jobs` at a time (on Linux each on cores of its own),
and writes `curves_<experiment>.csv` and `.png` to `--results`, of another agent than dreamerv3
`curves_<experiment>_<agent>`. Interrupted runs are resumed,
finished ones left alone.
"""

from __future__ import annotations

import csv
import dataclasses
import importlib.util
import itertools
import os
import pathlib
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

from vawm import checkpoint, command_line, flags, rundir, suites, tracking, validate
from vawm.envs.protocol import check_positive
from vawm.errors import InvalidInput
from vawm.runner import RunError


class Experiment(NamedTuple):
    """A program beside this one: its suite, and the tasks whose curves are usually wanted."""

    suite: str
    tasks: tuple[str, ...]


EXPERIMENTS = {
    "dmc_proprio": Experiment("dmc_proprio", ("cartpole_swingup", "cartpole_balance")),
    "dmc_vision": Experiment("dmc_vision", ("cartpole_balance",)),
    "atari100k": Experiment("atari100k", ("breakout",)),
    "gymnasium_task": Experiment("gymnasium", ("vawm/GridWorld-v0",)),
}
RESULTS = pathlib.Path(__file__).with_name("results")
COLUMNS = ("task", "alignment", "seed", "env_steps", "updates", "minutes", "return")


@dataclass(frozen=True)
class Options:
    """Which runs, and where they go."""

    experiment: Literal["dmc_proprio", "dmc_vision", "atari100k", "gymnasium_task"] = (
        "dmc_proprio"
    )
    """the program that trains"""
    agent: Literal["dreamerv3", "storm"] = "dreamerv3"
    tasks: tuple[str, ...] = ()
    """as many as are named; the usual ones of the experiment if none"""
    seeds: tuple[int, ...] = (0, 1, 2)
    alignments: tuple[str, ...] = ("adaptive", "off")
    """values of --value-alignment.weight"""
    preset: str = "quick"
    env_steps: int | None = None
    """length of every run; that of the preset if not given"""
    jobs: int = 1
    """runs side by side"""
    runs: pathlib.Path = pathlib.Path("runs/learning_curves")
    results: pathlib.Path = RESULTS
    collect_only: bool = False
    """write the results of the runs that are there, and start none"""

    @property
    def chosen_tasks(self) -> tuple[str, ...]:
        return self.tasks or EXPERIMENTS[self.experiment].tasks

    @property
    def suite(self) -> str:
        return EXPERIMENTS[self.experiment].suite

    @property
    def name(self) -> str:
        """Of the folder of its runs, and in the names of its results."""
        suffix = "" if self.agent == "dreamerv3" else f"_{self.agent}"
        return self.experiment + suffix

    def result(self, ending: str) -> pathlib.Path:
        """Where a file of results goes."""
        return self.results / f"curves_{self.name}.{ending}"


@dataclass(frozen=True)
class Run:
    task: str
    alignment: str
    seed: int

    def folder(self, options: Options) -> pathlib.Path:
        name = f"{self.task.replace('/', '-')}-{self.alignment}-seed{self.seed}"
        return options.runs / options.name / name

    def command(self, options: Options) -> list[str]:
        folder = self.folder(options)
        arguments = {
            "--agent": options.agent,
            "--task": self.task,
            "--preset": options.preset,
            "--seed": str(self.seed),
            "--value-alignment.weight": self.alignment,
            "--logdir": str(folder),
        }
        if options.env_steps is not None:
            arguments["--env-steps"] = str(options.env_steps)
        resume = [] if rundir.read_config(folder) is None else ["--resume"]
        program = pathlib.Path(__file__).with_name(f"{options.experiment}.py")
        return [sys.executable, str(program), *itertools.chain(*arguments.items()), *resume]

    def finished(self, options: Options) -> bool:
        """Whether the newest checkpoint is at the end already."""
        folder = self.folder(options)
        newest, config = checkpoint.latest(folder), rundir.read_config(folder)
        if newest is None or config is None:
            return False
        return int(newest.name) >= (options.env_steps or config.env_steps)


def all_runs(options: Options) -> list[Run]:
    """Seeds outermost, so that an early stop leaves whole comparisons."""
    product = itertools.product(options.seeds, options.alignments, options.chosen_tasks)
    return [Run(task, alignment, seed) for seed, alignment, task in product]


def check(options: Options) -> None:
    """Refuses what would only fail in every run, or after hours of them.

    Raises:
      InvalidInput: names the option, its value and the remedy.
      RunError: a package is missing.
    """
    config = validate.preset(options.agent, options.suite, options.preset)
    if options.env_steps is not None:
        config = dataclasses.replace(config, env_steps=options.env_steps)
    for seed in options.seeds:
        validate.check(dataclasses.replace(config, seed=seed))
    weights = flags.choices(type(config.value_alignment), "weight")
    for weight in options.alignments:
        validate.check_choice("alignments", weight, weights)
    for task in options.chosen_tasks:
        suites.check_task(dataclasses.replace(config, task=task))
    chosen = {"tasks": options.chosen_tasks, "seeds": options.seeds}
    for name, values in (chosen | {"alignments": options.alignments}).items():
        if not values or len(set(values)) < len(values):
            raise InvalidInput(name, values, "use at least one, and each once")
    check_positive("jobs", options.jobs)
    rundir.check_writable(options.results, "results")
    if not options.collect_only:
        rundir.check_writable(options.runs, "runs")
    if importlib.util.find_spec("matplotlib") is None:
        raise RunError("matplotlib is missing: pip install matplotlib (or vawm[notebooks])")


def train(options: Options) -> dict[Run, int]:
    """Keeps `jobs` runs going, each with its share of the cores.

    Returns:
      The exit codes other than 0.
    """
    cores = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []
    shares = [cores[i :: options.jobs] for i in range(options.jobs)]
    waiting = [run for run in all_runs(options) if not run.finished(options)]
    running, failed = dict[int, tuple[Run, subprocess.Popen]](), dict[Run, int]()
    while waiting or running:
        for slot in range(options.jobs):
            if slot in running and running[slot][1].poll() is not None:
                run, process = running.pop(slot)
                print(f"{run}: exit code {process.returncode}", flush=True)
                if process.returncode:
                    failed[run] = process.returncode
            if slot not in running and waiting:
                running[slot] = waiting[0], start(waiting.pop(0), options, shares[slot])
        time.sleep(1)
    return failed


def start(run: Run, options: Options, cores: list[int]) -> subprocess.Popen:
    folder = run.folder(options)
    folder.parent.mkdir(parents=True, exist_ok=True)
    log = folder.with_suffix(".log").open("a")
    pin = (lambda: os.sched_setaffinity(0, cores)) if cores else None
    return subprocess.Popen(run.command(options), stdout=log, stderr=log, preexec_fn=pin)


def read(options: Options) -> list[dict]:
    """A row per line of metrics in which episodes ended."""
    rows = []
    for run in all_runs(options):
        path = run.folder(options) / "metrics.jsonl"
        for metrics in tracking.read(path) if path.exists() else ():
            if metrics["episode/return"] is not None:
                rows.append(
                    {
                        "task": run.task,
                        "alignment": run.alignment,
                        "seed": run.seed,
                        "env_steps": metrics["env_steps"],
                        "updates": metrics["updates"],
                        "minutes": round(metrics["time"] / 60, 2),
                        "return": round(metrics["episode/return"], 1),
                    }
                )
    return rows


def write_csv(rows: list[dict], path: pathlib.Path) -> None:
    with path.open("w", newline="") as file:
        writer = csv.DictWriter(file, COLUMNS, lineterminator="\n")
        writer.writeheader()
        writer.writerows(rows)


def plot(rows: list[dict], options: Options, path: pathlib.Path) -> None:
    """A panel per task, a line per seed, a colour per kind of alignment."""
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, panels = plt.subplots(
        1,
        len(options.chosen_tasks),
        figsize=(4.5 * len(options.chosen_tasks), 3.2),
        squeeze=False,
    )
    for panel, task in zip(panels[0], options.chosen_tasks, strict=True):
        for color, alignment in enumerate(options.alignments):
            for seed in options.seeds:
                run = Run(task, alignment, seed)
                chosen = [row for row in rows if row.items() >= vars(run).items()]
                panel.plot(
                    [row["env_steps"] / 1000 for row in chosen],
                    [row["return"] for row in chosen],
                    color=f"C{color}",
                    label=f"value alignment {alignment}" if seed == options.seeds[0] else None,
                )
        panel.set(title=task, xlabel="thousand environment steps", ylabel="return")
        if options.suite.startswith("dmc"):
            panel.set_ylim(0, 1000)
    panels[0][0].legend()
    figure.tight_layout()
    figure.savefig(path, dpi=110)


def summary(rows: list[dict], options: Options) -> str:
    """Per run: the return of its last episodes, its best, and how long it took."""
    lines = []
    for run in all_runs(options):
        own = [row for row in rows if row.items() >= vars(run).items()]
        if own:
            best = max(row["return"] for row in own)
            last = own[-1]
            lines.append(
                f"{run.task:18} {run.alignment:9} seed {run.seed}: last {last['return']:6.1f} "
                f"best {best:6.1f} at {last['env_steps']} env steps, "
                f"{last['updates']} updates, {last['minutes']} min"
            )
    return "\n".join(lines)


def main(argv: Sequence[str] | None = None) -> int:
    """Trains and plots; returns the exit code, 1 if a run failed."""
    options = flags.read(Options, argv, description=__doc__)
    check(options)
    failed = {} if options.collect_only else train(options)
    rows = read(options)
    options.results.mkdir(parents=True, exist_ok=True)
    write_csv(rows, options.result("csv"))
    plot(rows, options, options.result("png"))
    print(summary(rows, options))
    for run, code in failed.items():
        log = run.folder(options).with_suffix(".log")
        print(f"error: {run} ended with exit code {code}, see {log}", file=sys.stderr)
    return 1 if failed else 0


if __name__ == "__main__":
    sys.exit(command_line.guard(main))
