"""Walker: run, stand, walk (dm_control.suite.walker)."""

from __future__ import annotations

import jax.numpy as jnp
import mujoco
from mujoco import mjx

from vawm.envs.mjx.rewards import tolerance
from vawm.envs.mjx.task import Start, Task, joint_sampler, no_target
from vawm.types import Array, Key

STAND_HEIGHT = 1.2  # m
MOVE_SPEED = {"stand": 0.0, "walk": 1.0, "run": 8.0}  # m/s


def make_task(name: str, model: mujoco.MjModel) -> Task:
    """One of "run", "stand", "walk"."""
    torso = model.body("torso").id
    sensor = model.sensor("torso_subtreelinvel").adr[0]
    joints = joint_sampler(model)
    target_speed = MOVE_SPEED[name]

    def observe(data: mjx.Data, target: Array) -> Array:
        """Cosine and sine of each body's angle, the torso's height, all velocities."""
        rotation = data.xmat[1:]
        orientations = jnp.stack([rotation[:, 0, 0], rotation[:, 0, 2]], axis=1).ravel()
        return jnp.concatenate([orientations, data.xpos[torso][2:], data.qvel])

    def stand(data: mjx.Data, target: Array) -> Array:
        standing = tolerance(
            data.xpos[torso][2], (STAND_HEIGHT, float("inf")), margin=STAND_HEIGHT / 2
        )
        upright = (1 + data.xmat[torso][2, 2]) / 2
        return (3 * standing + upright) / 4

    def move(data: mjx.Data, target: Array) -> Array:
        moving = tolerance(
            data.sensordata[sensor],
            (target_speed, float("inf")),
            margin=target_speed / 2,
            value_at_margin=0.5,
            sigmoid="linear",
        )
        return stand(data, target) * (5 * moving + 1) / 6

    def draw(key: Key) -> Start:
        return Start(joints(key), jnp.zeros(9), no_target())

    return Task(observe, stand if name == "stand" else move, draw, substeps=10)
