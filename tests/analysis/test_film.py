"""Films of truth, imagination and value: the content of the panels, and the GIF."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tiny
import tiny_pixels
from analysis_records import make_episodes, make_policy
from PIL import Image
from refusals import refused

from vawm.analysis import figures, film, trajectories
from vawm.policy import movies
from vawm.runs.reports import video
from vawm.types import EnvSpec

SPEC = EnvSpec("mixed", tiny_pixels.Lamp.obs, 2, False, 2, 1, None)
CONTEXT, DEPTH, SEED = 3, 4, 2
CHOICES = {"context": CONTEXT, "depth": DEPTH, "seed": SEED}


@pytest.fixture(scope="module")
def policy():
    model = dataclasses.replace(tiny.CONFIG.world_model, depth=1)
    return make_policy(dataclasses.replace(tiny.CONFIG, world_model=model), SPEC)


@pytest.fixture(scope="module")
def record(policy):
    return make_episodes(policy, episodes=1, length=13)


@pytest.fixture(scope="module")
def made(policy, record):
    return film.make(policy, record, **CHOICES)


def test_the_panels_are_of_the_window_that_trajectories_show(made, policy, record):
    shown = trajectories.imagine(policy, record, **CHOICES, at_most=1)
    np.testing.assert_array_equal(made.truth, shown.truth["picture"][0])
    told = np.clip(shown.predicted["picture"][0], 0, 1)
    np.testing.assert_allclose(made.imagined, 255 * told, atol=0.6)
    assert made.value.shape == (CONTEXT + DEPTH, 48, 48)
    assert (made.value.max((1, 2)) > 0).all()


def test_a_critic_that_says_the_same_everywhere_has_an_empty_map(policy, record):
    flat = jax.tree.map(jnp.zeros_like, policy.params.critic)
    indifferent = policy._replace(params=policy.params._replace(critic=flat))
    assert not film.make(indifferent, record, **CHOICES).value.any()


def test_a_short_episode_ends_the_film(policy, record):
    short = record._replace(length=np.array([5]))
    made = film.make(policy, short, **CHOICES)
    assert len(made.truth) == len(made.imagined) == len(made.value) == 4


def test_a_frame_has_three_panels_and_the_border_says_what_the_model_sees(made):
    frames = film.frames(made)
    side, left = 288, 288 + film.GAP  # 48 pixels, enlarged six times
    width = 3 * side + 2 * film.GAP
    assert frames.shape == (CONTEXT + DEPTH, film.TITLE + side, width, 3)
    for t, frame in enumerate(frames):
        color = video.SEEN if t < CONTEXT else video.IMAGINED
        assert tuple(frame[film.TITLE, left]) == tuple(frame[-1, left + side - 1]) == color
        assert tuple(frame[-1, side]) == film.PAPER
        # Enlarged smoothly: means of the panels are those of the pictures.
        panel = frame[film.TITLE :, :side]
        np.testing.assert_allclose(panel.mean(), made.truth[t].mean(), atol=2)
    heat = figures.heat(made.imagined, made.value)
    last = frames[-1, film.TITLE :, -side:]
    np.testing.assert_allclose(last.mean((0, 1)), heat[-1].mean((0, 1)), atol=2)


def test_a_gif_has_all_frames_and_repeats(made, tmp_path):
    frames = film.frames(made)
    movies.write_gif(frames, tmp_path / "a.gif", per_second=10)
    with Image.open(tmp_path / "a.gif") as read:
        assert read.n_frames == len(frames)
        assert read.size == frames.shape[2:0:-1]
        assert read.info["loop"] == 0
        assert read.info["duration"] == 100
        read.seek(len(frames) - 1)
        last = np.asarray(read.convert("RGB"), float)
    assert abs(last - frames[-1]).mean() < 6


def test_what_cannot_be_imagined_is_refused(policy, record):
    with refused("depth", 0):
        film.make(policy, record, context=3, depth=0, seed=0)
