"""Encoder, decoder, reward and continue heads of STORM."""

from __future__ import annotations

import jax
import jax.numpy as jnp

from vawm import nets
from vawm.config import StormConfig
from vawm.types import Array, EnvSpec, Key, PyTree
from vawm.world_model import codecs
from vawm.world_model.codecs import Codec, join_pixels, split_pixels
from vawm.world_model.heads import Heads, join_heads


def make_storm_heads(config: StormConfig, spec: EnvSpec, dtype: jnp.dtype) -> Heads:
    """The heads of STORM, for any mixture of vectors and images.

    The decoder reads z alone, reward head and continue head read h alone. The official
    termination head is our continue head with the opposite sign. `model_state` holds the
    running statistics of the BatchNorm of images.

    Raises:
      InvalidInput: an observation that is neither a vector nor a square image whose size can be
        halved four times.
    """
    codec = codecs.make_codecs(
        spec,
        vector=lambda widths: vector_codec(config, widths, dtype),
        image=lambda size, channels: image_codec(config, size, channels, dtype),
    )

    def mlp(outputs: int) -> nets.ReluMLP:
        return nets.ReluMLP(config.deter, config.head_layers, config.units, (outputs,), dtype)

    return join_heads(codec, reward=mlp(config.bins), cont=mlp(1))


def vector_codec(config: StormConfig, widths: list[int], dtype: jnp.dtype) -> Codec:
    """MLPs, which the paper does not have. They use LayerNorm: there are no statistics."""
    flat, layers, units = config.stoch * config.classes, config.vector_layers, config.units
    return codecs.vector_codec(
        nets.ReluMLP(sum(widths), layers, units, dtype=dtype),
        nets.ReluMLP(flat, layers, units, tuple(widths), dtype),
        widths=widths,
        latent=(flat,),
        token_size=units,
    )


def image_codec(config: StormConfig, size: int, channels: list[int], dtype: jnp.dtype) -> Codec:
    """CNNs with BatchNorm: the encoder reads o / 255, the decoder predicts it without bounds.

    Training normalises with the statistics of the batch, over all its leading dims, and moves
    the running statistics. Everything else uses the running statistics.
    """
    flat, pixels_shape = config.stoch * config.classes, (1, size, size, sum(channels))
    encoder = nets.StridedEncoder(sum(channels), config.depth, dtype)
    decoder = nets.StridedDecoder(flat, size, sum(channels), config.depth, dtype)

    def initial(module, key: Key, shape: tuple[int, ...]) -> tuple[PyTree, PyTree]:
        variables = module.init(key, jnp.zeros(shape, dtype), train=False)
        return variables["params"], variables["statistics"]

    def apply(module, params: PyTree, model_state: PyTree, x: Array, train: bool):
        variables = {"params": params, "statistics": model_state}
        if not train:
            return module.apply(variables, x, train=False), model_state
        y, changed = module.apply(variables, x, train=True, mutable=["statistics"])
        return y, jax.lax.stop_gradient(changed["statistics"])

    def encode(params: PyTree, model_state: PyTree, obs: list[Array], *, train: bool):
        tokens, model_state = apply(encoder, params, model_state, join_pixels(obs), train)
        return tokens.reshape(*obs[0].shape[:-3], -1), model_state

    def decode(params: PyTree, model_state: PyTree, feature: tuple[Array], *, train: bool):
        (stoch,) = feature
        pixels, model_state = apply(
            decoder, params, model_state, stoch.reshape(-1, flat), train
        )
        pixels = pixels.reshape(*stoch.shape[:-1], *pixels.shape[1:])
        return split_pixels(pixels, channels), model_state

    side = size // 2**nets.HALVINGS
    tokens = side * side * nets.STRIDED_WIDTHS[-1] * config.depth
    return Codec(
        init_encoder=lambda key: initial(encoder, key, pixels_shape),
        init_decoder=lambda key: initial(decoder, key, (1, flat)),
        encode=encode,
        decode=decode,
        token_size=tokens,
    )
