"""The two losses of an update, in the order in which the data flows.

    1. Explain the batch with the world model
    2. Maximum likelihood, Eq. 3                `vawm.learning.likelihood`
    3. Value alignment, Eq. 4 and 5             `vawm.learning.alignment`
                                                      make_world_model_loss
    4. Imagine
    5. Returns and their scale, Eq. 7 and 9     `vawm.learning.foresight`
    6. Actor and critic, Eq. 7 and 8
                                                      make_behaviour_loss

Both are pure functions of the same `Params`. `vawm.learning.update` differentiates them: their
sum, or one after the other.
"""

from __future__ import annotations

from collections.abc import Callable, Collection
from typing import NamedTuple

import jax
import jax.numpy as jnp

from vawm import losses
from vawm.agent import Agent
from vawm.config import Config
from vawm.errors import InvalidInput
from vawm.learning.alignment import alignment_metrics, make_value_alignment, warmup_step
from vawm.learning.discount import discount_of
from vawm.learning.foresight import Foresight, imagination_metrics, make_foresight
from vawm.learning.likelihood import latent_metrics, make_likelihood
from vawm.learning.state import Learner
from vawm.losses import returns
from vawm.types import (
    Array,
    Batch,
    Inference,
    Key,
    Latent,
    Metrics,
    Params,
    PyTree,
)


class Explained(NamedTuple):
    """What the world model's loss leaves for the rest of an update."""

    inference: Inference
    model_state: PyTree  # after the batch
    metrics: Metrics


class Behaved(NamedTuple):
    """What the loss of actor and critic leaves for the rest of an update."""

    return_scale: returns.ReturnScale  # after these returns
    metrics: Metrics


NAMES = {
    "reconstruction",
    "reward",
    "continue",
    "dynamics",
    "value_alignment",
    "actor",
    "critic",
    "replay_critic",
    "total",
}
"""Our own losses. A further loss of a world model needs another name."""

WorldModelLoss = Callable[[Params, Learner, Batch, Key, Array], tuple[Array, Explained]]
BehaviourLoss = Callable[
    [Params, Learner, Batch, Inference, PyTree, Key], tuple[Array, Behaved]
]


def make_world_model_loss(agent: Agent, config: Config) -> WorldModelLoss:
    """Build `world_model_loss(params, learner, batch, key, env_steps) -> (loss, Explained)`.

    Eq. 2: prediction, dynamics and value alignment of a batch; and the further losses that a
    world model or an agent has. Gradients reach the world model only. Of the learner it uses
    `model_state`, the slow critic and the number of updates.

    Raises:
      InvalidInput: in the first call, when a further loss has the name of one of ours.
    """
    likelihood = make_likelihood(config)
    value_alignment = make_value_alignment(agent, config)
    slow = config.value_alignment.critic == "slow"
    only_logged = {"value_alignment"} if config.value_alignment.weight == "off" else set()

    def world_model_loss(
        params: Params, learner: Learner, batch: Batch, key: Key, env_steps: Array
    ) -> tuple[Array, Explained]:
        # 1. Explain the batch: what is it, and what could have been predicted?
        explanation, model_state = agent.world_model.explain(
            params.world_model, learner.model_state, key, batch
        )
        inference = explanation.inference
        # 2. Maximum likelihood, Eq. 3.
        likely = likelihood(explanation)
        # 3. Value alignment, Eq. 4 and 5.
        critic = learner.slow_critic if slow else params.critic
        step = warmup_step(config, learner, env_steps)
        aligned = value_alignment(critic, inference, likely.kl, step)

        # And what this world model or this agent has besides.
        further = explanation.losses
        if agent.latent_losses is not None:
            of_latents = agent.latent_losses(params.critic, learner.slow_critic, inference)
            further = joined(further, of_latents)
        parts = joined(likely.losses, further)
        parts = mean_of_each(parts | {"value_alignment": aligned.weight * aligned.loss})
        metrics = alignment_metrics(aligned) | latent_metrics(
            config.world_model, inference, likely.kl
        )
        explained = Explained(inference, model_state, loss_metrics(parts) | metrics)
        return total(parts, only_logged), explained

    return world_model_loss


