"""Checkpoints of the complete state of a run, checked file by file and leaf by leaf.

    <logdir>/checkpoints/<env_steps>/
        params/          Orbax: the parameters, needed to act
        model_state/     Orbax: the world model's state besides them, if it has one
        state/           Orbax: everything else (optimiser, replay, environments, keys, ...)
        images/          Orbax: replayed images, if they are kept on the host
        episodes/        Orbax: the running episodes of environments on the host
        manifest.json    config, environment spec, counters, leaves, SHA-256 of every file
        manifest.sha256
    <logdir>/checkpoints/damaged-<env_steps>/     damaged, renamed by a resumed run

A checkpoint is written under a temporary name, opened as a restore would, and renamed. Then
older ones are deleted, except the newest `Config.keep_checkpoints`, so a complete one always
exists.
Reading compares checksums first. If the newest checkpoint is damaged, the newest undamaged one
is used, with a warning.

Orbax ignores the target's shape and casts dtypes silently, so before anything is allocated
every leaf is compared with the manifest, and the manifest with what Orbax finds. Leaves are
stored flat, named by their path in the tree. Typed PRNG keys are stored as their data; empty
arrays, which Orbax refuses, are stored only in the manifest. Nothing is ever unpickled.
"""

from vawm.runs.checkpoint.folders import (
    DAMAGED,
    SCRATCH,
    complete,
    expanded,
    kept,
    latest,
    root,
    set_aside,
)
from vawm.runs.checkpoint.leaves import flatten, unflatten
from vawm.runs.checkpoint.reading import (
    ACTING,
    Found,
    find,
    read_agent,
    read_episodes,
    read_manifest,
    read_state,
    restore,
    restore_agent,
    restore_episodes,
    usable,
    warning,
)
from vawm.runs.checkpoint.saver import Saver
from vawm.runs.checkpoint.snapshot import Snapshot, take
from vawm.runs.checkpoint.writing import SaveError, Written, free_space, save, write

__all__ = [
    "ACTING",
    "DAMAGED",
    "SCRATCH",
    "Found",
    "SaveError",
    "Saver",
    "Snapshot",
    "Written",
    "complete",
    "expanded",
    "find",
    "flatten",
    "free_space",
    "kept",
    "latest",
    "read_agent",
    "read_episodes",
    "read_manifest",
    "read_state",
    "restore",
    "restore_agent",
    "restore_episodes",
    "root",
    "save",
    "set_aside",
    "take",
    "unflatten",
    "usable",
    "warning",
    "write",
]
