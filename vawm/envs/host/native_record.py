"""`Native` as JSON, for the manifest of a checkpoint and for exported policies.

What is read is checked: every kind, shape and number is one that `native.of_spaces` could have
made, so that acting with a foreign file fails here or not at all.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

import jax
import numpy as np

from vawm.envs.host.native import Actions, Bounds, Discrete, Native
from vawm.envs.host.reading import (
    MOST_CHOICES,
    Choices,
    Container,
    Entry,
    Kind,
    Numbers,
    Picture,
    Reading,
)
from vawm.types import IMAGE_SIZES

MOST_AXES = 32
FLOATS = ("float16", "float32", "float64")
INTEGERS = ("int8", "int16", "int32", "int64", "uint8", "uint16", "uint32", "uint64")
KINDS = {"numbers": Numbers, "choices": Choices, "picture": Picture}
ACTIONS = {"discrete": Discrete, "bounds": Bounds}


def as_dict(native: Native) -> dict[str, Any]:
    """Converts `native` for JSON."""
    return {
        "entries": [
            {"name": entry.name, "path": list(entry.path), "kind": tagged(KINDS, entry.kind)}
            for entry in native.reading.entries
        ],
        "containers": [
            {
                "path": list(path),
                "keys": keys if isinstance(keys, int) else list(keys),
            }
            for path, keys in native.reading.containers
        ],
        "actions": tagged(ACTIONS, native.actions),
    }


def tagged(kinds: Mapping[str, type], kind: Any) -> dict[str, Any]:
    """The fields of a kind, with its name; numbers are Python's."""
    (name,) = (name for name, cls in kinds.items() if type(kind) is cls)
    fields = jax.tree.map(
        lambda x: x.item() if isinstance(x, np.generic) else x, dict(kind._asdict())
    )
    return {"is": name} | {
        field: list(value) if isinstance(value, tuple) else value
        for field, value in fields.items()
    }


def from_dict(content: Any) -> Native:
    """The inverse of `as_dict`; ValueError for other content."""
    fields = parsed(content, {"entries": a_list, "containers": a_list, "actions": a_dict})
    entries = tuple(
        Entry(**parsed(entry, {"name": a_text, "path": a_path, "kind": a_kind}))
        for entry in fields["entries"]
    )
    containers = tuple(
        Container(**parsed(container, {"path": a_path, "keys": keys}))
        for container in fields["containers"]
    )
    check_paths(entries, containers)
    actions = of_kind(ACTIONS, fields["actions"])
    check_actions(actions)
    return Native(Reading(entries, containers), actions)


def check_paths(entries: tuple[Entry, ...], containers: tuple[Container, ...]) -> None:
    """ValueError if an entry has no place, or two have one name."""
    names = {entry.name for entry in entries}
    if not entries or len(names) < len(entries) or (names != {""} and not containers):
        raise ValueError("the observations have no entries, or these no names of their own")
    known = {container.path: container.keys for container in containers}
    for path in [path for path, _ in containers] + [entry.path for entry in entries]:
        inside = known.get(path[:-1])
        there = range(inside) if isinstance(inside, int) else inside or ()
        if path and path[-1] not in there:
            raise ValueError(f"{str(path)[:40]!r} is no place in the observations")


def parsed(content: Any, fields: Mapping[str, Callable[[Any], Any]]) -> dict[str, Any]:
    """The fields of a dict that has these and no others; ValueError if it has not."""
    if not isinstance(content, dict) or content.keys() != fields.keys():
        raise ValueError(f"{str(content)[:40]!r} does not have {', '.join(fields)}")
    return {name: parse(content[name]) for name, parse in fields.items()}


def of_kind(kinds: Mapping[str, Any], content: Mapping[str, Any]) -> Any:
    """The kind that `tagged` has written."""
    name = content.get("is")
    if not isinstance(name, str) or name not in kinds:
        raise ValueError(f"{str(name)[:40]!r} is none of {', '.join(kinds)}")
    cls, fields = kinds[name], {k: v for k, v in content.items() if k != "is"}
    return cls(**parsed(fields, FIELDS[cls]))


