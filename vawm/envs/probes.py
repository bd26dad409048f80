"""Tiny environments with known values, from easy to hard, to find the part that cannot learn.

    name                        reward r_{t+1} of the action that leaves from o_t
    constant_reward             1
    truncation                  1, and the episode is truncated: value 1 / (1 - discount)
    discounting                 1 at the last step, else 0
    observation_reward          the signal s_t, a fresh -1 or 1 at every step
    action_reward[_discrete]    the fit of the action to 1
    observation_action[_discrete]  the fit of the action to the signal s_t
    memory[_discrete]           at the last step the fit to the first signal, else 0

An observation is `[signal, clock]`. The signal is 0 if the probe has none (in `memory`: after
the first step); the clock runs from 0 to 1 through the episode. The fit of a continuous action
a in [-1, 1] to c is 1 - 4 (a - c / 2)^2, best at c / 2. The fit of a discrete action is 1 for
the second choice if c = 1 and for the first if c = -1, otherwise 0. Episodes terminate
(`is_terminal`) after `episode_length` steps, except in `truncation`. Stream convention: see
`vawm.envs.protocol`.
"""

from __future__ import annotations

import chex
import jax
import jax.numpy as jnp
import numpy as np
from numpy.typing import ArrayLike

from vawm.envs.protocol import Environment, EnvState, check_positive
from vawm.errors import InvalidInput, suggestion
from vawm.types import Array, EnvSpec, Key, TimeStep, vector

PROBES = (
    "constant_reward",
    "truncation",
    "discounting",
    "observation_reward",
    "action_reward",
    "action_reward_discrete",
    "observation_action",
    "observation_action_discrete",
    "memory",
    "memory_discrete",
)


def make(name: str, *, num_envs: int, episode_length: int = 4) -> Environment:
    """Builds a probe.

    Args:
      name: one of `PROBES`.
      num_envs: N.
      episode_length: steps in an episode, T below.

    Returns:
      An `Environment`. Its `EnvState` holds the visible signal in `data`, and in `target`
      the value c that the action has to fit; both `[N]`.

    Raises:
      InvalidInput: an unknown name or an impossible number.
    """
    check_probe(name)
    check_positive("num_envs", num_envs)
    check_positive("episode_length", episode_length)
    discrete = name.endswith("discrete")
    kind = name.removesuffix("_discrete")
    action_size = 2 if discrete else 1

    def reset(key: Key) -> tuple[EnvState, TimeStep]:
        key, key_signal = jax.random.split(key)
        steps = jnp.zeros(num_envs, jnp.int32)
        signal = random_signal(key_signal, num_envs)
        state = EnvState(
            data=visible(kind, signal, steps),
            target=wanted(kind, signal),
            steps=steps,
            key=jax.random.split(key, num_envs),
        )
        return state, arrive(state, jnp.zeros(num_envs, jnp.float32), jnp.ones(num_envs, bool))

    def step(state: EnvState, action: Array) -> tuple[EnvState, TimeStep]:
        chex.assert_shape(action, (num_envs, action_size))
        is_first = state.steps == episode_length
        reward = reward_of(kind, state, fit(action, state.target, discrete), episode_length)

        key, key_signal = jax.vmap(lambda key: tuple(jax.random.split(key)))(state.key)
        signal = jax.vmap(lambda key: random_signal(key, 1)[0])(key_signal)
        steps = jnp.where(is_first, 0, state.steps + 1)
        remembers = (kind == "memory") & ~is_first
        state = EnvState(
            data=visible(kind, signal, steps),
            target=jnp.where(remembers, state.target, wanted(kind, signal)),
            steps=steps,
            key=key,
        )
        return state, arrive(state, jnp.where(is_first, 0.0, reward), is_first)

    def arrive(state: EnvState, reward: Array, is_first: Array) -> TimeStep:
        is_last = state.steps == episode_length
        clock = state.steps.astype(jnp.float32) / episode_length
        return TimeStep(
            obs=jnp.stack([state.data, clock], axis=-1),
            reward=reward,
            is_first=is_first,
            is_last=is_last,
            is_terminal=is_last if kind != "truncation" else jnp.zeros_like(is_last),
        )

    return Environment(
        spec=EnvSpec(
            task=f"probe_{name}",
            obs=vector(2),
            action_size=action_size,
            discrete=discrete,
            num_envs=num_envs,
            action_repeat=1,
            episode_length=episode_length,
        ),
        reset=reset,
        step=step,
    )


