"""Imagination and its returns: steps 4 and 5 of an update."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from vawm import losses
from vawm.agent import Agent
from vawm.agent.imagination import imagine
from vawm.config import Config
from vawm.errors import InvalidInput
from vawm.learning.discount import read_discount
from vawm.learning.state import Learner
from vawm.losses import returns, transforms
from vawm.types import Array, Inference, Key, Latent, Metrics, Params, PyTree
from vawm.world_model.protocol import Imagination


class Foresight(NamedTuple):
    """H imagined steps from N states. Only `value_logits` has a gradient."""

    latent: Latent  # [H, N, ...] where the actions were taken
    action: Array  # [H, N, A]
    reward: Array  # [H, N] of each action, predicted
    value: Array  # [H + 1, N] the online critic's, the last one after the last action
    value_logits: Array  # [H, N, bins] of the online critic
    returns: Array  # [H, N] lambda-returns, Eq. 7
    slow_target: Array  # [H, N] the slow critic's value, or the lambda-returns of its values
    advantage: Array  # [H, N] in units of `scale`, Eq. 8
    weight: Array  # [H, N] probability of getting there, by the continue head; or 1
    scale: Array  # [] S, Eq. 9
    return_scale: returns.ReturnScale  # the averages behind S, updated by these returns


def make_foresight(
    agent: Agent, config: Config
) -> Callable[[Params, Learner, Inference, PyTree, Key], Foresight]:
    """Build `foresight(params, learner, inference, contexts, key) -> Foresight`.

    Imagination starts as `imagination.starts` says: at every state of `inference`, or after
    the `contexts`, a `Batch`. It uses the learner's `model_state`, slow critic and return
    scale. Imagined latents carry no gradient, and neither do the rewards, the continuation and
    the values that are read from them; only the logits of the online critic do.

    Raises:
      InvalidInput: the world model cannot start at inferred states, but should.
    """
    imagination, model = config.imagination, config.world_model
    reward_code = transforms.make_two_hot(model.bins, model.bin_spacing)
    actor, critic, world_model = agent.actor, agent.critic, agent.world_model
    begin = make_begin(agent, config)

    def slow_target_of(
        slow_critic: PyTree, latent: Latent, reward: Array, discount: Array
    ) -> Array:
        if config.critic.slow_target == "returns":
            value = critic.code.mean(critic.logits(slow_critic, latent))
            return imagined_returns(config, reward, discount, value)
        return critic.code.mean(critic.logits(slow_critic, all_but_last(latent)))

    def foresight(
        params: Params, learner: Learner, inference: Inference, contexts: PyTree, key: Key
    ) -> Foresight:
        frozen = jax.lax.stop_gradient(params)
        model_state = learner.model_state
        key_starts, key_imagine = jax.random.split(key)
        # 4. Imagine H steps from every start.
        carry, start = begin(frozen.world_model, model_state, inference, contexts, key_starts)
        imagined = imagine(
            world_model,
            lambda latent: actor.policy(frozen.actor, latent),
            frozen.world_model,
            model_state,
            key_imagine,
            carry,
            start,
            horizon=imagination.horizon,
        )
        # 5. Lambda-returns and their scale, Eq. 7 and 9.
        predictions = world_model.predict(frozen.world_model, model_state, imagined.latent)
        reward = reward_code.mean(predictions.reward)
        discount = read_discount(config, predictions.cont)
        logits = critic.logits(params.critic, imagined.latent)
        value = critic.code.mean(jax.lax.stop_gradient(logits))
        target = imagined_returns(config, reward, discount, value)
        return_scale = returns.update_return_scale(
            learner.return_scale,
            target,
            decay=imagination.return_scale_decay,
            low=imagination.return_scale_low,
            high=imagination.return_scale_high,
        )
        scale = returns.return_scale(return_scale, limit=imagination.return_scale_limit)
        reach = losses.discount_weights(discount)[:-1]
        return Foresight(
            latent=all_but_last(imagined.latent),
            action=imagined.action,
            reward=reward[1:],
            value=value,
            value_logits=logits[:-1],
            returns=target,
            slow_target=slow_target_of(learner.slow_critic, imagined.latent, reward, discount),
            advantage=(target - value[:-1]) / scale,
            weight=reach if imagination.reach_weights else jnp.ones_like(reach),
            scale=scale,
            return_scale=return_scale,
        )

    return foresight


def make_begin(
    agent: Agent, config: Config
) -> Callable[[PyTree, PyTree, Inference, PyTree, Key], Imagination]:
    """Build `begin(params, model_state, inference, contexts, key) -> Imagination`."""
    world_model, imagination = agent.world_model, config.imagination
    starts = world_model.starts

    def after_contexts(params, model_state, inference, contexts, key) -> Imagination:
        del inference
        horizon = imagination.horizon
        return world_model.follow(params, model_state, key, contexts, horizon=horizon)[1]

    if imagination.starts == "contexts":
        return after_contexts
    if starts is None:
        remedy = "use contexts: this world model cannot start at the states of a batch"
        raise InvalidInput("imagination.starts", imagination.starts, remedy)

    def at_inferred_states(params, model_state, inference, contexts, key) -> Imagination:
        del contexts, key
        return starts(params, model_state, inference)

    return at_inferred_states


def imagined_returns(config: Config, reward: Array, discount: Array, value: Array) -> Array:
    """Lambda-returns `[H, N]` from what arrived with s_0..s_H and the values there."""
    lambda_ = config.imagination.lambda_
    reward, discount = reward[1:], discount[1:]
    if config.imagination.value_index == "current":
        return returns.lambda_returns(reward, discount, value[:-1], value[-1], lambda_=lambda_)
    return returns.lambda_returns(reward, discount, value[1:], lambda_=lambda_)


def all_but_last(latent: Latent) -> Latent:
    """`[H + 1, ...]` -> `[H, ...]`."""
    return jax.tree.map(lambda x: x[:-1], latent)


def imagination_metrics(ahead: Foresight) -> Metrics:
    """Means over all imagined steps, and S of Eq. 9."""
    return {
        "imagination/reward": jnp.mean(ahead.reward),
        "imagination/return": jnp.mean(ahead.returns),
        "imagination/value": jnp.mean(ahead.value),
        "imagination/return_scale": ahead.scale,
    }
