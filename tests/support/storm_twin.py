"""STORM's official architecture in plain numpy float64, written from its formulas.

The parameter trees are those of `vawm`; everything else is loops and matrix products. What is
random or has no gradient is given: the samples, and the numbers behind every stop-gradient.
Finite differences of the loss are therefore the gradients that the official code follows.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np


class Given(NamedTuple):
    """Values that stay fixed in a difference of the loss: those at the unmoved parameters."""

    one_hot: np.ndarray  # [B, T, S, K] samples of the posterior
    prior_one_hot: np.ndarray  # [B, T - 1, S, K] of the prior
    probs: np.ndarray  # the samples have their straight-through gradient
    prior_probs: np.ndarray
    post_log: np.ndarray  # log-probabilities of z
    prior_log: np.ndarray
    value_log: np.ndarray  # of the critic's classes at s and at its prediction
    prior_value_log: np.ndarray


def softmax_log(x):
    x = x - x.max(-1, keepdims=True)
    return x - np.log(np.exp(x).sum(-1, keepdims=True))


def linear(p, x):
    y = x @ p["kernel"]
    return y + p["bias"] if "bias" in p else y


def layer_norm(p, x, epsilon):
    x = x - x.mean(-1, keepdims=True)
    return x / np.sqrt((x**2).mean(-1, keepdims=True) + epsilon) * p["scale"] + p["bias"]


def mlp(p, x):
    """Hidden layers without bias, each with LayerNorm and ReLU; then the outputs."""
    for i in range(sum(name.startswith("hidden") for name in p)):
        x = np.maximum(layer_norm(p[f"norm_{i}"], linear(p[f"hidden_{i}"], x), 1e-5), 0)
    return linear(p["heads_0"], x) if "heads_0" in p else x


def batch_norm(p, x, statistics=None):
    """Batch norm with the statistics of the batch, or with the running ones if given."""
    axes = tuple(range(x.ndim - 1))
    mean, var = (x.mean(axes), x.var(axes)) if statistics is None else statistics
    return (x - mean) / np.sqrt(var + 1e-5) * p["scale"] + p["bias"]


def convolve(x, kernel):
    """4 x 4 kernel, stride 2, padded by one zero; `[N, H, W, in]`, `[4, 4, in, out]`."""
    x = np.pad(x, ((0, 0), (1, 1), (1, 1), (0, 0)))
    height, width = (x.shape[1] - 2) // 2, (x.shape[2] - 2) // 2
    y = np.zeros((x.shape[0], height, width, kernel.shape[-1]))
    for r in range(4):
        for s in range(4):
            y += x[:, r : r + 2 * height : 2, s : s + 2 * width : 2] @ kernel[r, s]
    return y


def convolve_transposed(x, kernel):
    """Adds the kernel times each pixel, 2 pixels apart; the outermost pixels are cut off."""
    count, height, width, _ = x.shape
    y = np.zeros((count, 2 * height + 2, 2 * width + 2, kernel.shape[-1]))
    for r in range(4):
        for s in range(4):
            y[:, r : r + 2 * height : 2, s : s + 2 * width : 2] += x @ kernel[r, s]
    return y[:, 1:-1, 1:-1]


def attention(p, x, heads):
    """One transformer block: post-norm, no dropout."""
    batch, length, width = x.shape
    query, key, value = np.split(linear(p["qkv"], x), 3, axis=-1)
    mixed = np.zeros_like(x)
    size = width // heads
    for b in range(batch):
        for head in range(heads):
            part = slice(head * size, (head + 1) * size)
            for t in range(length):
                scores = key[b, : t + 1, part] @ query[b, t, part] / np.sqrt(size)
                weights = np.exp(softmax_log(scores))
                mixed[b, t, part] = weights @ value[b, : t + 1, part]
    x = layer_norm(p["attention_norm"], x + linear(p["out"], mixed), 1e-6)
    wide = np.maximum(linear(p["wide"], x), 0)
    return layer_norm(p["feedforward_norm"], x + linear(p["narrow"], wide), 1e-6)


def transformer(p, stoch, action, heads):
    """h after every step of flat z `[B, T, S K]` and actions `[B, T, A]`."""
    x = np.concatenate([stoch, action], -1)
    x = np.maximum(layer_norm(p["mix_in_norm"], linear(p["mix_in"], x), 1e-5), 0)
    x = layer_norm(p["mix_out_norm"], linear(p["mix_out"], x), 1e-5)
    p = p["transformer"]
    x = layer_norm(p["norm"], x + p["position"][: x.shape[1]], 1e-6)
    for i in range(sum(name.startswith("layers") for name in p)):
        x = attention(p[f"layers_{i}"], x, heads)
    return x


def unimix_log(logits, share):
    probs = np.exp(softmax_log(logits))
    return np.log((1 - share) * probs + share / logits.shape[-1])


def two_hot_cross_entropy(logits, number):
    """Cross-entropy to a number coded as the two bins around its symlog."""
    y, n = np.sign(number) * np.log1p(abs(number)), logits.shape[-1]
    place = (y + 20) / 40 * (n - 1)
    below = int(np.floor(place))
    log = softmax_log(logits)
    return -((1 - (place - below)) * log[below] + (place - below) * log[below + 1])


def kl(p_log, q_log):
    return (np.exp(p_log) * (p_log - q_log)).sum(-1)


class Forward(NamedTuple):
    """The outputs of the networks, and the parts of the loss."""

    post_logits: np.ndarray  # [B, T, S, K] of the first T steps
    prior_logits: np.ndarray  # [B, T, S, K] of the last T steps
    deter: np.ndarray  # [B, T, D] of the last T steps
    parts: dict[str, Any]
    given: Given


def forward(params, critic, batch, config, one_hots, given=None, alignment=None) -> Forward:
    """The loss of the world model.

    Args:
      params: the world model's parameters, in float64.
      critic: the critic's parameters, which do not learn here.
      batch: a `Trajectory` of numpy arrays with images, `[B, T + 1, ...]`.
      config: a `StormConfig` without dropout.
      one_hots: samples of posterior and prior.
      given: see `Given`; computed from `params` if None.
      alignment: scales and weight of the value alignment, `(dynamics, representation)`.
    """
    obs = batch.obs[:, :-1]
    count, length = obs.shape[:2]
    leading = count, length
    pixels = obs.reshape(-1, *obs.shape[2:]) / 255.0
    cnn = params["encoder"]["image"]
    x = pixels
    for i in range(4):
        stage = cnn[f"stages_{i}"]
        x = np.maximum(batch_norm(stage["norm"], convolve(x, stage["kernel"])), 0)
    shape = *leading, config.stoch, config.classes
    net = params["storm"]
    post_logits = linear(net["posterior_out"], x.reshape(*leading, -1)).reshape(shape)
    post_log = unimix_log(post_logits, config.unimix)
    one_hot, prior_one_hot = one_hots
    probs = np.exp(post_log) if given is None else given.probs
    stoch = one_hot + np.exp(post_log) - probs
    flat = stoch.reshape(*leading, -1)
    deter = transformer(net, flat, batch.action[:, :-1], config.heads)
    prior_logits = linear(net["prior_out"], deter).reshape(shape)
    prior_log = unimix_log(prior_logits, config.unimix)
    prior_probs = np.exp(prior_log)[:, :-1] if given is None else given.prior_probs
    prior_stoch = prior_one_hot + np.exp(prior_log)[:, :-1] - prior_probs

    def value(z):
        state = np.concatenate([deter[:, :-1], z.reshape(*z.shape[:2], -1)], -1)
        return softmax_log(mlp(critic, state))

    value_log, prior_value_log = value(stoch[:, 1:]), value(prior_stoch)
    if given is None:
        given = Given(
            *(one_hot, prior_one_hot, probs, prior_probs),
            *(post_log[:, 1:], prior_log[:, :-1], value_log, prior_value_log),
        )
    cnn = params["decoder"]["image"]
    x = np.tensordot(flat.reshape(count * length, -1), cnn["kernel"], axes=1)
    x = np.maximum(batch_norm(cnn["norm"], x), 0)
    for i in range(3):
        stage = cnn[f"stages_{i}"]
        x = np.maximum(batch_norm(stage["norm"], convolve_transposed(x, stage["kernel"])), 0)
    x = convolve_transposed(x, cnn["out_kernel"]) + cnn["out_bias"]
    reward_logits, logits = (mlp(params[name], deter) for name in ("reward", "cont"))
    rewards, continues = [], []
    for b in range(count):
        for t in range(length):  # h after step t predicts what arrives at t + 1
            rewards.append(two_hot_cross_entropy(reward_logits[b, t], batch.reward[b, t + 1]))
            termination, ends = -logits[b, t, 0], batch.is_terminal[b, t + 1]
            continues.append(np.log1p(np.exp(termination)) - ends * termination)
    dynamics = kl(given.post_log, prior_log[:, :-1]).sum(-1)
    representation = kl(post_log[:, 1:], given.prior_log).sum(-1)
    parts = {
        "loss/reconstruction": ((x - pixels) ** 2).sum((1, 2, 3)).mean(),
        "loss/reward": np.mean(rewards),
        "loss/continue": np.mean(continues),
        "loss/dynamics": config.dynamics_scale * max(config.free_nats, dynamics.mean())
        + config.representation_scale * max(config.free_nats, representation.mean()),
    }
    if alignment is not None:
        weight = 1 / np.maximum(1, kl(given.post_log, given.prior_log).sum(-1))
        first, second = alignment
        aligned = first * kl(given.value_log, prior_value_log)
        aligned += second * kl(value_log, given.prior_value_log)
        parts["loss/value_alignment"] = (weight * aligned).mean()
    return Forward(post_logits, prior_logits, deter, parts, given)
