"""Whether a run fits into memory, told before anything is allocated."""

from __future__ import annotations

import math
import pathlib
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import jax

from vawm.agent import registry
from vawm.agent.registry import Activations
from vawm.config import Config, HostEnvConfig
from vawm.envs.host.crew import cores
from vawm.errors import InvalidInput, assignment
from vawm.runs import suites
from vawm.runs.checkpoint.manifest import leaf_info
from vawm.types import ArraySpec, EnvSpec, PyTree, is_image

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
"""Fixed memory of a run on a CPU: imports, XLA while it compiles, MJX.

A `quick` run of cartpole peaks at 2.5 GiB (glibc's huge pages on), of which 0.1 are its
state. Rounded up, since larger domains compile longer."""
HOST_PROCESS_BYTES = 1800 * 2**20
"""The same where environments run on the host: without MJX. Measured 1.4 to 1.7 GiB."""
COMPILER_BYTES = 400 * 2**20  # of an accelerator's memory, for its context and programs
WORKER_BYTES = 200 * 2**20
"""Of each process with environments, for imports: 100 MiB, 200 with dm_control."""
WORKING_FACTOR = 4
"""Measured per counted activation: 0.7 GB at size 1m for a batch of 16 x 64, 3.3 times
what `working_bytes` counts; rounded up."""
SAVING_COPIES = 4
"""While a checkpoint is written: what it holds, the copy that is written, that compressed, and
what the allocator keeps of the save before. Measured 3.0 for one save of random floats, 3.4 to
3.9 for four in a row, and 2.7 for bytes of 2 bits each."""
IMAGE_FACTOR = 2
"""Measured per number in the maps of images, for a batch of 16 x 64: 1.1 at size 1m, 1.7 at
12m; rounded up."""


class Estimate(NamedTuple):
    """Bytes that a run needs of one memory; `replay_capacity` is what `replay` holds, in steps.

    `where` is "device", or "host" for the memory of the machine beside an accelerator; on a
    CPU both are one, called device. `images` are those that replay keeps on the host. `copies`
    of what a checkpoint holds are in the same memory at once, see `SAVING_COPIES`.
    """

    where: str
    replay: int
    replay_capacity: int
    images: int
    params: int
    optimizer: int
    other_state: int
    working: int
    process: int
    copies: int

    @property
    def state(self) -> int:
        return self.replay + self.images + self.params + self.optimizer + self.other_state

    @property
    def total(self) -> int:
        return self.copies * self.state + self.working + self.process

    def __str__(self) -> str:
        parts = {
            "replay": self.replay,
            "images on the host": self.images,
            "parameters": self.params,
            "optimiser": self.optimizer,
            "environments and the rest": self.other_state,
            "copies of these while saving": (self.copies - 1) * self.state,
            "working memory": self.working,
            "processes": self.process,
        }
        return ", ".join(f"{name} {readable(size)}" for name, size in parts.items() if size)


def estimate(state: PyTree, spec: EnvSpec, config: Config) -> tuple[Estimate, ...]:
    """Estimates the memory of a run: exact for its state, an upper estimate for the rest.

    Args:
      state: the `TrainState`; shapes and dtypes are enough.
      spec: of the environments.
      config: of the run.
    """
    replay, params = nbytes(state.replay), nbytes(state.learner.params)
    images, optimizer = nbytes(state.images), nbytes(state.learner.opt_state)
    num_envs, per_env = state.replay.trajectory.reward.shape
    device = Estimate(
        where="device",
        replay=replay,
        replay_capacity=num_envs * per_env,
        images=0,
        params=params,
        optimizer=optimizer,
        other_state=nbytes(state) - replay - images - params - optimizer,
        working=working_bytes(spec, config) + 2 * params,  # gradient and update
        process=COMPILER_BYTES,
        copies=1,
    )
    process, host = PROCESS_BYTES, suites.host_choices(config)
    if host is not None:
        process = HOST_PROCESS_BYTES + worker_bytes(config, host)
    if jax.default_backend() == "cpu":
        return (device._replace(images=images, process=process, copies=SAVING_COPIES),)
    # The state passes through the host's memory on its way to a checkpoint.
    return device, device._replace(
        where="host", images=images, working=0, process=process, copies=SAVING_COPIES
    )


def process_bytes() -> int:
    """Fixed memory of a program on the first device."""
    return PROCESS_BYTES if jax.default_backend() == "cpu" else COMPILER_BYTES


def worker_bytes(config: Config, env: HostEnvConfig) -> int:
    """What the processes of environments on the host take."""
    workers = min(config.num_envs, env.workers or cores())
    return WORKER_BYTES * workers + suites.of(config).env_bytes * config.num_envs


def nbytes(tree: PyTree) -> int:
    """Bytes of all leaves; arrays or shapes."""
    return sum(leaf_info(leaf).nbytes for leaf in jax.tree.leaves(tree))


