"""Checks a Gymnasium environment and lists all problems at once.

Each problem is one clause and its remedy. The check plays seeded random actions in a separate
environment and looks at all returned values.
"""

from __future__ import annotations

import contextlib
import functools
import time
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, Protocol

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.wrappers import TimeLimit

from vawm.envs.host.reading import Entry, Reading, find, label, read
from vawm.envs.host.usable import Unusable, check_flag, check_number, first, one_line
from vawm.errors import InvalidInput, assignment

TOLERANCE = 1e-4
"""How far observations may leave their bounds, relative to max(1, |bound|), for rounding."""

IMAGE_SIZE = 64
"""Pixels a side to which pictures are resized, unless somebody chooses another size."""


class Problem(NamedTuple):
    """What is wrong and its remedy, in one clause.

    `settings` are choices of `from_gymnasium` that the text names, see `errors.assignment`.
    """

    text: str
    settings: Mapping[str, Any] = {}


class Add(Protocol):
    """Takes a kind of problem, its text and its settings; keeps the first of each kind."""

    def __call__(self, kind: str, text: str, **settings: Any) -> None: ...


def problems(
    env: gymnasium.Env, *, steps: int = 1000, seconds: float = 5.0, image_size: int = IMAGE_SIZE
) -> list[Problem]:
    """Everything that makes an environment unusable for training, each with a remedy.

    Plays random actions, always the same ones. Never raises; does not close `env`.

    Args:
      env: the environment; do not use it afterwards.
      steps: number of actions to play.
      seconds: time after which it stops playing.
      image_size: pixels a side to which pictures are resized.
    """
    if not isinstance(env, gymnasium.Env):
        return [Problem(what_it_is(env))]
    play = functools.partial(try_out, steps=steps, seconds=seconds, image_size=image_size)
    return look_at(env, {**looks_at_spaces(image_size), "random play": play})


def what_it_is(made: Any) -> str:
    """What was made in the place of an environment, with the remedy."""
    if isinstance(made, gymnasium.vector.VectorEnv):
        kind = type(made).__name__
        return f"the environment is a {kind} of several: make a single one, and pass num_envs"
    if isinstance(made, type):
        return f"the environment is the class {made.__name__}: make an object of it"
    kind = f"{type(made).__module__}.{type(made).__qualname__}"
    return f"the environment is a {kind}: derive it from gymnasium.Env"


def space_problems(env: gymnasium.Env, image_size: int = IMAGE_SIZE) -> list[Problem]:
    """The `problems` of an environment's spaces, found without playing."""
    return look_at(env, looks_at_spaces(image_size))


def looks_at_spaces(image_size: int) -> dict[str, Callable[..., None]]:
    """Name of each space of an environment -> its check."""
    look = functools.partial(look_at_observation_space, image_size=image_size)
    return {"observation_space": look, "action_space": look_at_action_space}


def look_at(env: gymnasium.Env, looks: Mapping[str, Callable[..., None]]) -> list[Problem]:
    """Runs some checks and returns their problems; a check that raises is a problem too."""
    found: dict[str, Problem] = {}

    def add(kind: str, text: str, **settings: Any) -> None:
        found.setdefault(kind, Problem(text, settings))

    for name, look in looks.items():
        try:
            look(env, add)
        except (Exception, SystemExit) as error:
            found[name] = Problem(f"{name} raised {one_line(error)}: fix the environment")
    return list(found.values())


def look_at_observation_space(env: gymnasium.Env, add: Add, *, image_size: int) -> None:
    """Checks that every part of the space can be read."""
    for name, text in read(env.observation_space, image_size=image_size).problems:
        add(name, text)


