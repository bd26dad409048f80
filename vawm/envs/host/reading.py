"""How observations of a Gymnasium space become vectors and images: the space alone decides.

    reading = read(env.observation_space, image_size=64)
    reading.spec          # as `EnvSpec.obs`
    reading.convert(obs)  # arrays of that spec, from what the environment returned

| entry of the space          | becomes                                                       |
|-----------------------------|---------------------------------------------------------------|
| `Box` of bytes, a picture   | an image `[image_size, image_size, channels]`                 |
| any other `Box`             | a vector, in the order of the array                           |
| `Discrete`, `MultiDiscrete` | a vector, one-hot for each choice                             |
| `MultiBinary`               | a vector of 0 and 1                                           |
| `Dict`, `Tuple`, nested     | their entries, named "camera", "0", "robot/joints"            |
| text                        | nothing; a notice says so                                     |

Bytes are a picture if at least two sides have `SMALLEST_IMAGE` entries; those of another range
than 0 to 255 are stretched to it. Smaller grids of bytes are numbers: a grid of 7 x 7 objects,
for example, is no picture.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Mapping
from typing import Any, Literal, NamedTuple

import numpy as np
from gymnasium import spaces

from vawm.envs.host.frames import make_resize
from vawm.envs.host.usable import Unusable, first, one_line
from vawm.types import IMAGE_SIZES, ArraySpec, PyTree, image, vector

SMALLEST_IMAGE = 16
"""Entries per side from which bytes count as a picture."""
MOST_CHOICES = 2**16
"""Longest one-hot vector; a single choice among more is no observation to learn from."""
RESIZE = "bilinear"

Path = tuple[Any, ...]
"""Keys and indices from an observation to one of its entries."""


class Numbers(NamedTuple):
    """Numbers of this shape, as a vector."""

    shape: tuple[int, ...]

    @property
    def spec(self) -> ArraySpec:
        return vector(math.prod(self.shape))

    def convert(self, name: str, value: Any) -> np.ndarray:
        """The numbers as float32.

        Raises:
          Unusable: another shape, no numbers, or not finite in float32.
        """
        array = as_array(name, value, self.shape)
        with np.errstate(over="ignore"):
            numbers = array.astype(np.float32)
        if not (finite := np.isfinite(numbers)).all():
            where, worst = first(~finite, array)
            if np.isfinite(worst):
                raise Unusable(
                    f"{name}{where}", f"is {worst:g}, beyond float32", "scale it down"
                )
            raise Unusable(f"{name}{where}", f"is {worst}, not finite", "return finite numbers")
        return numbers.reshape(-1)


class Choices(NamedTuple):
    """Choices in an array of this shape, each one-hot.

    `starts` has the first number of each choice and `sizes` how many there are, both flat.
    """

    shape: tuple[int, ...]
    starts: tuple[int, ...]
    sizes: tuple[int, ...]

    @property
    def spec(self) -> ArraySpec:
        return vector(sum(self.sizes))

    def convert(self, name: str, value: Any) -> np.ndarray:
        """Ones at the choices, zeros elsewhere.

        Raises:
          Unusable: another shape, no whole numbers, or a number that is not among the choices.
        """
        array = as_array(name, value, self.shape)
        if array.dtype.kind not in "biu":
            what = f"is {array.dtype}, not a whole number"
            raise Unusable(name, what, "return integers")
        chosen = array.reshape(-1).astype(np.int64) - self.starts
        if (outside := (chosen < 0) | (chosen >= self.sizes)).any():
            where = np.unravel_index(int(outside.argmax()), self.shape)
            index, number = f"{list(map(int, where)) or ''}", array[where]
            what = f"is {number}, which is not among the choices of its space"
            raise Unusable(f"{name}{index}", what, "declare it, or return another")
        one_hot = np.zeros(sum(self.sizes), np.float32)
        one_hot[np.cumsum((0, *self.sizes[:-1])) + chosen] = 1.0
        return one_hot


class Picture(NamedTuple):
    """Bytes of this shape, as an image of `size` x `size` pixels with channels last.

    Bytes from `low` to `high` are stretched to 0 to 255.
    """

    shape: tuple[int, ...]
    channels: Literal["none", "first", "last"]
    size: int
    low: int = 0
    high: int = 255

    @property
    def depth(self) -> int:
        """Number of channels."""
        return {"none": 1, "first": self.shape[0], "last": self.shape[-1]}[self.channels]

    @property
    def sides(self) -> tuple[int, int]:
        """Height and width before it is resized."""
        height, width = self.shape[1:] if self.channels == "first" else self.shape[:2]
        return height, width

    @property
    def spec(self) -> ArraySpec:
        return image(self.size, channels=self.depth)

    def convert(self, name: str, value: Any) -> np.ndarray:
        """The resized picture; as it is if it has the size and the whole range of bytes.

        Raises:
          Unusable: another shape, or not bytes.
        """
        array = as_array(name, value, self.shape)
        if array.dtype != np.uint8:
            raise Unusable(name, f"is {array.dtype}, not uint8", "return .astype(np.uint8)")
        height, width = self.sides
        if self.channels == "first":
            array = array.transpose(1, 2, 0)
        array = array.reshape(height, width, self.depth)
        if (self.low, self.high) != (0, 255):
            array = stretched(self.low, self.high)[array]
        if (height, width) == (self.size, self.size):
            return array
        return resizer(height, width, self.depth, self.size)(array)


Kind = Numbers | Choices | Picture


@functools.cache
def resizer(
    height: int, width: int, channels: int, size: int
) -> Callable[[np.ndarray], np.ndarray]:
    """`make_resize`, remembered: its weights are not part of a pickled reading."""
    return make_resize(RESIZE, height=height, width=width, size=size, channels=channels)


@functools.cache
def stretched(low: int, high: int) -> np.ndarray:
    """`[256]` uint8: what each byte becomes, 0 at `low` and 255 at `high`."""
    share = (np.arange(256) - low) / max(1, high - low)
    return np.rint(255 * np.clip(share, 0, 1)).astype(np.uint8)


class Entry(NamedTuple):
    """One array of the converted observation: its name, where it is, and what it becomes."""

    name: str
    path: Path
    kind: Kind


class Container(NamedTuple):
    """A dict with these keys, or a tuple with this many entries."""

    path: Path
    keys: tuple[str, ...] | int


class Reading(NamedTuple):
    """How to read the observations of one space; small, and can be pickled.

    Attributes:
      entries: the arrays of the converted observation.
      containers: the dicts and tuples of the space, outer ones first.
      notices: what a user should know of it, one line each.
      problems: (name, text with remedy) of each part that cannot be read. A reading with
        problems converts nothing.

    A run keeps its entries and containers, see `vawm.envs.host.native`.
    """

    entries: tuple[Entry, ...]
    containers: tuple[Container, ...]
    notices: tuple[str, ...] = ()
    problems: tuple[tuple[str, str], ...] = ()

    @property
    def spec(self) -> PyTree:
        """An `ArraySpec`, or a dict of them for a `Dict` or `Tuple`."""
        specs = {entry.name: entry.kind.spec for entry in self.entries}
        return specs if self.containers else specs[""]

    def convert(self, obs: Any) -> PyTree:
        """Arrays as `spec` says, from an observation of the space.

        Raises:
          Unusable: the observation is not of the space, or not finite in float32.
        """
        self.check_containers(obs)
        arrays = {
            entry.name: entry.kind.convert(label("obs", entry.path), find(obs, entry.path))
            for entry in self.entries
        }
        return arrays if self.containers else arrays[""]

    def check_containers(self, obs: Any) -> None:
        """Checks the keys of all dicts and the lengths of all tuples.

        Raises:
          Unusable: names the first that differs from its space.
        """
        for path, keys in self.containers:
            check_container(label("obs", path), find(obs, path), keys)


def read(space: Any, *, image_size: int) -> Reading:
    """Decides how to read the observations of a space; `Reading.problems` says what it cannot.

    Args:
      space: the observation space.
      image_size: pixels a side to which pictures are resized.
    """
    found = Found([], [], [], [])
    look_into(space, (), image_size, found)
    names = [entry.name for entry in found.entries]
    for name in {name for name in names if names.count(name) > 1}:
        text = f"observation_space has two entries called {name!r}: rename one of them"
        found.problems.append((f"observation_space {name}", text))
    if not (names or found.problems):
        text = f"observation space {space!s:.100} has nothing to learn from: add a Box"
        found.problems.append(("observation_space", text))
    return Reading(
        entries=tuple(found.entries),
        containers=tuple(found.containers),
        notices=tuple(found.notices),
        problems=tuple(found.problems),
    )


class Found(NamedTuple):
    """What a walk through a space has found; the fields of `Reading`."""

    entries: list[Entry]
    containers: list[Container]
    notices: list[str]
    problems: list[tuple[str, str]]


def look_into(space: Any, path: Path, image_size: int, found: Found) -> None:
    """Adds what is in a space, at `path` of the observation, to `found`."""
    name = label("observation_space", path)
    if isinstance(space, spaces.Dict):
        odd = [key for key in space.spaces if not isinstance(key, str)]
        for key in odd:
            text = f"{name}[{key!r}] has a key that is not a string: use a string"
            found.problems.append((f"{name}[{key!r}]", text))
        if odd:
            return
        found.containers.append(Container(path, tuple(space.spaces)))
        for key, inner in space.spaces.items():
            look_into(inner, (*path, key), image_size, found)
    elif isinstance(space, spaces.Tuple):
        found.containers.append(Container(path, len(space.spaces)))
        for index, inner in enumerate(space.spaces):
            look_into(inner, (*path, index), image_size, found)
    elif is_text(space):
        found.notices.append(f"{label('obs', path)} is a text: it is left out")
    else:
        kind = kind_of(space, image_size)
        if isinstance(kind, str):
            whole = name if path else "observation space"
            found.problems.append((name, f"{whole} {kind}"))
            return
        found.entries.append(Entry("/".join(map(str, path)), path, kind))
        if notice := notice_of(kind, space):
            found.notices.append(f"{label('obs', path)} {notice}")


def is_text(space: Any) -> bool:
    """Whether a space is of strings, such as `Text` or MiniGrid's missions."""
    dtype = getattr(space, "dtype", None)
    return isinstance(space, spaces.Space) and dtype is not None and dtype.kind == "U"


