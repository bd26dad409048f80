"""How environments were made: the record that a run keeps of them.

`of` describes any environments. What a suite or a registered id has made can be made again from
the record, by `vawm.runs.suites.make_again`; what the caller has made cannot.
"""

from __future__ import annotations

import functools
import json
import re
from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

from vawm.envs.protocol import Environment, HostEnvironment
from vawm.types import EnvSpec, Made

OBJECT = "object"
MJX = "vawm.envs.mjx.environment"
"""The module whose functions are the environments of `vawm.envs.make`."""


def of(env: Environment | HostEnvironment) -> Made:
    """How `env` was made: what it says itself, or that it is an object of the caller's."""
    made = getattr(env, "made", None) or env.spec.made
    if made is not None:
        return made
    if not isinstance(env, Environment):
        return Made(OBJECT, qualified(type(env)))
    if env.reset.__module__ == env.step.__module__ == MJX:
        repeat = {"action_repeat": env.spec.action_repeat}
        return Made("dmc_proprio", env.spec.task, options=repeat)
    return Made(OBJECT, qualified(env.step))


def by_gymnasium(
    make: str | Callable[..., Any],
    *,
    options: Mapping[str, Any],
    kwargs: Mapping[str, Any],
    registered: Mapping[str, Any],
) -> Made:
    """The record of `vawm.envs.from_gymnasium`.

    Args:
      make: the registered id, or the caller's function or class.
      options: what `from_gymnasium` was given beside it, and what changes the environment.
      kwargs: for the environment.
      registered: what the id stands for, see `vawm.envs.host.gymnasium.registration`.
    """
    plain = {name: value for name, value in kwargs.items() if in_json(value)}
    return Made(
        by="gymnasium" if isinstance(make, str) else OBJECT,
        name=make if isinstance(make, str) else qualified(make),
        options=dict(options),
        kwargs=plain,
        opaque={name: shown(kwargs[name]) for name in kwargs.keys() - plain.keys()},
        registered=dict(registered),
    )


def can_be_made_again(made: Made | None) -> bool:
    """Whether a command can make such environments; runs of earlier versions name theirs."""
    return made is None or (made.by != OBJECT and not made.opaque)


def describe(made: Made) -> str:
    """One line: the name, and everything that was chosen beside it."""
    chosen = {**made.options, **made.kwargs}
    words = [f"{name}={value!r}" for name, value in chosen.items() if value is not None]
    words += [f"{name}={value}" for name, value in made.opaque.items()]
    whose = "an object of the caller's, " if made.by == OBJECT else ""
    return f"{whose}{made.name}" + (f" ({', '.join(words)})" if words else "")


class Difference(NamedTuple):
    """Something that differs between the environments of a run and others.

    Attributes:
      name: such as "time_limit" or "obs".
      then: its value when the run started.
      now: its value now.
      grave: False where the same environment may differ in it: a name that depends on how a
        script was started, and the `repr` of an object.
    """

    name: str
    then: Any
    now: Any
    grave: bool = True


def differences(then: EnvSpec, now: EnvSpec) -> Iterator[Difference]:
    """What differs between two environments; of what earlier versions did not keep, `made` and
    `native`, only if both have it."""
    for name in EnvSpec._fields:
        values = getattr(then, name), getattr(now, name)
        told = name != "native" or None not in values
        if name != "made" and told and values[0] != values[1]:
            yield Difference(name, *values)
    if then.made is None or now.made is None:
        return
    for name in ("by", "name"):
        values = getattr(then.made, name), getattr(now.made, name)
        if values[0] != values[1]:
            objects = then.made.by == now.made.by == OBJECT
            yield Difference(name, *values, grave=not (objects and name == "name"))
    for own, others, grave in (
        (then.made.options, now.made.options, True),
        (then.made.kwargs, now.made.kwargs, True),
        (then.made.registered, now.made.registered, True),
        (then.made.opaque, now.made.opaque, False),
    ):
        for name in sorted(own.keys() | others.keys()):
            if own.get(name) != others.get(name):
                yield Difference(name, own.get(name), others.get(name), grave)


def as_dict(made: Made) -> dict[str, Any]:
    """Converts `made` for JSON."""
    return made._asdict()


def from_dict(content: Any) -> Made:
    """The inverse of `as_dict`; ValueError for other content."""
    kinds = {"by": str, "name": str, "options": dict, "kwargs": dict, "opaque": dict}
    kinds["registered"] = dict
    if not isinstance(content, dict) or content.keys() != kinds.keys():
        raise ValueError(f"{str(content)[:40]!r} does not say how environments were made")
    for name, kind in kinds.items():
        if not isinstance(content[name], kind):
            raise ValueError(f"{name} is {str(content[name])[:40]!r}, of the wrong type")
    return Made(**content)


def qualified(thing: Any) -> str:
    """The qualified name of a function or class, or of what a partial function calls."""
    while isinstance(thing, functools.partial):
        thing = thing.func
    if not hasattr(thing, "__qualname__"):
        thing = type(thing)
    return f"{thing.__module__}.{thing.__qualname__}"


def in_json(value: Any) -> bool:
    """Whether JSON gives back an equal value of the same type."""
    try:
        back = json.loads(json.dumps(value, allow_nan=False))
        return type(back) is type(value) and bool(back == value)
    except (TypeError, ValueError, RecursionError):
        return False


def shown(value: Any) -> str:
    """The `repr` of a value, without addresses, at most 200 characters."""
    return re.sub(r" at 0x[0-9a-f]+", "", repr(value))[:200]
