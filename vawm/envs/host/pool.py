"""N environments on the host, stepped in parallel in separate processes.

    with Pool(MySimulator, task="mine", num_envs=4) as pool:
        timestep = pool.reset(seed=0)
        pool.send(action)  # returns at once
        timestep = pool.receive()

The stream convention is that of `vawm.envs.protocol`. The stream does not depend on the
number of workers: the seed of an episode follows from the pool's seed, the environment's
index and its number of earlier episodes. Only one thread may use a pool at a time.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping
from typing import Any, Literal, NamedTuple, NoReturn, cast

import numpy as np

from vawm.envs.host.crew import Crew, pickled
from vawm.envs.host.simulator import Simulator
from vawm.envs.host.worker import Trouble, array_fields, leaves
from vawm.envs.protocol import EnvironmentFailure, check_positive
from vawm.errors import InvalidInput
from vawm.types import EnvSpec, Made, TimeStep

__all__ = ["EnvironmentFailure", "Episodes", "Pool", "episode_seed"]

MAX_KEPT = 30_000
"""Longest episode whose actions are kept: 2 MB per environment for Atari's 18 actions."""
MAX_FAILURES = 3
"""The pool ends after this many failures of an environment without a step in between."""
START_TIMEOUT = 120.0
"""Seconds to make a simulator: it may load libraries and compile."""


class Episodes(NamedTuple):
    """The running episode of every environment, enough to replay it."""

    index: np.ndarray  # type: ignore[assignment]  # [N] int64, number of earlier episodes
    length: np.ndarray  # [N] int64, actions so far; -1 if the episode is too long to keep
    actions: np.ndarray  # [sum of lengths, A] float32, raw as sent, environment by environment


