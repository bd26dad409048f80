"""From a config to its environments: which tasks a suite has, and how they are made."""

from __future__ import annotations

import functools
from collections.abc import Callable

from vawm import envs
from vawm.config import AtariConfig, Config, GymnasiumConfig, HostEnvConfig, VisionConfig
from vawm.envs.host import atari, gymnasium, rendering, vision
from vawm.envs.host.pool import Pool
from vawm.envs.host.simulator import Simulator
from vawm.envs.protocol import Environment, HostEnvironment


def check_task(config: Config) -> None:
    """Refuses a task that the suite does not have, with the nearest name.

    Raises:
      InvalidInput: the task is unknown.
    """
    if config.suite == "dmc_proprio":
        envs.check_task(config.task)
    elif config.suite == "dmc_vision":
        vision.check_vision_task(config.task)
    elif config.suite == "atari100k":
        atari.check_game(config.task)
    else:
        gymnasium.check_id(config.task)


def make(config: Config) -> Environment | HostEnvironment:
    """The environments of a run. Those on the host have processes: close them.

    Raises:
      InvalidInput: they cannot be made: a package of Python or of the system is missing, or
        all that a Gymnasium environment lacks at once.
    """
    if isinstance(config.env, HostEnvConfig):
        return on_host(config, config.env)
    return envs.make(config.task, num_envs=config.num_envs, action_repeat=config.action_repeat)


def on_host(config: Config, choices: HostEnvConfig) -> HostEnvironment:
    """The environments of a suite that runs in processes of its own."""
    if isinstance(choices, GymnasiumConfig):
        return envs.from_gymnasium(
            config.task,
            num_envs=config.num_envs,
            time_limit=choices.time_limit or None,
            workers=choices.workers,
            timeout=choices.timeout,
            on_failure=choices.on_failure,
        )
    return Pool(
        simulator(config, choices),
        task=config.task,
        num_envs=config.num_envs,
        action_repeat=config.action_repeat,
        workers=choices.workers,
        timeout=choices.timeout,
        on_failure=choices.on_failure,
    )


def simulator(config: Config, choices: HostEnvConfig) -> Callable[[], Simulator]:
    """What makes one environment of Atari or DMC vision, in the process that will run it."""
    if isinstance(choices, AtariConfig):
        return functools.partial(
            atari.AtariSimulator,
            config.task,
            frame_skip=config.action_repeat,
            pooling=choices.pooling,
            image_size=choices.image_size,
            resize=choices.resize,
            noops=choices.noops,
            sticky=choices.sticky,
            life_loss=choices.life_loss,
            clip_reward=choices.clip_reward,
            max_frames=choices.max_frames,
            full_action_set=choices.full_action_set,
        )
    if isinstance(choices, VisionConfig):
        return functools.partial(
            vision.VisionSimulator,
            config.task,
            image_size=choices.image_size,
            camera=choices.camera,
            renderer=rendering.choose(choices.renderer),
            fast_rendering=choices.fast_rendering,
            action_repeat=config.action_repeat,
        )
    raise TypeError(f"no simulator for {type(choices).__name__}")
