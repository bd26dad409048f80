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
import math
from collections.abc import Callable, Mapping
from typing import Any, Literal, cast

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.envs.registration import EnvSpec as RegisteredEnv
from gymnasium.wrappers import TimeLimit

from vawm.envs import made
from vawm.envs.host.gymnasium_check import pixels, problems, refuse, space_problems
from vawm.envs.host.pool import Pool
from vawm.envs.host.simulator import Outcome, Simulator
from vawm.envs.host.worker import one_line
from vawm.envs.protocol import check_positive
from vawm.errors import InvalidInput, suggestion
from vawm.types import ArraySpec, PyTree, image, vector


class GymnasiumSimulator:
    """A Gymnasium environment as a `Simulator`.

    Actions: [-1, 1] is scaled to the bounds of a `Box`; a `Discrete` keeps its choices.
    Observations: a `Box`, or a `Dict` of boxes, which keeps its keys. Square uint8 images
    stay images and get a channel axis if they have none; any other `Box` becomes a float32
    vector. `terminated` sets `is_terminal` and `is_last`; `truncated` sets `is_last`.
    """

    def __init__(self, env: gymnasium.Env):
        """Takes over `env`.

        Raises:
          InvalidInput: its spaces are not supported.
        """
        refuse(str(env), space_problems(env))
        self._env = env
        self._seen: Any = env.observation_space
        actions = cast(Any, env.action_space)
        self._actions = actions
        self.discrete = isinstance(actions, spaces.Discrete)
        self.action_size = int(actions.n) if self.discrete else math.prod(actions.shape)
        self.episode_length: int | None = None  # it may end earlier than its time limit
        if isinstance(self._seen, spaces.Dict):
            self.obs: PyTree = {key: array_spec(box) for key, box in self._seen.items()}
        else:
            self.obs = array_spec(self._seen)

    def reset(self, seed: int) -> PyTree:
        obs, _ = self._env.reset(seed=seed)
        return self._observation(obs)

    def step(self, action: np.ndarray | int) -> Outcome:
        obs, reward, terminated, truncated, _ = self._env.step(self._action(action))
        return Outcome(
            obs=self._observation(obs),
            reward=reward,  # type: ignore[arg-type]  # a number, as the pool makes sure
            is_last=bool(terminated) or bool(truncated),
            is_terminal=bool(terminated),
        )

    def close(self) -> None:
        self._env.close()

    def _observation(self, obs: Any) -> PyTree:
        if isinstance(self._seen, spaces.Dict):
            return {key: to_array(obs[key], box) for key, box in self._seen.items()}
        return to_array(obs, self._seen)

    def _action(self, action: np.ndarray | int) -> Any:
        """The environment's action for an action in [-1, 1] or for an index."""
        dtype = self._actions.dtype.type
        if self.discrete:
            return dtype(self._actions.start + action)
        low, high = self._actions.low, self._actions.high
        # Halve first: high - low may overflow. Symmetric bounds lose no bit.
        center, reach = low / 2 + high / 2, high / 2 - low / 2
        native = center + reach * np.reshape(action, low.shape).astype(dtype)
        return np.clip(native, low, high)


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
      **kwargs: for `gymnasium.make`, or for the function.

    Returns:
      A `Pool`; the caller must close it.

    Raises:
      InvalidInput: an unknown id, an impossible number, or a list of all problems.
      EnvironmentFailure: the environment could not be made.
    """
    if time_limit is not None:
        check_positive("time_limit", time_limit)
    source = check_id(make) if isinstance(make, str) else make
    task = task or name_of(make)
    make_env = functools.partial(make_environment, source, task, time_limit, kwargs)
    pool = Pool(
        functools.partial(simulate, make_env),
        task=task,
        num_envs=num_envs,
        workers=workers,
        timeout=timeout,
        on_failure=on_failure,
        first=functools.partial(check_and_simulate, make_env, task) if check else None,
    )
    pool.made = made.by_gymnasium(
        make, options={"time_limit": time_limit}, kwargs=kwargs, wrappers=wrappers_of(source)
    )
    return pool


def wrappers_of(source: RegisteredEnv | Callable[..., Any]) -> tuple[str, ...]:
    """Names of the wrappers that an id is registered with."""
    if not isinstance(source, RegisteredEnv):
        return ()
    return tuple(wrapper.name for wrapper in source.additional_wrappers)


def check_id(name: str) -> RegisteredEnv:
    """The environment registered under an id; "module:id" imports the module first.

    Raises:
      InvalidInput: the id is not registered; suggests the nearest one.
    """
    module, _, registered = name.rpartition(":")
    if module:
        try:
            importlib.import_module(module)
        except Exception as error:  # a module may raise anything
            remedy = f"module {module!r} cannot be imported: {one_line(error)}"
            raise InvalidInput("env", name, remedy) from None
    if registered in gymnasium.registry:
        return gymnasium.registry[registered]
    hint = suggestion(registered, gymnasium.registry)
    remedy = f"{hint}use a registered id, or 'module:id' to import the module that registers it"
    raise InvalidInput("env", name, remedy)


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
) -> gymnasium.Env:
    """Makes the environment, even if its id is registered only in the pool's process.

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
        return gymnasium.make(source, **settings)
    except (gymnasium.error.Error, ImportError) as error:
        raise InvalidInput("env", task, f"cannot be made: {one_line(error)}") from error


def simulate(make_env: Callable[[], gymnasium.Env]) -> Simulator:
    """Makes a simulator."""
    return GymnasiumSimulator(make_env())


def check_and_simulate(make_env: Callable[[], gymnasium.Env], task: str) -> Simulator:
    """Checks a separate environment, then makes a simulator.

    Raises:
      InvalidInput: lists all problems.
    """
    env = make_env()
    found = problems(env)
    with contextlib.suppress(Exception):
        env.close()
    refuse(task, found)
    return simulate(make_env)


def array_spec(box: Any) -> ArraySpec:
    """Shape and dtype of what `to_array` returns."""
    if not pixels(box):
        return vector(math.prod(box.shape))
    return image(box.shape[0], channels=box.shape[2] if len(box.shape) == 3 else 1)


def to_array(obs: Any, box: Any) -> np.ndarray:
    """Converts an observation of a `Box` to its `array_spec`.

    Raises:
      ValueError: its shape is not that of the space.
    """
    if pixels(box):
        array = np.asarray(obs)  # the pool refuses a wrong dtype or shape
        return array[..., None] if len(box.shape) == 2 else array
    array = np.asarray(obs, np.float32)
    if array.shape != box.shape:
        raise ValueError(f"observation has shape {array.shape}, but its space {box.shape}")
    return array.reshape(-1)
