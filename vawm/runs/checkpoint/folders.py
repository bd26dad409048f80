"""Where the checkpoints of a run are, which of them stay, and under which names."""

from __future__ import annotations

import os
import pathlib
import shutil

from vawm.errors import InvalidInput

SCRATCH, DAMAGED = "tmp-", "damaged-"
"""What the names begin with of one that is not complete, and of one that was set aside."""


def root(logdir: str | os.PathLike[str]) -> pathlib.Path:
    """Where the checkpoints of a run are."""
    return pathlib.Path(logdir).expanduser().absolute() / "checkpoints"


def folder(logdir: str | os.PathLike[str], env_steps: int) -> pathlib.Path:
    """Where the checkpoint at `env_steps` is, or will be."""
    return root(logdir) / f"{env_steps:012d}"


def complete(logdir: str | os.PathLike[str]) -> list[pathlib.Path]:
    """All that have been completed, the newest first; whether they are whole is not asked.

    Raises:
      InvalidInput: nobody here may look into the folder.
    """
    folder = root(logdir)
    try:
        names = [name for name in os.listdir(folder) if _is_step(name)]
    except (FileNotFoundError, NotADirectoryError):
        return []
    except PermissionError as error:
        raise InvalidInput(
            "logdir", str(logdir), f"cannot be read ({error.strerror})"
        ) from error
    return [folder / name for name in sorted(names, key=int, reverse=True)]


def _is_step(name: str) -> bool:
    return name.isascii() and name.isdigit() and len(name) < 20


def latest(logdir: str | os.PathLike[str]) -> pathlib.Path | None:
    """The newest complete checkpoint, or None; `find` tells whether it is whole."""
    return next(iter(complete(logdir)), None)


def kept(logdir: str | os.PathLike[str]) -> str:
    """What there is to go on from, for a message."""
    newest = latest(logdir)
    return f"the checkpoint at {int(newest.name)}" if newest else "no checkpoint yet"


def set_aside(path: pathlib.Path) -> pathlib.Path:
    """Renames a damaged checkpoint, so that no run meets it again; returns its new place.

    Raises:
      OSError: it cannot be renamed.
    """
    number, aside = 1, path.with_name(DAMAGED + path.name)
    while os.path.lexists(aside):
        number += 1
        aside = path.with_name(f"{DAMAGED}{path.name}-{number}")
    path.rename(aside)
    return aside


def prune(logdir: str | os.PathLike[str], keep: int) -> None:
    """Deletes all but the newest `keep`, and what a killed run left unfinished.

    One that goes is renamed first, so that half of it is never taken for a checkpoint.
    """
    for path in complete(logdir)[keep:]:
        try:
            path.rename(path.with_name(SCRATCH + path.name))
        except OSError:  # the next save tries again
            continue
    for path in root(logdir).glob(SCRATCH + "*"):
        shutil.rmtree(path, ignore_errors=True)
