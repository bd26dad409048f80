"""The training step: collect, store, update, as one pure function.

`make_update` builds the update of everything that is learned from one replayed batch,
`make_collect` the interaction with an environment, `make_train_step` joins both. Nothing
here is jitted; the caller compiles `train_step` once and donates its state.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import optax

from vawm import optim, replay, returns
from vawm.agent import Agent, PolicyCarry
from vawm.config import Config
from vawm.envs.protocol import Environment
from vawm.objective import Batch, make_behaviour_loss, make_world_model_loss
from vawm.replay import Replay
from vawm.types import (
    Array,
    Key,
    Latent,
    Metrics,
    Params,
    PyTree,
    TimeStep,
    Trajectory,
)


class Learner(NamedTuple):
    """Everything that updates change."""

    step: Array  # [] int32, updates done
    params: Params
    slow_critic: PyTree
    opt_state: PyTree
    return_scale: returns.ReturnScale


class Collector(NamedTuple):
    """Everything that interaction changes, but for replay."""

    env_state: PyTree
    timestep: TimeStep  # the observation that waits for an action
    carry: PolicyCarry
    env_steps: Array  # [] int32, control steps so far, action repeat included
    episode_return: Array  # [N] of the running episodes
    episode_length: Array  # [N] calls of `step` in the running episodes


class TrainState(NamedTuple):
    """A whole run: what a checkpoint holds and `train_step` maps to its successor."""

    learner: Learner
    collector: Collector
    replay: Replay
    credit: Array  # [] int32, replayed steps that are owed, less than one batch
    key: Key


Update = Callable[[Learner, Batch, Key, Array], tuple[Learner, Latent, Metrics]]
Init = Callable[[Key], TrainState]
Collect = Callable[[Params, Collector, Replay, Key], tuple[Collector, Replay, Metrics]]
Learn = Callable[[Learner, Replay, Key, Array, Array], tuple[Learner, Replay, Metrics]]
TrainStep = Callable[[TrainState], tuple[TrainState, Metrics]]


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


def make_collect(env: Environment, agent: Agent, config: Config) -> Collect:
    """Build `collect(params, collector, replay, key)`: K steps in each environment."""

    def step(params: Params, collector: Collector, key: Key):
        timestep = collector.timestep
        carry, action = agent.act(params, key, collector.carry, timestep)
        stored = Trajectory(*timestep, action=action), carry.latent
        env_state, timestep = env.step(collector.env_state, action)
        moved = ~timestep.is_first
        episode_return = jnp.where(moved, collector.episode_return, 0.0) + timestep.reward
        episode_length = jnp.where(moved, collector.episode_length + 1, 0)
        ended = timestep.is_last
        metrics = {
            "episode/count": jnp.sum(ended),
            "episode/return": jnp.sum(jnp.where(ended, episode_return, 0.0)),
            "episode/length": jnp.sum(jnp.where(ended, episode_length, 0)),
            "env/nonfinite": jnp.sum(ended & (env_state.steps < 0)),
        }
        collector = Collector(
            env_state=env_state,
            timestep=timestep,
            carry=carry,
            env_steps=collector.env_steps + env.spec.action_repeat * jnp.sum(moved),
            episode_return=episode_return,
            episode_length=episode_length,
        )
        return collector, (stored, metrics)

    def collect(params: Params, collector: Collector, buffer: Replay, key: Key):
        keys = jax.random.split(key, config.collect_steps)
        collector, (stored, metrics) = jax.lax.scan(
            lambda c, k: step(params, c, k), collector, keys
        )
        trajectory, latent = jax.tree.map(lambda x: x.swapaxes(0, 1), stored)
        buffer = replay.add(buffer, trajectory, latent)
        return collector, buffer, jax.tree.map(jnp.sum, metrics)

    return collect


def make_learn(agent: Agent, config: Config) -> Learn:
    """Build `learn(learner, replay, key, env_steps, due) -> (learner, replay, metrics)`.

    `due` updates, each on a batch of its own, whose latents are written back before the
    next is drawn. Metrics are means over the updates, NaN if there is none.
    """
    update = jax.jit(make_update(agent, config))  # so that asking for shapes is no second trace
    size, length = config.replay.batch_size, config.replay.batch_length
    classes = config.world_model.classes

    def draw(buffer: Replay, key: Key) -> tuple[Batch, replay.Positions]:
        trajectory, context, positions = replay.sample(
            buffer, key, batch_size=size, length=length + 1, classes=classes
        )
        return Batch(trajectory, context), positions._replace(time=positions.time[:, 1:])

    def learn(
        learner: Learner, buffer: Replay, key: Key, env_steps: Array, due: Array
    ) -> tuple[Learner, Replay, Metrics]:
        batch, _ = jax.eval_shape(draw, buffer, key)
        metrics = jax.eval_shape(update, learner, batch, key, env_steps)[-1]
        sums = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), metrics)

        def one_update(_, state: tuple[Learner, Replay, Key, Metrics]):
            learner, buffer, key, sums = state
            key, key_draw, key_update = jax.random.split(key, 3)
            batch, positions = draw(buffer, key_draw)
            learner, latent, metrics = update(learner, batch, key_update, env_steps)
            buffer = replay.write_back(buffer, positions, latent)
            return learner, buffer, key, jax.tree.map(jnp.add, sums, metrics)

        state = learner, buffer, key, sums
        learner, buffer, _, sums = jax.lax.fori_loop(0, due, one_update, state)
        return learner, buffer, jax.tree.map(lambda x: x / due, sums)

    return learn


def make_train_step(env: Environment, agent: Agent, config: Config) -> TrainStep:
    """Build `train_step(state) -> (state, metrics)`: collect K steps, then learn.

    Every collected step of every environment owes `train_ratio` replayed steps; an update
    replays batch_size * batch_length. From the first chunk on after which replay can fill
    a batch with different sequences, the updates due run at once and the remainder is
    carried over, so that their number is exactly
    `floor(collected steps * train_ratio / (batch_size * batch_length))`.

    Metrics: counters `env_steps`, `updates` (so far), `chunk/updates`, sums over finished
    episodes `episode/*`, `env/nonfinite`, and means over this chunk's updates of the rest
    (NaN when there was none).
    """
    collect = make_collect(env, agent, config)
    learn = make_learn(agent, config)
    length, batch_steps = config.replay.batch_length, config.replay.batch_steps
    earned = config.collect_steps * config.num_envs * config.train_ratio

    def train_step(state: TrainState) -> tuple[TrainState, Metrics]:
        key, key_collect, key_learn = jax.random.split(state.key, 3)
        collector, buffer, collected = collect(
            state.learner.params, state.collector, state.replay, key_collect
        )
        ready = replay.num_starts(buffer, length + 1) >= batch_steps
        credit = state.credit + jnp.where(ready, earned, 0)
        due = credit // batch_steps
        learner, buffer, learned = learn(
            state.learner, buffer, key_learn, collector.env_steps, due
        )
        counters = {
            "env_steps": collector.env_steps,
            "updates": learner.step,
            "chunk/updates": due,
        }
        state = TrainState(
            learner=learner,
            collector=collector,
            replay=buffer,
            credit=credit - due * batch_steps,
            key=key,
        )
        return state, counters | collected | learned

    return train_step


def init(env: Environment, agent: Agent, config: Config, key: Key) -> TrainState:
    """The state before the first step: fresh parameters, environments and replay."""
    key, key_learner, key_env = jax.random.split(key, 3)
    env_state, timestep = env.reset(key_env)
    carry = agent.initial(config.num_envs)
    example = Trajectory(*timestep, action=carry.action)
    capacity = replay.capacity_per_env(
        config.replay.capacity,
        env.spec,
        env_steps=config.env_steps,
        collect_steps=config.collect_steps,
    )
    return TrainState(
        learner=init_learner(agent, config, key_learner),
        collector=Collector(
            env_state=env_state,
            timestep=timestep,
            carry=carry,
            env_steps=jnp.zeros((), jnp.int32),
            episode_return=jnp.zeros(config.num_envs),
            episode_length=jnp.zeros(config.num_envs, jnp.int32),
        ),
        replay=replay.init(example, carry.latent, capacity=capacity),
        credit=jnp.zeros((), jnp.int32),
        key=key,
    )


SEED_AXES = TrainState(
    learner=0,  # type: ignore[arg-type]
    collector=0,  # type: ignore[arg-type]
    replay=Replay(trajectory=0, latent=0, head=None, size=None),  # type: ignore[arg-type]
    credit=None,  # type: ignore[arg-type]
    key=0,  # type: ignore[arg-type]
)
"""Which leaves of a `TrainState` stack over seeds.

How full replay is and what is owed follow from the number of chunks alone. Shared, they
give the loop of updates one trip count; stacked, the loop would have to select between
the old and the new replay of every seed after every update."""


def over_seeds(init: Init, train_step: TrainStep) -> tuple[Init, TrainStep]:
    """`init` over keys `[S]` and `train_step` over its states, all seeds side by side."""
    return (
        jax.vmap(init, out_axes=SEED_AXES),
        jax.vmap(train_step, in_axes=(SEED_AXES,), out_axes=(SEED_AXES, 0)),
    )
