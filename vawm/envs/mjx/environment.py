"""Batches a `Task` into an `Environment`: action repeat, episode ends, resets, failures."""

from __future__ import annotations

import importlib
from collections.abc import Callable

import chex
import jax
import jax.numpy as jnp
import numpy as np
from mujoco import mjx

from vawm.envs.mjx import physics
from vawm.envs.mjx.physics import Physics
from vawm.envs.mjx.task import Task
from vawm.envs.protocol import Environment, EnvState
from vawm.process import dtypes
from vawm.types import Array, ArraySpec, EnvSpec, Key, TimeStep

EPISODE_STEPS = 1000
MAX_DRAWS = 1000  # dm_control gives up after as many collisions


def make(domain: str, name: str, *, num_envs: int, action_repeat: int) -> Environment:
    """Loads a task and batches it; see `vawm.envs.make`."""
    task, loaded = load(domain, name)
    return batch(
        task, loaded, f"{domain}_{name}", num_envs=num_envs, action_repeat=action_repeat
    )


def load(domain: str, name: str) -> tuple[Task, Physics]:
    """Loads a task and its model; the domain's module may edit values of the model."""
    host = physics.load_host(domain)
    task = importlib.import_module(f"vawm.envs.mjx.{domain}").make_task(name, host)
    return task, physics.put(host, solver=physics.SOLVER.get(domain))


def batch(
    task: Task, loaded: Physics, name: str, *, num_envs: int, action_repeat: int
) -> Environment:
    """N environments of one task; see `Environment` for the stream's convention."""
    model, blank, host = loaded
    low, high = np.asarray(host.actuator_ctrlrange, np.float32).T
    spec = EnvSpec(
        task=name,
        obs=obs_spec(task, blank),
        action_size=host.nu,
        discrete=False,
        num_envs=num_envs,
        action_repeat=action_repeat,
        episode_length=EPISODE_STEPS // action_repeat,
    )

    def begin(key: Key) -> tuple[mjx.Data, Array]:
        return first_state(task, model, blank, key)

    def act(data: mjx.Data, target: Array, action: Array):
        ctrl = rescale(action, low, high)
        return simulate(task, model, blank, data, target, ctrl, action_repeat=action_repeat)

    def observe(state: EnvState) -> Array:
        obs = jax.vmap(task.observe)(state.data, state.target)
        # The data is always finite, unless the caller edited the state.
        return jnp.where(jnp.isfinite(obs), obs, 0.0)

    @dtypes.usual()
    def reset(key: Key) -> tuple[EnvState, TimeStep]:
        target = jax.eval_shape(task.draw, key).target
        empty = EnvState(
            data=jax.tree.map(lambda x: jnp.broadcast_to(x, (num_envs, *x.shape)), blank),
            target=jnp.zeros((num_envs, *target.shape), target.dtype),
            steps=jnp.zeros(num_envs, jnp.int32),
            key=jax.random.split(key, num_envs),
        )
        everyone = jnp.ones(num_envs, bool)
        state = renew(begin, empty, everyone)
        return state, TimeStep(
            obs=observe(state),
            reward=jnp.zeros(num_envs, jnp.float32),
            is_first=everyone,
            is_last=~everyone,
            is_terminal=~everyone,
        )

    @dtypes.usual()
    def step(state: EnvState, action: Array) -> tuple[EnvState, TimeStep]:
        chex.assert_shape(action, (num_envs, spec.action_size))
        due = over(state.steps)
        data, reward, sound = jax.vmap(act)(state.data, state.target, action)
        failed = ~sound & ~due
        steps = state.steps + action_repeat
        state = EnvState(
            data=select(sound, data, state.data),  # a failure keeps the last sound state
            target=state.target,
            steps=jnp.where(failed, -steps, steps),
            key=state.key,
        )
        state = renew(begin, state, due)
        return state, TimeStep(
            obs=observe(state),
            reward=jnp.where(due | failed, 0.0, reward),
            is_first=due,
            is_last=over(state.steps),
            is_terminal=jnp.zeros(num_envs, bool),
        )

    return Environment(spec=spec, reset=reset, step=step)


