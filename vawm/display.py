"""What a run shows while it runs: a bar on a terminal, a line per log elsewhere."""

from __future__ import annotations

import contextlib
import os
import sys
from types import TracebackType
from typing import IO, Any

import rich.console
import rich.progress

from vawm.tracking import Interval, Line

SPEED_SECONDS = 600.0
"""How far back the speed behind the ETA looks; two chunks have to fit in, or there is none."""


class Lasting:
    """Standard output that a run outlives: once it cannot be written, nothing is.

    A pipe whose reader ended, a terminal that was closed, a file on a disk that is full: none
    of them is a reason to lose a run, whose metrics are in its folder.
    """

    def __init__(self, file: IO[str]):
        self._file, self._gone = file, False

    def write(self, text: str) -> int:
        if not self._gone:
            try:
                return self._file.write(text)
            except OSError as error:
                self._lose(error)
        return len(text)

    def flush(self) -> None:
        if not self._gone:
            try:
                self._file.flush()
            except OSError as error:
                self._lose(error)

    def _lose(self, error: OSError) -> None:
        self._gone = True
        with contextlib.suppress(OSError):
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, self._file.fileno())  # where Python flushes what is left, at exit
            os.close(nowhere)
        with contextlib.suppress(OSError):
            print(
                f"warning: standard output is gone ({error.strerror}); the run goes on",
                file=sys.stderr,
                flush=True,
            )

    def __getattr__(self, name: str) -> Any:
        return getattr(self._file, name)


def standard_output() -> rich.console.Console:
    """The console of a run."""
    return rich.console.Console(file=Lasting(sys.stdout))  # type: ignore[arg-type]


class Display:
    """A context manager around the loop; `console` decides what is shown."""

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
        """After every chunk: where the run is, and how fast in this interval."""
        if interval.seconds:
            steps_per_s = interval.env_steps / interval.seconds
            updates_per_s = interval.updates / interval.seconds
            self._speed = f"{steps_per_s:,.0f}/s  {updates_per_s:.1f} updates/s"
        shown = "-" if self._return is None else f"{self._return:.1f}"
        status = f"{self._speed}  return {shown}"
        self._bar.update(self._task, completed=min(env_steps, self._total), status=status)

    def log(self, line: Line) -> None:
        """After every line of metrics."""
        latest = line.get("episode/return")
        self._return = self._return if latest is None else latest
        if self._console.is_terminal:
            return
        shown = "-" if latest is None else f"{latest:.1f}"
        remaining = max(0, self._total - line["env_steps"]) / max(line["env_steps_per_s"], 1e-9)
        # Steps are slower by far once there is something to learn from.
        left = f"{remaining / 60:.0f} min left" if line["updates"] else "not learning yet"
        self._console.print(
            f"env_steps {line['env_steps']}/{self._total}  updates {line['updates']}  "
            f"return {shown}  {line['env_steps_per_s']:.0f} steps/s  "
            f"{line['updates_per_s']:.1f} updates/s  {left}",
            highlight=False,
            soft_wrap=True,
        )

    def note(self, text: str) -> None:
        """A line of text above the bar."""
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
