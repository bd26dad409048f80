"""The suites of tasks: one record each, which everything else looks up.

A new suite is a file beside this one, a line in `SUITES`, and its presets in `vawm.presets`.
No other code asks which suite a run is of.
"""

from __future__ import annotations

from vawm.config import Config, HostEnvConfig
from vawm.envs.protocol import Environment, HostEnvironment
from vawm.runs.suites import atari100k, dmc_proprio, dmc_vision, gymnasium
from vawm.runs.suites.record import Protocol, Suite

__all__ = ["SUITES", "Protocol", "Suite", "check_task", "host_choices", "make", "of"]

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
    return of(config).make(config, config.env)


def host_choices(config: Config) -> HostEnvConfig | None:
    """What is chosen of environments on the host; None for those on the device."""
    return config.env if isinstance(config.env, HostEnvConfig) else None
