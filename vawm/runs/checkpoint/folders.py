"""The folders of a run's checkpoints: their names, listing, and deletion."""

from __future__ import annotations

import os
import pathlib
import re
import shutil

from vawm.errors import InvalidInput

SCRATCH, DAMAGED = "tmp-", "damaged-"
"""Prefixes of the names of incomplete checkpoints and of damaged ones that were renamed."""


URL = re.compile(r"[A-Za-z][A-Za-z0-9+.-]+:")
"""The first part of a URL such as `gs://bucket/run`."""


def expanded(path: str | os.PathLike[str], name: str = "logdir") -> pathlib.Path:
    """`path` with the home of its user for `~`; `name` is the option that it comes from.

    Raises:
      InvalidInput: it is a URL, names an unknown user, or holds a zero byte.
    """
    text = os.fspath(path)
    if "\0" in text:
        raise InvalidInput(name, text, "holds a zero byte, which no name of a file can hold")
    whole = pathlib.Path(text)
    if len(whole.parts) > 1 and URL.fullmatch(whole.parts[0]) and not whole.exists():
        remedy = "is a URL; use a folder, such as one where the bucket is mounted"
        raise InvalidInput(name, text, f"{remedy} (a folder of this name by its full path)")
    try:
        return whole.expanduser()
    except RuntimeError as error:
        remedy = "names the home of an unknown user; give the full path of the folder"
        raise InvalidInput(name, text, remedy) from error


def root(logdir: str | os.PathLike[str]) -> pathlib.Path:
    """The folder of all checkpoints of a run.

    Raises:
      InvalidInput: see `expanded`.
    """
    return expanded(logdir).absolute() / "checkpoints"


def folder(logdir: str | os.PathLike[str], env_steps: int) -> pathlib.Path:
    """The folder of the checkpoint at `env_steps`, which need not exist."""
    return root(logdir) / f"{env_steps:012d}"


def complete(logdir: str | os.PathLike[str]) -> list[pathlib.Path]:
    """All complete checkpoints, newest first; does not check them for damage.

    Raises:
      InvalidInput: no permission to read the folder.
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
    """The newest complete checkpoint, or None; `find` also checks for damage."""
    return next(iter(complete(logdir)), None)


def kept(logdir: str | os.PathLike[str]) -> str:
    """Describes the newest checkpoint, for a message."""
    newest = latest(logdir)
    return f"the checkpoint at {int(newest.name)}" if newest else "no checkpoint yet"


def set_aside(path: pathlib.Path) -> pathlib.Path:
    """Renames a damaged checkpoint, so that no run reads it again; returns the new path.

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
    """Deletes all but the newest `keep` checkpoints, and the incomplete ones of killed runs.

    Renames a checkpoint before deleting it, so that a partly deleted one is never used.
    """
    for path in complete(logdir)[keep:]:
        try:
            path.rename(path.with_name(SCRATCH + path.name))
        except OSError:  # the next save tries again
            continue
    for path in root(logdir).glob(SCRATCH + "*"):
        shutil.rmtree(path, ignore_errors=True)
