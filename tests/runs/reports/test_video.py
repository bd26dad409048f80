"""Videos: composed frames, the episode that is shown, and GIF files."""

import io

import numpy as np
import pytest
from PIL import Image

from vawm.runs.reports import video


def sequences(value, batch=2, length=4):
    return np.full((batch, length, 8, 8, 3), value, np.uint8)


def test_truth_prediction_and_error_are_stacked():
    truth = sequences(51)  # 0.2
    predicted = np.full((2, 4, 8, 8, 3), 0.6)
    same = np.ones((2, 4), bool)
    made = video.open_loop_video(truth, predicted, same, context=1)
    assert made.frames.shape == (4, 24, 16, 3)
    assert made.frames.dtype == np.uint8
    inside = made.frames[:, :, 2:6]  # of the first sequence, within its border
    assert (inside[:, 2:8] == 51).all()
    assert (inside[:, 8:16] == 153).all()
    assert (abs(inside[:, 16:22] - 255 * (0.4 + 1) / 2) <= 1).all()
    np.testing.assert_allclose(made.numbers["error"], [0.4**2] * 4, rtol=1e-5)
    assert made.numbers["context"] == 1


def test_the_border_colour_shows_whether_the_model_observes():
    frames = video.open_loop_video(
        sequences(0), np.zeros((2, 4, 8, 8, 3)), np.ones((2, 4), bool), context=2
    ).frames
    corners = frames[:, [0, 0, -1, -1], [0, 15, 0, 8]]
    assert (corners[:2] == video.SEEN).all()
    assert (corners[2:] == video.IMAGINED).all()


def test_errors_exclude_sequences_after_a_reset():
    truth, predicted = sequences(0), np.zeros((2, 4, 8, 8, 3))
    predicted[0] = 1.0
    same = np.array([[True, True, False, False], [True, True, True, False]])
    numbers = video.open_loop_video(truth, predicted, same, context=1).numbers
    assert numbers["error"] == [0.5, 0.5, 0.0, None]


def test_the_error_of_a_prediction_that_is_not_finite_is_none():
    predicted = np.full((2, 4, 8, 8, 3), np.nan)
    made = video.open_loop_video(sequences(0), predicted, np.ones((2, 4), bool), context=1)
    assert made.numbers["error"] == [None] * 4


def test_the_error_is_computed_before_rounding_over_all_channels():
    truth = np.concatenate([sequences(0), sequences(255)[..., :1]], -1)
    predicted = np.full((2, 4, 8, 8, 4), 0.001)  # less than one level of a byte
    made = video.open_loop_video(truth, predicted, np.ones((2, 4), bool), context=1)
    assert made.numbers["error"] == pytest.approx([(3 * 0.001**2 + 0.999**2) / 4] * 4)


def test_images_of_mixed_observations_are_shown_side_by_side():
    obs = {
        "a": sequences(9),
        "b": np.zeros((2, 4, 3), np.float32),
        "c": sequences(5)[..., :1],
        "d": np.concatenate([sequences(1), sequences(2)], -1),
    }
    shown = video.side_by_side(obs)
    assert shown.shape == (2, 4, 8, 24, 3)
    assert [shown[0, 0, 0, x, 2] for x in (0, 8, 16)] == [9, 5, 1]


def flags(length, *places):
    result = np.zeros(length, bool)
    result[list(places)] = True
    return result


@pytest.mark.parametrize(
    ("first", "last", "head", "size", "expected"),
    [
        ([0], [3], 6, 6, [0, 1, 2, 3]),
        ([0, 4], [3], 8, 8, [0, 1, 2, 3]),  # the running episode is incomplete
        ([0, 3], [2, 5], 6, 6, [3, 4, 5]),  # the newest
        ([], [2, 5], 6, 6, None),  # its start is overwritten
        ([1], [0], 6, 6, None),
        ([0, 2], [4], 6, 6, [2, 3, 4]),  # a reset ended the first one early
        ([6], [1], 4, 8, [6, 7, 0, 1]),  # across the end of the ring
        ([0], [3], 0, 0, None),
    ],
)
def test_the_newest_complete_episode_is_found(first, last, head, size, expected):
    actual = video.last_episode(flags(8, *first), flags(8, *last), head=head, size=size)
    assert (None if actual is None else actual.tolist()) == expected


def test_a_gif_has_all_frames_in_their_colours():
    frames = np.stack([np.full((16, 24, 3), c, np.uint8) for c in (0, 128, 255)])
    gif = Image.open(io.BytesIO(video.as_gif(frames)))
    assert (gif.format, gif.n_frames, gif.size) == ("GIF", 3, (24, 16))
    for i, color in enumerate((0, 128, 255)):
        gif.seek(i)
        assert np.asarray(gif.convert("RGB")).mean() == color
        assert gif.info["duration"] == 50
