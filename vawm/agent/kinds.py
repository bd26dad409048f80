"""The agents of the package, DreamerV3, STORM and VaGraM: one row of the registry each."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import cast

from vawm import config, nets
from vawm.agent.actor_critic import Critic
from vawm.agent.agent import LatentLosses
from vawm.agent.registry import Activations, register
from vawm.agent.value_gradient import make_value_gradient_loss
from vawm.config import (
    AdamConfig,
    Config,
    RSSMConfig,
    StormConfig,
    VagramConfig,
    presets,
)
from vawm.errors import BELOW_ONE, LAYERS, NOT_NEGATIVE, InvalidInput
from vawm.world_model.rssm import rssm
from vawm.world_model.storm import storm

HEAD_RULES = {
    "encoder_layers": LAYERS,
    "decoder_layers": LAYERS,
    "reward_layers": LAYERS,
    "continue_layers": LAYERS,
    "blocks": LAYERS,
}
RSSM_RULES = HEAD_RULES | {"prior_layers": LAYERS}
VAGRAM_RULES = RSSM_RULES | {"value_gradient_scale": NOT_NEGATIVE}
STORM_RULES = {
    "blocks": LAYERS,
    "vector_layers": LAYERS,
    "head_layers": LAYERS,
    "dropout": BELOW_ONE,
}


def check_rssm(config: Config) -> None:
    """Refuses widths that do not divide into blocks."""
    model = cast(RSSMConfig, config.world_model)
    if model.deter % model.blocks:
        remedy = f"use a multiple of world_model.blocks={model.blocks}"
        raise InvalidInput("world_model.deter", model.deter, remedy)
    if 4 * model.depth % model.blocks:  # channels of the map that the decoder starts from
        remedy = f"make 4 * depth a multiple of world_model.blocks={model.blocks}"
        raise InvalidInput("world_model.depth", model.depth, remedy)


def check_storm(config: Config) -> None:
    """Refuses what a transformer with learned positions cannot train on or imagine."""
    model, imagination = cast(StormConfig, config.world_model), config.imagination
    length = config.replay.batch_length
    if model.deter % model.heads:
        remedy = f"use a multiple of world_model.heads={model.heads}"
        raise InvalidInput("world_model.deter", model.deter, remedy)
    if imagination.starts != "contexts":
        remedy = "use contexts: a transformer starts from past steps, not from a state"
        raise InvalidInput("imagination.starts", imagination.starts, remedy)
    if length > model.positions:
        remedy = f"use at most world_model.positions={model.positions}"
        raise InvalidInput("replay.batch_length", length, remedy)
    # Training sees the first positions, as many as a batch is long.
    needs = (
        ("world_model.act_context", model.act_context, 0),
        ("imagination.horizon", imagination.horizon, imagination.context_length),
    )
    for name, value, before in needs:
        if before + value > length:
            remedy = f"use at most {length - before}, or replay.batch_length above {length}: "
            raise InvalidInput(name, value, remedy + "training sees no later position")


def rssm_activations(config: Config, image_size: int | None) -> Activations:
    """Of the layers around h, and of the CNNs, whose stages halve after their convolution."""
    model, critic = cast(RSSMConfig, config.world_model), config.critic
    layers = (
        model.encoder_layers
        + model.decoder_layers
        + model.reward_layers
        + model.continue_layers
        + config.actor.layers
        + critic.layers
    )
    step = layers * model.units + model.bins + 3 * critic.bins
    observed = 8 * (model.deter + model.stoch * model.classes) + 4 * step
    return Activations(observed, maps=maps(nets.STAGE_WIDTHS, model.depth, image_size, 0))


def storm_activations(config: Config, image_size: int | None) -> Activations:
    """Of the transformer and the heads, and of the CNNs, which halve before they convolve."""
    model = cast(StormConfig, config.world_model)
    imagination, critic = config.imagination, config.critic
    attention = 2 * model.heads * config.replay.batch_length
    block = 8 * model.deter + 2 * model.feedforward + attention
    layers = 2 * model.head_layers + 2 * model.vector_layers + 2 * critic.layers
    flat = model.stoch * model.classes
    slots = imagination.context_length + imagination.horizon
    return Activations(
        observed=model.blocks * block + 8 * flat + layers * model.units + 4 * critic.bins,
        cache=4 * model.blocks * imagination.batch_size * slots * model.deter,
        maps=maps(nets.STRIDED_WIDTHS, model.depth, image_size, 1),
    )


def maps(widths: Sequence[int], depth: int, size: int | None, halved: int) -> int:
    """Numbers in the maps of encoder and decoder; the first stage is `halved` times smaller."""
    if size is None:
        return 0
    sides = (size // 2 ** (stage + halved) for stage in range(len(widths)))
    return sum(
        2 * side * side * width * depth for side, width in zip(sides, widths, strict=True)
    )


def vagram_losses(critic: Critic, model: VagramConfig) -> LatentLosses:
    """VaGraM's loss by its name."""
    loss = make_value_gradient_loss(critic, model)
    return lambda *arguments: {"value_gradient": loss(*arguments)}


def register_all() -> None:
    """Adds the rows of the package."""
    rssm_sizes = {size: widths._asdict() for size, widths in config.RSSM_SIZES.items()}
    register(
        "dreamerv3",
        RSSMConfig,
        rssm,
        sizes=rssm_sizes,
        presets=presets.DREAMERV3,
        rules=RSSM_RULES,
        check=check_rssm,
        activations=rssm_activations,
    )
    register(
        "storm",
        StormConfig,
        storm,
        optimizer=AdamConfig,
        sizes={size: widths._asdict() for size, widths in config.STORM_SIZES.items()},
        presets=presets.STORM_PRESETS,
        rules=STORM_RULES,
        check=check_storm,
        activations=storm_activations,
        context_limited=True,
    )
    register(
        "vagram",
        VagramConfig,
        functools.partial(rssm, deterministic=True),
        sizes=rssm_sizes,
        presets=presets.VAGRAM_PRESETS,
        rules=VAGRAM_RULES,
        samples_latents=False,
        check=check_rssm,
        activations=rssm_activations,
        make_latent_losses=vagram_losses,
    )
