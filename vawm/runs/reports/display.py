"""What a run shows: a bar on a terminal, otherwise a line per line of metrics.

While something takes long before training, such as compiling, a terminal shows a spinner with
the seconds so far. The bar and the spinner are one live display, which is redrawn in place;
texts are printed above it. It leaves the last columns free: a terminal that prints `^C` there
would otherwise break a line, and the next redrawing would leave the old bar standing.

Colours follow `NO_COLOR` and `FORCE_COLOR`; nothing is redrawn where `TERM` is `dumb`.
"""

from __future__ import annotations

import contextlib
import sys
import textwrap
from collections.abc import Iterator
from types import TracebackType
from typing import Literal, NamedTuple

import rich.console
import rich.live
import rich.progress_bar
import rich.spinner
import rich.table
import rich.text

from vawm.runs.reports import tracking
from vawm.runs.reports.headline import Headline
from vawm.runs.reports.pace import Pace, Totals
from vawm.runs.reports.tracking import Interval, Line

Mode = Literal["auto", "bar", "plain", "quiet"]
"""auto: a bar on a terminal, else plain; plain: lines without control codes; quiet: warnings
alone."""

FREE_COLUMNS = 4
SHORTEST_BAR = 8
BETWEEN = "   "  # fields of the bar
SHOW_CURSOR = "\x1b[?25h"


class Busy(NamedTuple):
    """What takes long, and since when on the console's clock."""

    what: str
    began: float


