"""Configs that cannot run are refused with field, value and remedy."""

import dataclasses
import math

import pytest
import tiny
import tiny_storm

from vawm import presets
from vawm.agent import registry, with_size
from vawm.config import AdamConfig, LaPropConfig
from vawm.errors import InvalidInput
from vawm.runs import suites, validate
from vawm.types import image


def numbers(config):
    return [name for name, _, kind in validate.fields(config) if kind in (int, float)]


STORM = presets.STORM_QUICK
NUMBERS = [(config, name) for config in (tiny.CONFIG, STORM) for name in numbers(config)]


def changed(name, value, config=tiny.CONFIG):
    """`config` with the field of a dotted name replaced."""
    head, _, rest = name.partition(".")
    if rest:
        value = changed(rest, value, getattr(config, head))
    return dataclasses.replace(config, **{head: value})


OF_AGENTS = {agent: registry.kind(agent).presets for agent in registry.names()}
PRESETS = [
    (agent, suite, name)
    for agent, of_suite in OF_AGENTS.items()
    for suite, own in of_suite.items()
    for name in own
]
AT_EVERY_SIZE = [
    (*preset, size) for preset in PRESETS for size in registry.kind(preset[0]).sizes
]


@pytest.mark.parametrize(("agent", "suite", "preset", "size"), AT_EVERY_SIZE)
def test_every_preset_is_valid_at_every_size(agent, suite, preset, size):
    config = validate.preset(agent, suite, preset, size)
    validate.check(config)
    chosen = config.agent, config.suite, config.preset, config.size
    assert chosen == (agent, suite, preset, size)


@pytest.mark.parametrize(("agent", "suite", "preset"), PRESETS)
def test_every_preset_has_a_size_of_its_own_agent(agent, suite, preset):
    config = validate.preset(agent, suite, preset)
    validate.check(config)
    assert config == with_size(config, config.size)


@pytest.mark.parametrize(("config", "name"), NUMBERS, ids=lambda x: getattr(x, "agent", x))
@pytest.mark.parametrize("value", [-1, math.nan, math.inf, True, "3"])
def test_every_number_is_checked(config, name, value):
    assert_refused(config, name, value)


def assert_refused(config, name, value):
    with pytest.raises(InvalidInput) as error:
        validate.check(changed(name, value, config))
    assert error.value.field == name
    assert str(error.value).startswith(f"{name}={value!r}: ")
    assert "\n" not in str(error.value)


def quick(suite, agent="dreamerv3"):
    return registry.kind(agent).presets[suite]["quick"]


@pytest.mark.parametrize("agent", registry.names())
@pytest.mark.parametrize("suite", suites.SUITES)
def test_every_number_of_an_environment_is_checked(suite, agent):
    for name in numbers(quick(suite, agent)):
        if name.startswith("env."):
            for value in (-2, math.nan, True, "3"):
                assert_refused(quick(suite, agent), name, value)


def test_every_rule_is_about_a_field():
    names = set().union(
        *(numbers(quick(suite, agent)) for agent, own in OF_AGENTS.items() for suite in own)
    )
    assert set(validate.RULES) <= names
    for suite in suites.SUITES.values():
        assert {f"env.{name}" for name in suite.rules} <= names


