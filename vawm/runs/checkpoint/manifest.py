"""The manifest of a checkpoint: its config, every leaf, and a checksum per file."""

from __future__ import annotations

import dataclasses
import errno
import hashlib
import importlib.metadata
import json
import math
import os
import pathlib
import re
import stat
from collections.abc import Mapping
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from vawm.agent import registry
from vawm.agent.registry import UnknownAgent
from vawm.config import Config, as_dict, kinds
from vawm.envs import made as records
from vawm.envs.host import native_record
from vawm.envs.host.native import fits
from vawm.errors import InvalidInput
from vawm.runs import suites, validate
from vawm.types import ArraySpec, EnvSpec, PyTree

SCHEMA = 2
NAME, DIGEST = "manifest.json", "manifest.sha256"
PARAMS, EPISODES = "params", "episodes"
ITEMS = (PARAMS, "model_state", "images", "state", EPISODES)
"""The folders of a checkpoint."""
DTYPES = (
    "bool",
    "bfloat16",
    "float16",
    "float32",
    "float64",
    "int8",
    "int16",
    "int32",
    "int64",
    "uint8",
    "uint16",
    "uint32",
    "uint64",
)
MAX_BYTES = 2**24
"""Limit for a manifest; a usual one has about 100 bytes per leaf and file."""
MAX_AXES = 32
FILE_FACTOR, FILE_BYTES, LEAF_BYTES = 2, 2**20, 2**16
"""Limit for the files of an item: factor * size of the leaves + bytes + bytes per leaf."""
SPARSE_FACTOR = 100
"""Limit for the size of parameters relative to their files: random and trained parameters do
not compress."""
MAX_EPISODES_BYTES = 2**32
"""Limit for the running episodes, whose shapes are known only from the manifest."""


class Damaged(InvalidInput):
    """A damaged file of a checkpoint: its `path`, and `how` it is damaged."""

    def __init__(self, path: pathlib.Path, how: str):
        remedy = (
            f"{how}; the checkpoint is damaged: restore it from a backup, or start over with "
            "--fresh"
        )
        super().__init__("checkpoint", str(path), remedy)
        self.path, self.how = path, how


class OtherVersion(InvalidInput):
    """A file that another version wrote: `why` this one cannot use it, and the remedy."""

    def __init__(
        self,
        field: str,
        where: pathlib.Path,
        why: object,
        *,
        written: object,
        otherwise: str = "start over with --fresh",
    ):
        theirs, ours = str(written)[:40], version()
        who = f"written by vawm {theirs}, this is vawm {ours}"
        if theirs == ours:
            who = f"written by other code of vawm {ours}"
        remedy = f"{why} ({who}); use the version that wrote it, or {otherwise}"
        super().__init__(field, str(where), remedy)


class LeafInfo(NamedTuple):
    """Shape and dtype of a leaf; `impl` names the generator of a typed PRNG key."""

    shape: tuple[int, ...]
    dtype: str
    impl: str | None = None

    def __str__(self) -> str:
        return f"{self.dtype}[{','.join(map(str, self.shape))}]"

    @property
    def nbytes(self) -> int:
        itemsize = 8 if self.impl else jnp.dtype(self.dtype).itemsize
        return math.prod(self.shape) * itemsize


class Manifest(NamedTuple):
    """The description of one checkpoint.

    Attributes:
      version: of the package that wrote it.
      computed: JAX's version and the device: "jax 0.10.2 on cpu".
      env_steps: at which it was written.
      config: of the run.
      spec: of the environment.
      progress: the counters of the host loop, for the runner.
      leaves: item -> path in the tree -> `LeafInfo`.
      files: path relative to the checkpoint -> (bytes, SHA-256).
    """

    version: str
    computed: str
    env_steps: int
    config: Config
    spec: EnvSpec
    progress: dict[str, Any]
    leaves: dict[str, dict[str, LeafInfo]]
    files: dict[str, tuple[int, str]]


def version() -> str:
    """The installed version of the package."""
    try:
        return importlib.metadata.version("vawm")
    except importlib.metadata.PackageNotFoundError:
        return "unknown"


NUMERIC = {"jax_threefry_partitionable": True, "jax_default_matmul_precision": None}
"""Settings of JAX that change numbers, and their usual values."""


