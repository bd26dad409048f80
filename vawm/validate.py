"""Refuses a config that cannot run, before anything is compiled, allocated or written."""

from __future__ import annotations

import dataclasses
import difflib
import math
import typing
from collections.abc import Callable, Collection, Iterator
from typing import Any

from vawm import config as config_lib
from vawm.config import Config
from vawm.envs import EPISODE_STEPS
from vawm.errors import InvalidInput

Rule = tuple[Callable[[Any], bool], str]

POSITIVE: Rule = (lambda x: x > 0, "use a number above 0")
NOT_NEGATIVE: Rule = (lambda x: x >= 0, "use 0 or a number above")
SHARE: Rule = (lambda x: 0 <= x <= 1, "use a number from 0 to 1")
BELOW_ONE: Rule = (lambda x: 0 <= x < 1, "use a number from 0 up to, not including, 1")
RATE: Rule = (lambda x: 0 < x <= 1, "use a number above 0 and up to 1")
ABOVE_ONE: Rule = (lambda x: x > 1, "use a number above 1")
BINS: Rule = (lambda x: x >= 3 and x % 2 == 1, "use an odd number of at least 3")
CLASSES: Rule = (lambda x: 2 <= x <= 256, "use a number from 2 to 256")

RULES: dict[str, Rule] = {
    "seed": (lambda x: 0 <= x < 2**32, "use a number from 0 to 4294967295"),
    "world_model.stoch": POSITIVE,
    "world_model.classes": CLASSES,
    "world_model.bins": BINS,
    "world_model.unimix": BELOW_ONE,
    "world_model.free_nats": NOT_NEGATIVE,
    "world_model.reconstruction_scale": NOT_NEGATIVE,
    "world_model.dynamics_scale": NOT_NEGATIVE,
    "world_model.representation_scale": NOT_NEGATIVE,
    "actor.unimix": BELOW_ONE,
    "actor.scale": NOT_NEGATIVE,
    "actor.entropy_scale": NOT_NEGATIVE,
    "critic.bins": BINS,
    "critic.scale": NOT_NEGATIVE,
    "critic.slow_rate": RATE,
    "critic.slow_scale": NOT_NEGATIVE,
    "critic.replay_scale": NOT_NEGATIVE,
    "imagination.lambda_": SHARE,
    "imagination.discount_horizon": ABOVE_ONE,
    "imagination.return_scale_decay": BELOW_ONE,
    "imagination.return_scale_low": SHARE,
    "imagination.return_scale_high": SHARE,
    "value_alignment.static_weight": NOT_NEGATIVE,
    "value_alignment.warmup_steps": NOT_NEGATIVE,
    "value_alignment.dynamics_scale": NOT_NEGATIVE,
    "value_alignment.representation_scale": NOT_NEGATIVE,
    "optimizer.warmup_updates": NOT_NEGATIVE,
    "optimizer.beta1": BELOW_ONE,
    "optimizer.beta2": BELOW_ONE,
}
"""Every other number has to be positive."""


def check(config: Config) -> None:
    """Checks every field alone and all of them together; the task is the caller's.

    Raises:
      InvalidInput: names the first field that cannot work, its value and the remedy.
    """
    for name, value, kind in fields(config):
        if typing.get_origin(kind) is typing.Literal:
            check_choice(name, value, typing.get_args(kind))
        elif kind in (int, float):
            _check_number(name, value, kind)
    _check_together(config)


def check_choice(name: str, value: Any, choices: Collection[str]) -> None:
    """Refuses what is not among `choices`, and suggests the nearest."""
    if value in choices:
        return
    close = difflib.get_close_matches(str(value), choices, n=1)
    guess = f"did you mean {close[0]!r}? " if close else ""
    raise InvalidInput(name, value, f"{guess}use one of {', '.join(choices)}")


def values(config: Config) -> Iterator[tuple[str, Any]]:
    """(dotted name, value) of every choice, such as ("replay.capacity", 5_000_000)."""
    for name, value, _ in fields(config):
        yield name, value


def fields(node: Any, prefix: str = "") -> Iterator[tuple[str, Any, Any]]:
    """(dotted name, value, type) of every field that holds no further fields."""
    hints = typing.get_type_hints(type(node))
    for field in dataclasses.fields(node):
        name, value = prefix + field.name, getattr(node, field.name)
        if dataclasses.is_dataclass(value):
            yield from fields(value, name + ".")
        else:
            yield name, value, hints[field.name]


def _check_number(name: str, value: Any, kind: type) -> None:
    number = isinstance(value, int if kind is int else int | float)
    if isinstance(value, bool) or not number:
        raise InvalidInput(name, value, f"use a {'whole ' if kind is int else ''}number")
    if not math.isfinite(value):
        raise InvalidInput(name, value, "use a finite number")
    holds, remedy = RULES.get(name, POSITIVE)
    if not holds(value):
        raise InvalidInput(name, value, remedy)


def _check_together(config: Config) -> None:
    _check_widths(config)
    _check_replay(config)
    if EPISODE_STEPS % config.action_repeat:
        remedy = f"use a divisor of {EPISODE_STEPS}, the control steps of an episode"
        raise InvalidInput("action_repeat", config.action_repeat, remedy)
    if config.actor.min_std > config.actor.max_std:
        remedy = f"use at most actor.max_std={config.actor.max_std}"
        raise InvalidInput("actor.min_std", config.actor.min_std, remedy)
    scale = config.imagination
    if scale.return_scale_low >= scale.return_scale_high:
        remedy = f"use less than imagination.return_scale_high={scale.return_scale_high}"
        raise InvalidInput("imagination.return_scale_low", scale.return_scale_low, remedy)


def _check_widths(config: Config) -> None:
    deter, blocks = config.world_model.deter, config.world_model.blocks
    if deter % blocks:
        remedy = f"use a multiple of world_model.blocks={blocks}"
        raise InvalidInput("world_model.deter", deter, remedy)


def _check_replay(config: Config) -> None:
    """Learning starts when replay holds as many sequences as a batch has steps."""
    replay = config.replay
    batch_steps = replay.batch_steps
    needed = replay.batch_length + -(-batch_steps // config.num_envs)  # in each environment
    if replay.capacity // config.num_envs < needed:
        remedy = (
            f"use at least {needed * config.num_envs}, or smaller batches than "
            f"{replay.batch_size} x {replay.batch_length}"
        )
        raise InvalidInput("replay.capacity", replay.capacity, remedy)
    per_env = replay.capacity // config.num_envs
    if config.collect_steps > per_env:
        remedy = f"use at most {per_env}, replay.capacity / num_envs"
        raise InvalidInput("collect_steps", config.collect_steps, remedy)
    needed_env_steps = needed * config.num_envs * config.action_repeat
    if config.env_steps < needed_env_steps:
        remedy = (
            f"use at least {needed_env_steps}, what the first update needs in replay, or "
            f"smaller batches than {replay.batch_size} x {replay.batch_length}"
        )
        raise InvalidInput("env_steps", config.env_steps, remedy)


def preset(name: str, size: str | None = None) -> Config:
    """The config of a preset, at another size where one is given."""
    check_choice("preset", name, config_lib.PRESETS)
    if size is None:
        return config_lib.PRESETS[name]
    check_choice("size", size, config_lib.SIZES)
    return config_lib.with_size(config_lib.PRESETS[name], size)
