"""dm_control's models on MJX: loading, one control step, and dm_control's refresh after it.

MJX relies on rank promotion; only the functions that call it allow it. The model is always
an argument, so the tasks of a domain share one compiled step.
"""

from __future__ import annotations

import contextlib
import importlib.util
import pathlib
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import mujoco
import numpy as np
from mujoco import mjx

from vawm.process import dtypes
from vawm.types import Array

# (iterations, ls_iterations) of the Newton solver, where fewer than in the XML leave the
# one-step error against C MuJoCo unchanged. All other domains keep the XML's numbers.
SOLVER = {"cheetah": (8, 8), "hopper": (8, 8), "walker": (8, 8)}

MAX_VALUE = 1e10  # mjMAXVAL: MuJoCo treats larger states as bad

# The fields that the next step, the rewards and the observations read. Everything else in
# mjx.Data is recomputed from these, so it is neither carried nor selected. Constants replace
# it, which lets the compiler drop computations that only it needs.
KEPT = (
    "time",
    "qpos",
    "qvel",
    "qacc_warmstart",
    "ctrl",
    "sensordata",
    "xpos",
    "xmat",
    "xipos",
    "geom_xpos",
    "site_xpos",
)


class Physics(NamedTuple):
    """A loaded model.

    Attributes:
      model: for MJX; an argument of the functions below.
      blank: unbatched data in the state after `mj_resetData`.
      host: the same model for C MuJoCo.
    """

    model: mjx.Model
    blank: mjx.Data
    host: mujoco.MjModel


def load_host(domain: str) -> mujoco.MjModel:
    """Loads a domain's XML as dm_control ships it.

    Reads the files of the installed package without importing it: the import would load
    every domain and a rendering backend. Clears the energy flag, a diagnostic that MJX
    refuses; keeps integrator, timestep, cone and eulerdamp.
    """
    spec = importlib.util.find_spec("dm_control.suite")
    if spec is None or not spec.origin:
        raise ImportError("dm_control.suite is not installed")
    folder = pathlib.Path(spec.origin).parent
    assets = {
        f"./common/{path.name}": path.read_bytes() for path in folder.glob("common/*.xml")
    }
    with _quiet():
        model = mujoco.MjModel.from_xml_string((folder / f"{domain}.xml").read_text(), assets)
    model.opt.enableflags &= ~int(mujoco.mjtEnableBit.mjENBL_ENERGY)
    return model


@contextlib.contextmanager
def _quiet():
    """Keeps MuJoCo from logging cheetah.xml's deprecated attribute to a file in the cwd."""
    previous = mujoco.get_mju_user_warning()
    mujoco.set_mju_user_warning(lambda message: None)
    try:
        yield
    finally:
        mujoco.set_mju_user_warning(previous)


@dtypes.usual()
def put(host: mujoco.MjModel, *, solver: tuple[int, int] | None = None) -> Physics:
    """Moves a model to MJX.

    Args:
      host: a model of `load_host`, edited or not.
      solver: (iterations, ls_iterations); None keeps the model's.
    """
    if solver:
        host.opt.iterations, host.opt.ls_iterations = solver
    with jax.numpy_rank_promotion("allow"):
        model = mjx.put_model(host, impl="jax")
        blank = mjx.make_data(host, impl="jax")
    return Physics(model, jax.tree.map(jnp.asarray, blank), host)


def control_step(model: mjx.Model, data: mjx.Data, ctrl: Array, *, substeps: int) -> mjx.Data:
    """One control step of one environment, as `dm_control.mujoco.Physics.step`.

    Args:
      model: the physics.
      data: unbatched state; only `KEPT` fields are read.
      ctrl: `[nu]` in actuator units, held for all substeps.
      substeps: physics steps.

    Returns:
      The new state. As in dm_control, all values derived from positions and velocities
      belong to the new state, and touch belongs to the last substep.
    """
    with jax.numpy_rank_promotion("allow"):
        data = repeat(lambda d: mjx.step(model, d), data.replace(ctrl=ctrl), substeps)
    return refresh(model, data)


def coast(model: mjx.Model, data: mjx.Data, *, steps: int) -> mjx.Data:
    """Takes physics steps with the control in `data`, then refreshes."""
    with jax.numpy_rank_promotion("allow"):
        data = repeat(lambda d: mjx.step(model, d), data, steps)
    return refresh(model, data)


def refresh(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """Recomputes what observations and rewards read from (qpos, qvel), as mj_step1.

    `mjx.step` leaves these values one substep behind. Velocity sensors cost three more
    passes and are refreshed only if the model has a subtree velocity; joint sensors are
    read from qpos and qvel instead.
    """
    with jax.numpy_rank_promotion("allow"):
        data = mjx.kinematics(model, data)
        if np.any(model.sensor_type == mujoco.mjtSensor.mjSENS_SUBTREELINVEL):
            data = mjx.com_vel(model, mjx.com_pos(model, data))
            data = mjx.sensor_vel(model, data)
    return data


def forward(model: mjx.Model, data: mjx.Data) -> mjx.Data:
    """`mj_forward`, with all sensors; does not change the solver's warm start."""
    with jax.numpy_rank_promotion("allow"):
        return mjx.forward(model, data)


def collides(model: mjx.Model, data: mjx.Data) -> Array:
    """Whether any two geoms of one environment penetrate (MuJoCo's ncon > 0).

    MJX keeps a slot for every candidate pair, so the number of contacts does not tell.
    """
    with jax.numpy_rank_promotion("allow"):
        data = mjx.collision(model, mjx.kinematics(model, data))
    return (data._impl.contact.dist < 0).any()


def keep(blank: mjx.Data, data: mjx.Data) -> mjx.Data:
    """`data` with every field but `KEPT` reset to `blank`."""
    return blank.replace(**{name: getattr(data, name) for name in KEPT})


def healthy(data: mjx.Data) -> Array:
    """Whether one environment's state is finite and within MuJoCo's limits."""
    state = jnp.concatenate([data.qpos, data.qvel, data.qacc_warmstart])
    return (jnp.abs(state) <= MAX_VALUE).all()


def repeat(function: Callable, carry, times: int):
    """Applies `function` `times` times; it is compiled once."""
    if times == 1:
        return function(carry)
    return jax.lax.fori_loop(0, times, lambda _, carry: function(carry), carry)