class Pool:
    """N environments, stepped in parallel.

    Attributes:
      spec: what an agent has to know; mostly from the simulators.
      restarts: number of restarts after a failure so far.
      made: how the environments were made, if whoever makes the pool says so.
      notices: what to say when a run starts; from the simulators.
    """

    made: Made | None = None

    def __init__(
        self,
        make: Callable[[], Simulator],
        *,
        task: str,
        num_envs: int,
        action_repeat: int = 1,
        workers: int = 0,
        timeout: float = 60.0,
        on_failure: Literal["raise", "restart"] = "raise",
        first: Callable[[], Simulator] | None = None,
    ):
        """Starts the workers and makes the simulators.

        Args:
          make: makes a simulator; called once for each environment, in its worker. May be a
            lambda or a closure: each environment gets its own copy.
          task: name of the task.
          num_envs: N.
          action_repeat: control steps per step of the simulator; only recorded in `spec`.
          workers: processes; 0 for one per core. Never more than N.
          timeout: seconds that one call of a simulator may take. Making a simulator may take
            at least `START_TIMEOUT`.
          on_failure: what to do if an environment raises, dies, hangs or returns an invalid
            value. "raise" ends the pool, "restart" starts a new episode.
          first: replaces `make` for environment 0, but not after a failure. Use it to check
            a simulator.

        Raises:
          InvalidInput: an impossible choice, a `make` that makes nothing or that workers
            cannot import, or an `InvalidInput` that it raised.
          EnvironmentFailure: a simulator could not be made.
        """
        check_maker(make, "a simulator")
        check_choices(num_envs, action_repeat, workers, timeout, on_failure)
        self.restarts = 0
        self._on_failure = on_failure
        self._start_timeout = max(START_TIMEOUT, timeout)
        self._make = pickled(make)
        self._state: Literal["new", "ready", "sent"] = "new"
        self._failure: EnvironmentFailure | None = None  # the one that ended the pool
        self._index = np.zeros(num_envs, np.int64)
        self._length = np.zeros(num_envs, np.int64)
        self._failures = np.zeros(num_envs, np.int64)  # in a row
        self._over = np.zeros(num_envs, bool)  # whether the next step starts an episode
        self._crew = Crew(num_envs, workers, timeout)
        try:
            self.spec = self._start(
                self._make if first is None else pickled(first), task, action_repeat
            )
            spec = self.spec
            fields = array_fields(self._crew.size, num_envs, spec.obs, spec.action_size)
            self._arrays = self._crew.share(fields)
        except BaseException:
            self.close()
            raise
        self._kept = np.zeros((num_envs, 1024, self.spec.action_size), np.float32)

    def reset(self, seed: int) -> TimeStep:
        """Starts the first episode of all environments.

        Raises:
          InvalidInput: a seed that is not a whole number of at least 0.
          EnvironmentFailure: an environment failed and may not be restarted.
        """
        self._seed = check_seed(seed)
        self._enter("new", "ready", "sent")
        self._failures[:] = 0
        self._build()
        self._index[:] = -1
        self._recover(self._begin(range(self.spec.num_envs)))
        return self._leave(is_first=np.ones(self.spec.num_envs, bool))

    def send(self, action: np.ndarray) -> None:
        """Starts a step with `[N, action_size]` raw actions and returns at once.

        Raises:
          InvalidInput: actions of another shape.
        """
        action = np.asarray(action, np.float32)
        shape = self.spec.num_envs, self.spec.action_size
        if action.shape != shape:
            raise InvalidInput("action", action.shape, f"send actions of shape {shape}")
        self._enter("ready")
        self._arrays["action"][:] = action
        self._keep(action)
        seeds = {
            env: self._seed_of(env, ahead=1) if over else None
            for env, over in enumerate(self._over.tolist())
        }
        self._crew.tell("step", seeds)
        self._state = "sent"

    def receive(self) -> TimeStep:
        """Waits for the step that `send` started; the arrays are copies.

        Raises:
          EnvironmentFailure: an environment failed and may not be restarted. All workers
            have been ended.
        """
        self._enter("sent")
        begun = self._over
        self._index += begun
        self._length = np.where(begun, 0, self._length + 1)
        _, troubles = self._crew.hear()
        stepped = ~begun
        stepped[list(troubles)] = False
        self._failures[stepped] = 0
        return self._leave(is_first=begun | self._recover(troubles))

    def picture(self) -> np.ndarray | None:
        """What environment 0 looks like now, as its simulator draws it; None if it does not.

        Raises:
          EnvironmentFailure: drawing failed. The pool stays as it was.
        """
        self._enter("ready")
        self._crew.tell("picture", {0: None})
        results, troubles = self._crew.hear()
        self._state = "ready"
        if 0 in troubles:
            episode, step = int(self._index[0]), int(self._length[0])
            reason = f"cannot be drawn: {troubles[0].reason}"
            raise EnvironmentFailure(0, episode, step, reason, troubles[0].traceback)
        return results.get(0)

    def episodes(self) -> Episodes:
        """The running episodes, up to the last received time step."""
        length = np.where(self._length <= MAX_KEPT, self._length, -1)
        parts = [kept[: max(0, n)] for kept, n in zip(self._kept, length, strict=True)]
        return Episodes(self._index.copy(), length, np.concatenate(parts))

    def restore(
        self, seed: int, episodes: Episodes, expected: TimeStep
    ) -> tuple[TimeStep, np.ndarray]:
        """Replays the running episodes of an earlier pool; call it instead of `reset`.

        Args:
          seed: the seed that the earlier pool was reset with.
          episodes: its `episodes()`.
          expected: the last time step that it returned before, `[N, ...]`.

        Returns:
          A time step, and `[N]` bool: the environments whose observation, reward and flags
          equal `expected` bit for bit. The others start a new episode, among them those
          whose episode was too long to keep.

        Raises:
          InvalidInput: `episodes` or `expected` do not fit these environments.
          EnvironmentFailure: an environment that starts a new episode failed.
        """
        self._seed = check_seed(seed)
        index, length, actions = check_episodes(episodes, self.spec)
        check_expected(expected, like=self._timestep(self._over))
        self._enter("new", "ready", "sent")
        self._failures[:] = 0
        self._index, self._length = index, np.maximum(length, 0)
        self._build()

        parts = np.split(actions, np.cumsum(self._length)[:-1])
        self._room(int(self._length.max()))
        for kept, part in zip(self._kept, parts, strict=True):
            kept[: len(part)] = part
        kept_whole = np.flatnonzero(length >= 0).tolist()
        played = {env: (self._seed_of(env), parts[env]) for env in kept_whole}
        self._crew.tell("replay", played)
        _, troubles = self._crew.hear()
        troubles = self._crew.discard(troubles) | troubles

        is_first = length == 0
        same = ~self._mask(troubles) & (length >= 0)
        same &= rows_equal(self._timestep(is_first), expected)
        others = np.flatnonzero(~same).tolist()
        self._build(troubles)
        same &= ~self._recover(self._begin(others))
        return self._leave(is_first=np.where(same, is_first, True)), same

    def close(self) -> None:
        """Ends the workers; a second call does nothing."""
        self._crew.close()

    def __enter__(self) -> Pool:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _enter(self, *states: str) -> None:
        """Checks that a call is allowed now, given the calls before it.

        The state is "new" until the call is complete: after an interrupted call, only
        `reset` and `restore` are allowed.
        """
        if self._crew.closed:
            raise RuntimeError("the pool is closed") from self._failure
        if self._state not in states:
            first = {"new": "reset() or restore()", "ready": "send()", "sent": "receive()"}
            raise RuntimeError(f"call {first[self._state]} first")
        self._state = "new"

    def _leave(self, is_first: np.ndarray) -> TimeStep:
        """Completes a call; returns the time step that arrived."""
        timestep = self._timestep(is_first)
        self._over = np.array(timestep.is_last)
        self._state = "ready"
        return timestep

    def _timestep(self, is_first: np.ndarray) -> TimeStep:
        """Copies what the workers wrote, because JAX may read the arrays much later."""

        def copy(name: str) -> Any:
            return self._arrays[name].copy()

        obs = {key: copy(name) for name, key, _ in leaves(self.spec.obs)}
        return TimeStep(
            obs if isinstance(self.spec.obs, dict) else obs[None],
            reward=copy("reward"),
            is_first=cast(Any, is_first.copy()),
            is_last=copy("is_last"),
            is_terminal=copy("is_terminal"),
        )

    def _start(self, first: bytes, task: str, action_repeat: int) -> EnvSpec:
        """Starts all workers, makes all simulators and returns their common spec."""
        factories = dict.fromkeys(self._crew.start_missing(), self._make) | {0: first}
        described, troubles = self._crew.build(factories, timeout=self._start_timeout)
        for env in sorted(troubles):
            if refused := troubles[env].refused:
                raise InvalidInput(*refused)
            self._fail(env, troubles[env])
        self.notices = described[0].notices
        for env, description in described.items():
            if description != described[0]:
                differs = f"made {description}, but {described[0]} for environment 0"
                remedy = f"{differs}; make equal simulators"
                raise InvalidInput("make", f"environment {env}", remedy)
        return EnvSpec(
            task=task,
            num_envs=len(described),
            action_repeat=action_repeat,
            **described[0].of_spec(),
        )

    def _build(self, broken: Collection[int] = ()) -> None:
        """Remakes broken simulators and those of lost workers."""
        envs = {*broken, *self._crew.start_missing()}
        factories = dict.fromkeys(sorted(envs), self._make)
        described, troubles = self._crew.build(factories, timeout=self._start_timeout)
        for env, said in described.items():
            if any(getattr(self.spec, name) != value for name, value in said.of_spec().items()):
                reason = f"the simulator changed when it was made again: {said}"
                troubles[env] = Trouble(reason, building=True)
        if troubles:
            self._judge(troubles)

    def _begin(self, envs: Collection[int]) -> dict[int, Trouble]:
        """Starts the next episode of some environments."""
        envs = list(envs)
        self._index[envs] += 1
        self._length[envs] = 0
        self._crew.tell("begin", {env: self._seed_of(env) for env in envs})
        return self._crew.hear()[1]

    def _recover(self, troubles: Mapping[int, Trouble]) -> np.ndarray:
        """Starts a new episode in environments with trouble; `[N]` bool says which."""
        anew = self._mask(())
        while troubles:
            self._judge(troubles)
            troubles = self._crew.discard(troubles) | dict(troubles)
            self.restarts += len(troubles)
            anew |= self._mask(troubles)
            self._build(troubles)
            troubles = self._begin(troubles)
        return anew

    def _judge(self, troubles: Mapping[int, Trouble]) -> None:
        """Ends the pool if an environment cannot or must not be restarted."""
        for env in sorted(troubles, key=lambda env: (not troubles[env].guilty, env)):
            trouble = troubles[env]
            if self._on_failure == "raise" or trouble.building:
                self._fail(env, trouble)
            self._failures[env] += trouble.guilty
            if self._failures[env] >= MAX_FAILURES:
                reason = f"{trouble.reason} ({MAX_FAILURES} failures in a row)"
                self._fail(env, trouble._replace(reason=reason))

    def _fail(self, env: int, trouble: Trouble) -> NoReturn:
        """Ends the pool with the failure of an environment."""
        self._failure = EnvironmentFailure(
            environment=env,
            episode=int(self._index[env]),
            step=int(self._length[env]),
            reason=trouble.reason,
            traceback=trouble.traceback,
        )
        self.close()
        raise self._failure

    def _keep(self, action: np.ndarray) -> None:
        """Stores the actions, except those that a reset ignores."""
        envs = np.flatnonzero(~self._over & (self._length < MAX_KEPT))
        if envs.size:
            self._room(int(self._length[envs].max()) + 1)
            self._kept[envs, self._length[envs]] = action[envs]

    def _room(self, length: int) -> None:
        """Makes room for `length` actions of an episode."""
        while self._kept.shape[1] < length:
            self._kept = np.concatenate([self._kept, np.zeros_like(self._kept)], axis=1)

    def _mask(self, envs: Collection[int]) -> np.ndarray:
        """`[N]` bool, True for `envs`."""
        chosen = np.zeros(len(self._index), bool)
        chosen[list(envs)] = True
        return chosen

    def _seed_of(self, env: int, ahead: int = 0) -> int:
        return episode_seed(self._seed, env, int(self._index[env]) + ahead)


