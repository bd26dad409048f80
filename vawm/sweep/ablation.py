"""One ablation of the paper: its variants, its two scales, and the common command line.

The scale `quick` shows on a CPU that everything works; `paper` uses the tasks and presets of
the paper. Results are `ablation_<name>.csv`, `.md` and `.png`; the name has `_<agent>` for
another agent than dreamerv3, `_paper` for that scale, and the tasks if they are given.
"""

from __future__ import annotations

import dataclasses
import pathlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

from vawm.agent import registry
from vawm.analysis.tables import write_csv
from vawm.cli import flags
from vawm.config import AgentName
from vawm.runs import validate
from vawm.sweep import children, figures, results, runs
from vawm.sweep.runs import Sweep, Variant


class Scale(NamedTuple):
    """The tasks, seeds and length of the runs of a comparison.

    Attributes:
      suite: the suite whose program trains.
      preset: of that suite.
      tasks, seeds: of the runs.
      env_steps: length of a run; that of the preset if None.
      flags: further flags of every run.
    """

    suite: str
    preset: str
    tasks: tuple[str, ...]
    seeds: tuple[int, ...]
    env_steps: int | None = None
    flags: tuple[str, ...] = ()


QUICK = Scale("dmc_proprio", "quick", ("cartpole_swingup",), (0, 1, 2), env_steps=40_000)
"""A third of the length of the preset's run."""

TABLE_3 = ("alien", "crazy_climber", "demon_attack", "bank_heist", "battle_zone")


def paper(*games: str) -> Scale:
    """Games of Atari 100k, with the 5 seeds of Tables 1 and 2."""
    return Scale("atari100k", "paper", games, (0, 1, 2, 3, 4))


class Ablation(NamedTuple):
    """A comparison of variants.

    Attributes:
      name: of the results.
      title: the first sentence of the table.
      variants: `(agent) -> variants`; a variant may set another agent. Raises `InvalidInput`
        if the ablation does not apply to the agent.
      quick, paper: the two scales.
      factor: what differs between variants, as a column heading.
      extra: column -> metric of further curves in `ablation_<name>_curves.png`; the table
        has means over the last tenth of each run.
    """

    name: str
    title: str
    variants: Callable[[str], tuple[Variant, ...]]
    quick: Scale
    paper: Scale
    factor: str = "value alignment"
    extra: dict[str, str] = {}  # noqa: RUF012 - never mutated


ALIGNMENT = {
    "dynamics_loss": "loss/dynamics",
    "value_alignment_loss": "value_alignment/loss",
    "weight": "value_alignment/weight",
    "latent_kl": "latent/kl",
}
"""Column -> metric: Eq. 3b, L_var before its weight, the weight of Eq. 5, KL[q || p] of z."""

ADAPTIVE = ("--value-alignment.weight", "adaptive")
OFF = ("--value-alignment.weight", "off")


@dataclass(frozen=True)
class Compared:
    """The options of all scripts: what to compare, and where to put the results."""

    scale: Literal["quick", "paper"] = "quick"
    """quick: for a CPU with 2 cores; paper: the paper's tasks and presets, for a GPU"""
    agent: AgentName = "dreamerv3"
    """which agent"""
    tasks: tuple[str, ...] = ()
    """one or more tasks, or all; default those of the scale"""
    results: pathlib.Path = pathlib.Path("runs/ablations/results")
    """folder of tables and figures; existing ones are overwritten"""


@dataclass(frozen=True)
class Options(Compared):
    """The runs of an ablation, and their folder."""

    seeds: tuple[int, ...] = ()
    """one run of each task and variant for every seed; default those of the scale"""
    env_steps: int | None = None
    """length of every run; default that of the scale"""
    jobs: int = 1
    """runs at the same time"""
    runs: pathlib.Path = pathlib.Path("runs/ablations")
    """folder of the runs"""
    collect_only: bool = False
    """write the results of existing runs, and start none"""


def main(
    ablation: Ablation, argv: Sequence[str] | None, *, description: str | None, script: str
) -> int:
    """The main function of a script for `ablation`; returns 1 if a run failed, else 0."""
    options = flags.read(Options, argv, description=description)
    return run(ablation, options, script=script)


def run(ablation: Ablation, options: Options, *, script: str) -> int:
    """Trains the missing runs, then writes table and figures; returns the exit code.

    Args:
      ablation: the comparison.
      options: the runs, and their folder.
      script: the file that was started.

    Raises:
      InvalidInput: before anything is started.
      RunError: no run has any metrics.
    """
    sweep = make_sweep(ablation, options)
    check(ablation, options, sweep)

    def report() -> None:
        print(write(ablation, options, sweep, command(options, script)))

    jobs = [] if options.collect_only else runs.unfinished_jobs(sweep)
    return children.run_then(jobs, report, at_once=options.jobs)


