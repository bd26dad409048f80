"""The process that runs some environments of a pool.

A worker answers one order at a time. For an order `(ticket, name, {environment: payload})` it
calls the method `name` of `Worker` for each environment in turn. Actions, observations,
rewards and flags are in shared memory. The pool decides when an episode starts and what
follows a failure.

A worker ends when the pool ends it or when the pool's process ends, in whatever way.
"""

from __future__ import annotations

import contextlib
import ctypes
import faulthandler
import functools
import json
import os
import pickle
import signal
import socket
import sys
import threading
import time
import traceback
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import numpy as np

from vawm.envs.host.channel import Channel, Fields, view
from vawm.envs.host.simulator import Outcome, Simulator, legal
from vawm.envs.host.usable import Unusable, check_array, check_flag, check_number, one_line
from vawm.errors import InvalidInput
from vawm.process import streams
from vawm.types import ArraySpec, PyTree

IDLE = -1  # stands for no environment, between two orders
WATCH_SECONDS = 1.0
"""Interval at which to check that the pool's process lives, if the kernel does not tell."""
TELL = signal.SIGUSR1  # asks a hanging worker for its traceback
PR_SET_PDEATHSIG = 1  # linux/prctl.h


class Description(NamedTuple):
    """The attributes of a simulator; see `Simulator`."""

    obs: PyTree
    action_size: int
    discrete: bool
    episode_length: int | None
    notices: tuple[str, ...] = ()
    native: Any = None

    def of_spec(self) -> dict[str, Any]:
        """Those that are fields of an `EnvSpec`."""
        return {name: value for name, value in self._asdict().items() if name != "notices"}


class Trouble(NamedTuple):
    """What went wrong with one environment.

    Attributes:
      reason: in a few words, without the environment.
      traceback: of the worker, or "".
      building: whether the simulator could not be made.
      guilty: False if another environment took the worker down.
      refused: field, value, remedy and settings, if making it raised `InvalidInput`.
    """

    reason: str
    traceback: str = ""
    building: bool = False
    guilty: bool = True
    refused: tuple[str, Any, str, Mapping[str, Any]] | None = None


class Answer(NamedTuple):
    """The answer to order `ticket`: results and troubles by environment."""

    ticket: int
    results: dict[int, Any]
    troubles: dict[int, Trouble]


class NotBuilt(Exception):
    """Wraps an exception that was raised while a simulator was being made."""


def control_fields(workers: int) -> Fields:
    """The environment that each worker is calling, and since when (`time.monotonic`)."""
    return {"environment": ((workers,), np.int64), "began": ((workers,), np.float64)}


def array_fields(workers: int, num_envs: int, obs: PyTree, action_size: int) -> Fields:
    """All arrays in shared memory, with one row per environment."""
    step = {
        "action": ((num_envs, action_size), np.float32),
        "reward": ((num_envs,), np.float32),
        "is_last": ((num_envs,), np.bool_),
        "is_terminal": ((num_envs,), np.bool_),
    }
    seen = {name: ((num_envs, *spec.shape), spec.dtype) for name, _, spec in leaves(obs)}
    return {**control_fields(workers), **step, **seen}


def leaves(obs: PyTree) -> list[tuple[str, Any, Any]]:
    """(name, key, array) of each array in an observation, sorted by key; key None if single."""
    if isinstance(obs, dict):
        return [(f"obs[{key!r}]", key, obs[key]) for key in sorted(obs)]
    return [("obs", None, obs)]