def episode_seed(seed: int, env: int, episode: int) -> int:
    """The seed of an environment's episode, below 2**31.

    Args:
      seed: of the pool.
      env: index of the environment.
      episode: number of episodes that it started before.
    """
    words = np.random.SeedSequence(seed, spawn_key=(env, episode)).generate_state(1)
    return int(words[0]) >> 1


def rows_equal(a: TimeStep, b: TimeStep) -> np.ndarray:
    """`[N]` bool: the environments for which two time steps are equal, bit for bit."""
    equal = np.ones(len(a.reward), bool)
    for (_, x), (_, y) in zip(arrays_of(a), arrays_of(b), strict=True):
        equal &= [p.tobytes() == q.tobytes() for p, q in zip(x, y, strict=True)]
    return equal


def arrays_of(timestep: TimeStep) -> list[tuple[str, np.ndarray]]:
    """(name, numpy array) of everything in a time step."""
    named = [(name, array) for name, _, array in leaves(timestep.obs)]
    named += zip(TimeStep._fields[1:], timestep[1:], strict=True)
    return [(name, np.asarray(array)) for name, array in named]


def check_maker(make: Any, what: str) -> None:
    """Refuses an object in the place of the function or class that makes it.

    Raises:
      InvalidInput: `make` cannot be called.
    """
    if callable(make):
        return
    name = type(make).__name__
    remedy = f"is a {name}, not a function or class that makes {what}: use lambda: {name}(...)"
    raise InvalidInput("make", make, remedy)