def scale_of(ablation: Ablation, options: Compared) -> Scale:
    return {"quick": ablation.quick, "paper": ablation.paper}[options.scale]


def make_sweep(ablation: Ablation, options: Options) -> Sweep:
    """The runs of an ablation.

    Raises:
      InvalidInput: an unknown agent, or one that the ablation does not apply to.
    """
    scale = scale_of(ablation, options)
    validate.check_choice("agent", options.agent, registry.names())
    return Sweep(
        program=runs.trains(scale.suite),
        folder=options.runs / result_name(ablation, options),
        variants=ablation.variants(options.agent),
        tasks=runs.named_tasks(scale.suite, options.tasks) or scale.tasks,
        seeds=options.seeds or scale.seeds,
        flags=("--agent", options.agent, "--preset", scale.preset, *scale.flags),
        env_steps=options.env_steps if options.env_steps is not None else scale.env_steps,
    )


def check(ablation: Ablation, options: Options, sweep: Sweep) -> None:
    """Refuses options that would fail in every run, or only after hours."""
    runs.check(sweep, scale_of(ablation, options).suite)
    started = None if options.collect_only else options.runs
    runs.check_places(jobs=options.jobs, runs=started, results=options.results)


def result_name(ablation: Ablation, options: Compared) -> str:
    """The name of the result files and of the folder of runs."""
    agent = "" if options.agent == "dreamerv3" else f"_{options.agent}"
    scale = "" if options.scale == "quick" else f"_{options.scale}"
    tasks = "".join(f"_{task.replace('/', '-')}" for task in options.tasks)
    return f"ablation_{ablation.name}{agent}{scale}{tasks}"


def write(ablation: Ablation, options: Options, sweep: Sweep, made_by: str) -> str:
    """Writes table and figures of the existing runs; returns the table in Markdown.

    Raises:
      RunError: no run has any metrics.
    """
    columns = results.RETURN | ablation.extra
    rows = results.read_some(sweep, columns)
    options.results.mkdir(parents=True, exist_ok=True)
    path = options.results / result_name(ablation, options)
    write_csv(rows, path.with_suffix(".csv"))
    table = results.markdown(
        results.summarise(sweep, rows, columns),
        factor=ablation.factor,
        command=made_by,
        notes=f"{ablation.title} {setting(options.agent, sweep)}\n\n{how_to_read(ablation)}",
    )
    path.with_suffix(".md").write_text(table)
    figures.plot(rows, sweep, path.with_suffix(".png"), seeds="band")
    if ablation.extra:
        curves = path.with_name(path.name + "_curves.png")
        figures.plot(rows, sweep, curves, quantities=tuple(ablation.extra), seeds="band")
    return table


HOW_TO_READ = (
    "Returns of training episodes: mean +- standard error over seeds. The mean return is the "
    "area under the curve per environment step. Minutes are those of one run."
)
HOW_TO_READ_EXTRA = (
    "All other columns: the mean over the last tenth of each run's environment steps, then "
    "over seeds as above."
)


def how_to_read(ablation: Ablation) -> str:
    """Explains the columns of the table."""
    return f"{HOW_TO_READ} {HOW_TO_READ_EXTRA}" if ablation.extra else HOW_TO_READ


def setting(agent: str, sweep: Sweep) -> str:
    """What all runs have in common, except for variants that set another agent."""
    if any("--agent" in variant.flags for variant in sweep.variants):
        agent += " unless stated"
    length = "" if sweep.env_steps is None else f", {sweep.env_steps:,} environment steps"
    preset = sweep.flags[sweep.flags.index("--preset") + 1]
    return f"Agent {agent}, preset {preset} of {sweep.program[-1]}{length}."


def command(options: Compared, script: str) -> str:
    """The command line for these options, without flags that do not change the numbers."""
    words = ["python", "experiments/ablations/" + pathlib.Path(script).name]
    silent = ("jobs", "runs", "results", "collect_only")
    for field in dataclasses.fields(options):
        value = getattr(options, field.name)
        if field.name not in silent and value != field.default:
            values = map(str, value) if isinstance(value, tuple) else [str(value)]
            words += ["--" + field.name.replace("_", "-"), *values]
    return " ".join(words)