def kind_of(space: Any, image_size: int) -> Kind | str:
    """What a space without entries becomes; a problem with its remedy if that is a string."""
    if isinstance(space, spaces.Discrete):
        return choices((), [space.start], [space.n])
    if isinstance(space, spaces.MultiDiscrete):
        start = getattr(space, "start", np.zeros_like(space.nvec))
        return choices(space.nvec.shape, start.ravel(), space.nvec.ravel())
    if isinstance(space, spaces.MultiBinary):
        return Numbers(space.shape)
    if isinstance(space, spaces.Box):
        return of_box(space, image_size)
    if not isinstance(space, spaces.Space):
        return f"is {space!s:.100}, not a space of Gymnasium: declare a Box"
    remedy = "return a Box, a Dict or a Tuple from an ObservationWrapper"
    return f"is {space!s:.100}, which has no fixed size: {remedy}"


def choices(shape: tuple[int, ...], starts: Any, sizes: Any) -> Kind | str:
    """One-hot choices, unless there are none or too many."""
    total = sum(map(int, sizes))
    if not total:
        return empty(shape)
    if total > MOST_CHOICES:
        remedy = "return numbers that describe them, in a Box, from an ObservationWrapper"
        return f"has {total} choices, more than {MOST_CHOICES}: {remedy}"
    return Choices(shape, tuple(map(int, starts)), tuple(map(int, sizes)))


