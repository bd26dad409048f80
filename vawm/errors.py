"""The one error that a user's input can cause."""

from __future__ import annotations

from typing import Any


class InvalidInput(ValueError):
    """One line that names the field, its value and the remedy.

    Raised before anything is compiled, allocated or written; command lines print the
    message and leave with exit code 2.
    """

    def __init__(self, field: str, value: Any, remedy: str):
        super().__init__(f"{field}={value!r}: {remedy}")
        self.field = field
        self.value = value
        self.remedy = remedy
