"""Expects `InvalidInput` by its field, its value and names in its remedy."""

import contextlib
from unittest import mock

import pytest

from vawm.errors import InvalidInput


@contextlib.contextmanager
def refused(field, value=mock.ANY, *, naming=()):
    """Expects `InvalidInput` inside the `with` block.

    Args:
      field: that the error must name.
      value: that the error must carry; any if not given.
      naming: one string or several that the remedy must contain: names, numbers, commands.
    """
    with pytest.raises(InvalidInput) as refusal:
        yield refusal
    error = refusal.value
    assert error.field == field
    assert error.value is value or error.value == value
    for name in [naming] if isinstance(naming, str) else naming:
        assert name in error.remedy
    assert "\n" not in str(error)