def look_at_action_space(env: gymnasium.Env, add: Add) -> None:
    """Checks for a `Discrete`, or a `Box` of floats with finite bounds."""
    space: Any = env.action_space
    if isinstance(space, spaces.Discrete):
        return
    if not isinstance(space, spaces.Box):
        remedy = "turn it into a Discrete or a Box with gymnasium.wrappers.TransformAction"
        add("action_space", f"action space is {space!s:.100}: {remedy}")
        return
    if 0 in space.shape:
        add("action_space", f"action space has shape {space.shape}: give it an action")
    if space.dtype.kind != "f":
        remedy = "use a Discrete, or floats that the environment rounds"
        add("action_space", f"action space is a Box of {space.dtype}: {remedy}")
    elif not (np.isfinite(space.low).all() and np.isfinite(space.high).all()):
        remedy = "declare finite low and high"
        add("action_space", f"action space {space!s:.100} is not bounded: {remedy}")
    elif (space.low > space.high).any():
        add("action_space", "action space has low above high: swap them")


def try_out(
    env: gymnasium.Env, add: Add, *, steps: int, seconds: float, image_size: int
) -> None:
    """Plays seeded random actions and checks all returned values, as the run will."""

    @functools.cache
    def reading() -> Reading:
        return read(env.observation_space, image_size=image_size)

    def look(obs: Any) -> None:
        look_at_observation(obs, env.observation_space, reading(), add)

    limited = has_time_limit(env)
    with contextlib.suppress(Exception):  # sampling will show the problem
        env.action_space.seed(0)
    end = time.monotonic() + seconds
    playing, episode, over, ended = env, 0, True, False
    for _ in range(steps):
        if time.monotonic() > end:
            return  # too slow to tell whether an episode ends
        if over:
            begun = begin(playing, episode, look, add)
            if begun is None:
                return
            playing, episode = begun, episode + 1
        try:
            action = env.action_space.sample()
        except (Exception, SystemExit) as error:
            # The same kind as, and hidden by, an earlier problem of the space.
            text = f"action_space.sample() raised {one_line(error)}: fix the space"
            add("action_space", text)
            return
        try:
            result = playing.step(action)
        except (Exception, SystemExit) as error:
            if "values to unpack" in str(error) and playing is not playing.unwrapped:
                playing, over = playing.unwrapped, True  # wrappers expect five values
                continue
            remedy = "fix step(); random actions reproduce it"
            add("step", f"step() raised {one_line(error)}: {remedy}")
            return
        over = look_at_step(result, look, add)
        ended |= over
    if not ended and not limited:
        missing = f"no episode ended within {steps} random steps, and there is no time limit"
        limit = {"time_limit": 1000}
        add("end", f"{missing}: set one, such as {assignment('time_limit', 1000)}", **limit)


def look_at_step(result: Any, look: Callable[[Any], None], add: Add) -> bool:
    """Checks what `step` returned; returns whether the episode is over."""
    five = "return obs, reward, terminated, truncated, info"
    if isinstance(result, tuple) and len(result) == 4:  # the API of gym before 0.26
        add("step values", f"step() returns 4 values, as gym before 0.26: {five}")
        result = (*result[:3], False, result[3])
    if not isinstance(result, tuple) or len(result) != 5:
        add("step values", f"step() returns {number_of(result)}: {five}")
        return True
    obs, reward, terminated, truncated, _ = result
    look(obs)
    usable("reward", reward, check_number, add)
    usable("terminated", terminated, check_flag, add)
    usable("truncated", truncated, check_flag, add)
    return bool(np.any(terminated) or np.any(truncated))


def usable(name: str, value: Any, check: Callable[[str, Any], Any], add: Add) -> None:
    """Checks a value as the run will."""
    try:
        check(name, value)
    except Unusable as error:
        add(error.name, f"{error}: {error.remedy}")


def has_time_limit(env: gymnasium.Env) -> bool:
    """Whether the environment has a time limit, so that every episode ends."""
    layer = env
    while isinstance(layer, gymnasium.Wrapper):
        if isinstance(layer, TimeLimit):
            return True
        layer = layer.env
    return getattr(env.spec, "max_episode_steps", None) is not None


