"""Any Gymnasium environment as a simulator.

    pool = vawm.envs.from_gymnasium("CartPole-v1", num_envs=4)
    pool = vawm.envs.from_gymnasium(lambda: MyEnv(size=5), time_limit=1000)

Environments are made only in the processes of the pool. They are checked before the first
episode; one `InvalidInput` lists everything that is wrong.
"""

from __future__ import annotations

import contextlib
import functools
import importlib
import importlib.util
import re
import sys
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal

import gymnasium
import numpy as np
from gymnasium.envs.registration import EnvSpec as RegisteredEnv
from gymnasium.envs.registration import load_env_creator
from gymnasium.wrappers import TimeLimit

from vawm.envs import made
from vawm.envs.host import native
from vawm.envs.host.atari import GAMES
from vawm.envs.host.gymnasium_check import IMAGE_SIZE, problems, refuse, space_problems
from vawm.envs.host.pool import Pool, check_maker
from vawm.envs.host.reading import read
from vawm.envs.host.simulator import Outcome, Simulator
from vawm.envs.host.usable import check_flag, one_line
from vawm.envs.protocol import check_image_size, check_positive
from vawm.errors import InvalidInput, suggestion
from vawm.types import Made, PyTree

PACKAGES = {
    r"ALE/.+": "ale_py",
    r"\w+(-ram)?(NoFrameskip|Deterministic)-v\d": "ale_py",
    rf"({'|'.join(GAMES.values())})(-ram)?-v\d": "ale_py",
    r"(MiniGrid|BabyAI)-.+": "minigrid",
}
"""Pattern of ids -> the package that registers them when it is imported."""
DRAWN = "rgb_array"


class GymnasiumSimulator:
    """A Gymnasium environment as a `Simulator`.

    Observations are read as `vawm.envs.host.reading` says, actions taken as
    `vawm.envs.host.native` says. `terminated` sets `is_terminal` and `is_last`; `truncated`
    sets `is_last`.
    """

    def __init__(self, env: gymnasium.Env, image_size: int = IMAGE_SIZE):
        """Takes over `env`.

        Args:
          env: the environment.
          image_size: pixels a side to which pictures are resized.

        Raises:
          InvalidInput: its spaces are not supported.
        """
        refuse(str(env), space_problems(env, image_size))
        self._env = env
        self.native = native.of_spaces(
            env.observation_space, env.action_space, image_size=image_size
        )
        self._reading, self._actions = self.native
        self.obs: PyTree = self._reading.spec
        self.notices = read(env.observation_space, image_size=image_size).notices
        self.discrete = self._actions.discrete
        self.action_size = self._actions.size
        self.episode_length: int | None = None  # it may end earlier than its time limit

    def reset(self, seed: int) -> PyTree:
        obs, _ = self._env.reset(seed=seed)
        return self._reading.convert(obs)

    def step(self, action: np.ndarray | int) -> Outcome:
        native_action = self._actions.convert(action)
        obs, reward, terminated, truncated, _ = self._env.step(native_action)
        is_terminal = check_flag("terminated", terminated)
        return Outcome(
            obs=self._reading.convert(obs),
            reward=reward,  # type: ignore[arg-type]  # a number, as the pool makes sure
            is_last=check_flag("truncated", truncated) or is_terminal,
            is_terminal=is_terminal,
        )

    def picture(self) -> np.ndarray | None:
        """What `render` draws; None unless the environment was made to draw pictures."""
        if self._env.render_mode != DRAWN:
            return None
        return np.asarray(self._env.render())

    def close(self) -> None:
        self._env.close()


