"""One row for each kind of agent; other packages add theirs."""

import ast
import dataclasses
import os
import pathlib
import subprocess
import sys
from dataclasses import dataclass
from typing import Literal

import jax
import pytest
import tiny
from refusals import refused

import vawm
from vawm.agent import kinds, make_agent, plugins, registry
from vawm.cli import flags
from vawm.config import CUSTOM, Config, HeadsConfig, RSSMConfig, WorldModelConfig
from vawm.errors import NOT_NEGATIVE, InvalidInput
from vawm.learning import train
from vawm.runs import budget, validate
from vawm.runs.checkpoint import manifest
from vawm.world_model.rssm import rssm

PACKAGE = pathlib.Path(vawm.__file__).parent


@dataclass(frozen=True)
class MineConfig(RSSMConfig):
    """A third kind, whose class nothing in the package knows."""

    patience: int = 3
    form: Literal["round", "square"] = "round"


@pytest.fixture
def register(monkeypatch):
    """`registry.register`, undone after the test."""
    monkeypatch.setattr(registry, "_ROWS", dict(registry._ROWS))
    return registry.register


def mine():
    model = dataclasses.asdict(tiny.CONFIG.world_model)
    return tiny.config(agent="mine", world_model=MineConfig(**model))


def test_every_kind_is_complete():
    for name in registry.names():
        row = registry.kind(name)
        for suite, named in row.presets.items():
            for preset, config in named.items():
                assert (config.agent, config.suite, config.preset) == (name, suite, preset)
                assert type(config.world_model) is row.world_model
                assert type(config.optimizer) is row.optimizer
                assert config.size in row.sizes


def test_only_the_rows_and_world_models_know_the_classes_of_configs():
    classes = {"HeadsConfig", "RSSMConfig", "StormConfig", "VagramConfig"}
    allowed = {
        "config/__init__.py",
        "config/presets.py",
        "agent/kinds.py",
        "agent/value_gradient.py",
    }
    for path in PACKAGE.rglob("*.py"):
        name = path.relative_to(PACKAGE).as_posix()
        if name in allowed or name.startswith(("config/", "world_model/")):
            continue
        used = {
            node.id
            for node in ast.walk(ast.parse(path.read_text()))
            if isinstance(node, ast.Name)
        }
        assert not used & classes, name


def test_another_kind_is_built_checked_counted_and_saved(register):
    register("mine", MineConfig, rssm, rules={"patience": NOT_NEGATIVE})
    config, env = mine(), tiny.env()
    validate.check(config)
    agent = make_agent(config, env.spec)
    shapes = jax.eval_shape(lambda k: train.init(env, agent, config, k), jax.random.key(0))
    (needed,) = budget.estimate(shapes, env.spec, config)
    assert needed.working > 0
    assert manifest.config_from_dict(dataclasses.asdict(config)) == config


def test_without_presets_it_gets_the_runs_of_dreamerv3(register):
    register("mine", MineConfig, rssm)
    theirs = registry.kind("dreamerv3").presets["dmc_proprio"]["quick"]
    ours = validate.preset("mine", "dmc_proprio", "quick")
    assert ours.size == CUSTOM
    assert ours == dataclasses.replace(
        theirs, agent="mine", size=CUSTOM, world_model=MineConfig()
    )
    register("sized", MineConfig, rssm, sizes={"s": {"deter": 64, "units": 32}})
    ours = validate.preset("sized", "dmc_proprio", "quick")
    assert (ours.size, ours.world_model.deter, ours.actor.units) == ("s", 64, 32)
    validate.check(ours)


def test_its_rules_and_its_check_refuse(register):
    def check(config):
        raise InvalidInput("world_model.form", config.world_model.form, "use square")

    register("mine", MineConfig, rssm, rules={"patience": NOT_NEGATIVE}, check=check)
    config = mine()
    with pytest.raises(InvalidInput) as error:
        validate.check(config)
    assert (error.value.field, error.value.value) == ("world_model.form", "round")
    model = dataclasses.replace(config.world_model, patience=-1)
    with pytest.raises(InvalidInput) as error:
        validate.check(dataclasses.replace(config, world_model=model))
    assert (error.value.field, error.value.value) == ("world_model.patience", -1)


def test_a_cell_that_runs_again_replaces_its_row_and_no_other(register):
    register("mine", MineConfig, rssm)
    register("mine", MineConfig, rssm, context_limited=True)
    assert registry.kind("mine").context_limited
    with pytest.raises(InvalidInput) as error:
        register("storm", MineConfig, rssm)
    assert (error.value.field, error.value.value) == ("agent", "storm")
    assert "StormConfig of " in error.value.remedy


@dataclass(frozen=True)
class WithoutDefaults(WorldModelConfig):
    pass


@dataclass(frozen=True)
class WithTuple(MineConfig):
    widths: tuple[int, ...] = ()


class Undecorated(MineConfig):
    pass


@pytest.mark.parametrize("name", ["", "My Model", "a/b", "x" * 41, "-a"])
def test_a_name_that_is_no_file_name_is_refused(register, name):
    with pytest.raises(InvalidInput) as error:
        register(name, MineConfig, rssm)
    assert error.value.field == "agent"


@pytest.mark.parametrize(
    ("cls", "field"),
    [
        (dict, "world_model"),
        (Config, "world_model"),
        (Undecorated, "world_model"),
        (WithoutDefaults, "WithoutDefaults.deter"),
        (WithTuple, "WithTuple.widths"),
    ],
)
def test_a_config_that_could_not_be_saved_is_refused(register, cls, field):
    with pytest.raises(InvalidInput) as error:
        register("mine", cls, rssm)
    assert error.value.field == field


