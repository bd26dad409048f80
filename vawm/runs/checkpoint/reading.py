"""Reading the newest checkpoint that is whole."""

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
from vawm.runs.checkpoint import arrays, folders
from vawm.runs.checkpoint import leaves as leaves_lib
from vawm.runs.checkpoint import manifest as manifest_lib
from vawm.runs.checkpoint.integrity import verify
from vawm.runs.checkpoint.leaves import Leaves
from vawm.runs.checkpoint.manifest import EPISODES, Damaged, LeafInfo, Manifest, leaf_info
from vawm.types import PyTree

ACTING = ("params", "model_state")
"""Items that acting needs."""


class Found(NamedTuple):
    """The newest whole checkpoint of a run.

    Attributes:
      path: where it is.
      manifest: what it says of itself.
      damaged: newer ones, and what is wrong with each.
    """

    path: pathlib.Path
    manifest: Manifest
    damaged: tuple[tuple[pathlib.Path, Damaged], ...] = ()


def find(logdir: str | os.PathLike[str], items: Collection[str] | None = None) -> Found:
    """The newest checkpoint whose files have their checksums; changes nothing.

    Args:
      logdir: the folder of the run.
      items: those to look at; all by default, none for the manifest alone.

    Raises:
      InvalidInput: there is none, another version wrote it, or all are damaged, of which
        the first damaged file is named.
    """
    damaged: list[tuple[pathlib.Path, Damaged]] = []
    for path in folders.complete(logdir):
        try:
            manifest = manifest_lib.read(path)
            if manifest.env_steps != int(path.name):
                raise Damaged(path, f"holds the manifest of {manifest.env_steps} env steps")
            verify(path, manifest, manifest.leaves if items is None else items)
        except Damaged as error:
            if path not in folders.complete(logdir):  # its run goes on, and deletes old ones
                return find(logdir, items)
            damaged.append((path, error))
        else:
            return Found(path, manifest, tuple(damaged))
    if damaged:
        first = damaged[0][1]
        raise Damaged(first.path, f"{first.how}; and no older checkpoint is whole")
    state = "holds no checkpoint" if os.path.exists(logdir) else "is not there"
    remedy = f"{state}; name the folder of a run that saved one"
    raise InvalidInput("logdir", str(logdir), remedy)


def warning(found: Found) -> str | None:
    """One line about the damage that was met, and what takes its place; None without."""
    if not found.damaged:
        return None
    _, error = found.damaged[0]
    more = f" (and {len(found.damaged) - 1} more)" if len(found.damaged) > 1 else ""
    return (
        f"damaged checkpoint{more}: {error.path} {error.how}; "
        f"using the one at {found.manifest.env_steps} env steps instead"
    )


def usable(logdir: str | os.PathLike[str], items: Collection[str] | None = None) -> Found:
    """`find`, with a line in the log of `vawm` where a newer checkpoint is damaged."""
    found = find(logdir, items)
    if line := warning(found):
        logging.getLogger("vawm").warning(line)
    return found


def read_manifest(logdir: str | os.PathLike[str]) -> tuple[pathlib.Path, Manifest]:
    """The newest checkpoint whose manifest is whole, and what it says of itself.

    Raises:
      InvalidInput: there is none, or all are damaged.
    """
    path, manifest, _ = usable(logdir, ())
    return path, manifest


def restore(logdir: str | os.PathLike[str], target: PyTree) -> tuple[PyTree, Manifest]:
    """The newest whole checkpoint, in the tree of `target` (arrays or `ShapeDtypeStruct`s).

    Raises:
      InvalidInput: all are damaged, or a leaf differs from the target in path, shape or
        dtype.
    """
    found = usable(logdir)
    return read_state(found, target), found.manifest


def restore_episodes(logdir: str | os.PathLike[str]) -> dict[str, np.ndarray] | None:
    """The arrays that were saved as `episodes`; None where there are none.

    Raises:
      InvalidInput: all checkpoints are damaged.
    """
    return read_episodes(usable(logdir))


def restore_agent(
    logdir: str | os.PathLike[str], params: PyTree, model_state: PyTree
) -> tuple[tuple[PyTree, PyTree], Manifest]:
    """What acting needs, like the two trees given; nothing else of the checkpoint is read."""
    found = usable(logdir, ACTING)
    return read_agent(found, params, model_state), found.manifest


def read_state(found: Found, target: PyTree) -> PyTree:
    """The state of a checkpoint whose files have been verified.

    Raises:
      InvalidInput: a leaf differs from the target in path, shape or dtype.
    """
    result: Leaves = {}
    for item, wanted in leaves_lib.items(leaves_lib.flatten(target)).items():
        values = _read(found, item, wanted)
        result |= {leaves_lib.PREFIXES[item] + name: value for name, value in values.items()}
    return leaves_lib.unflatten(target, result)


def read_episodes(found: Found) -> dict[str, np.ndarray] | None:
    """The episodes of a checkpoint whose files have been verified; None without any."""
    infos = found.manifest.leaves.get(EPISODES)
    if infos is None:
        return None
    wanted = {
        name: jax.ShapeDtypeStruct(info.shape, jnp.dtype(info.dtype))
        for name, info in infos.items()
    }
    return _read(found, EPISODES, wanted)


def read_agent(found: Found, params: PyTree, model_state: PyTree) -> tuple[PyTree, PyTree]:
    """What acting needs, of a checkpoint in which that has been verified."""
    targets = dict(zip(ACTING, (params, model_state), strict=True))
    first, second = (
        leaves_lib.unflatten(target, _read(found, item, leaves_lib.flatten(target)))
        if jax.tree.leaves(target)
        else target
        for item, target in targets.items()
    )
    return first, second


def _read(found: Found, item: str, expected: Leaves) -> Leaves:
    infos = {name: leaf_info(leaf) for name, leaf in expected.items()}
    saved = found.manifest.leaves.get(item, {})
    leaves_lib.compare(found.path / item, saved, infos)
    stored = {name: _stored(leaf) for name, leaf in expected.items() if infos[name].nbytes}
    values = arrays.read(found.path / item, stored)
    as_leaf = _as_array if item in leaves_lib.ON_HOST else _as_leaf
    return {name: as_leaf(values.get(name), expected[name]) for name in infos}


def _stored(leaf: Any) -> LeafInfo:
    """What is stored of a leaf: itself, or the data of a typed key."""
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
            raise ValueError(f"{like.dtype} is not the default kind of key")
        return key
    return jnp.array(array)  # a copy: the memory of numpy could not be donated
