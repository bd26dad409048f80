"""Checkpoints: the whole of a run's state, checked file by file and leaf by leaf.

    <logdir>/checkpoints/<env_steps>/
        params/          Orbax: what is needed to act
        model_state/     Orbax: and what the world model carries beside it, if anything
        state/           Orbax: everything else (optimiser, replay, environments, keys, ...)
        images/          Orbax: replayed images, where they are kept on the host
        episodes/        Orbax: what environments on the host did since their last reset
        manifest.json    config, environment spec, counters, leaves, SHA-256 of every file
        manifest.sha256

A checkpoint is written under a temporary name and renamed when it is complete, and the
one before it is deleted after that, so a complete one exists at every moment.

Orbax ignores the target's shape and casts dtypes silently, so every leaf is compared with
the manifest. Leaves are stored flat, named by their path in the tree; typed PRNG keys are
stored as their data, and empty arrays, which Orbax refuses, in the manifest alone.
"""

from __future__ import annotations

import os
import pathlib
import shutil
from collections.abc import Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import orbax.checkpoint as ocp

from vawm import manifest as manifest_lib
from vawm.config import Config
from vawm.errors import InvalidInput
from vawm.manifest import LeafInfo, Manifest, leaf_info
from vawm.types import EnvSpec, PyTree

PREFIXES = {
    "params": ".learner.params",
    "model_state": ".learner.model_state",
    "images": ".images",
    "state": "",
}
"""Item -> what its paths begin with; the first that fits has a leaf."""
ON_HOST = ("images", "episodes")  # these stay arrays of numpy
SCRATCH = "tmp-"

Leaves = dict[str, Any]


class SaveError(RuntimeError):
    """A checkpoint could not be written; the one before it is intact."""


def root(logdir: str | os.PathLike[str]) -> pathlib.Path:
    """Where the checkpoints of a run are."""
    return pathlib.Path(logdir).expanduser().absolute() / "checkpoints"


def latest(logdir: str | os.PathLike[str]) -> pathlib.Path | None:
    """The newest complete checkpoint, or None."""
    if not root(logdir).is_dir():
        return None
    complete = [path for path in root(logdir).iterdir() if path.name.isdigit()]
    return max(complete, key=lambda path: int(path.name), default=None)


def read_manifest(logdir: str | os.PathLike[str]) -> tuple[pathlib.Path, Manifest]:
    """The newest checkpoint of a run, and what it says of itself.

    Raises:
      InvalidInput: there is none, or it is damaged.
    """
    path = latest(logdir)
    if path is None:
        raise InvalidInput(
            "logdir",
            str(logdir),
            "holds no checkpoint; name the folder of a run that saved one",
        )
    return path, manifest_lib.read(path)


def save(
    logdir: str | os.PathLike[str],
    state: PyTree,
    *,
    env_steps: int,
    config: Config,
    spec: EnvSpec,
    progress: Mapping[str, Any],
    episodes: Leaves | None = None,
) -> pathlib.Path:
    """Writes a `TrainState`; deletes older checkpoints once the new one is complete.

    `episodes` are arrays of any shape beside it, see `restore_episodes`.

    Raises:
      SaveError: nothing was changed, because the disk is full or a parameter not finite.
    """
    final = root(logdir) / f"{env_steps:012d}"
    if final.exists():
        return final
    items = _items(flatten(state))
    if episodes is not None:
        items["episodes"] = dict(episodes)
    _refuse_nonfinite(items["params"] | items.get("model_state", {}))
    infos = {
        item: {path: leaf_info(leaf) for path, leaf in leaves.items()}
        for item, leaves in items.items()
    }
    manifest = Manifest(
        version=manifest_lib.version(),
        env_steps=env_steps,
        config=config,
        spec=spec,
        progress=dict(progress),
        leaves=infos,
        files={},
    )
    scratch = final.with_name(SCRATCH + final.name)
    try:
        shutil.rmtree(scratch, ignore_errors=True)
        scratch.mkdir(parents=True)
        for item, leaves in items.items():
            _write(scratch / item, leaves)
        manifest_lib.write(scratch, manifest)
        scratch.rename(final)
    except Exception as error:
        shutil.rmtree(scratch, ignore_errors=True)
        raise SaveError(_why_not_saved(final, infos, error)) from error
    for path in final.parent.iterdir():
        if path != final:
            shutil.rmtree(path, ignore_errors=True)
    return final


def restore(logdir: str | os.PathLike[str], target: PyTree) -> tuple[PyTree, Manifest]:
    """The newest checkpoint, in the tree of `target` (arrays or `ShapeDtypeStruct`s).

    Raises:
      InvalidInput: a file is damaged, or a leaf differs from the target in path, shape or
        dtype.
    """
    path, manifest = read_manifest(logdir)
    expected = _items(flatten(target))
    leaves: Leaves = {}
    for item, wanted in expected.items():
        values = _read(path, manifest, item, wanted)
        leaves |= {PREFIXES[item] + name: value for name, value in values.items()}
    return unflatten(target, leaves), manifest


