"""Gymnasium ids `vawm/<task>-v0`, as strings: `gymnasium.make` imports what they name.

Gymnasium 1.0 and later do not search for plugins: an id is known after the module that
registers it was imported. `vawm.envs` registers these; with `vawm.envs:vawm/<task>-v0`
Gymnasium imports it.
"""

from __future__ import annotations

from collections.abc import Iterable

import gymnasium

GRID_WORLD = "vawm/GridWorld-v0"


def register(tasks: Iterable[str]) -> None:
    """Registers the tasks, single and vectorised, and the grid world; a second call is fine.

    The tasks end their episodes themselves, so they have no `max_episode_steps` and no
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
