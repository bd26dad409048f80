"""Names of coordinates: one for each, and those of the joints where they are."""

import pytest

from vawm import envs
from vawm.envs import TASKS, coordinates


@pytest.mark.parametrize("task", TASKS)
def test_every_coordinate_of_every_task_has_a_name_of_its_own(task):
    size = envs.make(task, num_envs=1).spec.obs.shape[0]
    names = coordinates.names(task, size)
    assert len(names) == len(set(names)) == size
    assert not any(name.startswith("coordinate") for name in names)


def test_velocities_are_named_in_the_order_of_the_joints():
    from vawm.envs.mjx import physics

    joints = {"cheetah": ("rootx", "rootz", "rooty", "bthigh", "bshin", "bfoot")}
    joints["walker"] = ("rootz", "rootx", "rooty", "right_hip", "right_knee", "right_ankle")
    joints["hopper"] = ("rootx", "rootz", "rooty", "waist", "hip", "knee", "ankle")
    words = {"rootx": "x", "rootz": "z", "rooty": "pitch"}
    for domain, expected in joints.items():
        model = physics.load_host(domain)
        assert tuple(model.joint(i).name for i in range(len(expected))) == expected
        names = [n for n in coordinates.OF_DOMAIN[domain] if n.endswith(" velocity")]
        assert len(names) == model.nv
        for name, joint in zip(names, expected, strict=False):
            said = words.get(joint, joint.replace("_", " ").replace("bthigh", "back thigh"))
            said = said.replace("bshin", "back shin").replace("bfoot", "back foot")
            assert name == f"{said} velocity"


def test_what_has_no_names_is_numbered():
    assert coordinates.names("CartPole-v1", 2) == ("coordinate 0", "coordinate 1")
    assert coordinates.names("cartpole_balance", 3)[0] == "coordinate 0"
