"""Learning curves of a suite: tasks x seeds, with and without value alignment.

    vawm sweep --jobs 2
    vawm sweep --experiment gymnasium --preset pixels
    vawm sweep --agent storm --tasks cartpole_balance
    vawm sweep --tasks all --seeds 0 1 2 3 4

Trains the runs that are missing under `--runs`, `--jobs` at a time (on Linux each on its own
cores), and writes `curves_<experiment>.csv` and `.png` to `--results`; for another agent than
dreamerv3, `curves_<experiment>_<agent>`. Resumes interrupted runs, skips finished ones, and
refuses runs that were started with other settings. Ctrl-C, SIGTERM and SIGHUP also stop the
runs, which save first.
"""

from __future__ import annotations

import pathlib
from collections.abc import Sequence
from dataclasses import dataclass

from vawm.analysis.tables import write_csv
from vawm.cli import flags
from vawm.config import AgentName, ValueAlignmentConfig
from vawm.runs import suites, validate
from vawm.sweep import children, figures, results, runs
from vawm.sweep.runs import Sweep, Variant


def experiments() -> dict[str, str]:
    """Name of a program or of a suite -> the suite that it trains on."""
    programs = {stem(name): name for name in suites.SUITES}
    return programs | {name: name for name in suites.SUITES}


def stem(suite: str) -> str:
    """The name of a suite's program, without its ending."""
    return pathlib.Path(suites.SUITES[suite].program).stem


@dataclass(frozen=True)
class Options:
    """The runs, and their folders."""

    experiment: str = "dmc_proprio"
    """a suite, or the name of its program in `experiments`, such as gymnasium_task"""
    agent: AgentName = "dreamerv3"
    """which agent"""
    tasks: tuple[str, ...] = ()
    """one or more tasks, or all; default the usual ones of the suite"""
    seeds: tuple[int, ...] = (0, 1, 2)
    """one run of each task and alignment for every seed"""
    alignments: tuple[str, ...] = ("adaptive", "off")
    """values of --value-alignment.weight"""
    preset: str = "quick"
    """set of defaults for all other numbers"""
    env_steps: int | None = None
    """length of every run; default that of the preset"""
    jobs: int = 1
    """runs at the same time"""
    runs: pathlib.Path = pathlib.Path("runs/learning_curves")
    """folder of the runs"""
    results: pathlib.Path = pathlib.Path("runs/learning_curves/results")
    """folder of the table and the figure; existing ones are overwritten"""
    collect_only: bool = False
    """write the results of existing runs, and start none"""

    @property
    def suite(self) -> str:
        """The suite.

        Raises:
          InvalidInput: there is no such experiment.
        """
        validate.check_choice("experiment", self.experiment, experiments())
        return experiments()[self.experiment]

    @property
    def name(self) -> str:
        """The name of the folder of runs, and part of the names of result files."""
        suffix = "" if self.agent == "dreamerv3" else f"_{self.agent}"
        return stem(self.suite) + suffix

    def result(self, ending: str) -> pathlib.Path:
        """The path of a result file."""
        return self.results / f"curves_{self.name}.{ending}"


def make_sweep(options: Options) -> Sweep:
    """All runs.

    Raises:
      InvalidInput: there is no such experiment, or it cannot list all of its tasks.
    """
    suite = suites.SUITES[options.suite]
    return Sweep(
        program=runs.trains(options.suite),
        folder=options.runs / options.name,
        variants=tuple(
            Variant(weight, ("--value-alignment.weight", weight))
            for weight in options.alignments
        ),
        tasks=runs.named_tasks(options.suite, options.tasks) or suite.usual_tasks,
        seeds=options.seeds,
        flags=("--agent", options.agent, "--preset", options.preset),
        env_steps=options.env_steps,
    )


def check(options: Options, sweep: Sweep) -> None:
    """Refuses options that would fail in every run, or only after hours.

    Raises:
      InvalidInput: names the option, its value and the remedy.
    """
    for weight in options.alignments:
        weights = flags.choices(ValueAlignmentConfig, "weight")
        validate.check_choice("alignments", weight, weights)
    runs.check_distinct("alignments", options.alignments)
    runs.check(sweep, options.suite)
    started = None if options.collect_only else options.runs
    runs.check_places(jobs=options.jobs, runs=started, results=options.results)


def write(rows: results.Rows, options: Options, sweep: Sweep) -> None:
    """Writes the table and the figure."""
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
        print(f"results are in {options.results}")

    jobs = [] if options.collect_only else runs.unfinished_jobs(sweep)
    return children.run_then(jobs, report, at_once=options.jobs)
