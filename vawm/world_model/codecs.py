"""Encoders and decoders of observations: one codec for all vectors, one for all images.

`make_codecs` joins both, so that a world model can encode and decode any tree of vectors and
images. The tokens are those of the vectors, followed by those of the images.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp

from vawm import nets
from vawm.envs.protocol import check_image_size
from vawm.errors import InvalidInput
from vawm.losses.transforms import symlog
from vawm.types import Array, EnvSpec, Key, PyTree, is_image


class Codec(NamedTuple):
    """Encoder and decoder of one kind of observation, as pure functions.

    `model_state` are running statistics of a normalisation; `()` for none.

    Attributes:
      init_encoder, init_decoder: `(key) -> (params, model_state)`.
      encode: `(params, model_state, obs, *, train) -> (tokens [..., token_size], model_state)`;
        `obs` are the arrays of this kind, in the order in which they are in an observation.
      decode: `(params, model_state, feature, *, train) -> (predictions, model_state)` of these
        arrays; `feature` are the parts of a latent that the decoder reads.
      token_size: width of the tokens.
    """

    init_encoder: Callable[[Key], tuple[PyTree, PyTree]]
    init_decoder: Callable[[Key], tuple[PyTree, PyTree]]
    encode: Callable[..., tuple[Array, PyTree]]
    decode: Callable[..., tuple[list[Array], PyTree]]
    token_size: int


class Codecs(NamedTuple):
    """The joined codecs of an observation; params and model_state have an entry for each kind.

    Attributes:
      init_encoder, init_decoder: `(key) -> (params, model_state)`.
      encode: `(params, model_state, obs, *, train) -> (tokens, model_state)`, of the tree.
      decode: `(params, model_state, feature, *, train) -> (obs, model_state)`.
      token_size: width of the tokens of all kinds.
    """

    init_encoder: Callable[[Key], tuple[PyTree, PyTree]]
    init_decoder: Callable[[Key], tuple[PyTree, PyTree]]
    encode: Callable[..., tuple[Array, PyTree]]
    decode: Callable[..., tuple[PyTree, PyTree]]
    token_size: int


def make_codecs(
    spec: EnvSpec,
    *,
    vector: Callable[[list[int]], Codec],
    image: Callable[[int, list[int]], Codec],
) -> Codecs:
    """Codecs for the observations of `spec`.

    Args:
      spec: of the environment.
      vector: makes the codec for vectors of these widths.
      image: makes the codec for images of this size and these numbers of channels.

    Raises:
      InvalidInput: an observation that is neither a vector nor a square image whose size can be
        halved four times.
    """
    check_obs(spec.obs)
    leaves, tree = jax.tree.flatten(spec.obs)
    vectors = [leaf for leaf in leaves if not is_image(leaf)]
    images = [leaf for leaf in leaves if is_image(leaf)]
    codecs = {}
    if vectors:
        codecs["vector"] = vector([leaf.shape[0] for leaf in vectors])
    if images:
        codecs["image"] = image(images[0].shape[0], [leaf.shape[2] for leaf in images])

    def init(of_codec: Callable[[Codec], Callable[[Key], tuple[PyTree, PyTree]]]):
        def init_all(key: Key) -> tuple[PyTree, PyTree]:
            keys = one_each(key, codecs)
            made = {kind: of_codec(codec)(keys[kind]) for kind, codec in codecs.items()}
            return {k: v[0] for k, v in made.items()}, {k: v[1] for k, v in made.items()}

        return init_all

    def encode(params: PyTree, model_state: PyTree, obs: PyTree, *, train: bool):
        # The kind is that of the spec: pixels may also come as floats, to be differentiated.
        pairs = list(zip(leaves, jax.tree.leaves(obs), strict=True))
        kinds = {
            "vector": [x for leaf, x in pairs if not is_image(leaf)],
            "image": [x for leaf, x in pairs if is_image(leaf)],
        }
        tokens, states = {}, {}
        for kind, codec in codecs.items():
            tokens[kind], states[kind] = codec.encode(
                params[kind], model_state[kind], kinds[kind], train=train
            )
        parts = list(tokens.values())
        return parts[0] if len(parts) == 1 else jnp.concatenate(parts, -1), states

    def decode(params: PyTree, model_state: PyTree, feature: PyTree, *, train: bool):
        decoded, states = {}, {}
        for kind, codec in codecs.items():
            arrays, states[kind] = codec.decode(
                params[kind], model_state[kind], feature, train=train
            )
            decoded[kind] = iter(arrays)
        kinds = ["image" if is_image(leaf) else "vector" for leaf in leaves]
        obs = [next(decoded[kind]).astype(jnp.float32) for kind in kinds]
        return jax.tree.unflatten(tree, obs), states

    return Codecs(
        init_encoder=init(lambda codec: codec.init_encoder),
        init_decoder=init(lambda codec: codec.init_decoder),
        encode=encode,
        decode=decode,
        token_size=sum(codec.token_size for codec in codecs.values()),
    )


def vector_codec(
    encoder: nets.MLP | nets.ReluMLP,
    decoder: nets.MLP | nets.ReluMLP,
    *,
    widths: list[int],
    latent: Sequence[int],
    token_size: int,
) -> Codec:
    """Symlog MLPs: the encoder reads symlog(o), the decoder predicts symlog(o); no model_state.

    Args:
      encoder: a network without outputs.
      decoder: a network with one output for each vector.
      widths: of the vectors.
      latent: widths of the arrays that the decoder reads.
      token_size: of the encoder.
    """

    def init_encoder(key: Key) -> tuple[PyTree, PyTree]:
        return encoder.init(key, jnp.zeros((1, sum(widths)), jnp.float32))["params"], ()

    def init_decoder(key: Key) -> tuple[PyTree, PyTree]:
        inputs = [jnp.zeros((1, width), jnp.float32) for width in latent]
        return decoder.init(key, *inputs)["params"], ()

    def encode(params: PyTree, model_state: PyTree, obs: list[Array], *, train: bool):
        del train
        vector = obs[0] if len(obs) == 1 else jnp.concatenate(obs, -1)
        return jnp.asarray(encoder.apply({"params": params}, symlog(vector))), model_state

    def decode(params: PyTree, model_state: PyTree, feature: tuple[Array, ...], *, train: bool):
        del train
        return list(decoder.apply({"params": params}, *feature)), model_state

    return Codec(init_encoder, init_decoder, encode, decode, token_size)


def join_pixels(images: list[Array]) -> Array:
    """Concatenates images on their channels: `[N, size, size, C]`, leading dims flat."""
    pixels = images[0] if len(images) == 1 else jnp.concatenate(images, -1)
    return pixels.reshape(-1, *pixels.shape[-3:])


def split_pixels(pixels: Array, channels: list[int]) -> list[Array]:
    """Splits images that were concatenated on their channels."""
    ends = [sum(channels[: i + 1]) for i in range(len(channels) - 1)]
    return jnp.split(pixels, ends, -1)


def one_each(key: Key, names: Collection[str]) -> dict[str, Key]:
    """A key for each name; `key` itself if there is only one name."""
    keys = [key] if len(names) == 1 else list(jax.random.split(key, len(names)))
    return dict(zip(names, keys, strict=True))


def check_obs(obs: PyTree) -> None:
    """Refuses observations that the networks cannot read.

    Raises:
      InvalidInput: names the first one.
    """
    sizes = set()
    for path, leaf in jax.tree_util.tree_leaves_with_path(obs):
        name = "obs" + jax.tree_util.keystr(path)
        shape = tuple(leaf.shape)
        if not is_image(leaf):
            if leaf.dtype != jnp.float32 or len(shape) != 1 or not shape[0]:
                remedy = "make vectors float32 with one dimension, and images uint8"
                raise InvalidInput(name, f"{leaf.dtype}{list(shape)}", remedy)
            continue
        if len(shape) != 3 or shape[0] != shape[1]:
            raise InvalidInput(name, shape, "give images the shape [size, size, channels]")
        check_image_size(name, shape[0])
        sizes.add(shape[0])
    if len(sizes) > 1:
        raise InvalidInput("obs", sorted(sizes), "give all images of an observation one size")
