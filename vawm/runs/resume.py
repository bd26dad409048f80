"""Resumes a run: the same choices, the same state, possibly more steps."""

from __future__ import annotations

import os
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from vawm.config import CUSTOM, Config
from vawm.envs import made as records
from vawm.errors import InvalidInput
from vawm.learning.replay import Replay
from vawm.runs import checkpoint, run_folder, settings, validate
from vawm.runs.checkpoint import manifest
from vawm.runs.checkpoint.manifest import Manifest, OtherVersion
from vawm.runs.reports import tracking
from vawm.types import EnvSpec, Made, PyTree

MAY_DIFFER = (
    "env_steps",
    "log_every",
    "save_every",
    "save_minutes",
    "keep_checkpoints",
    "video.every",
    "video.sequences",
    "video.context",
    "video.episode_steps",
    "env.workers",
    "env.timeout",
    "env.on_failure",
    "tracker",
    "tracker_project",
    "tracker_group",
    "tracker_tags",
)
"""Fields that may differ: they change neither what a run learns nor what it has stored."""


def saved_config(logdir: str | os.PathLike[str]) -> Config:
    """The config of the run in `logdir`, from its newest checkpoint or from its start.

    Raises:
      InvalidInput: `logdir` is not the folder of a run, or its checkpoints are damaged.
    """
    if checkpoint.latest(logdir) is None:
        started = run_folder.read_config(checkpoint.expanded(logdir))
        if started is not None:
            return started
    return checkpoint.find(logdir, ()).manifest.config


def saved_spec(logdir: str | os.PathLike[str]) -> EnvSpec | None:
    """The environments of the run in `logdir`; None before its first checkpoint."""
    if checkpoint.latest(logdir) is None:
        return None
    return checkpoint.find(logdir, ()).manifest.spec


def saved_made(logdir: str | os.PathLike[str]) -> Made | None:
    """How the environments of the run in `logdir` were made; None in an earlier version's."""
    spec = saved_spec(logdir)
    if spec is None:
        return run_folder.read_made(checkpoint.expanded(logdir))
    return spec.made


def check_environments(logdir: str | os.PathLike[str], spec: EnvSpec) -> list[str]:
    """Refuses to resume the run in `logdir` in environments of `spec` if they are others.

    Returns:
      Warnings about what may differ between equal environments.

    Raises:
      InvalidInput: the observations, the actions, their number, or how they were made.
    """
    then = saved_spec(logdir) or spec._replace(made=saved_made(logdir))
    warnings = []
    for name, saved, now, grave in records.differences(then, spec):
        if grave:
            remedy = f"the run was started with {saved!r}; resume it in the same environments"
            raise InvalidInput(f"env.{name}", now, remedy)
        warnings.append(
            f"the environments' {name} was {saved!r} when the run started, now {now!r}"
        )
    return warnings


def check(logdir: str | os.PathLike[str], config: Config) -> None:
    """Refuses to resume the run in `logdir` with `config` if that cannot work.

    Raises:
      InvalidInput: there is no run, its checkpoints are missing, another version wrote
        them, a choice or the generator of random numbers differs, or the run is complete.
    """
    started = saved_config(logdir)
    path = checkpoint.latest(logdir)
    if path is None:
        _refuse_to_lose(logdir, started)
    else:
        found = checkpoint.find(logdir, ())
        _refuse_another_version(found)
        infos = found.manifest.leaves.get("state", {}).values()
        settings.check_keys({info.impl for info in infos if info.impl})
    saved = dict(validate.values(started))
    choices = list(validate.values(config))
    if config.size == CUSTOM:  # check size last, to name the width that differs instead
        choices.sort(key=lambda choice: choice[0] == "size")
    whose = "the checkpoint was trained" if path else "the run was started"
    for name, value in choices:
        if name not in MAY_DIFFER and value != saved[name]:
            remedy = f"{whose} with {saved[name]!r}; use that to resume"
            raise InvalidInput(name, value, remedy)
    if path and config.env_steps <= int(path.name):
        # The run is complete, unless its newest checkpoint is damaged.
        done = checkpoint.find(logdir).manifest.env_steps
        if config.env_steps > done:
            return
        remedy = f"the checkpoint is already at {done}; use a larger number to continue"
        raise InvalidInput("env_steps", config.env_steps, remedy)


def _refuse_another_version(found: checkpoint.Found) -> None:
    """Refuses to resume a run of another version, even if it can be read.

    Raises:
      OtherVersion: versions may compute differently, and no metric would show it.
    """
    written = found.manifest.version
    if written != manifest.version():
        why = "a run must be resumed with the version that started it"
        raise OtherVersion("checkpoint", found.path, why, written=written)


