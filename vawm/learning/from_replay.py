"""Learning from replay: as many updates as are due, each on a batch of its own."""

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
from vawm.types import Array, Batch, Key, Metrics


class Draw(NamedTuple):
    """The same kind of thing for the batch and for the contexts; `()` if there are none.

    Such as their shapes, their positions in replay, or their images if the host keeps those.
    """

    batch: Any
    contexts: Any


UpdateAt = Callable[..., tuple[Learner, Replay, Metrics]]
Learn = Callable[[Learner, Replay, Key, Array, Array], tuple[Learner, Replay, Metrics]]

NO_IMAGES = Draw((), ())


def shapes(config: Config) -> Draw:
    """`(sequences, steps)` of what an update draws; a batch has one more step, for context."""
    batch = config.replay.batch_size, config.replay.batch_length + 1
    if not has_contexts(config):
        return Draw(batch, ())
    return Draw(batch, (config.imagination.batch_size, config.imagination.context_length))


def has_contexts(config: Config) -> bool:
    """Whether an update draws contexts of their own, in which imagination starts."""
    return config.imagination.starts == "contexts"


def for_each(config: Config, function: Callable[..., Any], *draws: Draw) -> Draw:
    """`function` of the entries for the batch, and of those for the contexts, if any."""
    batches = [draw.batch for draw in draws]
    contexts = [draw.contexts for draw in draws]
    return Draw(function(*batches), function(*contexts) if has_contexts(config) else ())


def draw(config: Config, buffer: Replay, key: Key) -> Draw:
    """Positions of the sequences of an update, uniform over all possible starts."""
    keys = Draw(key, ())
    if has_contexts(config):
        keys = Draw(*jax.random.split(key))

    def positions(shape: tuple[int, int], key: Key) -> Positions:
        batch_size, length = shape
        return replay.draw(buffer, key, batch_size=batch_size, length=length)

    return for_each(config, positions, shapes(config), keys)


def draw_on_host(
    config: Config, rng: np.random.Generator, num_envs: int, capacity: int, head: int, size: int
) -> Draw:
    """As `draw`, with numpy and without the arrays of replay."""

    def positions(shape: tuple[int, int]) -> Positions:
        batch_size, length = shape
        return replay.draw_on_host(
            rng, num_envs, capacity, head, size, batch_size=batch_size, length=length
        )

    return for_each(config, positions, shapes(config))


def make_update_at(agent: Agent, config: Config) -> UpdateAt:
    """Build `update_at(learner, replay, positions, images, key, env_steps)`.

    It makes one update with the steps at `positions` and writes the inferred latents back.
    It returns learner, replay and metrics. `images` are those of the same steps if the host
    keeps them, else `NO_IMAGES`.
    """
    update = make_update(agent, config)
    on_host = config.replay.images == "host"

    def update_at(
        learner: Learner,
        buffer: Replay,
        positions: Draw,
        images: Draw,
        key: Key,
        env_steps: Array,
    ) -> tuple[Learner, Replay, Metrics]:
        def read(at: Positions) -> Batch:
            return replay.read(buffer, at)

        drawn = for_each(config, read, positions)
        if on_host:
            drawn = for_each(config, image_store.complete, drawn, images)
        learner, latent, metrics = update(learner, drawn.batch, drawn.contexts, key, env_steps)
        inferred = positions.batch._replace(time=positions.batch.time[:, 1:])
        return learner, replay.write_back(buffer, inferred, latent), metrics

    return update_at


def make_learn(agent: Agent, config: Config) -> Learn:
    """Build `learn(learner, replay, key, env_steps, due) -> (learner, replay, metrics)`.

    It makes `due` updates, each on sequences of its own. Their latents are written back before
    the next sequences are drawn. Metrics are means over the updates, 0 if there are none.
    """
    # Jitted, so that `eval_shape` and the loop share one trace.
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
        updates = jnp.maximum(due, 1).astype(jnp.float32)  # no division by 0
        return learner, buffer, jax.tree.map(lambda x: x / updates, sums)

    return learn
