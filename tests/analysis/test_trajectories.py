"""Windows of imagination against the truth, their errors, and films of them."""

import subprocess
import sys

import numpy as np
import pytest
import tiny
import tiny_vagram
from analysis_records import make_episodes, make_policy
from refusals import refused

from vawm.analysis import trajectories
from vawm.analysis.trajectories import Trajectories
from vawm.losses.transforms import symlog
from vawm.policy import movies


@pytest.fixture(
    scope="module", params=[tiny.CONFIG, tiny_vagram.CONFIG], ids=["rssm", "vagram"]
)
def played(request):
    policy = make_policy(request.param, tiny.env().spec)
    return policy, make_episodes(policy, episodes=3, length=10)


def test_a_window_lies_in_its_episode(played):
    policy, record = played
    found = trajectories.imagine(policy, record, context=3, depth=4, seed=3, at_most=2)
    assert found.predicted.shape == found.truth.shape == (2, 7, 2)
    assert found.inside.all()
    for row, start in enumerate(found.start):
        assert 1 <= start <= 3
        seen = record.trajectory.obs[row, start : start + 7]
        np.testing.assert_array_equal(found.truth[row], seen)


def test_a_window_longer_than_the_episode_marks_the_steps_inside(played):
    policy, record = played
    short = record._replace(length=np.array([4, 6, 10]))
    found = trajectories.imagine(policy, short, context=3, depth=4, seed=0, at_most=2)
    np.testing.assert_array_equal(found.start, [1, 1])
    assert found.inside.tolist() == [3 * [True] + 4 * [False], 5 * [True] + 2 * [False]]


def hand():
    truth = {
        "picture": np.full((2, 3, 48, 48, 3), 51, np.uint8),
        "vector": np.array([[[0.0], [1.0], [3.0]], [[0.0], [-1.0], [9.0]]], np.float32),
    }
    predicted = {
        "picture": np.full((2, 3, 48, 48, 3), 0.5, np.float32),
        "vector": np.asarray(symlog(truth["vector"])) + np.float32([[[1.0]], [[2.0]]]),
    }
    inside = np.array([[True, True, True], [True, True, False]])
    return Trajectories(np.array([1, 1]), truth, predicted, inside, context=1)


def test_errors_by_hand():
    """Images by (0.5 - 51 / 255)^2, vectors by 1 and 4, of which the last is outside."""
    errors = trajectories.errors(hand())
    np.testing.assert_allclose(errors["image"], 3 * [0.09], rtol=1e-6)
    np.testing.assert_allclose(errors["vector"], [2.5, 2.5, 1.0], rtol=1e-6)
    rows = trajectories.rows("run", hand())
    assert [(row["depth"], row["windows"]) for row in rows[:3]] == [(0, 2), (1, 2), (2, 1)]


def test_vectors_are_in_the_decoders_units():
    truth, guess = trajectories.vectors(hand())
    np.testing.assert_allclose(guess - truth, [3 * [[1.0]], 3 * [[2.0]]], atol=1e-6)


def test_a_film_is_written_and_read_again(tmp_path):
    frames = trajectories.film(hand())
    assert frames.shape == (3, 3 * 48, 2 * 48, 3)
    import imageio.v3 as imageio

    path = tmp_path / "a.mp4"
    movies.write_mp4(frames[:, :-1, :-1], path, enlarge=1)
    read = imageio.imread(path, plugin="FFMPEG")
    assert read.shape == frames.shape  # odd sides get one more
    inner = read[:, 60:80, 10:30].astype(float).mean((0, 1, 2))
    np.testing.assert_allclose(inner, 128, atol=6)  # imagined: 0.5


def test_a_missing_encoder_is_one_line(monkeypatch, tmp_path):
    monkeypatch.setattr(movies.importlib.util, "find_spec", lambda _: None)
    with refused("imageio", naming="vawm[analysis]"):
        movies.write_mp4(np.zeros((1, 4, 4, 3), np.uint8), tmp_path / "a.mp4")


def test_an_impossible_depth_is_refused(played):
    with refused("depth", 0):
        trajectories.imagine(*played, context=3, depth=0, seed=0)


def test_importing_the_package_does_not_import_matplotlib_or_imageio():
    script = (
        "import sys, vawm.analysis.figures, vawm.policy.movies, vawm.analysis.values;"
        "sys.exit(any(name in sys.modules for name in ('matplotlib', 'imageio')))"
    )
    assert subprocess.run([sys.executable, "-c", script], check=False).returncode == 0
