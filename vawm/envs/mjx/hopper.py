"""Hopper: hop and stand (dm_control.suite.hopper)."""

from __future__ import annotations

import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx

from vawm.envs.mjx.rewards import tolerance
from vawm.envs.mjx.task import Start, Task, joint_sampler, no_target
from vawm.types import Array, Key

STAND_HEIGHT = 0.6  # m, torso over foot
HOP_SPEED = 2.0  # m/s


def make_task(name: str, model: mujoco.MjModel) -> Task:
    """One of "hop", "stand"."""
    torso, foot = model.body("torso").id, model.body("foot").id
    speed = model.sensor("torso_subtreelinvel").adr[0]
    touch = np.array([model.sensor(part).adr[0] for part in ("touch_toe", "touch_heel")])
    joints = joint_sampler(model)

    def observe(data: mjx.Data, target: Array) -> Array:
        """Everything but the horizontal position, and log(1 + force) of both touches."""
        return jnp.concatenate([data.qpos[1:], data.qvel, jnp.log1p(data.sensordata[touch])])

    def standing(data: mjx.Data) -> Array:
        height = data.xipos[torso][2] - data.xipos[foot][2]
        return tolerance(height, (STAND_HEIGHT, 2))

    def hop(data: mjx.Data, target: Array) -> Array:
        hopping = tolerance(
            data.sensordata[speed],
            (HOP_SPEED, float("inf")),
            margin=HOP_SPEED / 2,
            value_at_margin=0.5,
            sigmoid="linear",
        )
        return standing(data) * hopping

    def stand(data: mjx.Data, target: Array) -> Array:
        calm = tolerance(data.ctrl, margin=1, value_at_margin=0, sigmoid="quadratic")
        return standing(data) * (calm.mean() + 4) / 5

    def draw(key: Key) -> Start:
        return Start(joints(key), jnp.zeros(7), no_target())

    reward = hop if name == "hop" else stand
    return Task(observe, reward, draw, substeps=4, touch=True)
