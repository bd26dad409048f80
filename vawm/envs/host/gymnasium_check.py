"""Checks a Gymnasium environment and lists all problems at once.

Each problem is one clause and its remedy. The check plays seeded random actions in a separate
environment and looks at all returned values.
"""

from __future__ import annotations

import contextlib
import functools
import time
from collections.abc import Callable, Mapping
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.wrappers import TimeLimit

from vawm.envs.host.worker import one_line
from vawm.errors import InvalidInput
from vawm.types import IMAGE_SIZES

SMALLEST_IMAGE = 16
"""Pixels per side from which a uint8 array counts as an image."""
TOLERANCE = 1e-4
"""How far observations may leave their bounds, relative to max(1, |bound|), for rounding."""

Add = Callable[[str, str], Any]
"""Takes a kind of problem and its text; only the first of each kind is kept."""


def problems(env: gymnasium.Env, *, steps: int = 1000, seconds: float = 5.0) -> list[str]:
    """Everything that makes an environment unusable for training, each with a remedy.

    Plays random actions, always the same ones. Never raises; does not close `env`.

    Args:
      env: the environment; do not use it afterwards.
      steps: number of actions to play.
      seconds: time after which it stops playing.
    """
    if not isinstance(env, gymnasium.Env):
        kind = f"{type(env).__module__}.{type(env).__qualname__}"
        return [f"the environment is a {kind}: derive it from gymnasium.Env"]
    return look_at(
        env,
        {
            "observation_space": look_at_observation_space,
            "action_space": look_at_action_space,
            "random play": functools.partial(try_out, steps=steps, seconds=seconds),
        },
    )


def space_problems(env: gymnasium.Env) -> list[str]:
    """The `problems` of an environment's spaces, found without playing."""
    return look_at(
        env,
        {
            "observation_space": look_at_observation_space,
            "action_space": look_at_action_space,
        },
    )


def look_at(env: gymnasium.Env, looks: Mapping[str, Callable[..., None]]) -> list[str]:
    """Runs some checks and returns their problems; a check that raises is a problem too."""
    found: dict[str, str] = {}
    for name, look in looks.items():
        try:
            look(env, found.setdefault)
        except (Exception, SystemExit) as error:
            found[name] = f"{name} raised {one_line(error)}: fix the environment"
    return list(found.values())


def look_at_observation_space(env: gymnasium.Env, add: Add) -> None:
    """Checks for a `Box` or a `Dict` of them, with square images of one size."""
    space: Any = env.observation_space
    if not isinstance(space, spaces.Dict):
        if text := box_problem(space):
            add("observation_space", f"observation space {text}")
        return
    if not space.spaces:
        add("observation_space", "observation space is an empty Dict: add a Box")
    boxes: dict[Any, Any] = dict(space.items())
    for key, entry in boxes.items():
        name = f"observation_space[{key!r}]"
        if not isinstance(key, str):
            add(name, f"{name} has a key that is not a string: use a string")
        if text := box_problem(entry):
            add(name, f"{name} {text}")
    sides = {
        key: box.shape[0] for key, box in boxes.items() if not box_problem(box) and pixels(box)
    }
    if len(set(sides.values())) > 1:
        remedy = "resize them to one size with gymnasium.wrappers.ResizeObservation"
        add("image sizes", f"images differ in size, {sides} pixels per side: {remedy}")


def box_problem(space: Any) -> str:
    """The problem of an observation space with its remedy, or ""."""
    if not isinstance(space, spaces.Box):
        remedy = "return a Box from an ObservationWrapper"
        if isinstance(space, spaces.Space) and space.is_np_flattenable:
            remedy = "use gymnasium.wrappers.FlattenObservation, or return a Box"
        return f"is {space!s:.100}, not a Box: {remedy}"
    shape = space.shape
    if 0 in shape:
        return f"has shape {shape}, so it is empty: remove it"
    if len(shape) < 2:
        return ""
    if space.dtype != np.uint8:
        if sorted(shape)[-2] < IMAGE_SIZES[0]:
            return ""
        remedy = "declare uint8 if it is an image, flatten it if it is not"
        return f"has the shape of an image, {shape}, but dtype {space.dtype}: {remedy}"
    if len(shape) > 3:
        return f"has uint8 of shape {shape}: stack frames along the channels, (H, W, C)"
    if len(shape) == 3 and shape[0] < SMALLEST_IMAGE <= shape[1] == shape[2]:
        remedy = "move channels last with gymnasium.wrappers.TransformObservation"
        return f"has images of shape {shape}, channels first: {remedy}"
    if not pixels(space):
        return ""
    remedy = "use gymnasium.wrappers.ResizeObservation"
    if shape[0] != shape[1]:
        return f"has images of shape {shape}, not square: {remedy}"
    if shape[0] not in IMAGE_SIZES:
        sizes = f"a multiple of {IMAGE_SIZES.step} from {IMAGE_SIZES[0]} to {IMAGE_SIZES[-1]}"
        remedy += ", or FlattenObservation if it is not an image"
        return f"has images with {shape[0]} pixels per side, not {sizes}: {remedy}"
    return ""


def pixels(box: Any) -> bool:
    """Whether a `Box` without problems holds images."""
    if box.dtype != np.uint8 or len(box.shape) not in (2, 3):
        return False
    return min(box.shape[:2]) >= SMALLEST_IMAGE


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


