"""Value-aligned world models in JAX.

    vawm.losses         the losses as a functional library
    vawm.returns, vawm.transforms, vawm.distributions   what they are made of
    vawm.envs           18 tasks of the DeepMind Control Suite on MJX, and probes
    vawm.world_model, vawm.actor_critic, vawm.agent     the agent as pure functions
    vawm.objective, vawm.train                          its loss, its update, one jitted step
    vawm.runner, vawm.checkpoint, vawm.evaluate         runs on disk
    vawm.load           a policy from a run's checkpoint

Importing the package registers its tasks with Gymnasium as "vawm/<task>-v0".
"""

from __future__ import annotations

import importlib
from typing import Any

from vawm.envs.registration import register

__version__ = "0.1.0"
__all__ = ["__version__", "load"]

register()


def __getattr__(name: str) -> Any:
    """`vawm.load` and submodules, imported when they are first asked for."""
    if name == "load":
        from vawm.policy import load

        return load
    if not name.startswith("_"):
        try:
            return importlib.import_module(f"vawm.{name}")
        except ModuleNotFoundError as error:
            if error.name != f"vawm.{name}":
                raise
    raise AttributeError(f"module 'vawm' has no attribute {name!r}")
