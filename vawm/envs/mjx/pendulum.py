"""Pendulum swingup (dm_control.suite.pendulum)."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx

from vawm.envs.mjx.rewards import tolerance
from vawm.envs.mjx.task import Start, Task, no_target
from vawm.types import Array, Key

COSINE_BOUND = float(np.cos(np.deg2rad(8)))


def make_task(name: str, model: mujoco.MjModel) -> Task:
    """The only task is "swingup"."""
    pole = model.body("pole").id

    def observe(data: mjx.Data, target: Array) -> Array:
        """Cosine and sine of the pole's angle, its velocity."""
        rotation = data.xmat[pole]
        return jnp.stack([rotation[2, 2], rotation[0, 2], data.qvel[0]])

    def reward(data: mjx.Data, target: Array) -> Array:
        return tolerance(data.xmat[pole][2, 2], (COSINE_BOUND, 1))

    return Task(observe, reward, draw, substeps=1)


def draw(key: Key) -> Start:
    """A random angle, at rest."""
    qpos = jax.random.uniform(key, (1,), minval=-np.pi, maxval=np.pi)
    return Start(qpos, jnp.zeros(1), no_target())
