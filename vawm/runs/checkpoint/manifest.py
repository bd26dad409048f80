"""What a checkpoint says of itself: its config, every leaf, and a checksum per file."""

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

from vawm import config as config_lib
from vawm.agent import registry
from vawm.agent.registry import UnknownAgent
from vawm.config import Config
from vawm.errors import InvalidInput
from vawm.runs import suites, validate
from vawm.types import ArraySpec, EnvSpec, PyTree

SCHEMA = 2
NAME, DIGEST = "manifest.json", "manifest.sha256"
PARAMS, EPISODES = "params", "episodes"
ITEMS = (PARAMS, "model_state", "images", "state", EPISODES)
"""The folders of a checkpoint."""
DTYPES = (
    *("bool", "bfloat16", "float16", "float32", "float64"),
    *("int8", "int16", "int32", "int64", "uint8", "uint16", "uint32", "uint64"),
)
MAX_BYTES = 2**24
"""Of a manifest; that of a run has some 100 bytes per leaf and file."""
MAX_AXES = 32
FILE_FACTOR, FILE_BYTES, LEAF_BYTES = 2, 2**20, 2**16
"""What the files of an item may take: twice its leaves, and this much whatever their size."""
SPARSE_FACTOR = 100
"""How many times as large as their files parameters may be: noise, which they begin as, and
what training makes of it do not compress."""
MAX_EPISODES_BYTES = 2**32
"""Of running episodes, whose shapes nothing but the manifest tells."""


class Damaged(InvalidInput):
    """A file of a checkpoint that cannot be trusted: `path`, and `how` that is known."""

    def __init__(self, path: pathlib.Path, how: str):
        remedy = (
            f"{how}; the checkpoint is damaged: restore it from a copy, or start the run over "
            "with --fresh"
        )
        super().__init__("checkpoint", str(path), remedy)
        self.path, self.how = path, how


class OtherVersion(InvalidInput):
    """What another version wrote: `why` this one cannot use it, and what can be done."""

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
        who = f"vawm {theirs} wrote it and this is vawm {ours}"
        if theirs == ours:
            who = f"another state of vawm {ours} wrote it"
        remedy = f"{why}; {who}: use the one that wrote it, or {otherwise}"
        super().__init__(field, str(where), remedy)


