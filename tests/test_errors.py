"""The suggestion in the message for wrong input."""

import pytest

from vawm.errors import InvalidInput, suggestion


def test_an_invalid_input_carries_its_field_and_value():
    error = InvalidInput("size", 12, "use a name")
    assert (error.field, error.value, error.remedy) == ("size", 12, "use a name")
    assert str(error) == "size=12: use a name"


@pytest.mark.parametrize(
    ("value", "suggested"),
    [("walker_wlak", "'walker_walk'"), ("cartpole", "'CartPole'"), ("", ""), (None, "")],
)
def test_a_close_name_is_suggested_whatever_its_case(value, suggested):
    text = suggestion(value, iter(["walker_walk", "CartPole"]))
    assert text == (f"did you mean {suggested}? " if suggested else "")
