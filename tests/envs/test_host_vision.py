"""Tasks from pixels: dm_control's own frames, rewards and ends, and equal episodes.

One process does all the rendering: it runs this file as a script, because processes that run
other tests must not load a backend. It records what it sees; the tests compare.
"""

import ctypes.util
import pathlib
import subprocess
import sys

import numpy as np
import pytest

from vawm.envs import TASKS
from vawm.envs.host import rendering
from vawm.envs.host.vision import VISION_TASKS, VisionSimulator, check_vision_task, to_actuator
from vawm.errors import InvalidInput

# One task per domain, and those that draw a target.
PLAYED = (
    "acrobot_swingup",
    "ball_in_cup_catch",
    "cartpole_swingup",
    "cheetah_run",
    "finger_spin",
    "finger_turn_hard",
    "hopper_hop",
    "pendulum_swingup",
    "quadruped_run",
    "reacher_easy",
    "walker_walk",
)
WHOLE = ("cartpole_balance_sparse", "finger_spin", "quadruped_walk", "walker_run")
# task, camera, its number in dm_control, pixels a side
VIEWS = (
    ("walker_walk", -1, 0, 64),
    ("walker_walk", 1, 1, 96),
    ("quadruped_run", -1, 2, 64),
    ("reacher_hard", -1, 0, 128),
    ("cartpole_swingup", -1, 0, 600),
)
CHOICES = {
    "image_size": 64,
    "camera": -1,
    "renderer": "auto",
    "fast_rendering": False,
    "action_repeat": 2,
}


def simulator(task: str, **choices) -> VisionSimulator:
    return VisionSimulator(task, **CHOICES | choices)


def dm_control(task: str, seed: int):
    """The task in dm_control, and the range of its actions."""
    from dm_control import suite

    domain, name = next(pair for pair in suite.ALL_TASKS if "_".join(pair) == task)
    env = suite.load(domain, name, {"random": seed})
    return env, env.action_spec().minimum, env.action_spec().maximum


def actions(size: int, count: int, seed: int = 0) -> np.ndarray:
    """`[count, size]`, some of them out of range."""
    return np.random.default_rng(seed).uniform(-1.5, 1.5, (count, size)).astype(np.float32)


# Recording --------------------------------------------------------------------------------


def pictures(renderer: str, views=VIEWS) -> dict:
    """Frames of an episode, and those that dm_control renders for its states."""
    return {
        f"{task} {size} {fast}": picture(task, camera, number, size, renderer, fast)
        for task, camera, number, size in views
        for fast in (False, True)
    }


def picture(task, camera, number, size, renderer, fast) -> dict:
    sim = simulator(
        task, camera=camera, image_size=size, renderer=renderer, fast_rendering=fast
    )
    env, low, high = dm_control(task, seed=3)
    flags = {"shadow": False, "reflection": False} if fast else {}
    if fast:
        env.physics.model.vis.quality.offsamples = 0
    if size > 480:  # more than the XML asks for
        env.physics.model.vis.global_.offwidth = env.physics.model.vis.global_.offheight = size
    seen, by_hand = [sim.reset(3)], []
    env.reset()
    by_hand.append(env.physics.render(size, size, number, render_flag_overrides=flags))
    for action in actions(sim.action_size, 2):
        seen.append(sim.step(action).obs)
        for _ in range(2):
            env.step((high + low) / 2 + np.clip(action, -1, 1) * (high - low) / 2)
        by_hand.append(env.physics.render(size, size, number, render_flag_overrides=flags))
    sim.close()
    env.physics.free()
    return {"seen": seen, "by hand": by_hand}


def equal_episodes() -> dict:
    """An episode of a new simulator, and of one that was played, left and broken before."""
    from dm_control.rl.control import PhysicsError

    recorded = {}
    for task in PLAYED:
        used, fresh = (simulator(task, action_repeat=5) for _ in range(2))
        used.reset(1)
        for action in actions(used.action_size, 4, seed=1):
            used.step(action * 10)
        used._env.task.random.randn()  # leaves half of a pair of normal numbers behind
        broken = False
        try:
            used.step(np.full(used.action_size, np.nan))
        except PhysicsError:
            broken = True
        recorded[task] = {
            "used": episode(used),
            "fresh": episode(fresh),
            "again": episode(used),
            "broken": broken,
            "other": used.reset(6),
        }
        used.close()
        fresh.close()
    return recorded


