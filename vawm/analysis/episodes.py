"""Records whole episodes of a trained policy, with the memory of its world model.

As in `vawm.policy.play`, the episodes are fixed in advance. The environments are those of the
run's config, so rewards and ends of episodes are those that the critic was trained on.

If each world model were judged on episodes of its own policy, they would be judged on different
states. To compare them on the same steps, one policy plays, and `watched_by` recomputes the
memory of every world model from the recorded steps.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from vawm import evaluate
from vawm.agent import Agent, PolicyCarry, make_agent
from vawm.envs.protocol import Environment, HostEnvironment, check_fits
from vawm.errors import InvalidInput
from vawm.policy import Policy
from vawm.policy.play import FRESH, How
from vawm.types import Batch, EnvSpec, Key, Params, PyTree, TimeStep, Trajectory


class Episodes(NamedTuple):
    """E episodes, each from its first step on.

    Steps from `length` on are padding.

    Attributes:
      trajectory: `[E, T, ...]`.
      memory: `[E, T, ...]` the memory that replay would store with every step, from which a
        `Batch` starts; `()` for none.
      length: `[E]` int32, number of steps, including the first and the last.
    """

    trajectory: Trajectory
    memory: PyTree
    length: Any  # a jax or numpy array, as all leaves

    @property
    def returns(self) -> np.ndarray:
        """`[E]` undiscounted."""
        reward, length = np.asarray(self.trajectory.reward), np.asarray(self.length)
        inside = np.arange(reward.shape[1]) < length[:, None]
        return np.where(inside, reward, 0.0).sum(1)


def record(policy: Policy, *, episodes: int, seed: int, how: How = "sample") -> Episodes:
    """Plays `episodes` whole episodes in the environments of the policy's config.

    Raises:
      InvalidInput: a number of episodes that is not positive, or an impossible seed.
      EnvironmentFailure: an environment on the host failed.
    """
    evaluate.check(episodes, seed)
    with evaluate.environments(policy, episodes) as env:
        return record_in(env, policy, episodes=episodes, seed=seed, how=how)


def record_in(
    env: Environment | HostEnvironment,
    policy: Policy,
    *,
    episodes: int,
    seed: int,
    how: How = "sample",
) -> Episodes:
    """As `record`, in any environments; a jittable one needs `num_envs == episodes`.

    Raises:
      InvalidInput: as `record`; or the environments do not fit the policy, or are jittable
        without an episode length.
    """
    evaluate.check(episodes, seed)
    check_fits(policy.spec, env.spec)
    agent = make_agent(policy.config, policy.spec)
    if not isinstance(env, Environment):
        return on_host(env, policy, agent, episodes=episodes, seed=seed, how=how)
    if env.spec.num_envs != episodes:
        remedy = f"use {env.spec.num_envs}, one episode per environment"
        raise InvalidInput("episodes", episodes, remedy)
    if env.spec.episode_length is None:
        raise InvalidInput("env", env.spec.task, "set the episode_length of its spec")

    def play(params: Params, model_state: PyTree, key: Key) -> Episodes:
        own = policy._replace(params=params, model_state=model_state)
        return on_device(env, own, agent, key, how=how)

    return jax.jit(play)(policy.params, policy.model_state, jax.random.key(seed))


def on_device(
    env: Environment, policy: Policy, agent: Agent, key: Key, *, how: How = "sample"
) -> Episodes:
    """The first episode in each of N environments; can be jitted."""
    assert env.spec.episode_length is not None
    key_reset, key_act = jax.random.split(key)

    def step(loop: tuple[Any, ...], key: Key):
        env_state, carry = loop[0], loop[2]
        timestep: TimeStep = loop[1]
        carry, action = policy.act(key, carry, timestep, how)
        recorded = Trajectory(*timestep, action=action), agent.world_model.memory(carry.memory)
        return (*env.step(env_state, action), carry), recorded

    first = (*env.reset(key_reset), policy.initial(env.spec.num_envs))
    keys = jax.random.split(key_act, env.spec.episode_length + 1)
    _, recorded = jax.lax.scan(step, first, keys)
    trajectory, memory = jax.tree.map(lambda x: x.swapaxes(0, 1), recorded)
    length = 1 + jnp.argmax(trajectory.is_last, axis=1)
    return Episodes(trajectory, memory, length.astype(jnp.int32))


def on_host(
    env: HostEnvironment,
    policy: Policy,
    agent: Agent,
    *,
    episodes: int,
    seed: int,
    how: How = "sample",
) -> Episodes:
    """`episodes` whole episodes, an equal share from each of N environments, in their order."""
    num_envs = env.spec.num_envs
    share = [len(range(i, episodes, num_envs)) for i in range(num_envs)]
    whole: list[list[list[PyTree]]] = [[] for _ in range(num_envs)]
    running: list[list[PyTree]] = [[] for _ in range(num_envs)]
    carry, key = policy.initial(num_envs), jax.random.key(seed)
    timestep = env.reset(FRESH + seed)
    while any(len(own) < wanted for own, wanted in zip(whole, share, strict=True)):
        key, key_act = jax.random.split(key)
        carry, action = policy.act(key_act, carry, timestep, how)
        trajectory = Trajectory(*timestep, action=action)
        remembered = agent.world_model.memory(carry.memory)
        # Copies: the environment may write over its own arrays.
        kept = jax.tree.map(np.array, (trajectory, remembered))
        env.send(kept[0].action)
        for i in range(num_envs):
            if len(whole[i]) < share[i]:
                running[i].append(jax.tree.map(lambda x, i=i: x[i], kept))
                if kept[0].is_last[i]:
                    whole[i].append(running[i])
                    running[i] = []
        timestep = env.receive()
    return join([episode for own in whole for episode in own])


def join(episodes: Sequence[Sequence[PyTree]]) -> Episodes:
    """Joins lists of `(step of a trajectory, memory)`; pads short ones with their last step."""
    length = max(map(len, episodes))
    rows = [
        jax.tree.map(lambda *x: np.stack(x), *episode, *[episode[-1]] * (length - len(episode)))
        for episode in episodes
    ]
    trajectory, memory = jax.tree.map(lambda *x: np.stack(x), *rows)
    return Episodes(trajectory, memory, np.array([len(e) for e in episodes], np.int32))


def remember(
    agent: Agent, params: Params, model_state: PyTree, key: Key, trajectory: Trajectory
) -> PyTree:
    """`[E, T, ...]` the memory that this agent would have after watching the recorded steps.

    The agent acts with `Agent.act`, but its action is replaced by the recorded one. So the
    agent that recorded the steps gets the same memory again, given the same key (any key, if
    its latents are not sampled). Pure; can be jitted.

    Args:
      agent: with the world model that watches.
      params: of the agent.
      model_state: of its world model.
      key: for sampling latents.
      trajectory: `[E, T, ...]`, from the first steps of episodes on.
    """
    episodes, length = trajectory.reward.shape

    def step(carry: PolicyCarry, inputs: tuple[Key, Trajectory]):
        key, (*arrived, action) = inputs
        carry, _ = agent.act(params, model_state, key, carry, TimeStep(*arrived))
        return carry._replace(action=action), agent.world_model.memory(carry.memory)

    steps = jax.tree.map(lambda x: x.swapaxes(0, 1), trajectory)
    keys = jax.random.split(key, length)
    _, memory = jax.lax.scan(step, agent.initial(episodes), (keys, steps))
    return jax.tree.map(lambda x: x.swapaxes(0, 1), memory)


def watched_by(policy: Policy, episodes: Episodes, *, seed: int) -> Episodes:
    """The same steps, with the memory of the world model of `policy`.

    `check_can_watch` tells whether the steps fit the policy.
    """
    agent = make_agent(policy.config, policy.spec)
    infer = jax.jit(functools.partial(remember, agent))
    key = jax.random.key(seed)
    memory = infer(policy.params, policy.model_state, key, episodes.trajectory)
    return episodes._replace(memory=memory)


def check_can_watch(name: str, spec: EnvSpec, player: EnvSpec) -> None:
    """Refuses to judge a run on episodes from other environments than its own.

    Args:
      name: of the run.
      spec: of the environments that it was trained in.
      player: spec of the environments that are played.

    Raises:
      InvalidInput: names what differs: the task, observations, actions or action repeat.
    """
    for field in EnvSpec._fields:
        own, theirs = getattr(spec, field), getattr(player, field)
        if field == "native" and None in (own, theirs):  # of an earlier version
            continue
        if own != theirs and field not in ("num_envs", "episode_length"):
            remedy = f"{name} was trained with {own}; choose a player trained with the same"
            raise InvalidInput("player", f"{field} {theirs}", remedy)


def select(episodes: Episodes, index: int) -> Episodes:
    """One episode, with a leading dimension of 1."""
    return jax.tree.map(lambda x: x[index : index + 1], episodes)


def windows(episodes: Episodes, row: Any, start: Any, *, length: int) -> Batch:
    """`[N, length, ...]` steps of the episodes `row`, from their steps `start` on.

    The first step only gives context. Beyond the end of the record, its last step is repeated.

    Args:
      episodes: the record.
      row: `[N]` int, indices of episodes.
      start: `[N]` int, first steps of the windows.
      length: steps of a window.
    """
    row, start = jnp.asarray(row), jnp.asarray(start)
    last = episodes.trajectory.reward.shape[1] - 1
    time = jnp.minimum(start[:, None] + jnp.arange(length)[None], last)
    return Batch(
        jax.tree.map(lambda x: jnp.asarray(x)[row[:, None], time], episodes.trajectory),
        jax.tree.map(lambda x: jnp.asarray(x)[row, start], episodes.memory),
    )
