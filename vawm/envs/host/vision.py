"""Tasks of the DeepMind Control Suite from pixels, simulated and rendered by dm_control.

A control step of physics takes less than 0.2 ms; drawing a frame on a CPU takes 10 to 40 ms.
So only one frame per step is drawn, whatever the action repeat.
"""

from __future__ import annotations

import math
from typing import Any, cast

import numpy as np

from vawm.envs import DOMAINS, EPISODE_STEPS, TASKS
from vawm.envs.host import rendering
from vawm.envs.host.simulator import Outcome
from vawm.envs.protocol import check_positive
from vawm.errors import InvalidInput, suggestion
from vawm.types import PyTree, image

VISION_TASKS = tuple(sorted((*TASKS, "quadruped_run", "quadruped_walk")))
LARGE = 256  # pixels a side of a picture to look at
USUAL = -1
"""Selects the default camera of the task."""
CAMERAS = {"quadruped": 2}
"""Domain -> its default camera, 0 for all others; as in DreamerV3."""


class VisionSimulator:
    """One task as a `Simulator`; observations are `[image_size, image_size, 3]` uint8.

    An episode equals the first one of `suite.load(domain, task, {"random": seed})`.
    Everything that dm_control keeps between episodes is either drawn again at a reset
    (targets) or constant (sizes, damping), so the environment is never rebuilt.

    Equal episodes have bit-identical frames only with the same backend, driver and hardware.

    With `fast_rendering`, frames have no shadows, no floor reflections and jagged edges.
    Areas lit by a light that casts shadows are darker: the frame by up to 8 %, in pendulum
    by a fifth, in reacher by a third. On a CPU it is 8 to 20 times as fast. A simulator
    needs about 65 MB if Mesa draws, 45 MB with fast rendering.

    Args:
      task: one of `VISION_TASKS`.
      image_size: pixels per side.
      camera: index in dm_control's model; -1 for the default camera.
      renderer: "egl", "osmesa", or "auto" for the first that works, see
        `rendering.choose`. The first simulator of a process decides for all.
      fast_rendering: False for exactly the pixels that dm_control renders by default.
      action_repeat: control steps per step; their rewards are summed.

    Raises:
      InvalidInput: an unknown task, an impossible number, or a renderer that does not work.
    """

    obs: PyTree
    action_size: int
    discrete: bool = False
    episode_length: int | None = None
    _large: tuple[Any, Any] | None

    def __init__(
        self,
        task: str,
        *,
        image_size: int,
        camera: int,
        renderer: str,
        fast_rendering: bool,
        action_repeat: int,
    ):
        check_vision_task(task)
        check_positive("env.image_size", image_size)
        check_positive("action_repeat", action_repeat)
        known = renderer in rendering.BACKENDS  # then the caller has already tried it
        rendering.use(cast(Any, renderer) if known else rendering.choose(renderer))
        from dm_control import mujoco, suite

        domain = next(name for name in (*DOMAINS, *CAMERAS) if task.startswith(name))
        self._env = suite.load(domain, task.removeprefix(f"{domain}_"))
        physics, spec = self._env.physics, self._env.action_spec()
        visual = physics.model.vis
        # Read when the first camera makes the context. Buffers larger than a frame only
        # waste memory, 20 MB each time.
        visual.global_.offwidth = visual.global_.offheight = image_size
        if fast_rendering:
            visual.quality.offsamples = visual.quality.shadowsize = 0
        self._flags = {"shadow": False, "reflection": False} if fast_rendering else None
        number = check_camera(camera, domain, cameras=physics.model.ncam)
        self._camera = mujoco.Camera(physics, image_size, image_size, number)
        self._number, self._large = number, None
        self._low, self._high = spec.minimum, spec.maximum
        self._action_repeat = action_repeat
        self.obs = image(image_size)
        self.action_size = spec.shape[0]
        self.episode_length = math.ceil(EPISODE_STEPS / action_repeat)

    def reset(self, seed: int) -> np.ndarray:
        """Starts the episode that dm_control draws from `seed`."""
        self._env.task.random.seed(seed)
        self._env.reset()
        return self._frame()

    def step(self, action: np.ndarray | int) -> Outcome:
        """Takes `action_repeat` control steps, fewer if the episode ends before.

        Raises:
          dm_control.rl.control.PhysicsError: the simulation diverged.
        """
        control = to_actuator(action, self._low, self._high)
        latest, reward = repeat(self._env, control, self._action_repeat)
        return outcome(self._frame(), latest, reward)

    def picture(self) -> np.ndarray:
        """What the agent sees, but large: `[LARGE, LARGE, 3]` uint8."""
        if self._large is None:
            self._large = self._make_large()
        physics, camera = self._large
        physics.set_state(self._env.physics.get_state())
        physics.forward()
        return camera.render(render_flag_overrides=self._flags).copy()

    def _make_large(self) -> tuple[Any, Any]:
        """A copy of the physics that shares the model, with a camera of its own.

        The size of a context cannot change, and that of the agent's frames must not.
        """
        from dm_control import mujoco

        physics = self._env.physics.copy(share_model=True)
        visual = physics.model.vis.global_
        visual.offwidth = visual.offheight = LARGE
        return physics, mujoco.Camera(physics, LARGE, LARGE, self._number)

    def close(self) -> None:
        """Frees the rendering context and the simulation; a second call does nothing."""
        if self._large is not None:
            self._large[0].free()
            self._large = None
        self._env.physics.free()

    def _frame(self) -> np.ndarray:
        # Copy: dm_control returns a flipped view of its camera's buffer.
        return self._camera.render(render_flag_overrides=self._flags).copy()


def check_vision_task(task: str) -> None:
    """Refuses a name outside `VISION_TASKS` and suggests the nearest one.

    Raises:
      InvalidInput: names the nearest task and all tasks.
    """
    if task in VISION_TASKS:
        return
    remedy = f"{suggestion(task, VISION_TASKS)}choose one of {', '.join(VISION_TASKS)}"
    raise InvalidInput("task", task, remedy)


def check_camera(camera: int, domain: str, *, cameras: int) -> int:
    """The index of a camera in a model with `cameras` of them; resolves the default.

    Raises:
      InvalidInput: there is no such camera.
    """
    if camera == USUAL:
        return CAMERAS.get(domain, 0)
    if not 0 <= camera < cameras:
        remedy = f"use one of {domain}'s cameras, 0 to {cameras - 1}, or -1 for the default"
        raise InvalidInput("env.camera", camera, remedy)
    return camera


def repeat(env: Any, control: np.ndarray, times: int) -> tuple[Any, float]:
    """Takes control steps until the episode ends: the last one, and the sum of rewards."""
    reward = 0.0
    for _ in range(times):
        latest = env.step(control)
        reward += latest.reward
        if latest.last():
            break
    return latest, float(reward)


def outcome(obs: np.ndarray, latest: Any, reward: float) -> Outcome:
    """What a simulator says of dm_control's `latest` step."""
    return Outcome(obs, reward, latest.last(), bool(latest.discount == 0))


def to_actuator(action: np.ndarray | int, low: np.ndarray, high: np.ndarray) -> np.ndarray:
    """Clips to [-1, 1] and maps linearly onto `[low, high]`, in float64."""
    action = np.clip(np.asarray(action, np.float64), -1.0, 1.0)
    return (high + low) / 2 + action * ((high - low) / 2)
