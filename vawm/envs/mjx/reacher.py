"""Reacher: easy and hard (dm_control.suite.reacher)."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx

from vawm.envs.mjx.rewards import tolerance
from vawm.envs.mjx.task import Start, Task, joint_sampler
from vawm.types import Array, Key

TARGET_RADIUS = {"easy": 0.05, "hard": 0.015}  # m


def make_task(name: str, model: mujoco.MjModel) -> Task:
    """One of "easy", "hard"."""
    finger = model.geom("finger").id
    reach = TARGET_RADIUS[name] + float(model.geom("finger").size[0])
    joints = joint_sampler(model)

    def to_target(data: mjx.Data, target: Array) -> Array:
        """Vector from the finger to the target in the plane, m."""
        return target - data.geom_xpos[finger][:2]

    def observe(data: mjx.Data, target: Array) -> Array:
        return jnp.concatenate([data.qpos, to_target(data, target), data.qvel])

    def reward(data: mjx.Data, target: Array) -> Array:
        return tolerance(jnp.linalg.norm(to_target(data, target)), (0, reach))

    def draw(key: Key) -> Start:
        key_joints, key_angle, key_radius = jax.random.split(key, 3)
        angle = jax.random.uniform(key_angle, maxval=2 * np.pi)
        radius = jax.random.uniform(key_radius, minval=0.05, maxval=0.20)  # m
        target = radius * jnp.stack([jnp.sin(angle), jnp.cos(angle)])
        return Start(joints(key_joints), jnp.zeros(2), target)

    return Task(observe, reward, draw, substeps=1)
