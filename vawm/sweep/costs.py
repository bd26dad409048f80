"""Compares the cost of variants: a table of time and memory, and its figure."""

from __future__ import annotations

import dataclasses
import pathlib
import statistics
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from vawm.analysis.figures import panels
from vawm.analysis.tables import write_csv
from vawm.cli import flags
from vawm.envs.protocol import check_positive
from vawm.sweep import ablation, overhead, runs
from vawm.sweep.ablation import Ablation, Compared
from vawm.sweep.overhead import Measured, percent_more, quartiles
from vawm.sweep.results import line
from vawm.sweep.runs import Run, Sweep

Rows = list[dict[str, Any]]
GIB = 2**30


@dataclass(frozen=True)
class Options(Compared):
    """What to measure, and where to put the results."""

    repeats: int = 20
    """timed samples per variant"""


def main(
    compared: Ablation, argv: Sequence[str] | None, *, description: str | None, script: str
) -> int:
    """The main function of a script that measures the first variant against the second."""
    options = flags.read(Options, argv, description=description)
    check_positive("repeats", options.repeats)
    given = {field.name: getattr(options, field.name) for field in dataclasses.fields(Compared)}
    runs_of_it = ablation.Options(**given)  # to check the options; starts no run
    sweep = ablation.make_sweep(compared, runs_of_it)
    suite = ablation.scale_of(compared, options).suite
    runs.check(sweep, suite)
    runs.check_places(jobs=1, runs=None, results=options.results)
    rows = []
    for task in sweep.tasks:
        owned = [Run(task, variant.name, sweep.seeds[0]) for variant in sweep.variants]
        variants = [runs.flags(sweep, run) for run in owned]
        rows += rows_of(owned, overhead.compare(suite, variants, repeats=options.repeats))
    options.results.mkdir(parents=True, exist_ok=True)
    path = options.results / ablation.result_name(compared, options)
    notes = f"{compared.title} {ablation.setting(options.agent, sweep)}"
    table = markdown(rows, notes=notes, command=ablation.command(options, script))
    write_csv(rows, path.with_suffix(".csv"))
    path.with_suffix(".md").write_text(table)
    plot(rows, sweep, path.with_suffix(".png"))
    print(table)
    return 0


def rows_of(owned: Sequence[Run], measured: Sequence[Measured]) -> Rows:
    """A row per variant; overheads are relative to the last variant."""
    rows, base = [], measured[-1]
    for run, own in zip(owned, measured, strict=True):
        first, third = quartiles(own.seconds)
        more = percent_more(own.seconds, base.seconds)
        low, high = quartiles(more)
        rows.append(
            {
                "task": run.task,
                "variant": run.variant,
                "updates": own.updates,
                "env_steps": own.env_steps,
                "samples": len(own.seconds),
                "seconds": statistics.median(own.seconds),
                "seconds_first_quartile": first,
                "seconds_third_quartile": third,
                "overhead_percent": statistics.median(more),
                "overhead_first_quartile": low,
                "overhead_third_quartile": high,
                "peak_gib": own.peak_bytes / GIB,
                "more_memory_percent": 100 * (own.peak_bytes / base.peak_bytes - 1),
                "run_hours": own.run_hours,
                "compile_s": own.compile_s,
            }
        )
    return rows


HOW_TO_READ = (
    "A sample is the smallest number of training steps with a whole number of updates. Numbers "
    "are medians, with quartiles over the samples in brackets. The overhead compares each "
    "sample with the neighbouring sample of the other variant. Hours of a whole run follow "
    "from the median. Peak memory is that of the accelerator; on a CPU, it is XLA's plan for a "
    "step: arguments, results and temporaries."
)


def markdown(rows: Rows, *, notes: str, command: str) -> str:
    """The table in Markdown, with its explanation and its command."""
    heads = ["task", "value alignment", "s per sample", "overhead", "peak memory", "hours"]
    lines = [notes, "", HOW_TO_READ, "", line(heads), line(["---"] * len(heads))]
    base = rows[-1]["variant"]
    for row in rows:
        values = [
            f"{row['seconds']:.4g} ({row['seconds_first_quartile']:.4g} to "
            f"{row['seconds_third_quartile']:.4g})",
            f"{row['overhead_percent']:.1f} % ({row['overhead_first_quartile']:.1f} to "
            f"{row['overhead_third_quartile']:.1f})",
            f"{row['peak_gib']:.2f} GiB ({row['more_memory_percent']:+.1f} %)",
            f"{row['run_hours']:.3g}",
        ]
        if row["variant"] == base:
            values[1], values[2] = "-", f"{row['peak_gib']:.2f} GiB"
        lines.append(line([row["task"], row["variant"], *values]))
    sample = "; ".join(
        f"{row['task']}: {row['updates']} updates and {row['env_steps']} environment steps per "
        f"sample, {row['samples']} samples"
        for row in {row["task"]: row for row in rows}.values()
    )
    return "\n".join([*lines, "", f"{sample}.", "", f"Made by `{command}`.", ""])


def plot(rows: Rows, sweep: Sweep, path: pathlib.Path) -> None:
    """Draws seconds per sample, with quartiles, and peak memory: a group of bars per task."""
    width, places = 0.8 / len(sweep.variants), range(len(sweep.tasks))
    with panels(path, 1, 2, size=(4.5, 3.2)) as axes:
        time, memory = axes[0]
        for number, variant in enumerate(sweep.variants):
            own = [row for row in rows if row["variant"] == variant.name]
            at = [place + number * width for place in places]
            below = [row["seconds"] - row["seconds_first_quartile"] for row in own]
            above = [row["seconds_third_quartile"] - row["seconds"] for row in own]
            seconds = [row["seconds"] for row in own]
            time.bar(at, seconds, width, yerr=(below, above), label=variant.name)
            memory.bar(at, [row["peak_gib"] for row in own], width, label=variant.name)
        for panel, what in ((time, "seconds per sample"), (memory, "peak memory, GiB")):
            middle = width * (len(sweep.variants) - 1) / 2
            panel.set_xticks([place + middle for place in places], sweep.tasks)
            panel.set(ylabel=what)
        time.margins(y=0.35)  # space for the legend above the bars
        time.legend(title="value alignment", ncols=2)
