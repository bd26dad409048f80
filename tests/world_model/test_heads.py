"""Heads for vectors, images and both: what they read, what they predict, what they refuse."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tiny

from vawm import nets, types
from vawm.config import HeadsConfig
from vawm.errors import InvalidInput
from vawm.types import ArraySpec, EnvSpec, Latent, features, image, vector
from vawm.world_model.heads import make_heads

CONFIG = dataclasses.replace(tiny.CONFIG.world_model, depth=2)
LEADING = 2, 3


def spec(obs):
    return EnvSpec("test", obs, 3, False, 2, 1, None)


def make(obs, config=CONFIG):
    """Functions that encode and decode with fresh parameters, and the heads themselves."""
    heads = make_heads(config, spec(obs), jnp.float32)
    params, model_state = heads.init(jax.random.key(0))
    assert not jax.tree.leaves(model_state)  # nothing is carried

    def encode(obs):
        return heads.encode(params, model_state, obs)[0]

    def decode(latent):
        return heads.decode(params, model_state, features(latent))[0]

    return heads, params, encode, decode


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
    heads, _, encode, decode = make(image(size))
    tokens = jax.jit(encode)(random_obs(image(size)))
    assert tokens.shape == (*LEADING, heads.token_size)
    assert heads.token_size == (size // 16) ** 2 * 4 * CONFIG.depth
    predicted = jax.jit(decode)(latent())
    assert predicted.shape == (*LEADING, size, size, 3)
    assert ((predicted > 0) & (predicted < 1)).all()


def test_images_are_read_as_bytes_between_minus_and_plus_a_half():
    _, params, encode, _ = make(image(64))
    obs = random_obs(image(64))
    pixels = np.asarray(obs, np.float32).reshape(6, 64, 64, 3) / 255 - 0.5
    cnn = nets.ImageEncoder(3, CONFIG.depth)
    expected = cnn.apply({"params": params["encoder"]["image"]}, pixels)
    np.testing.assert_allclose(encode(obs).reshape(6, -1), expected, rtol=1e-5, atol=1e-6)


MIXED = {"camera": image(48), "joints": vector(4), "speed": vector(2), "top": image(48, 1)}


def test_images_and_vectors_are_mixed_and_each_is_predicted_at_its_place():
    heads, _, encode, decode = make(MIXED)
    obs = random_obs(MIXED)
    tokens = encode(obs)
    assert heads.token_size == CONFIG.units + 3 * 3 * 4 * CONFIG.depth
    predicted = decode(latent())
    assert {k: x.shape for k, x in predicted.items()} == {k: x.shape for k, x in obs.items()}
    read = {"joints": slice(None, CONFIG.units), "top": slice(CONFIG.units, None)}
    for name, changed in read.items():
        other = encode(obs | {name: random_obs(MIXED, seed=1)[name]})
        same = np.asarray(tokens == other)
        assert not same[..., changed].all()
        rest = np.ones(heads.token_size, bool)
        rest[changed] = False
        assert same[..., rest].all()


def test_predictions_of_one_kind_do_not_depend_on_the_order_of_the_keys():
    _, _, encode_shuffled, _ = make(dict(reversed(MIXED.items())))
    _, _, encode, _ = make(MIXED)
    obs = random_obs(MIXED)
    shuffled = dict(reversed(obs.items()))
    np.testing.assert_array_equal(encode_shuffled(shuffled), encode(obs))


@pytest.mark.parametrize(
    ("obs", "field", "value"),
    [
        (image(60), "obs", 60),
        (image(32), "obs", 32),
        (image(272), "obs", 272),
        (ArraySpec((64, 48, 3), jnp.uint8), "obs", (64, 48, 3)),
        (ArraySpec((64, 64), jnp.uint8), "obs", (64, 64)),
        (ArraySpec((4,), jnp.int32), "obs", "int32[4]"),
        (ArraySpec((4, 2), jnp.float32), "obs", "float32[4, 2]"),
        ({"a": image(64), "b": image(96)}, "obs", [64, 96]),
        ({"a": vector(2), "b": image(40)}, "obs['b']", 40),
    ],
)
def test_observations_that_cannot_be_read_are_refused(obs, field, value):
    with pytest.raises(InvalidInput) as error:
        make(obs)
    assert (error.value.field, error.value.value) == (field, value)


@pytest.mark.parametrize("obs", [vector(3), image(48), MIXED])
def test_the_fields_of_a_heads_config_are_enough(obs):
    """A world model of a user's own has no fields of an RSSM."""
    names = [field.name for field in dataclasses.fields(HeadsConfig)]
    config = HeadsConfig(**{name: getattr(CONFIG, name) for name in names})
    own, params, encode, _ = make(obs, config)
    rssm, expected, *_ = make(obs)
    assert params.keys() == {"encoder", "decoder", "reward", "cont"}
    jax.tree.map(np.testing.assert_array_equal, params, expected)
    assert encode(random_obs(obs)).shape == (*LEADING, rssm.token_size)
    logits, logit = own.outcome(params, features(latent()))
    assert logits.shape == (*LEADING, CONFIG.bins)
    assert logit.shape == LEADING
    np.testing.assert_array_equal(logits, 0.0)


def test_sizes_of_images_are_those_that_can_be_halved():
    assert types.IMAGE_SIZES.step == 2**nets.HALVINGS
