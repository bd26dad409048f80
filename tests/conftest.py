"""Strictness and the compilation cache for every test."""

import os

import chex
import jax
import pytest

from vawm import cache

os.environ.setdefault("MUJOCO_GL", "disable")  # dm_control is asked for physics only
cache.enable()
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_debug_key_reuse", True)


@pytest.fixture(autouse=True)
def fresh_trace_counter():
    """chex counts traces by function name; a factory's closures share theirs."""
    chex.clear_trace_counter()