class LeafInfo(NamedTuple):
    """What a leaf has to look like; `impl` names the generator of a typed PRNG key."""

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
    """One checkpoint.

    Attributes:
      version: of the package that wrote it.
      computed: with which JAX, and on what: "jax 0.10.2 on cpu".
      env_steps: when it was written.
      config: of the run.
      spec: of the environment.
      progress: the host's own counters, for the runner.
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


def computed() -> str:
    """With which JAX this process computes, and on what."""
    return f"jax {jax.__version__} on {jax.devices()[0].device_kind}"


def spec_as_dict(spec: EnvSpec) -> dict[str, Any]:
    """`spec`, ready for JSON."""
    return spec._asdict() | {"obs": _obs_as_dict(spec.obs)}


def spec_from_dict(content: dict[str, Any]) -> EnvSpec:
    """The inverse of `spec_as_dict`; ValueError or TypeError where it is none."""
    kinds: dict[str, type | tuple[type, ...]]
    kinds = {"task": str, "obs": dict, "action_size": int, "discrete": bool}
    kinds |= {"num_envs": int, "action_repeat": int, "episode_length": (int, type(None))}
    spec = _record(content, kinds)
    return EnvSpec(**spec | {"obs": _obs_from_dict(spec["obs"])})


def leaf_info(leaf: Any) -> LeafInfo:
    """Shape and dtype of an array, of a `ShapeDtypeStruct` or of a typed PRNG key."""
    shape = tuple(leaf.shape)
    if jnp.issubdtype(leaf.dtype, jax.dtypes.prng_key):
        name = str(leaf.dtype)  # such as key<fry>
        return LeafInfo(shape, name, impl=name)
    return LeafInfo(shape, str(np.dtype(leaf.dtype)))


def config_from_dict(content: dict[str, Any], cls: type = Config) -> Any:
    """The inverse of `config.as_dict`.

    Raises:
      InvalidInput: a field is missing or unknown, as after a change of version. The caller
        knows which, and raises `OtherVersion`.
    """
    if not isinstance(content, dict):
        raise InvalidInput(cls.__name__, str(content)[:40], "holds no choices")
    names = {field.name for field in dataclasses.fields(cls)}
    for name in sorted(names ^ content.keys()):
        verb = "was not saved" if name in names else "is not known"
        raise InvalidInput(f"{cls.__name__}.{name[:40]}", content.get(name), verb)
    hints = dict(config_lib.kinds(cls))
    if cls is Config:
        suite = content["suite"]
        if not isinstance(suite, str) or suite not in suites.SUITES:
            raise InvalidInput("Config.suite", suite, "is not known")
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
    """`value`, of the kind that the field has; what it may be is for `validate`."""
    kinds = {float: (int, float)}.get(hint, (hint,) if isinstance(hint, type) else (str,))
    if not isinstance(value, kinds) or (isinstance(value, bool) and hint is not bool):
        raise InvalidInput(name, str(value)[:40], "is of another kind")
    return value


def write(folder: pathlib.Path, manifest: Manifest) -> int:
    """Writes the manifest into `folder` with the checksums of all files found there.

    Returns:
      the bytes of all these files.
    """
    found = [path for path in sorted(folder.rglob("*")) if path.is_file()]
    sizes = {path: path.stat().st_size for path in found}
    content = manifest._asdict() | {
        "schema": SCHEMA,
        "config": config_lib.as_dict(manifest.config),
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
    """Checksum of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def sync(path: pathlib.Path) -> None:
    """Returns when a file, or the names in a folder, are on the disk and not in a buffer.

    Some file systems refuse that for folders; there it is theirs to keep the order.
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
    """The manifest in `folder`; nothing that it names is looked at.

    Raises:
      Damaged: it is missing, changed, too large, or describes no checkpoint of ours.
      OtherVersion: its layout or a choice is not known, or could not be run.
      UnknownAgent: nothing has registered its agent.
    """
    digest, text = _content(folder / DIGEST, 1024), _content(folder / NAME, MAX_BYTES)
    if not re.fullmatch(rb"[0-9a-f]{64}\n", digest):
        raise Damaged(folder / DIGEST, "is not a checksum")
    if hashlib.sha256(text).hexdigest().encode() != digest.strip():
        raise Damaged(folder / NAME, f"does not match {DIGEST}")
    try:
        content = _record(json.loads(text), {"schema": int, "version": str}, whole=False)
        if content["schema"] != SCHEMA:
            why, written = "its layout is not known", content["version"]
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
    """What is in a small regular file."""
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
    """The manifest in plain JSON; ValueError or TypeError where it is none."""
    kinds = {"schema": int, "version": str, "computed": str, "env_steps": int}
    kinds |= dict.fromkeys(("config", "spec", "progress", "leaves", "files"), dict)
    _record(content, kinds)
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
    content: Any, kinds: Mapping[str, type | tuple[type, ...]], *, whole: bool = True
) -> dict[str, Any]:
    """`content`, a dict whose values are of these kinds, with no others if `whole`."""
    if not isinstance(content, dict):
        raise ValueError(f"{str(content)[:40]!r} where {', '.join(kinds)} are expected")
    for name in kinds.keys() - content.keys():
        raise ValueError(f"{name} is missing")
    for name in content.keys() - kinds.keys() if whole else ():
        raise ValueError(f"{name[:40]!r} is not known")
    for name, kind in kinds.items():
        value = content[name]
        if not isinstance(value, kind) or (isinstance(value, bool) and kind is not bool):
            raise ValueError(f"{name} is {str(value)[:40]!r}")
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
        raise ValueError(f"item {item[:40]!r} is not known")
    if not isinstance(entries, dict):
        raise ValueError(f"item {item} has no leaves")
    return {path: _leaf_info(entry) for path, entry in entries.items()}


def _leaf_info(entry: Any) -> LeafInfo:
    _record(entry, {"shape": list, "dtype": str, "impl": (str, type(None))})
    dtype, impl = entry["dtype"], entry["impl"]
    is_key = impl is not None and impl == dtype and re.fullmatch(r"key<\w{1,20}>", dtype)
    if not (is_key or (impl is None and dtype in DTYPES)):
        raise ValueError(f"dtype {dtype[:40]!r} is not known")
    return LeafInfo(_shape(entry["shape"]), dtype, impl)


def _file(name: str, entry: Any, leaves: Mapping[str, Any]) -> tuple[int, str]:
    path = pathlib.PurePosixPath(name)
    if path.is_absolute() or ".." in path.parts or "\0" in name or str(path) != name:
        raise ValueError(f"file {name[:80]!r} is outside of the checkpoint")
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
    """No item takes more of the disk than its leaves can need, compressed or not; and small
    files do not unfold into huge parameters."""
    for item, infos in leaves.items():
        needed = sum(info.nbytes for info in infos.values())
        limit = FILE_FACTOR * needed + FILE_BYTES + LEAF_BYTES * len(infos)
        total = sum(size for name, (size, _) in files.items() if item_of(name) == item)
        if total > limit:
            raise ValueError(f"{total} bytes of {item}, whose leaves need {limit} at most")
        if item == PARAMS and needed > SPARSE_FACTOR * total + LEAF_BYTES * len(infos):
            raise ValueError(f"{needed} bytes of {item} cannot come of {total}")
        if item == EPISODES and needed > MAX_EPISODES_BYTES:
            raise ValueError(f"{needed} bytes of {item}, {MAX_EPISODES_BYTES} are allowed")


def item_of(name: str) -> str:
    """The item that a file of a checkpoint belongs to."""
    return pathlib.PurePosixPath(name).parts[0] if name else ""


def _obs_as_dict(obs: PyTree) -> dict[str, Any]:
    """`EnvSpec.obs`, ready for JSON: a dict of arrays is kept under "entries"."""
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
        raise ValueError(f"dtype {content['dtype'][:40]!r} is not known")
    return ArraySpec(_shape(content["shape"]), jnp.dtype(content["dtype"]))
