"""Whether a run fits into memory, told before anything is allocated."""

from __future__ import annotations

import pathlib
from typing import NamedTuple

import jax

from vawm.config import Config
from vawm.errors import InvalidInput
from vawm.manifest import leaf_info
from vawm.types import PyTree

CGROUP_LIMITS = [
    (
        "/sys/fs/cgroup/memory.max",
        "/sys/fs/cgroup/memory.current",
        "/sys/fs/cgroup/memory.stat",
    ),
    (
        "/sys/fs/cgroup/memory/memory.limit_in_bytes",
        "/sys/fs/cgroup/memory/memory.usage_in_bytes",
        "/sys/fs/cgroup/memory/memory.stat",
    ),
]
NO_LIMIT = 2**60  # bytes; control groups print a huge number for "none"
PROCESS_BYTES = 2600 * 2**20
"""On a CPU, what a run takes whatever its size: imports, XLA while it compiles, MJX.

A `quick` run of cartpole peaks at 2.5 GiB (glibc's huge pages on), of which 0.1 are its
state. Rounded up, since larger domains compile longer."""
COMPILER_BYTES = 400 * 2**20  # of an accelerator's memory, for its context and programs
WORKING_FACTOR = 4
"""Measured per counted activation: 0.7 GB at size 1m for a batch of 16 x 64, 3.3 times
what `working_bytes` counts; rounded up."""


class Estimate(NamedTuple):
    """Bytes that a run needs; `replay_capacity` is what `replay` holds, in steps.

    `copies` of replay, parameters, optimiser and other state are in the same memory at
    once: two where a checkpoint is written from, and read into, the memory of the run.
    """

    replay: int
    replay_capacity: int
    params: int
    optimizer: int
    other_state: int
    working: int
    process: int
    copies: int

    @property
    def state(self) -> int:
        return self.replay + self.params + self.optimizer + self.other_state

    @property
    def total(self) -> int:
        return self.copies * self.state + self.working + self.process

    def __str__(self) -> str:
        parts = {
            "replay": self.replay,
            "parameters": self.params,
            "optimiser": self.optimizer,
            "environments and the rest": self.other_state,
            "a copy of these for checkpoints": (self.copies - 1) * self.state,
            "working memory": self.working,
            "the process": self.process,
        }
        return ", ".join(f"{name} {readable(size)}" for name, size in parts.items() if size)


def estimate(state: PyTree, config: Config) -> Estimate:
    """What a run takes; exact for its state, on the high side for the rest.

    Args:
      state: the `TrainState`; shapes and dtypes are enough.
      config: of the run.
    """
    replay, params = nbytes(state.replay), nbytes(state.learner.params)
    optimizer = nbytes(state.learner.opt_state)
    num_envs, per_env = state.replay.trajectory.reward.shape
    return Estimate(
        replay=replay,
        replay_capacity=num_envs * per_env,
        params=params,
        optimizer=optimizer,
        other_state=nbytes(state) - replay - params - optimizer,
        working=working_bytes(config) + 2 * params,  # gradient and update
        process=process_bytes(),
        copies=2 if jax.default_backend() == "cpu" else 1,
    )


def process_bytes() -> int:
    """What a program takes of the first device's memory, whatever the run's size."""
    return PROCESS_BYTES if jax.default_backend() == "cpu" else COMPILER_BYTES


def nbytes(tree: PyTree) -> int:
    """Bytes of all leaves; arrays or shapes."""
    return sum(leaf_info(leaf).nbytes for leaf in jax.tree.leaves(tree))


def working_bytes(config: Config) -> int:
    """Rule of thumb for the activations of one update, in bytes.

    Counts float32 numbers per replayed step (observe, forward and kept for backward) and
    per imagined state (features, actor, critic and its logits), `WORKING_FACTOR` times.
    """
    model, critic = config.world_model, config.critic
    feature = model.deter + model.stoch * model.classes
    layers = (
        model.encoder_layers
        + model.decoder_layers
        + model.reward_layers
        + model.continue_layers
        + config.actor.layers
        + critic.layers
    )
    observed = 8 * feature + 4 * (layers * model.units + model.bins + 3 * critic.bins)
    imagined = 2 * feature + config.actor.layers * config.actor.units + 4 * critic.bins
    steps = config.replay.batch_steps
    numbers = steps * (observed + (config.imagination.horizon + 1) * imagined)
    return 4 * WORKING_FACTOR * numbers


def available_bytes() -> int | None:
    """Free memory of the first device: of the accelerator, else of this machine."""
    device = jax.devices()[0]
    if device.platform == "cpu":
        return _available_on_host()
    stats = device.memory_stats() or {}
    if "bytes_limit" not in stats:
        return None
    return stats["bytes_limit"] - stats.get("bytes_in_use", 0)


def _available_on_host() -> int | None:
    limits = [_meminfo_available()]
    for maximum, usage, stat in CGROUP_LIMITS:
        limit, used = _number(maximum), _number(usage)
        if limit is not None and used is not None and limit < NO_LIMIT:
            limits.append(limit - used + _reclaimable(stat))
    known = [limit for limit in limits if limit is not None]
    return min(known) if known else None


def _meminfo_available() -> int | None:
    for line in _text("/proc/meminfo").splitlines():
        if line.startswith("MemAvailable:"):
            return int(line.split()[1]) * 1024
    return None


def _reclaimable(stat: str) -> int:
    """File pages that the kernel drops when memory is short."""
    fields = dict(line.split() for line in _text(stat).splitlines() if len(line.split()) == 2)
    return int(fields.get("inactive_file", 0)) + int(fields.get("active_file", 0))


def _number(path: str) -> int | None:
    text = _text(path).strip()
    return int(text) if text.isdigit() else None


def _text(path: str) -> str:
    try:
        return pathlib.Path(path).read_text()
    except OSError:
        return ""


def check(
    needed: Estimate, available: int | None, *, configured: int, smallest: int = 1
) -> None:
    """Refuses a run that cannot fit, and names the replay that would.

    Args:
      needed: by the run.
      available: free memory, None where that is not known.
      configured: `replay.capacity`, of which a short run allocates only a part.
      smallest: steps in replay with which the run could still learn.

    Raises:
      InvalidInput: with the numbers.
    """
    if available is None or needed.total <= available:
        return
    numbers = (
        f"needs {readable(needed.total)} for a run that fills {needed.replay_capacity} of it, "
        f"{readable(available)} are free ({needed}); "
    )
    step = needed.copies * needed.replay / needed.replay_capacity
    rest = needed.total - needed.copies * needed.replay
    largest = int((available - rest) / step)
    if largest < smallest:
        remedy = "no replay is small enough: use a smaller size or batch, or fewer num_envs"
    else:
        remedy = f"use replay.capacity={largest} at most"
    raise InvalidInput("replay.capacity", configured, numbers + remedy)


def readable(size: float) -> str:
    """Bytes in the unit that suits them."""
    return f"{size / 2**30:.2f} GiB" if size >= 2**30 else f"{size / 2**20:.0f} MiB"
