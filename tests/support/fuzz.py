"""Random configs: tiny ones of every agent, with a few choices replaced by arbitrary values.

Each config has to be refused by the name of a choice, or to train.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import pathlib
import typing
from collections.abc import Callable

import jax
import tiny
import tiny_pixels
import tiny_storm
import tiny_vagram
from hypothesis import strategies as st

from vawm.agent import make_agent
from vawm.config import Config, HostEnvConfig
from vawm.errors import InvalidInput
from vawm.learning import train
from vawm.runs import diagnosis, runner, suites, validate
from vawm.types import EnvSpec

STEPS = 50  # at most, for a config that has not reached its second update

PIXELS = {
    suite: tiny_pixels.config(
        suite=suite,
        env=record.choices(workers=1),
        action_repeat=4 if suite == "atari100k" else 1,
        env_steps=4 * tiny.CONFIG.env_steps,
    )
    for suite, record in suites.SUITES.items()
    if issubclass(record.choices, HostEnvConfig)
}
"""Configs that learn from images, one for every suite on the host."""
BASES = {"dreamerv3": tiny.CONFIG, "storm": tiny_storm.CONFIG, "vagram": tiny_vagram.CONFIG}

USUAL_INTS = st.integers(1, 9) | st.sampled_from([0, 16, 24, 32, 48, 64, 200])
INTS = USUAL_INTS | st.sampled_from([-1, 255, 1000, 10**6, 2**31 - 1, 2**31, 2**32, 10**12])
USUAL_FLOATS = st.floats(0, 2) | st.sampled_from([0.0, 0.5, 1.0, 1e-3, 10.0, 333.0])
FLOATS = USUAL_FLOATS | st.sampled_from([-1.0, 1e-30, 1e30, math.nan, math.inf, -math.inf])
JUNK = st.none() | st.booleans() | st.text(max_size=3) | st.just([]) | FLOATS | INTS


def value_of(kind: typing.Any) -> st.SearchStrategy:
    """Values for a field of type `kind`: mostly what the type allows, sometimes junk."""
    if typing.get_origin(kind) is typing.Literal:
        usual = st.sampled_from(typing.get_args(kind))
    elif kind is bool:
        usual = st.booleans()
    elif kind is int:
        usual = USUAL_INTS
    elif kind is float:
        usual = USUAL_FLOATS
    else:
        usual = st.text(max_size=3)
    return st.one_of(usual, usual, usual, INTS if kind is int else FLOATS, JUNK)


class Nothing:
    """Replaces `tiny_pixels.pool()`: has only what is known before a process starts."""

    restarts = 0

    def __init__(self, action_repeat):
        obs, num_envs = tiny_pixels.Lamp.obs, tiny.CONFIG.num_envs
        self.spec = EnvSpec("lamp", obs, 2, True, num_envs, action_repeat, 4)

    def close(self):
        pass


@st.composite
def configs(draw: st.DrawFn, bases: typing.Mapping[str, Config] = BASES) -> Config:
    config = bases[draw(st.sampled_from(sorted(bases)))]
    fields = list(validate.fields(config))
    count = draw(st.integers(1, 4))
    chosen = draw(st.lists(st.sampled_from(fields), min_size=count, max_size=count))
    for name, _, kind in chosen:
        config = replace(config, name, draw(value_of(kind)))
    return config


def replace(config: typing.Any, name: str, value: typing.Any) -> typing.Any:
    """`config` with the field of a dotted name replaced."""
    head, _, rest = name.partition(".")
    if rest:
        value = replace(getattr(config, head), rest, value)
    return dataclasses.replace(config, **{head: value})


NAMES = {name for b in (BASES | PIXELS).values() for name, _ in validate.values(b)}
NAMES |= {"world_model", "optimizer", "env"}


def refusal(config: Config, folder: pathlib.Path) -> str:
    """Why `config` is refused: one line that begins with the name of a choice. Or ""."""
    try:
        runner.check(config, folder, resume=False, known_task=False)
        on_device = suites.host_choices(config) is None
        runner.prepare(config, tiny.env() if on_device else Nothing(config.action_repeat))
    except InvalidInput as error:
        if error.field not in NAMES or "\n" in str(error):
            raise AssertionError(f"not one line about a choice: {error}") from error
        return str(error)
    return ""


def trace(config: Config) -> None:
    """Traces the whole training step of a valid config; it must keep shapes and dtypes."""
    init, step = programs(config)
    before = jax.eval_shape(init, jax.random.key(0))
    after, metrics = jax.eval_shape(step, before)
    check_alike(before, after)
    assert all(metric.shape == () for metric in metrics.values())


def run(config: Config) -> str:
    """Compiles and runs the step that `trace` traces, until two updates. Returns the outcome.

    "learned": everything that is learned stays finite. "diagnosed": it does not, and a run
    would stop and say so. "collected": no second update within `STEPS` steps.
    """
    init, step = programs(config)
    step = jax.jit(step)
    state = jax.jit(init)(jax.random.key(0))
    for _ in range(STEPS):
        before = jax.eval_shape(lambda x: x, state)
        state, metrics = step(state)
        check_alike(before, state)
        if diagnosis.reason(state, jax.device_get(metrics), last=True):
            return "diagnosed"
        if int(state.learner.step) >= 2:
            return "learned"
    return "collected"


def programs(config: Config) -> tuple[Callable, Callable]:
    """The functions that start and continue a run of `config`."""
    env = tiny.env()
    agent = make_agent(config, env.spec)
    return functools.partial(train.init, env, agent, config), train.make_train_step(
        env, agent, config
    )


def check_alike(before: typing.Any, after: typing.Any) -> None:
    assert jax.tree.structure(after) == jax.tree.structure(before)
    for new, old in zip(jax.tree.leaves(after), jax.tree.leaves(before), strict=True):
        assert (new.shape, new.dtype) == (old.shape, old.dtype)
