"""The interface of one environment on the host: seeded episodes, one action at a time."""

from __future__ import annotations

from typing import NamedTuple, Protocol

import numpy as np

from vawm.types import PyTree


class Outcome(NamedTuple):
    """The result of one action.

    Attributes:
      obs: as `Simulator.obs` specifies; the next step may reuse its arrays.
      reward: sum over the action repeat; a number, or an array of one without axes.
      is_last: the episode is over, for any reason; only `reset` may follow.
      is_terminal: the return ends here. Usually the last step of an episode, but a lost
        life may end the return without ending the episode.
    """

    obs: PyTree
    reward: float
    is_last: bool
    is_terminal: bool


class Simulator(Protocol):
    """One environment, made and used in one process.

    An episode must depend only on its seed and its actions: equal ones give equal outcomes,
    bit for bit, whatever was played before. Resuming a run relies on this.

    Attributes:
      obs: an `ArraySpec` or a dict of them, as in `EnvSpec.obs`.
      action_size: width of the action, or number of discrete actions.
      discrete: whether actions are choices.
      episode_length: steps of a full episode, None if it varies.

    An attribute `notices`, if there is one, is a tuple of lines to say when a run starts. An
    attribute `native`, if there is one, is that of `EnvSpec`. A method `picture()`, if there is
    one, draws the environment as it is now, `[H, W, 3]` uint8, or returns None if it cannot; it
    changes nothing.
    """

    obs: PyTree
    action_size: int
    discrete: bool
    episode_length: int | None

    def reset(self, seed: int) -> PyTree:
        """Starts the episode of `seed`, below 2**31; returns its first observation."""

    def step(self, action: np.ndarray | int) -> Outcome:
        """Takes `[action_size]` float32 in [-1, 1], or the index of a discrete action."""

    def close(self) -> None:
        """Frees all resources; no call follows."""


def legal(raw: np.ndarray, *, discrete: bool) -> np.ndarray | int:
    """What `Simulator.step` takes, for a raw action `[action_size]`; NaN counts as 0."""
    action = np.where(np.isnan(raw), np.float32(0), raw)
    if discrete:
        return int(np.argmax(action))
    return np.clip(action, -1, 1)
