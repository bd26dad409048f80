"""Learning from replay: as many updates as are due, each on what it draws."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from vawm.agent import Agent
from vawm.config import Config
from vawm.learning import image_store, replay
from vawm.learning.replay import Positions, Replay
from vawm.learning.state import Learner
from vawm.learning.update import make_update
from vawm.types import Array, Key, Metrics, PyTree


class Draw(NamedTuple):
    """One thing for the batch and the same for the contexts, `()` where there are none.

    What it is: positions in replay, or the images there where replay has none itself.
    """

    batch: Any
    contexts: Any


UpdateAt = Callable[..., tuple[Learner, Replay, Metrics]]
Learn = Callable[[Learner, Replay, Key, Array, Array], tuple[Learner, Replay, Metrics]]

NO_IMAGES = Draw((), ())


def shapes(config: Config) -> Draw:
    """`(sequences, steps)` that an update draws; a batch has a first step for context."""
    batch = config.replay.batch_size, config.replay.batch_length + 1
    imagination = config.imagination
    if imagination.starts != "contexts":
        return Draw(batch, ())
    return Draw(batch, (imagination.batch_size, imagination.context_length))


def draw(config: Config, buffer: Replay, key: Key) -> Draw:
    """Where an update's sequences lie, uniformly over all possible starts."""
    batch, contexts = shapes(config)
    if not contexts:
        return Draw(_draw(buffer, key, *batch), ())
    key_batch, key_contexts = jax.random.split(key)
    return Draw(_draw(buffer, key_batch, *batch), _draw(buffer, key_contexts, *contexts))


def draw_on_host(
    config: Config, rng: np.random.Generator, num_envs: int, capacity: int, head: int, size: int
) -> Draw:
    """As `draw`, with numpy and where replay is known by its numbers only."""

    def positions(batch_size: int, length: int) -> Positions:
        ring = num_envs, capacity, head, size
        return replay.draw_on_host(rng, *ring, batch_size=batch_size, length=length)

    batch, contexts = shapes(config)
    return Draw(positions(*batch), positions(*contexts) if contexts else ())


def _draw(buffer: Replay, key: Key, batch_size: int, length: int) -> Positions:
    return replay.draw(buffer, key, batch_size=batch_size, length=length)


def make_update_at(agent: Agent, config: Config) -> UpdateAt:
    """Build `update_at(learner, replay, positions, images, key, env_steps)`.

    One update on what lies at `positions`, and the latents inferred there written back. Returns
    learner, replay and metrics. `images` are those of the same steps where replay keeps none.
    """
    update = make_update(agent, config)

    def update_at(
        learner: Learner,
        buffer: Replay,
        positions: Draw,
        images: Draw,
        key: Key,
        env_steps: Array,
    ) -> tuple[Learner, Replay, Metrics]:
        def read(at: Positions, images: PyTree):
            return image_store.complete(replay.read(buffer, at), images)

        batch = read(positions.batch, images.batch)
        contexts = positions.contexts and read(positions.contexts, images.contexts)
        learner, latent, metrics = update(learner, batch, contexts, key, env_steps)
        inferred = positions.batch._replace(time=positions.batch.time[:, 1:])
        return learner, replay.write_back(buffer, inferred, latent), metrics

    return update_at


def make_learn(agent: Agent, config: Config) -> Learn:
    """Build `learn(learner, replay, key, env_steps, due) -> (learner, replay, metrics)`.

    `due` updates, each on sequences of its own, whose latents are written back before the
    next are drawn. Metrics are means over the updates, NaN if there is none.
    """
    # Jitted, so that asking for shapes is no second trace.
    update_at = jax.jit(make_update_at(agent, config))

    def learn(
        learner: Learner, buffer: Replay, key: Key, env_steps: Array, due: Array
    ) -> tuple[Learner, Replay, Metrics]:
        positions = jax.eval_shape(lambda key: draw(config, buffer, key), key)
        arguments = learner, buffer, positions, NO_IMAGES, key, env_steps
        metrics = jax.eval_shape(update_at, *arguments)[-1]
        sums = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), metrics)

        def one_update(_, state: tuple[Learner, Replay, Key, Metrics]):
            learner, buffer, key, sums = state
            key, key_draw, key_update = jax.random.split(key, 3)
            positions = draw(config, buffer, key_draw)
            learner, buffer, metrics = update_at(
                learner, buffer, positions, NO_IMAGES, key_update, env_steps
            )
            return learner, buffer, key, jax.tree.map(jnp.add, sums, metrics)

        state = learner, buffer, key, sums
        learner, buffer, _, sums = jax.lax.fori_loop(0, due, one_update, state)
        return learner, buffer, jax.tree.map(lambda x: x / due, sums)

    return learn
