"""The environments of a run: what it keeps of them, and that commands make the same again."""

import copy
import dataclasses
import functools
import json

import gymnasium
import numpy as np
import pytest
import tiny
import toy
from gymnasium.envs.registration import WrapperSpec
from refusals import refused
from runs import save_toy

import vawm.envs
from vawm import evaluate, export
from vawm.config import AtariConfig, GymnasiumConfig
from vawm.envs import made
from vawm.envs.grid_world import GridWorld
from vawm.envs.host.native import of_spec
from vawm.policy import Policy
from vawm.runs import resume, run_folder, runner, suites
from vawm.types import Made, vector

HOST = tiny.config(suite="gymnasium", task="CartPole-v1", env=GymnasiumConfig(workers=1))


def policy_of(spec, config=HOST):
    return Policy(config, spec, 0, None, None, None, None)


def steps_of_episode(env):
    """Steps until the first environment's episode ends; every action is the first choice."""
    env.reset(0)
    action = np.eye(env.spec.action_size, dtype=np.float32)[np.zeros(env.spec.num_envs, int)]
    for step in range(1, 1000):
        env.send(action)
        if env.receive().is_last[0]:
            return step
    return None


def spec_of(env):
    """The spec that a run keeps."""
    return env.spec._replace(made=made.of(env))


def test_a_registered_id_is_made_again_with_its_arguments():
    given = {"sutton_barto_reward": True}
    with vawm.envs.from_gymnasium("CartPole-v1", task="mine", time_limit=5, **given) as env:
        spec = spec_of(env)
    options = {"time_limit": 5, "image_size": 64}
    record = Made("gymnasium", "CartPole-v1", options, given)
    assert spec.made._replace(registered={}) == record
    assert spec.made.registered["entry_point"].endswith("CartPoleEnv")
    assert spec.native.reading.spec == vector(4)
    with evaluate.environments(policy_of(spec), episodes=1) as env:
        assert spec_of(env) == spec
        assert steps_of_episode(env) == 5


def record_of(name, **choices):
    """The record of an id, whose time limit is that of its registration unless given."""
    with vawm.envs.from_gymnasium(name, check=False, **choices) as env:
        return made.of(env)


@pytest.fixture
def cartpole():
    """The registration of an id, as it is in this process; restored after the test."""
    name, usual = "CartPole-v1", gymnasium.registry["CartPole-v1"]
    gymnasium.registry[name] = copy.deepcopy(usual)
    yield gymnasium.registry[name]
    gymnasium.registry[name] = usual


def test_a_time_limit_that_a_script_registered_is_kept(cartpole):
    cartpole.max_episode_steps = 4
    spec = toy.SPEC._replace(task="CartPole-v1", made=record_of("CartPole-v1"))
    cartpole.max_episode_steps = 500
    with evaluate.environments(policy_of(spec), episodes=1) as env:
        assert steps_of_episode(env) == 4


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("entry_point", "gymnasium.envs.classic_control:AcrobotEnv"),
        ("kwargs", {"sutton_barto_reward": True}),
        ("additional_wrappers", (WrapperSpec("TL", "a:TimeLimit", {"max_episode_steps": 4}),)),
    ],
)
def test_an_id_that_stands_for_something_else_now_is_refused(cartpole, name, value):
    record = record_of("CartPole-v1")
    suites.check_made(record, python="TWO LINES")
    setattr(cartpole, name, value)
    with refused("env", "CartPole-v1", naming=name.removeprefix("additional_")):
        suites.check_made(record, python="TWO LINES")


def test_a_run_without_a_time_limit_is_not_cut_short_later(cartpole):
    cartpole.max_episode_steps = None
    record = record_of("CartPole-v1")
    suites.check_made(record, python="TWO LINES")
    cartpole.max_episode_steps = 500
    with refused("env", "CartPole-v1", naming=("time_limit", "500", "TWO LINES")):
        suites.check_made(record, python="TWO LINES")


def test_an_id_that_is_not_registered_here_needs_its_plugin(cartpole):
    gymnasium.registry["Local-v0"] = cartpole
    try:
        record = record_of("Local-v0")
    finally:
        del gymnasium.registry["Local-v0"]
    with refused("env", "Local-v0", naming=("--plugin", "TWO LINES")):
        suites.check_made(record, python="TWO LINES")


