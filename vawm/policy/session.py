"""Acting step by step on observations of an environment itself.

    session = policy.new_session(seed=1)
    action = session.predict(obs, episode_start=True)

A session is the only thing that remembers: the policy's carry, and a key. Underneath are pure
functions, which take and return both.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Literal, cast

import jax
import numpy as np

from vawm.agent import PolicyCarry
from vawm.envs.host.native import Native
from vawm.errors import InvalidInput
from vawm.types import Array, Key, PyTree, TimeStep

How = Literal["sample", "mode"]


class Session:
    """What a policy remembers while it acts, in one environment or in N at once.

    Attributes:
      carry: of the last observations; None before the first.
      key: for the next latents and actions.
      num: observations at once; 0 before the first.
    """

    def __init__(
        self,
        act: Callable[..., tuple[PolicyCarry, Array]],
        initial: Callable[[int], PolicyCarry],
        native: Native,
        key: Key,
    ):
        """Remembers nothing yet.

        Args:
          act: `Policy.act`.
          initial: `Policy.initial`.
          native: the observations and actions of the environment.
          key: for latents and actions.
        """
        self._act, self._initial, self._native = act, initial, native
        self.carry: PolicyCarry | None = None
        self.key = key
        self.num = 0

    def predict(self, obs: Any, episode_start: Any = None, *, how: How = "sample") -> Any:
        """The action for what was observed, and remembers both.

        Args:
          obs: as the environment returns it: one observation, or a batch `[N, ...]`. A dict or
            a tuple of a batch has batches in it.
          episode_start: whether it is the first observation of an episode: a bool, or `[N]` of
            them. Then the policy forgets what was before. None says that it is not, except at
            the first call. Another number of environments than before starts anew, so it needs
            True.
          how: sample the action, or take the policy's mode.

        Returns:
          An action of the environment's own space, or a batch `[N, ...]` of them.

        Raises:
          InvalidInput: the observation is not of the environment's space, or `episode_start`
            does not fit it; nothing is remembered then.
        """
        arrays, batched = self._native.see(obs)
        num = count(arrays)
        starts = starts_of(episode_start, num, before=self.num)
        key, key_act = jax.random.split(self.key)
        carry = self.carry if num == self.num else self._initial(num)
        carry, raw = self._act(key_act, carry, arrived(arrays, starts), how)
        self.carry, self.key, self.num = carry, key, num
        return self._native.take(raw, batched=batched)


def count(arrays: PyTree) -> int:
    """N of arrays `[N, ...]`."""
    return len(jax.tree.leaves(arrays)[0])


def arrived(arrays: PyTree, is_first: np.ndarray) -> TimeStep:
    """What a policy acts on: observations `[N, ...]`, and `[N]` whether they are first ones."""
    num = len(is_first)
    reward, never = np.zeros(num, np.float32), np.zeros(num, bool)
    return TimeStep(arrays, *cast(Any, (reward, is_first, never, never)))


def starts_of(episode_start: Any, num: int, *, before: int) -> np.ndarray:
    """`[num]` bool, whether each of the observations is the first of an episode.

    Args:
      episode_start: a bool, `[num]` of them, or None.
      num: how many observations there are.
      before: how many there were before; 0 if there were none.

    Raises:
      InvalidInput: it is something else, or the number changed in the middle of episodes.
    """
    flags = np.asarray(before == 0 if episode_start is None else episode_start)
    given = None if episode_start is None else f"{flags.dtype}{list(flags.shape)}"
    if flags.dtype != bool or flags.shape not in ((), (num,)):
        remedy = f"pass True or False, or one of them for each of {num} observations"
        raise InvalidInput("episode_start", given, remedy)
    flags = np.broadcast_to(flags, (num,))
    if before not in (0, num) and not flags.all():
        remedy = f"there are {num} observations, before there were {before}; pass True to start"
        raise InvalidInput("episode_start", given, remedy)
    return flags | (before == 0)
