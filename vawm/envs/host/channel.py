"""What passes between a pool and its workers: messages, and arrays in memory of both."""

from __future__ import annotations

import math
import mmap
import os
import pickle
import select
import socket
import struct
import tempfile
import time
from collections.abc import Mapping
from typing import Any

import numpy as np

Fields = Mapping[str, tuple[tuple[int, ...], Any]]
"""Name of an array -> shape and dtype."""

LENGTH = struct.Struct("<Q")
ALIGNMENT = 64  # bytes, a cache line: workers write their rows side by side


class Channel:
    """Messages over a connected socket, pickled; every wait can have an end.

    Both ends are ours: a process and the one that started it.
    """

    def __init__(self, end: socket.socket):
        end.setblocking(False)
        self._end = end
        self._arrived = bytearray()
        self._readable, self._writable = select.poll(), select.poll()
        self._readable.register(end, select.POLLIN)
        self._writable.register(end, select.POLLOUT)

    def send(self, message: Any, *, timeout: float | None = None) -> None:
        """Sends a message.

        Raises:
          OSError: the other end is gone, or takes nothing for `timeout` seconds.
        """
        body = pickle.dumps(message, protocol=pickle.HIGHEST_PROTOCOL)
        rest = memoryview(LENGTH.pack(len(body)) + body)
        while rest:
            try:
                rest = rest[self._end.send(rest) :]
            except BlockingIOError:
                wait = None if timeout is None else 1000 * timeout
                if not self._writable.poll(wait):
                    raise TimeoutError from None

    def receive(self, *, deadline: float | None = None) -> Any:
        """Waits for a message; what arrived of one is kept when time is up.

        Args:
          deadline: of `time.monotonic()`. What has arrived by then is returned, however
            late the call is made.

        Raises:
          TimeoutError: nothing whole by the deadline.
          EOFError: the other end is gone.
        """
        while (message := self._next()) is None:
            wait = None if deadline is None else 1000 * max(0, deadline - time.monotonic())
            if self._end.fileno() < 0:  # closed here; its number may be another's by now
                raise EOFError
            if not self._readable.poll(wait):
                raise TimeoutError
            try:
                part = self._end.recv(1 << 16)
            except OSError:
                part = b""
            if not part:
                raise EOFError
            self._arrived += part
        return message[0]

    def _next(self) -> tuple[Any] | None:
        """The first message that has arrived whole, in a tuple of its own."""
        if len(self._arrived) < LENGTH.size:
            return None
        end = LENGTH.size + LENGTH.unpack_from(self._arrived)[0]
        if len(self._arrived) < end:
            return None
        body = bytes(self._arrived[LENGTH.size : end])
        del self._arrived[:end]
        return (pickle.loads(body),)

    def close(self) -> None:
        self._end.close()


def create_file() -> int:
    """A descriptor of an empty file in memory, without a name that could be left behind."""
    if hasattr(os, "memfd_create"):
        try:
            return os.memfd_create("vawm")
        except OSError:  # forbidden in some containers
            pass
    folder = "/dev/shm" if os.access("/dev/shm", os.W_OK) else None
    file, path = tempfile.mkstemp(prefix="vawm-", dir=folder)
    os.unlink(path)
    return file


def reserve(file: int, fields: Fields) -> None:
    """Makes room for `fields`.

    Raises:
      OSError: there is none; writing to a file without room would be a bus error.
    """
    size = _place(fields)[1]
    if hasattr(os, "posix_fallocate"):
        os.posix_fallocate(file, 0, size)
    else:
        os.ftruncate(file, size)


def view(file: int, fields: Fields) -> dict[str, np.ndarray]:
    """Arrays in the file, in the order of `fields`; who views the first ones only sees the
    same. What one process writes, all read."""
    offsets, size = _place(fields)
    memory = mmap.mmap(file, size)
    return {
        name: np.ndarray(shape, dtype, buffer=memory, offset=offsets[name])
        for name, (shape, dtype) in fields.items()
    }


def _place(fields: Fields) -> tuple[dict[str, int], int]:
    """Offsets of the arrays, and the size of all."""
    offsets, size = {}, 0
    for name, (shape, dtype) in fields.items():
        offsets[name] = size
        size += -(-math.prod(shape) * np.dtype(dtype).itemsize // ALIGNMENT) * ALIGNMENT
    return offsets, size
