"""Finger: spin, turn_easy, turn_hard (dm_control.suite.finger)."""

from __future__ import annotations

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx

from vawm.envs.mjx.task import Start, Task, joint_sampler, no_target
from vawm.types import Array, Key

TARGET_RADIUS = {"turn_easy": 0.07, "turn_hard": 0.03}  # m
SPIN_VELOCITY = 15.0  # rad/s
SPIN_DAMPING = 0.03  # of the hinge, N m s/rad; the XML has 0.5
PLANE = np.array([0, 2])  # x and z


def make_task(name: str, model: mujoco.MjModel) -> Task:
    """One of "spin" (it edits the hinge's damping in `model`), "turn_easy", "turn_hard"."""
    touch = np.array([model.sensor(side).adr[0] for side in ("touchtop", "touchbottom")])
    spinner, tip = model.body("spinner").id, model.site("tip").id
    joints = joint_sampler(model)

    def tip_position(data: mjx.Data) -> Array:
        """(x, z) of the spinner's tip relative to its hinge, m."""
        return (data.site_xpos[tip] - data.xpos[spinner])[PLANE]

    def body(data: mjx.Data) -> list[Array]:
        """Finger angles, tip position, three velocities, log(1 + force) of both touches."""
        return [
            data.qpos[:2],
            tip_position(data),
            data.qvel,
            jnp.log1p(data.sensordata[touch]),
        ]

    def target_position(data: mjx.Data, target: Array) -> Array:
        return target - data.xpos[spinner][PLANE]

    def distance(data: mjx.Data, target: Array) -> Array:
        """Distance from the tip to the target's surface, m; negative inside."""
        to_target = target_position(data, target) - tip_position(data)
        return jnp.linalg.norm(to_target) - TARGET_RADIUS[name]

    def observe_spin(data: mjx.Data, target: Array) -> Array:
        return jnp.concatenate(body(data))

    def observe_turn(data: mjx.Data, target: Array) -> Array:
        goal = [target_position(data, target), distance(data, target)[None]]
        return jnp.concatenate(body(data) + goal)

    def reward_spin(data: mjx.Data, target: Array) -> Array:
        return (data.qvel[2] <= -SPIN_VELOCITY).astype(jnp.float32)

    def reward_turn(data: mjx.Data, target: Array) -> Array:
        return (distance(data, target) <= 0).astype(jnp.float32)

    def draw_spin(key: Key) -> Start:
        return Start(joints(key), jnp.zeros(3), no_target())

    place_target = target_sampler(model)

    def draw_turn(key: Key) -> Start:
        key_joints, key_target = jax.random.split(key)
        return Start(joints(key_joints), jnp.zeros(3), place_target(key_target))

    if name == "spin":
        model.dof_damping[model.joint("hinge").dofadr[0]] = SPIN_DAMPING
        return Task(observe_spin, reward_spin, draw_spin, substeps=2, collision_free=True)
    return Task(observe_turn, reward_turn, draw_turn, substeps=2, collision_free=True)


def target_sampler(model: mujoco.MjModel):
    """Draws the target's (x, z), m: a random point on the circle of the spinner's tip."""
    hinge = model.body("spinner").pos + model.joint("hinge").pos
    center = hinge[PLANE].astype(np.float32)
    radius = float(model.geom("cap1").size.sum())

    def place(key: Key) -> Array:
        angle = jax.random.uniform(key, minval=-np.pi, maxval=np.pi)
        return center + radius * jnp.stack([jnp.sin(angle), jnp.cos(angle)])

    return place
