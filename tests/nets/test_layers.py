"""Layers against numpy, and the block GRU against its definition block by block."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from nets_twin import block_gru_twin, float64, layer, noisy, params_of

from vawm import nets


def test_a_linear_layer_of_two_inputs_reads_their_concatenation():
    module = nets.Linear(5, 3)
    x, y = jnp.arange(4.0).reshape(2, 2), jnp.ones((2, 3))
    params = noisy(params_of(module, x, y))
    actual = module.apply({"params": params}, x, y)
    p = float64(params)
    expected = np.concatenate([x, y], -1) @ p["kernel"] + p["bias"]
    np.testing.assert_allclose(actual, expected, rtol=1e-6)


def test_a_linear_layer_refuses_inputs_of_the_wrong_width():
    with pytest.raises(ValueError, match=r"takes 5 features, got \[2, 2\]"):
        params_of(nets.Linear(5, 3), jnp.ones((1, 2)), jnp.ones((1, 2)))


def test_an_mlp_is_linear_norm_silu_in_each_hidden_layer():
    module = nets.MLP(4, 2, 8, (3, 2), (1.0, 0.0))
    x = jax.random.normal(jax.random.key(2), (5, 4))
    params = params_of(module, x)
    np.testing.assert_array_equal(params["heads_1"]["kernel"], 0.0)
    params = noisy(params)
    hidden, p = np.asarray(x, np.float64), float64(params)
    for name in ("hidden_0", "hidden_1"):
        hidden = layer(p[name], hidden)
    for head, actual in enumerate(module.apply({"params": params}, x)):
        out = p[f"heads_{head}"]
        np.testing.assert_allclose(actual, hidden @ out["kernel"] + out["bias"], atol=1e-5)


def test_initial_weights_have_the_scale_of_their_fan_in():
    kernel = params_of(nets.Linear(400, 300), jnp.ones((1, 400)))["kernel"]
    np.testing.assert_allclose(kernel.std(), 1 / np.sqrt(400), rtol=0.02)
    assert abs(kernel).max() <= 2 * nets.UNIT_VARIANCE / np.sqrt(400) + 1e-6


def test_block_kernels_use_the_full_input_width_as_fan_in():
    gru = nets.BlockGRU(deter=256, hidden=32, stoch=16, action=2, blocks=8)
    params = gru.init(jax.random.key(0), jnp.zeros((1, 2)), method="drive")["params"]
    mix, gate = params["mix_kernel"], params["gate_kernel"]
    assert mix.shape == (8, 32 + 3 * 32, 32)
    assert gate.shape == (8, 32, 96)
    np.testing.assert_allclose(mix.std(), 1 / np.sqrt(256 + 3 * 32 * 8), rtol=0.02)
    np.testing.assert_allclose(gate.std(), 1 / np.sqrt(256), rtol=0.02)


def test_the_block_gru_matches_its_definition_block_by_block():
    gru = nets.BlockGRU(deter=24, hidden=6, stoch=10, action=3, blocks=4)
    keys = jax.random.split(jax.random.key(3), 3)
    h, z, a = (
        jax.random.normal(k, (5, width)) * 2 for k, width in zip(keys, (24, 10, 3), strict=True)
    )

    def step(module, h, z, a):
        return module.from_blocks(module(module.to_blocks(h), h, z, module.drive(a)))

    params = noisy(gru.init(jax.random.key(0), h, z, a, method=step)["params"])
    actual = gru.apply({"params": params}, h, z, a, method=step)
    expected = block_gru_twin(float64(params), *float64((h, z, a)), blocks=4)
    np.testing.assert_allclose(actual, expected, atol=2e-6)


def test_large_actions_are_scaled_to_one():
    gru = nets.BlockGRU(deter=8, hidden=4, stoch=4, action=2, blocks=2)
    params = gru.init(jax.random.key(0), jnp.zeros((1, 2)), method="drive")
    drive = gru.apply(params, jnp.array([[5.0, -3.0], [1.0, -1.0]]), method="drive")
    np.testing.assert_array_equal(drive[0], drive[1])
