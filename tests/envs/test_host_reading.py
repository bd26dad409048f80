"""How observations of a space become vectors and images."""

import pickle

import gymnasium
import jax.numpy as jnp
import numpy as np
import PIL.Image
import pytest
from gymnasium import spaces

from vawm.envs.host.reading import SMALLEST_IMAGE, read
from vawm.envs.host.usable import Unusable
from vawm.types import image, vector


def pixels(*shape, low=0, high=255):
    return spaces.Box(low, high, shape, np.uint8)


def random_pixels(*shape):
    return np.random.default_rng(0).integers(256, size=shape, dtype=np.uint8)


def convert(space, obs, image_size=64):
    """The converted observation, after checking it against the spec and a pickled copy."""
    reading = read(space, image_size=image_size)
    assert reading.problems == ()
    copy = pickle.loads(pickle.dumps(reading))
    assert copy == reading
    result = copy.convert(obs)
    named, specs = (result, reading.spec) if isinstance(result, dict) else ({"": result}, None)
    specs = specs or {"": reading.spec}
    assert named.keys() == specs.keys()
    for name, array in named.items():
        assert (array.shape, array.dtype) == (specs[name].shape, specs[name].dtype)
    return result


# Numbers and choices.


@pytest.mark.parametrize("obs", [3, np.int64(3), np.array(3), jnp.int32(3)])
def test_a_choice_is_one_hot_from_its_start(obs):
    np.testing.assert_array_equal(convert(spaces.Discrete(4, start=2), obs), [0, 1, 0, 0])


def test_several_choices_are_one_hot_one_after_the_other():
    space = spaces.MultiDiscrete([2, 3], start=[0, -1])
    np.testing.assert_array_equal(convert(space, np.array([1, -1])), [0, 1, 1, 0, 0])
    space = spaces.MultiDiscrete([[2, 2], [1, 3]])
    obs = np.array([[0, 1], [0, 2]])
    np.testing.assert_array_equal(convert(space, obs), [1, 0, 0, 1, 1, 0, 0, 1])


def test_binary_entries_are_numbers():
    obs = np.array([[1, 0], [0, 1]], np.int8)
    np.testing.assert_array_equal(convert(spaces.MultiBinary((2, 2)), obs), [1, 0, 0, 1])


def test_a_box_of_any_shape_is_a_vector():
    obs = np.arange(24.0).reshape(1, 2, 3, 4)
    space = spaces.Box(-np.inf, np.inf, obs.shape, np.float64)
    np.testing.assert_array_equal(convert(space, obs), np.arange(24))
    assert convert(spaces.Box(0, 9, (), np.int16), np.int16(5)).tolist() == [5]
    bfloat = jnp.ones(3, jnp.bfloat16)
    np.testing.assert_array_equal(convert(spaces.Box(0, 9, (3,)), bfloat), [1, 1, 1])


@pytest.mark.parametrize(
    ("space", "obs", "name"),
    [
        (spaces.Box(0, 1, (2,)), np.zeros(3), "obs"),
        (spaces.Box(0, 1, (2,)), [[0, 1], [0]], "obs"),
        (spaces.Box(0, 1, (2,)), np.array(["0", "1"]), "obs"),
        (spaces.Box(0, 1, (2,)), np.array([0, np.nan]), "obs[1]"),
        (spaces.Box(0, 1, (2,)), np.array([1e39, 0]), "obs[0]"),
        (spaces.Box(0, 1, (2, 2)), np.array([[0, 0], [0, -(2.0**200)]]), "obs[1, 1]"),
        (spaces.Discrete(3), 3, "obs"),
        (spaces.Discrete(3, start=1), 0, "obs"),
        (spaces.Discrete(3), 1.0, "obs"),
        (spaces.MultiDiscrete([2, 2]), np.array([1, 2]), "obs[1]"),
        (pixels(16, 16), np.zeros((16, 16)), "obs"),
        (pixels(16, 20), np.zeros((20, 16), np.uint8), "obs"),
        (spaces.Dict(a=spaces.Discrete(2)), {"b": 0}, "obs"),
        (spaces.Dict(a=spaces.Discrete(2)), {"a": 2}, "obs['a']"),
        (spaces.Dict(a=spaces.Tuple([spaces.Discrete(2)])), {"a": ()}, "obs['a']"),
        (spaces.Dict(a=spaces.Tuple([spaces.Discrete(2)])), {"a": (5,)}, "obs['a'][0]"),
    ],
)
def test_what_is_not_of_the_space_is_named(space, obs, name):
    with pytest.raises(Unusable) as error:
        read(space, image_size=64).convert(obs)
    assert error.value.name == name
    assert error.value.remedy
    assert str(error.value).startswith(f"{name} ")


# Dicts, tuples and texts.