@pytest.mark.parametrize(
    ("name", "value", "remedy"),
    [
        ("env_steps", 0, "above 0"),
        ("num_envs", 0, "above 0"),
        ("env_steps", 1.5, "whole number"),
        ("action_repeat", 3, "divisor of 1000"),
        ("compute_dtype", "float23", "did you mean 'float32'"),
        ("value_alignment.weight", "none", "use one of adaptive, static, off"),
        ("world_model.deter", 30, "multiple of world_model.blocks=4"),
        ("world_model.classes", 257, "from 2 to 256"),
        ("world_model.decoder_layers", 1_000_000, "from 1 to 100"),
        ("actor.layers", 101, "from 1 to 100"),
        ("critic.bins", 40, "odd number"),
        ("critic.slow_rate", 1.5, "up to 1"),
        ("imagination.lambda_", 1.01, "from 0 to 1"),
        ("imagination.discount_horizon", 1.0, "above 1"),
        ("imagination.return_scale_low", 0.95, "less than imagination.return_scale_high"),
        ("actor.min_std", 2.0, "at most actor.max_std"),
        ("replay.capacity", 31, "at least 32, or smaller batches than 2 x 8"),
        ("env_steps", 31, "at least 32, what the first update needs"),
        ("num_envs", 20, "use 5"),
        ("collect_steps", 33, "at most 32"),
        ("seed", 2**32, "from 0 to 4294967295"),
        ("replay.batch_length", 1, "at least 2"),
        ("env_steps", 2**31, "below 2147483648"),
        ("critic.slow_scale", 2**32, "below 2147483648, or write it with a point"),
        ("train_ratio", 2**31 // 8, "use 268435454 at most"),
        ("critic.replay_gradient", [], "use True or False"),
        ("critic.replay_gradient", 1, "use True or False"),
        ("task", None, "use a text"),
        ("tracker_project", 3, "use a text"),
        ("actor", None, "use ActorConfig"),
    ],
)
def test_bad_values_come_with_a_remedy(name, value, remedy):
    with pytest.raises(InvalidInput, match=remedy) as error:
        validate.check(changed(name, value))
    assert error.value.field == name


def test_the_number_of_environments_that_is_named_fits():
    validate.check(tiny.config(num_envs=5))


@pytest.mark.parametrize(
    "config", [tiny.CONFIG, tiny_storm.CONFIG], ids=lambda config: config.agent
)
def test_every_number_of_layers_is_bounded(config):
    names = (name for name, _ in validate.values(config))
    depths = [name for name in names if name.endswith(("layers", "blocks"))]
    assert len(depths) > 3
    for name in depths:
        for value in (0, 101):
            assert_refused(config, name, value)


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("replay.capacity", 32),
        ("env_steps", 32),
        ("train_ratio", 268435454),
        ("seed", 2**32 - 1),
    ],
)
def test_the_smallest_value_that_is_named_is_accepted(name, value):
    validate.check(changed(name, value))


@pytest.mark.parametrize(("agent", "suite", "preset"), PRESETS)
def test_a_batch_larger_than_replay_is_blamed_and_a_smaller_one_named(agent, suite, preset):
    config = registry.kind(agent).presets[suite][preset]
    with pytest.raises(InvalidInput, match="does not fit into") as error:
        validate.check(changed("replay.batch_size", 100_000, config))
    assert error.value.field == "replay.batch_size"
    largest = int(error.value.remedy.split()[-3])
    validate.check(changed("replay.batch_size", largest, config))
    with pytest.raises(InvalidInput):
        validate.check(changed("replay.batch_size", largest + 1, config))
    with pytest.raises(InvalidInput) as error:
        validate.check(changed("replay.batch_length", 10**7, config))
    assert error.value.field == "replay.batch_length"


QUICK = presets.QUICK


@pytest.mark.parametrize(
    ("config", "message"),
    [
        (changed("size", "bogus"), "size='bogus': use one of 1m, .*, custom"),
        (changed("size", "12", QUICK), "size='12': did you mean '12m'"),
        (changed("preset", "bogus"), "preset='bogus': use one of quick, paper, custom"),
        (changed("preset", "tiny"), "preset='tiny': "),
        (changed("size", "12m", STORM), "size='12m': did you mean '1m'"),
        (changed("preset", "paper", STORM), "preset='paper': use one of quick, custom"),
    ],
)
def test_a_config_of_no_known_size_or_preset_is_refused(config, message):
    with pytest.raises(InvalidInput, match=message):
        validate.check(config)