def _refuse_to_lose(logdir: str | os.PathLike[str], started: Config) -> None:
    """Refuses to restart a run without checkpoints if it should have saved one.

    Restarting would delete its metrics.

    Raises:
      InvalidInput: a line records a checkpoint, or the metrics reach the env steps of the
        first one.
    """
    folder = checkpoint.expanded(logdir)
    saves = tracking.read(folder / tracking.SAVE_LINES)
    lines = tracking.read(folder / tracking.METRICS) + saves
    reached = max((line["env_steps"] for line in lines), default=0)
    if not saves and reached < min(started.save_every, started.env_steps):
        return
    remedy = (
        f"has no checkpoints, but metrics of {reached} env steps; choose another --logdir, or "
        "start over with --fresh, which keeps the old files in a subfolder"
    )
    raise InvalidInput("logdir", str(logdir), remedy)


def cut_back(logdir: str | os.PathLike[str], *, env_steps: int, logged: int) -> str | None:
    """Drops the lines that a run resumed at `env_steps` will write again.

    Args:
      logdir: folder of the run.
      env_steps: of the checkpoint.
      logged: env steps of the last line of metrics before the checkpoint.

    Returns:
      A warning about missing or damaged lines among the earlier ones, or None.

    Raises:
      OSError: a file cannot be written; it is unchanged.
    """
    folder = checkpoint.expanded(logdir)
    damaged = tracking.truncate(folder / tracking.METRICS, logged)
    for name in (tracking.VIDEO_LINES, tracking.SAVE_LINES):
        tracking.truncate(folder / name, env_steps)
    lines = tracking.read(folder / tracking.METRICS)
    reached = lines[-1]["env_steps"] if lines else 0
    if reached < logged:
        return (
            f"{tracking.METRICS} ends at {reached} env steps, but the checkpoint continues "
            f"from {logged}: the lines in between are lost"
        )
    if damaged:
        return f"dropped {damaged} damaged lines of {tracking.METRICS}"
    return None


class Restored(NamedTuple):
    """The content of the checkpoint that a run resumes from.

    Attributes:
      state: the `TrainState`.
      episodes: the running episodes of environments on the host, or None.
      manifest: of the checkpoint.
      warning: a line about newer checkpoints that are damaged and were renamed, or None.
    """

    state: PyTree
    episodes: dict[str, np.ndarray] | None
    manifest: Manifest
    warning: str | None


def restore(logdir: str | os.PathLike[str], shapes: PyTree) -> Restored:
    """Reads the newest undamaged checkpoint; `shapes` are those of the run's initial state.

    If an extended run needs a larger replay than was saved, the replay grows. Renames newer
    checkpoints, which are damaged.

    Raises:
      InvalidInput: all are damaged, or belong to another run; nothing was changed.
      OSError: a damaged one cannot be renamed.
    """
    found = checkpoint.find(logdir)
    state, episodes = _read(found, shapes), checkpoint.read_episodes(found)
    for path, _ in found.damaged:
        checkpoint.set_aside(path)
    return Restored(state, episodes, found.manifest, checkpoint.warning(found))


def _read(found: checkpoint.Found, shapes: PyTree) -> PyTree:
    saved = found.manifest.leaves.get("state", {}).get(".replay.trajectory.reward")
    wanted = shapes.replay.trajectory.reward.shape[1]
    capacity = saved.shape[1] if saved else wanted
    target = shapes._replace(
        replay=_with_capacity(shapes.replay, capacity),
        images=_with_capacity(shapes.images, capacity),
    )
    state = checkpoint.read_state(found, target)
    if wanted > capacity:
        state = state._replace(
            replay=grow(state.replay, wanted),
            images=grow_images(state.images, state.replay, wanted),
        )
    return state


def _with_capacity(rings: PyTree, capacity: int) -> PyTree:
    """Replaces C in shapes `[N, C, ...]`; keeps counters and empty arrays."""

    def reshape(x: jax.ShapeDtypeStruct) -> jax.ShapeDtypeStruct:
        if x.ndim < 2 or not x.shape[1]:
            return x
        return jax.ShapeDtypeStruct((x.shape[0], capacity, *x.shape[2:]), x.dtype)

    return jax.tree.map(reshape, rings)


def grow(replay: Replay, capacity: int) -> Replay:
    """Moves the steps to a larger buffer, the oldest first."""
    old = replay.trajectory.reward.shape[1]

    def pad(x: jax.Array) -> jax.Array:
        widths = [(0, 0), (0, capacity - old)] + [(0, 0)] * (x.ndim - 2)
        return jnp.pad(jnp.roll(x, -_oldest(replay), axis=1), widths)

    return Replay(
        trajectory=jax.tree.map(pad, replay.trajectory),
        latent=jax.tree.map(pad, replay.latent),
        head=replay.size % capacity,
        size=replay.size,
    )


def grow_images(images: PyTree, replay: Replay, capacity: int) -> PyTree:
    """Moves the images of `replay`, in host memory, as `grow` moves its steps."""

    def pad(x: np.ndarray) -> np.ndarray:
        if not x.size:
            return x
        larger = np.zeros((x.shape[0], capacity, *x.shape[2:]), x.dtype)
        larger[:, : x.shape[1]] = np.roll(x, -_oldest(replay), axis=1)
        return larger

    return jax.tree.map(pad, images)


def _oldest(replay: Replay) -> int:
    """Index of the oldest step."""
    return (int(replay.head) - int(replay.size)) % replay.trajectory.reward.shape[1]
