"""Interaction with environments: act, store the step, take in what arrives.

`depart` and `arrive` are the two halves of a step. `make_collect` calls a jittable environment
between them; environments on the host are called by `vawm.learning.host_train`.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from vawm.agent import Agent, PolicyCarry
from vawm.config import Config
from vawm.envs.protocol import Environment
from vawm.learning import replay
from vawm.learning.replay import Replay
from vawm.types import Array, Key, Metrics, Params, PyTree, TimeStep, Trajectory


class Collector(NamedTuple):
    """Everything that interaction changes, except replay."""

    env_state: PyTree
    timestep: TimeStep  # what has arrived and needs an action
    carry: PolicyCarry
    env_steps: Array  # [] int32, control steps so far, action repeat included
    episode_return: Array  # [N] of the running episodes
    episode_length: Array  # [N] calls of `step` in the running episodes


class Departure(NamedTuple):
    """The step to store once its action is chosen, and what replay keeps beside it."""

    trajectory: Trajectory  # [N, ...]
    latent: PyTree  # [N, ...]


Collect = Callable[[Params, PyTree, Collector, Replay, Key], tuple[Collector, Replay, Metrics]]


def depart(
    agent: Agent,
    params: Params,
    model_state: PyTree,
    collector: Collector,
    key: Key,
    *,
    random_steps: int,
) -> tuple[Collector, Departure]:
    """Acts on what has arrived. The action `[N, A]` is in the returned step.

    Before env step `random_steps` it is a uniformly random action.
    """
    timestep, carry = collector.timestep, collector.carry
    if random_steps > 0:
        key, key_random = jax.random.split(key)
        random_action = agent.random_action(key_random, timestep)
    carry, action = agent.act(params, model_state, key, carry, timestep, how="collect")
    if random_steps > 0:
        action = jnp.where(collector.env_steps < random_steps, random_action, action)
        carry = carry._replace(action=action)
    stored = Departure(
        Trajectory(*timestep, action=action), agent.world_model.memory(carry.memory)
    )
    return collector._replace(carry=carry), stored


def arrive(
    collector: Collector, timestep: TimeStep, *, action_repeat: int
) -> tuple[Collector, Metrics]:
    """Takes in what the environments returned; `collector` already has their new state.

    Metrics are sums over the episodes that ended in this step, and `chunk/nonfinite`: the
    number of environments with NaN or infinity in what arrived, or in the action before it.
    """
    moved = ~timestep.is_first
    episode_return = jnp.where(moved, collector.episode_return, 0.0) + timestep.reward
    episode_length = jnp.where(moved, collector.episode_length + 1, 0)
    ended = timestep.is_last
    exchanged = timestep.obs, timestep.reward, collector.carry.action
    metrics = {
        "episode/count": jnp.sum(ended, dtype=jnp.int32),
        "episode/return": jnp.sum(jnp.where(ended, episode_return, 0.0)),
        "episode/length": jnp.sum(jnp.where(ended, episode_length, 0), dtype=jnp.int32),
        "chunk/nonfinite": jnp.sum(~is_finite(exchanged), dtype=jnp.int32),
    }
    return Collector(
        env_state=collector.env_state,
        timestep=timestep,
        carry=collector.carry,
        env_steps=collector.env_steps + action_repeat * jnp.sum(moved, dtype=jnp.int32),
        episode_return=episode_return,
        episode_length=episode_length,
    ), metrics


def is_finite(exchanged: PyTree) -> Array:
    """Whether all numbers are finite, for each environment: `[N, ...]` arrays -> `[N]`."""

    def per_env(x: Array) -> Array:
        return jnp.isfinite(x).all(range(1, x.ndim))

    leaves = jax.tree.leaves(exchanged)
    floating = (x for x in leaves if jnp.issubdtype(x.dtype, jnp.floating))
    start = jnp.ones(leaves[0].shape[0], bool)
    return functools.reduce(jnp.logical_and, map(per_env, floating), start)


def in_float32(timestep: TimeStep) -> TimeStep:
    """`timestep`, in float32 what an environment computes in float64 under `jax_enable_x64`."""
    return jax.tree.map(
        lambda x: x.astype(jnp.float32) if x.dtype == jnp.float64 else x, timestep
    )


def make_collect(env: Environment, agent: Agent, config: Config) -> Collect:
    """Build `collect(params, model_state, collector, replay, key)`: K steps per environment.

    It returns `(collector, replay, metrics)`, the metrics summed over the K steps.
    """

    def step(params: Params, model_state: PyTree, collector: Collector, key: Key):
        collector, stored = depart(
            agent, params, model_state, collector, key, random_steps=config.random_steps
        )
        env_state, timestep = env.step(collector.env_state, stored.trajectory.action)
        timestep = in_float32(timestep)
        collector, metrics = arrive(
            collector._replace(env_state=env_state),
            timestep,
            action_repeat=env.spec.action_repeat,
        )
        failed = timestep.is_last & (env_state.steps < 0)
        metrics["env/nonfinite"] = jnp.sum(failed, dtype=jnp.int32)
        return collector, (stored, metrics)

    def collect(
        params: Params, model_state: PyTree, collector: Collector, buffer: Replay, key: Key
    ) -> tuple[Collector, Replay, Metrics]:
        keys = jax.random.split(key, config.collect_steps)
        collector, (stored, metrics) = jax.lax.scan(
            lambda c, k: step(params, model_state, c, k), collector, keys
        )
        trajectory, latent = jax.tree.map(lambda x: x.swapaxes(0, 1), stored)
        buffer = replay.add(buffer, trajectory, latent)
        return collector, buffer, jax.tree.map(lambda x: jnp.sum(x, dtype=x.dtype), metrics)

    return collect


def begin(agent: Agent, timestep: TimeStep, env_state: PyTree, *, num_envs: int) -> Collector:
    """The collector before the first action; `timestep` are first observations."""
    return Collector(
        env_state=env_state,
        timestep=timestep,
        carry=agent.initial(num_envs),
        env_steps=jnp.zeros((), jnp.int32),
        episode_return=jnp.zeros(num_envs, jnp.float32),
        episode_length=jnp.zeros(num_envs, jnp.int32),
    )