@pytest.mark.parametrize(
    ("config", "width"),
    [
        (changed("size", "12m", QUICK), "world_model.deter=2048, not 512"),
        (changed("world_model.deter", 1024, QUICK), "world_model.deter=512, not 1024"),
        (changed("world_model.hidden", 65, QUICK), "world_model.hidden=64, not 65"),
        (changed("world_model.classes", 5, QUICK), "world_model.classes=4, not 5"),
        (changed("world_model.units", 65, QUICK), "world_model.units=64, not 65"),
        (changed("world_model.depth", 8, QUICK), "world_model.depth=4, not 8"),
        (changed("actor.units", 65, QUICK), "actor.units=64, not 65"),
        (changed("critic.units", 65, QUICK), "critic.units=64, not 65"),
        (changed("size", "16m", STORM), "world_model.deter=512, not 128"),
        (changed("world_model.deter", 64, STORM), "world_model.deter=128, not 64"),
        (changed("world_model.feedforward", 64, STORM), "world_model.feedforward=256, not 64"),
        (changed("world_model.heads", 8, STORM), "world_model.heads=4, not 8"),
        (changed("world_model.classes", 5, STORM), "world_model.classes=8, not 5"),
        (changed("world_model.units", 65, STORM), "world_model.units=128, not 65"),
        (changed("world_model.depth", 4, STORM), "world_model.depth=8, not 4"),
        (changed("actor.units", 65, STORM), "actor.units=128, not 65"),
        (changed("critic.units", 65, STORM), "critic.units=128, not 65"),
    ],
)
def test_a_size_with_widths_of_another_is_refused(config, width):
    with pytest.raises(InvalidInput, match=f"has {width}; use agent.with_size") as error:
        validate.check(config)
    assert (error.value.field, error.value.value) == ("size", config.size)
    validate.check(dataclasses.replace(config, size="custom"))
    validate.check(with_size(config, config.size))


def test_unknown_presets_and_sizes_come_with_a_suggestion():
    with pytest.raises(InvalidInput, match=r"preset='papr': .*'paper'"):
        validate.preset("dreamerv3", "dmc_proprio", "papr")
    with pytest.raises(InvalidInput, match=r"size='12': .*'12m'"):
        validate.preset("dreamerv3", "dmc_proprio", "quick", "12")
    with pytest.raises(InvalidInput, match=r"suite='atari': .*'atari100k'"):
        validate.preset("dreamerv3", "atari", "quick")
    with pytest.raises(InvalidInput, match=r"agent='strom': .*'storm'"):
        validate.preset("strom", "dmc_proprio", "quick")
    with pytest.raises(InvalidInput, match=r"size='12m': .*'1m'"):
        validate.preset("storm", "dmc_proprio", "quick", "12m")
    with pytest.raises(InvalidInput, match="preset='paper': "):
        validate.preset("storm", "dmc_proprio", "paper")


FROM_CONTEXTS = changed("imagination.starts", "contexts")
CUSTOM_STORM = changed("size", "custom", STORM)


@pytest.mark.parametrize(
    ("config", "message"),
    [
        (changed("agent", "strom"), "agent='strom': .*'storm'"),
        (
            changed("agent", "storm"),
            "world_model='RSSMConfig': .*StormConfig",
        ),
        (
            changed("agent", "dreamerv3", STORM),
            "world_model='StormConfig': .*RSSMConfig",
        ),
        (
            changed("optimizer", LaPropConfig(), STORM),
            "optimizer='LaPropConfig': .*AdamConfig",
        ),
        (
            changed("optimizer", AdamConfig()),
            "optimizer='AdamConfig': .*LaPropConfig",
        ),
        (
            changed("critic.replay_scale", 0.3, STORM),
            "critic.replay_scale=0.3: .*0",
        ),
        (FROM_CONTEXTS, "critic.replay_scale=0.3: .*0"),
        (
            changed("imagination.context_length", 33, STORM),
            "imagination.context_length=33: .*replay.batch_length=32",
        ),
        (
            changed("imagination.starts", "posteriors", STORM),
            "imagination.starts='posteriors': ",
        ),
        (
            changed("world_model.positions", 31, STORM),
            "replay.batch_length=32: .*world_model.positions=31",
        ),
        (
            changed("imagination.horizon", 25, STORM),
            "imagination.horizon=25: .*24.*32",
        ),
        (
            changed("world_model.act_context", 33, STORM),
            "world_model.act_context=33: .*32",
        ),
        (
            changed("world_model.deter", 126, CUSTOM_STORM),
            "world_model.deter=126: .*world_model.heads=4",
        ),
        (changed("world_model.dropout", 1.0, STORM), "world_model.dropout=1.0: "),
        (changed("random_steps", -1), "random_steps=-1: .*0"),
    ],
)
def test_what_an_agent_cannot_do_is_refused(config, message):
    with pytest.raises(InvalidInput, match=message):
        validate.check(config)


