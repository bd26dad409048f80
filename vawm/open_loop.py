"""Open-loop prediction: what the world model expects after it has seen a few steps."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from vawm.agent import Agent
from vawm.objective import Batch
from vawm.types import Array, Key, Latent, Params, PyTree


class OpenLoop(NamedTuple):
    """Observations as the decoder tells them, `[B, T, ...]`, beside those of the batch."""

    predicted: PyTree  # in the decoder's units: symlog for vectors, [0, 1] for images
    same_episode: Array  # [B, T] bool, whether no reset lies between the context and here


def make_open_loop(agent: Agent, *, context: int) -> Callable[..., OpenLoop]:
    """Build `open_loop(params, key, batch) -> OpenLoop`.

    The first `context` of the T steps are observed, and decoded from their posterior. The
    others are imagined with the batch's own actions and never looked at. No gradient.
    """
    world_model = agent.world_model

    def decode(params: Params, latent: Latent) -> PyTree:
        return world_model.predict(params.world_model, latent).obs

    def open_loop(params: Params, key: Key, batch: Batch) -> OpenLoop:
        key_observe, key_starts, key_imagine = jax.random.split(key, 3)
        steps = jax.tree.map(lambda x: x[:, 1:], batch.trajectory)
        seen = jax.tree.map(lambda x: x[:, :context], steps)
        _, inference = world_model.observe(
            params.world_model,
            key_observe,
            batch.context,
            seen.obs,
            batch.trajectory.action[:, :context],
            seen.is_first,
            train=False,
        )
        last = jax.tree.map(lambda x: x[:, -1:], (seen, inference))
        carry, _ = world_model.starts(params.world_model, key_starts, *last)

        def imagine(carry: PyTree, inputs: tuple[Array, Key]):
            action, key = inputs
            return world_model.imagine(params.world_model, key, carry, action)

        action = steps.action[:, context - 1 : -1].swapaxes(0, 1)
        keys = jax.random.split(key_imagine, action.shape[0])
        _, latent = jax.lax.scan(imagine, carry, (action, keys))
        imagined = jax.tree.map(lambda x: x.swapaxes(0, 1), latent)
        parts = decode(params, inference.latent), decode(params, imagined)
        resets = jnp.cumsum(steps.is_first.astype(jnp.int32), axis=1)
        return OpenLoop(
            predicted=jax.tree.map(lambda a, b: jnp.concatenate([a, b], axis=1), *parts),
            same_episode=resets == resets[:, context - 1, None],
        )

    return open_loop
