"""Saving while training goes on: a copy is taken, and a thread writes it.

blocked   wait for the save before, copy the state    the loop waits for this much
behind    write, checksum, rename, delete old ones    in one thread, which has no JAX in it
"""

from __future__ import annotations

import concurrent.futures
import os
import pathlib
import time
from collections.abc import Callable, Mapping
from types import TracebackType
from typing import Any, NamedTuple

import numpy as np

from vawm.config import Config
from vawm.runs.checkpoint import folders, snapshot, writing
from vawm.runs.checkpoint.manifest import sync
from vawm.runs.checkpoint.snapshot import Snapshot
from vawm.runs.checkpoint.writing import SaveError, Written
from vawm.types import EnvSpec, PyTree

Log = Callable[[dict[str, Any]], None]
SLOW, SLOW_SECONDS = 0.1, 1.0
"""The share of the time between two saves in which training may wait for the disk, and the
seconds up to which nobody minds."""


class Pending(NamedTuple):
    """A save that was begun; the future has what was written, and when that was done."""

    env_steps: int
    began: float
    blocked: float
    future: concurrent.futures.Future[tuple[Written, float]]


class Saver:
    """Writes the checkpoints of one run, at most one at a time; a context manager.

    What goes wrong behind the loop is raised in it, by the next call of any method. On the
    way out a save that was begun is waited for.

    Args:
      logdir: the folder of the run.
      config: of the run; `save_minutes` counts from here, and from each save on.
      spec: of the environment.
      before: a file that has to be on the disk, as it was when a save began, before the
        checkpoint is complete: so that a machine that fails leaves none that is ahead of it.
      log: takes a line about each complete checkpoint, once the caller hears of it:
        `checkpoint/bytes` of its files, `checkpoint/seconds` until it was complete and older
        ones were deleted, `checkpoint/blocked_seconds` of those in which the caller waited.
      say: prints a warning, the first time that a save takes so long that the next one holds
        the caller up for more than `SLOW` of the time between the two.
    """

    def __init__(
        self,
        logdir: str | os.PathLike[str],
        config: Config,
        spec: EnvSpec,
        *,
        before: pathlib.Path | None = None,
        log: Log = lambda _: None,
        say: Callable[[str], None] = print,
    ):
        self.logdir, self._config, self._spec, self._before = logdir, config, spec, before
        self._log, self._say, self._told = log, say, False
        self._thread = concurrent.futures.ThreadPoolExecutor(1, thread_name_prefix="saver")
        self._pending: Pending | None = None
        self._last = time.monotonic()

    def is_time(self) -> bool:
        """Whether `save_minutes` have passed since the last save began; never if 0."""
        minutes = self._config.save_minutes
        return bool(minutes) and time.monotonic() - self._last >= 60 * minutes

    def save(
        self,
        state: PyTree,
        *,
        env_steps: int,
        progress: Mapping[str, Any],
        episodes: Mapping[str, np.ndarray] | None = None,
    ) -> None:
        """Waits for the save before, copies the state, and has it written behind the caller.

        Raises:
          SaveError: the save before failed, there is a checkpoint as new as this, or the
            folder of the run is gone.
        """
        due = time.monotonic()
        self.wait()
        began = time.monotonic()
        self._tell_if_slow(waited=began - due, interval=began - self._last)
        if not folders.root(self.logdir).parent.is_dir():  # nobody would look for a new one
            raise SaveError(
                f"{self.logdir} is gone, so no checkpoint is written; if it was moved, go on "
                "with --resume where it is"
            )
        writing.refuse_backwards(self.logdir, env_steps)
        taken = snapshot.take(
            state,
            env_steps=env_steps,
            config=self._config,
            spec=self._spec,
            progress=progress,
            episodes=episodes,
        )
        self._last = time.monotonic()
        future = self._thread.submit(_write, self.logdir, taken, self._before)
        self._pending = Pending(env_steps, began, self._last - began, future)

    def _tell_if_slow(self, *, waited: float, interval: float) -> None:
        if self._told or waited < SLOW_SECONDS or waited < SLOW * interval:
            return
        self._told = True
        self._say(
            f"warning: training waited {waited:.0f} s of {interval:.0f} s for the disk, which "
            "does not keep up: use a larger --save-every and --save-minutes"
        )

    def check(self) -> None:
        """Hears of a save that is done; never waits.

        Raises:
          SaveError: it failed; nothing of it is left, and the one before is intact.
        """
        if self._pending and self._pending.future.done():
            self.wait()

    def wait(self) -> None:
        """Returns when no save is under way.

        Raises:
          SaveError: as `check`.
        """
        if self._pending is None:
            return
        pending, self._pending = self._pending, None
        waits = time.monotonic()
        written, finished = pending.future.result()
        blocked = pending.blocked + max(0.0, finished - waits)
        self._log(
            {
                "env_steps": pending.env_steps,
                "checkpoint/bytes": written.nbytes,
                "checkpoint/seconds": round(finished - pending.began, 4),
                "checkpoint/blocked_seconds": round(blocked, 4),
            }
        )

    def __enter__(self) -> Saver:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        try:
            self.wait()
        except (SaveError, OSError):
            if error is None:  # else the run ends already, for a reason of its own
                raise
        finally:
            self._thread.shutdown()


def _write(
    logdir: str | os.PathLike[str], taken: Snapshot, before: pathlib.Path | None
) -> tuple[Written, float]:
    if before is not None and before.exists():
        sync(before)
        sync(before.parent)
    return writing.write(logdir, taken), time.monotonic()
