"""Any registered Gymnasium environment; the task is its id."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from gymnasium import Env

from vawm.config import Config, GymnasiumConfig
from vawm.envs.host import gymnasium
from vawm.envs.host.pool import Pool
from vawm.envs.protocol import check_image_size
from vawm.errors import NOT_NEGATIVE, InvalidInput, within
from vawm.runs.suites.record import Protocol, Suite


def check(config: Config, env: GymnasiumConfig) -> None:
    """Refuses to repeat actions, and impossible images.

    Raises:
      InvalidInput: names the field and the remedy.
    """
    if config.action_repeat != 1:
        remedy = "use 1: a Gymnasium environment repeats actions itself, or not at all"
        raise InvalidInput("action_repeat", config.action_repeat, remedy)
    check_image_size("env.image_size", env.image_size)


def make(
    config: Config,
    env: GymnasiumConfig,
    *,
    task: str | None = None,
    kwargs: Mapping[str, Any] | None = None,
    drawn: bool = False,
) -> Pool:
    """The environments of a run, in processes of their own.

    Args:
      config: of the run.
      env: its choices of the environments.
      task: name of the task; that of the id if None.
      kwargs: for the environment itself.
      drawn: whether they are asked for pictures to look at, if they have them.

    Raises:
      InvalidInput: also for all that does not fit in the environment, at once.
    """
    try:
        return gymnasium.from_gymnasium(
            config.task,
            num_envs=config.num_envs,
            time_limit=env.time_limit or None,
            workers=env.workers,
            timeout=env.timeout,
            on_failure=env.on_failure,
            image_size=env.image_size,
            task=task,
            drawn=drawn,
            **kwargs or {},
        )
    except InvalidInput as error:
        raise within("env", error) from error


def make_drawn(config: Config, env: GymnasiumConfig) -> Pool:
    """The same as `make`, and they can be drawn if their ids can."""
    return make(config, env, drawn=True)


def make_one(config: Config, env: GymnasiumConfig, kwargs: Mapping[str, Any]) -> Env:
    """One environment of a run in this process, with its own observations and actions.

    Args:
      config: of the run.
      env: its choices of the environments.
      kwargs: for the environment itself, such as `render_mode`.

    Raises:
      InvalidInput: it is not registered, or cannot be made.
    """
    source = gymnasium.check_id(config.task)
    return gymnasium.make_environment(source, config.task, env.time_limit or None, kwargs)


SUITE = Suite(
    choices=GymnasiumConfig,
    rules={"time_limit": NOT_NEGATIVE},
    check=check,
    check_task=gymnasium.check_id,
    make=make,
    make_drawn=make_drawn,
    protocol=Protocol(text="whole episodes of the registered environment", episodes=20),
    program="gymnasium_task.py",
    usual_tasks=("vawm/GridWorld-v0",),
    title="any registered Gymnasium environment; the task is its id",
    examples={
        "--task CartPole-v1": "from vectors",
        "--preset pixels": "a small grid world, from pixels",
    },
    notes=(
        "Checks the environment first and lists all problems at once. To train in one that is "
        "not registered, call `vawm.runs.runner.run(config, logdir, "
        "env=vawm.envs.from_gymnasium(...))`."
    ),
)
