"""The discount: gamma, and how it is read from the continue head."""

from __future__ import annotations

import math

import jax

from vawm.config import Config
from vawm.types import Array


def discount_of(config: Config) -> float:
    """gamma = 1 - 1 / horizon."""
    return 1.0 - 1.0 / config.imagination.discount_horizon


def read_discount(config: Config, logit: Array) -> Array:
    """gamma * P(continue) from a continue logit `[...]`; or gamma if likely, else 0.

    With `continue_target="discounted"` the head has learned gamma * P(continue) itself.
    """
    gamma, plain = discount_of(config), config.world_model.continue_target == "plain"
    if config.imagination.continuation == "threshold":
        # P(continue) = 1/2 is a logit of 0, or that of gamma / 2 if the head has learned gamma.
        limit = 0.0 if plain else math.log(gamma / (2.0 - gamma))
        return gamma * (logit >= limit).astype(logit.dtype)
    return gamma * jax.nn.sigmoid(logit) if plain else jax.nn.sigmoid(logit)
