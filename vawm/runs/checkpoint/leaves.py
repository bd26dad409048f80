"""The named leaves of a tree, and the checkpoint item that each belongs to."""

from __future__ import annotations

import pathlib
from collections.abc import Mapping
from typing import Any

import jax

from vawm.errors import InvalidInput
from vawm.runs.checkpoint.manifest import EPISODES, LeafInfo
from vawm.types import PyTree

PREFIXES = {
    "params": ".learner.params",
    "model_state": ".learner.model_state",
    "images": ".images",
    "state": "",
}
"""Item -> prefix of its paths; a leaf belongs to the first item whose prefix it has."""
ON_HOST = ("images", EPISODES)  # items whose leaves stay numpy arrays

Leaves = dict[str, Any]


def flatten(tree: PyTree) -> Leaves:
    """The leaves of `tree` by path, such as `.learner.params.actor['bias']`."""
    pairs, _ = jax.tree_util.tree_flatten_with_path(tree)
    leaves = {jax.tree_util.keystr(path): leaf for path, leaf in pairs}
    if len(leaves) != len(pairs):
        raise ValueError("two leaves share one path")
    return leaves


def unflatten(target: PyTree, leaves: Leaves) -> PyTree:
    """The inverse of `flatten`; returns a tree like `target`."""
    return jax.tree.unflatten(jax.tree.structure(target), [leaves[k] for k in flatten(target)])


def items(leaves: Leaves) -> dict[str, Leaves]:
    """Groups leaves by item and drops its prefix from their paths; omits empty items."""
    result: dict[str, Leaves] = {}
    for path, leaf in leaves.items():
        item = next(item for item, prefix in PREFIXES.items() if path.startswith(prefix))
        result.setdefault(item, {})[path.removeprefix(PREFIXES[item])] = leaf
    return result


def compare(
    where: pathlib.Path, saved: Mapping[str, LeafInfo], expected: Mapping[str, LeafInfo]
) -> None:
    """Refuses an item with other leaves than expected.

    Raises:
      InvalidInput: names the first three that differ in path, shape or dtype.
    """
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
