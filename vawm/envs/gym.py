"""The MJX tasks through Gymnasium: `gymnasium.make("vawm/walker_walk-v0")` and `make_vec`.

Episodes are truncated after 1000 control steps and never terminated. If the physics fails,
the episode is truncated early and `info["physics_failed"]` is set. The first `reset` and
`step` compile.
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
from vawm.envs.protocol import Environment
from vawm.types import EnvSpec, TimeStep


class SingleEnv(gymnasium.Env):
    """One environment, numpy in and out."""

    metadata = {"render_modes": []}  # noqa: RUF012 (an instance variable of the base)

    def __init__(self, task: str, action_repeat: int = 1):
        self._env = compiled(envs.make(task, num_envs=1, action_repeat=action_repeat))
        self.observation_space, self.action_space = make_spaces(self._env.spec)
        self._state: Any = None  # an EnvState after the first reset

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        """Starts a random episode; equal seeds give equal episodes."""
        super().reset(seed=seed)
        self._state, timestep = self._env.reset(draw_key(self.np_random))
        return np.asarray(timestep.obs[0]), {}

    def step(self, action):
        """Takes `action_repeat` control steps; clips the action to [-1, 1]."""
        action = jnp.asarray(action, jnp.float32)[None]
        self._state, timestep = self._env.step(self._state, action)
        obs, reward, terminated, truncated = outcome(timestep)
        failed = bool(self._state.steps[0] < 0)
        info = {"physics_failed": True} if failed else {}
        return obs[0], float(reward[0]), bool(terminated[0]), bool(truncated[0]), info


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


def make_spaces(spec: EnvSpec) -> tuple[spaces.Box, spaces.Box]:
    """The observation space and the action space of one environment."""
    observation = spaces.Box(-np.inf, np.inf, spec.obs.shape, np.float32)
    return observation, spaces.Box(-1.0, 1.0, (spec.action_size,), np.float32)


def draw_key(generator: np.random.Generator) -> jax.Array:
    """A JAX key from Gymnasium's generator."""
    return jax.random.key(int(generator.integers(2**31)))


def outcome(timestep: TimeStep) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """(obs, reward, terminated, truncated), each `[N, ...]`."""
    terminated = np.asarray(timestep.is_terminal)
    truncated = np.asarray(timestep.is_last) & ~terminated
    return np.asarray(timestep.obs), np.asarray(timestep.reward), terminated, truncated