def working_bytes(spec: EnvSpec, config: Config) -> int:
    """Rule of thumb for the activations of one update, in bytes.

    Counts float32 numbers per replayed step (observe, forward and kept for backward) and
    per imagined state (features, actor, critic and its logits), `WORKING_FACTOR` times, and
    the maps of images, `IMAGE_FACTOR` times.
    """
    model, imagination = config.world_model, config.imagination
    steps = config.replay.batch_steps
    row = registry.kind(config.agent).activations(config, _image_size(spec))
    feature = model.deter + model.stoch * model.classes
    imagined = 2 * feature + config.actor.layers * config.actor.units + 4 * config.critic.bins
    starts = imagination.batch_size if imagination.starts == "contexts" else steps
    states = starts * (imagination.horizon + 1)
    numbers = steps * row.observed + states * imagined
    maps = _image_maps(spec, row)
    maps = max(steps * maps, _context_maps(config, maps))
    return 4 * (WORKING_FACTOR * numbers + row.cache + IMAGE_FACTOR * maps)


def _images(spec: EnvSpec) -> list[ArraySpec]:
    return [leaf for leaf in jax.tree.leaves(spec.obs) if is_image(leaf)]


def _image_size(spec: EnvSpec) -> int | None:
    """Pixels a side of the images; None where there are none."""
    images = _images(spec)
    return images[0].shape[0] if images else None


def _image_maps(spec: EnvSpec, row: Activations) -> int:
    """Numbers in the maps of encoder and decoder for the images of one step.

    They are those between the layers, and the images that are read and predicted.
    """
    return row.maps + sum(2 * math.prod(image.shape) for image in _images(spec))


def _context_maps(config: Config, maps: int) -> int:
    """The same in the encoder's maps of the contexts; a CPU has those of a few at a time."""
    imagination = config.imagination
    if imagination.starts != "contexts" or jax.default_backend() == "cpu":
        return 0
    contexts = imagination.batch_size * imagination.context_length
    return contexts * maps // (2 * IMAGE_FACTOR)  # kept once, no gradient


def available() -> dict[str, int | None]:
    """Free memory by the names of `Estimate.where`; None where it is not known."""
    return {"device": available_bytes(), "host": _available_on_host()}


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
    needed: Sequence[Estimate],
    available: Mapping[str, int | None],
    config: Config,
    *,
    smallest: int = 1,
) -> None:
    """Refuses a run that cannot fit, and names the replay that would.

    Args:
      needed: by the run, of each memory.
      available: free memory, see `available`.
      config: of the run; a short run allocates only a part of its replay.
      smallest: steps in replay with which the run could still learn.

    Raises:
      InvalidInput: with the numbers.
    """
    for need in needed:
        free = available[need.where]
        if free is not None and need.total > free:
            raise _too_large(need, free, config, smallest)


def check_policy(shapes: PyTree, config: Config) -> None:
    """Refuses parameters that do not fit, of which there are two copies while they are read.

    Raises:
      InvalidInput: with the numbers.
    """
    needed = 2 * nbytes(shapes)
    for free in available().values():
        if free is not None and needed > free:
            numbers = f"{readable(needed)} to read its parameters, {readable(free)} are free"
            remedy = f"needs {numbers}; use a machine with more memory"
            raise InvalidInput("size", config.size, remedy)


def _too_large(need: Estimate, free: int, config: Config, smallest: int) -> InvalidInput:
    whose = " in host memory" if need.where == "host" else ""
    numbers = (
        f"needs {readable(need.total)}{whose} for a run that fills {need.replay_capacity} of "
        f"it, {readable(free)} are free ({need}); "
    )
    rings = need.replay + need.images
    step = need.copies * rings / need.replay_capacity
    rest = need.total - need.copies * rings
    largest = int((free - rest) / step)
    settings: dict[str, Any] = {}
    if largest < smallest:
        remedy = "no replay is small enough: use a smaller size or batch, or fewer num_envs"
    else:
        settings["replay.capacity"] = largest
        remedy = f"use {assignment('replay.capacity', largest)} at most"
    if need.where == "device" and jax.default_backend() != "cpu" and _could_move(config):
        settings["replay.images"] = "host"
        remedy += f", or {assignment('replay.images', 'host')} if that has more memory"
    return InvalidInput("replay.capacity", config.replay.capacity, numbers + remedy, settings)


def _could_move(config: Config) -> bool:
    """Whether replay keeps images on the device that could be on the host."""
    return suites.host_choices(config) is not None and config.replay.images == "device"


def readable(size: float) -> str:
    """Bytes in the unit that suits them."""
    return f"{size / 2**30:.2f} GiB" if size >= 2**30 else f"{size / 2**20:.0f} MiB"
