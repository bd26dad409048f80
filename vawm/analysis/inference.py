"""Infers the states of an episode, and imagines from each of them.

The protocol distinguishes two kinds of world models. One with `starts` can imagine from any
inferred state: all steps of the episode but the first are one sequence. One without `starts`
needs earlier steps: each state is inferred from a window of `context` steps that ends there,
so the first `context - 1` steps have no state.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from vawm.agent import Agent, registry
from vawm.analysis.episodes import Episodes, windows
from vawm.config import Config
from vawm.envs.protocol import check_positive
from vawm.errors import InvalidInput
from vawm.types import Array, Batch, Key, Latent, Params, PyTree, Trajectory
from vawm.world_model.protocol import Imagination


class Inferred(NamedTuple):
    """The states of the last N steps of one recorded episode, in order.

    Attributes:
      latent: `[N, ...]` s_t, with z_t sampled from the posterior.
      post_logits: `[N, S, K]` of that posterior, before unimix; None if the protocol does not
        provide them.
      ahead: imagination after a_t: s~_{t+1}, with z sampled from the prior.
    """

    latent: Latent
    post_logits: Array | None
    ahead: Imagination


Infer = Callable[[Params, PyTree, Key, Episodes], Inferred]


def make_infer(agent: Agent, *, context: int, horizon: int) -> Infer:
    """Builds `infer(params, model_state, key, episode) -> Inferred`; `episode` has E = 1.

    No gradient is stopped here.

    Args:
      agent: the agent.
      context: steps of a window, if the world model needs one; at least 2.
      horizon: steps that can be imagined after `ahead`.
    """
    world_model = agent.world_model

    def from_states(
        params: Params, model_state: PyTree, key: Key, episode: Episodes
    ) -> Inferred:
        model, starts = params.world_model, world_model.starts
        assert starts is not None
        key_explain, key_imagine = jax.random.split(key)
        whole = windows(episode, [0], [0], length=episode.trajectory.reward.shape[1])
        inference = world_model.explain(model, model_state, key_explain, whole)[0].inference
        carry, latent = starts(model, model_state, inference)
        action = whole.trajectory.action[0, 1:]
        ahead = world_model.imagine(model, model_state, key_imagine, carry, action)
        return Inferred(latent, inference.post_logits[0], ahead)

    def from_windows(
        params: Params, model_state: PyTree, key: Key, episode: Episodes
    ) -> Inferred:
        start = jnp.arange(episode.trajectory.reward.shape[1] - context + 1)
        batch = windows(episode, jnp.zeros_like(start), start, length=context)
        inferred, ahead = world_model.follow(
            params.world_model, model_state, key, batch, horizon=horizon
        )
        return Inferred(jax.tree.map(lambda x: x[:, -1], inferred), None, ahead)

    return from_windows if world_model.starts is None else from_states


def make_prior(agent: Agent) -> Callable[..., Array] | None:
    """Builds `prior(params, model_state, key, latent, action) -> logits [N, S, K]`.

    The logits of p(z_{t+1} | h_{t+1}) after `latent` and `action`, as `explain` computes them
    for a sequence that starts with this state. None for a world model without `starts`.
    """
    world_model, spec = agent.world_model, agent.spec
    if world_model.starts is None:
        return None

    def prior(
        params: Params, model_state: PyTree, key: Key, latent: Latent, action: Array
    ) -> Array:
        size = action.shape[0]

        def blank(leaf):
            return jnp.zeros((size, 2, *leaf.shape), leaf.dtype)

        flag = jnp.zeros((size, 2), bool)
        steps = Trajectory(
            obs=jax.tree.map(blank, spec.obs),  # the prior does not depend on it
            reward=jnp.zeros((size, 2), jnp.float32),
            is_first=flag,
            is_last=flag,
            is_terminal=flag,
            action=jnp.stack([action, jnp.zeros_like(action)], axis=1),
        )
        batch = Batch(steps, world_model.memory(latent))
        explanation, _ = world_model.explain(params.world_model, model_state, key, batch)
        return explanation.inference.prior_logits[:, 0]

    return prior


def reconstruction(obs: PyTree) -> PyTree:
    """`obs` as the decoder predicts it.

    Raises:
      InvalidInput: the world model has no decoder.
    """
    if not jax.tree.leaves(obs):
        raise InvalidInput("world_model", None, "has no decoder; this analysis needs one")
    return obs


def check(config: Config, *, context: int, depth: int) -> None:
    """Refuses a context and a depth that the world model cannot imagine with.

    Raises:
      InvalidInput: names the number and the remedy.
    """
    check_positive("depth", depth)
    check_positive("context", context)
    if context < 2:
        raise InvalidInput("context", context, "use at least 2: the first step has no state")
    seen = config.replay.batch_length
    if not registry.kind(config.agent).context_limited or context + depth <= seen:
        return
    saw = f"training used {seen} positions"
    if context >= seen:
        raise InvalidInput("context", context, f"use less than {seen}: {saw}")
    raise InvalidInput("depth", depth, f"use at most {seen - context} after the context: {saw}")
