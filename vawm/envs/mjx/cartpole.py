"""Cartpole: balance and swingup, smooth and sparse (dm_control.suite.cartpole)."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx

from vawm.envs.mjx.rewards import tolerance
from vawm.envs.mjx.task import Start, Task, no_target
from vawm.types import Array, Key

CART_RANGE = (-0.25, 0.25)  # m
ANGLE_COSINE_RANGE = (0.995, 1.0)


def make_task(name: str, model: mujoco.MjModel) -> Task:
    """One of "balance", "balance_sparse", "swingup", "swingup_sparse"."""
    pole = model.body("pole_1").id

    def observe(data: mjx.Data, target: Array) -> Array:
        """Cart position, cosine and sine of the pole's angle, both velocities."""
        rotation = data.xmat[pole]
        position = jnp.stack([data.qpos[0], rotation[2, 2], rotation[0, 2]])
        return jnp.concatenate([position, data.qvel])

    def smooth(data: mjx.Data, target: Array) -> Array:
        upright = (data.xmat[pole][2, 2] + 1) / 2
        centered = (1 + tolerance(data.qpos[0], margin=2)) / 2
        calm = tolerance(data.ctrl[0], margin=1, value_at_margin=0, sigmoid="quadratic")
        slow = tolerance(data.qvel[1], margin=5)
        return upright * centered * (4 + calm) / 5 * (1 + slow) / 2

    def sparse(data: mjx.Data, target: Array) -> Array:
        in_middle = tolerance(data.qpos[0], CART_RANGE)
        return in_middle * tolerance(data.xmat[pole][2, 2], ANGLE_COSINE_RANGE)

    return Task(
        observe=observe,
        reward=sparse if name.endswith("sparse") else smooth,
        draw=draw_hanging if name.startswith("swingup") else draw_upright,
        substeps=1,
    )


def draw_hanging(key: Key) -> Start:
    """Cart near the middle, pole pointing down: N(0, 0.01) around (0, pi)."""
    key_qpos, key_qvel = jax.random.split(key)
    hanging = jnp.array([0.0, np.pi])
    qpos = hanging + 0.01 * jax.random.normal(key_qpos, (2,))
    return Start(qpos, 0.01 * jax.random.normal(key_qvel, (2,)), no_target())


def draw_upright(key: Key) -> Start:
    """Cart near the middle, pole nearly upright: U(-0.1, 0.1) m and U(-0.034, 0.034) rad."""
    key_qpos, key_qvel = jax.random.split(key)
    bound = np.array([0.1, 0.034], np.float32)
    qpos = jax.random.uniform(key_qpos, (2,), minval=-bound, maxval=bound)
    return Start(qpos, 0.01 * jax.random.normal(key_qvel, (2,)), no_target())