def test_nested_entries_have_stable_names_and_texts_are_left_out_with_a_notice():
    space = spaces.Dict(
        robot=spaces.Dict(joints=spaces.Box(-1, 1, (2,)), grip=spaces.Discrete(2)),
        pair=spaces.Tuple([spaces.MultiBinary(2), spaces.Tuple([spaces.Discrete(3)])]),
        mission=spaces.Text(20),
    )
    obs = {
        "robot": {"joints": np.array([0.5, -1]), "grip": 1},
        "pair": (np.array([0, 1]), (2,)),
        "mission": "go",
    }
    result = convert(space, obs)
    assert {name: array.tolist() for name, array in result.items()} == {
        "robot/joints": [0.5, -1],
        "robot/grip": [0, 1],
        "pair/0": [0, 1],
        "pair/1/0": [0, 0, 1],
    }
    (notice,) = read(space, image_size=64).notices
    assert notice.startswith("obs['mission'] ")


def test_a_tuple_is_a_dict_of_numbers():
    env = gymnasium.make("Blackjack-v1")
    obs, _ = env.reset(seed=0)
    result = convert(env.observation_space, obs)
    assert {name: int(array.argmax()) for name, array in result.items()} == {
        str(index): int(value) for index, value in enumerate(obs)
    }


def test_minigrid_is_numbers_without_its_mission():
    env = gymnasium.make("minigrid:MiniGrid-Empty-5x5-v0")
    reading = read(env.observation_space, image_size=64)
    assert reading.spec == {"direction": vector(4), "image": vector(147)}
    grid, mission = reading.notices
    assert grid.startswith("obs['image'] ")
    assert mission.startswith("obs['mission'] ")
    obs, _ = env.reset(seed=0)
    result = reading.convert(obs)
    np.testing.assert_array_equal(result["image"], obs["image"].reshape(-1))


# Pictures.


@pytest.mark.parametrize(
    ("shape", "channels"),
    [
        ((210, 160, 3), 3),
        ((210, 160), 1),
        ((40, 30), 1),
        ((84, 84, 1), 1),
        ((84, 84, 12), 12),
        ((3, 84, 84), 3),
        ((4, 84, 84), 4),
        ((1, 120, 160), 1),
        ((240, 320, 4), 4),
        ((SMALLEST_IMAGE, SMALLEST_IMAGE, 3), 3),
        ((64, 64, 3), 3),
    ],
)
@pytest.mark.parametrize("size", [64, 96])
def test_bytes_that_look_like_a_picture_are_one_of_the_size_that_is_chosen(
    shape, channels, size
):
    reading = read(pixels(*shape), image_size=size)
    assert (reading.problems, reading.spec) == ((), image(size, channels=channels))
    assert (reading.notices == ()) == (shape[:2] == (size, size))
    obs = random_pixels(*shape)
    result = convert(pixels(*shape), obs, size)
    last = obs.transpose(1, 2, 0) if shape[0] < min(shape[1:]) and len(shape) == 3 else obs
    last = last.reshape(*last.shape[:2], channels)
    for channel in range(channels):
        picture = PIL.Image.fromarray(last[..., channel])
        resized = picture.resize((size, size), PIL.Image.Resampling.BILINEAR)
        np.testing.assert_array_equal(result[..., channel], resized)


def test_height_and_width_are_not_exchanged():
    """The upper half of a wide picture stays the upper half."""
    obs = np.zeros((32, 96, 3), np.uint8)
    obs[:16] = 200
    result = convert(pixels(32, 96, 3), obs, 48)
    assert (result[:23] == 200).all()
    assert (result[25:] == 0).all()


@pytest.mark.parametrize(
    "shape", [(7, 7, 3), (15, 15), (128,), (4, 7), (10, 200), (2, 3, 4, 5)]
)
def test_smaller_grids_of_bytes_are_numbers_and_said_to_be(shape):
    reading = read(pixels(*shape), image_size=64)
    assert reading.spec == vector(int(np.prod(shape)))
    assert len(reading.notices) == (len(shape) > 1)
    obs = random_pixels(*shape)
    np.testing.assert_array_equal(reading.convert(obs), obs.reshape(-1))


@pytest.mark.parametrize(
    "space",
    [
        pixels(84, 84, 84),
        pixels(84, 3, 84),
        pixels(4, 84, 84, 3),
        spaces.Box(0, 1, (64, 64, 3)),
        spaces.Box(0, 255, (64, 64), np.uint16),
        pixels(16, 16, 0),
        spaces.MultiDiscrete(np.zeros(0, np.int64)),
        spaces.Discrete(2**16 + 1),
        spaces.Sequence(spaces.Discrete(2)),
        spaces.OneOf([spaces.Discrete(2)]),
        spaces.Text(3),
        spaces.Dict(text=spaces.Text(3)),
        "Discrete",
    ],
)
def test_what_cannot_be_read_is_one_problem_with_a_remedy(space):
    ((name, text),) = read(space, image_size=64).problems
    assert name.startswith("observation_space")
    assert ": " in text