def episode(sim: VisionSimulator) -> dict:
    frames, states, rewards = [sim.reset(5)], [state(sim)], []
    for action in actions(sim.action_size, 3):
        outcome = sim.step(action)
        frames.append(outcome.obs)
        states.append(state(sim))
        rewards.append(outcome.reward)
    return {"frames": frames, "states": states, "rewards": rewards}


def state(sim: VisionSimulator) -> np.ndarray:
    """Everything that the next step depends on, including the warm start and the targets."""
    import mujoco

    physics = sim._env.physics
    whole = physics.get_state(mujoco.mjtState.mjSTATE_INTEGRATION)
    model = physics.model
    parts = (model.geom_pos, model.geom_size, model.site_pos, model.site_size)
    return np.concatenate([whole, model.dof_damping, *map(np.ravel, parts)])


def whole_episodes() -> dict:
    """Outcomes of 1000 control steps in steps of 2 and of 300, and those of a plain loop."""
    recorded = {}
    for task in WHOLE:
        for repeat in (2, 300):
            sim = simulator(task, action_repeat=repeat, image_size=16, fast_rendering=True)
            env, low, high = dm_control(task, seed=4)
            sim.reset(4)
            latest, outcomes, plain = env.reset(), [], []
            for action in actions(sim.action_size, sim.episode_length):
                outcome = sim.step(action)
                outcomes.append((outcome.reward, outcome.is_last, outcome.is_terminal))
                reward = 0.0
                for _ in range(repeat):
                    if not latest.last():
                        control = np.clip(action, -1, 1) * (high - low) / 2
                        latest = env.step((high + low) / 2 + control)
                        reward += latest.reward
                plain.append((reward, latest.last(), latest.discount == 0))
            sim.close()
            recorded[f"{task} {repeat}"] = {
                "seen": np.float64(outcomes),
                "plain": np.float64(plain),
                "length": sim.episode_length,
            }
    return recorded


def endings() -> dict:
    """The step in which a task ends itself at its third control step, by its discount."""
    recorded = {}
    for discount in (0.0, 1.0):
        sim = simulator("walker_stand", action_repeat=5, fast_rendering=True)
        task, seen = sim._env.task, []
        sim.reset(0)

        def after_three(physics, discount=discount, task=task, seen=seen):
            seen.append(task.get_reward(physics))
            return discount if len(seen) == 3 else None

        task.get_termination = after_three
        outcome = sim.step(np.zeros(sim.action_size))
        recorded[str(discount)] = {
            "outcome": outcome[1:],
            "rewards": seen,
            "frame": outcome.obs,
            "state": sim._camera.render(render_flag_overrides=sim._flags),
        }
        sim.close()
    return recorded


def controls() -> dict:
    """The controls of quadruped's actuators, which have different ranges."""
    sim = simulator("quadruped_walk", fast_rendering=True)
    sim.reset(0)
    reached = {}
    for value in (-7.0, -1.0, 0.0, 0.5, 1.0, 7.0):
        sim.step(np.full(sim.action_size, value, np.float32))
        reached[str(value)] = sim._env.physics.control()
    spec = sim._env.action_spec()
    sim.close()
    return reached | {"low": spec.minimum, "high": spec.maximum}


def neighbours() -> dict:
    """A simulator alone, and next to others in its process that come and go."""

    def play(sim, others=()):
        frames = [sim.reset(2)]
        for index, action in enumerate(actions(sim.action_size, 4)):
            for other in others:
                if index < 2:
                    other.step(np.zeros(other.action_size))
                if index == 2:
                    other.close()
            frames.append(sim.step(action).obs)
        sim.close()
        return frames

    alone = play(simulator("walker_walk"))
    others = [simulator("quadruped_run", image_size=96), simulator("reacher_easy")]
    for other in others:
        other.reset(0)
    return {"alone": alone, "beside": play(simulator("walker_walk"), others)}


def conduct() -> dict:
    """The number of frames per step, a simulator's attributes, and what `close` frees."""
    sim = simulator("walker_walk", action_repeat=10)
    frame = sim.reset(0)
    kept, drawn = frame.copy(), []
    render = sim._camera.render
    sim._camera.render = lambda **choices: drawn.append(1) or render(**choices)
    outcome = sim.step(np.ones(sim.action_size))
    says = {
        "drawn": len(drawn),
        "obs": (*sim.obs.shape, sim.obs.dtype == np.uint8),
        "frame": (*frame.shape, frame.dtype == np.uint8, frame.flags["C_CONTIGUOUS"]),
        "kept": (kept == frame).all() and (kept != outcome.obs).any(),
        "action_size": sim.action_size,
        "discrete": sim.discrete,
        "types": [type(value).__name__ for value in outcome],
    }
    context = sim._env.physics.contexts.gl
    sim.close()
    sim.close()
    return says | {"freed": context.terminated}


