"""Heads for vectors, images and both: what they read, what they predict, what they refuse."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tiny

from vawm import nets, types
from vawm.errors import InvalidInput
from vawm.types import ArraySpec, EnvSpec, Latent, image, vector
from vawm.world_model.heads import make_heads

CONFIG = dataclasses.replace(tiny.CONFIG.world_model, depth=2)
LEADING = 2, 3


def spec(obs):
    return EnvSpec("test", obs, 3, False, 2, 1, None)


def make(obs):
    heads = make_heads(CONFIG, spec(obs), jnp.float32)
    params, state = heads.init(jax.random.key(0))
    assert not jax.tree.leaves(state)  # nothing is carried
    return heads, params, state


def random_obs(obs, seed=0):
    """A batch `[2, 3, ...]` of what `obs` describes."""
    rng = np.random.default_rng(seed)

    def draw(leaf):
        shape = *LEADING, *leaf.shape
        if leaf.dtype == jnp.uint8:
            return jnp.asarray(rng.integers(0, 256, shape), jnp.uint8)
        return jnp.asarray(rng.normal(size=shape), jnp.float32)

    return jax.tree.map(draw, obs)


def latent():
    keys = jax.random.split(jax.random.key(1))
    deter = jax.random.normal(keys[0], (*LEADING, CONFIG.deter))
    shape = *LEADING, CONFIG.stoch, CONFIG.classes
    return Latent(deter, jax.nn.softmax(jax.random.normal(keys[1], shape)))


@pytest.mark.parametrize("size", [48, 64, 96, 128])
def test_square_images_of_several_sizes_are_read_and_predicted(size):
    heads, params, state = make(image(size))
    tokens = jax.jit(heads.encode)(params, state, random_obs(image(size)))
    assert tokens.shape == (*LEADING, heads.token_size)
    assert heads.token_size == (size // 16) ** 2 * 4 * CONFIG.depth
    predicted = jax.jit(heads.decode)(params, state, latent())
    assert predicted.shape == (*LEADING, size, size, 3)
    assert ((predicted > 0) & (predicted < 1)).all()


def test_images_are_read_as_bytes_between_minus_and_plus_a_half():
    heads, params, state = make(image(64))
    obs = random_obs(image(64))
    pixels = np.asarray(obs, np.float32).reshape(6, 64, 64, 3) / 255 - 0.5
    cnn = nets.ImageEncoder(3, CONFIG.depth)
    expected = cnn.apply({"params": params["encoder"]["image"]}, pixels)
    np.testing.assert_allclose(
        heads.encode(params, state, obs).reshape(6, -1), expected, rtol=1e-5, atol=1e-6
    )


MIXED = {"camera": image(48), "joints": vector(4), "speed": vector(2), "top": image(48, 1)}


def test_images_and_vectors_are_mixed_and_each_is_predicted_at_its_place():
    heads, params, state = make(MIXED)
    obs = random_obs(MIXED)
    tokens = heads.encode(params, state, obs)
    assert heads.token_size == CONFIG.units + 3 * 3 * 4 * CONFIG.depth
    predicted = heads.decode(params, state, latent())
    assert {k: x.shape for k, x in predicted.items()} == {k: x.shape for k, x in obs.items()}
    read = {"joints": slice(None, CONFIG.units), "top": slice(CONFIG.units, None)}
    for name, changed in read.items():
        other = heads.encode(params, state, obs | {name: random_obs(MIXED, seed=1)[name]})
        same = np.asarray(tokens == other)
        assert not same[..., changed].all()
        rest = np.ones(heads.token_size, bool)
        rest[changed] = False
        assert same[..., rest].all()


def test_predictions_of_one_kind_do_not_depend_on_the_order_of_the_keys():
    heads, params, state = make(dict(reversed(MIXED.items())))
    other, _, _ = make(MIXED)
    obs = random_obs(MIXED)
    shuffled = dict(reversed(obs.items()))
    np.testing.assert_array_equal(
        heads.encode(params, state, shuffled), other.encode(params, state, obs)
    )


@pytest.mark.parametrize(
    ("obs", "message"),
    [
        (image(60), "obs=60: use a multiple of 16 from 48 to 256, such as 64, 96 or 128"),
        (image(32), "obs=32: use a multiple of 16"),
        (image(272), "obs=272: use a multiple of 16"),
        (ArraySpec((64, 48, 3), jnp.uint8), r"obs=\(64, 48, 3\): images are \[size, size"),
        (ArraySpec((64, 64), jnp.uint8), "images are"),
        (ArraySpec((4,), jnp.int32), r"obs='int32\[4\]': vectors are float32"),
        (ArraySpec((4, 2), jnp.float32), "vectors are float32 of one dimension"),
        ({"a": image(64), "b": image(96)}, r"obs=\[64, 96\]: all images"),
        ({"a": vector(2), "b": image(40)}, r"obs\['b'\]=40: use a multiple"),
    ],
)
def test_observations_that_cannot_be_read_are_refused(obs, message):
    with pytest.raises(InvalidInput, match=message):
        make(obs)


def test_sizes_of_images_are_those_that_can_be_halved():
    assert types.IMAGE_SIZES.step == 2**nets.HALVINGS
