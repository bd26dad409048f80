"""Ball in cup, catch (dm_control.suite.ball_in_cup)."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx

from vawm.envs.mjx.task import Start, Task, no_target
from vawm.types import Array, Key


def make_task(name: str, model: mujoco.MjModel) -> Task:
    """The only task is "catch"."""
    ball, target_site = model.body("ball").id, model.site("target").id
    room = np.asarray(model.site("target").size - model.geom("ball").size[0], np.float32)
    plane = np.array([0, 2])  # x and z

    def observe(data: mjx.Data, target: Array) -> Array:
        return jnp.concatenate([data.qpos, data.qvel])

    def reward(data: mjx.Data, target: Array) -> Array:
        """1 while the whole ball is inside the target box."""
        to_target = jnp.abs(data.site_xpos[target_site] - data.xpos[ball])[plane]
        return (to_target < room[plane]).all().astype(jnp.float32)

    return Task(observe, reward, draw, substeps=10, collision_free=True)


def draw(key: Key) -> Start:
    """The ball at a random offset from its default, x U(-0.2, 0.2), z U(0.2, 0.5), at rest."""
    low, high = np.array([-0.2, 0.2], np.float32), np.array([0.2, 0.5], np.float32)
    ball = jax.random.uniform(key, (2,), minval=low, maxval=high)
    return Start(jnp.concatenate([jnp.zeros(2), ball]), jnp.zeros(4), no_target())
