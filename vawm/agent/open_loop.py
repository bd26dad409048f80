"""Open-loop prediction: what the world model predicts after it has seen a few steps."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from vawm.agent import Agent
from vawm.types import Array, Batch, Key, Latent, Params, PyTree


class OpenLoop(NamedTuple):
    """Decoded observations, `[B, T, ...]`, one for each of the batch."""

    predicted: PyTree  # in the decoder's units: symlog for vectors, [0, 1] for images
    same_episode: Array  # [B, T] bool, whether no reset lies between the context and this step


def make_states(agent: Agent, *, context: int) -> Callable[..., tuple[Latent, Latent]]:
    """Build `states(params, model_state, key, batch) -> (inferred, imagined)`.

    The first `context` of the T steps are observed, `[B, context, ...]`. The others are
    imagined with the batch's own actions; their observations are never read. No gradient.
    """
    world_model = agent.world_model

    def states(
        params: Params, model_state: PyTree, key: Key, batch: Batch
    ) -> tuple[Latent, Latent]:
        model = params.world_model
        key_follow, key_imagine = jax.random.split(key)
        steps = batch.trajectory
        seen = batch._replace(trajectory=jax.tree.map(lambda x: x[:, : context + 1], steps))
        action = steps.action[:, context + 1 : -1].swapaxes(0, 1)
        left = action.shape[0]
        inferred, (carry, first) = world_model.follow(
            model, model_state, key_follow, seen, horizon=left
        )

        def imagine(carry: PyTree, inputs: tuple[Array, Key]):
            action, key = inputs
            return world_model.imagine(model, model_state, key, carry, action)

        _, latent = jax.lax.scan(imagine, carry, (action, jax.random.split(key_imagine, left)))
        imagined = jax.tree.map(
            lambda a, b: jnp.concatenate([a[:, None], b.swapaxes(0, 1)], axis=1), first, latent
        )
        return inferred, imagined

    return states


def make_open_loop(agent: Agent, *, context: int) -> Callable[..., OpenLoop]:
    """Build `open_loop(params, model_state, key, batch) -> OpenLoop`: the states, decoded."""
    states = make_states(agent, context=context)

    def decode(params: Params, model_state: PyTree, latent: Latent) -> PyTree:
        return agent.world_model.predict(params.world_model, model_state, latent).obs

    def open_loop(params: Params, model_state: PyTree, key: Key, batch: Batch) -> OpenLoop:
        parts = [
            decode(params, model_state, part)
            for part in states(params, model_state, key, batch)
        ]
        resets = jnp.cumsum(batch.trajectory.is_first[:, 1:].astype(jnp.int32), axis=1)
        return OpenLoop(
            predicted=jax.tree.map(lambda a, b: jnp.concatenate([a, b], axis=1), *parts),
            same_episode=resets == resets[:, context - 1, None],
        )

    return open_loop