def of_box(box: Any, image_size: int) -> Kind | str:
    """What a `Box` becomes."""
    shape = box.shape
    if 0 in shape:
        return empty(shape)
    if box.dtype != np.uint8:
        if sum(side >= IMAGE_SIZES[0] for side in shape) < 2:
            return Numbers(shape)
        remedy = "declare uint8 if it is an image, flatten it if it is not"
        return f"has the shape of an image, {shape}, but dtype {box.dtype}: {remedy}"
    if sum(side >= SMALLEST_IMAGE for side in shape) < 2:
        return Numbers(shape)
    if len(shape) > 3:
        return f"has bytes of shape {shape}: stack pictures along the channels, (H, W, C)"
    low, high = int(box.low.min()), int(box.high.max())
    if len(shape) == 2:
        return Picture(shape, "none", image_size, low, high)
    if shape[2] < min(shape[:2]):
        return Picture(shape, "last", image_size, low, high)
    if shape[0] < min(shape[1:]):
        return Picture(shape, "first", image_size, low, high)
    remedy = "put the channels last, (H, W, C), or flatten it if it is not a picture"
    return f"has bytes of shape {shape}, of which no side can be the channels: {remedy}"


def empty(shape: tuple[int, ...]) -> str:
    return f"has shape {shape}, so it is empty: remove it"


