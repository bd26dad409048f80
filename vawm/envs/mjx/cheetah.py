"""Cheetah run (dm_control.suite.cheetah)."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx

from vawm.envs.mjx.rewards import tolerance
from vawm.envs.mjx.task import Start, Task, no_target
from vawm.types import Array, Key

RUN_SPEED = 10.0  # m/s
SETTLE_STEPS = 200


def make_task(name: str, model: mujoco.MjModel) -> Task:
    """The only task is "run"."""
    speed = model.sensor("torso_subtreelinvel").adr[0]

    def observe(data: mjx.Data, target: Array) -> Array:
        """Everything but the horizontal position."""
        return jnp.concatenate([data.qpos[1:], data.qvel])

    def reward(data: mjx.Data, target: Array) -> Array:
        return tolerance(
            data.sensordata[speed],
            (RUN_SPEED, float("inf")),
            margin=RUN_SPEED,
            value_at_margin=0,
            sigmoid="linear",
        )

    return Task(observe, reward, sampler(model), substeps=1, settle=SETTLE_STEPS - 1)


def sampler(model: mujoco.MjModel):
    """Draws limited joints uniformly in their range, then takes the first settling step.

    dm_control settles for 200 steps. The first one still uses the forces of the default
    pose (it calls mj_step2 without mj_step1). Their effect is the same for every draw: a
    constant velocity, computed once here with C MuJoCo.
    """
    limited = model.jnt_limited.astype(bool)
    low = np.where(limited, model.jnt_range[:, 0], model.qpos0).astype(np.float32)
    high = np.where(limited, model.jnt_range[:, 1], model.qpos0).astype(np.float32)

    data = mujoco.MjData(model)
    mujoco.mj_step(model, data)
    first_velocity = data.qvel.astype(np.float32)
    first_move = (model.opt.timestep * data.qvel).astype(np.float32)

    def draw(key: Key) -> Start:
        qpos = jax.random.uniform(key, low.shape, minval=low, maxval=high)
        return Start(qpos + first_move, jnp.asarray(first_velocity), no_target())

    return draw
