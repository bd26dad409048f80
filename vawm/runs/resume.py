"""Continuing a run: the same choices, the same state, perhaps more steps."""

from __future__ import annotations

import os
import pathlib
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from vawm.config import CUSTOM, Config
from vawm.errors import InvalidInput
from vawm.learning.replay import Replay
from vawm.runs import checkpoint, run_folder, validate
from vawm.runs.checkpoint import manifest as manifest_lib
from vawm.runs.checkpoint.manifest import Manifest
from vawm.runs.reports import tracking
from vawm.types import PyTree

MAY_DIFFER = (
    *("env_steps", "log_every", "save_every", "save_minutes", "keep_checkpoints"),
    *("video.every", "video.sequences", "video.context", "video.episode_steps"),
    *("env.workers", "env.timeout", "env.on_failure"),
    *("tracker", "tracker_project"),
)
"""What changes neither what a run learns nor what it has stored."""


def saved_config(logdir: str | os.PathLike[str]) -> Config:
    """The choices of the run in `logdir`: of its newest checkpoint, or as it was started.

    Raises:
      InvalidInput: the folder is not that of a run, or its checkpoints are damaged.
    """
    if checkpoint.latest(logdir) is None:
        started = run_folder.read_config(pathlib.Path(logdir).expanduser())
        if started is not None:
            return started
    return checkpoint.find(logdir, ()).manifest.config


def check(logdir: str | os.PathLike[str], config: Config) -> None:
    """Whether the run in `logdir` can be continued as `config`.

    Raises:
      InvalidInput: there is none, its checkpoints are gone, another version wrote them, a
        choice differs, or there is nothing left to do.
    """
    started = saved_config(logdir)
    path = checkpoint.latest(logdir)
    if path is None:
        _refuse_to_lose(logdir, started)
    else:
        _refuse_another_version(checkpoint.find(logdir, ()))
    saved = dict(validate.values(started))
    choices = list(validate.values(config))
    if config.size == CUSTOM:  # the width that differs says more, so its name comes last
        choices.sort(key=lambda choice: choice[0] == "size")
    whose = "the checkpoint was trained" if path else "the run was started"
    for name, value in choices:
        if name not in MAY_DIFFER and value != saved[name]:
            remedy = f"{whose} with {saved[name]!r}; use that to resume"
            raise InvalidInput(name, value, remedy)
    if path and config.env_steps <= int(path.name):
        # It is as far as it should be; unless that checkpoint is damaged.
        done = checkpoint.find(logdir).manifest.env_steps
        if config.env_steps > done:
            return
        remedy = f"the checkpoint is at {done} already; use more to continue it"
        raise InvalidInput("env_steps", config.env_steps, remedy)


def _refuse_another_version(found: checkpoint.Found) -> None:
    """Refuses to go on with what another version began, though it could be read.

    Raises:
      OtherVersion: a version may compute otherwise, and no metric would tell.
    """
    written = found.manifest.version
    if written != manifest_lib.version():
        why = "a run goes on with the version that began it"
        raise manifest_lib.OtherVersion("checkpoint", found.path, why, written=written)


def _refuse_to_lose(logdir: str | os.PathLike[str], started: Config) -> None:
    """Refuses to start a run over, and its metrics, if it should have saved a checkpoint.

    Raises:
      InvalidInput: a line tells of a checkpoint, or its metrics reach the first one that was
        due by its steps.
    """
    folder = pathlib.Path(logdir).expanduser()
    saves = tracking.read(folder / tracking.SAVE_LINES)
    lines = tracking.read(folder / tracking.METRICS) + saves
    reached = max((line["env_steps"] for line in lines), default=0)
    if not saves and reached < min(started.save_every, started.env_steps):
        return
    remedy = (
        f"its checkpoints are gone or were never written, and starting over would lose the "
        f"metrics of {reached} env steps; choose another --logdir, or start over with --fresh"
    )
    raise InvalidInput("logdir", str(logdir), remedy)


def cut_back(logdir: str | os.PathLike[str], *, env_steps: int, logged: int) -> str | None:
    """Drops the lines of what a run that goes on from `env_steps` will do again.

    Args:
      logdir: its folder.
      env_steps: of the checkpoint.
      logged: env steps of the last line of metrics that was written before it.

    Returns:
      A line about metrics that are missing among those that stay; None without any.

    Raises:
      OSError: a file cannot be written; it is as it was.
    """
    folder = pathlib.Path(logdir).expanduser()
    damaged = tracking.truncate(folder / tracking.METRICS, logged)
    for name in (tracking.VIDEO_LINES, tracking.SAVE_LINES):
        tracking.truncate(folder / name, env_steps)
    lines = tracking.read(folder / tracking.METRICS)
    reached = lines[-1]["env_steps"] if lines else 0
    if reached < logged:
        return (
            f"{tracking.METRICS} ends at {reached} env steps and the checkpoint goes on from "
            f"{logged}: the lines between are lost"
        )
    if damaged:
        return f"{damaged} damaged lines of {tracking.METRICS} are left out"
    return None


class Restored(NamedTuple):
    """What a run goes on from.

    Attributes:
      state: the `TrainState`.
      episodes: what environments on the host did since their last reset; None without any.
      manifest: of the checkpoint.
      warning: a line about newer checkpoints, which are damaged and were set aside.
    """

    state: PyTree
    episodes: dict[str, np.ndarray] | None
    manifest: Manifest
    warning: str | None


def restore(logdir: str | os.PathLike[str], shapes: PyTree) -> Restored:
    """The newest whole checkpoint; `shapes` is what the run would start with otherwise.

    A run that is extended may want a larger replay than was saved: it is grown. Newer
    checkpoints that are damaged are renamed.

    Raises:
      InvalidInput: all are damaged, or not of this run; nothing was changed.
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
    """Shapes `[N, C, ...]` with another C; counters and empty arrays stay as they are."""

    def reshape(x: jax.ShapeDtypeStruct) -> jax.ShapeDtypeStruct:
        if x.ndim < 2 or not x.shape[1]:
            return x
        return jax.ShapeDtypeStruct((x.shape[0], capacity, *x.shape[2:]), x.dtype)

    return jax.tree.map(reshape, rings)


def grow(replay: Replay, capacity: int) -> Replay:
    """The same steps in a larger buffer, the oldest first."""
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
    """The images of `replay` as `grow` moves its steps, in host memory."""

    def pad(x: np.ndarray) -> np.ndarray:
        if not x.size:
            return x
        larger = np.zeros((x.shape[0], capacity, *x.shape[2:]), x.dtype)
        larger[:, : x.shape[1]] = np.roll(x, -_oldest(replay), axis=1)
        return larger

    return jax.tree.map(pad, images)


def _oldest(replay: Replay) -> int:
    """Where the oldest step lies."""
    return (int(replay.head) - int(replay.size)) % replay.trajectory.reward.shape[1]
