"""Saves checkpoints while training continues.

the loop waits for    the previous save to finish, a copy of the state
a thread does         write, checksum, read back, rename, delete old ones (without JAX)
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
from vawm.process import names
from vawm.runs.checkpoint import folders, snapshot, writing
from vawm.runs.checkpoint.manifest import sync
from vawm.runs.checkpoint.snapshot import Snapshot
from vawm.runs.checkpoint.writing import SaveError, Written
from vawm.types import EnvSpec, PyTree

Log = Callable[[dict[str, Any]], None]
SLOW, SLOW_SECONDS = 0.1, 1.0
"""Training may wait this fraction of the time between two saves, or this many seconds, for
the disk before the saver warns."""


class Pending(NamedTuple):
    """A save in progress; its future holds the result and the time of completion."""

    env_steps: int
    began: float
    blocked: float
    future: concurrent.futures.Future[tuple[Written, float]]


class Saver:
    """Writes the checkpoints of one run, at most one at a time; a context manager.

    If a save fails, the next call of any method raises its error. The exit waits for a save
    in progress.

    Args:
      logdir: the folder of the run.
      config: of the run; `save_minutes` counts from now, and from each save.
      spec: of the environment.
      before: a file to write to the disk, as it was when the save started, before the
        checkpoint is complete. After a crash of the machine, no checkpoint is ahead of it.
      log: called with a line about each complete checkpoint: `checkpoint/bytes` of its
        files, `checkpoint/seconds` until it was complete and older ones were deleted, and
        `checkpoint/blocked_seconds`, for which the caller waited.
      say: prints a warning the first time that the caller waits for the previous save for
        more than `SLOW` of the time between the two saves.
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
        """Waits for the previous save, copies the state, and writes it in the background.

        Raises:
          SaveError: the previous save failed, a checkpoint as new as this exists, or the
            folder of the run does not exist any more.
        """
        due = time.monotonic()
        self.wait()
        began = time.monotonic()
        self._tell_if_slow(waited=began - due, interval=began - self._last)
        if not folders.root(self.logdir).parent.is_dir():  # a new folder would be overlooked
            raise SaveError(
                f"no checkpoint was written, because {names.shown(self.logdir)} does not exist "
                "any more; if it was moved, resume it with --resume --logdir NEW_FOLDER"
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
            f"warning: training waited {waited:.0f} s of {interval:.0f} s for the disk; save "
            "less often: use a larger --save-every and --save-minutes"
        )

    def check(self) -> None:
        """Handles the result of a finished save; never waits.

        Raises:
          SaveError: it failed. Its files are removed, and the previous checkpoint is intact.
        """
        if self._pending and self._pending.future.done():
            self.wait()

    def wait(self) -> None:
        """Waits until no save is in progress.

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
            if error is None:  # otherwise the run is already ending with another error
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
