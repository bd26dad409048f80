"""The DeepMind Control Suite from pixels, rendered by dm_control: 20 tasks."""

from __future__ import annotations

import functools

from vawm import envs
from vawm.config import Config, VisionConfig
from vawm.envs.host import rendering, vision
from vawm.envs.host.pool import Pool
from vawm.envs.protocol import check_image_size
from vawm.errors import Rule
from vawm.runs.suites import dmc_proprio, on_host
from vawm.runs.suites.record import Protocol, Suite

CAMERA: Rule = (lambda x: x >= -1, "use the number of a camera, or -1 for the usual one")
RENDERER_BYTES = 70 * 2**20
"""Memory of an environment that is rendered on a CPU, as `VisionSimulator` says."""


def check(config: Config, env: VisionConfig) -> None:
    """The checks of dmc_proprio, and the size of the images.

    Raises:
      InvalidInput: names the field and the remedy.
    """
    dmc_proprio.check(config, env)
    check_image_size("env.image_size", env.image_size)


def make(config: Config, env: VisionConfig) -> Pool:
    """The environments of a run, in processes of their own."""
    simulator = functools.partial(
        vision.VisionSimulator,
        config.task,
        image_size=env.image_size,
        camera=env.camera,
        renderer=rendering.choose(env.renderer),
        fast_rendering=env.fast_rendering,
        action_repeat=config.action_repeat,
    )
    return on_host.pool(config, env, simulator)


SUITE = Suite(
    choices=VisionConfig,
    rules={"camera": CAMERA},
    check=check,
    check_task=vision.check_vision_task,
    make=make,
    protocol=Protocol(
        text="whole episodes of 1000 control steps, rendered as in training",
        episodes=10,
    ),
    program="dmc_vision.py",
    usual_tasks=("cartpole_balance",),
    title="the DeepMind Control Suite, from pixels: 20 tasks",
    examples={
        "": "small, on a CPU",
        "--task walker_walk --preset paper": "on a GPU",
        "--env.image-size 96": "larger pictures",
    },
    notes="Needs the extra `vision`.",
    tasks=vision.VISION_TASKS,
    episode_steps=envs.EPISODE_STEPS,
    tables=("dmc_vision_1m",),
    returns=dmc_proprio.SUITE.returns,
    env_bytes=RENDERER_BYTES,
)
