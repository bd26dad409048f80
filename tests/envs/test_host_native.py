"""The spaces of an environment as a run keeps them: as JSON and back; nothing else is read."""

import json

import numpy as np
import pytest
from gymnasium import spaces

from vawm.envs.host import native_record
from vawm.envs.host.native import Bounds, Discrete, fits, of_spaces, of_spec
from vawm.runs.checkpoint import manifest
from vawm.types import EnvSpec, image, vector

EVERYTHING = spaces.Dict(
    camera=spaces.Box(0, 200, (3, 60, 50), np.uint8),
    grey=spaces.Box(0, 255, (64, 64), np.uint8),
    robot=spaces.Tuple([spaces.Box(-1, 1, (2, 2), np.float64), spaces.Discrete(3, start=-1)]),
    choices=spaces.MultiDiscrete([2, 3]),
    flags=spaces.MultiBinary(4),
    mission=spaces.Text(9),
)
ACTIONS = {
    "discrete": spaces.Discrete(3, start=-1),
    "box": spaces.Box(
        np.float64([[0.1, -3e300]]), np.float64([[0.3, 3e300]]), dtype=np.float64
    ),
    "single": spaces.Box(-2, 2, ()),
}


def spec_of(native):
    actions = native.actions
    obs = native.reading.spec
    return EnvSpec("mine", obs, actions.size, actions.discrete, 1, 1, None, native=native)


@pytest.mark.parametrize("name", ACTIONS)
def test_spaces_survive_json(name):
    native = of_spaces(EVERYTHING, ACTIONS[name], image_size=48)
    spec = spec_of(native)
    assert manifest.spec_from_dict(json.loads(json.dumps(manifest.spec_as_dict(spec)))) == spec


def test_the_readings_after_json_are_the_same():
    native = of_spaces(EVERYTHING, ACTIONS["discrete"], image_size=48)
    back = native_record.from_dict(json.loads(json.dumps(native_record.as_dict(native))))
    EVERYTHING.seed(0)
    obs = EVERYTHING.sample()
    one, batched = native.see(obs)
    other, _ = back.see(obs)
    assert not batched
    assert one.keys() == other.keys() == spec_of(native).obs.keys()
    for key, array in one.items():
        assert array.tobytes() == other[key].tobytes()
        assert array.shape[1:] == spec_of(native).obs[key].shape


@pytest.mark.parametrize("name", ACTIONS)
def test_actions_are_of_their_space(name):
    actions = of_spaces(EVERYTHING, ACTIONS[name], image_size=48)
    raw = np.random.default_rng(0).normal(size=(5, actions.actions.size)).astype(np.float32)
    raw[0] = np.nan
    batch = actions.take(raw, batched=True)
    assert len(batch) == 5
    for row, action in zip(raw, batch, strict=True):
        assert action in ACTIONS[name]
        assert actions.take(row[None], batched=False) == pytest.approx(action)


def test_environments_without_spaces_of_their_own_have_those_of_their_spec():
    spec = EnvSpec("a", {"x": vector(2), "y": image(48)}, 2, False, 1, 1, None)
    native = of_spec(spec)
    assert fits(native, spec)
    assert native.actions == Bounds((2,), (-1.0, -1.0), (1.0, 1.0), "float32")
    assert of_spec(spec._replace(discrete=True)).actions == Discrete(2, 0, "int64")


def damaged(change):
    native = of_spaces(EVERYTHING, ACTIONS["box"], image_size=48)
    content = manifest.spec_as_dict(spec_of(native))
    change(content["native"])
    return content


DAMAGES = {
    "more": lambda c: c.update(more=1),
    "no entries": lambda c: c.update(entries=[]),
    "kind": lambda c: c["entries"][0]["kind"].update({"is": "sound"}),
    "shape": lambda c: c["entries"][0]["kind"].update(shape=[-1, 60, 50]),
    "too large": lambda c: c["entries"][0]["kind"].update(size=10**6),
    "path": lambda c: c["entries"][0].update(path=[1.5]),
    "keys": lambda c: c["containers"][0].update(keys=[1]),
    "bounds": lambda c: c["actions"].update(low=[1.0]),
    "infinite": lambda c: c["actions"].update(low=[float("inf"), 0.0]),
    "dtype": lambda c: c["actions"].update(dtype="object"),
    "another size": lambda c: c["entries"][0]["kind"].update(size=64),
    "two names": lambda c: c["entries"].append(c["entries"][0]),
    "no place": lambda c: c["entries"][0].update(path=["elsewhere"]),
}


@pytest.mark.parametrize("name", DAMAGES)
def test_what_no_environment_has_is_an_error(name):
    with pytest.raises(ValueError, match=r".+"):
        manifest.spec_from_dict(damaged(DAMAGES[name]))
