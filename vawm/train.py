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

from vawm import losses, optim, replay, returns, transforms
from vawm.agent import Agent, PolicyCarry
from vawm.config import Config
from vawm.envs.protocol import Environment
from vawm.imagination import imagine
from vawm.replay import Replay
from vawm.types import (
    Array,
    Inference,
    Key,
    Latent,
    Metrics,
    Params,
    PyTree,
    TimeStep,
    Trajectory,
)


class Batch(NamedTuple):
    """Replayed experience: T + 1 steps, the first of which only gives context."""

    trajectory: Trajectory  # [B, T + 1, ...]
    context: Latent  # [B, ...] the stored latent of step 0


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
Collect = Callable[[Params, Collector, Replay, Key], tuple[Collector, Replay, Metrics]]
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
            params, learner, batch, inference, key_behaviour
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
        metrics["optimizer/gradient_norm"] = optax.global_norm(gradient)
        metrics["optimizer/update_norm"] = optax.global_norm(updates)
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


def make_world_model_loss(agent: Agent, config: Config):
    """Eq. 2: prediction, dynamics and value alignment of a batch.

    Gradients reach the world model only; L_var reads the critic with its parameters
    stopped, the same parameters for both latents.
    """
    model, alignment = config.world_model, config.value_alignment
    reward_bins = transforms.symexp_bins(model.bins)
    discount = 1.0 - 1.0 / config.imagination.discount_horizon

    def value_alignment(
        params: Params, slow_critic: PyTree, inference: Inference, kl: Array, step: Array
    ) -> tuple[Array, Array]:
        critic = params.critic if alignment.critic == "online" else slow_critic
        critic = jax.lax.stop_gradient(critic)
        latent, prior_latent = inference.latent, inference.prior_latent
        if alignment.deter_gradient == "stop":
            deter = jax.lax.stop_gradient(latent.deter)
            latent = latent._replace(deter=deter)
            prior_latent = prior_latent._replace(deter=deter)
        loss = losses.value_alignment_loss(
            agent.critic.logits(critic, latent),
            agent.critic.logits(critic, prior_latent),
            dynamics_scale=alignment.dynamics_scale,
            representation_scale=alignment.representation_scale,
        )
        weight = alignment_weight(kl, step)
        return loss * inference.has_prior, weight * inference.has_prior

    def alignment_weight(kl: Array, step: Array) -> Array:
        if alignment.weight == "off":
            return jnp.zeros_like(kl)
        if alignment.weight == "static":
            gate = (step > alignment.warmup_steps).astype(kl.dtype)
            return jnp.full_like(kl, alignment.static_weight) * gate
        return losses.value_alignment_weight(kl, step, warmup_steps=alignment.warmup_steps)

    def loss_fn(params: Params, slow_critic: PyTree, batch: Batch, key: Key, step: Array):
        steps = jax.tree.map(lambda x: x[:, 1:], batch.trajectory)
        prev_action = batch.trajectory.action[:, :-1]
        # 1. Explain the batch: what is it, and what could have been predicted?
        _, inference = agent.world_model.observe(
            params.world_model,
            key,
            batch.context,
            steps.obs,
            prev_action,
            steps.is_first,
            train=True,
        )
        predictions = agent.world_model.predict(params.world_model, inference.latent)
        # 2. Maximum likelihood, Eq. 3.
        prediction = losses.prediction_loss(
            predictions.obs,
            predictions.reward,
            predictions.cont,
            steps.obs,
            steps.reward,
            steps.is_terminal,
            bins=reward_bins,
            discount=discount,
        )
        dynamics, kl = losses.dynamics_loss(
            inference.post_logits,
            inference.prior_logits,
            unimix=model.unimix,
            free_nats=model.free_nats,
            dynamics_scale=model.dynamics_scale,
            representation_scale=model.representation_scale,
        )
        # 3. Value alignment, Eq. 4 and 5.
        aligned, weight = value_alignment(params, slow_critic, inference, kl, step)
        parts = {
            "loss/reconstruction": model.reconstruction_scale * prediction.reconstruction,
            "loss/reward": prediction.reward,
            "loss/continue": prediction.cont,
            "loss/dynamics": dynamics,
            "loss/value_alignment": weight * aligned,
        }
        parts = {name: jnp.mean(part) for name, part in parts.items()}
        metrics = parts | {
            "value_alignment/loss": jnp.mean(aligned),
            "value_alignment/weight": jnp.mean(weight),
            "latent/kl": jnp.mean(kl),
        }
        return sum(parts.values()), inference, metrics

    return loss_fn


