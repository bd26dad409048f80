"""Rollouts of the policy in the world model."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp

from vawm.nets.distributions import ActionDistribution
from vawm.types import Imagined, Key, Latent, PyTree
from vawm.world_model.protocol import WorldModel


def imagine(
    world_model: WorldModel,
    policy: Callable[[Latent], ActionDistribution],
    params: PyTree,
    model_state: PyTree,
    key: Key,
    carry: PyTree,
    start: Latent,
    *,
    horizon: int,
) -> Imagined:
    """Follows `policy` for `horizon` steps from N starts. The result has no gradient.

    Each latent is written to its place in one array when it is reached. Concatenating the
    starts and the outputs of the scan would copy all latents.

    Args:
      world_model: the model that imagines.
      policy: pi(a | s), as a function of a latent.
      params: parameters of the world model.
      model_state: what the world model carries beside them.
      key: for actions and latents.
      carry: what the world model's `imagine` carries at the starts.
      start: `[N, ...]` the latents to start from.
      horizon: H, number of imagined steps.

    Returns:
      `Imagined`: latents `[H + 1, N, ...]`, the first of them `start`, and the actions
      `[H, N, A]` between them.
    """

    def step(reached, inputs):
        (carry, latent, latents), (index, key) = reached, inputs
        key_action, key_latent = jax.random.split(key)
        action = policy(latent).sample(key_action)
        carry, latent = world_model.imagine(params, model_state, key_latent, carry, action)
        latents = jax.tree.map(lambda all, x: all.at[index + 1].set(x), latents, latent)
        return (carry, latent, latents), action

    room = jax.tree.map(lambda x: jnp.zeros((horizon + 1, *x.shape), x.dtype), start)
    latents = jax.tree.map(lambda all, x: all.at[0].set(x), room, start)
    steps = jnp.arange(horizon, dtype=jnp.int32), jax.random.split(key, horizon)
    (_, _, latents), action = jax.lax.scan(step, (carry, start, latents), steps)
    return jax.lax.stop_gradient(Imagined(latents, action))
