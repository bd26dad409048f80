"""Gymnasium ids `vawm/<task>-v0`: strings only, what they name is imported by `make`.

Gymnasium 1.0 and later look for no plugins: an id is known once the module that registers it
has been imported. `vawm.envs` does so; `vawm.envs:vawm/<task>-v0` has Gymnasium import it.
"""

from __future__ import annotations

from collections.abc import Iterable

import gymnasium

GRID_WORLD = "vawm/GridWorld-v0"


def register(tasks: Iterable[str]) -> None:
    """Registers the tasks, single and vectorised, and the grid world; once is enough.

    Episodes end in the environment itself, so there is no `max_episode_steps` and no
    TimeLimit wrapper. `action_repeat` is a keyword of `gymnasium.make` and `make_vec`.
    """
    for task in tasks:
        if env_id(task) not in gymnasium.registry:
            gymnasium.register(
                env_id(task),
                entry_point="vawm.envs.gym:SingleEnv",
                vector_entry_point="vawm.envs.gym:BatchedEnv",
                kwargs={"task": task},
            )
    if GRID_WORLD not in gymnasium.registry:
        gymnasium.register(
            GRID_WORLD, entry_point="vawm.envs.grid_world:GridWorld", max_episode_steps=50
        )


def env_id(task: str) -> str:
    """The Gymnasium id of a task."""
    return f"vawm/{task}-v0"
