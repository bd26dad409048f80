"""Refuses a config that cannot run, before anything is compiled, allocated or written."""

from __future__ import annotations

import dataclasses
import math
import re
import typing
from collections.abc import Collection, Iterator, Mapping
from typing import Any

import jax

from vawm.agent import registry
from vawm.config import CUSTOM, Config, kinds, presets
from vawm.errors import (
    ABOVE_ONE,
    BELOW_ONE,
    BINS,
    CLASSES,
    LAYERS,
    NOT_NEGATIVE,
    POSITIVE,
    RATE,
    SEQUENCE,
    SHARE,
    InvalidInput,
    Rule,
    suggestion,
)
from vawm.runs import suites
from vawm.types import EnvSpec, is_image

RULES: dict[str, Rule] = {
    "seed": (lambda x: 0 <= x < 2**32, "use a number from 0 to 4294967295"),
    "random_steps": NOT_NEGATIVE,
    "world_model.stoch": POSITIVE,
    "world_model.classes": CLASSES,
    "world_model.bins": BINS,
    "world_model.unimix": BELOW_ONE,
    "world_model.free_nats": NOT_NEGATIVE,
    "world_model.reconstruction_scale": NOT_NEGATIVE,
    "world_model.dynamics_scale": NOT_NEGATIVE,
    "world_model.representation_scale": NOT_NEGATIVE,
    "actor.layers": LAYERS,
    "critic.layers": LAYERS,
    "actor.unimix": BELOW_ONE,
    "actor.scale": NOT_NEGATIVE,
    "actor.entropy_scale": NOT_NEGATIVE,
    "env.workers": NOT_NEGATIVE,
    "critic.bins": BINS,
    "critic.scale": NOT_NEGATIVE,
    "critic.slow_rate": RATE,
    "critic.slow_scale": NOT_NEGATIVE,
    "critic.replay_scale": NOT_NEGATIVE,
    "imagination.lambda_": SHARE,
    "imagination.context_length": SEQUENCE,
    "imagination.discount_horizon": ABOVE_ONE,
    "imagination.return_scale_decay": BELOW_ONE,
    "imagination.return_scale_low": SHARE,
    "imagination.return_scale_high": SHARE,
    "value_alignment.static_weight": NOT_NEGATIVE,
    "value_alignment.warmup_steps": NOT_NEGATIVE,
    "value_alignment.dynamics_scale": NOT_NEGATIVE,
    "value_alignment.representation_scale": NOT_NEGATIVE,
    "replay.batch_length": SEQUENCE,
    "optimizer.warmup_updates": NOT_NEGATIVE,
    "optimizer.beta1": BELOW_ONE,
    "optimizer.beta2": BELOW_ONE,
    "video.every": NOT_NEGATIVE,
    "save_minutes": NOT_NEGATIVE,
}
"""Field -> what its number must be; positive if not here. Agents and suites add their own."""

KINDS = {bool: "True or False", str: "a text"}
LONGEST_LABEL = 64  # characters of a tag, at Weights & Biases
INT32 = 2**31  # whole numbers are counted with on the device, all but the seed


def check(config: Config) -> None:
    """Checks every field alone and all of them together; the task is the caller's.

    Raises:
      InvalidInput: names the first field that cannot work, its value and the remedy.
    """
    check_choice("agent", config.agent, registry.names())
    check_choice("suite", config.suite, list(suites.SUITES))
    _check_env_class(config)
    rules = RULES | _own_rules(config)
    for name, value, kind in fields(config):
        if typing.get_origin(kind) is typing.Literal:
            check_choice(name, value, typing.get_args(kind))
        elif kind in (int, float):
            _check_number(name, value, kind, rules)
        elif isinstance(kind, type) and not isinstance(value, kind):
            raise InvalidInput(name, value, f"use {KINDS.get(kind, kind.__name__)}")
    _check_together(config)