def joined(parts: dict[str, Array], further: dict[str, Array]) -> dict[str, Array]:
    """`parts` and further losses; refuses a name that is taken."""
    for name in further:
        if name in NAMES or name in parts:
            raise InvalidInput("loss", name, "is taken; use another name")
    return parts | further


def make_behaviour_loss(agent: Agent, config: Config) -> BehaviourLoss:
    """Build `behaviour_loss(params, learner, batch, inference, contexts, key)`.

    It returns `(loss, Behaved)`. Eq. 7 and 8: actor and critic from imagination, critic from
    replay. Imagined latents carry no gradient; the critic's loss in replay reaches the world
    model through `inference`, unless `critic.replay_gradient` is off. Of the learner it uses
    `model_state`, the slow critic and the return scale.
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
        params: Params, learner: Learner, batch: Batch, latent: Latent, ahead: Foresight
    ) -> Array:
        """`[B, T - 1]`: along the batch itself, imagined returns at its end."""
        steps = jax.tree.map(lambda x: x[:, 1:], batch.trajectory)
        target = returns.replay_returns(
            steps.reward,
            steps.is_last,
            steps.is_terminal,
            ahead.returns[0].reshape(steps.reward.shape),
            discount=discount_of(config),
            lambda_=config.imagination.lambda_,
        )
        if not critic_config.replay_gradient:
            latent = jax.lax.stop_gradient(latent)
        logits = critic.logits(params.critic, latent)[:, :-1]
        slow_logits = critic.logits(learner.slow_critic, jax.lax.stop_gradient(latent))[:, :-1]
        slow_value = critic.code.mean(slow_logits)
        goes_on = 1.0 - steps.is_last[:, :-1].astype(jnp.float32)
        return goes_on * critic_loss(logits, slow_value, target)

    def behaviour_loss(
        params: Params,
        learner: Learner,
        batch: Batch,
        inference: Inference,
        contexts: PyTree,
        key: Key,
    ) -> tuple[Array, Behaved]:
        # 4. and 5. Imagine, and judge what was imagined, Eq. 7 and 9.
        ahead = foresight(params, learner, inference, contexts, key)
        # 6. Actor and critic, Eq. 7 and 8; the critic also from replay.
        policy = actor.policy(params.actor, ahead.latent)
        log_prob, entropy = policy.log_prob(ahead.action), policy.entropy()
        actor_loss = losses.actor_loss(
            log_prob, entropy, ahead.advantage, entropy_scale=actor_config.entropy_scale
        )
        imagined_loss = critic_loss(ahead.value_logits, ahead.slow_target, ahead.returns)
        parts = {
            "actor": actor_config.scale * ahead.weight * actor_loss,
            "critic": critic_config.scale * ahead.weight * imagined_loss,
        }
        if critic_config.replay_scale > 0:
            replayed_loss = replay_critic_loss(params, learner, batch, inference.latent, ahead)
            parts["replay_critic"] = critic_config.replay_scale * replayed_loss

        parts = mean_of_each(parts)
        metrics = imagination_metrics(ahead) | {"policy/entropy": jnp.mean(entropy)}
        return total(parts), Behaved(ahead.return_scale, loss_metrics(parts) | metrics)

    return behaviour_loss


def mean_of_each(parts: dict[str, Array]) -> dict[str, Array]:
    """Losses of any shape -> their means, `[]`."""
    return {name: jnp.mean(part) for name, part in parts.items()}


def total(parts: dict[str, Array], only_logged: Collection[str] = ()) -> Array:
    """The sum of named scalars, without those that are only logged."""
    return jnp.sum(jnp.stack([x for name, x in parts.items() if name not in only_logged]))


def loss_metrics(parts: dict[str, Array]) -> Metrics:
    """Named losses as metrics."""
    return {f"loss/{name}": part for name, part in parts.items()}
