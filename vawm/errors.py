"""The error for wrong input, the suggestion in its message, and rules for numbers."""

from __future__ import annotations

import difflib
from collections.abc import Callable, Iterable
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


Rule = tuple[Callable[[Any], bool], str]
"""Whether a value is accepted, and what to use instead."""

POSITIVE: Rule = (lambda x: x > 0, "use a number above 0")
NOT_NEGATIVE: Rule = (lambda x: x >= 0, "use 0 or a number above")
SHARE: Rule = (lambda x: 0 <= x <= 1, "use a number from 0 to 1")
BELOW_ONE: Rule = (lambda x: 0 <= x < 1, "use a number from 0 up to, not including, 1")
RATE: Rule = (lambda x: 0 < x <= 1, "use a number above 0 and up to 1")
ABOVE_ONE: Rule = (lambda x: x > 1, "use a number above 1")
BINS: Rule = (lambda x: x >= 3 and x % 2 == 1, "use an odd number of at least 3")
SEQUENCE: Rule = (lambda x: x >= 2, "use a number of at least 2")
CLASSES: Rule = (lambda x: 2 <= x <= 256, "use a number from 2 to 256")
# Each layer, and each block of a transformer, is built and compiled on its own: a million would
# take the machine's memory.
LAYERS: Rule = (lambda x: 1 <= x <= 100, "use a number from 1 to 100")
