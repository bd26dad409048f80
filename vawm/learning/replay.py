"""A ring buffer of experience that lives on the device.

Every leaf is `[N, C, ...]`: N streams, one per environment, of C steps each. A sample is a run
of consecutive steps of one stream. It may cross the end of an episode, but never the write
head. Beside each step, replay keeps what the world model remembers there (`WorldModel.memory`),
such as the inferred latent, or `()`. A sample starts from what is kept beside its first step,
and updates write back what they infer.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from vawm.types import Array, Batch, EnvSpec, Key, PyTree, Trajectory


class Replay(NamedTuple):
    trajectory: Trajectory  # [N, C, ...]
    latent: PyTree  # [N, C, ...] what is kept beside a step
    head: Array  # [] int32, where the next step is written
    size: Array  # [] int32, steps held in each stream


class Positions(NamedTuple):
    """Where a sample is: arrays of jax or of numpy."""

    env: Any  # [B] int32
    time: Any  # [B, L] int32


def capacity_per_env(
    capacity: int, spec: EnvSpec, *, env_steps: int, collect_steps: int
) -> int:
    """Steps to keep of each environment: its share, but never more than a run collects.

    Args:
      capacity: steps of all environments together.
      spec: of the environment; every full episode adds a reset to its control steps.
      env_steps: control steps of the run.
      collect_steps: K, the number of steps in a chunk; a run collects whole chunks.
    """
    calls = -(-env_steps // (spec.num_envs * spec.action_repeat))
    resets = 0 if spec.episode_length is None else calls // spec.episode_length + 1
    collected = -(-(calls + resets) // collect_steps) * collect_steps
    return max(1, min(capacity // spec.num_envs, collected))


def init(example: Trajectory, latent: PyTree, *, capacity: int) -> Replay:
    """An empty buffer for steps like `example` and `latent`, each `[N, ...]`."""

    def empty(x):
        return jnp.zeros((x.shape[0], capacity, *x.shape[1:]), x.dtype)

    return Replay(
        trajectory=jax.tree.map(empty, example),
        latent=jax.tree.map(empty, latent),
        head=jnp.zeros((), jnp.int32),
        size=jnp.zeros((), jnp.int32),
    )


def add(replay: Replay, trajectory: Trajectory, latent: PyTree) -> Replay:
    """Append K steps `[N, K, ...]` to every stream; the oldest are overwritten."""
    capacity = replay.trajectory.reward.shape[1]
    length = trajectory.reward.shape[1]
    if length > capacity:
        raise ValueError(f"cannot add {length} steps to a buffer of {capacity}")
    time = (replay.head + jnp.arange(length, dtype=jnp.int32)) % capacity

    def write(buffer, x):
        return buffer.at[:, time].set(x.astype(buffer.dtype))

    return Replay(
        trajectory=jax.tree.map(write, replay.trajectory, trajectory),
        latent=jax.tree.map(write, replay.latent, latent),
        head=(replay.head + length) % capacity,
        size=jnp.minimum(replay.size + length, capacity),
    )


def num_starts(replay: Replay, length: int) -> Array:
    """The number of places, in all streams, where a sample of `length` steps can start."""
    num_envs = replay.trajectory.reward.shape[0]
    return num_envs * jnp.maximum(replay.size - length + 1, 0)


def draw(replay: Replay, key: Key, *, batch_size: int, length: int) -> Positions:
    """`batch_size` runs of `length` steps, uniform over all possible starts.

    Needs `num_starts(replay, length) > 0`.
    """
    num_envs, capacity = replay.trajectory.reward.shape
    key_env, key_start = jax.random.split(key)
    env = jax.random.randint(key_env, (batch_size,), 0, num_envs, jnp.int32)
    last = replay.size - length + 1
    start = jax.random.randint(key_start, (batch_size,), 0, last, jnp.int32)
    oldest = replay.head - replay.size
    time = (oldest + start[:, None] + jnp.arange(length, dtype=jnp.int32)[None, :]) % capacity
    return Positions(env, time)


def draw_on_host(
    rng: np.random.Generator,
    num_envs: int,
    capacity: int,
    head: int,
    size: int,
    *,
    batch_size: int,
    length: int,
) -> Positions:
    """As `draw`, with numpy and without the arrays of replay."""
    env = rng.integers(num_envs, size=batch_size)
    start = rng.integers(size - length + 1, size=batch_size)
    time = (head - size + start[:, None] + np.arange(length)[None, :]) % capacity
    return Positions(env.astype(np.int32), time.astype(np.int32))


def read(replay: Replay, positions: Positions) -> Batch:
    """The steps at `positions`, `[B, L, ...]`, and what is kept beside the first of each."""
    env, time = positions
    trajectory = jax.tree.map(lambda x: x[env[:, None], time], replay.trajectory)
    context = jax.tree.map(lambda x: x[env, time[:, 0]], replay.latent)
    # An episode that a reset cuts short has no `is_last` of its own.
    abandoned = jnp.pad(trajectory.is_first[:, 1:], ((0, 0), (0, 1)))
    trajectory = trajectory._replace(is_last=trajectory.is_last | abandoned)
    return Batch(trajectory, context)


def write_back(replay: Replay, positions: Positions, latent: PyTree) -> Replay:
    """Replaces what is kept beside the steps at `positions` by `latent`, `[B, L, ...]`."""

    def write(buffer, x):
        return buffer.at[positions.env[:, None], positions.time].set(x.astype(buffer.dtype))

    return replay._replace(latent=jax.tree.map(write, replay.latent, latent))
