"""Writes a checkpoint completely or not at all, and reads it back before it counts."""

from __future__ import annotations

import gc
import os
import pathlib
import re
import shutil
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np

from vawm.config import Config
from vawm.errors import InvalidInput
from vawm.process import names
from vawm.runs.checkpoint import arrays, folders, manifest, snapshot
from vawm.runs.checkpoint.manifest import Damaged, Manifest
from vawm.runs.checkpoint.snapshot import Snapshot
from vawm.types import EnvSpec, PyTree


class SaveError(RuntimeError):
    """A checkpoint could not be written; the previous one is intact."""


class Written(NamedTuple):
    """A complete checkpoint, and its size on disk in bytes."""

    path: pathlib.Path
    nbytes: int


def save(
    logdir: str | os.PathLike[str],
    state: PyTree,
    *,
    env_steps: int,
    config: Config,
    spec: EnvSpec,
    progress: Mapping[str, Any],
    episodes: Mapping[str, np.ndarray] | None = None,
) -> pathlib.Path:
    """Writes a `TrainState` and waits until the checkpoint is complete, unlike `Saver`.

    `episodes` are further arrays of any shape, see `restore_episodes`.

    Raises:
      SaveError: see `write`.
    """
    taken = snapshot.take(
        state,
        env_steps=env_steps,
        config=config,
        spec=spec,
        progress=progress,
        episodes=episodes,
    )
    return write(logdir, taken).path


def write(logdir: str | os.PathLike[str], taken: Snapshot) -> Written:
    """Writes a snapshot, then deletes old checkpoints.

    Does not use JAX, so any thread may call it, but only one at a time.

    Before the checkpoint gets its name and an older one is deleted, it is opened as a restore
    would open it, and compared with the snapshot: see `_check`.

    Raises:
      SaveError: nothing was changed, because the disk is full, the files cannot be read back,
        a parameter is not finite, or a checkpoint at these or later env steps exists.
    """
    final = folders.folder(logdir, taken.env_steps)
    refuse_backwards(logdir, taken.env_steps)
    _refuse_nonfinite(taken.arrays.get("params", {}) | taken.arrays.get("model_state", {}))
    scratch = final.with_name(folders.SCRATCH + final.name)
    with arrays.quiet():
        try:
            shutil.rmtree(scratch, ignore_errors=True)
            scratch.mkdir(parents=True)
            for item in taken.leaves:
                arrays.write(scratch / item, taken.arrays[item])
            nbytes = manifest.write(scratch, _manifest(taken))
            _check(scratch, taken)
            scratch.rename(final)
            manifest.sync(final.parent)
        except Exception as error:
            shutil.rmtree(scratch, ignore_errors=True)
            raise SaveError(_why_not_saved(logdir, final, taken.nbytes, error)) from error
        finally:
            gc.collect(1)  # Orbax leaves reference cycles that hold all compressed data
    folders.prune(logdir, taken.config.keep_checkpoints)
    return Written(final, nbytes)


def _check(scratch: pathlib.Path, taken: Snapshot) -> None:
    """Opens a checkpoint that was just written, as a restore would.

    Reads its manifest with all limits on what a checkpoint may hold, and its arrays, see
    `arrays.check`. The checksums were computed from the same files and are not computed again.

    Raises:
      InvalidInput: a restore would refuse it, or would return something else.
    """
    found = manifest.read(scratch)
    if found.leaves != taken.leaves:
        raise Damaged(scratch / manifest.NAME, "lists other leaves than were written")
    for item, written in taken.arrays.items():
        arrays.check(scratch / item, written)


def refuse_backwards(logdir: str | os.PathLike[str], env_steps: int) -> None:
    """Refuses to save at or before the env steps of the newest checkpoint.

    Raises:
      SaveError: there is one at these or later env steps; nothing was changed.
    """
    newest = folders.latest(logdir)
    if newest is not None and env_steps <= int(newest.name):
        path = names.shown(folders.folder(logdir, env_steps))
        raise SaveError(
            f"checkpoint {path} was not written, because a newer one exists, at "
            f"{int(newest.name)} env steps"
        )


def _manifest(taken: Snapshot) -> Manifest:
    return Manifest(
        version=manifest.version(),
        computed=manifest.computed(),
        env_steps=taken.env_steps,
        config=taken.config,
        spec=taken.spec,
        progress=taken.progress,
        leaves=taken.leaves,
        files={},
    )


def _refuse_nonfinite(needed: Mapping[str, np.ndarray]) -> None:
    """Refuses parameters that are not finite."""
    for path, array in needed.items():
        if not np.isfinite(array).all():
            raise SaveError(
                f"no checkpoint was written, because parameter {path} is not finite; start "
                "again with a smaller --optimizer.learning-rate or another --seed"
            )


def _why_not_saved(
    logdir: str | os.PathLike[str], final: pathlib.Path, needed: int, error: Exception
) -> str:
    path = names.shown(final)
    if isinstance(error, InvalidInput):
        how = f"{error.path.name} {error.how}" if isinstance(error, Damaged) else error.remedy
        return (
            f"checkpoint {path} was removed, because it could not be read back: {how[:200]}; "
            f"kept: {folders.kept(logdir)}; check the disk, or copy the run to another, then "
            "continue with --resume"
        )
    reason = (str(error).strip() or repr(error)).splitlines()[0]
    # TensorStore lists files before the system's error, and its own options after it.
    reason = re.split(r" \[\w+='", reason)[0].rpartition('": ')[-1]
    return (
        f"checkpoint {path} could not be written (up to {amount(needed)} needed, "
        f"{free_space(final.parents[1])} free): {reason[:200]}; kept: {folders.kept(logdir)}; "
        "fix the cause, then continue with --resume"
    )


def free_space(folder: str | os.PathLike[str]) -> str:
    """Free space on the disk of `folder`, as text."""
    try:
        return amount(shutil.disk_usage(folder).free)
    except OSError:
        return "an unknown amount"


def amount(nbytes: int) -> str:
    """A size in bytes as text: `"337 B"`, `"1.5 MiB"`, `"57 GiB"`."""
    size, units = float(nbytes), ["B", "KiB", "MiB", "GiB"]
    while size >= 1024 and len(units) > 1:
        size /= 1024
        del units[0]
    digits = 1 if size < 10 and units[0] != "B" else 0
    return f"{size:.{digits}f} {units[0]}"
