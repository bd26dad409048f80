"""Encoder, decoder, reward and continue heads of STORM."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp

from vawm import nets
from vawm.config import StormConfig
from vawm.types import Array, EnvSpec, Key, PyTree
from vawm.world_model import codecs
from vawm.world_model.codecs import Codec, join_pixels, split_pixels
from vawm.world_model.heads import init_heads, make_outcome


class StormHeads(NamedTuple):
    """Pure functions. The state is the running statistics of the images' BatchNorm.

    Attributes:
      init: `(key) -> (params, state)`.
      encode: `(params, state, obs, *, train) -> (tokens, state)`.
      decode: `(params, state, stoch, *, train) -> (obs, state)`, from flat z alone.
      outcome: `(params, deter) -> (reward logits [..., bins], continue logit [...])`, from h
        alone.
      token_size: width of the tokens.
    """

    init: Callable[[Key], tuple[PyTree, PyTree]]
    encode: Callable[..., tuple[Array, PyTree]]
    decode: Callable[..., tuple[PyTree, PyTree]]
    outcome: Callable[[PyTree, Array], tuple[Array, Array]]
    token_size: int


def make_storm_heads(config: StormConfig, spec: EnvSpec, dtype: jnp.dtype) -> StormHeads:
    """Heads for any mixture of vectors and images.

    The official termination head is the continue head with its sign turned.

    Raises:
      InvalidInput: an observation that is neither a vector nor a square image whose
        halvings fit.
    """
    codec = codecs.make_codecs(
        spec,
        vector=lambda widths: vector_codec(config, widths, dtype),
        image=lambda size, channels: image_codec(config, size, channels, dtype),
    )

    def mlp(outputs: int) -> nets.ReluMLP:
        return nets.ReluMLP(config.deter, config.head_layers, config.units, (outputs,), dtype)

    reward, cont = mlp(config.bins), mlp(1)

    def init(key: Key) -> tuple[PyTree, PyTree]:
        return init_heads(key, codec, reward, cont, jnp.zeros((1, config.deter)))

    def encode(params: PyTree, state: PyTree, obs: PyTree, *, train: bool):
        tokens, own = codec.encode(params["encoder"], state["encoder"], obs, train=train)
        return tokens, state | {"encoder": own}

    def decode(params: PyTree, state: PyTree, stoch: Array, *, train: bool):
        obs, own = codec.decode(params["decoder"], state["decoder"], (stoch,), train=train)
        return obs, state | {"decoder": own}

    return StormHeads(init, encode, decode, make_outcome(reward, cont), codec.token_size)


def vector_codec(config: StormConfig, widths: list[int], dtype: jnp.dtype) -> Codec:
    """MLPs, which the paper has not; their norm is LayerNorm, so there are no statistics."""
    flat, layers, units = config.stoch * config.classes, config.vector_layers, config.units
    return codecs.vector_codec(
        nets.ReluMLP(sum(widths), layers, units, dtype=dtype),
        nets.ReluMLP(flat, layers, units, tuple(widths), dtype),
        widths=widths,
        latent=(flat,),
        token_size=units,
    )


def image_codec(config: StormConfig, size: int, channels: list[int], dtype: jnp.dtype) -> Codec:
    """CNNs with BatchNorm: the encoder reads o / 255, the decoder predicts it, unbounded.

    Training normalises by the statistics of the batch, whatever its leading dims, and moves
    the running ones; all else uses those.
    """
    flat, pixels_shape = config.stoch * config.classes, (1, size, size, sum(channels))
    encoder = nets.StridedEncoder(sum(channels), config.depth, dtype)
    decoder = nets.StridedDecoder(flat, size, sum(channels), config.depth, dtype)

    def initial(module, key: Key, shape: tuple[int, ...]) -> tuple[PyTree, PyTree]:
        variables = module.init(key, jnp.zeros(shape, dtype), train=False)
        return variables["params"], variables["statistics"]

    def apply(module, params: PyTree, state: PyTree, x: Array, train: bool):
        variables = {"params": params, "statistics": state}
        if not train:
            return module.apply(variables, x, train=False), state
        y, changed = module.apply(variables, x, train=True, mutable=["statistics"])
        return y, jax.lax.stop_gradient(changed["statistics"])

    def encode(params: PyTree, state: PyTree, obs: list[Array], *, train: bool):
        tokens, state = apply(encoder, params, state, join_pixels(obs), train)
        return tokens.reshape(*obs[0].shape[:-3], -1), state

    def decode(params: PyTree, state: PyTree, latent: tuple[Array], *, train: bool):
        (stoch,) = latent
        pixels, state = apply(decoder, params, state, stoch.reshape(-1, flat), train)
        pixels = pixels.reshape(*stoch.shape[:-1], *pixels.shape[1:])
        return split_pixels(pixels, channels), state

    side = size // 2**nets.HALVINGS
    tokens = side * side * nets.STRIDED_WIDTHS[-1] * config.depth
    return Codec(
        init_encoder=lambda key: initial(encoder, key, pixels_shape),
        init_decoder=lambda key: initial(decoder, key, (1, flat)),
        encode=encode,
        decode=decode,
        token_size=tokens,
    )
