"""Our environments through Gymnasium.

The MJX tasks are registered: `gymnasium.make("vawm/walker_walk-v0")` and `make_vec`. Episodes
are truncated after 1000 control steps and never terminated. If the physics fails, the episode
is truncated early and `info["physics_failed"]` is set. The first `reset` and `step` compile.

`PureEnv` is any `Environment`, `HostEnv` any `HostEnvironment`, one of each.
"""

from __future__ import annotations

from typing import Any

import gymnasium
import jax
import jax.numpy as jnp
import numpy as np
from gymnasium import spaces
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space

from vawm import envs
from vawm.envs.protocol import Environment, HostEnvironment
from vawm.types import ArraySpec, EnvSpec, TimeStep, is_image


class PureEnv(gymnasium.Env):
    """One environment of pure functions, numpy in and out."""

    metadata = {"render_modes": []}  # noqa: RUF012 (an instance variable of the base)

    def __init__(self, env: Environment):
        """Takes an environment with `num_envs` 1."""
        self._env = compiled(env)
        self.observation_space, self.action_space = make_spaces(env.spec)
        self._state: Any = None  # an EnvState after the first reset

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        """Starts a random episode; equal seeds give equal episodes."""
        super().reset(seed=seed)
        self._state, timestep = self._env.reset(draw_key(self.np_random))
        return first(timestep.obs), {}

    def step(self, action):
        """Takes `action_repeat` control steps; numbers are clipped to [-1, 1]."""
        raw = jnp.asarray(to_raw(action, self._env.spec))
        self._state, timestep = self._env.step(self._state, raw)
        failed = bool(self._state.steps[0] < 0)
        return *first(outcome(timestep)), {"physics_failed": True} if failed else {}


class SingleEnv(PureEnv):
    """One environment of an MJX task."""

    def __init__(self, task: str, action_repeat: int = 1):
        super().__init__(envs.make(task, num_envs=1, action_repeat=action_repeat))


class HostEnv(gymnasium.Env):
    """One environment that runs in a process of its own, until it is closed."""

    metadata = {"render_modes": ["rgb_array"]}  # noqa: RUF012

    def __init__(self, env: HostEnvironment, render_mode: str | None = None):
        """Takes over an environment with `num_envs` 1.

        Args:
          env: the environment.
          render_mode: "rgb_array" to let `render` return the latest image.
        """
        self._env = env
        self._latest: Any = None
        self.render_mode = render_mode
        self.observation_space, self.action_space = make_spaces(env.spec)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        """Starts an episode; equal seeds give equal episodes."""
        super().reset(seed=seed)
        timestep = self._env.reset(int(self.np_random.integers(2**31)))
        self._latest = first(timestep.obs)
        return self._latest, {}

    def step(self, action):
        """Takes `action_repeat` control steps; numbers are clipped to [-1, 1]."""
        self._env.send(to_raw(action, self._env.spec))
        obs, *rest = first(outcome(self._env.receive()))
        self._latest = obs
        return obs, *rest, {}

    def render(self) -> np.ndarray | None:  # type: ignore[override]
        """The latest image, `[height, width, channels]` uint8; None without a render mode."""
        if self.render_mode is None:
            return None
        return next(filter(is_image, jax.tree.leaves(self._latest)), None)

    def close(self) -> None:
        """Ends the process."""
        self._env.close()


class BatchedEnv(VectorEnv):
    """N environments in one compiled call; each resets at the step after its last one."""

    metadata = {  # noqa: RUF012
        "render_modes": [],
        "autoreset_mode": AutoresetMode.NEXT_STEP,
    }

    def __init__(self, task: str, num_envs: int = 1, action_repeat: int = 1):
        self._env = compiled(envs.make(task, num_envs=num_envs, action_repeat=action_repeat))
        self.num_envs = num_envs
        self.single_observation_space, self.single_action_space = make_spaces(self._env.spec)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.action_space = batch_space(self.single_action_space, num_envs)
        self._state: Any = None  # an EnvState after the first reset

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        """Starts an episode in all environments, from one seed."""
        super().reset(seed=seed)
        self._state, timestep = self._env.reset(draw_key(self.np_random))
        return np.asarray(timestep.obs), {}

    def step(self, actions):
        """Takes `action_repeat` control steps in each environment."""
        self._state, timestep = self._env.step(self._state, jnp.asarray(actions, jnp.float32))
        failed = np.asarray(self._state.steps) < 0
        info = {"physics_failed": failed, "_physics_failed": failed} if failed.any() else {}
        return *outcome(timestep), info


def compiled(env: Environment) -> Environment:
    """Jits both functions; `step` donates the state, so each state can be used once."""
    return env._replace(reset=jax.jit(env.reset), step=jax.jit(env.step, donate_argnums=0))


def make_spaces(spec: EnvSpec) -> tuple[spaces.Space, spaces.Space]:
    """The observation space and the action space of one environment."""
    if isinstance(spec.obs, dict):
        observation: spaces.Space = spaces.Dict(
            {name: space_of(array) for name, array in spec.obs.items()}
        )
    else:
        observation = space_of(spec.obs)
    if spec.discrete:
        return observation, spaces.Discrete(spec.action_size)
    return observation, spaces.Box(-1.0, 1.0, (spec.action_size,), np.float32)


def space_of(array: ArraySpec) -> spaces.Box:
    """Bytes for an image, any numbers for a vector."""
    if is_image(array):
        return spaces.Box(0, 255, array.shape, np.uint8)
    return spaces.Box(-np.inf, np.inf, array.shape, np.float32)


def to_raw(action: Any, spec: EnvSpec) -> np.ndarray:
    """`[1, action_size]` float32, from an action of `make_spaces`."""
    if spec.discrete:
        return np.eye(spec.action_size, dtype=np.float32)[[int(action)]]
    return np.asarray(action, np.float32)[None]


def first(tree: Any) -> Any:
    """What belongs to the first environment; numbers and flags as Python has them."""
    own = jax.tree.map(lambda x: np.asarray(x)[0], tree)
    return jax.tree.map(lambda x: x if x.shape else x.item(), own)


def draw_key(generator: np.random.Generator) -> jax.Array:
    """A JAX key from Gymnasium's generator."""
    return jax.random.key(int(generator.integers(2**31)))


def outcome(timestep: TimeStep) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """(obs, reward, terminated, truncated), each `[N, ...]`."""
    is_last, is_terminal = np.asarray(timestep.is_last), np.asarray(timestep.is_terminal)
    obs = jax.tree.map(np.asarray, timestep.obs)
    # A lost life may end the return without ending the episode.
    return obs, np.asarray(timestep.reward), is_last & is_terminal, is_last & ~is_terminal
