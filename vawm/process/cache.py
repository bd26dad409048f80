"""JAX's persistent compilation cache, on by default, so the second start compiles nothing.

The folder is `$JAX_COMPILATION_CACHE_DIR`, else `$XDG_CACHE_HOME/vawm/jax`, else
`~/.cache/vawm/jax`; `VAWM_NO_CACHE=1` switches the cache off.
"""

from __future__ import annotations

import os
import pathlib
import sys

import jax

from vawm.process import names

MIN_COMPILE_SECONDS = 0.5


def folder() -> pathlib.Path:
    """The folder of compiled functions."""
    explicit = os.environ.get("JAX_COMPILATION_CACHE_DIR")
    if explicit:
        return pathlib.Path(explicit).expanduser()
    base = os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    return pathlib.Path(base).expanduser() / "vawm" / "jax"


def enable() -> pathlib.Path | None:
    """Turns the cache on. Warns and leaves it off if its folder cannot be used.

    Returns:
      The folder in use, or None if the cache is off.
    """
    if os.environ.get("VAWM_NO_CACHE", "") not in ("", "0"):
        jax.config.update("jax_enable_compilation_cache", False)
        return None
    try:
        path = folder()
        path.mkdir(parents=True, exist_ok=True)
        if not os.access(path, os.W_OK | os.X_OK):
            raise PermissionError(f"{names.shown(path)} is not writable")
        if not names.is_utf8(path):  # JAX would fail at the first compilation
            raise OSError(f"{names.shown(path)} is not UTF-8")
    except (OSError, RuntimeError) as error:  # RuntimeError: no home to expand "~" to
        remedy = "set JAX_COMPILATION_CACHE_DIR to a writable folder"
        print(f"warning: no compilation cache ({error}); {remedy}", file=sys.stderr)
        jax.config.update("jax_compilation_cache_dir", None)  # JAX reads the variable itself
        return None
    jax.config.update("jax_compilation_cache_dir", str(path))
    jax.config.update("jax_persistent_cache_min_compile_time_secs", MIN_COMPILE_SECONDS)
    return path
