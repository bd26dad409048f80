"""The film of vectors: named panels whose lines grow, green and then red."""

import numpy as np
import pytest

from vawm.analysis import motion
from vawm.analysis.trajectories import Trajectories
from vawm.losses.transforms import symlog
from vawm.runs.reports import video

NAMES = tuple(f"joint {i}" for i in range(10))


def made(size=10, steps=12, inside=12, context=4):
    rng = np.random.default_rng(0)
    truth = np.cumsum(rng.normal(size=(2, steps, size)), axis=1).astype(np.float32)
    guess = np.asarray(symlog(truth + rng.normal(size=truth.shape).astype(np.float32)))
    within = np.broadcast_to(np.arange(steps) < inside, (2, steps))
    return Trajectories(np.zeros(2, int), truth, guess, within, context)


def pixels(frame, color):
    return int((frame[motion.TITLE :] == color).all(-1).sum())


def test_lines_grow_green_while_it_observes_and_red_while_it_imagines():
    frames = motion.frames(made(), NAMES)
    assert frames.shape == (12, motion.TITLE + 4 * motion.HEIGHT, 2 * motion.WIDTH, 3)
    green = [pixels(frame, video.SEEN) for frame in frames]
    red = [pixels(frame, video.IMAGINED) for frame in frames]
    assert 0 < green[1] < green[3]
    assert red[3] < red[4] < red[-1]
    assert max(red[:3]) == 0


@pytest.mark.parametrize(("size", "panels"), [(1, (1, 1)), (3, (2, 2)), (10, (4, 2))])
def test_panels_are_as_many_as_coordinates_up_to_eight(size, panels):
    rows, columns = panels
    frames = motion.frames(made(size=size), NAMES)
    assert frames.shape[1:3] == (motion.TITLE + rows * motion.HEIGHT, columns * motion.WIDTH)


def test_a_window_ends_with_its_episode():
    assert len(motion.frames(made(inside=7), NAMES)) == 7


def test_names_are_drawn():
    same = made(size=1)
    one, other = (motion.frames(same, (name,))[0] for name in ("cart position", "pole"))
    assert (one != other).any()
