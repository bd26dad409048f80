"""Learning: one update of everything from one replayed batch, and as many as are due."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax

from vawm import image_store, optim, replay, returns
from vawm.agent import Agent
from vawm.config import Config
from vawm.objective import Batch, make_behaviour_loss, make_world_model_loss
from vawm.replay import Positions, Replay
from vawm.types import Array, Key, Latent, Metrics, Params, PyTree


class Learner(NamedTuple):
    """Everything that updates change."""

    step: Array  # [] int32, updates done
    params: Params
    slow_critic: PyTree
    opt_state: PyTree
    return_scale: returns.ReturnScale


Update = Callable[[Learner, Batch, Key, Array], tuple[Learner, Latent, Metrics]]
UpdateAt = Callable[..., tuple[Learner, Replay, Metrics]]
Learn = Callable[[Learner, Replay, Key, Array, Array], tuple[Learner, Replay, Metrics]]


def init_learner(agent: Agent, config: Config, key: Key) -> Learner:
    """Fresh parameters; the slow critic starts as an exact copy of the critic."""
    params = agent.init(key)
    return Learner(
        step=jnp.zeros((), jnp.int32),
        params=params,
        slow_critic=jax.tree.map(jnp.copy, params.critic),
        opt_state=optim.make_optimizer(config.optimizer).init(params),
        return_scale=returns.init_return_scale(),
    )


def make_update(agent: Agent, config: Config) -> Update:
    """Build `update(learner, batch, key, env_steps) -> (learner, latent, metrics)`.

    One gradient of one summed loss for world model, actor and critic, one optimiser step,
    one EMA. The returned latent is the posterior of the batch's steps 1..T, to be written
    back to replay. `env_steps` only gates value alignment.
    """
    optimizer = optim.make_optimizer(config.optimizer)
    world_model_loss = make_world_model_loss(agent, config)
    behaviour_loss = make_behaviour_loss(agent, config)

    def loss_fn(params: Params, learner: Learner, batch: Batch, key: Key, env_steps: Array):
        key_observe, key_behaviour = jax.random.split(key)
        step = env_steps if config.value_alignment.warmup_unit == "env_steps" else learner.step
        model_loss, inference, model_metrics = world_model_loss(
            params, learner.slow_critic, batch, key_observe, step
        )
        agent_loss, return_scale, agent_metrics = behaviour_loss(
            params,
            learner.slow_critic,
            learner.return_scale,
            batch,
            inference,
            key_behaviour,
        )
        total = model_loss + agent_loss
        metrics = model_metrics | agent_metrics | {"loss/total": total}
        return total, (inference.latent, return_scale, metrics)

    def update(
        learner: Learner, batch: Batch, key: Key, env_steps: Array
    ) -> tuple[Learner, Latent, Metrics]:
        gradient, (latent, return_scale, metrics) = jax.grad(loss_fn, has_aux=True)(
            learner.params, learner, batch, key, env_steps
        )
        updates, opt_state = optimizer.update(gradient, learner.opt_state, learner.params)
        params = optax.apply_updates(learner.params, updates)
        rate = config.critic.slow_rate
        metrics["optimizer/gradient_norm"] = optax.tree.norm(gradient)
        metrics["optimizer/update_norm"] = optax.tree.norm(updates)
        return (
            Learner(
                step=learner.step + 1,
                params=params,
                slow_critic=optax.incremental_update(params.critic, learner.slow_critic, rate),
                opt_state=opt_state,
                return_scale=return_scale,
            ),
            latent,
            metrics,
        )

    return update


def make_update_at(agent: Agent, config: Config) -> UpdateAt:
    """Build `update_at(learner, replay, positions, images, key, env_steps)`.

    One update on what lies at `positions`, `[B, T + 1]` steps of which the first only gives
    context, and the latents inferred there written back. Returns learner, replay and metrics.
    `images` are those of the same steps where replay keeps none, else `()`.
    """
    update = make_update(agent, config)

    def update_at(
        learner: Learner,
        buffer: Replay,
        positions: Positions,
        images: PyTree,
        key: Key,
        env_steps: Array,
    ) -> tuple[Learner, Replay, Metrics]:
        trajectory, context = replay.read(buffer, positions, classes=config.world_model.classes)
        obs = image_store.merge(trajectory.obs, images)
        batch = Batch(trajectory._replace(obs=obs), context)
        learner, latent, metrics = update(learner, batch, key, env_steps)
        positions = positions._replace(time=positions.time[:, 1:])
        return learner, replay.write_back(buffer, positions, latent), metrics

    return update_at


def make_learn(agent: Agent, config: Config) -> Learn:
    """Build `learn(learner, replay, key, env_steps, due) -> (learner, replay, metrics)`.

    `due` updates, each on a batch of its own, whose latents are written back before the
    next is drawn. Metrics are means over the updates, NaN if there is none.
    """
    # Jitted, so that asking for shapes is no second trace.
    update_at = jax.jit(make_update_at(agent, config))
    size, length = config.replay.batch_size, config.replay.batch_length

    def draw(buffer: Replay, key: Key) -> Positions:
        return replay.draw(buffer, key, batch_size=size, length=length + 1)

    def learn(
        learner: Learner, buffer: Replay, key: Key, env_steps: Array, due: Array
    ) -> tuple[Learner, Replay, Metrics]:
        positions = jax.eval_shape(draw, buffer, key)
        metrics = jax.eval_shape(update_at, learner, buffer, positions, (), key, env_steps)[-1]
        sums = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), metrics)

        def one_update(_, state: tuple[Learner, Replay, Key, Metrics]):
            learner, buffer, key, sums = state
            key, key_draw, key_update = jax.random.split(key, 3)
            positions = draw(buffer, key_draw)
            learner, buffer, metrics = update_at(
                learner, buffer, positions, (), key_update, env_steps
            )
            return learner, buffer, key, jax.tree.map(jnp.add, sums, metrics)

        state = learner, buffer, key, sums
        learner, buffer, _, sums = jax.lax.fori_loop(0, due, one_update, state)
        return learner, buffer, jax.tree.map(lambda x: x / due, sums)

    return learn
