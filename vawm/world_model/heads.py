"""Encoder, decoder, reward and continue heads, shared by all world models."""

from __future__ import annotations

from collections.abc import Callable, Collection
from typing import NamedTuple

import jax
import jax.numpy as jnp

from vawm import nets
from vawm.config import WorldModelConfig
from vawm.errors import InvalidInput
from vawm.transforms import symlog
from vawm.types import IMAGE_SIZES, Array, EnvSpec, Key, Latent, Predictions, PyTree, is_image

"""Pixels a side that the CNN may leave of an image, as in the official code."""


class Heads(NamedTuple):
    """Pure functions; `token_size` is the width of what `encode` returns."""

    init: Callable[[Key], PyTree]
    encode: Callable[[PyTree, PyTree], Array]
    predict: Callable[[PyTree, Latent], Predictions]
    token_size: int


class Codec(NamedTuple):
    """Encoder and decoder of one kind of observation.

    Attributes:
      init_encoder, init_decoder: `(key) -> params`.
      encode: `(encoder_params, obs) -> tokens`, `[..., token_size]`; `obs` are the arrays of
        this kind, in the order of the tree that an observation is.
      decode: `(decoder_params, deter, flat_stoch) -> predictions` of these arrays.
    """

    init_encoder: Callable[[Key], PyTree]
    init_decoder: Callable[[Key], PyTree]
    encode: Callable[[PyTree, list[Array]], Array]
    decode: Callable[[PyTree, Array, Array], list[Array]]
    token_size: int


def flat_stoch(latent: Latent) -> Array:
    """z as one vector, `[..., S * K]`."""
    return latent.stoch.reshape(*latent.stoch.shape[:-2], -1)


def make_heads(config: WorldModelConfig, spec: EnvSpec, dtype: jnp.dtype) -> Heads:
    """Heads for any mixture of vectors and images.

    Tokens are those of the vectors, then those of the images. The reward head has `bins`
    logits with zero initial output, the continue head one logit.

    Raises:
      InvalidInput: an observation that is neither a vector nor a square image whose
        halvings fit.
    """
    check_obs(spec.obs)
    leaves, tree = jax.tree.flatten(spec.obs)
    vectors = [leaf for leaf in leaves if not is_image(leaf)]
    images = [leaf for leaf in leaves if is_image(leaf)]
    codecs = {}
    if vectors:
        codecs["vector"] = vector_codec(config, [leaf.shape[0] for leaf in vectors], dtype)
    if images:
        channels = [leaf.shape[2] for leaf in images]
        codecs["image"] = image_codec(config, images[0].shape[0], channels, dtype)
    features = config.deter + config.stoch * config.classes

    def mlp(layers, outputs, scale):
        return nets.MLP(features, layers, config.units, (outputs,), (scale,), dtype)

    reward = mlp(config.reward_layers, config.bins, 0.0)
    cont = mlp(config.continue_layers, 1, 1.0)

    def init(key: Key) -> PyTree:
        key_encoder, key_decoder, key_reward, key_cont = jax.random.split(key, 4)
        feature = jnp.zeros((1, features))
        encoder_keys, decoder_keys = (one_each(k, codecs) for k in (key_encoder, key_decoder))
        return {
            "encoder": {k: codec.init_encoder(encoder_keys[k]) for k, codec in codecs.items()},
            "decoder": {k: codec.init_decoder(decoder_keys[k]) for k, codec in codecs.items()},
            "reward": reward.init(key_reward, feature)["params"],
            "cont": cont.init(key_cont, feature)["params"],
        }

    def encode(params: PyTree, obs: PyTree) -> Array:
        arrays = jax.tree.leaves(obs)
        kinds = {
            "vector": [x for x in arrays if not is_image(x)],
            "image": [x for x in arrays if is_image(x)],
        }
        tokens = [
            codec.encode(params["encoder"][kind], kinds[kind]) for kind, codec in codecs.items()
        ]
        return tokens[0] if len(tokens) == 1 else jnp.concatenate(tokens, -1)

    def decode(params: PyTree, deter: Array, stoch: Array) -> PyTree:
        decoded = {
            kind: iter(codec.decode(params["decoder"][kind], deter, stoch))
            for kind, codec in codecs.items()
        }
        kinds = ["image" if is_image(leaf) else "vector" for leaf in leaves]
        return jax.tree.unflatten(tree, [next(decoded[kind]) for kind in kinds])

    def predict(params: PyTree, latent: Latent) -> Predictions:
        feature = latent.deter, flat_stoch(latent)
        logits = reward.apply({"params": params["reward"]}, *feature)[0]
        logit = cont.apply({"params": params["cont"]}, *feature)[0]
        f32 = jnp.float32
        obs = jax.tree.map(lambda x: x.astype(f32), decode(params, *feature))
        return Predictions(obs, logits.astype(f32), logit[..., 0].astype(f32))

    return Heads(init, encode, predict, sum(codec.token_size for codec in codecs.values()))


