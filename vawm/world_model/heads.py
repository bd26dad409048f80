"""Encoder, decoder, reward and continue heads of DreamerV3."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from vawm import nets
from vawm.config import RSSMConfig
from vawm.transforms import symlog
from vawm.types import Array, EnvSpec, Key, Latent, Predictions, PyTree
from vawm.world_model.codecs import Codec, join_pixels, make_codecs, split_pixels


class Heads(NamedTuple):
    """Pure functions; `token_size` is the width of what `encode` returns."""

    init: Callable[[Key], tuple[PyTree, PyTree]]
    encode: Callable[[PyTree, PyTree, PyTree], Array]
    predict: Callable[[PyTree, PyTree, Latent], Predictions]
    token_size: int


def flat_stoch(latent: Latent) -> Array:
    """z as one vector, `[..., S * K]`."""
    return latent.stoch.reshape(*latent.stoch.shape[:-2], -1)


def make_heads(config: RSSMConfig, spec: EnvSpec, dtype: jnp.dtype) -> Heads:
    """Heads for any mixture of vectors and images.

    The reward head has `bins` logits with zero initial output, the continue head one logit.
    The state of the codecs holds no array: nothing here is carried from update to update.

    Raises:
      InvalidInput: an observation that is neither a vector nor a square image whose
        halvings fit.
    """
    codecs = make_codecs(
        spec,
        vector=lambda widths: vector_codec(config, widths, dtype),
        image=lambda size, channels: image_codec(config, size, channels, dtype),
    )
    features = config.deter + config.stoch * config.classes

    def mlp(layers, outputs, scale):
        return nets.MLP(features, layers, config.units, (outputs,), (scale,), dtype)

    reward = mlp(config.reward_layers, config.bins, 0.0)
    cont = mlp(config.continue_layers, 1, 1.0)

    def init(key: Key) -> tuple[PyTree, PyTree]:
        key_encoder, key_decoder, key_reward, key_cont = jax.random.split(key, 4)
        feature = jnp.zeros((1, features))
        encoder, encoder_state = codecs.init_encoder(key_encoder)
        decoder, decoder_state = codecs.init_decoder(key_decoder)
        params = {
            "encoder": encoder,
            "decoder": decoder,
            "reward": reward.init(key_reward, feature)["params"],
            "cont": cont.init(key_cont, feature)["params"],
        }
        return params, {"encoder": encoder_state, "decoder": decoder_state}

    def encode(params: PyTree, state: PyTree, obs: PyTree) -> Array:
        return codecs.encode(params["encoder"], state["encoder"], obs, train=False)[0]

    def predict(params: PyTree, state: PyTree, latent: Latent) -> Predictions:
        feature = latent.deter, flat_stoch(latent)
        obs, _ = codecs.decode(params["decoder"], state["decoder"], feature, train=False)
        logits = reward.apply({"params": params["reward"]}, *feature)[0]
        logit = cont.apply({"params": params["cont"]}, *feature)[0]
        return Predictions(obs, logits.astype(jnp.float32), logit[..., 0].astype(jnp.float32))

    return Heads(init, encode, predict, codecs.token_size)


def vector_codec(config: RSSMConfig, widths: list[int], dtype: jnp.dtype) -> Codec:
    """Symlog MLPs: the encoder reads symlog(o), the decoder predicts symlog(o)."""
    features = config.deter + config.stoch * config.classes
    units, outputs = config.units, tuple(widths)
    encoder = nets.MLP(sum(widths), config.encoder_layers, units, dtype=dtype)
    decoder = nets.MLP(
        features, config.decoder_layers, units, outputs, (1.0,) * len(widths), dtype
    )

    def init_encoder(key: Key) -> tuple[PyTree, PyTree]:
        return encoder.init(key, jnp.zeros((1, sum(widths))))["params"], ()

    def init_decoder(key: Key) -> tuple[PyTree, PyTree]:
        return decoder.init(key, jnp.zeros((1, features)))["params"], ()

    def encode(params: PyTree, state: PyTree, obs: list[Array], *, train: bool):
        del train
        vector = obs[0] if len(obs) == 1 else jnp.concatenate(obs, -1)
        return jnp.asarray(encoder.apply({"params": params}, symlog(vector))), state

    def decode(params: PyTree, state: PyTree, latent: tuple[Array, Array], *, train: bool):
        del train
        return list(decoder.apply({"params": params}, *latent)), state

    return Codec(init_encoder, init_decoder, encode, decode, units)


def image_codec(config: RSSMConfig, size: int, channels: list[int], dtype: jnp.dtype) -> Codec:
    """CNNs: the encoder reads o / 255 - 0.5, the decoder predicts o / 255.

    Images are concatenated on their channels.
    """
    flat = config.stoch * config.classes
    encoder = nets.ImageEncoder(sum(channels), config.depth, dtype)
    decoder = nets.ImageDecoder(
        deter=config.deter,
        stoch=flat,
        units=config.units,
        blocks=config.blocks,
        size=size,
        channels=sum(channels),
        depth=config.depth,
        dtype=dtype,
    )

    def init_encoder(key: Key) -> tuple[PyTree, PyTree]:
        pixels = jnp.zeros((1, size, size, sum(channels)), dtype)
        return encoder.init(key, pixels)["params"], ()

    def init_decoder(key: Key) -> tuple[PyTree, PyTree]:
        latent = jnp.zeros((1, config.deter), dtype), jnp.zeros((1, flat), dtype)
        return decoder.init(key, *latent)["params"], ()

    def encode(params: PyTree, state: PyTree, obs: list[Array], *, train: bool):
        del train
        pixels = join_pixels(obs).astype(dtype) / 255.0 - 0.5
        tokens = jnp.asarray(encoder.apply({"params": params}, pixels))
        return tokens.reshape(*obs[0].shape[:-3], -1), state

    def decode(params: PyTree, state: PyTree, latent: tuple[Array, Array], *, train: bool):
        del train
        deter, stoch = latent
        pixels = jnp.asarray(
            decoder.apply(
                {"params": params}, deter.reshape(-1, config.deter), stoch.reshape(-1, flat)
            )
        )
        pixels = pixels.reshape(*deter.shape[:-1], *pixels.shape[1:])
        return split_pixels(pixels, channels), state

    side = size // 2**nets.HALVINGS
    tokens = side * side * nets.STAGE_WIDTHS[-1] * config.depth
    return Codec(init_encoder, init_decoder, encode, decode, tokens)
