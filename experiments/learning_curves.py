"""Learning curves of an experiment: tasks x seeds, with and without value alignment.

    python experiments/learning_curves.py --jobs 2
    python experiments/learning_curves.py --experiment gymnasium_task --preset pixels
    python experiments/learning_curves.py --agent storm --tasks cartpole_balance

Trains the runs that are missing under `--runs`, `--jobs` at a time (on Linux each on its own
cores), and writes `curves_<experiment>.csv` and `.png` to `--results`; for another agent than
dreamerv3, `curves_<experiment>_<agent>`. Resumes interrupted runs, skips finished ones, and
refuses runs that were started with other settings. Ctrl-C, SIGTERM and SIGHUP also stop the
runs, which save first.
"""

from __future__ import annotations

import pathlib
import sys
from collections.abc import Sequence
from dataclasses import dataclass

from vawm.analysis.tables import write_csv
from vawm.cli import command_line, flags
from vawm.config import AgentName, ValueAlignmentConfig
from vawm.runs import suites, validate
from vawm.sweep import children, figures, results, runs
from vawm.sweep.runs import Sweep, Variant

EXPERIMENTS = {pathlib.Path(suite.program).stem: name for name, suite in suites.SUITES.items()}
"""Name of a program in this folder -> the suite that it trains on."""
FOLDER = pathlib.Path(__file__).resolve().parent


@dataclass(frozen=True)
class Options:
    """The runs, and their folders."""

    experiment: str = "dmc_proprio"
    """the program that trains: the name of a file in this folder, such as gymnasium_task"""
    agent: AgentName = "dreamerv3"
    tasks: tuple[str, ...] = ()
    """one or more tasks; default those of the suite"""
    seeds: tuple[int, ...] = (0, 1, 2)
    alignments: tuple[str, ...] = ("adaptive", "off")
    """values of --value-alignment.weight"""
    preset: str = "quick"
    env_steps: int | None = None
    """length of every run; default that of the preset"""
    jobs: int = 1
    """runs at the same time"""
    runs: pathlib.Path = pathlib.Path("runs/learning_curves")
    results: pathlib.Path = FOLDER / "results"
    collect_only: bool = False
    """write the results of existing runs, and start none"""

    @property
    def suite(self) -> str:
        return EXPERIMENTS[self.experiment]

    @property
    def name(self) -> str:
        """The name of the folder of runs, and part of the names of result files."""
        suffix = "" if self.agent == "dreamerv3" else f"_{self.agent}"
        return self.experiment + suffix

    def result(self, ending: str) -> pathlib.Path:
        """The path of a result file."""
        return self.results / f"curves_{self.name}.{ending}"


def make_sweep(options: Options) -> Sweep:
    """All runs.

    Raises:
      InvalidInput: there is no such experiment.
    """
    validate.check_choice("experiment", options.experiment, EXPERIMENTS)
    suite = suites.SUITES[options.suite]
    return Sweep(
        program=FOLDER / suite.program,
        folder=options.runs / options.name,
        variants=tuple(
            Variant(weight, ("--value-alignment.weight", weight))
            for weight in options.alignments
        ),
        tasks=options.tasks or suite.usual_tasks,
        seeds=options.seeds,
        flags=("--agent", options.agent, "--preset", options.preset),
        env_steps=options.env_steps,
    )


def check(options: Options, sweep: Sweep) -> None:
    """Refuses options that would fail in every run, or only after hours.

    Raises:
      InvalidInput: names the option, its value and the remedy.
      RunError: a package is not installed.
    """
    for weight in options.alignments:
        weights = flags.choices(ValueAlignmentConfig, "weight")
        validate.check_choice("alignments", weight, weights)
    runs.check_distinct("alignments", options.alignments)
    runs.check(sweep, options.suite)
    started = None if options.collect_only else options.runs
    runs.check_places(jobs=options.jobs, runs=started, results=options.results)


def write(rows: results.Rows, options: Options, sweep: Sweep) -> None:
    options.results.mkdir(parents=True, exist_ok=True)
    write_csv(results.headed(rows, "alignment"), options.result("csv"))
    figures.plot(
        rows,
        sweep,
        options.result("png"),
        label="value alignment {}",
        returns=suites.SUITES[options.suite].returns,
    )


def summary(rows: results.Rows, sweep: Sweep) -> str:
    """A line per run: the return of its last episodes, its best one, and its duration."""
    lines = []
    for run in runs.all_runs(sweep):
        own = results.of_run(rows, run)
        if own:
            best = max(row["return"] for row in own)
            last = own[-1]
            lines.append(
                f"{run.task:18} {run.variant:9} seed {run.seed}: last {last['return']:6.1f} "
                f"best {best:6.1f} at {last['env_steps']} env steps, "
                f"{last['updates']} updates, {last['minutes']} min"
            )
    return "\n".join(lines)


def main(argv: Sequence[str] | None = None) -> int:
    """Trains and plots; returns the exit code, 1 if a run failed."""
    options = flags.read(Options, argv, description=__doc__)
    sweep = make_sweep(options)
    check(options, sweep)

    def report() -> None:
        rows = results.read_some(sweep)
        write(rows, options, sweep)
        print(summary(rows, sweep))

    jobs = [] if options.collect_only else runs.unfinished_jobs(sweep)
    return children.run_then(jobs, report, at_once=options.jobs)


if __name__ == "__main__":
    sys.exit(command_line.guard(main))
