"""Environments: 18 DMC proprio tasks on MJX, and probes with known values.

    env = vawm.envs.make("walker_walk", num_envs=16, action_repeat=2)
    state, timestep = jax.jit(env.reset)(jax.random.key(0))
    state, timestep = jax.jit(env.step)(state, action)

`from_gymnasium` runs any Gymnasium environment in separate processes. Importing this module
is cheap: `make` loads MuJoCo, and the first use of `from_gymnasium` loads what runs the
processes. The import registers the tasks with Gymnasium, as `vawm/<task>-v0`, and
"vawm/GridWorld-v0".
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from vawm.envs.protocol import Environment, EnvState, check_positive
from vawm.envs.registration import register
from vawm.errors import InvalidInput, suggestion

if TYPE_CHECKING:
    from vawm.envs.host.gymnasium import from_gymnasium

__all__ = ["EPISODE_STEPS", "TASKS", "EnvState", "Environment", "from_gymnasium", "make"]

EPISODE_STEPS = 1000  # control steps in an episode of every task

DOMAINS = {
    "acrobot": ("swingup",),
    "ball_in_cup": ("catch",),
    "cartpole": ("balance", "balance_sparse", "swingup", "swingup_sparse"),
    "cheetah": ("run",),
    "finger": ("spin", "turn_easy", "turn_hard"),
    "hopper": ("hop", "stand"),
    "pendulum": ("swingup",),
    "reacher": ("easy", "hard"),
    "walker": ("run", "stand", "walk"),
}
TASKS = tuple(f"{domain}_{task}" for domain, tasks in DOMAINS.items() for task in tasks)

register(TASKS)


def __getattr__(name: str) -> Any:
    """Imports `from_gymnasium` on first use."""
    if name == "from_gymnasium":
        from vawm.envs.host.gymnasium import from_gymnasium

        return from_gymnasium
    raise AttributeError(f"module 'vawm.envs' has no attribute {name!r}")


def make(task: str, *, num_envs: int, action_repeat: int = 1) -> Environment:
    """Builds a task of the DeepMind Control Suite, simulated on MJX.

    Args:
      task: one of `TASKS`, such as "walker_walk".
      num_envs: N, environments stepped at once.
      action_repeat: control steps per call of `step`; their rewards are summed. Must
        divide 1000, the control steps of an episode.

    Returns:
      An `Environment`; nothing is compiled yet.

    Raises:
      InvalidInput: an unknown task or an impossible number.
    """
    check_task(task)
    check_positive("num_envs", num_envs)
    check_positive("action_repeat", action_repeat)
    if EPISODE_STEPS % action_repeat:
        divisors = [n for n in range(1, 21) if EPISODE_STEPS % n == 0]
        remedy = f"use a divisor of {EPISODE_STEPS}, such as {', '.join(map(str, divisors))}"
        raise InvalidInput("action_repeat", action_repeat, remedy)

    from vawm.envs.mjx import environment

    domain, name = split(task)
    return environment.make(domain, name, num_envs=num_envs, action_repeat=action_repeat)


def check_task(task: str) -> None:
    """Refuses a name outside `TASKS` and suggests the nearest one."""
    if task in TASKS:
        return
    remedy = f"{suggestion(task, TASKS)}choose one of {', '.join(TASKS)}"
    raise InvalidInput("task", task, remedy)


def split(task: str) -> tuple[str, str]:
    """Splits "ball_in_cup_catch" into ("ball_in_cup", "catch")."""
    domain = next(d for d, names in DOMAINS.items() if task.removeprefix(d + "_") in names)
    return domain, task.removeprefix(domain + "_")
