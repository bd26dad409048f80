"""Actor and critic: pure functions of a latent."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp

from vawm import distributions, nets, transforms
from vawm.config import ActorConfig, CriticConfig
from vawm.distributions import Policy
from vawm.types import Array, EnvSpec, Key, Latent, PyTree


class Actor(NamedTuple):
    """Pure functions of a stochastic policy pi(a | s), Eq. 6."""

    init: Callable[[Key], PyTree]
    policy: Callable[[PyTree, Latent], Policy]


class Critic(NamedTuple):
    """Pure functions of a distributional critic V(v | s), Eq. 6."""

    init: Callable[[Key], PyTree]
    logits: Callable[[PyTree, Latent], Array]  # [..., bins]
    mean: Callable[[Array], Array]  # [..., bins] -> [...], in environment units
    bins: Array  # [bins] values of the two-hot bins


def features(latent: Latent) -> tuple[Array, Array]:
    """[h, z] as the pair of inputs that networks read."""
    return latent.deter, latent.stoch.reshape(*latent.stoch.shape[:-2], -1)


def make_actor(
    config: ActorConfig, spec: EnvSpec, feature_size: int, dtype: jnp.dtype = jnp.float32
) -> Actor:
    """A one-hot categorical or a bounded normal, by the kind of action in `spec`."""
    heads = 1 if spec.discrete else 2
    net = nets.MLP(
        feature_size,
        config.layers,
        config.units,
        (spec.action_size,) * heads,
        (0.01,) * heads,
        dtype,
    )

    def init(key: Key) -> PyTree:
        return net.init(key, jnp.zeros((1, feature_size), dtype))["params"]

    def policy(params: PyTree, latent: Latent) -> Policy:
        outputs = net.apply({"params": params}, *features(latent))
        outputs = [jnp.asarray(x, jnp.float32) for x in outputs]
        if spec.discrete:
            return distributions.one_hot_categorical(*outputs, unimix=config.unimix)
        return distributions.bounded_normal(
            *outputs, min_std=config.min_std, max_std=config.max_std
        )

    return Actor(init, policy)


def make_critic(
    config: CriticConfig, feature_size: int, dtype: jnp.dtype = jnp.float32
) -> Critic:
    """Symexp two-hot critic whose last layer starts at zero, so it starts by predicting 0."""
    bins = transforms.symexp_bins(config.bins)
    net = nets.MLP(feature_size, config.layers, config.units, (config.bins,), (0.0,), dtype)

    def init(key: Key) -> PyTree:
        return net.init(key, jnp.zeros((1, feature_size), dtype))["params"]

    def logits(params: PyTree, latent: Latent) -> Array:
        return net.apply({"params": params}, *features(latent))[0].astype(jnp.float32)

    def mean(logits: Array) -> Array:
        return transforms.two_hot_mean(logits, bins)

    return Critic(init, logits, mean, bins)
