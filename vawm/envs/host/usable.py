"""What an agent can use of what an environment returns: numbers, flags and finite arrays.

The pool checks every step with these functions, and the look before a run uses the same ones.
"""

from __future__ import annotations

import traceback
from typing import Any

import numpy as np

from vawm.types import ArraySpec

LARGEST = float(np.finfo(np.float32).max)
LONGEST = 300  # characters of an exception's message


class Unusable(ValueError):
    """A value that no agent can use.

    Attributes:
      name: of the value, such as "reward" or "obs['camera']".
      what: is wrong with it, such as "is None, not a number".
      remedy: what to do in the environment; may be "".
    """

    def __init__(self, name: str, what: str, remedy: str = ""):
        super().__init__(f"{name} {what}")
        self.name = name
        self.what = what
        self.remedy = remedy


def check_number(name: str, value: Any) -> float:
    """The number in a value: anything without axes that `float` takes, of any library.

    Raises:
      Unusable: it is no number, or not finite in float32.
    """
    value = without_axes(name, value)
    if isinstance(value, (str, bytes)) or not hasattr(type(value), "__float__"):
        raise Unusable(name, f"is {value!r:.50}, not a number", "return a number")
    try:
        number = float(value)
    except OverflowError:
        number = float("inf")
    if not np.isfinite(number):
        raise Unusable(name, f"is {value!s:.50}, not finite", "return a finite number")
    if abs(number) > LARGEST:
        raise Unusable(name, f"is {number:g}, beyond float32", "scale it down")
    return number


def check_flag(name: str, value: Any) -> bool:
    """The truth in a bool or an array of one without axes, of any library.

    Raises:
      Unusable: it is something else.
    """
    flag = without_axes(name, value)
    if not isinstance(flag, bool):
        what = f"is {flag!r:.50}, not True or False"
        raise Unusable(name, what, "return True or False")
    return flag


def without_axes(name: str, value: Any) -> Any:
    """`value`; what is inside if it is an array without axes.

    Raises:
      Unusable: it is an array with axes.
    """
    shape = getattr(value, "shape", None)
    if shape is None or not hasattr(value, "item"):
        return value
    if tuple(shape):
        remedy = "return one value without axes"
        raise Unusable(name, f"has shape {tuple(shape)}", remedy)
    return value.item()


def check_array(name: str, value: Any, spec: ArraySpec) -> None:
    """Checks that an array follows its spec and is finite.

    Raises:
      Unusable: names the wrong type, dtype, shape or value.
    """
    if not isinstance(value, np.ndarray):
        raise Unusable(name, f"is a {type(value).__name__}, not a numpy array")
    if value.dtype != spec.dtype or value.shape != spec.shape:
        needed = f"{spec.dtype}{list(spec.shape)}"
        raise Unusable(name, f"is {value.dtype}{list(value.shape)}, not {needed}")
    if value.dtype.kind == "f" and not (finite := np.isfinite(value)).all():
        where, number = first(~finite, value)
        raise Unusable(f"{name}{where}", f"is {number}, not finite", "return finite numbers")


def first(mask: np.ndarray, value: np.ndarray) -> tuple[str, Any]:
    """The first entry that is True in a mask: its index in brackets, and its value."""
    where = np.argwhere(mask)[0].tolist()
    return f"{where or ''}", value[tuple(where)]


def one_line(error: BaseException) -> str:
    """Name and message of an exception, in one line."""
    message = " ".join("".join(traceback.format_exception_only(error)).split())
    return message if len(message) <= LONGEST else f"{message[:LONGEST]}..."
