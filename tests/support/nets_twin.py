"""Layers in numpy and float64, and parameters moved away from their initial values."""

import jax
import numpy as np


def params_of(module, *inputs):
    return module.init(jax.random.key(0), *inputs)["params"]


def noisy(params):
    """Adds noise to parameters, so that no bias is 0 and no norm scale is 1."""
    leaves, tree = jax.tree.flatten(params)
    keys = jax.random.split(jax.random.key(1), len(leaves))
    return jax.tree.unflatten(
        tree,
        [x + 0.1 * jax.random.normal(k, x.shape) for k, x in zip(keys, leaves, strict=True)],
    )


def silu(x):
    return x / (1 + np.exp(-x))


def sigmoid(x):
    return 1 / (1 + np.exp(-x))


def rms(x, scale):
    return x / np.sqrt((x**2).mean(-1, keepdims=True) + 1e-4) * scale


def layer(params, x):
    linear = params["linear"]
    return silu(rms(x @ linear["kernel"] + linear["bias"], params["norm"]))


def float64(tree):
    return jax.tree.map(lambda x: np.asarray(x, np.float64), tree)


def block_gru_twin(p, h, z, a, blocks):
    """Computes one step, block by block, with x copied to every block."""
    a = a / np.maximum(1.0, np.abs(a))
    x = np.concatenate(
        [layer(p["from_deter"], h), layer(p["from_stoch"], z), layer(p["from_action"], a)], -1
    )
    parts = np.split(h, blocks, -1)
    mixed = [np.concatenate([part, x], -1) @ p["mix_kernel"][k] for k, part in enumerate(parts)]
    mixed = silu(rms(np.concatenate(mixed, -1) + p["mix_bias"], p["mix_norm"]))
    biases = np.split(p["gate_bias"], blocks)
    out = []
    for k, (part, own) in enumerate(zip(np.split(mixed, blocks, -1), parts, strict=True)):
        reset, candidate, update = np.split(part @ p["gate_kernel"][k] + biases[k], 3, -1)
        update = sigmoid(update - 1)
        out.append(update * np.tanh(sigmoid(reset) * candidate) + (1 - update) * own)
    return np.concatenate(out, -1)
