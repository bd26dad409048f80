"""The error for wrong input, the suggestion in its message, and rules for numbers."""

from __future__ import annotations

import difflib
from collections.abc import Callable, Iterable, Mapping
from typing import Any


class InvalidInput(ValueError):
    """One line that names the field, its value and the remedy.

    Raised before anything is compiled, allocated or written. Command lines print the
    message and exit with code 2.

    Attributes:
      settings: choices of the caller's that the remedy names, as `assignment` writes them.
        Whoever passes them on under another name renames them with `reworded`.
    """

    def __init__(
        self, field: str, value: Any, remedy: str, settings: Mapping[str, Any] | None = None
    ):
        super().__init__(f"{field}={value!r}: {remedy}")
        self.field = field
        self.value = value
        self.remedy = remedy
        self.settings = dict(settings or {})


def assignment(name: str, value: Any) -> str:
    """A choice as Python writes it: `time_limit=1000`."""
    return f"{name}={value!r}"


def reworded(text: str, settings: Mapping[str, Any], how: Callable[[str, Any], str]) -> str:
    """`text` in which `how(name, value)` stands in the place of each assignment."""
    for name, value in settings.items():
        text = text.replace(assignment(name, value), how(name, value))
    return text


def within(part: str, error: InvalidInput) -> InvalidInput:
    """The same error for somebody who makes the settings in a part of a config.

    `time_limit=1000` becomes `env.time_limit=1000`, if the part is `env`.
    """
    names = {name: f"{part}.{name}" for name in error.settings}
    remedy = reworded(
        error.remedy, error.settings, lambda name, value: assignment(names[name], value)
    )
    settings = {names[name]: value for name, value in error.settings.items()}
    return InvalidInput(error.field, error.value, remedy, settings)


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