def from_gymnasium(
    make: str | Callable[..., gymnasium.Env],
    *,
    num_envs: int = 1,
    time_limit: int | None = None,
    workers: int = 0,
    timeout: float = 60.0,
    on_failure: Literal["raise", "restart"] = "raise",
    check: bool = True,
    task: str | None = None,
    image_size: int = IMAGE_SIZE,
    drawn: bool = False,
    **kwargs: Any,
) -> Pool:
    """Runs N copies of a Gymnasium environment in separate processes.

    Args:
      make: a registered id, such as "CartPole-v1" or "module:Name-v0"; or a function or class
        that makes the environment. It is not called in this process.
      num_envs: N.
      time_limit: steps after which an episode is truncated. Replaces the registered limit
        of an id; is added to what a function makes.
      workers: processes; see `Pool`, also for `timeout` and `on_failure`.
      check: whether to look for `problems` first, with one extra environment.
      task: name of the task; default the name of `make`.
      image_size: pixels a side to which pictures are resized, a multiple of 16 from 48 to 256.
      drawn: whether a registered environment is asked for pictures to look at, if it has them.
      **kwargs: for `gymnasium.make`, or for the function.

    Returns:
      A `Pool`; the caller must close it.

    Raises:
      InvalidInput: an unknown id, an impossible number, an environment in the place of what
        makes it, or a list of all problems.
      EnvironmentFailure: the environment could not be made.
    """
    if time_limit is not None:
        check_positive("time_limit", time_limit)
    check_image_size("image_size", image_size)
    check_source(make)
    source = check_id(make) if isinstance(make, str) else make
    task = task or name_of(make)
    make_env = functools.partial(make_environment, source, task, time_limit, kwargs, drawn)
    pool = Pool(
        functools.partial(simulate, make_env, image_size),
        task=task,
        num_envs=num_envs,
        workers=workers,
        timeout=timeout,
        on_failure=on_failure,
        first=functools.partial(check_and_simulate, make_env, task, image_size)
        if check
        else None,
    )
    registered = source if isinstance(source, RegisteredEnv) else None
    if time_limit is None and registered is not None:
        time_limit = registered.max_episode_steps
    pool.made = made.by_gymnasium(
        make,
        options={"time_limit": time_limit, "image_size": image_size},
        kwargs=kwargs,
        registered={} if registered is None else registration(registered),
    )
    return pool


def registration(registered: RegisteredEnv) -> dict[str, Any]:
    """What an id stands for but for its time limit, which a run keeps as its own."""
    entry, wrappers = registered.entry_point, registered.additional_wrappers
    return {
        "entry_point": entry if isinstance(entry, str | None) else made.qualified(entry),
        "kwargs": made.shown(registered.kwargs),
        "wrappers": [f"{w.entry_point}({made.shown(w.kwargs or {})})" for w in wrappers],
    }


def check_registration(record: Made, *, python: str) -> None:
    """Refuses an id that is not registered here, or stands for something else now.

    Args:
      record: how the environments of a run were made.
      python: two statements that do with environments of the caller's what a command cannot.

    Raises:
      InvalidInput: names the difference.
    """
    try:
        found = check_id(record.name)
    except InvalidInput as error:
        remedy = (
            "is not registered in this process; name what registers it, with --plugin "
            f"FILE_OR_MODULE; or in Python: {python}"
        )
        raise InvalidInput("env", record.name, remedy) from error
    now = registration(found)
    if record.options.get("time_limit") is None:  # nothing replaces that of the registration
        now["time_limit"] = found.max_episode_steps
    for name, value in now.items():
        then = record.registered.get(name)
        if value != then:
            remedy = f"is registered with {name} {value!r} here, the run had {then!r}"
            raise InvalidInput("env", record.name, f"{remedy}; in Python: {python}")


def check_source(make: Any) -> None:
    """Refuses an environment in the place of what makes it.

    Raises:
      InvalidInput: shows a function that makes it.
    """
    if isinstance(make, gymnasium.vector.VectorEnv):
        remedy = "is several environments: pass what makes a single one, and num_envs"
        raise InvalidInput("make", make, remedy)
    if not isinstance(make, gymnasium.Env):
        if not isinstance(make, str):
            check_maker(make, "the environment")
        return
    name = type(make.unwrapped).__name__
    example = f"lambda: {name}(...)"
    if make.spec is not None:
        example += f", or the id {make.spec.id!r}"
    remedy = f"is an environment, not what makes it: pass the class or a function, as {example}"
    raise InvalidInput("make", make, remedy)


