"""A batch of random steps, and the norm of a gradient."""

import jax
import jax.numpy as jnp

from vawm.types import Batch, Trajectory

BATCH, LENGTH = 2, 8


def batch(agent):
    keys = jax.random.split(jax.random.key(7), 3)
    shape = BATCH, LENGTH + 1
    flags = jnp.zeros(shape, bool)
    trajectory = Trajectory(
        obs=jax.random.normal(keys[0], (*shape, 2)),
        reward=jax.random.normal(keys[1], shape),
        is_first=flags.at[0, 5].set(True),
        is_last=flags.at[0, 4].set(True),
        is_terminal=flags,
        action=jax.random.normal(keys[2], (*shape, 1)),
    )
    return Batch(trajectory, agent.world_model.memory(agent.world_model.initial(BATCH)))


def norm(tree):
    return float(sum(jnp.sum(jnp.abs(x)) for x in jax.tree.leaves(tree)))
