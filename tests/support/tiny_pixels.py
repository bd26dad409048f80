"""The tiny configuration for an environment with pixels, and that environment."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import tiny

from vawm.config import Config, GymnasiumConfig, VideoConfig
from vawm.envs.host.pool import Pool
from vawm.envs.host.simulator import Outcome
from vawm.types import image, vector

CONFIG = dataclasses.replace(
    tiny.CONFIG,
    suite="gymnasium",
    task="lamp",
    world_model=dataclasses.replace(tiny.CONFIG.world_model, depth=1),
    video=VideoConfig(every=48, sequences=2, context=3, episode_steps=4),
    env=GymnasiumConfig(workers=1),
)


def config(images: str = "device", **changes: Any) -> Config:
    """`CONFIG` with some top-level fields replaced."""
    replay = dataclasses.replace(CONFIG.replay, images=images)
    return dataclasses.replace(CONFIG, **{"replay": replay} | changes)


class Lamp:
    """Episodes of 4 steps; reward 1 for the action of the lamp's side: 0 left, 1 right."""

    obs = {"clock": vector(1), "picture": image(48)}  # noqa: RUF012
    action_size = 2
    discrete = True
    episode_length = 4

    def reset(self, seed):
        self.random, self.steps = np.random.default_rng(seed), 0
        return self._look()

    def step(self, action):
        reward = float(action == self.side)
        self.steps += 1
        return Outcome(self._look(), reward, self.steps == 4, self.steps == 4)

    def close(self):
        pass

    def _look(self):
        self.side = int(self.random.integers(2))
        picture = np.zeros((48, 48, 3), np.uint8)
        picture[:, 24 * self.side : 24 * self.side + 24] = 50 * (self.steps + 1)
        return {"clock": np.array([self.steps], np.float32), "picture": picture}


class Picture(Lamp):
    """The picture of the lamp alone as the observation, without a dict."""

    obs = image(48)

    def _look(self):
        return super()._look()["picture"]


def pool(make=Lamp, **changes: Any) -> Pool:
    """Environments for `CONFIG`."""
    choices = {"workers": 1, "timeout": 30.0, "on_failure": "raise"}
    return Pool(make, task=CONFIG.task, num_envs=CONFIG.num_envs, **choices | changes)
