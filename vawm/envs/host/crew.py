"""The workers of a pool: starts them, sends them orders, collects answers, ends them.

If a worker dies or hangs, each of its environments gets a `Trouble`. Every wait has a limit:
if a call of a simulator takes longer than `timeout`, its worker is killed.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
import weakref
from collections.abc import Callable, Collection, Mapping
from typing import Any

import numpy as np

from vawm.envs.host.channel import Channel, Fields, create_file, reserve, view
from vawm.envs.host.usable import one_line
from vawm.envs.host.worker import (
    IDLE,
    TELL,
    Answer,
    Description,
    Trouble,
    control_fields,
)
from vawm.errors import InvalidInput

TELL_SECONDS = 0.5
"""Time for a hanging process to report its traceback."""
DEATH_SECONDS = 5.0
"""Time for a killed process to end. One that waits for a device takes longer; it is left."""
CLOSE_SECONDS = 5.0
"""Time for simulators to close properly, for example to finish a video."""
BOOT = (
    "import json, sys; sys.path[:] = json.loads(sys.argv[1]); "
    "from vawm.envs.host.worker import main; main()"
)


class Handle:
    """The pool's side of one worker.

    Attributes:
      index: among the workers; worker w of W runs environments w, w + W, ...
      envs: the environments it runs.
      ready: whether it has all its simulators; False after `kill`.
      channel: to the worker.
      process: the worker. It leads its own process group, so Ctrl-C in a terminal does not
        reach it, and processes that a simulator started end with it.
    """

    def __init__(self, index: int, workers: int, num_envs: int, memory: int):
        self.index = index
        self.envs = tuple(range(index, num_envs, workers))
        self.ready = False
        self._crash = create_file()
        ours, theirs = socket.socketpair()
        self.channel = Channel(ours)
        settings = {
            "index": index,
            "workers": workers,
            "num_envs": num_envs,
            "channel": theirs.fileno(),
            "memory": memory,
            "crash": self._crash,
            "parent": os.getpid(),
            "by_kernel": threading.current_thread() is threading.main_thread(),
        }
        # "" on the path means the current folder, for example of a notebook.
        path = [folder or os.getcwd() for folder in sys.path if isinstance(folder, str)]
        options = "-uP"  # -u: print without buffering; -P: add no folder to the path
        command = [sys.executable, options, "-c", BOOT, json.dumps(path), json.dumps(settings)]
        try:
            self.process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=standard_error(),  # keep standard output for the run itself
                pass_fds=(theirs.fileno(), memory, self._crash),
                process_group=0,
                env=variables(),
            )
        except BaseException:
            self._release()
            raise
        finally:
            theirs.close()

    def where(self) -> str:
        """Asks a worker that does not answer for its traceback; "" if it sends none."""
        with contextlib.suppress(OSError):
            os.kill(self.process.pid, TELL)
        end = time.monotonic() + TELL_SECONDS
        while not (said := self.last_words()) and time.monotonic() < end:
            time.sleep(0.01)
        return said

    def last_words(self) -> str:
        """The traceback that the interpreter wrote after a crash or on request."""
        return os.pread(self._crash, 1 << 16, 0).decode(errors="replace")

    def kill(self) -> str:
        """Kills the process and what it started; returns how it ended.

        A process that had already ended keeps its exit code. It was not waited for before,
        so its process id cannot have been reused yet.
        """
        if self._crash < 0:
            return ""
        with contextlib.suppress(ProcessLookupError, PermissionError):
            os.killpg(self.process.pid, signal.SIGKILL)
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.process.wait(DEATH_SECONDS)
        self._release()
        code = self.process.returncode
        if code is None:
            return "did not end when killed"
        if code >= 0:
            return f"exited with code {code}"
        names = {number.value: number.name for number in signal.Signals}
        return f"was killed by {names.get(-code, f'signal {-code}')}"

    def _release(self) -> None:
        self.ready = False
        self.channel.close()
        os.close(self._crash)
        self._crash = -1


class Crew:
    """All workers of a pool.

    Attributes:
      size: how many there are.
      timeout: seconds that a call of a simulator may take.
    """

    def __init__(self, num_envs: int, workers: int, timeout: float):
        """Prepares the workers; starts none yet.

        Args:
          num_envs: N, over all workers.
          workers: number of workers; 0 for one per core. Never more than N.
          timeout: seconds that a call of a simulator may take.
        """
        self.size = min(num_envs, workers or cores())
        self.timeout = timeout
        self._num_envs = num_envs
        self._handles: list[Handle] = []
        self._file = create_file()
        self._stop = weakref.finalize(self, stop, self._handles, self._file, os.getpid())
        self._control = self.share(control_fields(self.size))
        self._ticket = 0
        self._told: list[Handle] = []

    @property
    def closed(self) -> bool:
        """Whether the crew has been closed."""
        return not self._stop.alive

    def share(self, fields: Fields) -> dict[str, np.ndarray]:
        """Arrays in shared memory; `fields` must start with those shared before."""
        reserve(self._file, fields)
        return view(self._file, fields)

    def start_missing(self) -> list[int]:
        """Starts every worker that is missing or lost.

        Returns:
          The environments of the new workers: they have no simulator yet, see `build`.
        """
        empty: list[int] = []
        for index in range(self.size):
            if index < len(self._handles) and self._handles[index].ready:
                continue
            for handle in self._handles[index : index + 1]:
                handle.kill()
            self._control["environment"][index] = IDLE
            self._control["began"][index] = time.monotonic()
            handle = Handle(index, self.size, self._num_envs, self._file)
            self._handles[index : index + 1] = [handle]
            empty += handle.envs
        return empty

    def tell(
        self, name: str, payloads: Mapping[int, Any], *, timeout: float | None = None
    ) -> None:
        """Sends an order to the workers of some environments; `hear` waits for the answers.

        Args:
          name: a method of `Worker`.
          payloads: environment -> its argument.
          timeout: seconds in which a worker must accept the order; default `self.timeout`.
        """
        self._ticket += 1
        self._told = []
        for handle in self._handles:
            part = {env: payloads[env] for env in handle.envs if env in payloads}
            if part:
                self._told.append(handle)
                with contextlib.suppress(OSError):  # `hear` finds the cause
                    order = self._ticket, name, part
                    handle.channel.send(order, timeout=timeout or self.timeout)

    def hear(
        self, *, timeout: float | None = None
    ) -> tuple[dict[int, Any], dict[int, Trouble]]:
        """Returns the results of the last order, and the troubles, by environment.

        Skips answers to earlier orders that were interrupted before they were collected.

        Args:
          timeout: seconds for each call of a simulator; default `self.timeout`.
        """
        timeout = self.timeout if timeout is None else timeout
        deadline = time.monotonic() + timeout
        results: dict[int, Any] = {}
        troubles: dict[int, Trouble] = {}
        for handle in self._told:
            try:
                answer = self._answer(handle, deadline, timeout)
            except TimeoutError:
                where = handle.where()
                handle.kill()
                troubles |= self._lost(handle, f"timed out after {timeout:g} s", where)
            except EOFError:
                said = handle.last_words()
                troubles |= self._lost(handle, f"its worker {handle.kill()}", said)
            else:
                results |= answer.results
                troubles |= answer.troubles
        return results, troubles

    def build(
        self, factories: Mapping[int, bytes], *, timeout: float
    ) -> tuple[dict[int, Description], dict[int, Trouble]]:
        """Makes simulators; returns the same as `hear`, all troubles with `building=True`."""
        self.tell("build", factories, timeout=timeout)
        results, troubles = self.hear(timeout=timeout)
        for handle in self._told:
            handle.ready = not troubles.keys() & set(handle.envs)
        return results, {
            env: trouble
            if trouble.building
            else trouble._replace(building=True, reason=f"could not be made: {trouble.reason}")
            for env, trouble in troubles.items()
        }

    def discard(self, envs: Collection[int]) -> dict[int, Trouble]:
        """Closes simulators before they are replaced.

        Returns:
          Troubles of the environments whose worker died or hung while closing one.
        """
        alive = [env for handle in self._handles if handle.ready for env in handle.envs]
        self.tell("close", {env: None for env in alive if env in envs})
        return self.hear()[1]

    def close(self) -> None:
        """Closes the simulators and ends all workers; a second call does nothing."""
        if self.closed:
            return
        try:
            # Only ready workers: nobody should wait for broken ones.
            envs = [env for handle in self._handles if handle.ready for env in handle.envs]
            deadline = time.monotonic() + min(CLOSE_SECONDS, self.timeout)
            self.tell("close", dict.fromkeys(envs))
            for handle in self._told:
                with contextlib.suppress(Exception):
                    while handle.channel.receive(deadline=deadline).ticket != self._ticket:
                        pass
        finally:
            self._stop()

    def _answer(self, handle: Handle, deadline: float, timeout: float) -> Answer:
        """The worker's answer to the last order.

        Raises:
          TimeoutError: the current call takes too long.
          EOFError: the worker died.
        """
        while True:
            try:
                answer = handle.channel.receive(deadline=deadline)
            except TimeoutError:
                # The current call may have started after others, or after this wait.
                deadline = float(self._control["began"][handle.index]) + timeout
                if deadline <= time.monotonic():
                    raise
                continue
            if answer.ticket == self._ticket:
                return answer

    def _lost(self, handle: Handle, reason: str, said: str) -> dict[int, Trouble]:
        """The troubles of a lost worker's environments."""
        guilty = int(self._control["environment"][handle.index])
        if guilty == IDLE:
            if len(handle.envs) > 1:
                reason += f" between calls of environments {list(handle.envs)}"
            return {env: Trouble(reason, said) for env in handle.envs}
        return {env: Trouble(reason, said, guilty=env == guilty) for env in handle.envs}


def stop(handles: list[Handle], file: int, owner: int) -> None:
    """Ends the workers, unless this process was forked from the one that owns them."""
    if os.getpid() == owner:
        for handle in handles:
            handle.kill()
        os.close(file)


def cores() -> int:
    """Number of cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def standard_error() -> int:
    """The descriptor of standard error, or DEVNULL if it is closed."""
    try:
        os.fstat(2)
    except OSError:
        return subprocess.DEVNULL
    return 2


def variables() -> dict[str, str]:
    """Environment variables of a worker."""
    return {
        "PYTHONHASHSEED": "0",  # sets must have the same order in every process
        **os.environ,
        "JAX_PLATFORMS": "cpu",  # a simulator that uses JAX must not take the accelerator
    }


def pickled(make: Callable[[], Any]) -> bytes:
    """Pickles a factory for a worker, including lambdas, closures and code of a script.

    Raises:
      InvalidInput: it refers to an object that cannot be pickled.
    """
    import cloudpickle

    try:
        return cloudpickle.dumps(make)
    except Exception as error:
        remedy = f"cannot be pickled ({one_line(error)}); create all objects inside of it"
        raise InvalidInput("make", make, remedy) from None