def refusals() -> dict:
    def refused(task, **choices):
        try:
            simulator(task, **choices)
        except InvalidInput as error:
            return str(error)
        return ""

    return {
        "camera": refused("walker_walk", camera=2),
        "negative": refused("walker_walk", camera=-2),
        "renderer": refused(
            "walker_walk", renderer="egl" if rendering.loaded() == "osmesa" else "osmesa"
        ),
    }


def flat(recorded: dict, prefix: str = "") -> dict:
    """Flattens nested dicts, to keys such as "pictures/walker_walk 64 True/seen"."""
    entries = {}
    for key, value in recorded.items():
        if isinstance(value, dict):
            entries |= flat(value, f"{prefix}{key}/")
        else:
            entries[f"{prefix}{key}"] = np.asarray(value)
    return entries


def main(path: str, renderer: str) -> None:
    CHOICES["renderer"] = renderer
    recorded = {"pictures": pictures(renderer, VIEWS if renderer == "auto" else VIEWS[:1])}
    if renderer == "auto":
        recorded |= {
            "episodes": equal_episodes(),
            "whole": whole_episodes(),
            "endings": endings(),
            "controls": controls(),
            "neighbours": neighbours(),
            "conduct": conduct(),
            "refusals": refusals(),
        }
    np.savez(path, **flat(recorded))


# Comparing --------------------------------------------------------------------------------