def check_task(config: Config) -> None:
    """Checks the suite and its task, and no number.

    Raises:
      InvalidInput: names what is unknown, and the nearest one.
    """
    check_choice("suite", config.suite, list(suites.SUITES))
    if not isinstance(config.task, str):
        raise InvalidInput("task", config.task, f"use {KINDS[str]}")
    suites.check_task(config)


def check_choice(name: str, value: Any, choices: Collection[str]) -> None:
    """Refuses what is not among `choices`, and suggests the nearest."""
    if value in choices:
        return
    guess = suggestion(value, choices)
    raise InvalidInput(name, value, f"{guess}use one of {', '.join(choices)}")


def values(config: Config) -> Iterator[tuple[str, Any]]:
    """(dotted name, value) of every choice, such as ("replay.capacity", 5_000_000)."""
    for name, value, _ in fields(config):
        yield name, value


def fields(node: Any, prefix: str = "") -> Iterator[tuple[str, Any, Any]]:
    """(dotted name, value, type) of every field that holds no further fields."""
    kind: type = type(node)
    hints = kinds(kind)
    for field in dataclasses.fields(node):
        name, value = prefix + field.name, getattr(node, field.name)
        if dataclasses.is_dataclass(value):
            yield from fields(value, name + ".")
        else:
            yield name, value, hints[field.name]


def _check_number(name: str, value: Any, kind: type, rules: Mapping[str, Rule]) -> None:
    number = isinstance(value, int if kind is int else int | float)
    if isinstance(value, bool) or not number:
        raise InvalidInput(name, value, f"use a {'whole ' if kind is int else ''}number")
    if not math.isfinite(value):
        raise InvalidInput(name, value, "use a finite number")
    holds, remedy = rules.get(name, POSITIVE)
    if not holds(value):
        raise InvalidInput(name, value, remedy)
    if isinstance(value, int) and value >= INT32 and name != "seed":
        point = "" if kind is int else ", or write it with a point"
        raise InvalidInput(name, value, f"use a number below {INT32}{point}")


def _check_together(config: Config) -> None:
    _check_agent(config)
    _check_names(config)
    _check_project(config.tracker_project)
    _check_labels(config)
    _check_imagination(config)
    registry.kind(config.agent).check(config)
    _check_replay(config)
    _check_counters(config)
    _check_env(config)
    if config.actor.min_std > config.actor.max_std:
        remedy = f"use at most actor.max_std={config.actor.max_std}"
        raise InvalidInput("actor.min_std", config.actor.min_std, remedy)
    scale = config.imagination
    if scale.return_scale_low >= scale.return_scale_high:
        remedy = f"use less than imagination.return_scale_high={scale.return_scale_high}"
        raise InvalidInput("imagination.return_scale_low", scale.return_scale_low, remedy)


def _check_env_class(config: Config) -> None:
    """A suite has the choices of its own kind."""
    kind = suites.of(config).choices
    if type(config.env) is not kind:
        remedy = f"suite {config.suite} takes a {kind.__name__}"
        raise InvalidInput("env", type(config.env).__name__, remedy)


def _own_rules(config: Config) -> dict[str, Rule]:
    """The rules of the agent and of the suite."""
    model, env = registry.kind(config.agent).rules, suites.of(config).rules
    return {f"world_model.{name}": rule for name, rule in model.items()} | {
        f"env.{name}": rule for name, rule in env.items()
    }


def _check_agent(config: Config) -> None:
    """An agent has the choices of its own kind."""
    row = registry.kind(config.agent)
    for name, kind in (("world_model", row.world_model), ("optimizer", row.optimizer)):
        if type(getattr(config, name)) is not kind:
            remedy = f"agent {config.agent} takes a {kind.__name__}"
            raise InvalidInput(name, type(getattr(config, name)).__name__, remedy)


