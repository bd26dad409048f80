"""The error for wrong input, and the suggestion in its message."""

from __future__ import annotations

import difflib
from collections.abc import Iterable
from typing import Any


class InvalidInput(ValueError):
    """One line that names the field, its value and the remedy.

    Raised before anything is compiled, allocated or written. Command lines print the
    message and exit with code 2.
    """

    def __init__(self, field: str, value: Any, remedy: str):
        super().__init__(f"{field}={value!r}: {remedy}")
        self.field = field
        self.value = value
        self.remedy = remedy


def suggestion(value: object, choices: Iterable[str]) -> str:
    """The start of a remedy: "did you mean 'walker_walk'? ", or "" without a close match.

    Upper and lower case match each other.
    """
    by_lower = {choice.lower(): choice for choice in choices}
    close = difflib.get_close_matches(str(value).lower(), by_lower, n=1)
    return f"did you mean {by_lower[close[0]]!r}? " if close else ""