def check_choices(
    num_envs: int, action_repeat: int, workers: int, timeout: float, on_failure: str
) -> None:
    """Refuses impossible arguments of a pool.

    Raises:
      InvalidInput: names the argument and the remedy.
    """
    check_positive("num_envs", num_envs)
    check_positive("action_repeat", action_repeat)
    if workers != 0:
        check_positive("workers", workers)
    number = isinstance(timeout, (int, float)) and not isinstance(timeout, bool)
    if not number or not 0 < timeout < math.inf:
        raise InvalidInput("timeout", timeout, "use a positive number of seconds")
    if on_failure not in ("raise", "restart"):
        raise InvalidInput("on_failure", on_failure, "use 'raise' or 'restart'")


def check_seed(seed: Any) -> int:
    """Refuses a seed that numpy cannot use."""
    if isinstance(seed, bool) or not isinstance(seed, (int, np.integer)) or seed < 0:
        raise InvalidInput("seed", seed, "use a whole number of at least 0")
    return int(seed)


def check_episodes(episodes: Episodes, spec: EnvSpec) -> Episodes:
    """Copies episodes, with the pool's dtypes.

    Raises:
      InvalidInput: they do not fit the environments of `spec`.
    """
    index = np.array(episodes.index, np.int64)
    length = np.array(episodes.length, np.int64)
    actions = np.array(episodes.actions, np.float32)
    whole = int(np.maximum(length, 0).sum())
    for name, array, shape in (
        ("index", index, (spec.num_envs,)),
        ("length", length, (spec.num_envs,)),
        ("actions", actions, (whole, spec.action_size)),
    ):
        if array.shape != shape:
            remedy = f"pass episodes of these environments, with shape {shape}"
            raise InvalidInput(f"episodes.{name}", array.shape, remedy)
    return Episodes(index, length, actions)


def check_expected(expected: TimeStep, like: TimeStep) -> None:
    """Refuses a time step with other names, dtypes or shapes than `like`.

    Raises:
      InvalidInput: names those given and those needed.
    """
    given, wanted = (
        {name: f"{array.dtype}{list(array.shape)}" for name, array in arrays_of(timestep)}
        for timestep in (expected, like)
    )
    if given != wanted:
        raise InvalidInput("expected", given, f"pass a time step with {wanted}")
