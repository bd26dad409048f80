"""What one environment on the host is: seeded episodes, one action at a time."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np

from vawm.types import PyTree


class Outcome(NamedTuple):
    """What arrives after one action.

    Attributes:
      obs: as `Simulator.obs` says; its arrays may be reused by the next step.
      reward: sum over the action repeat.
      is_last: the episode is over, for any reason; only `reset` may follow.
      is_terminal: the return truly ends here. Mostly a last step, but a life that is lost
        may end the return and not the episode.
    """

    obs: PyTree
    reward: float
    is_last: bool
    is_terminal: bool


class Simulator(Protocol):
    """One environment, made and used in one process.

    An episode is a function of its seed and its actions: equal ones give equal outcomes, bit
    for bit, whatever was played before. Resuming a run relies on it.

    Attributes:
      obs: an `ArraySpec` or a dict of them, as in `EnvSpec.obs`.
      action_size: width of the action, or number of discrete actions.
      discrete: whether actions are choices.
      episode_length: steps of a full episode, None where it varies.
    """

    obs: PyTree
    action_size: int
    discrete: bool
    episode_length: int | None

    def reset(self, seed: int) -> PyTree:
        """Begins the episode `seed`, a number below 2**31; returns its first observation."""

    def step(self, action: np.ndarray | int) -> Outcome:
        """One step: `[action_size]` float32 in [-1, 1], or the index of a discrete action."""

    def close(self) -> None:
        """Gives back what it holds; nothing follows."""
