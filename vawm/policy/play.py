"""Plays whole episodes of a trained policy, each counted exactly once.

The episodes to count are fixed in advance: one per environment on the device, an equal share
per environment on the host. Counting the first episodes that finish would favour short ones.
"""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from vawm import envs
from vawm.envs.host.vision import to_actuator
from vawm.envs.protocol import Environment, HostEnvironment
from vawm.policy import Policy
from vawm.types import Array, Params, PyTree, TimeStep

How = Literal["sample", "mode"]

FRESH = 2**32
"""Added to the seed of an evaluation on the host. Seeds of runs are smaller, so training has
used none of its episodes."""


class Score(NamedTuple):
    """Returns of whole episodes.

    Attributes:
      returns: one number per episode.
    """

    returns: tuple[float, ...]

    @property
    def mean(self) -> float:
        return float(np.mean(self.returns))

    @property
    def standard_error(self) -> float:
        """Of the mean; NaN for a single episode."""
        if len(self.returns) < 2:
            return math.nan
        return float(np.std(self.returns, ddof=1) / math.sqrt(len(self.returns)))

    def __str__(self) -> str:
        count = len(self.returns)
        if count == 1:
            return f"{self.mean:.1f} over 1 episode"
        return f"{self.mean:.1f} +- {self.standard_error:.1f} over {count} episodes"


class Loop(NamedTuple):
    """Carry of `on_device`."""

    env_state: Any
    timestep: TimeStep
    carry: Any
    key: Array
    done: Array  # [N] whether the first episode is over
    total: Array  # [N] its return so far


def player(env: Environment, policy: Policy, how: How = "sample") -> jax.stages.Wrapped:
    """`(params, model_state, key) -> returns`, jitted once for all checkpoints of a run."""

    def play(params: Params, model_state: PyTree, key: Array) -> Array:
        return on_device(env, policy._replace(params=params, model_state=model_state), key, how)

    return jax.jit(play)


def on_device(env: Environment, policy: Policy, key: Array, how: How = "sample") -> Array:
    """The return of the first episode in each of N environments, `[N]`; can be jitted."""
    num_envs = env.spec.num_envs
    key_reset, key_act = jax.random.split(key)

    def one_step(loop: Loop) -> Loop:
        key, key_act = jax.random.split(loop.key)
        carry, action = policy.act(key_act, loop.carry, loop.timestep, how)
        env_state, timestep = env.step(loop.env_state, action)
        return Loop(
            env_state=env_state,
            timestep=timestep,
            carry=carry,
            key=key,
            done=loop.done | timestep.is_last,
            total=loop.total + jnp.where(loop.done, 0.0, timestep.reward).astype(jnp.float32),
        )

    env_state, timestep = env.reset(key_reset)
    first = Loop(
        env_state=env_state,
        timestep=timestep,
        carry=policy.initial(num_envs),
        key=key_act,
        done=jnp.zeros(num_envs, bool),
        total=jnp.zeros(num_envs, jnp.float32),
    )
    return jax.lax.while_loop(lambda loop: ~loop.done.all(), one_step, first).total


def on_host(
    env: HostEnvironment, policy: Policy, *, episodes: int, seed: int, how: How = "sample"
) -> Score:
    """Plays `episodes` whole episodes in N environments, an equal share in each.

    An environment that has played its share continues, uncounted, until all are done.
    """
    num_envs = env.spec.num_envs
    share = np.array([len(range(i, episodes, num_envs)) for i in range(num_envs)])
    returns: list[list[float]] = [[] for _ in range(num_envs)]
    carry, key, total = policy.initial(num_envs), jax.random.key(seed), np.zeros(num_envs)
    timestep = env.reset(FRESH + seed)
    while any(len(own) < wanted for own, wanted in zip(returns, share, strict=True)):
        key, key_act = jax.random.split(key)
        carry, action = policy.act(key_act, carry, timestep, how)
        env.send(np.asarray(action))
        timestep = env.receive()
        total = np.where(timestep.is_first, 0.0, total) + timestep.reward
        for i in np.flatnonzero(timestep.is_last):
            if len(returns[i]) < share[i]:
                returns[i].append(float(total[i]))
    return Score(tuple(score for own in returns for score in own))


def in_mujoco(policy: Policy, *, episodes: int, seed: int, how: How = "sample") -> Score:
    """Plays `episodes` of the policy's proprio task in dm_control's C simulation."""
    os.environ.setdefault("MUJOCO_GL", "disable")  # no rendering
    from dm_control import suite

    domain, task = envs.split(policy.spec.task)
    sims = [suite.load(domain, task, {"random": seed + i}) for i in range(episodes)]
    specs = sims[0].action_spec()
    latest = [sim.reset() for sim in sims]
    total = np.zeros(episodes)
    carry, key = policy.initial(episodes), jax.random.key(seed)
    is_first = True
    while not all(step.last() for step in latest):
        key, key_act = jax.random.split(key)
        timestep = _as_timestep(latest, is_first)
        carry, action = policy.act(key_act, carry, timestep, how)
        controls = to_actuator(np.asarray(action), specs.minimum, specs.maximum)
        for i, (sim, control) in enumerate(zip(sims, controls, strict=True)):
            for _ in range(policy.spec.action_repeat):
                if not latest[i].last():
                    latest[i] = sim.step(control)
                    total[i] += latest[i].reward
        is_first = False
    return Score(tuple(map(float, total)))


def _as_timestep(steps: Sequence[Any], is_first: bool) -> TimeStep:
    """Joins dm_env's steps of N simulations; entries are in dm_control's order."""
    obs = [np.concatenate([np.ravel(x) for x in s.observation.values()]) for s in steps]
    last = np.array([step.last() for step in steps])
    return TimeStep(
        obs=jnp.asarray(np.stack(obs), jnp.float32),
        reward=jnp.asarray([step.reward or 0.0 for step in steps], jnp.float32),
        is_first=jnp.full(len(steps), is_first),
        is_last=jnp.asarray(last),
        is_terminal=jnp.zeros(len(steps), bool),
    )