def known_value(
    name: str,
    *,
    steps: ArrayLike,
    signal: ArrayLike = 0.0,
    discount: float,
    episode_length: int,
) -> np.ndarray:
    """The optimal value V*(o_t), in closed form, at t = `steps` < T.

        V*(o_t) = max E[sum_{k>=1} discount^{k-1} r_{t+k}], 0 after termination.

    If actions do not matter, every policy has this value.

    Args:
      name: one of `PROBES`.
      steps: `[...]` t, steps since the reset.
      signal: `[...]` visible at t; only `observation_reward` depends on it.
      discount: in [0, 1); `truncation` excludes 1.
      episode_length: T.

    Returns:
      `[...]` float64 values.
    """
    check_probe(name)
    t, visible_signal = np.broadcast_arrays(np.asarray(steps), np.asarray(signal, float))
    kind = name.removesuffix("_discrete")
    if kind == "truncation":
        return np.full(t.shape, 1 / (1 - discount))
    if kind in ("discounting", "memory"):
        return discount ** (episode_length - 1.0 - t)
    if kind == "observation_reward":
        return visible_signal
    return (1 - discount ** (episode_length - 1.0 * t)) / (1 - discount)


def optimal_action(name: str, target: Array) -> Array:
    """The best action `[N, action_size]` for `EnvState.target`."""
    if name.endswith("discrete"):
        return jax.nn.one_hot((target > 0).astype(jnp.int32), 2, dtype=jnp.float32)
    return target[:, None] / 2


def check_probe(name: str) -> None:
    """Refuses a name outside `PROBES` and suggests the nearest one."""
    if name in PROBES:
        return
    remedy = f"{suggestion(name, PROBES)}choose one of {', '.join(PROBES)}"
    raise InvalidInput("probe", name, remedy)


def random_signal(key: Key, num_envs: int) -> Array:
    """`[N]` random signals, -1 or 1 with equal probability."""
    heads = jax.random.bernoulli(key, jnp.float32(0.5), (num_envs,))
    return 2 * heads.astype(jnp.float32) - 1


def visible(kind: str, signal: Array, steps: Array) -> Array:
    """The part of the signal that the observation shows."""
    if kind in ("observation_reward", "observation_action"):
        return signal
    if kind == "memory":
        return jnp.where(steps == 0, signal, 0.0)
    return jnp.zeros_like(signal)


def wanted(kind: str, signal: Array) -> Array:
    """The value c that the action has to fit from now on."""
    return signal if kind in ("observation_action", "memory") else jnp.ones_like(signal)


def fit(action: Array, target: Array, discrete: bool) -> Array:
    """The fit `[N]` of actions `[N, A]` to targets `[N]` of -1 or 1; NaN counts as 0."""
    action = jnp.where(jnp.isnan(action), 0.0, action)
    if discrete:
        return jnp.where((action[:, 1] > action[:, 0]) == (target > 0), 1.0, 0.0)
    return 1 - 4 * (jnp.clip(action[:, 0], -1, 1) - target / 2) ** 2


def reward_of(kind: str, state: EnvState, fitness: Array, episode_length: int) -> Array:
    """Rewards `[N]` of the actions that leave from `state`; `fitness` is their fit."""
    last = (state.steps == episode_length - 1).astype(jnp.float32)
    if kind in ("constant_reward", "truncation"):
        return jnp.ones_like(fitness)
    if kind == "discounting":
        return last
    if kind == "observation_reward":
        return state.data
    return fitness * last if kind == "memory" else fitness
