"""Encoder, decoder, reward and continue heads, shared by all world models."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from vawm import nets
from vawm.config import WorldModelConfig
from vawm.errors import InvalidInput
from vawm.transforms import symlog
from vawm.types import Array, EnvSpec, Key, Latent, Predictions, PyTree


class Heads(NamedTuple):
    """Pure functions; `token_size` is the width of what `encode` returns."""

    init: Callable[[Key], PyTree]
    encode: Callable[[PyTree, Array], Array]
    predict: Callable[[PyTree, Latent], Predictions]
    token_size: int


def flat_stoch(latent: Latent) -> Array:
    """z as one vector, `[..., S * K]`."""
    return latent.stoch.reshape(*latent.stoch.shape[:-2], -1)


def vector_heads(config: WorldModelConfig, spec: EnvSpec, dtype: jnp.dtype) -> Heads:
    """Heads for vector observations: symlog MLPs.

    The encoder reads symlog(o), the decoder predicts symlog(o). The reward head has
    `bins` logits with zero initial output, the continue head one logit.
    """
    if len(spec.obs_shape) != 1:
        raise InvalidInput(
            "obs_shape", spec.obs_shape, "vector observations have one dimension"
        )
    features = config.deter + config.stoch * config.classes
    units = config.units

    def mlp(in_features, layers, outputs=(), scales=()):
        return nets.MLP(in_features, layers, units, outputs, scales, dtype)

    encoder = mlp(spec.obs_shape[0], config.encoder_layers)
    decoder = mlp(features, config.decoder_layers, spec.obs_shape, (1.0,))
    reward = mlp(features, config.reward_layers, (config.bins,), (0.0,))
    cont = mlp(features, config.continue_layers, (1,), (1.0,))

    def init(key: Key) -> PyTree:
        key_encoder, key_decoder, key_reward, key_cont = jax.random.split(key, 4)
        obs, feature = jnp.zeros((1, *spec.obs_shape)), jnp.zeros((1, features))
        return {
            "encoder": encoder.init(key_encoder, obs)["params"],
            "decoder": decoder.init(key_decoder, feature)["params"],
            "reward": reward.init(key_reward, feature)["params"],
            "cont": cont.init(key_cont, feature)["params"],
        }

    def encode(params: PyTree, obs: Array) -> Array:
        return encoder.apply({"params": params["encoder"]}, symlog(obs))

    def predict(params: PyTree, latent: Latent) -> Predictions:
        feature = latent.deter, flat_stoch(latent)
        obs = decoder.apply({"params": params["decoder"]}, *feature)[0]
        logits = reward.apply({"params": params["reward"]}, *feature)[0]
        logit = cont.apply({"params": params["cont"]}, *feature)[0]
        f32 = jnp.float32
        return Predictions(obs.astype(f32), logits.astype(f32), logit[..., 0].astype(f32))

    return Heads(init, encode, predict, units)
