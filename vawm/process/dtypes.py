"""JAX's usual rules for dtypes, for libraries that need them, whatever this process has set.

Our own code names the dtype of every array, so neither `jax_enable_x64` nor
`jax_numpy_dtype_promotion` changes what it computes. Some libraries leave dtypes to the rules.
Under x64 they would compute in float64 and draw other random numbers, and under strict
promotion they do not run.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator

import jax


@contextlib.contextmanager
def usual() -> Iterator[None]:
    """Inside the `with` block, or in a function that this decorates: JAX's defaults."""
    with jax.enable_x64(False), jax.numpy_dtype_promotion("standard"):
        yield
