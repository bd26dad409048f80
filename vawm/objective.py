"""The one loss that an update differentiates, in the order in which the data flows.

    1 explain the batch   2 maximum likelihood   3 value alignment      make_world_model_loss
    4 imagine   5 returns and their scale                                       make_foresight
    6 critic and actor                                                     make_behaviour_loss

Losses are pure functions of the same `Params`; their sum is the loss of `vawm.train`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from vawm import losses, returns, transforms
from vawm.agent import Agent
from vawm.config import Config
from vawm.imagination import imagine
from vawm.types import Array, Inference, Key, Latent, Metrics, Params, PyTree, Trajectory


class Batch(NamedTuple):
    """Replayed experience: T + 1 steps, the first of which only gives context."""

    trajectory: Trajectory  # [B, T + 1, ...]
    context: Latent  # [B, ...] the stored latent of step 0


def total(parts: Metrics) -> Array:
    """The sum of named scalars."""
    return jnp.sum(jnp.stack(list(parts.values())))


class Alignment(NamedTuple):
    """L_var at every state of a batch, `[B, T]`; 0 where nothing was predicted."""

    loss: Array  # Eq. 4, both terms with their scales
    weight: Array  # Eq. 5
    kl: Array  # KL[V(s) || V(s~)] in nats, whatever the scales; no gradient


def make_value_alignment(agent: Agent, config: Config) -> Callable[..., Alignment]:
    """Build `value_alignment(critic_params, inference, latent_kl, step) -> Alignment`.

    The critic's parameters are stopped and the same for both latents; gradients reach the
    world model through the latents, or only through z where `deter_gradient` is "stop".
    """
    alignment = config.value_alignment

    def weight_of(kl: Array, step: Array) -> Array:
        if alignment.weight == "off":
            return jnp.zeros_like(kl)
        if alignment.weight == "static":
            gate = (step > alignment.warmup_steps).astype(kl.dtype)
            return jnp.full_like(kl, alignment.static_weight) * gate
        return losses.value_alignment_weight(kl, step, warmup_steps=alignment.warmup_steps)

    def value_alignment(
        critic: PyTree, inference: Inference, kl: Array, step: Array
    ) -> Alignment:
        critic = jax.lax.stop_gradient(critic)
        if alignment.weight == "off":  # no backward pass either
            inference = jax.lax.stop_gradient(inference)
        latent, prior_latent = inference.latent, inference.prior_latent
        if alignment.deter_gradient == "stop":
            deter = jax.lax.stop_gradient(latent.deter)
            latent = latent._replace(deter=deter)
            prior_latent = prior_latent._replace(deter=deter)
        logits = agent.critic.logits(critic, latent)
        prior_logits = agent.critic.logits(critic, prior_latent)
        loss = losses.value_alignment_loss(
            logits,
            prior_logits,
            dynamics_scale=alignment.dynamics_scale,
            representation_scale=alignment.representation_scale,
        )
        value_kl = transforms.categorical_kl(*jax.lax.stop_gradient((logits, prior_logits)))
        parts = Alignment(loss, weight_of(kl, step), value_kl)
        return jax.tree.map(lambda part: part * inference.has_prior, parts)

    return value_alignment


def make_world_model_loss(agent: Agent, config: Config):
    """Eq. 2: prediction, dynamics and value alignment of a batch.

    Gradients reach the world model only.
    """
    model = config.world_model
    value_alignment = make_value_alignment(agent, config)
    reward_bins = transforms.symexp_bins(model.bins)
    discount = 1.0 - 1.0 / config.imagination.discount_horizon

    def entropy(logits: Array) -> Array:
        """Of z_t, in nats, summed over its categoricals."""
        mixed = transforms.unimix_logits(logits, model.unimix)
        return transforms.categorical_entropy(jax.lax.stop_gradient(mixed)).sum(-1)

    def loss_fn(
        params: Params, slow_critic: PyTree, batch: Batch, key: Key, step: Array
    ) -> tuple[Array, Inference, Metrics]:
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
        slow = config.value_alignment.critic == "slow"
        critic = slow_critic if slow else params.critic
        aligned = value_alignment(critic, inference, kl, step)
        parts = {
            "loss/reconstruction": model.reconstruction_scale * prediction.reconstruction,
            "loss/reward": prediction.reward,
            "loss/continue": prediction.cont,
            "loss/dynamics": dynamics,
        }
        parts = {name: jnp.mean(part) for name, part in parts.items()}
        loss_var = {"loss/value_alignment": jnp.mean(aligned.weight * aligned.loss)}
        if config.value_alignment.weight != "off":
            parts |= loss_var
        metrics = parts | loss_var
        metrics |= {
            "value_alignment/loss": jnp.mean(aligned.loss),
            "value_alignment/weight": jnp.mean(aligned.weight),
            "value_alignment/kl": jnp.mean(aligned.kl),
            "latent/kl": jnp.mean(kl),
            "latent/posterior_entropy": jnp.mean(entropy(inference.post_logits)),
            "latent/prior_entropy": jnp.mean(entropy(inference.prior_logits)),
        }
        return total(parts), inference, metrics

    return loss_fn


class Foresight(NamedTuple):
    """H imagined steps from every state of a batch, `[H, N, ...]`, and what they promise."""

    latent: Latent  # that the actions left from
    action: Array  # [H, N, A]
    value_logits: Array  # [H, N, bins] of the online critic, the only field with a gradient
    returns: Array  # [H, N] lambda-returns, Eq. 7
    advantage: Array  # [H, N] in units of the return scale, Eq. 8
    weight: Array  # [H, N] probability, by the continue head, of getting there


def make_foresight(agent: Agent, config: Config):
    """Build `foresight(params, scale, batch, inference, key) -> (Foresight, scale, metrics)`.

    Imagined latents carry no gradient, neither do the rewards, the continuation and the
    values read from them.
    """
    imagination = config.imagination
    reward_bins = transforms.symexp_bins(config.world_model.bins)
    actor, critic, world_model = agent.actor, agent.critic, agent.world_model

    def foresight(
        params: Params,
        scale_state: returns.ReturnScale,
        batch: Batch,
        inference: Inference,
        key: Key,
    ) -> tuple[Foresight, returns.ReturnScale, Metrics]:
        frozen = jax.lax.stop_gradient(params)
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
        target = returns.lambda_returns(
            reward[1:], cont[1:], value[1:], lambda_=imagination.lambda_
        )
        scale_state = returns.update_return_scale(
            scale_state,
            target,
            decay=imagination.return_scale_decay,
            low=imagination.return_scale_low,
            high=imagination.return_scale_high,
        )
        scale = returns.return_scale(scale_state, limit=imagination.return_scale_limit)
        metrics = {
            "imagination/reward": jnp.mean(reward[1:]),
            "imagination/return": jnp.mean(target),
            "imagination/value": jnp.mean(value),
            "imagination/return_scale": scale,
        }
        ahead = Foresight(
            latent=jax.tree.map(lambda x: x[:-1], imagined.latent),
            action=imagined.action[:-1],
            value_logits=logits[:-1],
            returns=target,
            advantage=(target - value[:-1]) / scale,
            weight=losses.discount_weights(cont)[:-1],
        )
        return ahead, scale_state, metrics

    return foresight


def make_behaviour_loss(agent: Agent, config: Config):
    """Eq. 7 and 8: critic and actor from imagination, critic from replay.

    Imagined latents carry no gradient; the replay value loss reaches the world model
    unless `critic.replay_gradient` is off.
    """
    actor_config, critic_config = config.actor, config.critic
    actor, critic = agent.actor, agent.critic
    foresight = make_foresight(agent, config)

    def critic_loss(logits: Array, slow_logits: Array, target: Array) -> Array:
        return losses.critic_loss(
            logits,
            critic.mean(slow_logits),
            target,
            bins=critic.bins,
            slow_scale=critic_config.slow_scale,
        )

    def replay_critic_loss(
        params: Params, slow_critic: PyTree, steps: Trajectory, latent: Latent, bootstrap: Array
    ) -> Array:
        """Of the batch's own steps, `[B, T - 1]`, with imagined returns at the end."""
        target = returns.replay_returns(
            steps.reward,
            steps.is_last,
            steps.is_terminal,
            bootstrap,
            discount=1.0 - 1.0 / config.imagination.discount_horizon,
            lambda_=config.imagination.lambda_,
        )
        if not critic_config.replay_gradient:
            latent = jax.lax.stop_gradient(latent)
        logits = critic.logits(params.critic, latent)[:, :-1]
        slow_logits = critic.logits(slow_critic, jax.lax.stop_gradient(latent))[:, :-1]
        return (1.0 - steps.is_last[:, :-1]) * critic_loss(logits, slow_logits, target)

    def loss_fn(
        params: Params,
        slow_critic: PyTree,
        scale_state: returns.ReturnScale,
        batch: Batch,
        inference: Inference,
        key: Key,
    ) -> tuple[Array, returns.ReturnScale, Metrics]:
        ahead, scale_state, metrics = foresight(params, scale_state, batch, inference, key)
        # 6. Critic and actor, Eq. 7 and 8; the critic also from replay.
        policy = actor.policy(params.actor, ahead.latent)
        log_prob, entropy = policy.log_prob(ahead.action), policy.entropy()
        actor_loss = losses.actor_loss(
            log_prob, entropy, ahead.advantage, entropy_scale=actor_config.entropy_scale
        )
        slow_logits = critic.logits(slow_critic, ahead.latent)
        imagined_loss = critic_loss(ahead.value_logits, slow_logits, ahead.returns)
        steps = jax.tree.map(lambda x: x[:, 1:], batch.trajectory)
        bootstrap = ahead.returns[0].reshape(steps.reward.shape)
        replayed_loss = replay_critic_loss(
            params, slow_critic, steps, inference.latent, bootstrap
        )
        parts = {
            "loss/actor": actor_config.scale * ahead.weight * actor_loss,
            "loss/critic": critic_config.scale * ahead.weight * imagined_loss,
            "loss/replay_critic": critic_config.replay_scale * replayed_loss,
        }
        parts = {name: jnp.mean(part) for name, part in parts.items()}
        metrics = parts | metrics | {"policy/entropy": jnp.mean(entropy)}
        return total(parts), scale_state, metrics

    return loss_fn
