"""Value-aligned world models in JAX.

    vawm.losses         the losses as a functional library, and what they are made of
    vawm.types, vawm.config   the data, and the choices; vawm.presets: the paper's, small ones
    vawm.world_model, vawm.agent            world models; what imagines and acts in them
    vawm.envs           the DeepMind Control Suite on MJX and rendered, Gymnasium, Atari
    vawm.learning       the objective, one update, replay, the jitted training step
    vawm.runs           the loop of a run on disk, checkpoints, reports
    vawm.policy         trained policies, and published scores
    vawm.analysis       what value alignment does, in numbers and pictures
    vawm.sweep          many runs of one program, tables and curves of them
    vawm.load           a policy from a run's checkpoint, or as vawm.export wrote it

Importing the package imports none of them. `vawm.losses` imports neither networks nor
environments; `vawm.envs` registers its tasks with Gymnasium.
"""

from __future__ import annotations

import importlib
from typing import Any

__version__ = "0.1.0"
__all__ = ["__version__", "load"]


def __getattr__(name: str) -> Any:
    """`vawm.load`, `vawm.presets` and submodules, imported when they are first asked for."""
    if name == "load":
        from vawm.policy import load

        return load
    if name == "presets":
        return importlib.import_module("vawm.config.presets")
    if not name.startswith("_"):
        try:
            return importlib.import_module(f"vawm.{name}")
        except ModuleNotFoundError as error:
            if error.name != f"vawm.{name}":
                raise
    raise AttributeError(f"module 'vawm' has no attribute {name!r}")
