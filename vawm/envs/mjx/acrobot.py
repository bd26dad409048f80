"""Acrobot swingup (dm_control.suite.acrobot)."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx

from vawm.envs.mjx.rewards import tolerance
from vawm.envs.mjx.task import Start, Task, no_target
from vawm.types import Array, Key


def make_task(name: str, model: mujoco.MjModel) -> Task:
    """The only task is "swingup"."""
    arms = np.array([model.body("upper_arm").id, model.body("lower_arm").id])
    tip, target_site = model.site("tip").id, model.site("target").id
    target_radius = float(model.site("target").size[0])  # m

    def observe(data: mjx.Data, target: Array) -> Array:
        """Sines of both arms, cosines of both arms, both velocities."""
        rotation = data.xmat[arms]
        return jnp.concatenate([rotation[:, 0, 2], rotation[:, 2, 2], data.qvel])

    def reward(data: mjx.Data, target: Array) -> Array:
        distance = jnp.linalg.norm(data.site_xpos[target_site] - data.site_xpos[tip])
        return tolerance(distance, (0, target_radius), margin=1)

    return Task(observe, reward, draw, substeps=1)


def draw(key: Key) -> Start:
    """Both joints at a random angle, at rest."""
    qpos = jax.random.uniform(key, (2,), minval=-np.pi, maxval=np.pi)
    return Start(qpos, jnp.zeros(2), no_target())