def computed() -> str:
    """The JAX version, the device, and unusual settings that change the numbers."""
    parts = [f"jax {jax.__version__} on {jax.devices()[0].device_kind}"]
    for name, usual in NUMERIC.items():
        if (value := getattr(jax.config, name)) != usual:
            parts.append(f"{name}={value}")
    return ", ".join(parts)


def spec_as_dict(spec: EnvSpec) -> dict[str, Any]:
    """Converts `spec` for JSON."""
    return spec._asdict() | {
        "obs": _obs_as_dict(spec.obs),
        "made": None if spec.made is None else records.as_dict(spec.made),
        "native": None if spec.native is None else native_record.as_dict(spec.native),
    }


def spec_from_dict(content: dict[str, Any]) -> EnvSpec:
    """The inverse of `spec_as_dict`; ValueError or TypeError for other content."""
    types: dict[str, type | tuple[type, ...]]
    types = {"task": str, "obs": dict, "action_size": int, "discrete": bool}
    types |= {"num_envs": int, "action_repeat": int, "episode_length": (int, type(None))}
    types |= dict.fromkeys(("made", "native"), (dict, type(None)))
    if isinstance(content, dict):  # earlier versions did not keep them
        content = {"made": None, "native": None, **content}
    content = _record(content, types)
    spec = EnvSpec(**content | {"obs": _obs_from_dict(content["obs"])})
    if content["made"] is not None:
        spec = spec._replace(made=records.from_dict(content["made"]))
    if content["native"] is not None:
        spec = spec._replace(native=native_record.from_dict(content["native"]))
        if not fits(spec.native, spec):
            raise ValueError("the spaces of the environment do not fit its spec")
    return spec


def leaf_info(leaf: Any) -> LeafInfo:
    """Shape and dtype of an array, a `ShapeDtypeStruct` or a typed PRNG key."""
    shape = tuple(leaf.shape)
    if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
        name = str(leaf.dtype)  # such as key<fry>
        return LeafInfo(shape, name, impl=name)
    return LeafInfo(shape, str(np.dtype(leaf.dtype)))


def config_from_dict(content: dict[str, Any], cls: type = Config) -> Any:
    """The inverse of `config.as_dict`.

    Raises:
      InvalidInput: a field is missing or unknown, as after a change of version. The caller
        knows the versions and raises `OtherVersion`.
    """
    if not isinstance(content, dict):
        raise InvalidInput(cls.__name__, str(content)[:40], "is not a dict of fields")
    names = {field.name for field in dataclasses.fields(cls)}
    for name in sorted(names ^ content.keys()):
        verb = "was not saved" if name in names else "is unknown"
        raise InvalidInput(f"{cls.__name__}.{name[:40]}", content.get(name), verb)
    hints = dict(kinds(cls))
    if cls is Config:
        suite = content["suite"]
        if not isinstance(suite, str) or suite not in suites.SUITES:
            raise InvalidInput("Config.suite", suite, "is unknown")
        row = registry.kind(_choice("Config.agent", content["agent"], str))
        hints |= {
            "env": suites.SUITES[suite].choices,
            "world_model": row.world_model,
            "optimizer": row.optimizer,
        }
    return cls(
        **{
            name: config_from_dict(value, hints[name])
            if dataclasses.is_dataclass(hints[name])
            else _choice(f"{cls.__name__}.{name}", value, hints[name])
            for name, value in content.items()
        }
    )


def _choice(name: str, value: Any, hint: Any) -> Any:
    """`value`, if it has the field's type; `validate` checks the value."""
    types = {float: (int, float)}.get(hint, (hint,) if isinstance(hint, type) else (str,))
    if not isinstance(value, types) or (isinstance(value, bool) and hint is not bool):
        raise InvalidInput(name, str(value)[:40], "has the wrong type")
    return value


def write(folder: pathlib.Path, manifest: Manifest) -> int:
    """Writes the manifest to `folder`, with the checksums of all files there.

    Returns:
      The total size of these files, in bytes.
    """
    found = [path for path in sorted(folder.rglob("*")) if path.is_file()]
    sizes = {path: path.stat().st_size for path in found}
    content = manifest._asdict() | {
        "schema": SCHEMA,
        "config": as_dict(manifest.config),
        "spec": spec_as_dict(manifest.spec),
        "leaves": {
            item: {path: info._asdict() for path, info in leaves.items()}
            for item, leaves in manifest.leaves.items()
        },
        "files": {
            path.relative_to(folder).as_posix(): [size, sha256(path)]
            for path, size in sizes.items()
        },
    }
    text = json.dumps(content, indent=1).encode()
    digest = hashlib.sha256(text).hexdigest().encode() + b"\n"
    (folder / NAME).write_bytes(text)
    (folder / DIGEST).write_bytes(digest)
    for path in (*folder.rglob("*"), folder):
        sync(path)
    return sum(sizes.values()) + len(text) + len(digest)


