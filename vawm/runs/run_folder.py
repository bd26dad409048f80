"""The folder of one run: who may use it, and what it says it holds."""

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

from vawm import config as config_lib
from vawm.config import Config
from vawm.errors import InvalidInput
from vawm.runs.checkpoint import manifest as manifest_lib

HELD = (errno.EAGAIN, errno.EACCES)
NO_LOCKS = (errno.ENOSYS, errno.ENOLCK, errno.EOPNOTSUPP, errno.EINVAL)
"""What a lock fails with where another has it, and where the file system has none."""
LOCK, CONFIG, REPLACED = "lock", "config.json", "replaced-"


def check_new(logdir: pathlib.Path) -> None:
    """Refuses a folder that cannot be made, written to, or holds something already.

    Raises:
      InvalidInput: nothing was written.
    """
    check_writable(logdir)
    if logdir.is_dir() and any(path.name != LOCK for path in logdir.iterdir()):
        others = "start over with --fresh or choose another --logdir"
        remedy = f"exists; continue that run with --resume, {others}"
        raise InvalidInput("logdir", str(logdir), remedy)


def check_writable(folder: pathlib.Path, name: str = "logdir") -> None:
    """Refuses a path at which no folder can be written; `name` is the option it came from.

    Raises:
      InvalidInput: nothing was written.
    """
    try:
        nearest = folder.absolute()
        while not nearest.exists():
            nearest = nearest.parent
        usable = nearest.is_dir() and os.access(nearest, os.W_OK | os.X_OK)
    except OSError:
        usable = False
    if not usable:
        remedy = f"is not writable; choose another --{name}"
        raise InvalidInput(name, str(folder), remedy)


def check_fresh(logdir: pathlib.Path) -> None:
    """Refuses to start over where no run is, and something else.

    Raises:
      InvalidInput: `put_aside` would move files of which this package knows nothing.
    """
    check_writable(logdir)
    names = [path.name for path in logdir.iterdir()] if logdir.is_dir() else []
    ours = rf"{LOCK}|{re.escape(CONFIG)}\.tmp|{REPLACED}\d+"
    others = [name for name in names if not re.fullmatch(ours, name)]
    saved = any(logdir.glob(f"checkpoints/{'[0-9]' * 12}"))
    begun = [logdir / CONFIG, *logdir.glob(f"{REPLACED}*/{CONFIG}")]  # or put aside in part
    if others and not saved and not any(map(_content, begun)):
        remedy = "holds files, but no run to start over; choose another --logdir"
        raise InvalidInput("logdir", str(logdir), remedy)


@contextlib.contextmanager
def claim(logdir: pathlib.Path, *, say: Callable[[str], None] = print) -> Iterator[None]:
    """Makes the folder and holds it for this process alone.

    The kernel gives the lock back when a process ends, however it ends. Where the file system
    has no locks, `say` is told so.

    Raises:
      InvalidInput: another process holds it, or the folder cannot be made.
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
                f"WARNING: the file system of {logdir} has no locks ({error.strerror}): "
                "nothing keeps a second run out of this folder"
            )
        file.truncate(0)
        file.write(f"process {os.getpid()} on {socket.gethostname()}\n")
        file.flush()
        yield


def write_config(logdir: pathlib.Path, config: Config) -> None:
    """Writes `config.json`: all choices of the run and what wrote them.

    Raises:
      OSError: it could not be written; the folder is as it was before.
    """
    content = {
        "schema": manifest_lib.SCHEMA,
        "vawm": manifest_lib.version(),
        "config": config_lib.as_dict(config),
    }
    scratch = logdir / (CONFIG + ".tmp")
    try:
        scratch.write_text(json.dumps(content, indent=2) + "\n")
        scratch.replace(logdir / CONFIG)
    except OSError:
        scratch.unlink(missing_ok=True)
        raise


def read_config(logdir: pathlib.Path) -> Config | None:
    """What `write_config` wrote into `logdir`; None where no run was started.

    Raises:
      OtherVersion: it has other choices than this one knows.
    """
    path = logdir / CONFIG
    content = _content(path)
    if content is None:
        return None
    try:
        return manifest_lib.config_from_dict(content["config"])
    except InvalidInput as error:
        written = content["vawm"]
        raise manifest_lib.OtherVersion("logdir", path, error, written=written) from error


def _content(path: pathlib.Path) -> dict[str, Any] | None:
    """What `write_config` wrote; None where it is something else."""
    try:
        content = json.loads(path.read_text())
    except (OSError, ValueError, RecursionError):
        return None
    if not isinstance(content, dict) or not {"schema", "vawm", "config"} <= content.keys():
        return None
    return None if "format" in content else content  # of an exported policy


def put_aside(logdir: pathlib.Path) -> pathlib.Path | None:
    """Moves all that is in the folder into a new `replaced-<number>` in it; None if nothing.

    What earlier calls have put aside stays where it is. `config.json` and the checkpoints go
    first: what is left if this is interrupted is no run that would be resumed.

    Raises:
      OSError: something cannot be moved.
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
    """Removes what a run measured that saved nothing; it is about to measure it again."""
    lines = ("metrics.jsonl*", "checkpoints.jsonl*", "videos.jsonl*")
    for pattern in (*lines, "events.out.tfevents.*", "videos/*", "diagnosis.json"):
        for path in logdir.glob(pattern):
            path.unlink()