def test_arguments_of_an_environment_may_have_any_name(monkeypatch):
    given = {"config": {"a": 1}, "env": "x"}
    record = Made("gymnasium", "CartPole-v1", {"time_limit": 5}, given)
    record = record._replace(registered=record_of("CartPole-v1").registered)
    calls = []
    simulators = suites.gymnasium.gymnasium
    monkeypatch.setattr(simulators, "from_gymnasium", lambda *_, **made: calls.append(made))
    suites.make_again(HOST, record, task="mine", python="")
    assert {name: calls[0][name] for name in given} == given
    assert (calls[0]["task"], calls[0]["time_limit"]) == ("mine", 5)


def test_a_run_of_an_earlier_version_is_in_the_environment_of_its_config():
    config = dataclasses.replace(HOST, env=GymnasiumConfig(workers=1, time_limit=3))
    with evaluate.environments(policy_of(toy.SPEC, config), episodes=1) as env:
        assert env.spec.task == "CartPole-v1"
        assert steps_of_episode(env) == 3


class Box(dict):
    """Not JSON, though it looks like it."""


@pytest.mark.parametrize(
    ("make", "kwargs"),
    [(GridWorld, {}), (functools.partial(GridWorld), {}), ("CartPole-v1", {"x": Box()})],
)
def test_what_the_caller_made_is_refused_and_named(make, kwargs):
    options = {"time_limit": 7}
    record = made.by_gymnasium(make, options=options, kwargs=kwargs, registered={})
    policy = policy_of(toy.SPEC._replace(made=record))
    lines = ("vawm.load(LOGDIR)", "vawm.evaluate.evaluate(policy, episodes=2, env=...)")
    with refused("env", made.describe(record), naming=lines):
        evaluate.by_protocol(policy, episodes=2)
    assert "GridWorld" in made.describe(record) or "x={}" in made.describe(record)
    assert "time_limit=7" in made.describe(record)
    with refused("env", naming="env=..."):
        evaluate.by_protocol(policy._replace(config=tiny.CONFIG), episodes=2, physics="mujoco")


def test_pure_functions_of_the_callers_are_not_taken_for_the_registered_task():
    own = tiny.env()
    spec = own.spec._replace(task="walker_walk")
    record = made.of(own._replace(spec=spec))
    assert record == Made("object", "vawm.envs.probes.make.<locals>.step")
    with refused("env", naming="vawm.evaluate.evaluate"):
        evaluate.by_protocol(policy_of(spec._replace(made=record), tiny.CONFIG), episodes=1)


def test_mjx_tasks_are_made_again_with_their_action_repeat():
    ours = vawm.envs.make("cartpole_balance", num_envs=2, action_repeat=5)
    spec = spec_of(ours)
    assert spec.made == Made("dmc_proprio", "cartpole_balance", {"action_repeat": 5})
    with evaluate.environments(policy_of(spec, tiny.CONFIG), episodes=3) as env:
        assert spec_of(env) == spec._replace(num_envs=3)
    other = ours._replace(step=lambda state, action: ours.step(state, action))
    assert made.of(other).by == "object"


def test_choices_of_a_suite_are_made_again():
    """And `changes` of the protocol still hold."""
    config = tiny.config(suite="atari100k", task="pong", env=AtariConfig(workers=1))
    trained = dataclasses.replace(config.env, image_size=48, noops=0, life_loss="terminal")
    with suites.make(dataclasses.replace(config, env=trained)) as env:
        spec = spec_of(env)
    assert (spec.made.by, spec.made.options["image_size"]) == ("atari100k", 48)
    policy = policy_of(spec, config)
    with evaluate.environments(policy, episodes=1, life_loss="ignore") as env:
        options = made.of(env).options
    assert options == spec.made.options | {"life_loss": "ignore"}


def test_the_record_survives_json_and_the_checkpoint(tmp_path):
    record = Made("gymnasium", "A-v0", {"time_limit": 5}, {"x": [1]}, {"f": "<f>"}, {"W": []})
    assert made.from_dict(json.loads(json.dumps(made.as_dict(record)))) == record
    save_toy(tmp_path, toy.state(), spec=toy.SPEC._replace(made=record))
    assert resume.saved_made(tmp_path) == record


