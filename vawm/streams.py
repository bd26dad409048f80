"""Standard output and standard error that a process outlives.

A pipe whose reader ended, a terminal that was closed, a file on a disk that is full: none of
them is a reason to lose a run, whose metrics are in its folder.
"""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterator
from typing import IO, Any


class Lasting:
    """A text file that takes what it is given; once it cannot write, it drops it.

    The first time it says so on standard error, as far as that can be heard.
    """

    def __init__(self, file: IO[str] | None, name: str):
        self._file, self._name = file, name

    def write(self, text: str) -> int:
        if self._file is not None:
            try:
                self._file.write(text)
            except UnicodeError:
                raise
            except (OSError, ValueError) as error:  # ValueError: it was closed
                self._lose(error)
        return len(text)

    def flush(self) -> None:
        if self._file is not None:
            try:
                self._file.flush()
            except (OSError, ValueError) as error:
                self._lose(error)

    def _lose(self, error: OSError | ValueError) -> None:
        file, self._file = self._file, None
        assert file is not None
        with contextlib.suppress(OSError, ValueError):
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, file.fileno())  # where Python flushes what is left, at exit
            os.close(nowhere)
        why = error.strerror if isinstance(error, OSError) else error
        with contextlib.suppress(OSError, ValueError):
            print(f"warning: {self._name} is gone ({why})", file=sys.stderr, flush=True)

    def isatty(self) -> bool:
        return self._file is not None and self._file.isatty()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._file, name)


def lasting() -> tuple[Lasting, Lasting]:
    """Standard output and standard error of this process, to be put in their places.

    One that was closed before the process began takes everything, too.
    """
    return (
        _lasting(sys.stdout, "standard output"),
        _lasting(sys.stderr, "standard error"),
    )


@contextlib.contextmanager
def outlive() -> Iterator[None]:
    """Inside, `sys.stdout` and `sys.stderr` are `lasting()`."""
    before = sys.stdout, sys.stderr
    sys.stdout, sys.stderr = lasting()  # type: ignore[assignment]
    try:
        yield
    finally:
        sys.stdout, sys.stderr = before


def _lasting(file: IO[str] | None, name: str) -> Lasting:
    return file if isinstance(file, Lasting) else Lasting(file, name)
