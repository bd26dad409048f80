"""The interface of environments: two pure, jittable functions, or a host environment.

Both functions work on N environments at once; every array leads with `[N]`. The stream
follows the convention of dm_env: the step *after* `is_last` is a reset. It ignores its
action, has reward 0 and carries `is_first` with the first observation of a new random
episode.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import numpy as np

from vawm.errors import InvalidInput
from vawm.types import IMAGE_SIZES, Array, EnvSpec, Key, Made, TimeStep


class EnvState(NamedTuple):
    """Everything a simulated environment carries from one step to the next.

    Attributes:
      data: `[N, ...]` batched `mjx.Data`, always finite.
      target: `[N, G]` what the task randomises outside qpos; G is 0 if there is nothing.
      steps: `[N]` int32 control steps since the reset. Negated when the physics failed
        in this episode, so an `is_last` with negative `steps` is a failure, and with
        1000 `steps` an ordinary end.
      key: `[N]` typed keys for future resets.
    """

    data: Any
    target: Array
    steps: Array
    key: Key


class Environment(NamedTuple):
    """N environments as pure functions.

    Attributes:
      spec: what an agent has to know; static.
      reset: `(key) -> (state, TimeStep)`; all N environments start an episode.
      step: `(state, action [N, action_size]) -> (state, TimeStep)`. `state` is an
        `EnvState` for physics, otherwise any NamedTuple with `steps` and `key`.
    """

    spec: EnvSpec
    reset: Callable[[Key], tuple[Any, TimeStep]]
    step: Callable[[Any, Array], tuple[Any, TimeStep]]


class HostEnvironment(Protocol):
    """N environments outside jit, with the same stream convention; numpy in and out.

    Attributes:
      spec: what an agent has to know; static.
      restarts: number of restarts after a failure so far.
      made: how they were made; may be missing, if nobody says so.
      notices: lines to say when a run starts; may be missing.
    """

    spec: EnvSpec
    restarts: int
    made: Made | None

    def reset(self, seed: int) -> TimeStep:
        """Starts the first episode of all N environments."""

    def send(self, action: np.ndarray) -> None:
        """Starts a step with `[N, action_size]` raw actions, without waiting for it."""

    def receive(self) -> TimeStep:
        """Waits for the step that `send` started. May raise `EnvironmentFailure`."""

    def episodes(self) -> Any:
        """The running episodes: a NamedTuple of arrays, enough to replay them."""

    def restore(
        self, seed: int, episodes: Any, expected: TimeStep
    ) -> tuple[TimeStep, np.ndarray]:
        """Replays `episodes`; `[N]` bool says which ended in `expected`, bit for bit.
        The others start a new episode."""

    def close(self) -> None:
        """Frees everything; a second call does nothing."""


class EnvironmentFailure(RuntimeError):
    """A host environment raised, died, hung or returned a value that no agent can use.

    Attributes:
      environment: index among the N.
      episode: number of episodes that it started before this one.
      step: the step of the episode that failed, from 1; 0 is the reset.
      reason: what happened.
      traceback: of the simulator's process, or "" if it left none.
    """

    def __init__(
        self, environment: int, episode: int, step: int, reason: str, traceback: str = ""
    ):
        super().__init__(f"environment {environment}, episode {episode}, step {step}: {reason}")
        self.environment = environment
        self.episode = episode
        self.step = step
        self.reason = reason
        self.traceback = traceback
        if traceback:
            self.add_note(f"In the environment's process:\n{traceback}")


def check_positive(field: str, value: Any) -> None:
    """Refuses anything that is not a whole number of at least 1."""
    if isinstance(value, bool) or not isinstance(value, int) or value < 1:
        raise InvalidInput(field, value, "use a whole number of at least 1")


def check_image_size(name: str, size: int) -> None:
    """Refuses images that cannot be halved four times, as the CNNs do.

    Raises:
      InvalidInput: names sizes that can.
    """
    if size not in IMAGE_SIZES:
        low, high, step = IMAGE_SIZES[0], IMAGE_SIZES[-1], IMAGE_SIZES.step
        remedy = f"use a multiple of {step} from {low} to {high}, such as 64, 96 or 128"
        raise InvalidInput(name, size, remedy)


def check_environment(env: Any) -> None:
    """Refuses what is neither pure functions nor a host environment, such as Gymnasium's.

    Raises:
      InvalidInput: names `from_gymnasium`, which makes a host environment.
    """
    parts = ("spec", "reset", "send", "receive")
    if isinstance(env, Environment):
        return
    if not isinstance(env, type) and all(hasattr(env, part) for part in parts):
        return
    kind = type(getattr(env, "unwrapped", env))
    make = getattr(env, "__name__", f"lambda: {kind.__name__}(...)")
    if isinstance(env, str):
        make = repr(env)
    remedy = (
        f"is neither an Environment nor a HostEnvironment: pass from_gymnasium({make}, "
        "num_envs=...), if it is of Gymnasium"
    )
    raise InvalidInput("env", env, remedy)


def check_fits(trained: EnvSpec, spec: EnvSpec) -> None:
    """Refuses environments whose observations, actions or action repeat are not the policy's.

    Args:
      trained: of the environments that the policy was trained in.
      spec: of the others.

    Raises:
      InvalidInput: names what differs.
    """
    for name in ("obs", "action_size", "discrete", "action_repeat"):
        own, theirs = getattr(trained, name), getattr(spec, name)
        if own != theirs:
            raise InvalidInput("env", f"{name} {theirs}", f"the policy was trained with {own}")
