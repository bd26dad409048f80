"""What every environment of the package looks like: two pure, jittable functions.

Both work on N environments at once; every array leads with `[N]`. The stream follows the
convention of dm_env: the step *after* `is_last` is a reset. It ignores its action, its
reward is 0 and it carries `is_first` with the first observation of a new random episode.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import numpy as np

from vawm.errors import InvalidInput
from vawm.types import Array, EnvSpec, Key, TimeStep


class EnvState(NamedTuple):
    """Everything a simulated environment carries from one step to the next.

    Attributes:
      data: `[N, ...]` batched `mjx.Data`, always finite.
      target: `[N, G]` what the task randomises outside qpos; G is 0 where nothing is.
      steps: `[N]` int32 control steps since the reset. Negated when the physics failed
        in this episode, so an `is_last` with negative `steps` is a failure, and with
        1000 `steps` an ordinary end.
      key: `[N]` typed keys for the resets to come.
    """

    data: Any
    target: Array
    steps: Array
    key: Key


class Environment(NamedTuple):
    """N environments as pure functions.

    Attributes:
      spec: what an agent has to know; static.
      reset: `(key) -> (state, TimeStep)`, all N start an episode.
      step: `(state, action [N, action_size]) -> (state, TimeStep)`. `state` is an
        `EnvState` for physics and any NamedTuple with `steps` and `key` elsewhere.
    """

    spec: EnvSpec
    reset: Callable[[Key], tuple[Any, TimeStep]]
    step: Callable[[Any, Array], tuple[Any, TimeStep]]


class HostEnvironment(Protocol):
    """N environments outside of jit, in the same stream; numpy in and out.

    Attributes:
      spec: what an agent has to know; static.
      restarts: environments begun anew after a failure, so far.
    """

    spec: EnvSpec
    restarts: int

    def reset(self, seed: int) -> TimeStep:
        """All N start their first episode."""

    def send(self, action: np.ndarray) -> None:
        """Takes `[N, action_size]` raw actions and returns while they are simulated."""

    def receive(self) -> TimeStep:
        """Waits for what `send` began. May raise `EnvironmentFailure`."""

    def episodes(self) -> Any:
        """The running episodes: a NamedTuple of arrays, enough to play them again."""

    def restore(
        self, seed: int, episodes: Any, expected: TimeStep
    ) -> tuple[TimeStep, np.ndarray]:
        """Plays `episodes` again; `[N]` bool says which ended in `expected`, bit for bit.
        The others begin a new episode."""

    def close(self) -> None:
        """Ends it; a second call does nothing."""


class EnvironmentFailure(RuntimeError):
    """An environment on the host raised, died, hung or returned what no agent can use.

    Attributes:
      environment: index among the N.
      episode: how many episodes it began before this one.
      step: the action of the episode that failed, from 1; 0 is the reset.
      reason: what happened.
      traceback: of the process that simulated, where it had one to tell; else "".
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
            self.add_note(f"In the process of the environment:\n{traceback}")


def check_positive(field: str, value: Any) -> None:
    """Refuses anything that is not a whole number of at least 1."""
    if isinstance(value, bool) or not isinstance(value, int) or value < 1:
        raise InvalidInput(field, value, "use a whole number of at least 1")
