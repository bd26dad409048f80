"""Strictness and the compilation cache for every test."""

import os
import pathlib

CACHE = pathlib.Path(os.environ.get("XDG_CACHE_HOME", "~/.cache")).expanduser() / "vawm" / "jax"

os.environ.setdefault("MUJOCO_GL", "disable")
os.environ.setdefault("JAX_COMPILATION_CACHE_DIR", str(CACHE))
os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "0.5")

import chex
import jax
import pytest

jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_debug_key_reuse", True)


@pytest.fixture(autouse=True)
def fresh_trace_counter():
    """chex counts traces by function name; a factory's closures share theirs."""
    chex.clear_trace_counter()
