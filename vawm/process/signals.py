"""Ctrl-C, SIGTERM and SIGHUP: the first stops a run cleanly, a later one kills it."""

from __future__ import annotations

import contextlib
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator

SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
"""Sent by the user, by a scheduler, or when a terminal or a connection closes."""
BURST_SECONDS = 1.0
"""Signals this close together count as one: `timeout` sends two, a terminal signals every
process."""
LAST_SECONDS = 0.5


class Stop:
    """`signal` is the number of the signal that asked the run to stop, or None."""

    signal: int | None = None

    @property
    def exit_code(self) -> int:
        """The shell's exit code for a process ended by `signal`; 0 without one."""
        return 0 if self.signal is None else 128 + self.signal


@contextlib.contextmanager
def catch(
    notify: Callable[[], None] = lambda: None, *, at_end: Callable[[], None] = lambda: None
) -> Iterator[Stop]:
    """Turns the first signal into a request; a later one ends the process at once.

    A thread reads signals from a pipe, because Python runs its own handlers only between
    two calls of compiled code, which can be minutes apart. Python can catch signals only in
    the main thread; elsewhere this does nothing. SIGHUP stays ignored if it is already, as
    under `nohup`. SIGINT is caught even if it is ignored, because scripts ignore it for
    everything they start with `&`.

    Args:
      notify: called at the first signal, in the thread that reads signals.
      at_end: called before a later one ends the process, which waits `LAST_SECONDS` for it.
    """
    stop, asked = Stop(), 0.0
    ignored = signal.getsignal(signal.SIGHUP) == signal.SIG_IGN
    caught = [number for number in SIGNALS if number != signal.SIGHUP or not ignored]
    if threading.current_thread() is not threading.main_thread():
        yield stop
        return
    reader, writer = os.pipe()
    os.set_blocking(writer, False)

    def listen() -> None:
        nonlocal asked
        while received := os.read(reader, 1):
            if received[0] not in caught:
                continue
            if stop.signal is None:
                stop.signal, asked = received[0], time.monotonic()
                with contextlib.suppress(BaseException):  # the terminal may be closed
                    notify()
            elif time.monotonic() - asked > BURST_SECONDS:
                last = threading.Thread(target=at_end, daemon=True)
                last.start()
                last.join(LAST_SECONDS)  # a terminal that is stopped would block it
                os._exit(128 + received[0])

    thread = threading.Thread(target=listen, daemon=True)
    previous = {number: signal.signal(number, lambda *_: None) for number in caught}
    previous_fd = signal.set_wakeup_fd(writer, warn_on_full_buffer=False)
    thread.start()
    try:
        yield stop
    finally:
        signal.set_wakeup_fd(previous_fd)
        for number, handler in previous.items():
            signal.signal(number, handler)
        os.close(writer)
        thread.join()
        os.close(reader)