class Worker:
    """Some environments, with one method for each kind of order."""

    def __init__(self, index: int, workers: int, num_envs: int, channel: Channel, file: int):
        self.index, self.workers, self.num_envs = index, workers, num_envs
        self.channel, self.file = channel, file
        self.control = view(file, control_fields(workers))
        self.simulators: dict[int, Simulator] = {}
        self.description = Description((), 0, False, None)  # until one is built

    def serve(self) -> None:
        """Answers orders until the pool is gone."""
        with contextlib.suppress(EOFError, OSError):
            while True:
                self.channel.send(self.answer(*self.channel.receive()))

    def answer(self, ticket: int, name: str, payloads: Mapping[int, Any]) -> Answer:
        results, troubles = {}, {}
        carry_out = getattr(self, name)
        for env, payload in payloads.items():
            self.note(env)
            try:
                result = carry_out(env, payload)
            except BaseException as error:
                troubles[env] = describe(error)
            else:
                if result is not None:
                    results[env] = result
        self.note(IDLE)
        return Answer(ticket, results, troubles)

    def note(self, env: int) -> None:
        """Records which environment is being called, in case the call never returns."""
        self.control["environment"][self.index] = env
        self.control["began"][self.index] = time.monotonic()

    def build(self, env: int, factory: bytes) -> Description:
        """Makes the simulator, from its own copy of the factory."""
        try:
            simulator = unpickled(factory)()
            self.description = describe_simulator(simulator)
        except BaseException as error:
            raise NotBuilt from error
        self.simulators[env] = simulator
        return self.description

    def begin(self, env: int, seed: int) -> None:
        """Starts the episode of a seed."""
        self.write(env, Outcome(self.simulators[env].reset(seed), 0.0, False, False))

    def step(self, env: int, seed: int | None) -> None:
        """Steps with the action in memory; if there is a seed, starts its episode instead."""
        if seed is None:
            action = self.action(self.arrays["action"][env])
            self.write(env, self.simulators[env].step(action))
        else:
            self.begin(env, seed)

    def replay(self, env: int, episode: tuple[int, np.ndarray]) -> None:
        """Replays an episode, given its seed and its actions `[length, action_size]`."""
        seed, actions = episode
        self.begin(env, seed)
        for count, action in enumerate(actions, start=1):
            self.note(env)
            outcome = self.simulators[env].step(self.action(action))
            if count == len(actions):
                self.write(env, outcome)
            elif outcome.is_last:
                ended = f"ended after {count} of {len(actions)} steps"
                raise Unusable("the replayed episode", ended)

    def picture(self, env: int, _: None) -> np.ndarray | None:
        """What the simulator draws; None if it draws nothing."""
        draw = getattr(self.simulators[env], "picture", None)
        drawn = None if draw is None else draw()
        return None if drawn is None else np.ascontiguousarray(drawn)

    def close(self, env: int, _: None = None) -> None:
        """Closes the simulator and ignores its errors."""
        simulator = self.simulators.pop(env, None)
        if simulator is not None:
            with contextlib.suppress(BaseException):
                simulator.close()

    @functools.cached_property
    def arrays(self) -> dict[str, np.ndarray]:
        """The shared arrays; the pool allocates them before the first episode."""
        obs, action_size = self.description[:2]
        return view(self.file, array_fields(self.workers, self.num_envs, obs, action_size))

    @functools.cached_property
    def obs(self) -> list[tuple[str, Any, ArraySpec, np.ndarray]]:
        """(name, key, spec, memory `[N, ...]`) of each array in an observation."""
        return [(*leaf, self.arrays[leaf[0]]) for leaf in leaves(self.description.obs)]

    def action(self, raw: np.ndarray) -> np.ndarray | int:
        """Converts a raw action `[action_size]` for the simulator."""
        return legal(raw, discrete=self.description.discrete)

    def write(self, env: int, outcome: Outcome) -> None:
        """Writes an outcome to shared memory, after checking all of it."""
        reward = check_number("reward", outcome.reward)
        is_last = check_flag("is_last", outcome.is_last)
        is_terminal = check_flag("is_terminal", outcome.is_terminal)
        values = [self.entry(outcome.obs, key) for _, key, *_ in self.obs]
        for (name, _, spec, _), value in zip(self.obs, values, strict=True):
            check_array(name, value, spec)
        for (*_, memory), value in zip(self.obs, values, strict=True):
            memory[env] = value
        self.arrays["reward"][env] = reward
        self.arrays["is_last"][env] = is_last
        self.arrays["is_terminal"][env] = is_terminal

    def entry(self, obs: PyTree, key: Any) -> Any:
        """`obs`, or its entry `key` if observations are dicts."""
        if key is None:
            return obs
        if not isinstance(obs, Mapping) or len(obs) != len(self.obs) or key not in obs:
            kind = f"of {sorted(map(str, obs))}" if isinstance(obs, Mapping) else type(obs)
            keys = [key for _, key, *_ in self.obs]
            raise Unusable("obs", f"is {kind}, not a dict of {keys}")
        return obs[key]


def unpickled(factory: bytes) -> Callable[[], Simulator]:
    """The factory from its pickle, which names modules rather than containing them.

    Raises:
      InvalidInput: a module, or what it should contain, is not found in this process.
    """
    try:
        return pickle.loads(factory)
    except (ImportError, AttributeError) as error:
        remedy = (
            f"is not found in the processes of the environments ({one_line(error)}): define it "
            "in the script itself, or in a module whose folder is in PYTHONPATH"
        )
        raise InvalidInput("make", error.name or "the environment", remedy) from error