def restore_episodes(logdir: str | os.PathLike[str]) -> dict[str, np.ndarray] | None:
    """The arrays that were saved as `episodes`; None where there are none.

    Raises:
      InvalidInput: a file is damaged.
    """
    path, manifest = read_manifest(logdir)
    infos = manifest.leaves.get("episodes")
    if infos is None:
        return None
    expected = {name: np.zeros(info.shape, info.dtype) for name, info in infos.items()}
    return _read(path, manifest, "episodes", expected)


def restore_agent(
    logdir: str | os.PathLike[str], params: PyTree, model_state: PyTree
) -> tuple[tuple[PyTree, PyTree], Manifest]:
    """What acting needs, like the two trees given; nothing else of the checkpoint is read."""
    path, manifest = read_manifest(logdir)
    targets = {"params": params, "model_state": model_state}
    restored = [
        unflatten(target, _read(path, manifest, item, flatten(target)))
        if jax.tree.leaves(target)
        else target
        for item, target in targets.items()
    ]
    return (restored[0], restored[1]), manifest


def flatten(tree: PyTree) -> Leaves:
    """Every leaf of `tree` by its path, such as `.learner.params.actor['bias']`."""
    pairs, _ = jax.tree_util.tree_flatten_with_path(tree)
    leaves = {jax.tree_util.keystr(path): leaf for path, leaf in pairs}
    if len(leaves) != len(pairs):
        raise ValueError("two leaves share one path")
    return leaves


def unflatten(target: PyTree, leaves: Leaves) -> PyTree:
    """The inverse of `flatten`, in the tree of `target`."""
    return jax.tree.unflatten(jax.tree.structure(target), [leaves[k] for k in flatten(target)])


def _items(leaves: Leaves) -> dict[str, Leaves]:
    """Leaves by item, their paths without its prefix; items without leaves are left out."""
    items: dict[str, Leaves] = {}
    for path, leaf in leaves.items():
        item = next(item for item, prefix in PREFIXES.items() if path.startswith(prefix))
        items.setdefault(item, {})[path.removeprefix(PREFIXES[item])] = leaf
    return items


def _refuse_nonfinite(needed: Leaves) -> None:
    """What acting needs has to be finite."""
    for path, leaf in needed.items():
        if not bool(jnp.isfinite(leaf).all()):
            raise SaveError(f"parameter {path} is not finite; no checkpoint is written")


def _write(path: pathlib.Path, leaves: Leaves) -> None:
    plain = {
        name: jax.random.key_data(leaf) if leaf_info(leaf).impl else leaf
        for name, leaf in leaves.items()
    }
    arrays = {name: np.asarray(leaf) for name, leaf in plain.items() if leaf.size}
    with _checkpointer() as checkpointer:
        checkpointer.save(path, args=ocp.args.PyTreeSave(arrays))


def _read(path: pathlib.Path, manifest: Manifest, item: str, expected: Leaves) -> Leaves:
    infos = {name: leaf_info(leaf) for name, leaf in expected.items()}
    _compare(path / item, manifest.leaves.get(item, {}), infos)
    manifest_lib.verify(path, manifest, item)
    stored = [name for name, info in infos.items() if info.nbytes]
    with _checkpointer() as checkpointer:
        arrays = checkpointer.restore(
            path / item,
            args=ocp.args.PyTreeRestore(
                restore_args={name: ocp.RestoreArgs(restore_type=np.ndarray) for name in stored}
            ),
        )
    as_leaf = _as_array if item in ON_HOST else _as_leaf
    return {name: as_leaf(arrays.get(name), expected[name]) for name in infos}


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


def _compare(
    where: pathlib.Path, saved: Mapping[str, LeafInfo], expected: Mapping[str, LeafInfo]
) -> None:
    differences = [
        f"{path} is {saved.get(path, 'missing')}, expected {expected.get(path, 'nothing')}"
        for path in sorted(saved.keys() | expected.keys())
        if saved.get(path) != expected.get(path)
    ]
    if differences:
        shown = "; ".join(differences[:3])
        more = f"; and {len(differences) - 3} more leaves" if len(differences) > 3 else ""
        remedy = f"{shown}{more}; resume with the config and version that wrote it"
        raise InvalidInput("checkpoint", str(where), remedy)


def _checkpointer() -> ocp.Checkpointer:
    return ocp.Checkpointer(ocp.PyTreeCheckpointHandler(use_ocdbt=True, use_zarr3=True))


def _why_not_saved(
    final: pathlib.Path, infos: dict[str, dict[str, LeafInfo]], error: Exception
) -> str:
    needed = sum(info.nbytes for item in infos.values() for info in item.values())
    free = shutil.disk_usage(final.parents[1]).free
    reason = (str(error).strip() or repr(error)).splitlines()[0]
    return (
        f"checkpoint {final} could not be written (up to {needed / 2**20:.0f} MiB needed, "
        f"{free / 2**20:.0f} MiB free): {reason[:200]}"
    )