def record(folder: pathlib.Path, renderer: str) -> dict[str, np.ndarray]:
    done = subprocess.run(
        [sys.executable, __file__, str(folder / "recorded.npz"), renderer],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    with np.load(folder / "recorded.npz") as recorded:
        return dict(recorded)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    try:
        rendering.choose("auto")
    except InvalidInput as error:
        pytest.skip(str(error))
    return record(tmp_path_factory.mktemp("vision"), "auto")


VIEW_NAMES = [f"{task} {size}" for task, _, _, size in VIEWS]


@pytest.mark.parametrize("fast", [False, True])
@pytest.mark.parametrize("view", VIEW_NAMES)
def test_frames_are_those_of_dm_control(recorded, view, fast):
    seen, by_hand = (recorded[f"pictures/{view} {fast}/{who}"] for who in ("seen", "by hand"))
    np.testing.assert_array_equal(seen, by_hand)
    assert seen.std() > 5  # not a blank picture
    assert (seen[0] != seen[-1]).any()  # something moves


@pytest.mark.parametrize("view", VIEW_NAMES)
def test_fast_rendering_changes_the_pixels(recorded, view):
    default, fast = (recorded[f"pictures/{view} {fast}/seen"] for fast in (False, True))
    assert (default != fast).any()


def test_osmesa_renders_the_frames_of_dm_control_too(tmp_path):
    if ctypes.util.find_library("OSMesa") is None:
        pytest.skip("needs libosmesa6")
    recorded = record(tmp_path, "osmesa")
    for fast in (False, True):
        seen, by_hand = (
            recorded[f"pictures/{VIEW_NAMES[0]} {fast}/{who}"] for who in ("seen", "by hand")
        )
        np.testing.assert_array_equal(seen, by_hand)
        assert seen.std() > 5


@pytest.mark.parametrize("task", PLAYED)
def test_an_episode_depends_on_its_seed_and_actions_alone(recorded, task):
    assert recorded[f"episodes/{task}/broken"]
    for part in ("frames", "states", "rewards"):
        used, fresh, again = (
            recorded[f"episodes/{task}/{who}/{part}"] for who in ("used", "fresh", "again")
        )
        assert used.tobytes() == fresh.tobytes() == again.tobytes()
    first = recorded[f"episodes/{task}/fresh/frames"][0]
    assert (first != recorded[f"episodes/{task}/other"]).any()  # another seed, another start


@pytest.mark.parametrize("task", WHOLE)
@pytest.mark.parametrize(("repeat", "length"), [(2, 500), (300, 4)])
def test_rewards_and_ends_are_those_of_dm_control(recorded, task, repeat, length):
    name = f"whole/{task} {repeat}"
    assert recorded[f"{name}/length"] == length
    np.testing.assert_array_equal(recorded[f"{name}/seen"], recorded[f"{name}/plain"])
    reward, is_last, is_terminal = recorded[f"{name}/seen"].T
    assert is_last.tolist() == [False] * (length - 1) + [True]
    assert not is_terminal.any()  # a time limit is no termination
    assert np.isfinite(reward).all()


@pytest.mark.parametrize("discount", [0.0, 1.0])
def test_a_step_stops_at_the_end_and_is_terminal_only_at_discount_0(recorded, discount):
    name = f"endings/{discount}"
    reward, is_last, is_terminal = recorded[f"{name}/outcome"]
    assert len(recorded[f"{name}/rewards"]) == 3
    assert reward == sum(recorded[f"{name}/rewards"])
    assert is_last
    assert is_terminal == (discount == 0)
    np.testing.assert_array_equal(recorded[f"{name}/frame"], recorded[f"{name}/state"])


def test_actions_are_clipped_and_mapped_onto_each_actuator(recorded):
    reached = {
        key: recorded[f"controls/{key}"] for key in ("-7.0", "-1.0", "0.5", "1.0", "7.0")
    }
    low, high = recorded["controls/low"], recorded["controls/high"]
    assert len(set(high)) > 1
    np.testing.assert_allclose(reached["-1.0"], low)
    np.testing.assert_allclose(reached["1.0"], high)
    np.testing.assert_allclose(reached["0.5"], low + 0.75 * (high - low))
    np.testing.assert_array_equal(reached["-7.0"], reached["-1.0"])
    np.testing.assert_array_equal(reached["7.0"], reached["1.0"])


def test_an_action_by_hand():
    low, high = np.array([-1.0, 0.0, -3.0]), np.array([1.0, 4.0, -1.0])
    action = np.float32([0.25, -0.5, 9.0])
    np.testing.assert_array_equal(to_actuator(action, low, high), [0.25, 1.0, -1.0])


def test_simulators_of_one_process_do_not_disturb_each_other(recorded):
    alone, beside = recorded["neighbours/alone"], recorded["neighbours/beside"]
    np.testing.assert_array_equal(alone, beside)


def test_a_repeat_draws_one_frame(recorded):
    assert recorded["conduct/drawn"] == 1


def test_a_simulators_attributes_are_true(recorded):
    assert recorded["conduct/obs"].tolist() == [64, 64, 3, True]
    assert recorded["conduct/frame"].tolist() == [64, 64, 3, True, True]
    assert recorded["conduct/action_size"] == 6
    assert not recorded["conduct/discrete"]
    assert recorded["conduct/types"].tolist() == ["ndarray", "float", "bool", "bool"]


def test_a_frame_outlives_the_next_step(recorded):
    assert recorded["conduct/kept"]


def test_closing_frees_the_context(recorded):
    assert recorded["conduct/freed"]


def test_a_camera_that_is_not_there_is_refused(recorded):
    for camera, name in ((2, "camera"), (-2, "negative")):
        message = str(recorded[f"refusals/{name}"])
        assert message.startswith(f"env.camera={camera}: ")
        assert "0 to 1" in message


def test_a_second_renderer_in_a_process_is_refused(recorded):
    message = str(recorded["refusals/renderer"])
    assert message.startswith("env.renderer=")
    assert "\n" not in message


def test_the_tasks_are_those_of_the_suite():
    from dm_control import suite

    assert len(VISION_TASKS) == 20
    assert set(VISION_TASKS) - set(TASKS) == {"quadruped_run", "quadruped_walk"}
    assert set(VISION_TASKS) <= {"_".join(pair) for pair in suite.ALL_TASKS}
    for task in VISION_TASKS:
        check_vision_task(task)


@pytest.mark.parametrize(
    ("task", "choices", "field", "value", "named"),
    [
        ("walker_wlak", {}, "task", "walker_wlak", "'walker_walk'"),
        ("humanoid_run", {}, "task", "humanoid_run", ["acrobot_swingup", "quadruped_run"]),
        ("walker_walk", {"image_size": 0}, "env.image_size", 0, ()),
        ("walker_walk", {"action_repeat": 0}, "action_repeat", 0, ()),
        ("walker_walk", {"renderer": "glfw"}, "env.renderer", "glfw", ["egl", "osmesa"]),
    ],
)
def test_bad_choices_are_refused_before_anything_is_loaded(task, choices, field, value, named):
    from refusals import refused  # not known where this file runs as a script

    loaded = set(sys.modules)
    with refused(field, value, naming=named):
        simulator(task, **choices)
    assert set(sys.modules) == loaded


if __name__ == "__main__":
    main(*sys.argv[1:])
