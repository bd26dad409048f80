"""Named arrays of numpy in a folder, by Orbax; what does not fit its description is refused."""

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
    # A snapshot is a copy already; Orbax would make another.
    (np.ndarray, ocp.type_handlers.NumpyHandler(deepcopy_host_arrays=False)),
    (jax.Array, ocp.type_handlers.ArrayHandler()),  # never used; Orbax warns without it
)


def write(path: pathlib.Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Writes `arrays`, none of them empty, into the new folder `path`."""
    with _checkpointer() as checkpointer:
        checkpointer.save(path, args=ocp.args.PyTreeSave(dict(arrays)))


def read(path: pathlib.Path, expected: Mapping[str, LeafInfo]) -> dict[str, np.ndarray]:
    """The arrays in `path`, which are exactly those expected.

    Shapes and dtypes are compared with what Orbax wrote beside the numbers, before memory
    is taken for them: a few bytes can stand for an array of any size.

    Raises:
      Damaged: it cannot be read, or holds other arrays.
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
    except Exception as error:  # Orbax and TensorStore have no error of their own
        first = (str(error).strip() or repr(error)).splitlines()[0]
        raise Damaged(path, f"cannot be read ({first[:200]})") from error
    for name, info in expected.items():
        if (arrays[name].shape, str(arrays[name].dtype)) != (info.shape, info.dtype):
            raise Damaged(path, f"holds another {name} than the manifest says")
    return arrays


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """Keeps Orbax and what it runs on from logging, for the whole process.

    Where it cannot write, it logs a trace for every array, hundreds of lines on a full disk,
    and raises the error as well. TensorStore then has more to tell to a loop that Orbax has
    closed, some of it later: after an error these traces stay unheard for good.
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
    """A `sys.unraisablehook` that passes on to `hook` all but what a closed loop is told."""

    def hear(unraisable: Any) -> None:
        error = unraisable.exc_value
        if not (isinstance(error, RuntimeError) and str(error) == "Event loop is closed"):
            hook(unraisable)

    return hear


def _compare(path: pathlib.Path, found: Any, expected: Mapping[str, LeafInfo]) -> None:
    if not isinstance(found, dict) or found.keys() != expected.keys():
        raise Damaged(path, "holds other arrays than the manifest says")
    for name, info in expected.items():
        actual = LeafInfo(tuple(found[name].shape), str(np.dtype(found[name].dtype)))
        storage = found[name].storage
        chunk = tuple(storage.chunk_shape or ()) if storage else ()
        fits = len(chunk) == len(info.shape) and all(
            part <= whole for part, whole in zip(chunk, info.shape, strict=True)
        )
        if actual != info or not fits:
            raise Damaged(path, f"holds {name} as {actual}, the manifest says {info}")


def _checkpointer() -> ocp.Checkpointer:
    handler = ocp.PyTreeCheckpointHandler(
        use_ocdbt=True, use_zarr3=True, type_handler_registry=REGISTRY
    )
    return ocp.Checkpointer(handler)
