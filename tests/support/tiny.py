"""The one tiny configuration that tests share, so that its update is compiled once.

`CONFIG` is a whole run in miniature: 2 environments, 8 collected steps and one update per
chunk, in the probe of `env()`. Replay wraps, and its size does not change with `env_steps`.
"""

from __future__ import annotations

import dataclasses
from typing import Any

from vawm import config as config_lib
from vawm.envs import Environment, probes

CONFIG = config_lib.Config(
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
    world_model=config_lib.RSSMConfig(
        deter=32, hidden=16, stoch=4, classes=4, units=16, blocks=4, bins=41
    ),
    actor=config_lib.ActorConfig(layers=1, units=16),
    critic=config_lib.CriticConfig(layers=1, units=16, bins=41),
    imagination=config_lib.ImaginationConfig(horizon=3),
    value_alignment=config_lib.ValueAlignmentConfig(warmup_steps=24),
    optimizer=config_lib.LaPropConfig(learning_rate=1e-3, warmup_updates=2),
    replay=config_lib.ReplayConfig(capacity=64, batch_size=2, batch_length=8),
)


def config(**changes: Any) -> config_lib.Config:
    """`CONFIG` with some top-level fields replaced."""
    return dataclasses.replace(CONFIG, **changes)


def env() -> Environment:
    """The environment of `CONFIG`."""
    return probes.make("observation_action", num_envs=CONFIG.num_envs)
