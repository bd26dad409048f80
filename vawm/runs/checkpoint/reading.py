"""Reads the newest undamaged checkpoint."""

from __future__ import annotations

import logging
import os
import pathlib
from collections.abc import Collection
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from vawm.errors import InvalidInput
from vawm.process import names
from vawm.runs.checkpoint import arrays, folders, leaves, manifest, store
from vawm.runs.checkpoint.integrity import verify
from vawm.runs.checkpoint.leaves import Leaves
from vawm.runs.checkpoint.manifest import EPISODES, Damaged, LeafInfo, Manifest, leaf_info
from vawm.types import PyTree

ACTING = ("params", "model_state")
"""Items that are needed to act."""


class Found(NamedTuple):
    """The newest undamaged checkpoint of a run.

    Attributes:
      path: its folder.
      manifest: its manifest.
      damaged: newer checkpoints, and the damage of each.
    """

    path: pathlib.Path
    manifest: Manifest
    damaged: tuple[tuple[pathlib.Path, Damaged], ...] = ()

    @property
    def unmerged(self) -> tuple[str, ...]:
        """Items whose files an earlier version did not merge; they are read all the same."""
        return tuple(i for i in self.manifest.leaves if store.unmerged(self.path / i))


def find(logdir: str | os.PathLike[str], items: Collection[str] | None = None) -> Found:
    """The newest checkpoint whose files match their checksums; changes nothing.

    Args:
      logdir: the folder of the run.
      items: items to check; all by default, none to check only the manifest.

    Raises:
      InvalidInput: there is none, another version wrote it, or all are damaged (names the
        first damaged file).
    """
    damaged: list[tuple[pathlib.Path, Damaged]] = []
    for path in folders.complete(logdir):
        try:
            content = manifest.read(path)
            if content.env_steps != int(path.name):
                raise Damaged(path, f"holds the manifest of {content.env_steps} env steps")
            verify(path, content, content.leaves if items is None else items)
        except Damaged as error:
            if path not in folders.complete(logdir):  # a running run has deleted it
                return find(logdir, items)
            damaged.append((path, error))
        else:
            return Found(path, content, tuple(damaged))
    if damaged:
        first = damaged[0][1]
        raise Damaged(first.path, f"{first.how}, and all older checkpoints are damaged too")
    state = "holds no checkpoint" if os.path.exists(logdir) else "does not exist"
    remedy = f"{state}; use the folder of a run that has saved one"
    raise InvalidInput("logdir", str(logdir), remedy)


def warning(found: Found) -> str | None:
    """One line about damaged checkpoints and the one used instead, and about an incomplete one.

    None if the newest checkpoint is used and complete.
    """
    lines = []
    if found.damaged:
        _, error = found.damaged[0]
        more = f" (and {len(found.damaged) - 1} more)" if len(found.damaged) > 1 else ""
        lines.append(
            f"damaged checkpoint{more}: {names.shown(error.path)} {error.how}; using "
            f"the one at {found.manifest.env_steps} env steps instead"
        )
    if found.unmerged:
        items = ", ".join(found.unmerged)
        lines.append(
            f"incomplete checkpoint: {names.shown(found.path)}, whose files in "
            f"{items} an earlier version did not merge; nothing is lost, all is read"
        )
    return "; ".join(lines) or None


def usable(logdir: str | os.PathLike[str], items: Collection[str] | None = None) -> Found:
    """`find`; also logs its `warning` to `vawm`."""
    found = find(logdir, items)
    if line := warning(found):
        logging.getLogger("vawm").warning(line)
    return found


def read_manifest(logdir: str | os.PathLike[str]) -> tuple[pathlib.Path, Manifest]:
    """The folder and the manifest of the newest checkpoint whose manifest is undamaged.

    Raises:
      InvalidInput: there is none, or all are damaged.
    """
    found = usable(logdir, ())
    return found.path, found.manifest


def restore(logdir: str | os.PathLike[str], target: PyTree) -> tuple[PyTree, Manifest]:
    """Reads the newest undamaged checkpoint into a tree like `target`.

    `target` may hold arrays or `ShapeDtypeStruct`s.

    Raises:
      InvalidInput: all are damaged, or a leaf differs from the target in path, shape or
        dtype.
    """
    found = usable(logdir)
    return read_state(found, target), found.manifest


def restore_episodes(logdir: str | os.PathLike[str]) -> dict[str, np.ndarray] | None:
    """The arrays that were saved as `episodes`; None if there are none.

    Raises:
      InvalidInput: all checkpoints are damaged.
    """
    return read_episodes(usable(logdir))


def restore_agent(
    logdir: str | os.PathLike[str], params: PyTree, model_state: PyTree
) -> tuple[tuple[PyTree, PyTree], Manifest]:
    """Reads only what is needed to act, into trees like the two given."""
    found = usable(logdir, ACTING)
    return read_agent(found, params, model_state), found.manifest


def read_state(found: Found, target: PyTree) -> PyTree:
    """Reads the state of a verified checkpoint.

    Raises:
      InvalidInput: a leaf differs from the target in path, shape or dtype.
    """
    result: Leaves = {}
    for item, wanted in leaves.items(leaves.flatten(target)).items():
        values = _read(found, item, wanted)
        result |= {leaves.PREFIXES[item] + name: value for name, value in values.items()}
    return leaves.unflatten(target, result)


def read_episodes(found: Found) -> dict[str, np.ndarray] | None:
    """Reads the episodes of a verified checkpoint; None if it has none."""
    infos = found.manifest.leaves.get(EPISODES)
    if infos is None:
        return None
    wanted = {
        name: jax.ShapeDtypeStruct(info.shape, jnp.dtype(info.dtype))
        for name, info in infos.items()
    }
    return _read(found, EPISODES, wanted)


def read_agent(found: Found, params: PyTree, model_state: PyTree) -> tuple[PyTree, PyTree]:
    """Reads what is needed to act from a checkpoint with these items verified."""
    targets = dict(zip(ACTING, (params, model_state), strict=True))
    first, second = (
        leaves.unflatten(target, _read(found, item, leaves.flatten(target)))
        if jax.tree.leaves(target)
        else target
        for item, target in targets.items()
    )
    return first, second


def _read(found: Found, item: str, expected: Leaves) -> Leaves:
    infos = {name: leaf_info(leaf) for name, leaf in expected.items()}
    saved = found.manifest.leaves.get(item, {})
    leaves.compare(found.path / item, saved, infos)
    stored = {name: _stored(leaf) for name, leaf in expected.items() if infos[name].nbytes}
    values = arrays.read(found.path / item, stored)
    as_leaf = _as_array if item in leaves.ON_HOST else _as_leaf
    return {name: as_leaf(values.get(name), expected[name]) for name in infos}


def _stored(leaf: Any) -> LeafInfo:
    """Shape and dtype in which a leaf is stored: its own, or those of a typed key's data."""
    if leaf_info(leaf).impl:
        return leaf_info(jax.eval_shape(jax.random.key_data, leaf))
    return leaf_info(leaf)


def _as_array(array: np.ndarray | None, like: Any) -> np.ndarray:
    return np.zeros(like.shape, like.dtype) if array is None else array


def _as_leaf(array: np.ndarray | None, like: Any) -> jax.Array:
    if array is None:
        return jnp.zeros(like.shape, like.dtype)
    if leaf_info(like).impl:
        key = jax.random.wrap_key_data(jnp.array(array))
        if key.dtype != like.dtype:
            raise ValueError(f"{like.dtype} is not the default type of key")
        return key
    return jnp.array(array)  # a copy, because numpy's memory cannot be donated
