"""The tiny configuration with STORM instead of DreamerV3."""

from __future__ import annotations

import dataclasses
from typing import Any

import tiny

from vawm import presets
from vawm.config import AdamConfig, Config, StormConfig

CONFIG = dataclasses.replace(
    tiny.CONFIG,
    agent="storm",
    world_model=StormConfig(
        deter=32,
        stoch=4,
        classes=4,
        units=16,
        depth=1,
        bins=41,
        heads=2,
        feedforward=24,
        positions=16,
        act_context=5,
    ),
    actor=dataclasses.replace(presets.STORM.actor, layers=1, units=16),
    critic=dataclasses.replace(presets.STORM.critic, layers=1, units=16, bins=41),
    imagination=dataclasses.replace(
        presets.STORM.imagination, horizon=3, batch_size=6, context_length=4
    ),
    optimizer=AdamConfig(learning_rate=1e-3, behaviour_learning_rate=1e-2),
)


def config(**changes: Any) -> Config:
    """`CONFIG` with some top-level fields replaced."""
    return dataclasses.replace(CONFIG, **changes)


def storm(like: Config, **changes: Any) -> Config:
    """`like` with tiny STORM as its agent, and with `changes`."""
    names = ("agent", "world_model", "actor", "critic", "imagination", "optimizer")
    return dataclasses.replace(
        like, **{name: getattr(CONFIG, name) for name in names} | changes
    )


def model(**changes: Any) -> StormConfig:
    """The world model of `CONFIG`, with some fields replaced."""
    return dataclasses.replace(CONFIG.world_model, **changes)
