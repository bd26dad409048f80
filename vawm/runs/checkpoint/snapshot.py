"""A copy of the state for a checkpoint, so that training can continue while it is written."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import numpy as np

from vawm.config import Config
from vawm.runs.checkpoint.leaves import flatten, items
from vawm.runs.checkpoint.manifest import EPISODES, LeafInfo, leaf_info
from vawm.types import EnvSpec, PyTree


class Snapshot(NamedTuple):
    """A copy of a run's state in host memory.

    Attributes:
      env_steps: at which it was taken.
      config: of the run.
      spec: of the environment.
      progress: the counters of the host loop.
      leaves: item -> path in the tree -> `LeafInfo`.
      arrays: item -> path in the tree -> the array to store; empty leaves are left out.
    """

    env_steps: int
    config: Config
    spec: EnvSpec
    progress: dict[str, Any]
    leaves: dict[str, dict[str, LeafInfo]]
    arrays: dict[str, dict[str, np.ndarray]]

    @property
    def nbytes(self) -> int:
        return sum(info.nbytes for item in self.leaves.values() for info in item.values())


def take(
    state: PyTree,
    *,
    env_steps: int,
    config: Config,
    spec: EnvSpec,
    progress: Mapping[str, Any],
    episodes: Mapping[str, np.ndarray] | None = None,
) -> Snapshot:
    """Copies a `TrainState`, whose memory the next step reuses, and `episodes`."""
    by_item = items(flatten(state))
    if episodes is not None:
        by_item[EPISODES] = dict(episodes)
    return Snapshot(
        env_steps=env_steps,
        config=config,
        spec=spec,
        progress=dict(progress),
        leaves={
            item: {path: leaf_info(leaf) for path, leaf in leaves.items()}
            for item, leaves in by_item.items()
        },
        arrays={item: _copy(leaves) for item, leaves in by_item.items()},
    )


def _copy(leaves: Mapping[str, Any]) -> dict[str, np.ndarray]:
    stored = {
        path: jax.random.key_data(leaf) if leaf_info(leaf).impl else leaf
        for path, leaf in leaves.items()
        if leaf.size
    }
    fetched = jax.device_get(stored)  # from all devices at once
    return {
        path: np.array(array) if _shares_memory(stored[path]) else array
        for path, array in fetched.items()
    }


def _shares_memory(leaf: Any) -> bool:
    """Whether `device_get` returns the memory of `leaf` itself."""
    if not isinstance(leaf, jax.Array):
        return True
    return any(device.platform == "cpu" for device in leaf.devices())