def describe_simulator(simulator: Simulator) -> Description:
    """Reads and checks the attributes of a simulator.

    Raises:
      TypeError: names an attribute that does not follow `Simulator`.
    """
    said = Description(
        simulator.obs,
        simulator.action_size,
        simulator.discrete,
        simulator.episode_length,
        notices=tuple(getattr(simulator, "notices", ())),
        native=getattr(simulator, "native", None),
    )
    for name, key, spec in leaves(said.obs):
        if not isinstance(spec, ArraySpec) or not isinstance(key, (str, type(None))):
            raise TypeError(f"{name} of the simulator is {spec!r:.100}, not an ArraySpec")
    for name, value in (
        ("action_size", said.action_size),
        ("episode_length", said.episode_length),
    ):
        may_be_none = name == "episode_length" and value is None
        if not may_be_none and not (isinstance(value, (int, np.integer)) and value >= 1):
            raise TypeError(f"{name} of the simulator is {value!r:.100}, not 1 or more")
    return said._replace(
        action_size=int(said.action_size),
        discrete=bool(said.discrete),
        episode_length=None if said.episode_length is None else int(said.episode_length),
    )


def describe(error: BaseException) -> Trouble:
    """Turns an exception into a `Trouble`, which can be sent."""
    building = isinstance(error, NotBuilt)
    cause = (error.__cause__ if building else None) or error
    reason = str(cause) if isinstance(cause, Unusable) else f"raised {one_line(cause)}"
    refused = None
    if building and isinstance(cause, InvalidInput):
        refused = cause.field, sendable(cause.value), cause.remedy, cause.settings
    return Trouble(
        reason=f"could not be made: {reason}" if building else reason,
        traceback="".join(traceback.format_exception(cause)),
        building=building,
        refused=refused,
    )


def sendable(value: Any) -> Any:
    """`value`, or its repr if the pool's process may not know its type."""
    try:
        json.dumps(value)
    except Exception:
        return repr(value)
    return value


def main() -> None:
    """Serves the pool that started this process; its settings are the last argument."""
    settings = json.loads(sys.argv[-1])
    with streams.outlive():
        serve(settings)


def serve(settings: dict[str, Any]) -> None:
    """Prepares the process, then answers orders until it is told to end."""
    for name in ("channel", "memory", "crash"):
        os.set_inheritable(settings[name], False)  # not for programs a simulator starts
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        # Not SIG_IGN: programs that a simulator starts would inherit it.
        signal.signal(number, lambda *_: None)
    # A terminal may stop background processes that print; ignore that signal.
    signal.signal(signal.SIGTTOU, signal.SIG_IGN)
    leave_a_guard()
    end_with(settings["parent"], by_kernel=settings["by_kernel"])
    faulthandler.enable(settings["crash"], all_threads=False)
    faulthandler.register(TELL, settings["crash"], all_threads=False)
    channel = Channel(socket.socket(fileno=settings["channel"]))
    place = settings["index"], settings["workers"], settings["num_envs"]
    Worker(*place, channel, settings["memory"]).serve()
    os._exit(0)  # threads that a simulator left behind must not keep the process alive


def leave_a_guard() -> None:
    """Forks a process that, after this one ends, kills what simulators started.

    It is forked before there are threads and leads its own process group. It keeps no file
    open, because the pool learns from closed files that this process has ended.
    """
    worker = os.getpid()  # leads the process group of everything its simulators start
    if os.fork():
        return
    os.setpgid(0, 0)
    nothing = os.open(os.devnull, os.O_RDWR)
    for standard in range(3):
        os.dup2(nothing, standard)
    os.closerange(3, os.sysconf("SC_OPEN_MAX"))
    while os.getppid() == worker:
        time.sleep(WATCH_SECONDS)
    with contextlib.suppress(OSError):
        os.killpg(worker, signal.SIGKILL)
    os._exit(0)


def end_with(parent: int, *, by_kernel: bool) -> None:
    """Ends this process when its parent has ended, even inside a call that never returns.

    Args:
      parent: its process id.
      by_kernel: let Linux do it, which works even if the call holds the interpreter's lock.
        Linux acts when the *thread* that started the process ends, so use it only if that
        is the main thread.
    """
    if by_kernel and sys.platform == "linux":
        ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGKILL)

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(WATCH_SECONDS)
        os.kill(os.getpid(), signal.SIGKILL)

    if os.getppid() != parent:  # the parent ended before the prctl call
        os._exit(1)
    threading.Thread(target=watch, daemon=True).start()
