"""Rollouts of the policy inside the world model."""

from __future__ import annotations

from collections.abc import Callable

import jax
import jax.numpy as jnp

from vawm.distributions import ActionDistribution
from vawm.types import Imagined, Key, Latent, PyTree
from vawm.world_model.protocol import WorldModel


def imagine(
    world_model: WorldModel,
    policy: Callable[[Latent], ActionDistribution],
    params: PyTree,
    state: PyTree,
    key: Key,
    carry: PyTree,
    start: Latent,
    *,
    horizon: int,
) -> Imagined:
    """Follow `policy` for `horizon` steps from N starts; no gradient leaves here.

    Latents are written to their places as they are reached: to put the starts in front of what
    a scan emits would copy all of them.

    Args:
      world_model: the model that imagines.
      policy: pi(a | s), as a function of a latent.
      params: parameters of the world model.
      state: what it carries beside them.
      key: for actions and latents.
      carry: the world model's imagination state at the starts.
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
        carry, latent = world_model.imagine(params, state, key_latent, carry, action)
        latents = jax.tree.map(lambda all, x: all.at[index + 1].set(x), latents, latent)
        return (carry, latent, latents), action

    room = jax.tree.map(lambda x: jnp.zeros((horizon + 1, *x.shape), x.dtype), start)
    latents = jax.tree.map(lambda all, x: all.at[0].set(x), room, start)
    steps = jnp.arange(horizon), jax.random.split(key, horizon)
    (_, _, latents), action = jax.lax.scan(step, (carry, start, latents), steps)
    return jax.lax.stop_gradient(Imagined(latents, action))
