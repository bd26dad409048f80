"""What an environment itself returns and takes, beside what an agent sees of it.

    native = of_spaces(env.observation_space, env.action_space, image_size=64)
    arrays, batched = native.see(obs)          # `[N, ...]`, as `EnvSpec.obs` says
    env.step(native.take(raw, batched=batched))  # from raw actions `[N, action_size]`

| action space | becomes                                                        |
|--------------|----------------------------------------------------------------|
| `Box`        | numbers in [-1, 1], scaled to its bounds                       |
| `Discrete`   | one number for each choice, of which the largest chooses       |

`vawm.envs.host.reading` says how observations are read. All of it is plain data, which a run
keeps as JSON (`vawm.envs.host.native_record`): so its policy acts on observations of the
environment without having it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from gymnasium import spaces

from vawm.envs.host.reading import (
    Container,
    Entry,
    Kind,
    Numbers,
    Picture,
    Reading,
    as_numbers,
    find,
    label,
    read,
)
from vawm.envs.host.simulator import legal
from vawm.envs.host.usable import Unusable
from vawm.errors import InvalidInput
from vawm.types import EnvSpec, PyTree, is_image


class Discrete(NamedTuple):
    """`size` choices, of which `start` is the first."""

    size: int
    start: int
    dtype: str

    @property
    def discrete(self) -> bool:
        return True

    def convert(self, action: Any) -> Any:
        """The choice with this index."""
        return np.dtype(self.dtype).type(self.start + action)


class Bounds(NamedTuple):
    """Numbers of this shape between `low` and `high`, both flat."""

    shape: tuple[int, ...]
    low: tuple[float, ...]
    high: tuple[float, ...]
    dtype: str

    @property
    def discrete(self) -> bool:
        return False

    @property
    def size(self) -> int:
        """How many numbers."""
        return math.prod(self.shape)

    def convert(self, action: Any) -> Any:
        """`[size]` numbers in [-1, 1], scaled to the bounds."""
        dtype = np.dtype(self.dtype)
        low, high = (np.array(x, dtype).reshape(self.shape) for x in (self.low, self.high))
        # Halve first: high - low may overflow. Symmetric bounds lose no bit.
        center, reach = low / 2 + high / 2, high / 2 - low / 2
        native = center + reach * np.reshape(action, self.shape).astype(dtype)
        return np.clip(native, low, high)


Actions = Discrete | Bounds


class Native(NamedTuple):
    """The observations and actions of an environment itself.

    Attributes:
      reading: how an agent reads its observations.
      actions: what it takes.
    """

    reading: Reading
    actions: Actions

    def see(self, obs: Any) -> tuple[PyTree, bool]:
        """What an agent sees of one observation, or of a batch of N.

        Args:
          obs: as the environment returns it, or as N of them do that are stepped together: each
            array of a batch leads with N. Texts are not looked at.

        Returns:
          Arrays `[N, ...]` as `EnvSpec.obs` says, and whether it was a batch; N is 1 if not.

        Raises:
          InvalidInput: names what does not belong to the observation space.
        """
        entries, containers = self.reading.entries, self.reading.containers
        try:
            self.reading.check_containers(obs)
            parts = {entry.name: part_of(obs, entry) for entry in entries}
            check_equal_numbers(parts)
            arrays = {entry.name: parts[entry.name].convert(entry) for entry in entries}
        except Unusable as error:
            raise InvalidInput(error.name, type(obs).__name__, f"it {error.what}") from error
        batched = any(part.batched for part in parts.values())
        return (arrays if containers else arrays[""]), batched

    def take(self, raw: Any, *, batched: bool) -> Any:
        """The environment's actions `[N, ...]` for raw ones `[N, action_size]`.

        If not `batched`, N is 1 and the action has no axis for it.
        """
        discrete = self.actions.discrete
        own = [self.actions.convert(legal(row, discrete=discrete)) for row in np.asarray(raw)]
        return np.stack(own) if batched else own[0]


class Part(NamedTuple):
    """One entry of N observations; N is 1 if they are not `batched`."""

    rows: list[np.ndarray]
    batched: bool

    def convert(self, entry: Entry) -> np.ndarray:
        """`[N, ...]` as the agent sees it."""
        name = label("obs", entry.path)
        return np.stack([entry.kind.convert(name, row) for row in self.rows])


def part_of(obs: Any, entry: Entry) -> Part:
    """The entry in an observation or a batch of them.

    Raises:
      Unusable: no numbers.
      InvalidInput: the shape is neither that of one observation nor of several.
    """
    name, shape = label("obs", entry.path), entry.kind.shape
    array = as_numbers(name, find(obs, entry.path))
    if array.shape == shape:
        return Part([array], batched=False)
    if array.ndim == len(shape) + 1 and array.shape[1:] == shape and len(array):
        return Part(list(array), batched=True)
    several = f"(N, {', '.join(map(str, shape))})" if shape else "(N,)"
    remedy = f"pass one observation, of shape {shape}, or a batch of shape {several}"
    raise InvalidInput(name, array.shape, remedy)


def check_equal_numbers(parts: Mapping[str, Part]) -> None:
    """Refuses entries of different numbers of observations.

    Raises:
      InvalidInput: names the numbers.
    """
    numbers = {name: len(part.rows) if part.batched else "one" for name, part in parts.items()}
    if len(set(numbers.values())) > 1:
        raise InvalidInput("obs", numbers, "pass as many observations in every entry")


def of_spaces(observation_space: Any, action_space: Any, *, image_size: int) -> Native:
    """Of an environment with these spaces, which have no problems."""
    reading = read(observation_space, image_size=image_size)
    return Native(Reading(reading.entries, reading.containers), of_actions(action_space))


def of_actions(space: Any) -> Actions:
    """What a `Discrete` or a bounded `Box` takes."""
    dtype = str(space.dtype)
    if isinstance(space, spaces.Discrete):
        return Discrete(int(space.n), int(space.start), dtype)
    low, high = (tuple(map(float, x.ravel())) for x in (space.low, space.high))
    return Bounds(tuple(map(int, space.shape)), low, high, dtype)


def of_spec(spec: EnvSpec) -> Native:
    """Of an environment that has the observations and actions of its spec.

    Its actions are an index, or numbers in [-1, 1].
    """
    named = spec.obs if isinstance(spec.obs, dict) else {"": spec.obs}
    entries = tuple(
        Entry(name, (name,) if name else (), of_array(array)) for name, array in named.items()
    )
    containers = (Container((), tuple(named)),) if isinstance(spec.obs, dict) else ()
    size = spec.action_size
    actions = (
        Discrete(size, 0, "int64")
        if spec.discrete
        else Bounds((size,), (-1.0,) * size, (1.0,) * size, "float32")
    )
    return Native(Reading(entries, containers), actions)


def of_array(array: Any) -> Kind:
    """How to read what already is as its `ArraySpec` says."""
    if is_image(array):
        return Picture(array.shape, "last", array.shape[0])
    return Numbers(array.shape)


def fits(native: Native, spec: EnvSpec) -> bool:
    """Whether an environment of `spec` can be this one."""
    reading, actions = native
    return (
        reading.spec == spec.obs
        and actions.size == spec.action_size
        and actions.discrete == spec.discrete
    )
