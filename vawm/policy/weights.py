"""A policy's weights in a folder of three plain files, to be shared and loaded anywhere.

    model.safetensors   all parameters, and what the world model carries beside them
    config.json         config, environment spec, version, SHA-256 of model.safetensors
    README.md           a model card, for people only

Names are paths in the tree, such as `params.actor['layer_0']['kernel']`; dtypes stay as they
are. Nothing is pickled. What is read is compared with what the config builds, by name, shape
and dtype, before any array is allocated, and with its checksum.
"""

from __future__ import annotations

import json
import os
import pathlib
import shutil
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import safetensors
import safetensors.numpy

from vawm import config as config_lib
from vawm.config import Config
from vawm.errors import InvalidInput
from vawm.runs import checkpoint, run_folder, validate
from vawm.runs.checkpoint import manifest as manifest_lib
from vawm.runs.checkpoint.manifest import LeafInfo
from vawm.types import EnvSpec, Params, PyTree

FORMAT, SCHEMA = "vawm policy", 1
MODEL, CONFIG, CARD = "model.safetensors", "config.json", "README.md"
DTYPES = {
    "BOOL": "bool",
    "U8": "uint8",
    "I8": "int8",
    "U16": "uint16",
    "I16": "int16",
    "U32": "uint32",
    "I32": "int32",
    "U64": "uint64",
    "I64": "int64",
    "F16": "float16",
    "BF16": "bfloat16",
    "F32": "float32",
    "F64": "float64",
}
"""What safetensors calls a dtype -> what numpy does."""
MAX_BYTES = 2**24
"""Of `config.json`; that of a policy has a few thousand."""


WRONG = (
    *(OSError, ValueError, TypeError, KeyError, AttributeError),
    *(OverflowError, RecursionError),  # numbers without end, and nesting
)
"""What is raised by content that is no description."""


class Description(NamedTuple):
    """What `config.json` says of the weights beside it.

    Attributes:
      version: of the package that wrote it.
      env_steps: control steps of training.
      config: of the run.
      spec: of the environment.
      sha256: of `model.safetensors`.
    """

    version: str
    env_steps: int
    config: Config
    spec: EnvSpec
    sha256: str


def found(folder: str | os.PathLike[str]) -> bool:
    """Whether `folder` is, or was, one that `write` wrote, and not that of a run."""
    folder = pathlib.Path(folder).expanduser()
    if os.path.isfile(folder / MODEL):  # False too where it may not be looked at
        return True
    try:
        return bool(_content(folder / CONFIG))
    except WRONG:
        return False


def check_output(folder: pathlib.Path) -> None:
    """Refuses a place where nothing can be written, or where something is.

    Raises:
      InvalidInput: nothing was written.
    """
    run_folder.check_writable(folder.parent, "output")
    if folder.exists() and not (folder.is_dir() and not any(folder.iterdir())):
        raise InvalidInput("output", str(folder), "exists; choose another --output")


def write(
    folder: pathlib.Path,
    params: Params,
    state: PyTree,
    *,
    config: Config,
    spec: EnvSpec,
    env_steps: int,
    card: str,
) -> None:
    """Writes the three files under a temporary name, which becomes `folder` at the end.

    Raises:
      InvalidInput: `folder` exists and is not empty, or `read` would refuse the config.
      SaveError: the disk is full; nothing is left behind.
    """
    check_output(folder)
    validate.check(config)
    validate.check_spec(config, spec)
    leaves = {name: np.asarray(leaf) for name, leaf in _flatten(params, state).items()}
    scratch = folder.absolute().with_name(f".{folder.name}.tmp-{os.getpid()}")
    content = {
        "format": FORMAT,
        "schema": SCHEMA,
        "vawm": manifest_lib.version(),
        "env_steps": env_steps,
        "config": config_lib.as_dict(config),
        "spec": manifest_lib.spec_as_dict(spec),
    }
    try:
        scratch.mkdir(parents=True)
        safetensors.numpy.save_file(leaves, scratch / MODEL, metadata={"format": "np"})
        content["sha256"] = manifest_lib.sha256(scratch / MODEL)
        (scratch / CONFIG).write_text(json.dumps(content, indent=2) + "\n")
        (scratch / CARD).write_text(card)
        (scratch / MODEL).chmod((scratch / CARD).stat().st_mode)  # the library's is 0600
        for path in (*scratch.iterdir(), scratch):
            manifest_lib.sync(path)
        scratch.replace(folder.absolute())
    except (OSError, safetensors.SafetensorError) as error:
        shutil.rmtree(scratch, ignore_errors=True)
        raise checkpoint.SaveError(f"{folder} could not be written: {error}") from error