def a_kind(content: Any) -> Kind:
    """What an entry becomes."""
    kind = of_kind(KINDS, a_dict(content))
    check_kind(kind)
    return kind


def check_kind(kind: Kind) -> None:
    """ValueError for what `read` never makes."""
    if isinstance(kind, Choices):
        count = math.prod(kind.shape)
        if not len(kind.starts) == len(kind.sizes) == count:
            raise ValueError("the choices do not fit their shape")
        if min(kind.sizes, default=0) < 0 or not 0 < sum(kind.sizes) <= MOST_CHOICES:
            raise ValueError("a number of choices is impossible")
    if isinstance(kind, Picture):
        if len(kind.shape) != (2 if kind.channels == "none" else 3):
            raise ValueError("the channels of a picture do not fit its shape")
        if not 0 <= kind.low <= kind.high <= 255 or kind.size not in IMAGE_SIZES:
            raise ValueError("a picture has an impossible size or range")
    if 0 in kind.shape:
        raise ValueError("an entry is empty")


def check_actions(actions: Actions) -> None:
    """ValueError for what no environment takes."""
    if isinstance(actions, Discrete):
        if actions.size < 1 or actions.dtype not in INTEGERS:
            raise ValueError("the choices of actions are impossible")
        return
    if not len(actions.low) == len(actions.high) == actions.size > 0:
        raise ValueError("the bounds of actions do not fit their shape")
    finite = all(map(math.isfinite, actions.low + actions.high))
    if not finite or actions.dtype not in FLOATS:
        raise ValueError("the bounds of actions are not finite, or no floats")


def a_list(value: Any) -> list[Any]:
    if not isinstance(value, list):
        raise ValueError(f"{str(value)[:40]!r} is not a list")
    return value


def a_dict(value: Any) -> dict[str, Any]:
    if not isinstance(value, dict):
        raise ValueError(f"{str(value)[:40]!r} is not a dict")
    return value


def a_text(value: Any) -> str:
    if not isinstance(value, str):
        raise ValueError(f"{str(value)[:40]!r} is not a text")
    return value


def whole(value: Any) -> int:
    if not isinstance(value, int) or isinstance(value, bool):
        raise ValueError(f"{str(value)[:40]!r} is not a whole number")
    return value


def wholes(value: Any) -> tuple[int, ...]:
    return tuple(map(whole, a_list(value)))


def number(value: Any) -> float:
    if not isinstance(value, (int, float)) or isinstance(value, bool):
        raise ValueError(f"{str(value)[:40]!r} is not a number")
    return float(value)


def numbers(value: Any) -> tuple[float, ...]:
    return tuple(map(number, a_list(value)))


def a_shape(value: Any) -> tuple[int, ...]:
    shape = wholes(value)
    if len(shape) > MOST_AXES or min(shape, default=0) < 0:
        raise ValueError(f"{str(value)[:40]!r} is not a shape")
    return shape


def a_path(value: Any) -> tuple[Any, ...]:
    return tuple(key if isinstance(key, str) else whole(key) for key in a_list(value))


def keys(value: Any) -> tuple[str, ...] | int:
    return whole(value) if not isinstance(value, list) else tuple(map(a_text, value))


def channels(value: Any) -> str:
    if value not in ("none", "first", "last"):
        raise ValueError(f"{str(value)[:40]!r} is not a place of channels")
    return value


Fields = dict[str, Callable[[Any], Any]]
SHAPE: Fields = {"shape": a_shape}
CHOICES: Fields = {"starts": wholes, "sizes": wholes}
RANGE: Fields = {"channels": channels, "size": whole, "low": whole, "high": whole}
BOUNDS: Fields = {"low": numbers, "high": numbers, "dtype": a_text}
FIELDS: dict[type, Fields] = {
    Numbers: SHAPE,
    Choices: SHAPE | CHOICES,
    Picture: SHAPE | RANGE,
    Discrete: {"size": whole, "start": whole, "dtype": a_text},
    Bounds: SHAPE | BOUNDS,
}
"""Kind -> how each of its fields is read."""