def sha256(path: pathlib.Path) -> str:
    """SHA-256 of a file, in hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def sync(path: pathlib.Path) -> None:
    """Waits until a file, or the names in a folder, are on the disk (fsync).

    Ignores file systems that refuse fsync for folders.
    """
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.ENOTSUP) or not path.is_dir():
            raise
    finally:
        os.close(descriptor)


def read(folder: pathlib.Path) -> Manifest:
    """Reads the manifest in `folder`; does not look at the files that it names.

    Raises:
      Damaged: it is missing, changed, too large, or not a manifest.
      OtherVersion: its layout or a field is unknown, or its config could not be run.
      UnknownAgent: its agent is not registered.
    """
    digest, text = _content(folder / DIGEST, 1024), _content(folder / NAME, MAX_BYTES)
    if not re.fullmatch(rb"[0-9a-f]{64}\n", digest):
        raise Damaged(folder / DIGEST, "is not a checksum")
    if hashlib.sha256(text).hexdigest().encode() != digest.strip():
        raise Damaged(folder / NAME, f"does not match {DIGEST}")
    try:
        content = _record(json.loads(text), {"schema": int, "version": str}, whole=False)
        if content["schema"] != SCHEMA:
            why, written = f"schema {content['schema']} is unknown", content["version"]
            raise OtherVersion("checkpoint", folder, why, written=written)
        manifest = _parse(content)
        validate.check(manifest.config)
    except (OtherVersion, UnknownAgent):
        raise
    except InvalidInput as error:
        written = content["version"]
        raise OtherVersion("checkpoint", folder, error, written=written) from error
    except (ValueError, TypeError, RecursionError) as error:
        reason = "nested too deep" if isinstance(error, RecursionError) else _first_line(error)
        raise Damaged(folder / NAME, f"is not a manifest: {reason}") from error
    return manifest


def _content(path: pathlib.Path, limit: int) -> bytes:
    """The content of a small regular file."""
    try:
        status = path.lstat()
        if not stat.S_ISREG(status.st_mode):
            raise Damaged(path, "is not a file")
        if status.st_size > limit:
            raise Damaged(path, f"has {status.st_size} bytes, more than the {limit} allowed")
        return path.read_bytes()
    except OSError as error:
        missing = isinstance(error, FileNotFoundError)
        how = "is missing" if missing else f"cannot be read ({error.strerror})"
        raise Damaged(path, how) from error


def _first_line(error: Exception) -> str:
    return (str(error).strip() or repr(error)).splitlines()[0][:200]


def _parse(content: dict[str, Any]) -> Manifest:
    """The manifest from plain JSON; ValueError or TypeError for other content."""
    types = {"schema": int, "version": str, "computed": str, "env_steps": int}
    types |= dict.fromkeys(("config", "spec", "progress", "leaves", "files"), dict)
    _record(content, types)
    leaves = {item: _leaves(item, entries) for item, entries in content["leaves"].items()}
    files = {name: _file(name, entry, leaves) for name, entry in content["files"].items()}
    _check_sizes(leaves, files)
    return Manifest(
        version=content["version"],
        computed=content["computed"],
        env_steps=_count(content["env_steps"]),
        config=config_from_dict(content["config"]),
        spec=spec_from_dict(content["spec"]),
        progress=content["progress"],
        leaves=leaves,
        files=files,
    )


def _record(
    content: Any, types: Mapping[str, type | tuple[type, ...]], *, whole: bool = True
) -> dict[str, Any]:
    """`content`, if it is a dict with values of these types, and no others if `whole`."""
    if not isinstance(content, dict):
        raise ValueError(f"{str(content)[:40]!r} is not a dict of {', '.join(types)}")
    for name in types.keys() - content.keys():
        raise ValueError(f"{name} is missing")
    for name in content.keys() - types.keys() if whole else ():
        raise ValueError(f"{name[:40]!r} is unknown")
    for name, kind in types.items():
        value = content[name]
        if not isinstance(value, kind) or (isinstance(value, bool) and kind is not bool):
            raise ValueError(f"{name} is {str(value)[:40]!r}, of the wrong type")
    return content


def _count(value: Any) -> int:
    if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value < 2**63:
        raise ValueError(f"{str(value)[:40]!r} is not a count")
    return value


def _shape(value: Any) -> tuple[int, ...]:
    if not isinstance(value, list) or len(value) > MAX_AXES:
        raise ValueError(f"{str(value)[:40]!r} is not a shape")
    return tuple(_count(size) for size in value)


def _leaves(item: str, entries: Any) -> dict[str, LeafInfo]:
    if item not in ITEMS:
        raise ValueError(f"item {item[:40]!r} is unknown")
    if not isinstance(entries, dict):
        raise ValueError(f"item {item} has no leaves")
    return {path: _leaf_info(entry) for path, entry in entries.items()}


def _leaf_info(entry: Any) -> LeafInfo:
    _record(entry, {"shape": list, "dtype": str, "impl": (str, type(None))})
    dtype, impl = entry["dtype"], entry["impl"]
    is_key = impl is not None and impl == dtype and re.fullmatch(r"key<\w{1,20}>", dtype)
    if not (is_key or (impl is None and dtype in DTYPES)):
        raise ValueError(f"dtype {dtype[:40]!r} is unknown")
    return LeafInfo(_shape(entry["shape"]), dtype, impl)


def _file(name: str, entry: Any, leaves: Mapping[str, Any]) -> tuple[int, str]:
    path = pathlib.PurePosixPath(name)
    if path.is_absolute() or ".." in path.parts or "\0" in name or str(path) != name:
        raise ValueError(f"file {name[:80]!r} is outside the checkpoint")
    if item_of(name) not in leaves or len(path.parts) < 2:
        raise ValueError(f"file {name[:80]!r} belongs to no item")
    if not isinstance(entry, list) or len(entry) != 2:
        raise ValueError(f"file {name[:80]!r} has no size and checksum")
    size, digest = entry
    if not isinstance(digest, str) or not re.fullmatch("[0-9a-f]{64}", digest):
        raise ValueError(f"file {name[:80]!r} has no checksum")
    return _count(size), digest


def _check_sizes(
    leaves: Mapping[str, Mapping[str, LeafInfo]], files: Mapping[str, tuple[int, str]]
) -> None:
    """Refuses files that are too large for their leaves, and leaves too large for their files.

    The former would fill the disk, the latter the memory.
    """
    for item, infos in leaves.items():
        needed = sum(info.nbytes for info in infos.values())
        limit = FILE_FACTOR * needed + FILE_BYTES + LEAF_BYTES * len(infos)
        total = sum(size for name, (size, _) in files.items() if item_of(name) == item)
        if total > limit:
            raise ValueError(f"{item} has {total} bytes in files, more than {limit}")
        if item == PARAMS and needed > SPARSE_FACTOR * total + LEAF_BYTES * len(infos):
            raise ValueError(f"{item} has {needed} bytes, but only {total} in files")
        if item == EPISODES and needed > MAX_EPISODES_BYTES:
            raise ValueError(f"{item} has {needed} bytes, more than {MAX_EPISODES_BYTES}")


def item_of(name: str) -> str:
    """The item that a file of a checkpoint belongs to."""
    return pathlib.PurePosixPath(name).parts[0] if name else ""


def _obs_as_dict(obs: PyTree) -> dict[str, Any]:
    """Converts `EnvSpec.obs` for JSON: a dict of arrays is stored under "entries"."""
    if isinstance(obs, dict):
        return {"entries": {name: _obs_as_dict(entry) for name, entry in obs.items()}}
    return {"shape": list(obs.shape), "dtype": str(jnp.dtype(obs.dtype))}


def _obs_from_dict(content: Any) -> PyTree:
    """The inverse of `_obs_as_dict`."""
    if isinstance(content, dict) and "entries" in content:
        entries = _record(content, {"entries": dict})["entries"]
        return {name: _obs_from_dict(entry) for name, entry in entries.items()}
    _record(content, {"shape": list, "dtype": str})
    if content["dtype"] not in DTYPES:
        raise ValueError(f"dtype {content['dtype'][:40]!r} is unknown")
    return ArraySpec(_shape(content["shape"]), jnp.dtype(content["dtype"]))
