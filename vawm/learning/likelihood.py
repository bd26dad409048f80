"""Maximum likelihood of a batch, Eq. 3: what the heads predict, and prior against posterior."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from vawm import losses
from vawm.config import Config, WorldModelConfig
from vawm.learning.discount import discount_of
from vawm.losses import transforms
from vawm.types import Array, Explanation, Inference, Metrics


class Likelihood(NamedTuple):
    """Eq. 3 of one batch."""

    losses: dict[str, Array]  # name -> [B, T] or [], with their scales
    kl: Array  # [B, T] KL of posterior and prior in nats; no gradient


def make_likelihood(config: Config) -> Callable[[Explanation], Likelihood]:
    """Build `likelihood(explanation) -> Likelihood`.

    A world model that predicts no observation has no reconstruction loss.
    """
    model = config.world_model
    reward_code = transforms.make_two_hot(model.bins, model.bin_spacing)
    discount = 1.0 if model.continue_target == "plain" else discount_of(config)
    of_batch = model.free_nats_of == "batch"
    dynamics_loss = losses.batch_dynamics_loss if of_batch else losses.dynamics_loss

    def likelihood(explanation: Explanation) -> Likelihood:
        inference = explanation.inference
        predictions, targets = explanation.predictions, explanation.targets
        has_decoder = len(jax.tree.leaves(predictions.obs)) > 0
        prediction = losses.prediction_loss(
            predictions.obs,
            predictions.reward,
            predictions.cont,
            targets.obs if has_decoder else (),
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
        parts = {
            "reconstruction": model.reconstruction_scale * prediction.reconstruction,
            "reward": prediction.reward,
            "continue": prediction.cont,
            "dynamics": dynamics,
        }
        if not has_decoder:
            del parts["reconstruction"]
        return Likelihood(parts, kl)

    return likelihood


def latent_metrics(model: WorldModelConfig, inference: Inference, kl: Array) -> Metrics:
    """The KL of posterior and prior, and their entropies, in nats: means over the batch."""

    def entropy(logits: Array) -> Array:
        mixed = transforms.unimix_logits(logits, model.unimix)
        return transforms.categorical_entropy(jax.lax.stop_gradient(mixed)).sum(-1)

    return {
        "latent/kl": jnp.mean(kl),
        "latent/posterior_entropy": jnp.mean(entropy(inference.post_logits)),
        "latent/prior_entropy": jnp.mean(entropy(inference.prior_logits)),
    }
