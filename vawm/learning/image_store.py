"""Replayed images in the memory of the host, for devices that have too little of it.

The store is a ring like replay, of bytes. Replay on the device then holds everything except the
images, with an empty array in place of each image; the store holds only the images, with an
empty array in place of each vector. Both are trees like an observation; `merge` joins them.
"""

from __future__ import annotations

import jax
import jax.numpy as jnp
import numpy as np

from vawm.learning.replay import Positions
from vawm.types import ArraySpec, Batch, PyTree, is_image


def specs(obs: PyTree, *, num_envs: int, capacity: int) -> PyTree:
    """Shapes of a store for `capacity` steps of each environment; `obs` is `EnvSpec.obs`."""

    def ring(spec: ArraySpec) -> ArraySpec:
        shape = (num_envs, capacity, *spec.shape) if is_image(spec) else (num_envs, 0)
        return ArraySpec(shape, spec.dtype)

    return jax.tree.map(ring, obs)


def init(obs: PyTree, *, num_envs: int, capacity: int) -> PyTree:
    """An empty store, of numpy arrays that `add` writes into."""
    shapes = specs(obs, num_envs=num_envs, capacity=capacity)
    return jax.tree.map(lambda x: np.zeros(x.shape, x.dtype), shapes)


def add(store: PyTree, obs: PyTree, at: int) -> None:
    """Writes the images of one step, `[N, ...]`, to index `at` of every ring, in place."""
    for ring, x in zip(jax.tree.leaves(store), jax.tree.leaves(obs), strict=True):
        if ring.size:
            ring[:, at] = x


def read(store: PyTree, positions: Positions) -> PyTree:
    """A copy of the images at `positions`, `[B, L, ...]`."""
    env, time = positions

    def gather(ring: np.ndarray) -> np.ndarray:
        empty = np.zeros((*time.shape, 0), ring.dtype)
        return ring[env[:, None], time] if ring.size else empty

    return jax.tree.map(gather, store)


def without_images(obs: PyTree) -> PyTree:
    """Observations `[N, ...]` with an empty array in place of each image."""
    return jax.tree.map(
        lambda x: jnp.zeros((x.shape[0], 0), x.dtype) if is_image(x) else x, obs
    )


def merge(obs: PyTree, images: PyTree) -> PyTree:
    """Observations whose images are taken from the tree `images`."""
    return jax.tree.map(lambda x, pixels: pixels if is_image(x) else x, obs, images)


def complete(batch: Batch, images: PyTree) -> Batch:
    """`batch` with the `images` of its steps."""
    obs = merge(batch.trajectory.obs, images)
    return batch._replace(trajectory=batch.trajectory._replace(obs=obs))