def begin(
    env: gymnasium.Env, seed: int, look: Callable[[Any], None], add: Add
) -> gymnasium.Env | None:
    """Resets and checks what is returned.

    Returns:
      The environment to play: `env`, or the innermost one if wrappers cannot reset it; None
      if `reset` fails.
    """
    try:
        try:
            result: Any = env.reset(seed=seed)
        except TypeError as error:
            if "unexpected keyword argument 'seed'" not in str(error):
                raise
            remedy = "take seed=None, options=None and call super().reset(seed=seed)"
            add("seed", f"reset() does not accept seed=: {remedy}")
            env = env.unwrapped  # wrappers pass the seed on
            result = env.reset()
    except (Exception, SystemExit) as error:
        add("reset", f"reset() raised {one_line(error)}: fix reset()")
        return None
    if isinstance(result, tuple) and len(result) == 2 and isinstance(result[1], dict):
        result = result[0]
    else:
        add("reset values", f"reset() returns {number_of(result)}: return obs, info (a dict)")
        result = result[0] if isinstance(result, tuple) and result else result
    look(result)
    return env


def number_of(result: Any) -> str:
    """Describes how many values were returned."""
    if isinstance(result, tuple):
        return f"{len(result)} values"
    return f"one value, a {type(result).__name__}"


def look_at_observation(obs: Any, space: Any, reading: Reading, add: Add) -> None:
    """Checks that the run can read an observation, and that it is of its space."""
    try:
        reading.check_containers(obs)
    except Unusable as error:
        add(f"{error.name} keys", f"{error}: {error.remedy}")
        return
    for entry in reading.entries:
        look_at_entry(entry, find(obs, entry.path), find(space, entry.path), add)


def look_at_entry(entry: Entry, obs: Any, space: Any, add: Add) -> None:
    """Checks one entry: its type and dtype, that the run can read it, and its bounds."""
    name = label("obs", entry.path)
    if isinstance(space, (spaces.Box, spaces.MultiBinary, spaces.MultiDiscrete)):
        if not hasattr(obs, "__array__"):
            remedy = f"return a numpy array of {space.dtype}"
            add(f"{name} type", f"{name} is a {type(obs).__name__}: {remedy}")
            return
        dtype = getattr(obs, "dtype", None)
        if (
            isinstance(space, spaces.Box)
            and isinstance(dtype, np.dtype)
            and dtype != space.dtype
        ):
            remedy = f"return .astype(np.{space.dtype}), or declare a Box of {dtype}"
            add(f"{name} dtype", f"{name} is {dtype}, but its space {space.dtype}: {remedy}")
            if space.dtype == np.uint8:  # said once: a picture must be of bytes
                return
    try:
        entry.kind.convert(name, obs)
    except Unusable as error:
        add(f"{name} value", f"{error}: {error.remedy}")
        return
    if isinstance(space, spaces.Box):
        look_at_bounds(name, np.asarray(obs, np.float64), space, add)


def look_at_bounds(name: str, value: np.ndarray, box: spaces.Box, add: Add) -> None:
    """Checks that numbers are within the bounds of their `Box`."""
    low, high = (np.asarray(bound, np.float64) for bound in (box.low, box.high))
    low = low - TOLERANCE * np.maximum(1, np.abs(low))
    high = high + TOLERANCE * np.maximum(1, np.abs(high))
    if (outside := (value < low) | (value > high)).any():
        where, worst = first(outside, value)
        text = f"{name}{where} is {worst:g}, outside the bounds of its space"
        add(f"{name} bounds", f"{text}: declare wider bounds")


def refuse(name: str, found: list[Problem]) -> None:
    """Raises `InvalidInput` if an environment has problems."""
    if found:
        count = f"{len(found)} problem{'s' if len(found) > 1 else ''}"
        listed = "; ".join(f"({i}) {text}" for i, (text, _) in enumerate(found, start=1))
        settings = {
            name: value for problem in found for name, value in problem.settings.items()
        }
        raise InvalidInput("env", name, f"{count}: {listed}", settings)