@pytest.mark.parametrize(
    "config",
    [
        changed("world_model.positions", 32, STORM),
        changed("world_model.act_context", 32, STORM),
        changed("imagination.horizon", 24, STORM),
        changed("imagination.context_length", 16, STORM),
        changed("world_model.deter", 124, CUSTOM_STORM),
        # A recurrent model can follow a context too.
        changed("critic.replay_scale", 0.0, FROM_CONTEXTS),
    ],
)
def test_what_an_agent_can_just_do_is_accepted(config):
    validate.check(config)


ATARI, VISION = quick("atari100k"), quick("dmc_vision")


@pytest.mark.parametrize(
    ("config", "message"),
    [
        (
            changed("env.resize", "area", changed("env.image_size", 192, ATARI)),
            "env.image_size=192: .*160",
        ),
        (
            changed("actor.collect_temperature", 0.1, presets.VISION_PAPER),
            "actor.collect_temperature=0.1: .*1",
        ),
        (changed("env.pooling", 5, ATARI), "env.pooling=5: .*action_repeat.*4"),
        (changed("env.image_size", 60, ATARI), "env.image_size=60: .*16"),
        (changed("env.image_size", 512, VISION), "env.image_size=512: .*16"),
        (changed("env.sticky", 1.0, ATARI), "env.sticky=1.0: .*0"),
        (changed("env.resize", "cubic", ATARI), "env.resize='cubic': "),
        (changed("action_repeat", 3, VISION), "action_repeat=3: .*1000"),
        (changed("action_repeat", 2, quick("gymnasium")), "action_repeat=2: .*1"),
        (changed("suite", "atari100k", VISION), "env='VisionConfig': "),
        (changed("suite", "atari", ATARI), "suite='atari': .*'atari100k'"),
        (changed("video.context", 32, VISION), "video.context=32: .*replay.batch"),
        (
            changed("size", "custom", changed("world_model.depth", 3, ATARI)),
            "world_model.depth=3: .*blocks=8",
        ),
        (changed("replay.images", "host"), "replay.images='host': "),
        (changed("video.every", 10), "video.every=10: "),
    ],
)
def test_what_a_suite_does_not_allow_is_refused(config, message):
    with pytest.raises(InvalidInput, match=message):
        validate.check(config)


def test_a_frame_skip_need_not_divide_an_episode():
    validate.check(changed("action_repeat", 3, ATARI))


def test_environments_that_are_not_what_the_config_says_are_refused():
    spec = tiny.env().spec
    validate.check_spec(tiny.CONFIG, spec)
    with pytest.raises(InvalidInput, match=r"num_envs=2: .*3"):
        validate.check_spec(tiny.CONFIG, spec._replace(num_envs=3))
    with pytest.raises(InvalidInput, match=r"action_repeat=1: .*2"):
        validate.check_spec(tiny.CONFIG, spec._replace(action_repeat=2))
    pixels = changed("replay.images", "host", quick("gymnasium"))
    spec = spec._replace(num_envs=pixels.num_envs)
    with pytest.raises(InvalidInput, match="no images in these observations"):
        validate.check_spec(pixels, spec)
    validate.check_spec(pixels, spec._replace(obs={"a": spec.obs, "b": image(64)}))
