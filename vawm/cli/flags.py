"""Flags from a dataclass, by tyro, with one line per error instead of its box.

Every program also takes `--plugin FILE_OR_MODULE ...`, which registers further agents, see
`vawm.agent.plugins`; a field that is an `AgentName` offers all that are registered.
"""

from __future__ import annotations

import argparse
import contextlib
import dataclasses
import io
import re
import sys
import typing
from collections.abc import Sequence
from typing import Annotated, Any, TypeVar

import tyro

from vawm.agent import plugins, registry
from vawm.config import AgentName, Config
from vawm.errors import InvalidInput, reworded, suggestion

T = TypeVar("T")

KINDS = {int: "a whole number", float: "a number"}


def read(
    cls: type[T],
    argv: Sequence[str] | None = None,
    *,
    default: T | None = None,
    description: str | None = None,
) -> T:
    """What `argv` (of the process if None) says, as a `cls`.

    Raises:
      InvalidInput: names the flag, its value and the remedy.
      SystemExit: help was asked for (0).
    """
    argv = load_plugins(list(sys.argv[1:] if argv is None else argv))
    offered = _offering(cls)
    given: Any = {} if default is None else {"default": _recast(default, offered)}
    box = io.StringIO()
    try:
        with contextlib.redirect_stderr(box):
            result, unknown = tyro.cli(
                offered, args=argv, description=description, return_unknown_args=True, **given
            )
    except SystemExit as error:
        if not error.code:
            raise
        raise _bad_value(box.getvalue(), argv, known(cls, default)) from None
    if unknown:
        raise _unknown(unknown, known(cls, default))
    return _recast(result, cls)


def load_plugins(argv: list[str]) -> list[str]:
    """`argv` without `--plugin` and the words after it, which are imported.

    Raises:
      InvalidInput: no word follows, or one cannot be imported.
    """
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    parser.add_argument("--plugin", nargs="+", action="extend", default=[])
    try:
        known, left = parser.parse_known_args(argv)
    except argparse.ArgumentError:
        known, left = argparse.Namespace(plugin=[""]), argv
    if "" in known.plugin:
        remedy = "has no value; name a module, or a file like own.py"
        raise InvalidInput("--plugin", None, remedy)
    if known.plugin:
        plugins.add(known.plugin)
    return left


def _offering(cls: type) -> type:
    """`cls`, where a field that is an `AgentName` is one of the agents that are registered."""
    changed: list[tuple[str, Any]] = []
    hints, offered = typing.get_type_hints(cls, include_extras=True), kinds(cls)
    for field in dataclasses.fields(cls):
        hint = hints[field.name]
        if hint == AgentName:
            changed.append((field.name, offered[field.name]))
        elif field.name == "config":
            inner = _offering(Config)
            changed.append((field.name, Annotated[(inner, *typing.get_args(hint)[1:])]))
    if not changed:
        return cls
    return dataclasses.make_dataclass(cls.__name__, changed, bases=(cls,), frozen=True)


def _recast(value: Any, cls: type) -> Any:
    """A dataclass with the same fields as a `cls`, its config too."""
    parts = {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
    kinds = typing.get_type_hints(cls)
    if "config" in parts:
        parts["config"] = _recast(parts["config"], kinds["config"])
    return cls(**parts)


def known(cls: type, default: Any = None, prefix: str = "") -> dict[str, Any]:
    """Flag -> type, for every field; those of `config: Config` have no prefix.

    Where `default` holds a subclass of what a field is declared as, its fields count.
    """
    hints = kinds(cls)
    result: dict[str, Any] = {}
    for field in dataclasses.fields(cls):
        name, kind = prefix + field.name, hints[field.name]
        value = getattr(default, field.name, None)
        if dataclasses.is_dataclass(kind):
            inner = typing.cast(type, kind) if value is None else type(value)
            result |= known(inner, value, "" if name == "config" else name + ".")
        else:
            result[_dashed("--" + name)] = kind
    return result


def kinds(cls: type) -> dict[str, Any]:
    """Field -> type, of a dataclass; that of an `AgentName` has the names of all agents."""
    plain = typing.get_type_hints(cls)
    marked = typing.get_type_hints(cls, include_extras=True)
    agents = (name for name, hint in marked.items() if hint == AgentName)
    return plain | dict.fromkeys(agents, typing.Literal[registry.names()])


def choices(cls: type, name: str) -> tuple[str, ...]:
    """What a field that is a `Literal` may be."""
    return typing.get_args(kinds(cls)[name])


def in_flags(error: Exception) -> str:
    """The message of an error, with flags in the place of the choices that it names.

    `env.time_limit=1000` becomes `--env.time-limit 1000`.
    """
    settings = getattr(error, "settings", {})
    return reworded(str(error), settings, lambda name, value: f"{_dashed('--' + name)} {value}")


def _dashed(flag: str) -> str:
    """`--a.b_c_` as tyro writes it: `--a.b-c_`."""
    return re.sub(r"(?<=\w)_(?=\w)", "-", flag)


def _unknown(words: list[str], flags: dict[str, Any]) -> InvalidInput:
    """The error for words that tyro could not place."""
    first = next((word for word in words if word.startswith("-")), None)
    if first is None:
        remedy = "belongs to no flag; write --flag value (--help lists the flags)"
        return InvalidInput("argument", words[0], remedy)
    flag, values = first.partition("=")[0], _values(first.partition("=")[0], words)
    guess = suggestion(_dashed(flag), flags)
    value = " ".join(values) if values else None
    return InvalidInput(flag, value, f"no such flag; {guess}--help lists all")


def _bad_value(box: str, argv: list[str], flags: dict[str, Any]) -> InvalidInput:
    """The error behind tyro's message, of which only the first flag is used."""
    flag = next((name for name in re.findall(r"--[\w.-]*\w", box) if name in flags), None)
    if flag is None:
        text = " ".join(re.sub(r"[╭╮╰╯│─]", " ", box).split())
        return InvalidInput("arguments", " ".join(argv), f"{text} (--help lists the flags)")
    values, kind = _values(flag, argv), flags[flag]
    if values is None:
        return InvalidInput(flag, None, "is required (--help tells more)")
    if not values:
        return InvalidInput(flag, None, f"has no value; {_remedy(None, kind)}")
    return InvalidInput(flag, " ".join(values), _remedy(values[0], kind))


def _values(flag: str, words: list[str]) -> list[str] | None:
    """The words that follow the last `flag`; None where it is not given."""
    found = None
    for i, word in enumerate(words):
        name, has_value, value = word.partition("=")
        if _dashed(name) == _dashed(flag):
            end = i + 1
            while end < len(words) and not words[end].startswith("--"):
                end += 1
            found = [value] if has_value else words[i + 1 : end]
    return found


def _remedy(value: str | None, kind: Any) -> str:
    if typing.get_origin(kind) is typing.Literal:
        names = [str(choice) for choice in typing.get_args(kind)]
        return f"{suggestion(value or '', names)}use one of {', '.join(names)}"
    wanted = [KINDS[k] for k in (kind, *typing.get_args(kind)) if k in KINDS]
    return f"use {wanted[0]}" if wanted else "--help tells what it takes"
