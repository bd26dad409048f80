"""Names of files as text: for a message, and for a command to copy.

A name may hold any byte but `/` and 0. Line breaks would split a message. Bytes that are not
UTF-8, which Python keeps as lone surrogates, cannot be printed.
"""

from __future__ import annotations

import os
import shlex


def shown(path: str | os.PathLike[str]) -> str:
    r"""`path` on one line that any terminal prints: other characters as `\n` or `\xff`."""
    text = os.fspath(path)
    return text if text.isprintable() else _escaped(text)


def quoted(path: str | os.PathLike[str]) -> str:
    r"""`path` as one word for a shell; as `$'\xff'`, which bash and zsh know, if it must be."""
    text = os.fspath(path)
    if text.isprintable():
        return shlex.quote(text)
    return "$'" + _escaped(text.replace("\\", "\\\\").replace("'", "\\'")) + "'"


def flag(name: str, path: str | os.PathLike[str]) -> str:
    """`--name path` for a command line; `--name=path` if it would be taken for a flag."""
    between = "=" if os.fspath(path).startswith("-") else " "
    return f"--{name}{between}{quoted(path)}"


def is_utf8(path: str | os.PathLike[str]) -> bool:
    """Whether the bytes of `path` are text in UTF-8, as some libraries need."""
    try:
        os.fsencode(path).decode("utf-8")
    except UnicodeDecodeError:
        return False
    return True


def _escaped(text: str) -> str:
    return "".join(map(_character, text))


def _character(character: str) -> str:
    if character.isprintable():
        return character
    if character in "\n\t\r":
        return {"\n": r"\n", "\t": r"\t", "\r": r"\r"}[character]
    return "".join(f"\\x{byte:02x}" for byte in os.fsencode(character))
