"""Named numpy arrays in a folder, stored by Orbax and compared with the manifest."""

from __future__ import annotations

import contextlib
import logging
import pathlib
import sys
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import jax
import numpy as np
import orbax.checkpoint as ocp

from vawm.runs.checkpoint.manifest import Damaged, LeafInfo

REGISTRY = ocp.type_handlers.create_type_handler_registry(
    # A snapshot is already a copy; Orbax would make another.
    (np.ndarray, ocp.type_handlers.NumpyHandler(deepcopy_host_arrays=False)),
    (jax.Array, ocp.type_handlers.ArrayHandler()),  # unused; Orbax warns without it
)


def write(path: pathlib.Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Writes `arrays`, none of them empty, to the new folder `path`."""
    with _checkpointer() as checkpointer:
        checkpointer.save(path, args=ocp.args.PyTreeSave(dict(arrays)))


def read(path: pathlib.Path, expected: Mapping[str, LeafInfo]) -> dict[str, np.ndarray]:
    """Reads the arrays in `path`, which must be exactly those expected.

    Compares shapes and dtypes with Orbax's metadata before memory is allocated, because a
    few bytes can expand to an array of any size.

    Raises:
      Damaged: the folder cannot be read, or holds other arrays.
    """
    try:
        with _checkpointer() as checkpointer:
            _compare(path, checkpointer.metadata(path).item_metadata.tree, expected)
            restore_args = {name: ocp.RestoreArgs(restore_type=np.ndarray) for name in expected}
            arrays = checkpointer.restore(
                path, args=ocp.args.PyTreeRestore(restore_args=restore_args)
            )
    except Damaged:
        raise
    except Exception as error:  # Orbax and TensorStore have no error class
        first = (str(error).strip() or repr(error)).splitlines()[0]
        raise Damaged(path, f"cannot be read ({first[:200]})") from error
    for name, info in expected.items():
        if (arrays[name].shape, str(arrays[name].dtype)) != (info.shape, info.dtype):
            raise Damaged(path, f"holds {name} with a shape or dtype not in the manifest")
    return arrays


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
