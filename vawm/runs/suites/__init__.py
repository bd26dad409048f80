"""The suites of tasks: one record each, which everything else looks up.

A new suite is a file beside this one, a line in `SUITES`, and its presets in
`vawm.config.presets`. No other code asks which suite a run is of.
"""

from __future__ import annotations

import dataclasses
from typing import Any

from gymnasium import Env

from vawm.config import Config, GymnasiumConfig, HostEnvConfig
from vawm.envs import made as records
from vawm.envs.gym import HostEnv, PureEnv
from vawm.envs.host.gymnasium import check_registration
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
    "make_one",
    "of",
    "resized_to",
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
    """Refuses environments that no command can make again as they were.

    Raises:
      InvalidInput: they were made by code of the caller's, or by an id that stands for
        something else here. The remedy names `python`, two statements that use environments
        of the caller's.
    """
    if made is None:
        return
    if not records.can_be_made_again(made):
        remedy = f"no command can make it again; in Python: {python}"
        raise InvalidInput("env", records.describe(made), remedy)
    if made.by == "gymnasium":
        check_registration(made, python=python)


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
    config, kwargs = as_recorded(config, made, python=python, **changes)
    if isinstance(config.env, GymnasiumConfig) and made is not None:
        return gymnasium.make(config, config.env, task=task, kwargs=kwargs, drawn=drawn)
    return make_drawn(config) if drawn else make(config)


def make_one(
    config: Config, made: Made | None, *, python: str, render_mode: str | None = None
) -> Env:
    """One environment as those that a run was trained in, as a `gymnasium.Env`.

    It has the observations and actions of the environment itself, and runs in this process if
    Gymnasium makes it. Close it.

    Args:
      config: of the run.
      made: the record; None in a run of an earlier version.
      python: as in `make_again`.
      render_mode: of a registered environment any that it has; "rgb_array" where observations
        have an image.

    Raises:
      InvalidInput: it was made by code of the caller's, cannot be made here, or cannot be
        rendered.
    """
    config, kwargs = as_recorded(config, made, python=python)
    if isinstance(config.env, GymnasiumConfig):
        rendered = {} if render_mode is None else {"render_mode": render_mode}
        return gymnasium.make_one(config, config.env, kwargs | rendered)
    drawn = isinstance(config.env, HostEnvConfig) and of(config).has_images
    if render_mode not in (known := (None, "rgb_array") if drawn else (None,)):
        remedy = f"environments of {config.suite} are not drawn like this; use "
        raise InvalidInput("render_mode", render_mode, remedy + " or ".join(map(str, known)))
    if isinstance(config.env, HostEnvConfig):
        on_host = dataclasses.replace(config.env, on_failure="raise")
        config = dataclasses.replace(config, env=on_host)
    env = make(dataclasses.replace(config, num_envs=1))
    return PureEnv(env) if isinstance(env, Environment) else HostEnv(env, render_mode)


def as_recorded(
    config: Config, made: Made | None, *, python: str, **changes: Any
) -> tuple[Config, dict[str, Any]]:
    """The choices of a run as its record has them, with `changes`; and keyword arguments.

    Raises:
      InvalidInput: its environments were made by code of the caller's, or by an unknown suite.
    """
    if made is None:
        env = dataclasses.replace(config.env, **changes)
        return dataclasses.replace(config, env=env), {}
    check_made(made, python=python)
    if made.by not in SUITES:
        raise InvalidInput("env", records.describe(made), f"suite {made.by} is unknown here")
    suite = SUITES[made.by]
    choices = config.env if type(config.env) is suite.choices else suite.choices()
    known = {field.name for field in dataclasses.fields(suite.choices)}
    recorded = {n: value for n, value in made.options.items() if n in known}
    if suite.choices is GymnasiumConfig:
        recorded["time_limit"] = made.options.get("time_limit") or 0
    config = dataclasses.replace(
        config,
        suite=made.by,
        task=made.name,
        action_repeat=made.options.get("action_repeat", config.action_repeat),
        env=dataclasses.replace(choices, **recorded | changes),
    )
    return config, made.kwargs


def resized_to(config: Config, made: Made | None) -> int | None:
    """Pixels a side to which pictures of an environment of Gymnasium are resized, also by an
    earlier version; None for others, which have the observations and actions of their spec."""
    if made is not None:
        by_gymnasium = made.by in ("gymnasium", records.OBJECT)
        return made.options.get("image_size") if by_gymnasium else None
    return config.env.image_size if isinstance(config.env, GymnasiumConfig) else None


def host_choices(config: Config) -> HostEnvConfig | None:
    """What is chosen of environments on the host; None for those on the device."""
    return config.env if isinstance(config.env, HostEnvConfig) else None
