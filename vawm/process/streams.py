"""Standard output and standard error that a process outlives.

A pipe whose reader ended, a terminal that was closed, a file on a disk that is full: none of
them is a reason to lose a run, whose metrics are in its folder.
"""

from __future__ import annotations

import contextlib
import os
import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from typing import IO, Any


class Lasting:
    """A text file that takes what it is given; once it cannot write, it drops it.

    The first time it says so on standard error, as far as that can be heard. What is written
    past it, to `buffer` or `fileno()`, is not its business.
    """

    def __init__(self, file: IO[str], name: str):
        self._file, self._name = file, name
        self._gone, self._lock = False, threading.Lock()

    def write(self, text: str) -> int:
        self._try(self._file.write, text)
        return len(text)

    def writelines(self, lines: Iterable[str]) -> None:
        for line in lines:
            self.write(line)

    def flush(self) -> None:
        self._try(self._file.flush)

    def finish(self) -> None:
        """Flushes, or loses what cannot be: Python's own flush at exit would cost the code."""
        self._try(self._file.flush, last=True)

    def _try(self, call: Callable[..., object], *arguments: str, last: bool = False) -> None:
        if self._gone:
            return
        try:
            call(*arguments)
        except UnicodeError:
            raise
        except (OSError, ValueError) as error:  # ValueError: it was closed
            # A pipe that is full for the moment has lost this text alone.
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
                os.dup2(nowhere, number)  # where Python flushes what is left, at exit
                os.close(nowhere)
        why = error.strerror if isinstance(error, OSError) else error
        with contextlib.suppress(OSError, ValueError):
            print(f"warning: {self._name} is gone ({why})", file=sys.stderr, flush=True)

    def isatty(self) -> bool:
        return not self._gone and self._file.isatty()

    def __getattr__(self, name: str) -> Any:
        if name.startswith("_"):  # while it is being copied it has none of its own
            raise AttributeError(name)
        return getattr(self._file, name)


@contextlib.contextmanager
def outlive() -> Iterator[None]:
    """Inside, `sys.stdout` and `sys.stderr` are `Lasting`. One that was closed before the
    process began takes everything, and its number does not go to the next file."""
    _open_closed()
    before = sys.stdout, sys.stderr
    ours = tuple(map(_lasting, before, ("standard output", "standard error")))
    sys.stdout, sys.stderr = ours
    try:
        yield
    finally:
        # Unless someone put another one in its place: inside, or in another thread.
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
    """Gives the numbers 0 to 2 to nothing, where they are free."""
    while (number := os.open(os.devnull, os.O_RDWR)) <= 2:
        os.set_inheritable(number, True)
    os.close(number)
