"""The arrays of a folder as TensorStore holds them, without Orbax.

Orbax writes a store for each process, and then one in the folder that refers to them. Earlier
versions of this package could leave the latter out: with special characters in the path, Orbax
did not find the former. All arrays are there, but Orbax reads none.

    <item>/manifest.ocdbt                     the merged store; missing in such a folder
    <item>/ocdbt.process_0/manifest.ocdbt     the store of the only process
"""

from __future__ import annotations

import pathlib
from collections.abc import Collection, Mapping
from typing import Any

import numpy as np
import tensorstore as ts

from vawm.runs.checkpoint.manifest import Damaged, LeafInfo

MANIFEST, PROCESS, ARRAY = "manifest.ocdbt", "ocdbt.process_0", "/zarr.json"


def unmerged(path: pathlib.Path) -> bool:
    """Whether Orbax wrote arrays to the folder `path`, but did not merge them."""
    return not (path / MANIFEST).exists() and (path / PROCESS / MANIFEST).exists()


def read_unmerged(
    path: pathlib.Path, folder: pathlib.Path, expected: Mapping[str, LeafInfo]
) -> dict[str, np.ndarray]:
    """Reads arrays that were not merged, which must be exactly those expected.

    Args:
      path: of the item, for messages.
      folder: the same as `handle.plain` gives it.
      expected: name -> shape and dtype.

    Raises:
      Damaged: there are others.
    """
    store, context = folder / PROCESS, ts.Context()
    names = {key.removesuffix(ARRAY) for key in _keys(store, context) if key.endswith(ARRAY)}
    if names != expected.keys():
        raise Damaged(path, "holds other arrays than its manifest lists")
    opened = {name: _open(store, name, context) for name in expected}
    for name, info in expected.items():  # all before the first takes memory
        array = opened[name]
        actual = LeafInfo(tuple(array.shape), str(np.dtype(array.dtype.numpy_dtype)))
        chunk = array.chunk_layout.read_chunk.shape or ()
        if actual != info or any((a or 0) > b for a, b in zip(chunk, info.shape, strict=True)):
            raise Damaged(path, f"holds {name} as {actual}, but its manifest lists {info}")
    return {name: np.asarray(array.read().result()) for name, array in opened.items()}


def require_data(path: pathlib.Path, folder: pathlib.Path, names: Collection[str]) -> None:
    """Checks that the merged store lists data of these arrays, besides their description.

    Raises:
      Damaged: one has none.
    """
    keys = _keys(folder, ts.Context()) if names else []
    for name in names:
        if not any(key.startswith(f"{name}/c") for key in keys):
            raise Damaged(path, f"holds no data of {name}")


def _keys(store: pathlib.Path, context: ts.Context) -> list[str]:
    found = ts.KvStore.open(_spec(store), context=context).result().list().result()
    return [key.decode() for key in found]


def _open(store: pathlib.Path, name: str, context: ts.Context) -> ts.TensorStore:
    spec = {"driver": "zarr3", "kvstore": _spec(store) | {"path": f"{name}/"}}
    return ts.open(spec, open=True, read=True, context=context).result()


def _spec(store: pathlib.Path) -> dict[str, Any]:
    return {"driver": "ocdbt", "base": {"driver": "file", "path": f"{store}/"}}
