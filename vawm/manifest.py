"""What a checkpoint says of itself: its config, every leaf, and a checksum per file."""

from __future__ import annotations

import dataclasses
import hashlib
import importlib.metadata
import json
import math
import os
import pathlib
import typing
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from vawm import config as config_lib
from vawm.config import Config
from vawm.errors import InvalidInput
from vawm.types import ArraySpec, EnvSpec, PyTree

SCHEMA = 1
NAME, DIGEST = "manifest.json", "manifest.sha256"


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
      env_steps: when it was written.
      config: of the run.
      spec: of the environment.
      progress: the host's own counters, for the runner.
      leaves: item -> path in the tree -> `LeafInfo`.
      files: path relative to the checkpoint -> (bytes, SHA-256).
    """

    version: str
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


def spec_as_dict(spec: EnvSpec) -> dict[str, Any]:
    """`spec`, ready for JSON."""
    return spec._asdict() | {"obs": _obs_as_dict(spec.obs)}


def spec_from_dict(content: dict[str, Any]) -> EnvSpec:
    """The inverse of `spec_as_dict`."""
    return EnvSpec(**content | {"obs": _obs_from_dict(content["obs"])})


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
      InvalidInput: a field is missing or unknown, as after a change of version.
    """
    names = {field.name for field in dataclasses.fields(cls)}
    for name in names ^ content.keys():
        verb = "was not saved" if name in names else "is not known"
        raise InvalidInput(
            f"{cls.__name__}.{name}", content.get(name), f"{verb} (other version)"
        )
    hints = typing.get_type_hints(cls)
    if cls is Config:
        for name, known in (
            ("suite", config_lib.ENV_CONFIGS),
            ("agent", config_lib.AGENT_CONFIGS),
        ):
            if content[name] not in known:
                raise InvalidInput(
                    f"Config.{name}", content[name], "is not known (other version)"
                )
        hints["env"] = config_lib.ENV_CONFIGS[content["suite"]]
        hints |= config_lib.AGENT_CONFIGS[content["agent"]]._asdict()
    return cls(
        **{
            name: config_from_dict(value, hints[name])
            if dataclasses.is_dataclass(hints[name])
            else value
            for name, value in content.items()
        }
    )


def write(folder: pathlib.Path, manifest: Manifest) -> None:
    """Writes the manifest into `folder` with the checksums of all files found there."""
    content = manifest._asdict() | {
        "schema": SCHEMA,
        "config": config_lib.as_dict(manifest.config),
        "spec": spec_as_dict(manifest.spec),
        "leaves": {
            item: {path: info._asdict() for path, info in leaves.items()}
            for item, leaves in manifest.leaves.items()
        },
        "files": {
            str(path.relative_to(folder)): [path.stat().st_size, sha256(path)]
            for path in sorted(folder.rglob("*"))
            if path.is_file()
        },
    }
    text = json.dumps(content, indent=1).encode()
    (folder / NAME).write_bytes(text)
    (folder / DIGEST).write_text(hashlib.sha256(text).hexdigest() + "\n")
    for name in (NAME, DIGEST):
        sha256(folder / name)


def sha256(path: pathlib.Path) -> str:
    """Checksum of a file, which is on the disk, not in a buffer, when this returns."""
    with path.open("rb") as file:
        os.fsync(file.fileno())
        return hashlib.file_digest(file, "sha256").hexdigest()


def read(folder: pathlib.Path) -> Manifest:
    """The manifest in `folder`.

    Raises:
      InvalidInput: it is missing, damaged, or of another layout.
    """
    for name in (NAME, DIGEST):
        if not (folder / name).is_file():
            raise damaged(folder / name, "is missing")
    text = (folder / NAME).read_bytes()
    digest = (folder / DIGEST).read_bytes().strip()
    if hashlib.sha256(text).hexdigest().encode() != digest:
        raise damaged(folder / NAME, f"does not match {DIGEST}")
    content = json.loads(text)
    if content.pop("schema") != SCHEMA:
        remedy = f"was written by vawm {content['version']}, whose layout this one cannot read"
        raise InvalidInput("checkpoint", str(folder), remedy)
    return Manifest(
        version=content["version"],
        env_steps=content["env_steps"],
        config=config_from_dict(content["config"]),
        spec=spec_from_dict(content["spec"]),
        progress=content["progress"],
        leaves={
            item: {path: _leaf_info(entry) for path, entry in leaves.items()}
            for item, leaves in content["leaves"].items()
        },
        files={path: (size, digest) for path, (size, digest) in content["files"].items()},
    )


def _obs_as_dict(obs: PyTree) -> dict[str, Any]:
    """`EnvSpec.obs`, ready for JSON: a dict of arrays is kept under "entries"."""
    if isinstance(obs, dict):
        return {"entries": {name: _obs_as_dict(entry) for name, entry in obs.items()}}
    return {"shape": list(obs.shape), "dtype": str(jnp.dtype(obs.dtype))}


def _obs_from_dict(content: dict[str, Any]) -> PyTree:
    """The inverse of `_obs_as_dict`."""
    if "entries" in content:
        return {name: _obs_from_dict(entry) for name, entry in content["entries"].items()}
    return ArraySpec(tuple(content["shape"]), jnp.dtype(content["dtype"]))


def _leaf_info(entry: dict[str, Any]) -> LeafInfo:
    return LeafInfo(tuple(entry["shape"]), entry["dtype"], entry["impl"])


def verify(folder: pathlib.Path, manifest: Manifest, item: str) -> None:
    """Compares every file of `item` with its checksum.

    Raises:
      InvalidInput: the first file that is missing, cut short or changed.
    """
    for name, (size, digest) in manifest.files.items():
        path = folder / name
        if pathlib.PurePosixPath(name).parts[0] != item:
            continue
        if not path.is_file():
            raise damaged(path, "is missing")
        if path.stat().st_size != size:
            raise damaged(path, f"has {path.stat().st_size} bytes instead of {size}")
        if sha256(path) != digest:
            raise damaged(path, "does not match its checksum")


def damaged(path: pathlib.Path, how: str) -> InvalidInput:
    """The error for a file of a checkpoint that cannot be trusted."""
    remedy = f"{how}; the checkpoint is damaged, restore it from a copy or start a new run"
    return InvalidInput("checkpoint", str(path), remedy)
