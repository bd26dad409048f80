"""Value-aligned world models in JAX.

    vawm.losses         the losses as a functional library
    vawm.returns, vawm.transforms, vawm.distributions   what they are made of
    vawm.envs           18 tasks of the DeepMind Control Suite on MJX, and probes
    vawm.envs.host      Atari, DMC vision and Gymnasium, stepped in processes of their own
    vawm.world_model, vawm.actor_critic, vawm.agent     the agent as pure functions
    vawm.objective, vawm.learner, vawm.learn            its loss, one update, those due
    vawm.train, vawm.host_train         the step around MJX, and around host environments
    vawm.runner, vawm.checkpoint        runs on disk
    vawm.evaluate, vawm.scores          protocols of the suites, and published scores
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
