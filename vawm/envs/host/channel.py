"""Communication between a pool and its workers: messages, and arrays in shared memory."""

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
ALIGNMENT = 64  # bytes, one cache line


class Channel:
    """Pickled messages over a connected socket; every wait can have a timeout.

    The two ends are a process and the one that started it, so unpickling is safe.
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
          OSError: the other end is closed, or accepts nothing for `timeout` seconds.
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
        """Waits for a message; keeps a partly received one if time is up.

        Args:
          deadline: in terms of `time.monotonic()`. A message that has already arrived is
            returned even after the deadline.

        Raises:
          TimeoutError: no complete message by the deadline.
          EOFError: the other end is closed.
        """
        while (message := self._next()) is None:
            wait = None if deadline is None else 1000 * max(0, deadline - time.monotonic())
            if self._end.fileno() < 0:  # closed here; its descriptor may be reused by now
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
        """The first complete message, in a 1-tuple; None if there is none."""
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
    """Opens an empty file in memory, without a name, so that nothing is left behind."""
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
    """Allocates space for `fields` in the file.

    Raises:
      OSError: there is not enough; writing without it would be a bus error.
    """
    size = _place(fields)[1]
    if hasattr(os, "posix_fallocate"):
        os.posix_fallocate(file, 0, size)
    else:
        os.ftruncate(file, size)


def view(file: int, fields: Fields) -> dict[str, np.ndarray]:
    """Arrays in the file, in the order of `fields`, shared by all processes.

    A view of only the first fields has the same arrays at the same place.
    """
    offsets, size = _place(fields)
    memory = mmap.mmap(file, size)
    return {
        name: np.ndarray(shape, dtype, buffer=memory, offset=offsets[name])
        for name, (shape, dtype) in fields.items()
    }


def _place(fields: Fields) -> tuple[dict[str, int], int]:
    """The offset of each array, and the total size, in bytes."""
    offsets, size = {}, 0
    for name, (shape, dtype) in fields.items():
        offsets[name] = size
        size += -(-math.prod(shape) * np.dtype(dtype).itemsize // ALIGNMENT) * ALIGNMENT
    return offsets, size
