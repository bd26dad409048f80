"""Image encoder and decoder against 5 x 5 convolutions written out in numpy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from nets_twin import float64, layer, noisy, params_of, rms, sigmoid, silu

from vawm import nets
from vawm.nets import convolution

SIZE, CHANNELS, DEPTH = 32, 3, 2
DETER, STOCH, UNITS, BLOCKS = 12, 6, 5, 4


def convolve(x, params):
    """`[N, H, W, in]` with `[5, 5, in, out]`, zeros around, tap by tap."""
    kernel, bias = params["kernel"], params["bias"]
    height, width = x.shape[1:3]
    padded = np.pad(x, ((0, 0), (2, 2), (2, 2), (0, 0)))
    result = np.zeros((*x.shape[:3], kernel.shape[-1])) + bias
    for i in range(5):
        for j in range(5):
            result += padded[:, i : i + height, j : j + width] @ kernel[i, j]
    return result


def pool(x):
    count, height, width, channels = x.shape
    result = np.zeros((count, height // 2, width // 2, channels))
    for i in range(height // 2):
        for j in range(width // 2):
            result[:, i, j] = x[:, 2 * i : 2 * i + 2, 2 * j : 2 * j + 2].max((1, 2))
    return result


def encode(params, x):
    for name in sorted(params):
        x = silu(rms(pool(convolve(x, params[name]["conv"])), params[name]["norm"]))
    return x.reshape(len(x), -1)


def decode(params, deter, stoch):
    side, top = SIZE // 16, 4 * DEPTH
    maps = np.zeros((len(deter), side, side, top))
    for k in range(BLOCKS):
        block = deter[:, k * DETER // BLOCKS : (k + 1) * DETER // BLOCKS]
        width = side * side * top // BLOCKS
        out = block @ params["deter_kernel"][k]
        out = out + params["deter_bias"][k * width : (k + 1) * width]
        group = top // BLOCKS
        out = out.reshape(-1, side, side, group)
        maps[..., k * group : (k + 1) * group] = out
    z = layer(params["stoch_layer"], stoch)
    z = z @ params["stoch_out"]["kernel"] + params["stoch_out"]["bias"]
    x = silu(rms(maps + z.reshape(maps.shape), params["norm"]))
    for i in range(3):
        stage = params[f"stages_{i}"]
        x = silu(rms(convolve(x.repeat(2, 1).repeat(2, 2), stage["conv"]), stage["norm"]))
    return sigmoid(convolve(x.repeat(2, 1).repeat(2, 2), params["conv"]))


def encoder():
    module = nets.ImageEncoder(CHANNELS, DEPTH)
    x = jax.random.normal(jax.random.key(2), (3, SIZE, SIZE, CHANNELS))
    return module, noisy(params_of(module, x)), x


def decoder():
    module = nets.ImageDecoder(
        deter=DETER,
        stoch=STOCH,
        units=UNITS,
        blocks=BLOCKS,
        size=SIZE,
        channels=CHANNELS,
        depth=DEPTH,
    )
    keys = jax.random.split(jax.random.key(3))
    inputs = [jax.random.normal(k, (3, n)) for k, n in zip(keys, (DETER, STOCH), strict=True)]
    return module, noisy(params_of(module, *inputs)), inputs


def test_the_encoder_convolves_pools_and_normalises_four_times():
    module, params, x = encoder()
    actual = module.apply({"params": params}, x)
    assert actual.shape == (3, (SIZE // 16) ** 2 * 4 * DEPTH)
    np.testing.assert_allclose(actual, encode(float64(params), np.asarray(x)), atol=2e-5)


def test_the_decoder_repeats_pixels_and_convolves_four_times():
    module, params, inputs = decoder()
    actual = module.apply({"params": params}, *inputs)
    assert actual.shape == (3, SIZE, SIZE, CHANNELS)
    expected = decode(float64(params), *float64(inputs))
    np.testing.assert_allclose(actual, expected, atol=2e-6)


@pytest.mark.parametrize("row", [0, 1, 7])
@pytest.mark.parametrize("column", [0, 6, 7])
def test_a_single_pixel_meets_every_tap_once(row, column):
    """Of a kernel of ones around one pixel: 25 ones, less what falls outside the image."""
    x = jnp.zeros((1, 8, 8, 1)).at[0, row, column, 0].set(1.0)
    kernel = jnp.ones((5, 5, 1, 1))
    blocks = convolution.convolve(convolution.to_blocks(x), convolution.pooled_kernel(kernel))
    actual = convolution.from_phases(blocks)[0, ..., 0]
    expected = np.zeros((8, 8))
    expected[max(0, row - 2) : row + 3, max(0, column - 2) : column + 3] = 1
    np.testing.assert_array_equal(actual, expected)


@pytest.mark.parametrize("batch", [3, 32])
def test_gradients_equal_those_of_the_plain_convolutions(batch):
    """Of several images at once too, as kernel gradients on CPU take them: 16 at a time."""
    module, params, x = encoder()
    x = jnp.resize(x, (batch, *x.shape[1:])) * jnp.linspace(0.5, 1, batch)[:, None, None, None]

    def plain(params, x):
        for name in sorted(params):
            kernel, bias = params[name]["conv"]["kernel"], params[name]["conv"]["bias"]
            x = jax.lax.conv_general_dilated(
                x, kernel, (1, 1), "SAME", dimension_numbers=("NHWC", "HWIO", "NHWC")
            )
            x = x + bias.reshape(1, 1, 1, -1)
            count, height, width, channels = x.shape
            x = x.reshape(count, height // 2, 2, width // 2, 2, channels).max((2, 4))
            x = jax.nn.silu(nets.rms_norm(x, params[name]["norm"]))
        return x.reshape(x.shape[0], -1)

    def loss(encode):
        return jax.jit(jax.grad(lambda params, x: jnp.sin(encode(params, x)).sum(), (0, 1)))

    actual = loss(lambda params, x: module.apply({"params": params}, x))(params, x)
    expected = loss(plain)(params, x)
    for a, b in zip(jax.tree.leaves(actual), jax.tree.leaves(expected), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-4 * abs(b).max())


def test_kernels_start_with_unit_gain():
    """So that a convolution of white noise has about the variance of its input."""
    module = nets.ImageEncoder(CHANNELS, 16)
    params = params_of(module, jnp.zeros((1, 16, 16, CHANNELS)))
    for name, inputs in [("stages_0", CHANNELS), ("stages_1", 32), ("stages_3", 64)]:
        kernel = np.asarray(params[name]["conv"]["kernel"])
        assert kernel.std() == pytest.approx(1 / np.sqrt(25 * inputs), rel=0.05)
        assert not params[name]["conv"]["bias"].any()


def test_the_decoder_s_map_starts_with_the_fan_in_of_all_of_h():
    module = nets.ImageDecoder(512, 128, 64, 8, 64, 3, 4)
    params = params_of(module, jnp.zeros((1, 512)), jnp.zeros((1, 128)))
    std = np.asarray(params["deter_kernel"]).std()
    assert std == pytest.approx(1 / np.sqrt(512), rel=0.05)


def test_bfloat16_products_keep_float32_parameters():
    module = nets.ImageEncoder(CHANNELS, DEPTH, jnp.bfloat16)
    x = jnp.zeros((1, SIZE, SIZE, CHANNELS))
    params = params_of(module, x)
    assert all(leaf.dtype == jnp.float32 for leaf in jax.tree.leaves(params))
    assert module.apply({"params": params}, x).dtype == jnp.bfloat16
