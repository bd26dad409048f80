"""Named numpy arrays in a folder, stored by Orbax and compared with the manifest.

Orbax sees the folder through a path without special characters, see `handle`.
"""

from __future__ import annotations

import contextlib
import logging
import pathlib
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import Any

import jax
import numpy as np
import orbax.checkpoint as ocp

from vawm.runs.checkpoint import handle, store
from vawm.runs.checkpoint.manifest import Damaged, LeafInfo

REGISTRY = ocp.type_handlers.create_type_handler_registry(
    # A snapshot is already a copy; Orbax would make another.
    (np.ndarray, ocp.type_handlers.NumpyHandler(deepcopy_host_arrays=False)),
    (jax.Array, ocp.type_handlers.ArrayHandler()),  # unused; Orbax warns without it
)

READ_BACK = 64 * 2**20
"""Bytes of arrays that `check` reads at once."""


def write(path: pathlib.Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Writes `arrays`, none of them empty, to the new folder `path`, whose parent exists."""
    with handle.plain(path.parent) as parent, _checkpointer() as checkpointer:
        checkpointer.save(parent / path.name, args=ocp.args.PyTreeSave(dict(arrays)))


def read(path: pathlib.Path, expected: Mapping[str, LeafInfo]) -> dict[str, np.ndarray]:
    """Reads the arrays in `path`, which must be exactly those expected.

    Compares shapes and dtypes with the stored metadata before memory is allocated, because a
    few bytes can expand to an array of any size.

    Raises:
      Damaged: the folder cannot be read, or holds other arrays.
    """
    with _open(path) as folder:
        if store.unmerged(folder):
            return store.read_unmerged(path, folder, expected)
        with _checkpointer() as checkpointer:
            _compare(path, checkpointer.metadata(folder).item_metadata.tree, expected)
            args = ocp.args.PyTreeRestore(restore_args=_as_numpy(expected))
            arrays = checkpointer.restore(folder, args=args)
    for name, info in expected.items():
        if _info(arrays[name]) != info:
            raise Damaged(path, f"holds {name} with a shape or dtype not in the manifest")
    return arrays


def check(path: pathlib.Path, written: Mapping[str, np.ndarray]) -> None:
    """Opens what `write` wrote to `path` as `read` would, and compares it with `written`.

    Of every array it compares name, shape and dtype. Arrays up to `READ_BACK` bytes are read
    and compared bit for bit, a few at a time. Of larger ones, such as replayed images, it only
    checks that there is data: reading them would take their memory again.

    Raises:
      Damaged: `read` would refuse it, or would return something else.
    """
    infos = {name: _info(array) for name, array in written.items()}
    with _open(path) as folder, _checkpointer() as checkpointer:
        _compare(path, checkpointer.metadata(folder).item_metadata.tree, infos)
        for part in _parts(infos):
            args = ocp.args.PyTreeRestore(
                item=dict.fromkeys(part, 0), restore_args=_as_numpy(part), partial_restore=True
            )
            found = checkpointer.restore(folder, args=args)
            for name in part:
                if not _same(found[name], written[name]):
                    raise Damaged(path, f"holds another {name} than was written")
        large = [name for name, info in infos.items() if info.nbytes > READ_BACK]
        store.require_data(path, folder, large)


def _parts(infos: Mapping[str, LeafInfo]) -> Iterator[list[str]]:
    """Names of arrays of at most `READ_BACK` bytes; together no more than that in each part."""
    part: list[str] = []
    size = 0
    for name, info in infos.items():
        if info.nbytes > READ_BACK:
            continue
        if part and size + info.nbytes > READ_BACK:
            yield part
            part, size = [], 0
        part.append(name)
        size += info.nbytes
    if part:
        yield part


def _info(array: np.ndarray) -> LeafInfo:
    return LeafInfo(array.shape, str(array.dtype))


def _same(a: np.ndarray, b: np.ndarray) -> bool:
    """Whether two arrays are equal bit for bit, NaN included."""
    return _info(a) == _info(b) and bool(np.array_equal(_bits(a), _bits(b)))


def _bits(array: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(array).reshape(-1).view(np.uint8)


def _as_numpy(names: Iterable[str]) -> dict[str, ocp.RestoreArgs]:
    return {name: ocp.RestoreArgs(restore_type=np.ndarray) for name in names}


@contextlib.contextmanager
def _open(path: pathlib.Path) -> Iterator[pathlib.Path]:
    """A plain path to the folder `path`; turns errors inside the block into `Damaged`."""
    where = ""
    try:
        with handle.plain(path) as folder:
            where = str(folder)
            yield folder
    except Damaged:
        raise
    except Exception as error:  # Orbax and TensorStore have no error class
        text = (str(error).strip() or repr(error)).splitlines()[0]
        first = text.replace(where, str(path)) if where else text
        raise Damaged(path, f"cannot be read ({first[:200]})") from error


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """Keeps Orbax and its libraries from logging, for the whole process.

    If Orbax cannot write, it logs a trace for every array (hundreds of lines on a full disk)
    and raises the error as well. TensorStore then reports to an event loop that Orbax has
    closed, sometimes later: after an error, these traces are suppressed for good.
    """
    loggers = [logging.getLogger(name) for name in ("absl", "asyncio")]
    for logger in loggers:
        logger.addFilter(_nothing)
    earlier, sys.unraisablehook = sys.unraisablehook, _but_closed_loops(sys.unraisablehook)
    try:
        yield
        sys.unraisablehook = earlier
    finally:
        for logger in loggers:
            logger.removeFilter(_nothing)


def _nothing(record: logging.LogRecord) -> bool:
    return False


def _but_closed_loops(hook: Callable[[Any], object]) -> Callable[[Any], object]:
    """A `sys.unraisablehook` that drops errors of closed event loops and calls `hook`."""

    def hear(unraisable: Any) -> None:
        error = unraisable.exc_value
        if not (isinstance(error, RuntimeError) and str(error) == "Event loop is closed"):
            hook(unraisable)

    return hear


def _compare(path: pathlib.Path, found: Any, expected: Mapping[str, LeafInfo]) -> None:
    if not isinstance(found, dict) or found.keys() != expected.keys():
        raise Damaged(path, "holds other arrays than its manifest lists")
    for name, info in expected.items():
        actual = LeafInfo(tuple(found[name].shape), str(np.dtype(found[name].dtype)))
        storage = found[name].storage
        chunk = tuple(storage.chunk_shape or ()) if storage else ()
        fits = len(chunk) == len(info.shape) and all(
            part <= whole for part, whole in zip(chunk, info.shape, strict=True)
        )
        if actual != info or not fits:
            raise Damaged(path, f"holds {name} as {actual}, but its manifest lists {info}")


def _checkpointer() -> ocp.Checkpointer:
    handler = ocp.PyTreeCheckpointHandler(
        use_ocdbt=True, use_zarr3=True, type_handler_registry=REGISTRY
    )
    return ocp.Checkpointer(handler)
