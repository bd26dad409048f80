"""What is known of a run whose loss is not finite, for whoever looks for the reason."""

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


def first_nonfinite(metrics: Mapping[str, Any]) -> str | None:
    """The name of the first loss of a chunk that is not finite; None if all are, or it had
    no update."""
    if not int(metrics["chunk/updates"]):
        return None
    losses = (name for name in metrics if name.startswith("loss/"))
    return next((name for name in losses if not math.isfinite(metrics[name])), None)


def write(
    logdir: pathlib.Path, config: Config, state: TrainState, metrics: Mapping[str, Any]
) -> pathlib.Path:
    """Writes `diagnosis.json` about the chunk that led to `state` and measured `metrics`.

    It names the loss and its value, env steps and updates, the optimiser's choices, every
    metric of the chunk that is not finite, the last line of metrics whose losses are all
    finite, the parameters that are not finite, and what replay holds that is not, or waits
    to be stored: that came from the environments, or from the policy.

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
    }
    path = logdir / FILE
    path.write_text(json.dumps(content, indent=2) + "\n")
    return path


def reason(state: TrainState, metrics: Mapping[str, Any], *, last: bool) -> str | None:
    """Why a run cannot go on after the chunk that led to `state`; None if it can.

    What an environment returned or was sent and is not finite: it would be saved with replay,
    and be learned from one day. A loss; after the `last` chunk also a parameter: no loss of a
    next update would tell.
    """
    if int(metrics["chunk/nonfinite"]):
        first = _first(nonfinite_steps(state))
        acted = first is not None and _is_action(first)
        return f"{'an action' if acted else 'what an environment returned'} is not finite"
    if loss := first_nonfinite(metrics):
        return f"{loss} is {float(metrics[loss])}"
    if last and (params := nonfinite_parameters(state)):
        return f"parameter {params[0]} is not finite"
    return None


def nonfinite_parameters(state: TrainState) -> list[str]:
    """Paths of the parameters that are not finite, and of the world model's own state."""
    learner = state.learner
    leaves = checkpoint.flatten(learner.params) | checkpoint.flatten(learner.model_state)
    return [name for name, x in leaves.items() if not _is_finite(x)]


def last_finite_line(logdir: pathlib.Path) -> Line | None:
    """The last line of metrics that has losses, all of them finite."""
    for line in reversed(tracking.read(logdir / METRICS)):
        losses = [value for name, value in line.items() if name.startswith("loss/")]
        if losses and None not in losses:  # null is what is not finite
            return line
    return None


def nonfinite_steps(state: TrainState) -> list[dict[str, Any]]:
    """Per field of the trajectory where it is not finite: in which environment first, how many
    steps of that environment ago, and in how many steps of all.

    Counted back from the newest step in replay, which is 0 steps ago; what has arrived since
    and waits to be stored is -1 steps ago. One reduction to `[N, C]` each.
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
    """An entry for every field of `steps`, `[N, C, ...]`, of which `ago` is the age, `[C]`."""
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


def advice(state: TrainState) -> str:
    """What to do about a run that has come to `state`, in one sentence."""
    first = _first(nonfinite_steps(state))
    if first is None or _is_action(first):
        return "Start again with a smaller --optimizer.learning-rate or another --seed"
    ago = f"{first['steps_ago'] + 1} steps before the newest"
    return f"{where(first)}, {ago}: mend what returned it, then go on with --resume"


def where(found: Mapping[str, Any]) -> str:
    """An entry of `nonfinite_steps`, in words."""
    if _is_action(found):
        return f"an action of environment {found['environment']} is not finite"
    return f"environment {found['environment']} returned {found['field']} that is not finite"


def _first(found: list[dict[str, Any]]) -> dict[str, Any] | None:
    """The first of `nonfinite_steps`: the cause of the others. Actions follow what they see."""
    return max(found, key=lambda x: (x["steps_ago"], not _is_action(x)), default=None)


def _is_action(found: Mapping[str, Any]) -> bool:
    return found["field"].startswith("action")


@jax.jit
def _finite_steps(x: Array) -> Array:
    return jnp.isfinite(x).all(range(2, x.ndim))


def _is_finite(x: Array) -> bool:
    return bool(jnp.isfinite(x).all())
