"""Flags from a dataclass, by tyro, with one line per error instead of its box.

Every program also takes `--plugin FILE_OR_MODULE ...`, which registers further agents, see
`vawm.agent.plugins`; a field that is an `AgentName` offers all that are registered. Whole
numbers may be written as `1e6` or `500_000`.
"""

from __future__ import annotations

import argparse
import ast
import contextlib
import dataclasses
import decimal
import functools
import inspect
import io
import itertools
import re
import sys
import textwrap
import typing
from collections.abc import Sequence
from typing import Annotated, Any, TypeVar

import tyro

from vawm.agent import plugins, registry
from vawm.config import AgentName, Config
from vawm.errors import InvalidInput, reworded, suggestion

T = TypeVar("T")

KINDS = {int: "a whole number", float: "a number"}
MEANT = {
    "--lr": "--optimizer.learning-rate",
    "--learning-rate": "--optimizer.learning-rate",
    "--steps": "--env-steps",
    "--num-steps": "--env-steps",
    "--timesteps": "--env-steps",
    "--total-steps": "--env-steps",
    "--total-timesteps": "--env-steps",
    "--env": "--task",
    "--env-id": "--task",
    "--game": "--task",
    "--n-envs": "--num-envs",
    "--batch-size": "--replay.batch-size",
    "--buffer-size": "--replay.capacity",
    "--gamma": "--imagination.discount-horizon",
    "--output-dir": "--logdir",
    "--model": "--agent",
}
"""Flag of other programs -> ours, where the spelling does not tell."""
ELSEWHERE = {"--device": "JAX_PLATFORMS=cpu, or =cuda, before the command chooses the device"}
"""Flag of other programs -> what does it here."""
OFF = ("off", "none", "false", "no", "0")
"""Words for nothing, of which a choice has one at most."""


def read(
    cls: type[T],
    argv: Sequence[str] | None = None,
    *,
    default: T | None = None,
    description: str | None = None,
    prog: str | None = None,
) -> T:
    """What `argv` (of the process if None) says, as a `cls`.

    Args:
      cls: a dataclass; each field is a flag.
      argv: the words after the program's name.
      default: values of the fields; those of `cls` if None.
      description: for the help.
      prog: the program's name in the help; as the process was started if None.

    Raises:
      InvalidInput: names the flag, its value and the remedy.
      SystemExit: help was asked for (0).
    """
    argv = load_plugins(list(sys.argv[1:] if argv is None else argv))
    argv = _with_whole_numbers(argv, known(cls, default))
    offered = _offering(cls)
    given: Any = {} if default is None else {"default": _recast(default, offered)}
    box = io.StringIO()
    try:
        with contextlib.redirect_stderr(box):
            result, unknown = tyro.cli(
                offered,
                prog=prog,
                args=argv,
                description=description,
                return_unknown_args=True,
                **given,
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


def _with_whole_numbers(argv: list[str], flags: dict[str, Any]) -> list[str]:
    """`argv`, where the values of flags that take whole numbers are written in digits."""
    result, kind = [], None
    for word in argv:
        name, has_value, value = word.partition("=")
        if word.startswith("--"):
            kind = flags.get(_dashed(name))
        if int not in (kind, *typing.get_args(kind)):
            result.append(word)
        elif word.startswith("--"):
            result.append(f"{name}={whole(value)}" if has_value else word)
        else:
            result.append(whole(word))
    return result


def whole(word: str) -> str:
    """`1e6` or `2.5e3` in digits; `word` itself if it is something else, or not whole."""
    if not re.fullmatch(r"[+-]?\d+(_\d+)*(\.\d+)?[eE]\+?\d{1,2}", word):
        return word
    number = decimal.Decimal(word)
    return str(int(number)) if number == int(number) else word


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


def known(cls: type, default: Any = None) -> dict[str, Any]:
    """Flag -> type, for every field; those of `config: Config` have no prefix.

    Where `default` holds a subclass of what a field is declared as, its fields count.
    """
    found = _fields(cls, default)
    hints = {owner: kinds(owner) for owner, _ in found.values()}
    return {flag: hints[owner][name] for flag, (owner, name) in found.items()}


def sentences(cls: type, default: Any = None) -> dict[str, str]:
    """Flag -> the string below its field in the source, which is its help; "" without one.

    A field that a class only gives another default has the string of its base, as in tyro.
    """
    return {
        flag: _string_below(owner, name)
        for flag, (owner, name) in _fields(cls, default).items()
    }


def _fields(cls: type, default: Any, prefix: str = "") -> dict[str, tuple[type, str]]:
    """Flag -> the class of its field, and the field's name there; see `known`."""
    hints = kinds(cls)
    result: dict[str, tuple[type, str]] = {}
    for field in dataclasses.fields(cls):
        name, kind = prefix + field.name, hints[field.name]
        value = getattr(default, field.name, None)
        if dataclasses.is_dataclass(kind):
            inner = typing.cast(type, kind) if value is None else type(value)
            result |= _fields(inner, value, "" if name == "config" else name + ".")
        else:
            result[_dashed("--" + name)] = cls, field.name
    return result


def _string_below(cls: type, name: str) -> str:
    """The string below a field, in the first of the classes of `cls` that has one."""
    found = (_strings_below(owner).get(name) for owner in cls.__mro__[:-1])
    return next((text for text in found if text), "")


@functools.cache
def _strings_below(cls: type) -> dict[str, str]:
    """Field -> the string below it, of the fields that `cls` itself declares."""
    try:
        source = inspect.getsource(cls)
    except (OSError, TypeError):  # made by a function, or typed into a session
        return {}
    [declared] = ast.parse(textwrap.dedent(source)).body
    assert isinstance(declared, ast.ClassDef)
    return {
        ast.unparse(field.target): " ".join(str(below.value.value).split())
        for field, below in itertools.pairwise(declared.body)
        if isinstance(field, ast.AnnAssign)
        and isinstance(below, ast.Expr)
        and isinstance(below.value, ast.Constant)
    }


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
    value = " ".join(values) if values else None
    if _dashed(flag) in ELSEWHERE:
        return InvalidInput(flag, value, f"no such flag; {ELSEWHERE[_dashed(flag)]}")
    meant = MEANT.get(_dashed(flag))
    guess = suggestion(meant if meant in flags else _dashed(flag), flags)
    return InvalidInput(flag, value, f"no such flag; {guess}--help lists all")


def _bad_value(box: str, argv: list[str], flags: dict[str, Any]) -> InvalidInput:
    """The error behind tyro's message, of which only the first flag is used."""
    flag = next((name for name in re.findall(r"--[\w.-]*\w", box) if name in flags), None)
    if flag is None:
        text = " ".join(re.sub(r"[╭╮╰╯│─]", " ", box).split())
        return InvalidInput("arguments", " ".join(argv), f"{text} (--help lists the flags)")
    values, kind = _values(flag, argv), flags[flag]
    if values is None:
        for place, word in enumerate(argv):  # the required one may be misspelt
            name = re.sub(r"(^--|\.)no-", r"\1", _dashed(word.partition("=")[0]))
            if word.startswith("--") and name not in flags:
                return _unknown(argv[place:], flags)
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
        nothing = [name for name in names if name in OFF and (value or "").lower() in OFF]
        guess = suggestion(nothing[0] if nothing else value or "", names)
        return f"{guess}use one of {', '.join(names)}"
    wanted = [KINDS[k] for k in (kind, *typing.get_args(kind)) if k in KINDS]
    return f"use {wanted[0]}" if wanted else "--help tells what it takes"
