"""A policy's weights in a folder of three plain files, to share and load anywhere.

    model.safetensors   all parameters, and the world model's state besides them
    config.json         config, environment spec, version, SHA-256 of model.safetensors
    README.md           a model card, for people only

A folder for a hub of models has more files, which are not read: see `vawm.policy.hub`.

Names are paths in the tree, such as `params.actor['layer_0']['kernel']`; dtypes are kept.
Nothing is pickled. Before any array is allocated, the file is compared by name, shape and dtype
with what the config builds, and then with its checksum.
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

from vawm.config import Config, as_dict
from vawm.errors import InvalidInput
from vawm.policy import returned
from vawm.policy.returned import LastReturn
from vawm.process import names
from vawm.runs import checkpoint, run_folder, validate
from vawm.runs.checkpoint import manifest
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
"""safetensors' name of a dtype -> numpy's name."""
MAX_BYTES = 2**24
"""Limit for `config.json`; usually it has a few thousand bytes."""


WRONG = (
    OSError,
    ValueError,
    TypeError,
    KeyError,
    AttributeError,
    OverflowError,
    RecursionError,  # from huge numbers and deep nesting
)
"""Exceptions that a `config.json` with wrong content raises."""


class Description(NamedTuple):
    """The content of `config.json`, which describes the weights next to it.

    Attributes:
      version: of the package that wrote it.
      env_steps: control steps of training.
      config: of the run.
      spec: of the environment.
      sha256: of `model.safetensors`.
      last_return: of training; None if it is not known.
    """

    version: str
    env_steps: int
    config: Config
    spec: EnvSpec
    sha256: str
    last_return: LastReturn | None = None


def found(folder: str | os.PathLike[str]) -> bool:
    """Whether `write` wrote `folder`, even if it is damaged now; False for that of a run."""
    folder = checkpoint.expanded(folder)
    if os.path.isfile(folder / MODEL):  # False as well without permission to look
        return True
    try:
        return bool(_content(folder / CONFIG))
    except WRONG:
        return False


def check_output(folder: pathlib.Path) -> None:
    """Refuses a folder that is not writable or not empty; writes nothing.

    Raises:
      InvalidInput: it is not writable or not empty, or its path is too long.
    """
    run_folder.check_length(folder, "output")
    run_folder.check_writable(folder.parent, "output")
    if folder.exists() and not (folder.is_dir() and not any(folder.iterdir())):
        raise InvalidInput("output", str(folder), "already exists; choose another --output")


def write(
    folder: pathlib.Path,
    params: Params,
    model_state: PyTree,
    *,
    config: Config,
    spec: EnvSpec,
    env_steps: int,
    card: str,
    last_return: LastReturn | None = None,
    others: Mapping[str, bytes] | None = None,
) -> None:
    """Writes the three files to a temporary folder, then renames it to `folder`.

    Args:
      folder: new or empty.
      params: of the policy.
      model_state: of its world model.
      config: of the run.
      spec: of its environment.
      env_steps: at which the parameters were saved.
      card: the text of `README.md`.
      last_return: of training, if it is known.
      others: further files, name -> content.

    Raises:
      InvalidInput: `folder` exists and is not empty, or `read` would refuse the config.
      SaveError: writing failed, for example on a full disk; leaves no files behind.
    """
    check_output(folder)
    validate.check(config)
    validate.check_spec(config, spec)
    leaves = {name: np.asarray(leaf) for name, leaf in _flatten(params, model_state).items()}
    scratch = folder.absolute().with_name(f".vawm-export-{os.getpid()}")  # never too long
    content = {
        "format": FORMAT,
        "schema": SCHEMA,
        "vawm": manifest.version(),
        "env_steps": env_steps,
        "config": as_dict(config),
        "spec": manifest.spec_as_dict(spec),
        "last_return": None if last_return is None else last_return._asdict(),
    }
    try:
        scratch.mkdir(parents=True)
        safetensors.numpy.save_file(leaves, scratch / MODEL, metadata={"format": "np"})
        content["sha256"] = manifest.sha256(scratch / MODEL)
        (scratch / CONFIG).write_text(json.dumps(content, indent=2) + "\n")
        (scratch / CARD).write_text(card, encoding="utf-8")
        for name, data in (others or {}).items():
            (scratch / name).write_bytes(data)
        (scratch / MODEL).chmod((scratch / CARD).stat().st_mode)  # safetensors sets 0600
        for path in (*scratch.iterdir(), scratch):
            manifest.sync(path)
        scratch.replace(folder.absolute())
    except (OSError, safetensors.SafetensorError) as error:
        shutil.rmtree(scratch, ignore_errors=True)
        why = f"{names.shown(folder)} could not be written: {error}"
        raise checkpoint.SaveError(why) from error


def describe(folder: str | os.PathLike[str]) -> Description:
    """Reads and checks `config.json` in `folder`.

    Raises:
      InvalidInput: it is damaged, or another version wrote it (`OtherVersion`).
    """
    path = checkpoint.expanded(folder) / CONFIG
    try:
        content = _content(path)
        written = content["vawm"]
        if content["schema"] != SCHEMA:
            raise InvalidInput("schema", content["schema"], "is unknown to this version")
        description = Description(
            version=str(written),
            env_steps=int(content["env_steps"]),
            config=manifest.config_from_dict(content["config"]),
            spec=manifest.spec_from_dict(content["spec"]),
            sha256=content["sha256"],
            last_return=returned.from_dict(content.get("last_return")),
        )
        validate.check(description.config)
        validate.check_spec(description.config, description.spec)
        return description
    except InvalidInput as error:
        raise manifest.OtherVersion(
            "weights", path, error, written=written, otherwise="export it again"
        ) from error
    except WRONG as error:
        reason = error.strerror if isinstance(error, OSError) else repr(error)[:200]
        raise _damaged(path, f"does not describe a policy ({reason})") from error


def _content(path: pathlib.Path) -> dict[str, Any]:
    """The content of `config.json`; raises one of `WRONG` if it has another format."""
    with path.open("rb") as file:
        text = file.read(MAX_BYTES + 1)
    if len(text) > MAX_BYTES:
        raise ValueError(f"more than the {MAX_BYTES} bytes allowed")
    content = json.loads(text)
    if content["format"] != FORMAT:
        raise ValueError(f"format is {str(content['format'])[:40]!r}")
    return content


def read(
    folder: str | os.PathLike[str],
    description: Description,
    params: PyTree,
    model_state: PyTree,
) -> tuple[PyTree, PyTree]:
    """Reads the weights in `folder` into trees like those given.

    `params` and `model_state` may hold arrays or `ShapeDtypeStruct`s.

    Raises:
      InvalidInput: a name, shape or dtype differs, or the file is damaged.
    """
    path = checkpoint.expanded(folder) / MODEL
    expected = _flatten(params, model_state)
    infos = {name: manifest.leaf_info(leaf) for name, leaf in expected.items()}
    try:
        with safetensors.safe_open(path, framework="numpy") as file:
            slices = {name: file.get_slice(name) for name in file.keys()}  # noqa: SIM118
            stored = {name: _info(entry) for name, entry in slices.items()}
            _compare(path, stored, infos)
            if manifest.sha256(path) != description.sha256:
                raise _damaged(path, f"does not match its checksum in {CONFIG}")
            leaves = {name: jnp.array(file.get_tensor(name)) for name in expected}
    except (OSError, safetensors.SafetensorError) as error:
        raise _damaged(path, str(error).splitlines()[0][:200]) from error
    return _unflatten("params", params, leaves), _unflatten("model_state", model_state, leaves)


def _flatten(params: PyTree, model_state: PyTree) -> dict[str, Any]:
    trees = {"params": params, "model_state": model_state}
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
        wrong = f"the weights do not fit {CONFIG}: {'; '.join(differences[:3])}{more}"
        raise InvalidInput("weights", str(path), f"{wrong}; export the policy again")


def _damaged(path: pathlib.Path, how: str) -> InvalidInput:
    return InvalidInput("weights", str(path), f"{how}; export or copy the policy again")
