"""How the runs of a sweep are doing, from their folders: counts, scores and the time left."""

from __future__ import annotations

import pathlib
import time
from collections.abc import Callable, Sequence
from typing import NamedTuple

from vawm.errors import InvalidInput
from vawm.runs import run_folder
from vawm.runs.reports import tracking

LOOK_SECONDS = 60.0
"""Time between looks at the metrics of runs that go on."""


class Standing(NamedTuple):
    """How far a run is.

    Attributes:
      env_steps: at its last line of metrics; 0 without one.
      length: env steps of the whole run; None before it has begun.
      score: its last return; None without one.
    """

    env_steps: int = 0
    length: int | None = None
    score: float | None = None

    @property
    def share(self) -> float:
        """The share of the run that is done, in [0, 1]."""
        return min(1.0, self.env_steps / self.length) if self.length else 0.0

    def __str__(self) -> str:
        score = "no return yet" if self.score is None else f"return {self.score:.1f}"
        return f"{score} at {self.env_steps:,} env steps"


def standing(folder: pathlib.Path) -> Standing:
    """Reads the folder of a run, which may not be there yet."""
    try:
        config = run_folder.read_config(folder)
    except InvalidInput:  # of another version, or half written
        config = None
    lines = tracking.read(folder / tracking.METRICS)
    scores = [
        line["episode/return"] for line in lines if line.get("episode/return") is not None
    ]
    return Standing(
        env_steps=lines[-1]["env_steps"] if lines else 0,
        length=config.env_steps if config else None,
        score=scores[-1] if scores else None,
    )


class Progress:
    """Prints one line for each change, with counts and the time left.

    The time left assumes that what is to do goes as fast as what this process has seen.
    """

    def __init__(
        self,
        folders: Sequence[pathlib.Path],
        *,
        say: Callable[[str], None],
        clock: Callable[[], float] = time.monotonic,
    ):
        self._say, self._clock = say, clock
        self._standings = {folder: standing(folder) for folder in folders}
        self._begun = self._looked = clock()
        self._share = self._done()  # before this process
        self._finished = self._failed = 0
        self._running: dict[pathlib.Path, str] = {}
        self._ended: set[pathlib.Path] = set()

    def starts(self, name: str, folder: pathlib.Path) -> None:
        """A run starts, or goes on."""
        self._running[folder] = name
        self._tell(f"{name}: started")

    def ends(self, name: str, folder: pathlib.Path, code: int) -> None:
        """A run has ended with an exit code."""
        self._running.pop(folder)
        self._ended.add(folder)
        now = self._standings[folder] = standing(folder)
        if code:
            self._failed += 1
            self._tell(f"{name}: failed with exit code {code}, {now}")
        else:
            self._finished += 1
            self._tell(f"{name}: finished, {now}")

    def look(self) -> None:
        """Tells new scores of the runs that go on, if the last look was a while ago."""
        if self._clock() - self._looked < LOOK_SECONDS:
            return
        self._looked = self._clock()
        for folder, name in self._running.items():
            before, now = self._standings[folder], standing(folder)
            self._standings[folder] = now
            if (before.score, before.env_steps) != (now.score, now.env_steps):
                self._tell(f"{name}: {now}")

    def _done(self) -> float:
        return sum(standing.share for standing in self._standings.values())

    def _tell(self, change: str) -> None:
        total = len(self._standings)
        failed = f", {self._failed} failed" if self._failed else ""
        counts = f"{self._finished} of {total} finished, {len(self._running)} running{failed}"
        left = f", {self._left()} left" if len(self._ended) < total else ""
        self._say(f"[{counts}{left}] {change}")

    def _left(self) -> str:
        """Hours and minutes until all have ended; "?" before anything was done."""
        gained = self._done() - self._share
        if gained <= 0:
            return "?"
        seconds = (self._clock() - self._begun) / gained * self._to_do()
        hours, minutes = divmod(round(seconds / 60), 60)
        return f"{hours}:{minutes:02} h"

    def _to_do(self) -> float:
        """Runs that are still to do, in parts; what a failed run lacks is not among it."""
        return sum(
            1 - standing.share
            for folder, standing in self._standings.items()
            if folder not in self._ended
        )
