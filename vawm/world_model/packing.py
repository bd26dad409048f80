"""How replay stores latents: the classes of a one-hot z as bytes."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from vawm.types import Latent


def pack(latent: Latent) -> Latent:
    """Replaces one-hot z `[..., S, K]` by indices `[..., S]`: exact, one byte for K floats."""
    return latent._replace(stoch=jnp.argmax(latent.stoch, -1).astype(jnp.uint8))


def unpack(latent: Latent, classes: int) -> Latent:
    """The inverse of `pack`; z has the dtype of h."""
    return latent._replace(
        stoch=jax.nn.one_hot(latent.stoch, classes, dtype=latent.deter.dtype)
    )
