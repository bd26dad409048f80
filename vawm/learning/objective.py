"""The one loss that an update differentiates, in the order in which the data flows.

    1 explain the batch   2 maximum likelihood   3 value alignment      make_world_model_loss
      (VaGraM in the place of the KL: make_value_gradient_loss)
    4 imagine   5 returns and their scale                                       make_foresight
    6 critic and actor                                                     make_behaviour_loss

Losses are pure functions of the same `Params`; `vawm.learning.update` differentiates them, as
one sum or one after the other.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from vawm import losses
from vawm.agent import Agent
from vawm.agent.imagination import imagine
from vawm.config import Config
from vawm.losses import returns, transforms
from vawm.types import Array, Batch, Inference, Key, Latent, Metrics, Params, PyTree, Trajectory


def total(parts: Metrics) -> Array:
    """The sum of named scalars."""
    return jnp.sum(jnp.stack(list(parts.values())))


class Alignment(NamedTuple):
    """L_var at every state of a batch that was predicted, `[B, T]`."""

    loss: Array  # Eq. 4, both terms with their scales
    weight: Array  # Eq. 5
    kl: Array  # KL[V(s) || V(s~)] in nats, whatever the scales; no gradient


def make_value_alignment(agent: Agent, config: Config) -> Callable[..., Alignment]:
    """Build `value_alignment(critic_params, inference, latent_kl, step) -> Alignment`.

    The critic's parameters are stopped and the same for both latents; gradients reach the
    world model through the latents, or only through z where `deter_gradient` is "stop".
    """
    alignment = config.value_alignment
    adaptive = functools.partial(
        losses.value_alignment_weight, warmup_steps=alignment.warmup_steps
    )

    def weight_of(kl: Array, step: Array) -> Array:
        if alignment.weight == "off":
            return jnp.zeros_like(kl)
        if alignment.weight == "static":  # where the KL is 0 only the warm-up is left of Eq. 5
            return alignment.static_weight * adaptive(jnp.zeros_like(kl), step)
        return adaptive(kl, step)

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
        return Alignment(loss, weight_of(kl, step), value_kl)

    return value_alignment


def make_world_model_loss(agent: Agent, config: Config):
    """Eq. 2: prediction, dynamics and value alignment of a batch.

    Gradients reach the world model only. The state that the world model carries is returned as
    the batch leaves it.
    """
    model = config.world_model
    value_alignment = make_value_alignment(agent, config)
    reward_code = transforms.make_two_hot(model.bins, model.bin_spacing)
    discount = 1.0 if model.continue_target == "plain" else discount_of(config)
    of_batch = model.free_nats_of == "batch"
    dynamics_loss = losses.batch_dynamics_loss if of_batch else losses.dynamics_loss

    def entropy(logits: Array) -> Array:
        """Of z_t, in nats, summed over its categoricals."""
        mixed = transforms.unimix_logits(logits, model.unimix)
        return transforms.categorical_entropy(jax.lax.stop_gradient(mixed)).sum(-1)

    def loss_fn(
        params: Params, state: PyTree, slow_critic: PyTree, batch: Batch, key: Key, step: Array
    ) -> tuple[Array, tuple[Inference, PyTree, Metrics]]:
        # 1. Explain the batch: what is it, and what could have been predicted?
        explanation, state = agent.world_model.explain(params.world_model, state, key, batch)
        inference, predictions, targets = explanation
        # 2. Maximum likelihood, Eq. 3.
        prediction = losses.prediction_loss(
            predictions.obs,
            predictions.reward,
            predictions.cont,
            targets.obs,
            reward_code.encode(targets.reward),
            targets.is_terminal,
            bins=reward_code.bins,
            discount=discount,
        )
        dynamics, kl = dynamics_loss(
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
        if agent.latent_loss is not None:
            parts["loss/value_gradient"] = agent.latent_loss(
                params.critic, slow_critic, inference
            )
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
        return total(parts), (inference, state, metrics)

    return loss_fn


def discount_of(config: Config) -> float:
    """gamma."""
    return 1.0 - 1.0 / config.imagination.discount_horizon


class Foresight(NamedTuple):
    """H imagined steps from N states, `[H, N, ...]`, and what they promise."""

    latent: Latent  # that the actions left from
    action: Array  # [H, N, A]
    value_logits: Array  # [H, N, bins] of the online critic, the only field with a gradient
    returns: Array  # [H, N] lambda-returns, Eq. 7
    slow_target: Array  # [H, N] the slow critic's value, or the lambda-returns of its values
    advantage: Array  # [H, N] in units of the return scale, Eq. 8
    weight: Array  # [H, N] probability, by the continue head, of getting there; or 1


def read_discount(config: Config, logit: Array) -> Array:
    """gamma * P(continue) of a continue logit; or gamma where that is likely, else 0."""
    gamma, plain = discount_of(config), config.world_model.continue_target == "plain"
    if config.imagination.continuation == "threshold":
        # One half, or the logit of gamma / 2 where gamma is learned along.
        limit = 0.0 if plain else math.log(gamma / (2.0 - gamma))
        return gamma * (logit >= limit).astype(logit.dtype)
    return gamma * jax.nn.sigmoid(logit) if plain else jax.nn.sigmoid(logit)


def imagined_returns(config: Config, reward: Array, discount: Array, value: Array) -> Array:
    """Lambda-returns `[H, N]` from what arrived with s_0..s_H and the values there."""
    lambda_, arrived = config.imagination.lambda_, (reward[1:], discount[1:])
    if config.imagination.value_index == "current":
        return returns.lambda_returns(*arrived, value[:-1], value[-1], lambda_=lambda_)
    return returns.lambda_returns(*arrived, value[1:], lambda_=lambda_)


def make_foresight(agent: Agent, config: Config):
    """Build `foresight(params, state, slow_critic, scale, inference, contexts, key)`.

    It returns `(Foresight, scale, metrics)`. Imagined latents carry no gradient, neither do
    the rewards, the continuation and the values read from them. Imagination begins where
    `imagination.starts` says: at `inference`, or after the `contexts`, a `Batch`.
    """
    imagination, model = config.imagination, config.world_model
    reward_code = transforms.make_two_hot(model.bins, model.bin_spacing)
    actor, critic, world_model = agent.actor, agent.critic, agent.world_model
    horizon = imagination.horizon
    returns_of = functools.partial(imagined_returns, config)

    def begin(params: PyTree, state: PyTree, inference: Inference, contexts: PyTree, key: Key):
        if imagination.starts == "contexts":
            return world_model.follow(params, state, key, contexts, horizon=horizon)[1]
        assert world_model.starts is not None
        return world_model.starts(params, state, inference)

    def slow_target_of(params: PyTree, latent: Latent, reward: Array, discount: Array) -> Array:
        if config.critic.slow_target == "returns":
            value = critic.code.mean(critic.logits(params, latent))
            return returns_of(reward, discount, value)
        latent = jax.tree.map(lambda x: x[:-1], latent)
        return critic.code.mean(critic.logits(params, latent))

    def foresight(
        params: Params,
        state: PyTree,
        slow_critic: PyTree,
        scale_state: returns.ReturnScale,
        inference: Inference,
        contexts: PyTree,
        key: Key,
    ) -> tuple[Foresight, returns.ReturnScale, Metrics]:
        frozen = jax.lax.stop_gradient(params)
        key_starts, key_imagine = jax.random.split(key)
        # 4. Imagine H steps from every start.
        carry, start = begin(frozen.world_model, state, inference, contexts, key_starts)
        imagined = imagine(
            world_model,
            lambda latent: actor.policy(frozen.actor, latent),
            frozen.world_model,
            state,
            key_imagine,
            carry,
            start,
            horizon=horizon,
        )
        # 5. Lambda-returns and their scale, Eq. 7 and 9.
        predictions = world_model.predict(frozen.world_model, state, imagined.latent)
        reward = reward_code.mean(predictions.reward)
        discount = read_discount(config, predictions.cont)
        logits = critic.logits(params.critic, imagined.latent)
        value = critic.code.mean(jax.lax.stop_gradient(logits))
        target = returns_of(reward, discount, value)
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
        reach = losses.discount_weights(discount)[:-1]
        ahead = Foresight(
            latent=jax.tree.map(lambda x: x[:-1], imagined.latent),
            action=imagined.action,
            value_logits=logits[:-1],
            returns=target,
            slow_target=slow_target_of(slow_critic, imagined.latent, reward, discount),
            advantage=(target - value[:-1]) / scale,
            weight=reach if imagination.reach_weights else jnp.ones_like(reach),
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

    def critic_loss(logits: Array, slow_target: Array, target: Array) -> Array:
        return losses.critic_loss(
            logits,
            critic.code.encode(slow_target),
            critic.code.encode(target),
            bins=critic.code.bins,
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
            discount=discount_of(config),
            lambda_=config.imagination.lambda_,
        )
        if not critic_config.replay_gradient:
            latent = jax.lax.stop_gradient(latent)
        logits = critic.logits(params.critic, latent)[:, :-1]
        slow_logits = critic.logits(slow_critic, jax.lax.stop_gradient(latent))[:, :-1]
        slow_value = critic.code.mean(slow_logits)
        return (1.0 - steps.is_last[:, :-1]) * critic_loss(logits, slow_value, target)

    def loss_fn(
        params: Params,
        state: PyTree,
        slow_critic: PyTree,
        scale_state: returns.ReturnScale,
        batch: Batch,
        inference: Inference,
        contexts: PyTree,
        key: Key,
    ) -> tuple[Array, tuple[returns.ReturnScale, Metrics]]:
        ahead, scale_state, metrics = foresight(
            params, state, slow_critic, scale_state, inference, contexts, key
        )
        # 6. Critic and actor, Eq. 7 and 8; the critic also from replay.
        policy = actor.policy(params.actor, ahead.latent)
        log_prob, entropy = policy.log_prob(ahead.action), policy.entropy()
        actor_loss = losses.actor_loss(
            log_prob, entropy, ahead.advantage, entropy_scale=actor_config.entropy_scale
        )
        imagined_loss = critic_loss(ahead.value_logits, ahead.slow_target, ahead.returns)
        parts = {
            "loss/actor": actor_config.scale * ahead.weight * actor_loss,
            "loss/critic": critic_config.scale * ahead.weight * imagined_loss,
        }
        if critic_config.replay_scale:
            steps = jax.tree.map(lambda x: x[:, 1:], batch.trajectory)
            bootstrap = ahead.returns[0].reshape(steps.reward.shape)
            replayed_loss = replay_critic_loss(
                params, slow_critic, steps, inference.latent, bootstrap
            )
            parts["loss/replay_critic"] = critic_config.replay_scale * replayed_loss
        parts = {name: jnp.mean(part) for name, part in parts.items()}
        metrics = parts | metrics | {"policy/entropy": jnp.mean(entropy)}
        return total(parts), (scale_state, metrics)

    return loss_fn