def check_id(name: str) -> RegisteredEnv:
    """The environment registered under an id; "module:id" imports the module first.

    The packages of `PACKAGES` are imported for their ids.

    Raises:
      InvalidInput: the id is not registered; suggests the nearest one, or what to install.
    """
    module, _, registered = name.rpartition(":")
    package = package_of(registered)
    if module:
        import_quietly(module, name)
    elif registered not in gymnasium.registry and package:
        if importlib.util.find_spec(package) is None:
            remedy = f"is an id of a package that is not installed: pip install {package}"
            raise InvalidInput("env", name, remedy.replace("ale_py", "ale-py"))
        import_quietly(package, name)
    if registered in gymnasium.registry:
        return gymnasium.registry[registered]
    hint = suggestion(registered, gymnasium.registry)
    remedy = f"{hint}use a registered id, or 'module:id' to import the module that registers it"
    raise InvalidInput("env", name, remedy)


def package_of(registered: str) -> str:
    """The package that registers an id, if it is known; "" if not."""
    known = (package for ids, package in PACKAGES.items() if re.fullmatch(ids, registered))
    return next(known, "")


def import_quietly(module: str, name: str) -> None:
    """Imports a module for the id `name`; what it prints goes to standard error.

    Raises:
      InvalidInput: it cannot be imported.
    """
    try:
        with contextlib.redirect_stdout(sys.stderr):
            importlib.import_module(module)
    except Exception as error:  # a module may raise anything
        remedy = f"module {module!r} cannot be imported: {one_line(error)}"
        raise InvalidInput("env", name, remedy) from None


def name_of(make: str | Callable[..., Any]) -> str:
    """A name for the task. Can name a folder, unless it is an id."""
    if isinstance(make, str):
        return make.rpartition(":")[2]
    name = getattr(make, "__name__", "")
    return name if name.isidentifier() else "environment"


def make_environment(
    source: RegisteredEnv | Callable[..., gymnasium.Env],
    task: str,
    time_limit: int | None,
    kwargs: Mapping[str, Any],
    drawn: bool = False,
) -> gymnasium.Env:
    """Makes the environment, even if its id is registered only in the pool's process.

    If it is to be `drawn`, and can be, it renders pictures.

    Raises:
      InvalidInput: Gymnasium cannot make it, for example because a package is missing.
    """
    if not isinstance(source, RegisteredEnv):
        env = source(**kwargs)
        if time_limit is not None and isinstance(env, gymnasium.Env):
            env = TimeLimit(env, time_limit)
        return env
    limit = {} if time_limit is None else {"max_episode_steps": time_limit}
    settings = {"disable_env_checker": True, **kwargs, **limit}  # `problems` checks instead
    try:
        if drawn and DRAWN in render_modes(source):
            settings["render_mode"] = DRAWN
        return gymnasium.make(source, **settings)
    except (gymnasium.error.Error, ImportError) as error:
        raise InvalidInput("env", task, f"cannot be made: {one_line(error)}") from error


def render_modes(source: RegisteredEnv) -> Sequence[str]:
    """How a registered environment can be drawn."""
    creator: Any = source.entry_point
    if isinstance(creator, str):
        creator = load_env_creator(creator)
    return getattr(creator, "metadata", {}).get("render_modes", ())


def simulate(make_env: Callable[[], gymnasium.Env], image_size: int) -> Simulator:
    """Makes a simulator."""
    return GymnasiumSimulator(make_env(), image_size)


def check_and_simulate(
    make_env: Callable[[], gymnasium.Env], task: str, image_size: int
) -> Simulator:
    """Checks a separate environment, then makes a simulator.

    Raises:
      InvalidInput: lists all problems.
    """
    env = make_env()
    found = problems(env, image_size=image_size)
    with contextlib.suppress(Exception):
        env.close()
    refuse(task, found)
    return simulate(make_env, image_size)
