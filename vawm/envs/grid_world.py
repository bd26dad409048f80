"""A small pixel environment: walk to the goal, then to the next one.

Registered with Gymnasium as "vawm/GridWorld-v0": episodes of 50 steps on 4 x 4 fields, drawn as
64 x 64 pixels. Reaching the goal gives reward 1 and moves the goal somewhere else. Walking
straight to each goal returns 18 per episode, random actions return 1.6.
"""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces

FIELDS = 4  # a side
FIELD = 16  # pixels a side
SIZE = FIELDS * FIELD
WALKER, GOAL = (255, 255, 255), (0, 255, 0)
MOVES = np.array([(-1, 0), (1, 0), (0, -1), (0, 1)])  # up, down, left, right


class GridWorld(gymnasium.Env):
    """Observations are `[64, 64, 3]` uint8, actions 0 to 3: up, down, left, right."""

    metadata = {"render_modes": ["rgb_array"]}  # noqa: RUF012 (of the base)

    def __init__(self, render_mode: str | None = None):
        self.render_mode = render_mode
        self.observation_space = spaces.Box(0, 255, (SIZE, SIZE, 3), np.uint8)
        self.action_space = spaces.Discrete(len(MOVES))

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        """Puts walker and goal on two different random fields."""
        super().reset(seed=seed)
        self.walker = self.np_random.integers(FIELDS, size=2)
        self._move_goal()
        return self.render(), {}

    def step(self, action: int):
        """Moves by one field; the edge stops the walker."""
        self.walker = np.clip(self.walker + MOVES[action], 0, FIELDS - 1)
        reached = bool((self.walker == self.goal).all())
        if reached:
            self._move_goal()
        return self.render(), float(reached), False, False, {}

    def render(self) -> np.ndarray:  # type: ignore[override]
        """`[64, 64, 3]` uint8 picture of the fields from above."""
        picture = np.zeros((SIZE, SIZE, 3), np.uint8)
        for (row, column), color in ((self.goal, GOAL), (self.walker, WALKER)):
            top, left = FIELD * row, FIELD * column
            picture[top : top + FIELD, left : left + FIELD] = color
        return picture

    def _move_goal(self) -> None:
        """Puts the goal on a random field without the walker."""
        index = self.np_random.integers(FIELDS**2 - 1)
        here = self.walker[0] * FIELDS + self.walker[1]
        self.goal = np.array(divmod(index + (index >= here), FIELDS))
