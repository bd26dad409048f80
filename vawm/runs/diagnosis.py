"""Finds the cause of losses that are not finite, and writes it to `diagnosis.json`."""

from __future__ import annotations

import dataclasses
import json
import math
import pathlib
from collections.abc import Iterator, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from vawm.config import Config
from vawm.learning.train import TrainState
from vawm.runs import checkpoint
from vawm.runs.reports import tracking
from vawm.runs.reports.tracking import METRICS, Line
from vawm.types import Array, PyTree

FILE = "diagnosis.json"
LARGEST = float(np.finfo(np.float32).max)


def first_nonfinite(metrics: Mapping[str, Any]) -> str | None:
    """The name of a chunk's first loss that is not finite.

    None if all losses are finite or the chunk had no update.
    """
    if not int(metrics["chunk/updates"]):
        return None
    losses = (name for name in metrics if name.startswith("loss/"))
    return next((name for name in losses if not math.isfinite(metrics[name])), None)


def write(
    logdir: pathlib.Path, config: Config, state: TrainState, metrics: Mapping[str, Any]
) -> pathlib.Path:
    """Writes `diagnosis.json` about the chunk that led to `state` and measured `metrics`.

    It has the loss and its value, env steps and updates, the optimiser's choices, the last
    line of metrics with finite losses, and everything that is not finite: metrics of the
    chunk, parameters, and steps in replay or not yet stored, which came from the
    environments or from the policy. It also has the largest reward in replay: beyond what
    returns can hold in float32, finite rewards are the cause.

    Raises:
      OSError: it cannot be written.
    """
    loss = first_nonfinite(metrics)
    broken = {name: str(float(x)) for name, x in metrics.items() if not math.isfinite(x)}
    content = {
        "loss": loss,
        "value": broken.get(str(loss)),
        "env_steps": int(metrics["env_steps"]),
        "updates": int(metrics["updates"]),
        "optimizer": dataclasses.asdict(config.optimizer),
        "nonfinite_metrics": broken,
        "last_finite_line": last_finite_line(logdir),
        "nonfinite_parameters": nonfinite_parameters(state),
        "nonfinite_replay": nonfinite_steps(state),
        "largest_reward": largest_reward(state),
    }
    path = logdir / FILE
    path.write_text(json.dumps(content, indent=2) + "\n")
    return path


def reason(state: TrainState, metrics: Mapping[str, Any], *, last: bool) -> str | None:
    """Why a run must stop after the chunk that led to `state`; None if it can continue.

    It must stop if a value from an environment or an action is not finite, because training
    would later read it from replay; if a loss is not finite; and, after the `last` chunk, if
    a parameter is not finite, because no later loss would show it.
    """
    if int(metrics["chunk/nonfinite"]):
        first = _first(nonfinite_steps(state))
        acted = first is not None and _is_action(first)
        return f"{'an action' if acted else 'a value from an environment'} is not finite"
    if loss := first_nonfinite(metrics):
        return f"{loss} is {float(metrics[loss])}"
    if last and (params := nonfinite_parameters(state)):
        return f"parameter {params[0]} is not finite"
    return None


def nonfinite_parameters(state: TrainState) -> list[str]:
    """Paths of the parameters, and of the world model's state, that are not finite."""
    learner = state.learner
    leaves = checkpoint.flatten(learner.params) | checkpoint.flatten(learner.model_state)
    return [name for name, x in leaves.items() if not _is_finite(x)]


def last_finite_line(logdir: pathlib.Path) -> Line | None:
    """The last line of metrics with losses that are all finite."""
    for line in reversed(tracking.read(logdir / METRICS)):
        losses = [value for name, value in line.items() if name.startswith("loss/")]
        if losses and None not in losses:  # None: not finite
            return line
    return None


def nonfinite_steps(state: TrainState) -> list[dict[str, Any]]:
    """The fields of the trajectory that are not finite, one entry each.

    An entry has the environment with the oldest such step, the age of that step in steps of
    that environment, and the number of such steps in all environments. The newest step in
    replay is 0 steps ago; one that waits to be stored is -1 steps ago. Costs one reduction
    to `[N, C]` per field.
    """
    replay = state.replay
    capacity = replay.trajectory.reward.shape[1]
    ago = (int(replay.head) - 1 - np.arange(capacity)) % capacity
    waiting = jax.tree.map(lambda x: x[:, None], state.collector.timestep)
    return [
        *_nonfinite(replay.trajectory, ago),
        *_nonfinite(waiting, np.array([-1])),
    ]


def _nonfinite(steps: PyTree, ago: np.ndarray) -> Iterator[dict[str, Any]]:
    """Entries for the fields of `steps` `[N, C, ...]`, whose age is `ago` `[C]`."""
    for name, leaf in checkpoint.flatten(steps).items():
        if not jnp.issubdtype(leaf.dtype, jnp.floating) or not leaf.size:
            continue
        envs, slots = np.nonzero(~np.asarray(_finite_steps(leaf)))
        if not len(envs):
            continue
        oldest = int(np.argmax(ago[slots]))
        yield {
            "field": name.lstrip("."),
            "environment": int(envs[oldest]),
            "steps_ago": int(ago[slots[oldest]]),
            "steps": len(envs),
        }


def largest_reward(state: TrainState) -> dict[str, Any]:
    """The finite reward in replay of the largest magnitude, and its environment."""
    rewards = np.asarray(state.replay.trajectory.reward)
    sizes = np.where(np.isfinite(rewards), np.abs(rewards), 0.0)
    env, slot = np.unravel_index(int(np.argmax(sizes)), sizes.shape)
    return {"environment": int(env), "reward": float(rewards[env, slot])}


def advice(state: TrainState, config: Config) -> str:
    """One sentence on what to do about a run of `config` that stopped at `state`."""
    first, largest = _first(nonfinite_steps(state)), largest_reward(state)
    most = LARGEST / config.imagination.discount_horizon
    if first is None and abs(largest["reward"]) > most:
        return (
            f"environment {largest['environment']} gave a reward of {largest['reward']:.3g}: "
            f"returns, sums of rewards, hold at most {LARGEST:.2g} in float32, so rewards must "
            f"stay below {most:.2g}; scale the rewards of the environment, and start again"
        )
    if first is None or _is_action(first):
        return "Start again with a smaller --optimizer.learning-rate or another --seed"
    ago = f"{first['steps_ago'] + 1} steps before the newest"
    return f"{where(first)}, {ago}; fix the environment, then continue with --resume"


def where(found: Mapping[str, Any]) -> str:
    """Describes an entry of `nonfinite_steps`."""
    if _is_action(found):
        return f"an action of environment {found['environment']} is not finite"
    return f"{found['field']} from environment {found['environment']} is not finite"


def _first(found: list[dict[str, Any]]) -> dict[str, Any] | None:
    """The oldest of `nonfinite_steps`, the likely cause; observations come before actions."""
    return max(found, key=lambda x: (x["steps_ago"], not _is_action(x)), default=None)


def _is_action(found: Mapping[str, Any]) -> bool:
    return found["field"].startswith("action")


@jax.jit
def _finite_steps(x: Array) -> Array:
    return jnp.isfinite(x).all(range(2, x.ndim))


def _is_finite(x: Array) -> bool:
    return bool(jnp.isfinite(x).all())