def make_behaviour_loss(agent: Agent, config: Config):
    """Eq. 7 and 8: critic and actor from imagination, critic from replay.

    Imagined latents carry no gradient; the replay value loss reaches the world model
    unless `critic.replay_gradient` is off.
    """
    imagination, critic_config = config.imagination, config.critic
    discount = 1.0 - 1.0 / imagination.discount_horizon
    reward_bins = transforms.symexp_bins(config.world_model.bins)
    actor, critic, world_model = agent.actor, agent.critic, agent.world_model

    def critic_loss(logits: Array, slow_logits: Array, target: Array) -> Array:
        return losses.critic_loss(
            logits,
            critic.mean(slow_logits),
            target,
            bins=critic.bins,
            slow_scale=critic_config.slow_scale,
        )

    def loss_fn(params: Params, learner: Learner, batch: Batch, inference: Inference, key: Key):
        frozen = jax.lax.stop_gradient(params)
        steps = jax.tree.map(lambda x: x[:, 1:], batch.trajectory)
        key_starts, key_imagine = jax.random.split(key)
        # 4. Imagine H steps from every state of the batch.
        carry, start = world_model.starts(
            frozen.world_model, key_starts, batch.trajectory, inference
        )
        imagined = imagine(
            world_model,
            lambda latent: actor.policy(frozen.actor, latent),
            frozen.world_model,
            key_imagine,
            carry,
            start,
            horizon=imagination.horizon,
        )
        # 5. Lambda-returns and their scale, Eq. 7 and 9.
        predictions = world_model.predict(frozen.world_model, imagined.latent)
        reward = transforms.two_hot_mean(predictions.reward, reward_bins)
        cont = jax.nn.sigmoid(predictions.cont)
        logits = critic.logits(params.critic, imagined.latent)
        value = critic.mean(jax.lax.stop_gradient(logits))
        weight = losses.discount_weights(cont)[:-1]
        target = returns.lambda_returns(
            reward[1:], cont[1:], value[1:], lambda_=imagination.lambda_
        )
        scale_state = returns.update_return_scale(
            learner.return_scale,
            target,
            decay=imagination.return_scale_decay,
            low=imagination.return_scale_low,
            high=imagination.return_scale_high,
        )
        scale = returns.return_scale(scale_state, limit=imagination.return_scale_limit)
        advantage = (target - value[:-1]) / scale
        # 6. Critic and actor, Eq. 7 and 8; the critic also from replay.
        before_last = jax.tree.map(lambda x: x[:-1], imagined.latent)
        slow_logits = critic.logits(learner.slow_critic, before_last)
        policy = actor.policy(params.actor, before_last)
        entropy = policy.entropy()
        replay_latent = inference.latent
        if not critic_config.replay_gradient:
            replay_latent = jax.lax.stop_gradient(replay_latent)
        replay_target = returns.replay_returns(
            steps.reward,
            steps.is_last,
            steps.is_terminal,
            target[0].reshape(steps.reward.shape),
            discount=discount,
            lambda_=imagination.lambda_,
        )
        replay_loss = critic_loss(
            critic.logits(params.critic, replay_latent)[:, :-1],
            critic.logits(learner.slow_critic, jax.lax.stop_gradient(replay_latent))[:, :-1],
            replay_target,
        )
        parts = {
            "loss/actor": config.actor.scale
            * weight
            * losses.actor_loss(
                policy.log_prob(imagined.action),
                entropy,
                advantage,
                entropy_scale=config.actor.entropy_scale,
            ),
            "loss/critic": critic_config.scale
            * weight
            * critic_loss(logits[:-1], slow_logits, target),
            "loss/replay_critic": critic_config.replay_scale
            * (1.0 - steps.is_last[:, :-1])
            * replay_loss,
        }
        parts = {name: jnp.mean(part) for name, part in parts.items()}
        metrics = parts | {
            "policy/entropy": jnp.mean(entropy),
            "imagination/reward": jnp.mean(reward[1:]),
            "imagination/return": jnp.mean(target),
            "imagination/value": jnp.mean(value),
            "imagination/return_scale": scale,
        }
        return sum(parts.values()), scale_state, metrics

    return loss_fn


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
            "env/nonfinite": jnp.sum(cut_short(timestep, episode_length)),
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

    def cut_short(timestep: TimeStep, length: Array) -> Array:
        """Where an episode ended early without a terminal state: the physics failed."""
        if env.spec.episode_length is None:
            return jnp.zeros_like(timestep.is_last)
        return timestep.is_last & ~timestep.is_terminal & (length < env.spec.episode_length)

    def collect(params: Params, collector: Collector, buffer: Replay, key: Key):
        keys = jax.random.split(key, config.collect_steps)
        collector, (stored, metrics) = jax.lax.scan(
            lambda c, k: step(params, c, k), collector, keys
        )
        trajectory, latent = jax.tree.map(lambda x: x.swapaxes(0, 1), stored)
        buffer = replay.add(buffer, trajectory, latent)
        return collector, buffer, jax.tree.map(jnp.sum, metrics)

    return collect


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
    update = jax.jit(make_update(agent, config))  # traced once, though its shapes are asked for
    size, length = config.replay.batch_size, config.replay.batch_length
    earned = config.collect_steps * config.num_envs * config.train_ratio
    classes = config.world_model.classes

    def draw(buffer: Replay, key: Key) -> tuple[Batch, replay.Positions]:
        trajectory, context, positions = replay.sample(
            buffer, key, batch_size=size, length=length + 1, classes=classes
        )
        return Batch(trajectory, context), positions._replace(time=positions.time[:, 1:])

    def learn(learner: Learner, buffer: Replay, key: Key, env_steps: Array, due: Array):
        keys = jax.random.split(key, 2)
        _, _, shapes = jax.eval_shape(
            update, learner, jax.eval_shape(draw, buffer, key)[0], key, env_steps
        )
        sums = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), shapes)

        def one_update(i: Array, state: tuple[Learner, Replay, Metrics]):
            learner, buffer, sums = state
            key_draw, key_update = (jax.random.fold_in(k, i) for k in keys)
            batch, positions = draw(buffer, key_draw)
            learner, latent, metrics = update(learner, batch, key_update, env_steps)
            buffer = replay.write_back(buffer, positions, latent)
            return learner, buffer, jax.tree.map(jnp.add, sums, metrics)

        learner, buffer, sums = jax.lax.fori_loop(0, due, one_update, (learner, buffer, sums))
        return learner, buffer, jax.tree.map(lambda x: x / due, sums)

    def train_step(state: TrainState) -> tuple[TrainState, Metrics]:
        key, key_collect, key_learn = jax.random.split(state.key, 3)
        collector, buffer, metrics = collect(
            state.learner.params, state.collector, state.replay, key_collect
        )
        ready = replay.num_starts(buffer, length + 1) >= size * length
        credit = state.credit + jnp.where(ready, earned, 0)
        due = credit // (size * length)
        learner, buffer, means = learn(
            state.learner, buffer, key_learn, collector.env_steps, due
        )
        metrics |= means
        metrics |= {
            "env_steps": collector.env_steps,
            "updates": learner.step,
            "chunk/updates": due,
        }
        state = TrainState(
            learner=learner,
            collector=collector,
            replay=buffer,
            credit=credit - due * size * length,
            key=key,
        )
        return state, metrics

    return train_step


def init(env: Environment, agent: Agent, config: Config, key: Key) -> TrainState:
    """The state before the first step: fresh parameters, environments and replay."""
    key, key_learner, key_env = jax.random.split(key, 3)
    env_state, timestep = env.reset(key_env)
    carry = agent.initial(config.num_envs)
    example = Trajectory(*timestep, action=carry.action)
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
        replay=replay.init(
            example, carry.latent, capacity=replay.capacity_per_env(config)
        ),
        credit=jnp.zeros((), jnp.int32),
        key=key,
    )
