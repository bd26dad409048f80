"""Learning curves of an experiment: tasks x seeds, with and without value alignment.

    python experiments/learning_curves.py --jobs 2
    python experiments/learning_curves.py --experiment gymnasium_task --preset pixels
    python experiments/learning_curves.py --agent storm --tasks cartpole_balance

Runs what is missing under `--runs`, `--jobs` at a time (on Linux each on cores of its own),
and writes `curves_<experiment>.csv` and `.png` to `--results`, of another agent than dreamerv3
`curves_<experiment>_<agent>`. Interrupted runs are resumed, finished ones left alone; runs that
were begun with other settings are refused. Ctrl-C, SIGTERM and SIGHUP stop the runs too, which
save before they end.
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
"""Name of a program beside this one -> the suite on which it trains."""
FOLDER = pathlib.Path(__file__).resolve().parent


@dataclass(frozen=True)
class Options:
    """Which runs, and where they go."""

    experiment: str = "dmc_proprio"
    """the program that trains: the name of a file beside this one, such as gymnasium_task"""
    agent: AgentName = "dreamerv3"
    tasks: tuple[str, ...] = ()
    """any number of them; the usual ones of the suite if none"""
    seeds: tuple[int, ...] = (0, 1, 2)
    alignments: tuple[str, ...] = ("adaptive", "off")
    """values of --value-alignment.weight"""
    preset: str = "quick"
    env_steps: int | None = None
    """length of every run; that of the preset if not given"""
    jobs: int = 1
    """runs side by side"""
    runs: pathlib.Path = pathlib.Path("runs/learning_curves")
    results: pathlib.Path = FOLDER / "results"
    collect_only: bool = False
    """write the results of the runs that are there, and start none"""

    @property
    def suite(self) -> str:
        return EXPERIMENTS[self.experiment]

    @property
    def name(self) -> str:
        """Of the folder of its runs, and in the names of its results."""
        suffix = "" if self.agent == "dreamerv3" else f"_{self.agent}"
        return self.experiment + suffix

    def result(self, ending: str) -> pathlib.Path:
        """Where a file of results goes."""
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
    """Refuses what would only fail in every run, or after hours of them.

    Raises:
      InvalidInput: names the option, its value and the remedy.
      RunError: a package is missing.
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
    """Per run: the return of its last episodes, its best, and how long it took."""
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
