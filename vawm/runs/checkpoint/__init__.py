"""Checkpoints: the whole of a run's state, checked file by file and leaf by leaf.

    <logdir>/checkpoints/<env_steps>/
        params/          Orbax: what is needed to act
        model_state/     Orbax: and what the world model carries beside it, if anything
        state/           Orbax: everything else (optimiser, replay, environments, keys, ...)
        images/          Orbax: replayed images, where they are kept on the host
        episodes/        Orbax: what environments on the host did since their last reset
        manifest.json    config, environment spec, counters, leaves, SHA-256 of every file
        manifest.sha256
    <logdir>/checkpoints/damaged-<env_steps>/     one that a resumed run has set aside

A checkpoint is written under a temporary name and renamed when it is complete, and older
ones are deleted after that, all but `Config.keep_checkpoints`, so a complete one exists at
every moment. What is read is compared with its checksums first; where the newest is damaged,
the newest one that is whole takes its place, with a warning.

Orbax ignores the target's shape and casts dtypes silently, so every leaf is compared with
the manifest, and the manifest with what Orbax finds, before anything is allocated. Leaves
are stored flat, named by their path in the tree; typed PRNG keys are stored as their data,
and empty arrays, which Orbax refuses, in the manifest alone. Nothing is ever unpickled.
"""

from vawm.runs.checkpoint.folders import (
    DAMAGED,
    SCRATCH,
    complete,
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
