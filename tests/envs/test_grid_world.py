"""The grid world: its rules, its pixels, and Gymnasium's checks."""

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from vawm.envs import registration
from vawm.envs.grid_world import GOAL, WALKER, GridWorld
from vawm.envs.host import gymnasium as adapter


@pytest.fixture
def world():
    world = GridWorld()
    world.reset(seed=0)
    return world


def test_it_passes_the_checkers():
    env = gymnasium.make(registration.GRID_WORLD)
    check_env(env.unwrapped, skip_render_check=True)
    assert adapter.problems(gymnasium.make(registration.GRID_WORLD)) == []


def test_an_episode_has_50_steps():
    env = gymnasium.make(registration.GRID_WORLD)
    env.reset(seed=0)
    ends = [env.step(0)[2:4] for _ in range(50)]
    assert ends == [(False, False)] * 49 + [(False, True)]


@pytest.mark.parametrize(
    ("action", "moved", "stopped"),
    [
        (0, (-1, 0), (0, 1)),
        (1, (1, 0), (3, 1)),
        (2, (0, -1), (1, 0)),
        (3, (0, 1), (1, 3)),
    ],
)
def test_steps_move_one_field_and_edges_stop_the_walker(world, action, moved, stopped):
    world.goal = np.array([3, 3])
    world.walker = np.array([1, 1])
    world.step(action)
    assert tuple(world.walker - 1) == moved
    for _ in range(5):
        world.step(action)
    assert tuple(world.walker) == stopped


def test_reaching_a_goal_is_rewarded_once_and_moves_it(world):
    world.walker, world.goal = np.array([2, 2]), np.array([2, 3])
    picture, reward, *_ = world.step(3)
    assert reward == 1.0
    assert (world.goal != world.walker).any()
    np.testing.assert_array_equal(picture, world.render())
    rewards = [world.step(action)[1] for action in (0, 0, 0, 0)]
    assert sum(rewards) <= 1


def test_the_goal_appears_on_every_other_field(world):
    world.walker = np.array([1, 3])
    seen = set()
    for _ in range(500):
        world._move_goal()
        seen.add(tuple(world.goal.tolist()))
    assert seen == {(i, j) for i in range(4) for j in range(4)} - {(1, 3)}


def test_walker_and_goal_are_drawn_where_they_are(world):
    world.walker, world.goal = np.array([0, 0]), np.array([3, 2])
    picture = world.render()
    assert picture.shape == (64, 64, 3)
    assert (picture[:16, :16] == WALKER).all()
    assert (picture[48:, 32:48] == GOAL).all()
    assert (picture == GOAL).all(-1).sum() == (picture == WALKER).all(-1).sum() == 256
    assert picture.any(-1).sum() == 512
