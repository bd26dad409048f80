"""Actor and critic: pure functions of a latent."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import NamedTuple

import jax.numpy as jnp

from vawm import nets
from vawm.config import ActorConfig, CriticConfig
from vawm.errors import InvalidInput
from vawm.losses import transforms
from vawm.losses.transforms import TwoHot
from vawm.nets import distributions
from vawm.nets.distributions import ActionDistribution
from vawm.types import Array, EnvSpec, Key, Latent, PyTree, features


class Actor(NamedTuple):
    """Pure functions of a stochastic policy pi(a | s), Eq. 6.

    Attributes:
      init: `(key) -> params`.
      policy: `(params, latent) -> ActionDistribution`, what the losses and imagination use.
      behaviour: the same at `collect_temperature`, what acts while experience is collected.
    """

    init: Callable[[Key], PyTree]
    policy: Callable[[PyTree, Latent], ActionDistribution]
    behaviour: Callable[[PyTree, Latent], ActionDistribution]


class Critic(NamedTuple):
    """Pure functions of a distributional critic V(v | s), Eq. 6."""

    init: Callable[[Key], PyTree]
    logits: Callable[[PyTree, Latent], Array]  # [..., bins]
    code: TwoHot  # values as logits over bins, and back


def make_actor(
    config: ActorConfig, spec: EnvSpec, feature_size: int, dtype: jnp.dtype = jnp.float32
) -> Actor:
    """A one-hot categorical for discrete actions, a bounded normal for continuous ones.

    Raises:
      InvalidInput: a temperature for continuous actions.
    """
    if not spec.discrete and config.collect_temperature != 1.0:
        remedy = "use 1: continuous actions have no temperature"
        raise InvalidInput("actor.collect_temperature", config.collect_temperature, remedy)
    heads = 1 if spec.discrete else 2
    outputs = (spec.action_size,) * heads
    net = make_network(config, feature_size, outputs, scale=0.01, dtype=dtype)

    def init(key: Key) -> PyTree:
        return net.init(key, jnp.zeros((1, feature_size), dtype))["params"]

    def read(params: PyTree, latent: Latent) -> list[Array]:
        outputs = net.apply({"params": params}, *features(latent))
        return [jnp.asarray(x, jnp.float32) for x in outputs]

    def discrete(
        params: PyTree, latent: Latent, temperature: float = 1.0
    ) -> ActionDistribution:
        (logits,) = read(params, latent)
        return distributions.one_hot_categorical(logits / temperature, unimix=config.unimix)

    def continuous(params: PyTree, latent: Latent) -> ActionDistribution:
        mean, std_logit = read(params, latent)
        return distributions.bounded_normal(
            mean, std_logit, min_std=config.min_std, max_std=config.max_std
        )

    if not spec.discrete:
        return Actor(init, continuous, continuous)
    cooled = functools.partial(discrete, temperature=config.collect_temperature)
    return Actor(init, discrete, cooled)


def make_critic(
    config: CriticConfig, feature_size: int, dtype: jnp.dtype = jnp.float32
) -> Critic:
    """A critic with two-hot values. DreamerV3's starts at 0: its last layer is zero."""
    net = make_network(config, feature_size, (config.bins,), scale=0.0, dtype=dtype)

    def init(key: Key) -> PyTree:
        return net.init(key, jnp.zeros((1, feature_size), dtype))["params"]

    def logits(params: PyTree, latent: Latent) -> Array:
        return net.apply({"params": params}, *features(latent))[0].astype(jnp.float32)

    return Critic(init, logits, transforms.make_two_hot(config.bins, config.bin_spacing))


def make_network(
    config: ActorConfig | CriticConfig,
    feature_size: int,
    outputs: tuple[int, ...],
    *,
    scale: float,
    dtype: jnp.dtype,
) -> nets.MLP | nets.ReluMLP:
    """The layers. `scale` is for DreamerV3's initial output weights; STORM uses PyTorch's."""
    sizes = feature_size, config.layers, config.units, outputs
    if config.network == "storm":
        return nets.ReluMLP(*sizes, dtype=dtype)
    return nets.MLP(*sizes, scales=(scale,) * len(outputs), dtype=dtype)
