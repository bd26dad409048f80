"""The last return of training: a score that nobody had to measure."""

from __future__ import annotations

import math
import os
from typing import Any, NamedTuple

from vawm.runs import checkpoint
from vawm.runs.reports import tracking


class LastReturn(NamedTuple):
    """The mean return of the last episodes of training, with its rewards and exploration.

    Attributes:
      mean: of their returns.
      episodes: how many there are.
      env_steps: shortly before which they ended.
    """

    mean: float
    episodes: int
    env_steps: int

    def __str__(self) -> str:
        return (
            f"{self.mean:.1f}, the mean over {self.episodes} "
            f"episode{'s' if self.episodes > 1 else ''} that ended shortly before "
            f"{self.env_steps} env steps"
        )


def find(logdir: str | os.PathLike[str], env_steps: int) -> LastReturn | None:
    """The last return of the run in `logdir` up to `env_steps`; None if there is none."""
    try:
        lines = tracking.read(checkpoint.expanded(logdir) / tracking.METRICS)
    except OSError:  # may not be read, or is no file
        return None
    for line in reversed(lines):
        if line["env_steps"] <= env_steps and line.get("episode/return") is not None:
            mean, episodes = line["episode/return"], int(line["episode/count"])
            return LastReturn(mean, episodes, line["env_steps"])
    return None


def from_dict(content: Any) -> LastReturn | None:
    """The inverse of `LastReturn._asdict`, None of None; ValueError for other content."""
    if content is None:
        return None
    if not isinstance(content, dict) or content.keys() != set(LastReturn._fields):
        raise ValueError(f"{str(content)[:40]!r} is not a return of training")
    mean, episodes, env_steps = (content[name] for name in LastReturn._fields)
    whole = all(isinstance(x, int) and x >= 0 for x in (episodes, env_steps))
    if not whole or not isinstance(mean, (int, float)) or not math.isfinite(mean):
        raise ValueError(f"{str(content)[:80]!r} are not the numbers of a return")
    return LastReturn(float(mean), episodes, env_steps)
