"""The command `vawm`, and `python -m vawm`: one door to all programs.

A program is imported when it is asked for, so that the help comes at once.
"""

from __future__ import annotations

import importlib
import sys
from collections.abc import Sequence
from typing import NamedTuple

import vawm
from vawm.errors import InvalidInput, suggestion


class Program(NamedTuple):
    """A program: the module whose `main(argv)` returns the exit code, and what it does."""

    module: str
    does: str


PROGRAMS = {
    "train": Program("vawm.cli.train", "train an agent on a suite of tasks"),
    "evaluate": Program("vawm.evaluate", "play whole episodes with a trained agent"),
    "export": Program("vawm.export", "write a trained agent to a folder of its own"),
    "analyse": Program("vawm.analysis.program", "what a trained agent imagines and values"),
    "sweep": Program("vawm.sweep.learning_curves", "runs of tasks x seeds, and their curves"),
}

EXAMPLES = (
    "vawm train dmc_proprio --task walker_walk",
    "vawm evaluate --logdir LOGDIR",
    "vawm sweep --tasks all --jobs 2",
)


def main(argv: Sequence[str] | None = None) -> int:
    """Runs the program that the first word names; returns the exit code.

    Without a word, prints the help and returns 0.
    """
    words = sys.argv[1:] if argv is None else list(argv)
    if not words or words[0] in ("-h", "--help"):
        print(usage())
        return 0
    if words[0] == "--version":
        print(f"vawm {vawm.__version__}")
        return 0
    if words[0] not in PROGRAMS:
        print(f"error: {unknown(words[0])}", file=sys.stderr)
        return 2
    return start(words[0], words[1:])


def start(name: str, argv: Sequence[str]) -> int:
    """Runs a program; what can go wrong becomes one line, as for every program."""
    from vawm.process import huge_pages

    huge_pages.use_huge_pages()
    from vawm.cli import command_line

    sys.argv[0] = f"vawm {name}"  # the program's name in its help
    module = PROGRAMS[name].module
    return command_line.guard(lambda: importlib.import_module(module).main(argv))


def usage() -> str:
    """The help: every program, with examples."""
    width = max(map(len, PROGRAMS))
    rows = [f"    {name:{width}}  {program.does}" for name, program in PROGRAMS.items()]
    return "\n".join(
        [
            "usage: vawm PROGRAM [flags]",
            "",
            "Value-aligned world models in JAX.",
            "",
            *rows,
            "",
            *(f"    {example}" for example in EXAMPLES),
            "",
            "`vawm PROGRAM --help` tells more; `vawm --version` prints the version.",
        ]
    )


def unknown(word: str) -> InvalidInput:
    """The error for a word that names no program."""
    remedy = f"use one of {', '.join(PROGRAMS)} (vawm --help tells more)"
    return InvalidInput("program", word, suggestion(word, PROGRAMS) + remedy)


if __name__ == "__main__":
    sys.exit(main())
