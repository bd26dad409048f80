"""Lets a process survive the loss of its standard output and standard error.

A run must not fail because the reader of a pipe ended, a terminal was closed, a disk is full or
a character cannot be encoded: its metrics are in its folder.
"""

from __future__ import annotations

import contextlib
import os
import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from typing import IO, Any


class Lasting:
    """A text file that drops all text once a write has failed.

    Prints one warning to standard error, if that still works. Writes to `buffer` or
    `fileno()` are not covered.
    """

    def __init__(self, file: IO[str], name: str):
        self._file, self._name = file, name
        self._gone, self._lock = False, threading.Lock()

    def write(self, text: str) -> int:
        r"""Writes the text; characters that the file's encoding lacks as `\xe9` or `\udcff`."""
        try:
            self._try(self._file.write, text)
        except UnicodeEncodeError as error:
            encoded = text.encode(error.encoding, "backslashreplace")
            self._try(self._file.write, encoded.decode(error.encoding))
        return len(text)

    def writelines(self, lines: Iterable[str]) -> None:
        for line in lines:
            self.write(line)

    def flush(self) -> None:
        self._try(self._file.flush)

    def finish(self) -> None:
        """Flushes, or drops the rest: a failing flush at exit would change the exit code."""
        self._try(self._file.flush, last=True)

    def _try(self, call: Callable[..., object], *arguments: str, last: bool = False) -> None:
        if self._gone:
            return
        try:
            call(*arguments)
        except UnicodeError:
            raise
        except (OSError, ValueError) as error:  # ValueError: it was closed
            # BlockingIOError: the pipe is full right now, so only this text is lost.
            if last or not isinstance(error, BlockingIOError):
                self._lose(error)

    def _lose(self, error: OSError | ValueError) -> None:
        with self._lock:
            if self._gone:
                return
            self._gone = True
        with contextlib.suppress(OSError, ValueError):
            if (number := self._file.fileno()) in (1, 2):
                nowhere = os.open(os.devnull, os.O_WRONLY)
                os.dup2(nowhere, number)  # Python flushes the rest there at exit
                os.close(nowhere)
        why = error.strerror if isinstance(error, OSError) else error
        with contextlib.suppress(OSError, ValueError):
            message = f"warning: {self._name} is closed ({why}); its further text is dropped"
            print(message, file=sys.stderr, flush=True)

    def isatty(self) -> bool:
        return not self._gone and self._file.isatty()

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):  # while being copied, it has no attributes yet
            raise AttributeError(name)
        return getattr(self._file, name)


@contextlib.contextmanager
def outlive() -> Iterator[None]:
    """Makes `sys.stdout` and `sys.stderr` `Lasting` inside the `with` block.

    If one was closed before the process started, text written to it is dropped, and its file
    descriptor is kept from the next file that is opened.
    """
    _open_closed()
    before = sys.stdout, sys.stderr
    ours = tuple(map(_lasting, before, ("standard output", "standard error")))
    sys.stdout, sys.stderr = ours
    try:
        yield
    finally:
        # Unless other code replaced it, inside the block or in another thread.
        if sys.stdout is ours[0]:
            sys.stdout = before[0]
        if sys.stderr is ours[1]:
            sys.stderr = before[1]
        for stream in ours:
            stream.finish()


def _lasting(file: IO[str] | None, name: str) -> Any:
    if file is None:
        file = open(os.devnull, "w")  # noqa: SIM115
    return file if isinstance(file, Lasting) else Lasting(file, name)


def _open_closed() -> None:
    """Opens the null device on each of the descriptors 0 to 2 that is free."""
    while (number := os.open(os.devnull, os.O_RDWR)) <= 2:
        os.set_inheritable(number, True)
    os.close(number)