def test_a_run_without_a_checkpoint_keeps_the_record_in_its_config(tmp_path):
    record = Made("object", "mine.Line")
    run_folder.write_config(tmp_path, tiny.CONFIG, record)
    assert resume.saved_made(tmp_path) == record
    with refused("env", naming=("saved_config", "resume=True, env=...")):
        runner.run(tiny.CONFIG, tmp_path, resume=True)


SPEC = toy.SPEC._replace(
    made=Made("gymnasium", "A-v0", {"time_limit": 5}, {"x": 1}, registered={"wrappers": ["W"]})
)


@pytest.mark.parametrize(
    ("name", "change"),
    [
        ("name", {"name": "B-v0"}),
        ("by", {"by": "object"}),
        ("time_limit", {"options": {"time_limit": None}}),
        ("x", {"kwargs": {"x": 2}}),
        ("x", {"kwargs": {}}),
        ("wrappers", {"registered": {}}),
    ],
)
def test_another_environment_is_refused_on_resume(tmp_path, name, change):
    save_toy(tmp_path, toy.state(), spec=SPEC)
    assert resume.check_environments(tmp_path, SPEC) == []
    now = SPEC._replace(made=SPEC.made._replace(**change))
    with refused(f"env.{name}"):
        resume.check_environments(tmp_path, now)


def test_other_bounds_of_actions_are_refused_on_resume(tmp_path):
    """Except for a run of an earlier version, which did not keep them."""
    spec = SPEC._replace(native=of_spec(SPEC))
    bounds = spec.native.actions._replace(high=(2.0,))
    now = spec._replace(native=spec.native._replace(actions=bounds))
    save_toy(tmp_path / "run", toy.state(), spec=spec)
    assert resume.check_environments(tmp_path / "run", spec) == []
    with refused("env.native"):
        resume.check_environments(tmp_path / "run", now)
    save_toy(tmp_path / "earlier", toy.state(), spec=SPEC)
    assert resume.check_environments(tmp_path / "earlier", now) == []


def test_another_spec_is_refused_on_resume(tmp_path):
    save_toy(tmp_path, toy.state(), spec=SPEC)
    with refused("env.action_size", 4, naming="1"):
        resume.check_environments(tmp_path, SPEC._replace(action_size=4))


@pytest.mark.parametrize(
    "change", [{"name": "module.Line"}, {"opaque": {"reward": "<function g>"}}]
)
def test_what_may_differ_between_equal_environments_is_a_warning(tmp_path, change):
    then = Made("object", "__main__.Line", opaque={"reward": "<function f>"})
    save_toy(tmp_path, toy.state(), spec=SPEC._replace(made=then))
    now = SPEC._replace(made=then._replace(**change))
    (warning,) = resume.check_environments(tmp_path, now)
    assert repr(next(iter(change.values()))) in warning or "<function g>" in warning


def test_a_run_of_an_earlier_version_is_resumed_in_any_environment_of_its_spec(tmp_path):
    save_toy(tmp_path, toy.state())
    assert resume.check_environments(tmp_path, SPEC) == []


def test_the_repr_of_an_argument_has_no_address():
    record = made.by_gymnasium(
        "A-v0", options={}, kwargs={"f": tiny.env, "x": 1}, registered={}
    )
    assert record.kwargs == {"x": 1}
    assert record.opaque == {"f": "<function env>"}


@pytest.mark.parametrize("content", [None, {}, {"by": 1}, made.as_dict(SPEC.made) | {"by": 1}])
def test_a_damaged_record_is_an_error(content):
    with pytest.raises(ValueError, match=r"how environments were made|wrong type"):
        made.from_dict(content)


def test_the_model_card_names_the_environment():
    spec = toy.SPEC._replace(made=Made("object", "mine.Line", {"time_limit": 9}))
    card = export.card(policy_of(spec)._replace(params={}), "Not evaluated.")
    assert "mine.Line (time_limit=9)" in card
    assert "an observation of your environment" in card