def one_each(key: Key, names: Collection[str]) -> dict[str, Key]:
    """A key for each name; `key` itself where there is one."""
    keys = [key] if len(names) == 1 else list(jax.random.split(key, len(names)))
    return dict(zip(names, keys, strict=True))


def check_obs(obs: PyTree) -> None:
    """Refuses observations that the networks cannot read.

    Raises:
      InvalidInput: names the first of them.
    """
    sizes = set()
    for path, leaf in jax.tree_util.tree_leaves_with_path(obs):
        name = "obs" + jax.tree_util.keystr(path)
        shape = tuple(leaf.shape)
        if not is_image(leaf):
            if leaf.dtype != jnp.float32 or len(shape) != 1 or not shape[0]:
                remedy = "vectors are float32 of one dimension, images are uint8"
                raise InvalidInput(name, f"{leaf.dtype}{list(shape)}", remedy)
            continue
        if len(shape) != 3 or shape[0] != shape[1]:
            raise InvalidInput(name, shape, "images are [size, size, channels]")
        check_image_size(name, shape[0])
        sizes.add(shape[0])
    if len(sizes) > 1:
        raise InvalidInput("obs", sorted(sizes), "all images of an observation have one size")


def check_image_size(name: str, size: int) -> None:
    """Refuses a side of an image that cannot be halved as often as the CNN does.

    Raises:
      InvalidInput: with the sizes that can.
    """
    if size not in IMAGE_SIZES:
        low, high, step = IMAGE_SIZES[0], IMAGE_SIZES[-1], IMAGE_SIZES.step
        remedy = f"use a multiple of {step} from {low} to {high}, such as 64, 96 or 128"
        raise InvalidInput(name, size, remedy)


def vector_codec(config: WorldModelConfig, widths: list[int], dtype: jnp.dtype) -> Codec:
    """Symlog MLPs: the encoder reads symlog(o), the decoder predicts symlog(o)."""
    features = config.deter + config.stoch * config.classes
    units, outputs = config.units, tuple(widths)
    encoder = nets.MLP(sum(widths), config.encoder_layers, units, dtype=dtype)
    decoder = nets.MLP(
        features, config.decoder_layers, units, outputs, (1.0,) * len(widths), dtype
    )

    def init_encoder(key: Key) -> PyTree:
        return encoder.init(key, jnp.zeros((1, sum(widths))))["params"]

    def init_decoder(key: Key) -> PyTree:
        return decoder.init(key, jnp.zeros((1, features)))["params"]

    def encode(params: PyTree, obs: list[Array]) -> Array:
        vector = obs[0] if len(obs) == 1 else jnp.concatenate(obs, -1)
        return jnp.asarray(encoder.apply({"params": params}, symlog(vector)))

    def decode(params: PyTree, deter: Array, stoch: Array) -> list[Array]:
        return list(decoder.apply({"params": params}, deter, stoch))

    return Codec(init_encoder, init_decoder, encode, decode, units)


def image_codec(
    config: WorldModelConfig, size: int, channels: list[int], dtype: jnp.dtype
) -> Codec:
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

    def init_encoder(key: Key) -> PyTree:
        return encoder.init(key, jnp.zeros((1, size, size, sum(channels)), dtype))["params"]

    def init_decoder(key: Key) -> PyTree:
        latent = jnp.zeros((1, config.deter), dtype), jnp.zeros((1, flat), dtype)
        return decoder.init(key, *latent)["params"]

    def encode(params: PyTree, obs: list[Array]) -> Array:
        pixels = obs[0] if len(obs) == 1 else jnp.concatenate(obs, -1)
        leading = pixels.shape[:-3]
        pixels = pixels.reshape(-1, *pixels.shape[-3:]).astype(dtype) / 255.0 - 0.5
        tokens = jnp.asarray(encoder.apply({"params": params}, pixels))
        return tokens.reshape(*leading, -1)

    def decode(params: PyTree, deter: Array, stoch: Array) -> list[Array]:
        leading = deter.shape[:-1]
        latent = deter.reshape(-1, config.deter), stoch.reshape(-1, flat)
        pixels = jnp.asarray(decoder.apply({"params": params}, *latent))
        pixels = pixels.reshape(*leading, *pixels.shape[1:])
        ends = [sum(channels[: i + 1]) for i in range(len(channels) - 1)]
        return jnp.split(pixels, ends, -1)

    side = size // 2**nets.HALVINGS
    tokens = side * side * nets.STAGE_WIDTHS[-1] * config.depth
    return Codec(init_encoder, init_decoder, encode, decode, tokens)
