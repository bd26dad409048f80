"""The DeepMind Control Suite from vectors, simulated on MJX: 18 tasks."""

from __future__ import annotations

import functools

from vawm import envs
from vawm.config import Config, EnvConfig, HostEnvConfig
from vawm.envs.host import rendering
from vawm.envs.host.drawn import ProprioSimulator
from vawm.envs.host.pool import Pool
from vawm.envs.protocol import Environment
from vawm.errors import InvalidInput
from vawm.runs.suites import on_host
from vawm.runs.suites.record import Protocol, Suite


def check(config: Config, env: EnvConfig) -> None:
    """Refuses an action repeat that does not divide an episode, and a temperature.

    Raises:
      InvalidInput: names the field and the remedy.
    """
    if envs.EPISODE_STEPS % config.action_repeat:
        remedy = f"use a divisor of {envs.EPISODE_STEPS}, the control steps of an episode"
        raise InvalidInput("action_repeat", config.action_repeat, remedy)
    if config.actor.collect_temperature != 1.0:
        remedy = "use 1: only discrete policies have a temperature"
        raise InvalidInput(
            "actor.collect_temperature", config.actor.collect_temperature, remedy
        )


def make(config: Config, env: EnvConfig) -> Environment:
    """The environments of a run."""
    return envs.make(config.task, num_envs=config.num_envs, action_repeat=config.action_repeat)


def make_drawn(config: Config, env: EnvConfig) -> Pool:
    """The same tasks in dm_control's own simulation, which can draw them.

    Raises:
      InvalidInput: no renderer works here.
    """
    envs.check_task(config.task)
    simulator = functools.partial(
        ProprioSimulator,
        config.task,
        renderer=rendering.choose("auto"),
        action_repeat=config.action_repeat,
    )
    return on_host.pool(config, HostEnvConfig(), simulator)


SUITE = Suite(
    choices=EnvConfig,
    check=check,
    check_task=envs.check_task,
    make=make,
    make_drawn=make_drawn,
    protocol=Protocol(
        text="whole episodes of 1000 control steps, simulated on MJX as in training",
        episodes=10,
        physics=("mjx", "mujoco"),
    ),
    program="dmc_proprio.py",
    usual_tasks=("cartpole_swingup", "cartpole_balance"),
    title="the DeepMind Control Suite, from proprioception: 18 tasks on MJX",
    examples={
        "": "minutes on a CPU",
        "--task walker_walk --preset paper": "on a GPU",
        "--value-alignment.weight off": "plain DreamerV3",
        "--agent storm": "the transformer",
    },
    tasks=envs.TASKS,
    episode_steps=envs.EPISODE_STEPS,
    tables=("dmc_proprio_500k",),
    returns=(0.0, 1000.0),
    has_images=False,
)