def renew(
    begin: Callable[[Key], tuple[mjx.Data, Array]], state: EnvState, due: Array
) -> EnvState:
    """Starts a new episode where `due`; all keys advance if any episode starts.

    Ordinary steps cost nothing extra: the loop runs no iteration if no environment is due,
    even if the whole step is vmapped over seeds (a `lax.cond` would become a select and run
    both sides).

    Args:
      begin: draws the first state and the target of one environment.
      state: of N environments.
      due: `[N]` bool, which environments start a new episode.
    """

    def body(carry):
        state, due, attempt = carry
        key, key_begin = jax.vmap(lambda key: tuple(jax.random.split(key)))(state.key)
        data, target = jax.vmap(begin)(key_begin)
        state = EnvState(
            data=select(due, data, state.data),
            target=select(due, target, state.target),
            steps=jnp.where(due, 0, state.steps),
            key=key,
        )
        due = due & ~jax.vmap(physics.healthy)(data)  # draw unhealthy ones again
        return state, due, attempt + 1

    def anyone_due(carry):
        return carry[1].any() & (carry[2] < MAX_DRAWS)

    return jax.lax.while_loop(anyone_due, body, (state, due, jnp.int32(0)))[0]


def simulate(
    task: Task,
    model: mjx.Model,
    blank: mjx.Data,
    data: mjx.Data,
    target: Array,
    ctrl: Array,
    *,
    action_repeat: int,
) -> tuple[mjx.Data, Array, Array]:
    """`action_repeat` control steps of one environment.

    Returns:
      The new state, the sum of the rewards, and whether all of it is finite.
    """

    def control_step(carry):
        data, reward = carry
        data = physics.control_step(model, data, ctrl, substeps=task.substeps)
        return physics.keep(blank, data), reward + task.reward(data, target)

    start = physics.keep(blank, data), jnp.float32(0)
    data, reward = physics.repeat(control_step, start, action_repeat)
    obs = task.observe(data, target)
    sound = physics.healthy(data) & jnp.isfinite(obs).all() & jnp.isfinite(reward)
    return data, reward, sound


def first_state(
    task: Task, model: mjx.Model, blank: mjx.Data, key: Key
) -> tuple[mjx.Data, Array]:
    """Draws the first state and the target of one environment.

    dm_control ends a reset with a forward pass without actuation: the control is 0, and
    the solver's warm start is still 0 unless the task settles first.
    """

    def draw_again(carry):
        key, _, _, draws = carry
        key, key_draw = jax.random.split(key)
        start = task.draw(key_draw)
        data = blank.replace(qpos=start.qpos, qvel=start.qvel)
        return key, start, physics.collides(model, data), draws + 1

    def rejected(carry):
        return carry[2] & (carry[3] < MAX_DRAWS)

    if task.collision_free:
        nothing = jax.tree.map(jnp.zeros_like, jax.eval_shape(task.draw, key))
        first = key, nothing, jnp.bool_(True), jnp.int32(0)
        start = jax.lax.while_loop(rejected, draw_again, first)[1]
    else:
        start = task.draw(key)

    data = blank.replace(qpos=start.qpos, qvel=start.qvel)
    if task.settle:
        data = physics.coast(model, data, steps=task.settle)
        data = data.replace(time=blank.time)
    elif task.touch:
        data = physics.forward(model, data)
    else:
        data = physics.refresh(model, data)
    return physics.keep(blank, data), start.target


def over(steps: Array) -> Array:
    """Whether an episode has ended: 1000 control steps, or a failure (negative)."""
    return (steps >= EPISODE_STEPS) | (steps < 0)


def rescale(action: Array, low: np.ndarray, high: np.ndarray) -> Array:
    """Clips to [-1, 1] and maps linearly onto `[low, high]`; NaN counts as 0."""
    action = jnp.asarray(action, jnp.float32)
    action = jnp.clip(jnp.where(jnp.isnan(action), 0.0, action), -1.0, 1.0)
    return (high + low) / 2 + action * ((high - low) / 2)


def select(mask: Array, on_true, on_false):
    """`jnp.where` over the leading axis; for `mjx.Data`, on the `KEPT` fields only."""

    def pick(a, b):
        return jnp.where(mask.reshape(mask.shape + (1,) * (a.ndim - 1)), a, b)

    if not isinstance(on_true, mjx.Data):
        return pick(on_true, on_false)
    fields = {f: pick(getattr(on_true, f), getattr(on_false, f)) for f in physics.KEPT}
    return on_true.replace(**fields)


@dtypes.usual()
def obs_spec(task: Task, blank: mjx.Data) -> ArraySpec:
    """Shape and dtype of one observation, without computing one."""

    def first_obs(key):
        return task.observe(blank, task.draw(key).target)

    return jax.eval_shape(first_obs, jax.random.key(0))
