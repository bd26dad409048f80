"""Scores of a trained policy, in the simulation it learned in and in dm_control's own.

    python -m vawm.evaluate --logdir runs/... --episodes 10 --physics mujoco

The policy is sampled, as in training.
"""

from __future__ import annotations

import dataclasses
import math
import os
import pathlib
import sys
from collections.abc import Sequence
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from vawm import cache, envs, flags, huge_pages
from vawm import policy as policy_lib
from vawm.command_line import guard
from vawm.envs.protocol import Environment
from vawm.errors import InvalidInput
from vawm.policy import Policy
from vawm.types import Array, TimeStep


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
        return f"{self.mean:.1f} +- {self.standard_error:.1f} over {count} episodes"


class Loop(NamedTuple):
    """Carry of `play`."""

    env_state: Any
    timestep: TimeStep
    carry: Any
    key: Array
    done: Array  # [N] whether the first episode is over
    total: Array  # [N] its return so far


def evaluate(
    policy: Policy,
    *,
    episodes: int,
    physics: Literal["mjx", "mujoco"] = "mjx",
    seed: int = 0,
    env: Environment | None = None,
) -> Score:
    """Plays `episodes` whole episodes of the policy's task.

    Args:
      policy: what `vawm.load` returns.
      episodes: played side by side.
      physics: "mjx" for the simulation of training, "mujoco" for dm_control's.
      seed: of the episodes and of the actions.
      env: in place of the MJX task; has `num_envs == episodes`.

    Raises:
      InvalidInput: a number of episodes that is not positive, or an impossible seed.
    """
    check(episodes, seed)
    if physics == "mujoco":
        return _evaluate_mujoco(policy, episodes, seed)
    env = env or envs.make(
        policy.spec.task, num_envs=episodes, action_repeat=policy.spec.action_repeat
    )
    returns = player(env, policy)(policy.params, jax.random.key(seed))
    return Score(tuple(map(float, returns)))


def check(episodes: int, seed: int) -> None:
    """Refuses what cannot be played.

    Raises:
      InvalidInput: names the number and the remedy.
    """
    if episodes < 1:
        raise InvalidInput("episodes", episodes, "use a number of at least 1")
    if not 0 <= seed < 2**31:
        raise InvalidInput("seed", seed, f"use a number from 0 to {2**31 - 1}")


def player(env: Environment, policy: Policy) -> jax.stages.Wrapped:
    """`(params, key) -> returns`, jitted: the same program for every checkpoint of a run."""
    return jax.jit(lambda params, key: play(env, policy._replace(params=params), key))


def play(env: Environment, policy: Policy, key: Array) -> Array:
    """Returns `[N]` of the first episode in each of N environments."""
    num_envs = env.spec.num_envs
    key_reset, key_act = jax.random.split(key)

    def one_step(loop: Loop) -> Loop:
        key, key_act = jax.random.split(loop.key)
        carry, action = policy.act(key_act, loop.carry, loop.timestep)
        env_state, timestep = env.step(loop.env_state, action)
        return Loop(
            env_state=env_state,
            timestep=timestep,
            carry=carry,
            key=key,
            done=loop.done | timestep.is_last,
            total=loop.total + jnp.where(loop.done, 0.0, timestep.reward),
        )

    env_state, timestep = env.reset(key_reset)
    first = Loop(
        env_state=env_state,
        timestep=timestep,
        carry=policy.initial(num_envs),
        key=key_act,
        done=jnp.zeros(num_envs, bool),
        total=jnp.zeros(num_envs),
    )
    return jax.lax.while_loop(lambda loop: ~loop.done.all(), one_step, first).total


def _evaluate_mujoco(policy: Policy, episodes: int, seed: int) -> Score:
    os.environ.setdefault("MUJOCO_GL", "disable")  # nothing is rendered
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
        carry, action = policy.act(key_act, carry, _as_timestep(latest, is_first))
        controls = to_actuator(np.asarray(action), specs.minimum, specs.maximum)
        for i, (sim, control) in enumerate(zip(sims, controls, strict=True)):
            for _ in range(policy.spec.action_repeat):
                if not latest[i].last():
                    latest[i] = sim.step(control)
                    total[i] += latest[i].reward
        is_first = False
    return Score(tuple(map(float, total)))


def to_actuator(action: np.ndarray, minimum: np.ndarray, maximum: np.ndarray) -> np.ndarray:
    """Raw actions, clipped to [-1, 1] and stretched to the actuator's range."""
    unit = (np.clip(action, -1.0, 1.0) + 1.0) / 2.0
    return minimum + unit * (maximum - minimum)


def _as_timestep(steps: Sequence[Any], is_first: bool) -> TimeStep:
    """dm_env's steps of N simulations as one `TimeStep`; entries in dm_control's order."""
    obs = [np.concatenate([np.ravel(x) for x in s.observation.values()]) for s in steps]
    last = np.array([step.last() for step in steps])
    return TimeStep(
        obs=jnp.asarray(np.stack(obs), jnp.float32),
        reward=jnp.asarray([step.reward or 0.0 for step in steps], jnp.float32),
        is_first=jnp.full(len(steps), is_first),
        is_last=jnp.asarray(last),
        is_terminal=jnp.zeros(len(steps), bool),
    )


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Evaluate the newest checkpoint of a run."""

    logdir: pathlib.Path
    """folder of the run"""
    episodes: int = 10
    physics: Literal["mjx", "mujoco"] = "mjx"
    """mujoco: also in dm_control's own C simulation"""
    seed: int = 0


def main(argv: Sequence[str] | None = None) -> int:
    """Prints a line per simulation; returns the exit code."""
    arguments = flags.read(Arguments, argv, description=__doc__)
    check(arguments.episodes, arguments.seed)
    cache.enable()
    policy = policy_lib.load(arguments.logdir)
    print(f"{policy.spec.task} at {policy.env_steps} env steps, mean +- standard error")
    for physics in ("mjx", "mujoco") if arguments.physics == "mujoco" else ("mjx",):
        score = evaluate(
            policy, episodes=arguments.episodes, physics=physics, seed=arguments.seed
        )
        print(f"  {physics:6} {score}", flush=True)
    return 0


if __name__ == "__main__":
    huge_pages.use_huge_pages()
    sys.exit(guard(main))
