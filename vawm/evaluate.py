"""Scores of a trained policy: one named protocol per suite, and the command line.

    python -m vawm.evaluate --logdir runs/...

    dmc_proprio   10 episodes, on MJX or in dm_control's own simulation
    dmc_vision    10 episodes
    atari100k     100 games to their end, whole scores, no sticky actions; human-normalised
    gymnasium     20 episodes

Actions are sampled from the policy, as in the official DreamerV3, whatever the temperature it
collected with; `how="mode"` takes its mode. Every episode that is begun to be counted is
counted, once. On the host, none of them is an episode that the run was trained on.
"""

from __future__ import annotations

import contextlib
import dataclasses
import pathlib
import sys
from collections.abc import Sequence
from typing import Any, Literal

import jax

from vawm import envs
from vawm.cli import flags
from vawm.cli.command_line import guard
from vawm.config import HostEnvConfig
from vawm.envs.protocol import Environment, HostEnvironment, check_positive
from vawm.errors import InvalidInput
from vawm.policy import Policy, play, scores
from vawm.policy import policy as policy_lib
from vawm.policy.play import How, Score
from vawm.process import cache, huge_pages
from vawm.runs import suites

AT_ONCE = 8
"""Environments on the host that are stepped together, each with its share of the episodes."""


def evaluate(
    policy: Policy,
    *,
    episodes: int,
    env: Environment | HostEnvironment,
    how: How = "sample",
    seed: int = 0,
) -> Score:
    """Plays `episodes` whole episodes in any environments.

    Args:
      policy: what `vawm.load` returns.
      episodes: a jittable environment plays them side by side, with `num_envs == episodes`.
      env: what to play in; one on the host stays open.
      how: actions are sampled, or the policy's mode.
      seed: of the episodes and of the actions.

    Raises:
      InvalidInput: a number of episodes that is not positive, an impossible seed, or
        environments of another kind than the policy's.
      EnvironmentFailure: an environment on the host failed.
    """
    check(episodes, seed)
    check_env(policy, env)
    if not isinstance(env, Environment):
        return play.on_host(env, policy, episodes=episodes, seed=seed, how=how)
    if env.spec.num_envs != episodes:
        remedy = f"the environments are {env.spec.num_envs}, one for each; use that"
        raise InvalidInput("episodes", episodes, remedy)
    returns = play.player(env, policy, how)(policy.params, policy.state, jax.random.key(seed))
    return Score(tuple(map(float, returns)))


def check(episodes: int, seed: int) -> None:
    """Refuses what cannot be played.

    Raises:
      InvalidInput: names the number and the remedy.
    """
    check_positive("episodes", episodes)
    if not 0 <= seed < 2**31:
        raise InvalidInput("seed", seed, f"use a number from 0 to {2**31 - 1}")


def check_env(policy: Policy, env: Environment | HostEnvironment) -> None:
    """Refuses environments whose observations, actions or action repeat are not the policy's.

    Raises:
      InvalidInput: names what differs.
    """
    for name in ("obs", "action_size", "discrete", "action_repeat"):
        own, theirs = getattr(policy.spec, name), getattr(env.spec, name)
        if own != theirs:
            raise InvalidInput("env", f"{name} {theirs}", f"the policy was trained with {own}")


def check_suite(policy: Policy, suite: str) -> None:
    """Refuses a policy that was trained in another suite.

    Raises:
      InvalidInput: names the protocol of its own.
    """
    own = policy.config.suite
    if own != suite:
        remedy = f"use the protocol of its own suite, evaluate.{own}"
        raise InvalidInput("policy", f"trained in {own}", remedy)


def dmc_proprio(
    policy: Policy,
    *,
    episodes: int = 10,
    physics: Literal["mjx", "mujoco"] = "mjx",
    how: How = "sample",
    seed: int = 0,
) -> Score:
    """Episodes of 1000 control steps, in the simulation of training or in dm_control's."""
    check(episodes, seed)
    check_suite(policy, "dmc_proprio")
    if physics == "mujoco":
        return play.in_mujoco(policy, episodes=episodes, seed=seed, how=how)
    spec = policy.spec
    env = envs.make(spec.task, num_envs=episodes, action_repeat=spec.action_repeat)
    return evaluate(policy, episodes=episodes, env=env, how=how, seed=seed)


def dmc_vision(
    policy: Policy, *, episodes: int = 10, how: How = "sample", seed: int = 0
) -> Score:
    """Episodes of 1000 control steps, rendered as in training."""
    check_suite(policy, "dmc_vision")
    return _on_host(policy, episodes=episodes, how=how, seed=seed)