def _check_names(config: Config) -> None:
    """Preset and size are known, and the widths match the named size."""
    check_choice("preset", config.preset, [*registry.presets_of(config), CUSTOM])
    check_choice("size", config.size, [*registry.kind(config.agent).sizes, CUSTOM])
    if config.size == CUSTOM:
        return
    widths = dict(values(registry.with_size(config, config.size)))
    for name, value in values(config):
        if value != widths[name]:
            remedy = (
                f"has {name}={widths[name]}, not {value}; "
                f"use agent.with_size(..., {config.size!r}), or size={CUSTOM!r}"
            )
            raise InvalidInput("size", config.size, remedy)


def _check_project(name: str) -> None:
    """The tracker's project is a valid name of a file."""
    if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}", name):
        remedy = "use up to 100 letters, digits, '-', '_' and '.', a letter or digit first"
        raise InvalidInput("tracker_project", name, remedy)


def _check_labels(config: Config) -> None:
    """The tracker's group and tags are short texts on one line, as trackers take them."""
    for name, texts in (
        ("tracker_group", [config.tracker_group]),
        ("tracker_tags", config.tracker_tags.split(",")),
    ):
        value = getattr(config, name)
        if value and not all(
            text.isprintable() and 0 < len(text.strip()) <= LONGEST_LABEL for text in texts
        ):
            remedy = f"use texts of 1 to {LONGEST_LABEL} characters"
            raise InvalidInput(name, value, remedy)


def _check_imagination(config: Config) -> None:
    """Where imagination starts, and what depends on it."""
    imagination = config.imagination
    from_contexts = imagination.starts == "contexts"
    if from_contexts and config.critic.replay_scale:
        remedy = "use 0: the replay value loss needs imagination.starts=posteriors"
        raise InvalidInput("critic.replay_scale", config.critic.replay_scale, remedy)
    if from_contexts and imagination.context_length > config.replay.batch_length:
        remedy = f"use at most replay.batch_length={config.replay.batch_length}"
        raise InvalidInput("imagination.context_length", imagination.context_length, remedy)


