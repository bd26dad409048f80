"""The tiny configuration that tests share, so that its update is compiled once.

`CONFIG` is a whole run in miniature: 2 environments, 8 collected steps and one update per
chunk, in the probe that `env()` makes. Replay wraps; its size does not depend on `env_steps`.
"""

from __future__ import annotations

import dataclasses
from typing import Any

from vawm.config import (
    ActorConfig,
    Config,
    CriticConfig,
    ImaginationConfig,
    LaPropConfig,
    ReplayConfig,
    RSSMConfig,
    ValueAlignmentConfig,
)
from vawm.envs import Environment, probes

CONFIG = Config(
    task="probe_observation_action",
    preset="custom",
    size="custom",
    seed=0,
    env_steps=96,
    num_envs=2,
    action_repeat=1,
    train_ratio=3,
    collect_steps=4,
    compute_dtype="float32",
    log_every=16,
    save_every=32,
    world_model=RSSMConfig(
        deter=32, hidden=16, stoch=4, classes=4, units=16, blocks=4, bins=41
    ),
    actor=ActorConfig(layers=1, units=16),
    critic=CriticConfig(layers=1, units=16, bins=41),
    imagination=ImaginationConfig(horizon=3),
    value_alignment=ValueAlignmentConfig(warmup_steps=24),
    optimizer=LaPropConfig(learning_rate=1e-3, warmup_updates=2),
    replay=ReplayConfig(capacity=64, batch_size=2, batch_length=8),
)


def config(**changes: Any) -> Config:
    """`CONFIG` with some top-level fields replaced."""
    return dataclasses.replace(CONFIG, **changes)


def env() -> Environment:
    """The environment of `CONFIG`."""
    return probes.make("observation_action", num_envs=CONFIG.num_envs)
