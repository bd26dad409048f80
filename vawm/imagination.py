"""Rollouts of the policy inside the world model."""

from __future__ import annotations

from collections.abc import Callable

import jax

from vawm.distributions import Policy
from vawm.types import Imagined, Key, Latent, PyTree
from vawm.world_model.protocol import WorldModel


def imagine(
    world_model: WorldModel,
    policy: Callable[[Latent], Policy],
    params: PyTree,
    state: PyTree,
    key: Key,
    carry: PyTree,
    start: Latent,
    *,
    horizon: int,
) -> Imagined:
    """Follow `policy` for `horizon` steps from N starts; no gradient leaves here.

    The scan emits the latent that each step starts from and runs once more than the
    horizon, which spares the copy of every imagined latent that prepending the starts
    would make.

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
      `Imagined`: latents `[H + 1, N, ...]`, the first of them `start`, actions
      `[H + 1, N, A]`; the last one leads nowhere and only completes the shape.
    """

    def step(reached, key):
        carry, latent = reached
        key_action, key_latent = jax.random.split(key)
        action = policy(latent).sample(key_action)
        return world_model.imagine(params, state, key_latent, carry, action), (latent, action)

    keys = jax.random.split(key, horizon + 1)
    _, (latent, action) = jax.lax.scan(step, (carry, start), keys)
    return jax.lax.stop_gradient(Imagined(latent, action))
