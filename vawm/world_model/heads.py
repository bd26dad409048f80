"""Encoder, decoder, reward and continue heads: `Heads`, and those of DreamerV3."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from vawm import nets
from vawm.config import HeadsConfig
from vawm.types import Array, EnvSpec, Key, PyTree
from vawm.world_model import codecs
from vawm.world_model.codecs import Codec, Codecs, join_pixels, split_pixels

Network = nets.MLP | nets.ReluMLP


class Heads(NamedTuple):
    """The heads of a world model, as pure functions.

    `model_state` is the part of a world model's state that belongs to the heads: running
    statistics, if there are any. `feature` are the parts of a latent that a head reads, a tuple
    of arrays, such as `vawm.types.features(latent)`.

    Attributes:
      init: `(key) -> (params, model_state)`.
      encode: `(params, model_state, obs, *, train=False) -> (tokens, model_state)`.
      decode: `(params, model_state, feature, *, train=False) -> (obs, model_state)`.
      outcome: `(params, feature) -> (reward logits [..., bins], continue logit [...])`.
      token_size: width of the tokens.
    """

    init: Callable[[Key], tuple[PyTree, PyTree]]
    encode: Callable[..., tuple[Array, PyTree]]
    decode: Callable[..., tuple[PyTree, PyTree]]
    outcome: Callable[[PyTree, tuple[Array, ...]], tuple[Array, Array]]
    token_size: int


def join_heads(codec: Codecs, reward: Network, cont: Network) -> Heads:
    """The heads that a codec and two networks make, under four keys of parameters.

    Args:
      codec: encoder and decoder.
      reward: its first output are the logits of the reward's two-hot code.
      cont: its first output is the logit of continuation, of width 1.
    """

    def init(key: Key) -> tuple[PyTree, PyTree]:
        key_encoder, key_decoder, key_reward, key_cont = jax.random.split(key, 4)
        encoder, encoder_state = codec.init_encoder(key_encoder)
        decoder, decoder_state = codec.init_decoder(key_decoder)
        params = {
            "encoder": encoder,
            "decoder": decoder,
            "reward": init_network(reward, key_reward),
            "cont": init_network(cont, key_cont),
        }
        return params, {"encoder": encoder_state, "decoder": decoder_state}

    def encode(params: PyTree, model_state: PyTree, obs: PyTree, *, train: bool = False):
        tokens, own = codec.encode(params["encoder"], model_state["encoder"], obs, train=train)
        return tokens, model_state | {"encoder": own}

    def decode(
        params: PyTree, model_state: PyTree, feature: tuple[Array, ...], *, train: bool = False
    ):
        obs, own = codec.decode(params["decoder"], model_state["decoder"], feature, train=train)
        return obs, model_state | {"decoder": own}

    def outcome(params: PyTree, feature: tuple[Array, ...]) -> tuple[Array, Array]:
        logits = reward.apply({"params": params["reward"]}, *feature)[0]
        logit = cont.apply({"params": params["cont"]}, *feature)[0]
        return logits.astype(jnp.float32), logit[..., 0].astype(jnp.float32)

    return Heads(init, encode, decode, outcome, codec.token_size)


def init_network(network: Network, key: Key) -> PyTree:
    """Fresh parameters."""
    return network.init(key, jnp.zeros((1, network.in_features), jnp.float32))["params"]


def make_heads(config: HeadsConfig, spec: EnvSpec, dtype: jnp.dtype) -> Heads:
    """The heads of DreamerV3, for any mixture of vectors and images.

    Decoder, reward head and continue head read [h, z]. The reward head has `bins` logits, which
    start at 0; the continue head has one. There are no running statistics, so `model_state`
    has no arrays, and `train` changes nothing.

    Raises:
      InvalidInput: an observation that is neither a vector nor a square image whose size can be
        halved four times.
    """
    codec = codecs.make_codecs(
        spec,
        vector=lambda widths: vector_codec(config, widths, dtype),
        image=lambda size, channels: image_codec(config, size, channels, dtype),
    )
    width = config.deter + config.stoch * config.classes
    return join_heads(
        codec,
        reward=nets.MLP(
            width, config.reward_layers, config.units, (config.bins,), (0.0,), dtype
        ),
        cont=nets.MLP(width, config.continue_layers, config.units, (1,), (1.0,), dtype),
    )


def vector_codec(config: HeadsConfig, widths: list[int], dtype: jnp.dtype) -> Codec:
    """MLPs: the decoder reads h and z."""
    latent, units = (config.deter, config.stoch * config.classes), config.units
    scales = (1.0,) * len(widths)
    return codecs.vector_codec(
        nets.MLP(sum(widths), config.encoder_layers, units, dtype=dtype),
        nets.MLP(sum(latent), config.decoder_layers, units, tuple(widths), scales, dtype),
        widths=widths,
        latent=latent,
        token_size=units,
    )


def image_codec(config: HeadsConfig, size: int, channels: list[int], dtype: jnp.dtype) -> Codec:
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

    def encode(params: PyTree, model_state: PyTree, obs: list[Array], *, train: bool):
        del train
        pixels = join_pixels(obs).astype(dtype) / 255.0 - 0.5
        tokens = jnp.asarray(encoder.apply({"params": params}, pixels))
        return tokens.reshape(*obs[0].shape[:-3], -1), model_state

    def decode(
        params: PyTree, model_state: PyTree, feature: tuple[Array, Array], *, train: bool
    ):
        del train
        deter, stoch = feature
        pixels = jnp.asarray(
            decoder.apply(
                {"params": params}, deter.reshape(-1, config.deter), stoch.reshape(-1, flat)
            )
        )
        pixels = pixels.reshape(*deter.shape[:-1], *pixels.shape[1:])
        return split_pixels(pixels, channels), model_state

    side = size // 2**nets.HALVINGS
    tokens = side * side * nets.STAGE_WIDTHS[-1] * config.depth
    return Codec(init_encoder, init_decoder, encode, decode, tokens)
