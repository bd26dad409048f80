"""Encoder, decoder, reward and continue heads of DreamerV3."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from vawm import nets
from vawm.config import RSSMConfig
from vawm.types import Array, EnvSpec, Key, Latent, PyTree, flat_stoch
from vawm.world_model import codecs
from vawm.world_model.codecs import Codec, Codecs, join_pixels, split_pixels

Network = nets.MLP | nets.ReluMLP


class Heads(NamedTuple):
    """Pure functions.

    Attributes:
      init: `(key) -> (params, state)`.
      encode: `(params, state, obs) -> tokens`.
      decode: `(params, state, latent) -> obs`.
      outcome: `(params, latent) -> (reward logits [..., bins], continue logit [...])`.
      token_size: width of the tokens.
    """

    init: Callable[[Key], tuple[PyTree, PyTree]]
    encode: Callable[[PyTree, PyTree, PyTree], Array]
    decode: Callable[[PyTree, PyTree, Latent], PyTree]
    outcome: Callable[[PyTree, Latent], tuple[Array, Array]]
    token_size: int


def make_heads(config: RSSMConfig, spec: EnvSpec, dtype: jnp.dtype) -> Heads:
    """Heads for any mixture of vectors and images.

    The reward head has `bins` logits with zero initial output, the continue head one logit.
    The state of the codecs holds no array: nothing here is carried from update to update.

    Raises:
      InvalidInput: an observation that is neither a vector nor a square image whose
        halvings fit.
    """
    codec = codecs.make_codecs(
        spec,
        vector=lambda widths: vector_codec(config, widths, dtype),
        image=lambda size, channels: image_codec(config, size, channels, dtype),
    )
    features = config.deter + config.stoch * config.classes

    def mlp(layers, outputs, scale):
        return nets.MLP(features, layers, config.units, (outputs,), (scale,), dtype)

    reward = mlp(config.reward_layers, config.bins, 0.0)
    cont = mlp(config.continue_layers, 1, 1.0)

    read = make_outcome(reward, cont)

    def init(key: Key) -> tuple[PyTree, PyTree]:
        return init_heads(key, codec, reward, cont, jnp.zeros((1, features)))

    def encode(params: PyTree, state: PyTree, obs: PyTree) -> Array:
        return codec.encode(params["encoder"], state["encoder"], obs, train=False)[0]

    def decode(params: PyTree, state: PyTree, latent: Latent) -> PyTree:
        feature = latent.deter, flat_stoch(latent.stoch)
        return codec.decode(params["decoder"], state["decoder"], feature, train=False)[0]

    def outcome(params: PyTree, latent: Latent) -> tuple[Array, Array]:
        return read(params, latent.deter, flat_stoch(latent.stoch))

    return Heads(init, encode, decode, outcome, codec.token_size)


def init_heads(
    key: Key, codec: Codecs, reward: Network, cont: Network, feature: Array
) -> tuple[PyTree, PyTree]:
    """Parameters and state of all heads; `feature` is what reward and continuation read."""
    key_encoder, key_decoder, key_reward, key_cont = jax.random.split(key, 4)
    encoder, encoder_state = codec.init_encoder(key_encoder)
    decoder, decoder_state = codec.init_decoder(key_decoder)
    params = {
        "encoder": encoder,
        "decoder": decoder,
        "reward": reward.init(key_reward, feature)["params"],
        "cont": cont.init(key_cont, feature)["params"],
    }
    return params, {"encoder": encoder_state, "decoder": decoder_state}


def make_outcome(reward: Network, cont: Network) -> Callable[..., tuple[Array, Array]]:
    """Build `outcome(params, *feature) -> (logits, logit)` of reward and continuation.

    `[..., bins]` and `[...]`, both float32.
    """

    def outcome(params: PyTree, *feature: Array) -> tuple[Array, Array]:
        logits = reward.apply({"params": params["reward"]}, *feature)[0]
        logit = cont.apply({"params": params["cont"]}, *feature)[0]
        return logits.astype(jnp.float32), logit[..., 0].astype(jnp.float32)

    return outcome


def vector_codec(config: RSSMConfig, widths: list[int], dtype: jnp.dtype) -> Codec:
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
