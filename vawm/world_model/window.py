"""The last steps, which an agent without a recurrent state remembers."""

from __future__ import annotations

from typing import NamedTuple

import jax
import jax.numpy as jnp

from vawm.types import Array, EnvSpec, PyTree


class Window(NamedTuple):
    """What acting remembers: the last complete steps, and the one that still needs its action.

    The oldest step is at index 0. Entries from index `length` on are not used.
    """

    obs: PyTree  # [N, C, ...]
    action: Array  # [N, C, A], what left from them
    length: Array  # [N] int32, steps held
    latest: PyTree  # [N, ...] the observation whose action is not known yet
    waits: Array  # [N] bool, whether there is such an observation


def empty_window(spec: EnvSpec, context: int, batch_size: int) -> Window:
    """An empty window with room for `context` steps."""

    def room(shape: tuple[int, ...]) -> PyTree:
        return jax.tree.map(lambda x: jnp.zeros((*shape, *x.shape), x.dtype), spec.obs)

    return Window(
        obs=room((batch_size, context)),
        action=jnp.zeros((batch_size, context, spec.action_size), jnp.float32),
        length=jnp.zeros(batch_size, jnp.int32),
        latest=room((batch_size,)),
        waits=jnp.zeros(batch_size, bool),
    )


def remember(window: Window, action: Array) -> Window:
    """Completes the step that waits for `action`, if there is one, and appends it."""
    context = window.action.shape[1]
    full = window.length == context

    def append(past: Array, new: Array) -> Array:
        def per_row(flag: Array) -> Array:
            return flag.reshape(-1, *(1,) * (past.ndim - 1))

        moved = jnp.where(per_row(full), jnp.roll(past, -1, axis=1), past)
        place = jnp.where(full, context - 1, window.length)
        here = jnp.arange(context, dtype=jnp.int32)[None] == place[:, None]
        here = (here & window.waits[:, None]).reshape(*here.shape, *(1,) * (past.ndim - 2))
        appended = jnp.where(here, new[:, None], moved)
        return jnp.where(per_row(window.waits), appended, past)

    return window._replace(
        obs=jax.tree.map(append, window.obs, window.latest),
        action=append(window.action, action),
        length=jnp.where(window.waits & ~full, window.length + 1, window.length),
    )
