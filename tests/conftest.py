"""Strict settings of JAX and the compilation cache for every test."""

import ctypes
import gc
import os
import sys

import chex
import hurry
import hypothesis
import jax
import pytest

from vawm.envs.host import rendering
from vawm.process import cache

os.environ.setdefault("MUJOCO_GL", "disable")  # dm_control is asked for physics only
hurry.hurry()
cache.enable()
jax.config.update("jax_numpy_rank_promotion", "raise")
jax.config.update("jax_debug_key_reuse", True)
# The same examples in every run, and no deadline: the first example of a test compiles.
hypothesis.settings.register_profile("vawm", derandomize=True, deadline=None, max_examples=50)
hypothesis.settings.load_profile("vawm")


def pytest_configure(config):
    """With `VAWM_TESTS_RENDER` set, fails if a backend cannot render instead of skipping."""
    if os.environ.get("VAWM_TESTS_RENDER") and not hasattr(config, "workerinput"):
        for backend in rendering.BACKENDS:
            if fault := rendering.fault(backend):
                raise pytest.UsageError(f"{backend} does not render here: {fault}")


@pytest.fixture(autouse=True, scope="module")
def memory_of_one_file():
    """Releases what a file has compiled; a worker would keep the programs of all its files.

    What the next file shares with it is read from the compilation cache.
    """
    yield
    jax.clear_caches()
    gc.collect()
    if sys.platform.startswith("linux"):  # glibc keeps freed memory otherwise
        ctypes.CDLL(None).malloc_trim(0)


@pytest.fixture(autouse=True)
def fresh_trace_counter():
    """Resets chex's counts of traces: closures from one factory share a name, and a count."""
    chex.clear_trace_counter()
