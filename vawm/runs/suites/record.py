"""The record that defines a suite."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

from vawm.config import Config, EnvConfig
from vawm.envs.protocol import Environment, HostEnvironment
from vawm.errors import Rule


class Protocol(NamedTuple):
    """How `vawm.evaluate` plays a trained policy.

    Attributes:
      text: what the episodes are, for help and model cards.
      episodes: their number, unless the caller gives one.
      changes: choice of the environments -> its value, where it differs from training.
      options: those of `changes` that the caller may set.
      physics: engines that can simulate the tasks, that of training first; empty if there is
        only one. `mujoco` is dm_control's own simulation.
    """

    text: str
    episodes: int
    changes: Mapping[str, Any] = {}
    options: tuple[str, ...] = ()
    physics: tuple[str, ...] = ()


class Suite(NamedTuple):
    """One suite of tasks. `env` stands for `config.env`, which is of class `choices`.

    Attributes:
      choices: what can be chosen of the environments. A subclass of `HostEnvConfig` says that
        they run on the host.
      rules: number in `choices` -> what it may be; above 0 if it is not named here.
      check: `(config, env)`; raises `InvalidInput` where numbers do not fit together.
      check_task: `(task)`; raises `InvalidInput` for a task that the suite does not have.
      make: `(config, env) -> environments`. Nothing is compiled yet; processes are started.
      make_drawn: the same on the host, for films; None if those of `make` can be drawn.
      protocol: of evaluation.
      program: the file in `experiments` that trains on the suite.
      usual_tasks: those whose learning curves are usually wanted.
      title: what the tasks are, for a help: "train on ...".
      examples: flags of a command line -> what it does, for a help.
      notes: the rest of a help; empty if there is nothing more to say.
      tasks: all tasks; empty if nobody can list them.
      aliases: flag -> the flag of which it is another name.
      episode_steps: control steps of every episode; None if they differ in length.
      tables: published scores, as names of `vawm.policy.scores.TABLES`.
      human_table: that of `tables` with the scores of a human and of random play; empty if
        there is none.
      returns: lowest and highest return of an episode; None where it depends on the task.
      has_images: whether observations can have images.
      env_bytes: memory of one environment on a CPU, besides that of its process.
    """

    choices: type[EnvConfig]
    check: Callable[[Config, Any], None]
    check_task: Callable[[str], object]
    make: Callable[[Config, Any], Environment | HostEnvironment]
    protocol: Protocol
    program: str
    usual_tasks: tuple[str, ...]
    title: str = ""
    examples: Mapping[str, str] = {}
    notes: str = ""
    tasks: tuple[str, ...] = ()
    aliases: Mapping[str, str] = {}
    episode_steps: int | None = None
    make_drawn: Callable[..., HostEnvironment] | None = None
    rules: Mapping[str, Rule] = {}
    tables: tuple[str, ...] = ()
    human_table: str = ""
    returns: tuple[float, float] | None = None
    has_images: bool = True
    env_bytes: int = 0