def try_out(env: gymnasium.Env, add: Add, *, steps: int, seconds: float) -> None:
    """Plays seeded random actions and checks all returned values."""
    limited = has_time_limit(env)
    with contextlib.suppress(Exception):  # sampling will show the problem
        env.action_space.seed(0)
    end = time.monotonic() + seconds
    playing, episode, over, ended = env, 0, True, False
    for _ in range(steps):
        if time.monotonic() > end:
            return  # too slow to tell whether an episode ends
        if over:
            begun = begin(playing, episode, add)
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
        over = look_at_step(result, playing.observation_space, add)
        ended |= over
    if not ended and not limited:
        missing = f"no episode ended within {steps} random steps, and there is no time limit"
        add("end", f"{missing}: pass time_limit=")


def look_at_step(result: Any, space: Any, add: Add) -> bool:
    """Checks what `step` returned; returns whether the episode is over."""
    five = "return obs, reward, terminated, truncated, info"
    if isinstance(result, tuple) and len(result) == 4:  # the API of gym before 0.26
        add("step values", f"step() returns 4 values, as gym before 0.26: {five}")
        result = (*result[:3], False, result[3])
    if not isinstance(result, tuple) or len(result) != 5:
        add("step values", f"step() returns {number_of(result)}: {five}")
        return True
    obs, reward, terminated, truncated, _ = result
    look_at_observation(obs, space, add)
    look_at_reward(reward, add)
    for name, flag in (("terminated", terminated), ("truncated", truncated)):
        if not isinstance(flag, (bool, np.bool_)):
            add(name, f"{name} is {flag!r:.50}: return True or False")
    return bool(np.any(terminated) or np.any(truncated))


def has_time_limit(env: gymnasium.Env) -> bool:
    """Whether the environment has a time limit, so that every episode ends."""
    layer = env
    while isinstance(layer, gymnasium.Wrapper):
        if isinstance(layer, TimeLimit):
            return True
        layer = layer.env
    return getattr(env.spec, "max_episode_steps", None) is not None


def begin(env: gymnasium.Env, seed: int, add: Add) -> gymnasium.Env | None:
    """Resets and checks what is returned.

    Returns:
      The environment to play: `env`, or the innermost one if wrappers cannot reset it; None
      if `reset` fails.
    """
    try:
        try:
            result: Any = env.reset(seed=seed)
        except TypeError as error:
            if "seed" not in str(error):
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
    look_at_observation(result, env.observation_space, add)
    return env


def number_of(result: Any) -> str:
    """Describes how many values were returned."""
    if isinstance(result, tuple):
        return f"{len(result)} values"
    return f"one value, a {type(result).__name__}"


def look_at_observation(obs: Any, space: Any, add: Add) -> None:
    """Checks that an observation matches its space, is finite and within bounds."""
    if not isinstance(space, spaces.Dict):
        look_at_array("obs", obs, space, add)
        return
    if not isinstance(obs, Mapping):
        add("obs", f"obs is a {type(obs).__name__}, but its space is a Dict: return a dict")
        return
    if set(obs) != set(space.spaces):
        keys = f"obs has keys {sorted(map(str, obs))}, but its space {sorted(space.spaces)}"
        add("obs keys", f"{keys}: return the keys of the space")
    for key in space.spaces.keys() & obs.keys():
        look_at_array(f"obs[{key!r}]", obs[key], space[key], add)


def look_at_array(name: str, obs: Any, box: Any, add: Add) -> None:
    """Checks that an array matches its `Box`, is finite and within bounds.

    Skips other spaces, because `look_at_observation_space` reports them.
    """
    if not isinstance(box, spaces.Box):
        return
    if not isinstance(obs, (np.ndarray, np.generic)):
        remedy = f"return a numpy array of {box.dtype}"
        add(f"{name} type", f"{name} is a {type(obs).__name__}: {remedy}")
        return
    if obs.dtype != box.dtype:
        remedy = f"return .astype(np.{box.dtype}), or declare a Box of {obs.dtype}"
        add(f"{name} dtype", f"{name} is {obs.dtype}, but its space {box.dtype}: {remedy}")
    if obs.shape != box.shape:
        text = f"{name} has shape {obs.shape}, but its space {box.shape}"
        add(f"{name} shape", f"{text}: change one of them")
        return
    if obs.dtype.kind not in "fiub":
        return
    value = np.asarray(obs, np.float64)
    if not np.isfinite(value).all():
        where, worst = first(~np.isfinite(value), value)
        add(f"{name} finite", f"{name}{where} is {worst}: return finite numbers")
        return
    low, high = (np.asarray(bound, np.float64) for bound in (box.low, box.high))
    low = low - TOLERANCE * np.maximum(1, np.abs(low))
    high = high + TOLERANCE * np.maximum(1, np.abs(high))
    if (outside := (value < low) | (value > high)).any():
        where, worst = first(outside, value)
        text = f"{name}{where} is {worst:g}, outside the bounds of its space"
        add(f"{name} bounds", f"{text}: declare wider bounds")


def first(mask: np.ndarray, value: np.ndarray) -> tuple[str, float]:
    """The first entry that is True in a mask: its index in brackets, and its value."""
    where = np.argwhere(mask)[0].tolist()
    return f"{where or ''}", float(value[tuple(where)])


def look_at_reward(reward: Any, add: Add) -> None:
    """Checks that the reward is a finite number."""
    if np.ndim(reward):
        add("reward", f"reward has shape {np.shape(reward)}: return a number")
    elif not isinstance(np.asarray(reward)[()], (np.bool_, np.integer, np.floating)):
        add("reward", f"reward is {reward!r:.50}: return a number")
    elif not np.isfinite(reward):
        add("reward", f"reward is {reward}: return a finite number")


def refuse(name: str, found: list[str]) -> None:
    """Raises `InvalidInput` if an environment has problems."""
    if found:
        count = f"{len(found)} problem{'s' if len(found) > 1 else ''}"
        listed = "; ".join(f"({i}) {text}" for i, text in enumerate(found, start=1))
        raise InvalidInput("env", name, f"{count}: {listed}")
