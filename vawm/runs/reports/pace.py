"""How fast a run is, and how long it still takes.

Env steps are cheap until learning starts, and expensive from then on. So their costs are told
apart: those of an env step in the chunks without updates, and those of an update in what the
other chunks took longer.
"""

from __future__ import annotations

import math
from typing import NamedTuple

MEMORY_SECONDS = 120.0
"""How fast earlier chunks are forgotten: after so many seconds, they count by a third."""


class Totals(NamedTuple):
    """Of the run so far: env steps, updates, and the seconds that all chunks took."""

    env_steps: float = 0.0
    updates: float = 0.0
    seconds: float = 0.0


class Pace:
    """Measures chunks.

    Args:
      updates_per_env_step: once the run learns.
      start: totals at which measuring starts; with updates, the run has been learning.

    Attributes:
      learning: whether the run has made an update.
    """

    def __init__(self, updates_per_env_step: float, start: Totals = Totals()):  # noqa: B008
        self._updates_per_env_step = updates_per_env_step
        self._latest = start
        self.learning = start.updates > 0
        self._all = self._idle = Totals()  # chunks since the first update; those without one

    def reach(self, totals: Totals) -> None:
        """One more chunk, after which the run has these totals."""
        chunk = Totals(*(now - then for now, then in zip(totals, self._latest, strict=True)))
        self._latest = totals
        if chunk.updates and not self.learning:
            self.learning, self._all = True, Totals()
        self._all = _added(self._all, chunk)
        if not chunk.updates:
            self._idle = _added(self._idle, chunk)

    @property
    def env_steps_per_s(self) -> float:
        """Of late; 0 before the first chunk."""
        return self._all.env_steps / self._all.seconds if self._all.seconds else 0.0

    @property
    def updates_per_s(self) -> float:
        """Of late; 0 before the first update."""
        return self._all.updates / self._all.seconds if self._all.seconds else 0.0

    def seconds_for(self, env_steps: float) -> float | None:
        """Seconds that so many further env steps take; None before the first update."""
        total, idle = self._all, self._idle
        if not total.updates:
            return None
        per_env_step = idle.seconds / idle.env_steps if idle.env_steps else 0.0
        if total.env_steps:
            per_env_step = min(per_env_step, total.seconds / total.env_steps)
        per_update = (total.seconds - per_env_step * total.env_steps) / total.updates
        return env_steps * (per_env_step + per_update * self._updates_per_env_step)


def _added(totals: Totals, chunk: Totals) -> Totals:
    """`totals`, faded by the time that `chunk` took, and `chunk`."""
    fade = math.exp(-chunk.seconds / MEMORY_SECONDS)
    return Totals(*(fade * then + now for then, now in zip(totals, chunk, strict=True)))