def notice_of(kind: Kind, space: Any) -> str:
    """What a user should know of how an entry is read, or ""."""
    if isinstance(kind, Picture):
        height, width = kind.sides
        changes = []
        if (kind.low, kind.high) != (0, 255):
            changes.append(f"bytes from {kind.low} to {kind.high} are stretched to 0 to 255")
        if (height, width) != (kind.size, kind.size):
            new = f"{kind.size} x {kind.size} (image_size) by Pillow's {RESIZE} filter"
            changes.append(f"they are resized to {new}")
        if changes:
            return f"has pictures of {height} x {width} pixels: {'; '.join(changes)}"
    if isinstance(kind, Numbers) and space.dtype == np.uint8 and len(kind.shape) > 1:
        sides = " x ".join(map(str, kind.shape))
        return f"has {sides} bytes, too few for a picture: they are read as numbers"
    return ""


def label(root: str, path: Path) -> str:
    """A name for messages, such as `obs['robot'][0]`."""
    return root + "".join(f"[{key!r}]" for key in path)


def find(obs: Any, path: Path) -> Any:
    """The entry of an observation at a path."""
    for key in path:
        obs = obs[key]
    return obs


def check_container(name: str, value: Any, keys: tuple[str, ...] | int) -> None:
    """Checks the keys of a dict, or the length of a tuple.

    Raises:
      Unusable: they are not those of the space.
    """
    if isinstance(keys, int):
        if not isinstance(value, (tuple, list)):
            what = f"is a {type(value).__name__}, but its space a Tuple"
            raise Unusable(name, what, "return a tuple")
        if len(value) != keys:
            what = f"has {len(value)} entries, but its space {keys}"
            raise Unusable(name, what, "return those of the space")
        return
    if not isinstance(value, Mapping):
        what = f"is a {type(value).__name__}, but its space is a Dict"
        raise Unusable(name, what, "return a dict")
    if set(value) != set(keys):
        what = f"has keys {sorted(map(str, value))}, but its space {sorted(keys)}"
        raise Unusable(name, what, "return the keys of the space")


def as_array(name: str, value: Any, shape: tuple[int, ...]) -> np.ndarray:
    """A numpy array of numbers from what an environment returned.

    Raises:
      Unusable: it cannot be one, or has another shape.
    """
    array = as_numbers(name, value)
    if array.shape != shape:
        what = f"has shape {array.shape}, but its space {shape}"
        raise Unusable(name, what, "change one of them")
    return array


def as_numbers(name: str, value: Any) -> np.ndarray:
    """A numpy array of numbers, of any shape.

    Raises:
      Unusable: the value cannot be one.
    """
    try:
        array = np.asarray(value)
    except Exception as error:  # lists of different lengths, arrays on another device, ...
        what = f"is a {type(value).__name__} that numpy cannot read ({one_line(error)})"
        raise Unusable(name, what, "return a numpy array") from error
    if array.dtype.kind in "OUSVcMm" and array.dtype.name != "bfloat16":
        raise Unusable(name, f"holds {array.dtype}, not numbers", "return a numpy array")
    return array
