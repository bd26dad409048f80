"""The folder of a run: its checks, its lock and its `config.json`."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import json
import os
import pathlib
import re
import socket
from collections.abc import Callable, Iterator
from typing import Any

from vawm.config import Config, as_dict
from vawm.envs import made as records
from vawm.errors import InvalidInput
from vawm.process import names
from vawm.runs.checkpoint import manifest
from vawm.types import Made

HELD = (errno.EAGAIN, errno.EACCES)
NO_LOCKS = (errno.ENOSYS, errno.ENOLCK, errno.EOPNOTSUPP, errno.EINVAL)
"""Errors of a lock that another process holds, and of file systems without locks."""
LOCK, CONFIG, REPLACED = "lock", "config.json", "replaced-"
LONGEST_INSIDE = 200
"""Bytes of the longest path inside the folder of a run, rounded up: a checkpoint's files, an
event file with the name of a machine, `replaced-<number>` before either."""


def check_new(logdir: pathlib.Path) -> None:
    """Refuses a folder that is not writable or not empty; writes nothing.

    Raises:
      InvalidInput: it is not writable or not empty.
    """
    check_writable(logdir)
    if not logdir.is_dir() or all(path.name == LOCK for path in logdir.iterdir()):
        return
    others = "start over with --fresh or choose another --logdir"
    if _has_checkpoints(logdir) or _content(logdir / CONFIG):
        remedy = f"already exists; continue that run with --resume, {others}"
    elif may_start_over(logdir):
        remedy = f"holds a run that was put aside; {others}"
    else:
        remedy = "contains files, but no run; choose another --logdir"
    raise InvalidInput("logdir", str(logdir), remedy)


def check_writable(folder: pathlib.Path, name: str = "logdir") -> None:
    """Refuses a folder that is not writable; `name` is its command-line option.

    Raises:
      InvalidInput: it is not writable, or its path is too long; nothing was written.
    """
    try:
        check_length(folder, name)
        nearest = folder.absolute()
        while not nearest.exists():
            nearest = nearest.parent
        usable = nearest.is_dir() and os.access(nearest, os.W_OK | os.X_OK)
    except OSError:
        usable = False
    if not usable:
        remedy = f"is not writable; choose another --{name}"
        raise InvalidInput(name, str(folder), remedy)


def check_length(folder: pathlib.Path, name: str) -> None:
    """Refuses a folder whose full path leaves no room for the files inside.

    Raises:
      InvalidInput: a name in it is too long, or all together.
    """
    limits = {which: os.pathconf("/", f"PC_{which}_MAX") for which in ("NAME", "PATH")}
    longest = max(len(os.fsencode(part)) for part in folder.absolute().parts)
    if longest > limits["NAME"]:
        remedy = f"has a name of {longest} bytes; use names of at most {limits['NAME']}"
        raise InvalidInput(name, str(folder), remedy)
    length, most = len(os.fsencode(folder.absolute())), limits["PATH"] - LONGEST_INSIDE
    if length > most:
        remedy = f"is a path of {length} bytes; use one of at most {most}"
        raise InvalidInput(name, str(folder), remedy)


def check_fresh(logdir: pathlib.Path) -> None:
    """Refuses to start over in a folder with other files than those of a run.

    Raises:
      InvalidInput: `put_aside` would move files that this package did not write.
    """
    check_writable(logdir)
    if not may_start_over(logdir):
        remedy = "contains files, but no run to start over; choose another --logdir"
        raise InvalidInput("logdir", str(logdir), remedy)


def may_start_over(logdir: pathlib.Path) -> bool:
    """Whether `put_aside` would move only files that this package has written."""
    names = [path.name for path in logdir.iterdir()] if logdir.is_dir() else []
    ours = rf"{LOCK}|{re.escape(CONFIG)}\.tmp|{REPLACED}\d+"
    others = [name for name in names if not re.fullmatch(ours, name)]
    # In `replaced-*` if an earlier `put_aside` was interrupted.
    begun = [logdir / CONFIG, *logdir.glob(f"{REPLACED}*/{CONFIG}")]
    return not others or _has_checkpoints(logdir) or any(map(_content, begun))


def _has_checkpoints(logdir: pathlib.Path) -> bool:
    return any(logdir.glob(f"checkpoints/{'[0-9]' * 12}"))


@contextlib.contextmanager
def claim(logdir: pathlib.Path, *, say: Callable[[str], None] = print) -> Iterator[None]:
    """Makes the folder and locks it for this process.

    The kernel releases the lock when the process ends, in whatever way. `say` prints a
    warning if the file system has no locks.

    Raises:
      InvalidInput: another process holds the lock, or the folder cannot be made.
    """
    try:
        logdir.mkdir(parents=True, exist_ok=True)
        file = (logdir / LOCK).open("a+")
    except OSError as error:
        remedy = f"is not writable ({error.strerror}); choose another --logdir"
        raise InvalidInput("logdir", str(logdir), remedy) from error
    with file:
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            if error.errno in HELD:
                file.seek(0)
                holder = file.read().strip() or "another process"
                remedy = f"is in use by {holder}; wait for it or choose another --logdir"
                raise InvalidInput("logdir", str(logdir), remedy) from error
            if error.errno not in NO_LOCKS:
                raise
            say(
                f"WARNING: the file system of {names.shown(logdir)} has no locks "
                f"({error.strerror}); do not start a second run in this folder"
            )
        file.truncate(0)
        file.write(f"process {os.getpid()} on {socket.gethostname()}\n")
        file.flush()
        yield


def write_config(logdir: pathlib.Path, config: Config, made: Made | None = None) -> None:
    """Writes `config.json`: all choices of the run and the version that wrote them.

    `made` says how the environments were made.

    Raises:
      OSError: it could not be written; the folder is unchanged.
    """
    content = {
        "schema": manifest.SCHEMA,
        "vawm": manifest.version(),
        "config": as_dict(config),
        "environments": None if made is None else records.as_dict(made),
    }
    scratch = logdir / (CONFIG + ".tmp")
    try:
        scratch.write_text(json.dumps(content, indent=2) + "\n")
        scratch.replace(logdir / CONFIG)
    except OSError:
        scratch.unlink(missing_ok=True)
        raise


def read_config(logdir: pathlib.Path) -> Config | None:
    """Reads what `write_config` wrote to `logdir`; None if no run was started there.

    Raises:
      OtherVersion: it has fields that this version does not know.
    """
    path = logdir / CONFIG
    content = _content(path)
    if content is None:
        return None
    try:
        return manifest.config_from_dict(content["config"])
    except InvalidInput as error:
        written = content["vawm"]
        raise manifest.OtherVersion("logdir", path, error, written=written) from error


def read_made(logdir: pathlib.Path) -> Made | None:
    """How the environments of the run in `logdir` were made; None if it does not say.

    Raises:
      InvalidInput: the record is damaged.
    """
    path = logdir / CONFIG
    content = (_content(path) or {}).get("environments")
    try:
        return None if content is None else records.from_dict(content)
    except ValueError as error:
        raise InvalidInput("logdir", str(path), f"is damaged: {error}") from error


def _content(path: pathlib.Path) -> dict[str, Any] | None:
    """What `write_config` wrote; None if the file has other content."""
    try:
        content = json.loads(path.read_text())
    except (OSError, ValueError, RecursionError):
        return None
    if not isinstance(content, dict) or not {"schema", "vawm", "config"} <= content.keys():
        return None
    return None if "format" in content else content  # "format": an exported policy


def put_aside(logdir: pathlib.Path) -> pathlib.Path | None:
    """Moves the content of the folder to a new `replaced-<number>` in it.

    Earlier `replaced-<number>` stay in place. `config.json` and the checkpoints are moved
    first, so that after an interruption the rest cannot be resumed.

    Returns:
      The new folder, or None if there was nothing to move.

    Raises:
      OSError: a file cannot be moved.
    """
    kept = (LOCK, f"{REPLACED}*")
    found = [p for p in sorted(logdir.iterdir()) if not any(map(p.match, kept))]
    if not found:
        return None
    number = 1
    while (aside := logdir / f"{REPLACED}{number}").exists():
        number += 1
    aside.mkdir()
    for path in sorted(found, key=lambda path: path.name not in (CONFIG, "checkpoints")):
        path.rename(aside / path.name)
    return aside


def clear(logdir: pathlib.Path) -> None:
    """Deletes the metrics of a run without a checkpoint, before it starts again."""
    lines = ("metrics.jsonl*", "checkpoints.jsonl*", "videos.jsonl*")
    for pattern in (*lines, "events.out.tfevents.*", "videos/*", "diagnosis.json"):
        for path in logdir.glob(pattern):
            path.unlink()
