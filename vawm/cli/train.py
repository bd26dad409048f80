"""`vawm train SUITE ...`: the program of every suite, by the suite's name."""

from __future__ import annotations

from collections.abc import Sequence

from vawm.cli import command_line
from vawm.errors import InvalidInput, suggestion
from vawm.runs import suites


def main(argv: Sequence[str]) -> int:
    """Trains one agent; returns the exit code.

    Raises:
      InvalidInput: the first word is no suite, or the rest is not what it takes.
    """
    suite = argv[0] if argv else None
    if suite in ("-h", "--help"):
        print(description())
        return 0
    if suite is None or suite not in suites.SUITES:
        names = suites.SUITES
        remedy = f"the first word is a suite: one of {', '.join(names)}"
        raise InvalidInput("suite", suite, suggestion(suite or "", names) + remedy)
    return command_line.train(argv[1:], suite=suite, command=f"vawm train {suite}")


def description() -> str:
    """The help: every suite, and how to go on."""
    width = max(map(len, suites.SUITES))
    lines = [f"    {name:{width}}  {suite.title}" for name, suite in suites.SUITES.items()]
    return "\n".join(
        [
            "usage: vawm train SUITE [flags]",
            "",
            "Trains an agent on a suite:",
            "",
            *lines,
            "",
            "`vawm train SUITE --help` lists the flags of a suite.",
        ]
    )
