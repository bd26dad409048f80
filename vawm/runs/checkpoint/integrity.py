"""Compares the files of a checkpoint with its manifest."""

from __future__ import annotations

import os
import pathlib
import stat
from collections.abc import Collection

from vawm.runs.checkpoint.manifest import Damaged, Manifest, item_of, sha256


def verify(folder: pathlib.Path, manifest: Manifest, items: Collection[str]) -> None:
    """Compares every file of `items` with its size and checksum; cheap comparisons first.

    Raises:
      Damaged: names the first file that is missing, truncated, changed, a link, or not in
        the manifest.
    """
    files = {name: file for name, file in manifest.files.items() if item_of(name) in items}
    for name, (size, _) in files.items():
        actual = _size(folder, name)
        if actual != size:
            raise Damaged(folder / name, f"has {actual} bytes instead of {size}")
    _refuse_others(folder, manifest, items)
    for name, (_, digest) in files.items():
        try:
            matches = sha256(folder / name) == digest
        except OSError as error:
            raise Damaged(folder / name, f"cannot be read ({error.strerror})") from error
        if not matches:
            raise Damaged(folder / name, "does not match its checksum")


def _refuse_others(folder: pathlib.Path, manifest: Manifest, items: Collection[str]) -> None:
    """Refuses files that are not in the manifest, because Orbax might read them."""
    for item in items:
        for where, _, names in os.walk(folder / item):
            for name in names:
                path = pathlib.Path(where, name)
                if path.relative_to(folder).as_posix() not in manifest.files:
                    raise Damaged(path, "is not in the manifest")


def _size(folder: pathlib.Path, name: str) -> int:
    """Size in bytes of a regular file in the folder; refuses symbolic links."""
    path = folder
    for part in ("", *pathlib.PurePosixPath(name).parts):
        path = path / part
        try:
            status = path.lstat()
        except OSError as error:
            raise Damaged(folder / name, "is missing") from error
        if stat.S_ISLNK(status.st_mode):
            raise Damaged(path, "is a symbolic link")
    if not stat.S_ISREG(status.st_mode):
        raise Damaged(path, "is not a file")
    return status.st_size