def describe(folder: str | os.PathLike[str]) -> Description:
    """What `config.json` in `folder` says.

    Raises:
      InvalidInput: it is damaged, or another version wrote it (`OtherVersion`).
    """
    path = pathlib.Path(folder).expanduser() / CONFIG
    try:
        content = _content(path)
        written = content["vawm"]
        if content["schema"] != SCHEMA:
            raise InvalidInput("schema", content["schema"], "its layout is not known")
        description = Description(
            version=str(written),
            env_steps=int(content["env_steps"]),
            config=manifest_lib.config_from_dict(content["config"]),
            spec=manifest_lib.spec_from_dict(content["spec"]),
            sha256=content["sha256"],
        )
        validate.check(description.config)
        validate.check_spec(description.config, description.spec)
        return description
    except InvalidInput as error:
        raise manifest_lib.OtherVersion(
            "weights", path, error, written=written, otherwise="export it again"
        ) from error
    except WRONG as error:
        reason = error.strerror if isinstance(error, OSError) else repr(error)[:200]
        raise _damaged(path, f"is no description of a policy ({reason})") from error


def _content(path: pathlib.Path) -> dict[str, Any]:
    """What is in `config.json`, of this format; an error of `WRONG` where it is none."""
    with path.open("rb") as file:
        text = file.read(MAX_BYTES + 1)
    if len(text) > MAX_BYTES:
        raise ValueError(f"more than the {MAX_BYTES} bytes allowed")
    content = json.loads(text)
    if content["format"] != FORMAT:
        raise ValueError(f"format is {str(content['format'])[:40]!r}")
    return content


def read(
    folder: str | os.PathLike[str], description: Description, params: PyTree, state: PyTree
) -> tuple[PyTree, PyTree]:
    """The weights in `folder`, like the two trees given (arrays or `ShapeDtypeStruct`s).

    Raises:
      InvalidInput: a name, shape or dtype differs, or the file is damaged.
    """
    path = pathlib.Path(folder).expanduser() / MODEL
    expected = _flatten(params, state)
    infos = {name: manifest_lib.leaf_info(leaf) for name, leaf in expected.items()}
    try:
        with safetensors.safe_open(path, framework="numpy") as file:
            slices = {name: file.get_slice(name) for name in file.keys()}  # noqa: SIM118
            stored = {name: _info(entry) for name, entry in slices.items()}
            _compare(path, stored, infos)
            if manifest_lib.sha256(path) != description.sha256:
                raise _damaged(path, f"does not match its checksum in {CONFIG}")
            leaves = {name: jnp.array(file.get_tensor(name)) for name in expected}
    except (OSError, safetensors.SafetensorError) as error:
        raise _damaged(path, str(error).splitlines()[0][:200]) from error
    return _unflatten("params", params, leaves), _unflatten("model_state", state, leaves)


def _flatten(params: PyTree, state: PyTree) -> dict[str, Any]:
    trees = {"params": params, "model_state": state}
    return {
        prefix + name: leaf
        for prefix, tree in trees.items()
        for name, leaf in checkpoint.flatten(tree).items()
    }


def _unflatten(prefix: str, target: PyTree, leaves: Mapping[str, jax.Array]) -> PyTree:
    own = {name: leaves[prefix + name] for name in checkpoint.flatten(target)}
    return checkpoint.unflatten(target, own)


def _info(entry: Any) -> LeafInfo:
    kind = entry.get_dtype()
    return LeafInfo(tuple(entry.get_shape()), DTYPES.get(kind, kind))


def _compare(
    path: pathlib.Path, stored: Mapping[str, LeafInfo], expected: Mapping[str, LeafInfo]
) -> None:
    differences = [
        f"{name} is {stored.get(name, 'missing')}, expected {expected.get(name, 'nothing')}"
        for name in sorted(stored.keys() | expected.keys())
        if stored.get(name) != expected.get(name)
    ]
    if differences:
        more = f"; and {len(differences) - 3} more" if len(differences) > 3 else ""
        remedy = f"{'; '.join(differences[:3])}{more}: these are not weights of {CONFIG}"
        raise InvalidInput("weights", str(path), remedy)


def _damaged(path: pathlib.Path, how: str) -> InvalidInput:
    return InvalidInput(
        "weights", str(path), f"{how}; export the policy again, or copy it again"
    )
