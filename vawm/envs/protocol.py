"""What every environment of the package looks like: two pure, jittable functions.

Both work on N environments at once; every array leads with `[N]`. The stream follows the
convention of dm_env: the step *after* `is_last` is a reset. It ignores its action, its
reward is 0 and it carries `is_first` with the first observation of a new random episode.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

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


def check_positive(field: str, value: Any) -> None:
    """Refuses anything that is not a whole number of at least 1."""
    if isinstance(value, bool) or not isinstance(value, int) or value < 1:
        raise InvalidInput(field, value, "use a whole number of at least 1")
