"""Value alignment of a batch, Eq. 4, with its weight, Eq. 5."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from vawm import losses
from vawm.agent import Agent
from vawm.config import Config
from vawm.learning.state import Learner
from vawm.losses import transforms
from vawm.types import Array, Inference, Metrics, PyTree


class Alignment(NamedTuple):
    """L_var at every state of a batch that was predicted, `[B, T]`."""

    loss: Array  # Eq. 4, both terms with their scales
    weight: Array  # Eq. 5
    kl: Array  # KL[V(s) || V(s~)] in nats, whatever the scales; no gradient


def make_value_alignment(
    agent: Agent, config: Config
) -> Callable[[PyTree, Inference, Array, Array], Alignment]:
    """Build `value_alignment(critic_params, inference, latent_kl, step) -> Alignment`.

    Both latents are judged by the same critic, whose parameters are stopped. Gradients reach
    the world model through the latents, or through z alone if `deter_gradient` is "stop".
    `latent_kl` is the KL `[B, T]` of posterior and prior, `step` what the warm-up counts.
    """
    alignment = config.value_alignment
    adaptive = functools.partial(
        losses.value_alignment_weight, warmup_steps=alignment.warmup_steps
    )

    def weight_of(kl: Array, step: Array) -> Array:
        if alignment.weight == "off":
            return jnp.zeros_like(kl)
        if alignment.weight == "static":  # with a KL of 0, Eq. 5 is the warm-up alone
            return alignment.static_weight * adaptive(jnp.zeros_like(kl), step)
        return adaptive(kl, step)

    def value_alignment(
        critic: PyTree, inference: Inference, latent_kl: Array, step: Array
    ) -> Alignment:
        critic = jax.lax.stop_gradient(critic)
        if alignment.weight == "off":  # then there is no backward pass either
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
            finite=True,
        )
        kl = transforms.finite_kl(*jax.lax.stop_gradient((logits, prior_logits)))
        return Alignment(loss, weight_of(latent_kl, step), kl)

    return value_alignment


def warmup_step(config: Config, learner: Learner, env_steps: Array) -> Array:
    """What the warm-up of value alignment counts: env steps, or updates."""
    return env_steps if config.value_alignment.warmup_unit == "env_steps" else learner.step


def alignment_metrics(aligned: Alignment) -> Metrics:
    """Means over the batch."""
    return {
        "value_alignment/loss": jnp.mean(aligned.loss),
        "value_alignment/weight": jnp.mean(aligned.weight),
        "value_alignment/kl": jnp.mean(aligned.kl),
    }
