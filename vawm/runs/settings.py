"""Settings of JAX for the whole process under which nothing here can work.

Settings that change nothing (x64, promotion of dtypes and ranks, `jax_debug_nans`) are not
refused.
"""

from __future__ import annotations

from typing import Any

import jax

from vawm.errors import InvalidInput

GUARDS = (
    "jax_transfer_guard_host_to_device",
    "jax_transfer_guard_device_to_device",
    "jax_transfer_guard_device_to_host",
)
KEYS = {"key<fry>": "threefry2x32", "key<rbg>": "rbg", "key<urbg>": "unsafe_rbg"}
"""Dtype of a typed key -> its generator, as `jax_default_prng_impl` calls it."""


def check() -> None:
    """Refuses a platform without a device, and a guard against transfers to devices.

    Raises:
      InvalidInput: names the setting, its value and the remedy.
    """
    for name in GUARDS:
        value = _value(name)
        if value is not None and value.startswith("disallow"):
            remedy = "arrays move between host and device here; use 'log', or unset it"
            raise InvalidInput(name.upper(), value, remedy)
    try:
        jax.devices()
    except Exception as error:  # RuntimeError, or AssertionError without a plugin
        why = (str(error).strip() or type(error).__name__).splitlines()[0][:200]
        remedy = f"JAX finds no such device ({why}); unset it, or install the device's package"
        raise InvalidInput("JAX_PLATFORMS", _value("jax_platforms"), remedy) from error


def check_training() -> None:
    """As `check`; refuses also to train without compiling.

    Raises:
      InvalidInput: names the setting, its value and the remedy.
    """
    if _value("jax_disable_jit"):
        remedy = "a training step is compiled as a whole; unset it to train"
        raise InvalidInput("JAX_DISABLE_JIT", True, remedy)
    check()


def check_keys(saved: set[str]) -> None:
    """Refuses to continue with keys of another generator of random numbers.

    Args:
      saved: dtypes of the keys that were saved.

    Raises:
      InvalidInput: names the generator of this process and the one to set.
    """
    ours = str(jax.eval_shape(lambda: jax.random.key(0)).dtype)
    for theirs in sorted(saved - {ours}):
        remedy = (
            f"the checkpoint was written with {KEYS.get(theirs, theirs)}; set that to resume"
        )
        raise InvalidInput("JAX_DEFAULT_PRNG_IMPL", KEYS.get(ours, ours), remedy)


def _value(name: str) -> Any:
    return getattr(jax.config, name)
