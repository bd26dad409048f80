"""The suites of tasks: one record each, which everything else looks up.

A new suite is a file beside this one, a line in `SUITES`, and its presets in `vawm.presets`.
No other code asks which suite a run is of.
"""

from __future__ import annotations

import dataclasses
from typing import Any

from vawm.config import Config, GymnasiumConfig, HostEnvConfig
from vawm.envs import made as records
from vawm.envs.protocol import Environment, HostEnvironment
from vawm.errors import InvalidInput
from vawm.runs.suites import atari100k, dmc_proprio, dmc_vision, gymnasium
from vawm.runs.suites.record import Protocol, Suite
from vawm.types import Made

__all__ = [
    "SUITES",
    "Protocol",
    "Suite",
    "check_made",
    "check_task",
    "host_choices",
    "make",
    "make_again",
    "make_drawn",
    "of",
]

SUITES: dict[str, Suite] = {
    "dmc_proprio": dmc_proprio.SUITE,
    "dmc_vision": dmc_vision.SUITE,
    "atari100k": atari100k.SUITE,
    "gymnasium": gymnasium.SUITE,
}
"""Name, as in `Config.suite` -> record."""


def of(config: Config) -> Suite:
    """The record of a run's suite."""
    return SUITES[config.suite]


def check_task(config: Config) -> None:
    """Refuses a task that the suite does not have.

    Raises:
      InvalidInput: names the task and the nearest one.
    """
    of(config).check_task(config.task)


def make(config: Config) -> Environment | HostEnvironment:
    """The environments of a run. Those on the host have processes: close them.

    Raises:
      InvalidInput: they cannot be made, for example because a package is missing.
    """
    return _recorded(config, of(config).make(config, config.env))


def make_drawn(config: Config) -> HostEnvironment:
    """As `make`, but on the host, and with pictures for films if there can be any.

    Raises:
      InvalidInput: also if no renderer works here.
    """
    suite = of(config)
    make_one: Any = suite.make_drawn or suite.make
    env: Any = _recorded(config, make_one(config, config.env))
    return env


def _recorded(
    config: Config, env: Environment | HostEnvironment
) -> Environment | HostEnvironment:
    """`env`, which the suite of `config` has made, with a record of that if it has none."""
    if records.of(env).by != records.OBJECT:
        return env
    processes = {field.name for field in dataclasses.fields(HostEnvConfig)}
    chosen = {n: x for n, x in dataclasses.asdict(config.env).items() if n not in processes}
    chosen["action_repeat"] = config.action_repeat
    made = Made(config.suite, config.task, chosen)
    if isinstance(env, Environment):
        return env._replace(spec=env.spec._replace(made=made))
    env.made = made
    return env


def check_made(made: Made | None, *, python: str) -> None:
    """Refuses environments that were made by code of the caller's.

    Raises:
      InvalidInput: the remedy names `python`, two statements that use such environments.
    """
    if made is not None and not records.can_be_made_again(made):
        remedy = f"no command can make it again; in Python: {python}"
        raise InvalidInput("env", records.describe(made), remedy)


def make_again(
    config: Config,
    made: Made | None,
    *,
    task: str,
    python: str,
    drawn: bool = False,
    **changes: Any,
) -> Environment | HostEnvironment:
    """The environments that a run was trained in, as its record says. Close those on the host.

    Args:
      config: of the run; its `num_envs` are made, and its choices count where there is no
        record.
      made: the record; None in a run of an earlier version.
      task: name of the task.
      python: two statements that do with the caller's own environments what a command
        cannot, for the remedy.
      drawn: whether to make them by `make_drawn`.
      **changes: choices of the suite's environments that differ from those of the run.

    Raises:
      InvalidInput: they were made by code of the caller's, or cannot be made here.
    """
    making = make_drawn if drawn else make
    if made is None:
        env = dataclasses.replace(config.env, **changes)
        return making(dataclasses.replace(config, env=env))
    check_made(made, python=python)
    if made.by not in SUITES:
        raise InvalidInput("env", records.describe(made), f"suite {made.by} is unknown here")
    suite = SUITES[made.by]
    choices = config.env if type(config.env) is suite.choices else suite.choices()
    known = {field.name for field in dataclasses.fields(suite.choices)}
    recorded = {n: value for n, value in made.options.items() if n in known}
    if suite.choices is GymnasiumConfig:
        recorded["time_limit"] = made.options.get("time_limit") or 0
    choices = dataclasses.replace(choices, **recorded | changes)
    config = dataclasses.replace(
        config,
        suite=made.by,
        task=made.name,
        action_repeat=made.options.get("action_repeat", config.action_repeat),
        env=choices,
    )
    if suite.choices is GymnasiumConfig:
        make_one = gymnasium.make_drawn if drawn else gymnasium.make
        return make_one(config, choices, task=task, **made.kwargs)  # type: ignore[arg-type]
    return making(config)


def host_choices(config: Config) -> HostEnvConfig | None:
    """What is chosen of environments on the host; None for those on the device."""
    return config.env if isinstance(config.env, HostEnvConfig) else None
