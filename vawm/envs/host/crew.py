"""The workers of a pool: started, given orders, heard, and ended.

A worker that dies or hangs shows as `Trouble` of all its environments. No wait is without
end: a call of a simulator may take so many seconds, then its worker is killed.
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
from vawm.envs.host.worker import (
    IDLE,
    TELL,
    Answer,
    Description,
    Trouble,
    control_fields,
    one_line,
)
from vawm.errors import InvalidInput

TELL_SECONDS = 0.5
"""For a process that hangs to say where."""
DEATH_SECONDS = 5.0
"""For a killed process to be gone; one that waits for a device takes longer, unattended."""
CLOSE_SECONDS = 5.0
"""For simulators to close in order, such as to finish a video."""
BOOT = (
    "import json, sys; sys.path[:] = json.loads(sys.argv[1]); "
    "from vawm.envs.host.worker import main; main()"
)


class Handle:
    """One worker, as the pool's process sees it.

    Attributes:
      index: among the workers; worker w of W runs the environments w, w + W, ...
      envs: those.
      ready: whether it has all its simulators. Never again after `kill`.
      channel: to it.
      process: leads a process group of its own. So Ctrl-C in a terminal does not reach it,
        and what a simulator started ends with it.
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
        # A script's own folder may be on the path, or a notebook's: "".
        path = [folder or os.getcwd() for folder in sys.path if isinstance(folder, str)]
        options = "-uP"  # shows what is printed at once; adds no folder to the path
        command = [sys.executable, options, "-c", BOOT, json.dumps(path), json.dumps(settings)]
        try:
            self.process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=standard_error(),  # standard output is for what the run prints
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
        """Has a worker that does not answer say where it is: a traceback, or ""."""
        with contextlib.suppress(OSError):
            os.kill(self.process.pid, TELL)
        end = time.monotonic() + TELL_SECONDS
        while not (said := self.last_words()) and time.monotonic() < end:
            time.sleep(0.01)
        return said

    def last_words(self) -> str:
        """What the interpreter wrote when it crashed or was asked."""
        return os.pread(self._crash, 1 << 16, 0).decode(errors="replace")

    def kill(self) -> str:
        """Ends the process and what it started; returns how it ended.

        One that had ended by itself keeps its own exit code: it is not waited for before, so
        that its number cannot be another's yet.
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
            return "does not end"
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
        """Starts nothing yet.

        Args:
          num_envs: N, over all workers.
          workers: how many; 0 for as many as there are cores. Never more than N.
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
        """Whether they have ended for good."""
        return not self._stop.alive

    def share(self, fields: Fields) -> dict[str, np.ndarray]:
        """Arrays in memory of all; `fields` begin with those shared before."""
        reserve(self._file, fields)
        return view(self._file, fields)

    def start_missing(self) -> list[int]:
        """Starts a worker where there is none or a lost one.

        Returns:
          Environments that have no simulator yet, see `build`.
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
        """Gives an order to the workers of some environments; `hear` waits for it.

        Args:
          name: of a method of `Worker`.
          payloads: environment -> its argument.
          timeout: in which a worker has to take it, in place of the usual one.
        """
        self._ticket += 1
        self._told = []
        for handle in self._handles:
            part = {env: payloads[env] for env in handle.envs if env in payloads}
            if part:
                self._told.append(handle)
                with contextlib.suppress(OSError):  # `hear` finds out why
                    order = self._ticket, name, part
                    handle.channel.send(order, timeout=timeout or self.timeout)

    def hear(
        self, *, timeout: float | None = None
    ) -> tuple[dict[int, Any], dict[int, Trouble]]:
        """What the environments returned to the last order, and what went wrong.

        Answers to earlier orders, whose wait was interrupted, are passed over.

        Args:
          timeout: of each call of a simulator, in place of the usual one.
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
        """Makes simulators; returns what `hear` does, every failure marked as one to build."""
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
        """Lets go of simulators, before others take their place.

        Returns:
          Environments that were lost with a worker, where closing one ended or hung it.
        """
        alive = [env for handle in self._handles if handle.ready for env in handle.envs]
        self.tell("close", {env: None for env in alive if env in envs})
        return self.hear()[1]

    def close(self) -> None:
        """Lets the simulators close and ends all workers; a second call does nothing."""
        if self.closed:
            return
        try:
            # Only where nothing is known to be wrong: nobody waits for the others.
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
          TimeoutError: the call that is under way takes too long.
          EOFError: it died.
        """
        while True:
            try:
                answer = handle.channel.receive(deadline=deadline)
            except TimeoutError:
                # The call may have begun after others, or after the wait did.
                deadline = float(self._control["began"][handle.index]) + timeout
                if deadline <= time.monotonic():
                    raise
                continue
            if answer.ticket == self._ticket:
                return answer

    def _lost(self, handle: Handle, reason: str, said: str) -> dict[int, Trouble]:
        """A worker that is no more, as trouble of its environments."""
        guilty = int(self._control["environment"][handle.index])
        if guilty == IDLE:
            if len(handle.envs) > 1:
                reason += f" between calls of environments {list(handle.envs)}"
            return {env: Trouble(reason, said) for env in handle.envs}
        return {env: Trouble(reason, said, guilty=env == guilty) for env in handle.envs}


def stop(handles: list[Handle], file: int, owner: int) -> None:
    """Ends the workers; not in a process that was forked from the one they belong to."""
    if os.getpid() == owner:
        for handle in handles:
            handle.kill()
        os.close(file)


def cores() -> int:
    """Cores that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def standard_error() -> int:
    """The descriptor of standard error, or of nothing where it is closed."""
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
    """A factory as a worker reads it: lambdas, closures and a script's own code included.

    Raises:
      InvalidInput: it holds on to something that cannot leave this process.
    """
    import cloudpickle

    try:
        return cloudpickle.dumps(make)
    except Exception as error:
        remedy = f"make everything inside of it, it cannot be sent: {one_line(error)}"
        raise InvalidInput("make", make, remedy) from None