def _first_update(config: Config) -> int:
    """Steps of each environment that replay holds when learning starts.

    That is as soon as there are as many sequences to draw as a batch has steps.
    """
    return config.replay.batch_length + -(-config.replay.batch_steps // config.num_envs)


def smallest_replay(config: Config) -> int:
    """The least `replay.capacity` that can fill a batch and hold a chunk."""
    return max(_first_update(config), config.collect_steps) * config.num_envs


def _check_replay(config: Config) -> None:
    """Replay can fill a batch, and the run lasts long enough for that."""
    replay, num_envs = config.replay, config.num_envs
    batches = f"smaller batches than {replay.batch_size} x {replay.batch_length}"
    needed = _first_update(config)
    needed_env_steps = needed * num_envs * config.action_repeat
    fits = replay.capacity // num_envs >= needed
    if not (fits and config.env_steps >= needed_env_steps):
        _blame_batch(config)
        _blame_envs(config, needed)
    if not fits:
        remedy = f"use at least {needed * num_envs}, or {batches}"
        raise InvalidInput("replay.capacity", replay.capacity, remedy)
    per_env = replay.capacity // num_envs
    if config.collect_steps > per_env:
        remedy = f"use at most {per_env}, replay.capacity / num_envs"
        raise InvalidInput("collect_steps", config.collect_steps, remedy)
    if config.env_steps < needed_env_steps:
        remedy = (
            f"use at least {needed_env_steps}, what the first update needs in replay, "
            f"or {batches}"
        )
        raise InvalidInput("env_steps", config.env_steps, remedy)


def _usual(config: Config) -> Config:
    """The preset of this run; that of the paper where it has none of its own."""
    return registry.presets_of(config).get(config.preset, presets.PAPER)


def _blame_batch(config: Config) -> None:
    """Refuses a batch that is too large for the replay buffer and larger than the preset's.

    Raises:
      InvalidInput: with the largest batch that would do; not for a batch of usual size.
    """
    replay, num_envs = config.replay, config.num_envs
    usual = _usual(config).replay
    if replay.batch_steps <= usual.batch_steps:
        return
    held = min(replay.capacity, config.env_steps // config.action_repeat) // num_envs
    largest = (held - replay.batch_length) * num_envs // replay.batch_length
    too_large = (
        f"a batch of {replay.batch_size} x {replay.batch_length} does not fit into the "
        f"{held * num_envs} steps that replay will hold"
    )
    if largest < 1:
        remedy = f"{too_large}; use a smaller one"
        raise InvalidInput("replay.batch_length", replay.batch_length, remedy)
    raise InvalidInput(
        "replay.batch_size", replay.batch_size, f"{too_large}; use {largest} at most"
    )


def _blame_envs(config: Config, needed: int) -> None:
    """Refuses more environments than the preset's if replay holds too few steps of each.

    Raises:
      InvalidInput: with a number that would do; not for a usual number, nor if a single
        environment were too many.
    """
    usual = _usual(config).num_envs
    held = min(config.replay.capacity, config.env_steps // config.action_repeat)
    # n environments need n * (L + ceil(B * L / n)), which is below n * (L + 1) + B * L.
    enough = (held - config.replay.batch_steps) // (config.replay.batch_length + 1)
    if config.num_envs <= usual or enough < 1:
        return
    remedy = (
        f"replay will hold {held // config.num_envs} steps of each but needs {needed}; "
        f"use {enough}"
    )
    raise InvalidInput("num_envs", config.num_envs, remedy)


def _check_counters(config: Config) -> None:
    """The replayed steps that are owed are an int32, and less than a batch is carried over."""
    owed = config.collect_steps * config.num_envs
    largest = (INT32 - config.replay.batch_steps) // owed
    if config.train_ratio <= largest:
        return
    if largest >= 1:
        remedy = f"use {largest} at most, or fewer collect_steps or num_envs"
        raise InvalidInput("train_ratio", config.train_ratio, remedy)
    remedy = f"use fewer: collect_steps * num_envs * train_ratio has to be below {INT32}"
    raise InvalidInput("collect_steps", config.collect_steps, remedy)


def _check_env(config: Config) -> None:
    """What the suite refuses, and what depends on whether it has images."""
    suite, sequence = suites.of(config), config.replay.batch_length
    suite.check(config, config.env)
    if config.video.every and config.video.context >= sequence:
        remedy = f"use less than replay.batch_length={sequence}, or nothing is left to predict"
        raise InvalidInput("video.context", config.video.context, remedy)
    if not suite.has_images:
        check_images(config, present=False)


def check_spec(config: Config, spec: EnvSpec) -> None:
    """Refuses environments that are not what the config says of them.

    Raises:
      InvalidInput: their number, their action repeat, or choices for images they do not have.
    """
    for name in ("num_envs", "action_repeat"):
        if getattr(config, name) != getattr(spec, name):
            remedy = f"the environments have {getattr(spec, name)}; use that"
            raise InvalidInput(name, getattr(config, name), remedy)
    check_images(config, present=any(map(is_image, jax.tree.leaves(spec.obs))))


def check_images(config: Config, *, present: bool) -> None:
    """Refuses choices for images where there are no images.

    Raises:
      InvalidInput: replay is to keep images on the host, or videos are to be made.
    """
    if present:
        return
    if config.replay.images == "host":
        remedy = "there are no images in these observations; use 'device'"
        raise InvalidInput("replay.images", config.replay.images, remedy)
    if config.video.every:
        remedy = "there are no images in these observations; use 0"
        raise InvalidInput("video.every", config.video.every, remedy)


def preset(agent: str, suite: str, name: str, size: str | None = None) -> Config:
    """The config of a preset, at another size where one is given."""
    check_choice("agent", agent, registry.names())
    row = registry.kind(agent)
    if suite not in row.presets:
        remedy = f"agent {agent} has no presets for it; use one of {', '.join(row.presets)}"
        raise InvalidInput("suite", suite, suggestion(suite, row.presets) + remedy)
    known = row.presets[suite]
    check_choice("preset", name, known)
    if size is None:
        return known[name]
    check_choice("size", size, [*row.sizes, CUSTOM])
    return registry.with_size(known[name], size)
