"""A path to a folder that has no special characters, whatever the folder is called.

Orbax expands `[`, `*`, `?` and backslashes of the whole path when it merges its files, and then
silently finds none; it takes `gs:/` for a URL; TensorStore refuses names that are not UTF-8.
The folder's own name is therefore never shown to them.
"""

from __future__ import annotations

import contextlib
import os
import pathlib
import tempfile
from collections.abc import Iterator

DESCRIPTORS = pathlib.Path("/proc/self/fd")
"""Where Linux names the open files of this process, folders too."""


@contextlib.contextmanager
def plain(folder: pathlib.Path) -> Iterator[pathlib.Path]:
    """A path of letters, digits and slashes to the existing `folder`, for the `with` block.

    It leads to the same folder even if that is renamed meanwhile. Other threads may use it.
    Without `/proc`, it is a link in the folder for temporary files.

    Raises:
      OSError: the folder does not exist or cannot be opened.
    """
    descriptor = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        path = DESCRIPTORS / str(descriptor)
        if path.is_dir():
            yield path
        else:
            with tempfile.TemporaryDirectory(prefix="vawm") as private:
                link = pathlib.Path(private) / "folder"
                link.symlink_to(folder.absolute(), target_is_directory=True)
                yield link
    finally:
        os.close(descriptor)
