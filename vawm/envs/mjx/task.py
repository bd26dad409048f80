"""The `Task` that the module of each domain provides: pure functions of one environment."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx

from vawm.types import Array, Key


class Start(NamedTuple):
    """A drawn initial state of one environment."""

    qpos: Array  # [nq] m or rad
    qvel: Array  # [nv] m/s or rad/s
    target: Array  # [G] what the task randomises outside qpos


class Task(NamedTuple):
    """Observation, reward and initial states of one environment, unbatched.

    Attributes:
      observe: `(data, target) -> [D]`, dm_control's entries in dm_control's order.
      reward: `(data, target) -> []` for the state in `data`, reached with `data.ctrl`.
      draw: `(key) -> Start`, a candidate from dm_control's initial distribution.
      substeps: physics steps in one control step.
      collision_free: whether to draw again if a candidate has a contact.
      settle: physics steps without control before the first observation.
      touch: whether the first observation reads contact forces.
    """

    observe: Callable[[mjx.Data, Array], Array]
    reward: Callable[[mjx.Data, Array], Array]
    draw: Callable[[Key], Start]
    substeps: int
    collision_free: bool = False
    settle: int = 0
    touch: bool = False


def no_target() -> Array:
    """The empty target of a task without one."""
    return jnp.zeros((0,), jnp.float32)


def joint_sampler(model: mujoco.MjModel) -> Callable[[Key], Array]:
    """dm_control's `randomize_limited_and_rotational_joints` for hinges and slides.

    Limited joints are uniform in their range and unlimited hinges in [-pi, pi]; unlimited
    slides keep the model's default.
    """
    hinge = model.jnt_type == mujoco.mjtJoint.mjJNT_HINGE
    limited = model.jnt_limited.astype(bool)
    low = np.where(limited, model.jnt_range[:, 0], np.where(hinge, -np.pi, model.qpos0))
    high = np.where(limited, model.jnt_range[:, 1], np.where(hinge, np.pi, model.qpos0))
    low, high = low.astype(np.float32), high.astype(np.float32)

    def sample(key: Key) -> Array:
        return jax.random.uniform(key, low.shape, minval=low, maxval=high)

    return sample
