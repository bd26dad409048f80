"""The progress display of a run: a bar on a terminal, otherwise a line per log entry."""

from __future__ import annotations

from types import TracebackType

import rich.console
import rich.progress

from vawm.runs.reports.tracking import Interval, Line

SPEED_SECONDS = 600.0
"""Window for the speed of the ETA; it must contain two chunks, otherwise there is no ETA."""


class Display:
    """A context manager around the loop; shows the bar if `console` is a terminal."""

    def __init__(self, console: rich.console.Console, *, start: int, total: int):
        self._console = console
        self._total = total
        self._return: float | None = None
        self._speed = ""
        self._bar = rich.progress.Progress(
            rich.progress.BarColumn(bar_width=None),
            rich.progress.TextColumn("{task.completed:,.0f}/{task.total:,.0f} env steps"),
            rich.progress.TextColumn("{task.fields[status]}"),
            rich.progress.TimeRemainingColumn(elapsed_when_finished=True),
            console=console,
            speed_estimate_period=SPEED_SECONDS,
            disable=not console.is_terminal,
        )
        self._task = self._bar.add_task("", completed=start, total=total, status="")

    def advance(self, env_steps: int, interval: Interval) -> None:
        """Updates the bar after every chunk: progress, and speed in this interval."""
        if interval.seconds:
            steps_per_s = interval.env_steps / interval.seconds
            updates_per_s = interval.updates / interval.seconds
            self._speed = f"{steps_per_s:,.0f}/s  {updates_per_s:.1f} updates/s"
        shown = "-" if self._return is None else f"{self._return:.1f}"
        status = f"{self._speed}  return {shown}"
        self._bar.update(self._task, completed=min(env_steps, self._total), status=status)

    def log(self, line: Line) -> None:
        """Shows a line of metrics."""
        latest = line.get("episode/return")
        self._return = self._return if latest is None else latest
        if self._console.is_terminal:
            return
        shown = "-" if latest is None else f"{latest:.1f}"
        remaining = max(0, self._total - line["env_steps"]) / max(line["env_steps_per_s"], 1e-9)
        # Steps become much slower once updates start, so there is no estimate before.
        left = f"{remaining / 60:.0f} min left" if line["updates"] else "not learning yet"
        self._console.print(
            f"env_steps {line['env_steps']}/{self._total}  updates {line['updates']}  "
            f"return {shown}  {line['env_steps_per_s']:.0f} steps/s  "
            f"{line['updates_per_s']:.1f} updates/s  {left}",
            highlight=False,
            soft_wrap=True,
        )

    def note(self, text: str) -> None:
        """Prints a line of text above the bar."""
        self._console.print(text, highlight=False, soft_wrap=True, markup=False)

    def __enter__(self) -> Display:
        self._bar.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self._bar.stop()