def test_an_agent_that_nothing_registered_is_named_with_those_that_are():
    for lookup in (registry.kind, lambda name: manifest.config_from_dict(saved(name))):
        with pytest.raises(registry.UnknownAgent, match=r"agent='nobody'.*dreamerv3.*--plugin"):
            lookup("nobody")


def saved(agent):
    return dataclasses.asdict(tiny.CONFIG) | {"agent": agent}


def test_what_other_programs_need_to_know_an_agent(register, monkeypatch):
    register("mine", MineConfig, rssm)
    monkeypatch.chdir(pathlib.Path(__file__).parent)
    assert registry.plugin_of("mine") == "test_registry.py"
    monkeypatch.chdir(pathlib.Path(__file__).parents[1] / "runs")
    assert registry.plugin_of("mine") == __file__
    assert registry.plugin_of("storm") is None


def test_heads_of_dreamerv3_need_no_more_than_their_config():
    assert {field.name for field in dataclasses.fields(HeadsConfig)} <= {
        field.name for field in dataclasses.fields(RSSMConfig)
    }
    assert kinds.HEAD_RULES.keys() <= {field.name for field in dataclasses.fields(HeadsConfig)}


# Plugins

PLUGIN = """
from dataclasses import dataclass
import vawm.agent
from vawm.config import RSSMConfig
from vawm.world_model.rssm import rssm

@dataclass(frozen=True)
class OwnConfig(RSSMConfig):
    own: int = 1

vawm.agent.register("own", OwnConfig, rssm)
"""
PARSE = """
import sys
from vawm.cli import command_line
command_line.parse(sys.argv[1:], suite="dmc_proprio", description="")
"""
NAMES = "from vawm.agent import registry; print(*registry.names())"


@pytest.fixture
def plugin(tmp_path):
    path = tmp_path / "own_model.py"
    path.write_text(PLUGIN)
    return path


def python(*words, **environ):
    return subprocess.run(
        [sys.executable, *map(str, words)],
        env=os.environ | environ,
        capture_output=True,
        text=True,
        check=False,
    )


def test_a_plugin_is_a_file_or_a_module_of_the_environment(plugin):
    for name, more in ((plugin, {}), ("own_model", {"PYTHONPATH": path_with(plugin.parent)})):
        done = python("-c", NAMES, **{plugins.VARIABLE: str(name)}, **more)
        assert done.stdout.split()[-1] == "own", done.stderr


def path_with(folder):
    return os.pathsep.join([str(folder), *sys.path])


def test_programs_offer_what_a_plugin_registers(plugin):
    done = python("-m", "vawm.evaluate", "--plugin", plugin, "--logdir", plugin.parent / "no")
    assert done.returncode == 2
    assert "logdir=" in done.stderr
    done = python("-c", PARSE, "--plugin", plugin, "--agent", "own", "--help")
    assert "vagram,own}" in done.stdout
    assert "--world-model.own" in done.stdout


@pytest.mark.parametrize("words", [["--plugin"], ["--plugin", "--seed", "1"], ["--plugin="]])
def test_a_plugin_without_a_name_is_refused(words):
    with pytest.raises(InvalidInput) as error:
        flags.load_plugins(words)
    assert (error.value.field, error.value.value) == ("--plugin", None)


def test_a_plugin_whose_path_has_the_separator_is_refused(tmp_path, monkeypatch):
    monkeypatch.setenv(plugins.VARIABLE, "")
    path = tmp_path / "a:b" / "own.py"
    with refused("plugin", str(path), naming=[repr(os.pathsep), plugins.VARIABLE]):
        plugins.add([str(path)])
    assert os.environ[plugins.VARIABLE] == ""


def test_words_that_are_not_plugins_stay_in_order(plugin, monkeypatch):
    monkeypatch.setenv(plugins.VARIABLE, "")
    monkeypatch.setattr(plugins, "load_named", lambda: None)
    words = [
        "--seeds",
        "0",
        "1",
        f"--plugin={plugin}",
        "--tasks",
        "a",
        "--plugin",
        "m",
        "--x=-1",
    ]
    assert flags.load_plugins(words) == ["--seeds", "0", "1", "--tasks", "a", "--x=-1"]
    assert os.environ[plugins.VARIABLE].split(os.pathsep) == [str(plugin), "m"]


@pytest.mark.parametrize(
    ("text", "told"),
    [(None, "no such file"), ("1 / 0", "ZeroDivisionError"), ("import nowhere_", "nowhere_")],
)
def test_a_plugin_that_cannot_be_imported_is_one_line(tmp_path, monkeypatch, text, told):
    path = tmp_path / "broken.py"
    if text:
        path.write_text(text)
    monkeypatch.setenv(plugins.VARIABLE, "")
    for _ in range(2):  # it stays named
        with pytest.raises(InvalidInput) as error:
            plugins.add([str(path)])
        assert (error.value.field, error.value.value) == ("plugin", str(path))
        assert told in str(error.value)
        assert "\n" not in str(error.value)


def test_a_file_does_not_take_the_place_of_a_module(tmp_path, monkeypatch):
    path = tmp_path / "random.py"
    path.write_text("seen = True")
    monkeypatch.setenv(plugins.VARIABLE, "")
    plugins.add([str(path)])
    import random

    assert not hasattr(random, "seen")