def atari100k(
    policy: Policy,
    *,
    episodes: int = 100,
    how: How = "sample",
    sticky: float = 0.0,
    seed: int = 0,
) -> Score:
    """Whole games with their whole scores, whatever the training called an end or clipped.

    Frames, no-ops and the length limit are those of training; sticky actions are off unless
    `sticky` is their probability.
    """
    check_suite(policy, "atari100k")
    changes = {"sticky": sticky, "life_loss": "ignore", "clip_reward": False}
    return _on_host(policy, episodes=episodes, how=how, seed=seed, **changes)


def gymnasium(
    policy: Policy, *, episodes: int = 20, how: How = "sample", seed: int = 0
) -> Score:
    """Episodes of a registered environment."""
    check_suite(policy, "gymnasium")
    return _on_host(policy, episodes=episodes, how=how, seed=seed)


PROTOCOLS = {
    "dmc_proprio": dmc_proprio,
    "dmc_vision": dmc_vision,
    "atari100k": atari100k,
    "gymnasium": gymnasium,
}


def _on_host(policy: Policy, *, episodes: int, how: How, seed: int, **changes: Any) -> Score:
    """In the environments of the policy's own config, with some of its choices changed."""
    check(episodes, seed)
    assert isinstance(policy.config.env, HostEnvConfig)
    choices = dataclasses.replace(policy.config.env, on_failure="raise", **changes)
    config = dataclasses.replace(policy.config, num_envs=min(episodes, AT_ONCE), env=choices)
    with contextlib.closing(suites.on_host(config, choices)) as env:
        return evaluate(policy, episodes=episodes, env=env, how=how, seed=seed)


@dataclasses.dataclass(frozen=True)
class Arguments:
    """Evaluate the newest checkpoint of a run by the protocol of its suite."""

    logdir: pathlib.Path
    """folder of the run"""
    episodes: int | None = None
    """as many as the protocol has if not given"""
    how: Literal["sample", "mode"] = "sample"
    """sample actions from the policy, or take its mode"""
    physics: Literal["mjx", "mujoco"] = "mjx"
    """mujoco: also in dm_control's own C simulation; for dmc_proprio"""
    sticky: float = 0.0
    """probability of sticky actions; for atari100k"""
    seed: int = 0


def main(argv: Sequence[str] | None = None) -> int:
    """Prints a line per simulation; returns the exit code."""
    arguments = flags.read(Arguments, argv, description=__doc__)
    check(1 if arguments.episodes is None else arguments.episodes, arguments.seed)
    cache.enable()
    policy = policy_lib.load(arguments.logdir)
    suite, task = policy.config.suite, policy.spec.task
    variants = _variants(arguments, suite)
    print(f"{task} ({suite}) at {policy.env_steps} env steps, mean +- standard error")
    common: dict[str, Any] = {"how": arguments.how, "seed": arguments.seed}
    if arguments.episodes is not None:
        common["episodes"] = arguments.episodes
    for name, choices in variants.items():
        score = PROTOCOLS[suite](policy, **common, **choices)
        text = f"  {name:6} {score}"
        if suite == "atari100k":
            normalized = scores.human_normalized(task, score.mean)
            text += f", {normalized:.3f} human-normalised"
        print(text, flush=True)
    return 0


def _variants(arguments: Arguments, suite: str) -> dict[str, dict[str, Any]]:
    """Name -> what its protocol is told besides the usual.

    Raises:
      InvalidInput: an option that is not of this suite.
    """
    if arguments.physics != "mjx" and suite != "dmc_proprio":
        raise InvalidInput("physics", arguments.physics, f"is not an option of {suite}")
    if arguments.sticky and suite != "atari100k":
        raise InvalidInput("sticky", arguments.sticky, f"is not an option of {suite}")
    if not 0 <= arguments.sticky < 1:
        raise InvalidInput("sticky", arguments.sticky, "use a number from 0 up to 1")
    if suite == "atari100k":
        return {"ale": {"sticky": arguments.sticky}}
    if suite != "dmc_proprio":
        return {arguments.how: {}}
    simulations = ("mjx", "mujoco") if arguments.physics == "mujoco" else ("mjx",)
    return {name: {"physics": name} for name in simulations}


if __name__ == "__main__":
    huge_pages.use_huge_pages()
    sys.exit(guard(main))
