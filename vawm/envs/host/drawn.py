"""Proprio tasks as dm_control simulates and draws them, for films of what was trained on MJX.

MJX cannot draw. Its tasks are those of dm_control, with the same observations, rewards and
episodes; see `tests/envs/test_parity.py`.
"""

from __future__ import annotations

import math
from typing import Any, cast

import numpy as np

from vawm.envs import EPISODE_STEPS, check_task, split
from vawm.envs.host import rendering
from vawm.envs.host.simulator import Outcome
from vawm.envs.host.vision import USUAL, check_camera, outcome, repeat, to_actuator
from vawm.envs.protocol import check_positive
from vawm.types import PyTree, vector

HEIGHT, WIDTH = 256, 320  # pixels of a picture


class ProprioSimulator:
    """One task as a `Simulator`; observations are vectors, in dm_control's order.

    Args:
      task: one of `vawm.envs.TASKS`.
      renderer: "egl" or "osmesa", which works here; see `rendering.choose`.
      action_repeat: control steps per step; their rewards are summed.

    Raises:
      InvalidInput: an unknown task, an impossible number, or another renderer is loaded.
    """

    obs: PyTree
    action_size: int
    discrete: bool = False
    episode_length: int | None = None

    def __init__(self, task: str, *, renderer: str, action_repeat: int):
        check_task(task)
        check_positive("action_repeat", action_repeat)
        rendering.use(cast(Any, renderer))
        import mujoco
        from dm_control import mujoco as control
        from dm_control import suite

        mujoco.set_mju_user_warning(lambda message: None)  # it would go to a file
        domain, name = split(task)
        self._env = suite.load(domain, name)
        physics, actions = self._env.physics, self._env.action_spec()
        visual = physics.model.vis.global_
        visual.offwidth, visual.offheight = WIDTH, HEIGHT
        number = check_camera(USUAL, domain, cameras=physics.model.ncam)
        self._camera = control.Camera(physics, HEIGHT, WIDTH, number)
        self._low, self._high = actions.minimum, actions.maximum
        self._action_repeat = action_repeat
        self.obs = vector(
            sum(math.prod(x.shape) for x in self._env.observation_spec().values())
        )
        self.action_size = actions.shape[0]
        self.episode_length = math.ceil(EPISODE_STEPS / action_repeat)

    def reset(self, seed: int) -> np.ndarray:
        """Starts the episode that dm_control draws from `seed`."""
        self._env.task.random.seed(seed)
        return flat(self._env.reset().observation)

    def step(self, action: np.ndarray | int) -> Outcome:
        """Takes `action_repeat` control steps, fewer if the episode ends before."""
        control = to_actuator(action, self._low, self._high)
        latest, reward = repeat(self._env, control, self._action_repeat)
        return outcome(flat(latest.observation), latest, reward)

    def picture(self) -> np.ndarray:
        """The task as it is now, `[HEIGHT, WIDTH, 3]` uint8."""
        return self._camera.render().copy()

    def close(self) -> None:
        """Frees the rendering context and the simulation."""
        self._env.physics.free()


def flat(observation: Any) -> np.ndarray:
    """dm_control's entries in its order, as one float32 vector."""
    return np.concatenate([np.ravel(x) for x in observation.values()]).astype(np.float32)