class Display:
    """Prints what a run says; a context manager around the run.

    Args:
      console: where to; standard output by default.
      mode: what to show.
    """

    def __init__(self, console: rich.console.Console | None = None, *, mode: Mode = "auto"):
        redrawn = mode == "bar" or (
            mode == "auto" and (console is not None or sys.stdout.isatty())
        )
        self._console = console or rich.console.Console(
            force_terminal={"bar": True, "plain": False}.get(mode)
        )
        self._quiet = mode == "quiet"
        self._busy: Busy | None = None
        self._spinner = rich.spinner.Spinner("line")
        self._headline = Headline()
        self._has_line = False
        self._pace: Pace | None = None
        self._env_steps = self._total = 0
        self._began = self._reached = self._console.get_time()
        self._live: rich.live.Live | None = None
        if redrawn and self._console.is_terminal and not self._console.is_dumb_terminal:
            self._live = rich.live.Live(
                console=self._console, get_renderable=self._rendered, transient=True
            )

    def note(self, text: str) -> None:
        """Prints text, above the bar; nothing if quiet."""
        if not self._quiet:
            self._print(text)

    def head(self, text: str) -> None:
        """As `note`; a terminal gets lines that break between words.

        Other texts have commands and paths to copy, whose lines only the terminal breaks.
        """
        if self._console.is_terminal:
            text = "\n".join(_wrapped(line, self._console.width) for line in text.splitlines())
        self.note(text)

    def warn(self, text: str) -> None:
        """Prints a warning, even if quiet."""
        self._print(text, style="yellow")

    @contextlib.contextmanager
    def busy(self, what: str, *, done: str = "", hint: str = "") -> Iterator[None]:
        """Shows for how long the `with` block has been busy with `what`.

        Args:
          what: such as "compiling".
          done: such as "compiled"; printed at the end, with the seconds.
          hint: how long it may take, for displays that cannot show the seconds.
        """
        began = self._console.get_time()
        self._busy = Busy(what, began)
        if self._live is not None:
            self._live.start(refresh=True)
        elif hint:
            self.note(f"{what} ({hint}) ...")
        try:
            yield
        finally:
            self._busy = None
        if done:
            self.note(f"{done} in {self._console.get_time() - began:.1f} s")

    def begin(self, start: Totals, *, total: int, pace: Pace, lines: list[Line]) -> None:
        """Shows the bar.

        Args:
          start: counters of the run, not 0 if it is resumed.
          total: env steps at its end.
          pace: measures it.
          lines: earlier lines of metrics, whose last numbers are shown until there are others.
        """
        self._pace, self._total, self._env_steps = pace, total, int(start.env_steps)
        self._began = self._reached = self._console.get_time()
        for line in lines:
            self._headline.take(line)
        if (latest := self._headline.episode_return) is not None and self._live is None:
            self.note(f"last episode return {latest:.1f}")
        if self._live is not None:
            self._live.transient = False  # the last bar stays
            self._live.start(refresh=True)

    def advance(self, totals: Totals, interval: Interval) -> None:
        """Takes over the counters after a chunk, and what was measured since the last line."""
        assert self._pace is not None, "call begin first"
        self._pace.reach(totals)
        self._env_steps, self._reached = int(totals.env_steps), self._console.get_time()
        if self._live is not None and not self._has_line:
            self._headline.take(
                tracking.line(
                    interval,
                    env_steps=self._env_steps,
                    updates=int(totals.updates),
                    seconds=totals.seconds,
                )
            )

    def log(self, line: Line) -> None:
        """Shows a line of metrics."""
        self._headline.take(line)
        self._has_line = self._has_line or bool(line["updates"])
        if self._live is None:
            own = Headline()
            own.take(line)
            fields = [
                f"env_steps {line['env_steps']}/{self._total}",
                f"updates {line['updates']}",
                *own.fields(),
                f"{line['env_steps_per_s']:,.0f} env steps/s",
                f"{line['updates_per_s']:.1f} updates/s",
                self._time_left() if line["updates"] else "not learning yet",
            ]
            self.note("  ".join(fields))

    def stopping(self) -> None:
        """Says that a signal has asked the run to stop, and what it waits for."""
        if (busy := self._busy) is not None:
            self.note(f"stopping: waits for {busy.what} to end (again: ends at once) ...")
        else:
            self.note("stopping after this step ...")

    def release(self) -> None:
        """Gives the terminal back its cursor, for a process that is about to be ended."""
        if self._live is not None and self._live.is_started:
            self._console.file.write(SHOW_CURSOR)
            self._console.file.flush()

    def _print(self, text: str, style: str | None = None) -> None:
        self._console.print(text, style=style, highlight=False, soft_wrap=True, markup=False)

    def _rendered(self) -> rich.console.RenderableType:
        """The live display as it is now."""
        if (busy := self._busy) is not None:
            seconds = self._console.get_time() - busy.began
            self._spinner.update(text=f"{busy.what} {seconds:.0f} s")
            return self._spinner
        if self._pace is None:
            return ""
        room = max(1, self._console.width - FREE_COLUMNS)
        rows = [rich.text.Text(row, no_wrap=True) for row in packed(self._fields(), room)]
        return rich.console.Group(self._bar(room), *rows)

    def _bar(self, room: int) -> rich.console.RenderableType:
        completed = min(self._env_steps, self._total)
        share = completed / self._total
        told = f"{share:4.0%}  {completed:,}/{self._total:,} env steps  {self._time_left()}"
        width = room - len(told) - 2
        if width < SHORTEST_BAR:
            return rich.text.Text(told, no_wrap=True)
        grid = rich.table.Table.grid(padding=(0, 2, 0, 0))
        bar = rich.progress_bar.ProgressBar(self._total, completed, width=width)
        grid.add_row(bar, rich.text.Text(told, no_wrap=True))
        return grid

    def _fields(self) -> list[str]:
        assert self._pace is not None
        known, *losses = self._headline.fields()
        speed = f"{self._pace.env_steps_per_s:,.0f} env steps/s"
        updates = f"{self._pace.updates_per_s:.1f} updates/s"
        learning = updates if self._pace.learning else "not learning yet"
        return [known, speed, learning, *losses]

    def _time_left(self) -> str:
        """The time that the run still needs; at its end, the time that it took."""
        assert self._pace is not None
        now, missing = self._console.get_time(), self._total - self._env_steps
        if missing <= 0:
            return f"took {duration(self._reached - self._began)}"
        seconds = self._pace.seconds_for(missing)
        if seconds is None:
            return "ETA -"
        return f"ETA {duration(max(0.0, seconds - (now - self._reached)))}"

    def __enter__(self) -> Display:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._live is not None:
            self._live.stop()


def packed(fields: list[str], room: int) -> list[str]:
    """Rows of at most `room` characters with as many fields each as fit."""
    rows: list[str] = []
    for field in fields:
        if rows and len(rows[-1]) + len(BETWEEN) + len(field) <= room:
            rows[-1] += BETWEEN + field
        else:
            rows.append(field)
    return rows


def _wrapped(line: str, width: int) -> str:
    """`line` in rows of at most `width`; further rows are indented by two more."""
    indent = line[: len(line) - len(line.lstrip())]
    return textwrap.fill(
        line.lstrip(), width, initial_indent=indent, subsequent_indent=indent + "  "
    )


def duration(seconds: float) -> str:
    """Hours, minutes and seconds: `1:02:03`."""
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes // 60}:{minutes % 60:02}:{rest:02}"
