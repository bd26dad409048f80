"""Values of `Config` by suite and name: the paper's setting, and small ones for a CPU."""

from __future__ import annotations

import dataclasses
from typing import Any

from vawm.config import (
    AtariConfig,
    Config,
    GymnasiumConfig,
    ImaginationConfig,
    OptimizerConfig,
    ReplayConfig,
    ValueAlignmentConfig,
    VideoConfig,
    VisionConfig,
    with_size,
)

PAPER = Config()

QUICK = dataclasses.replace(
    with_size(PAPER, "1m"),
    preset="quick",
    env_steps=120_000,
    num_envs=8,
    action_repeat=4,
    train_ratio=64,
    log_every=2_000,
    save_every=24_000,
    imagination=ImaginationConfig(discount_horizon=150.0),
    value_alignment=ValueAlignmentConfig(warmup_steps=7_200),
    optimizer=OptimizerConfig(learning_rate=6e-4, warmup_updates=300),
    replay=ReplayConfig(batch_size=8, batch_length=32),
)
"""For a CPU with 2 cores: steps in the simulation cost little there and updates much, so it
takes few small updates at a high learning rate, and long actions."""

SMALL = ("size", "world_model", "actor", "critic", "imagination", "optimizer", "replay")
"""What the small presets of the other suites take from `QUICK`: all that an update costs."""


def small(config: Config, **changes: Any) -> Config:
    """`config` with the updates of `QUICK`, and further changes."""
    taken = {name: getattr(QUICK, name) for name in SMALL}
    return dataclasses.replace(config, preset="quick", **taken | changes)


VISION_PAPER = dataclasses.replace(
    PAPER,
    suite="dmc_vision",
    task="walker_walk",
    env_steps=1_000_000,
    video=VideoConfig(every=50_000),
    env=VisionConfig(),
)
"""DMC vision; batch, train ratio and action repeat as for the proprio tasks."""

VISION_QUICK = small(
    VISION_PAPER,
    task="cartpole_balance",
    env_steps=60_000,
    num_envs=8,
    action_repeat=4,
    train_ratio=64,
    save_every=12_000,
    value_alignment=ValueAlignmentConfig(warmup_steps=3_600),
    video=VideoConfig(every=20_000),
)

ATARI_PAPER = dataclasses.replace(
    PAPER,
    suite="atari100k",
    task="breakout",
    env_steps=400_000,
    num_envs=1,
    action_repeat=4,
    train_ratio=256,
    save_every=40_000,
    value_alignment=ValueAlignmentConfig(warmup_steps=40_000),
    video=VideoConfig(every=40_000),
    env=AtariConfig(),
)
"""100,000 agent steps of 4 frames each; the warm-up is 10,000 of them, since the paper's text
calls the agent's steps training steps. The train ratio is the official code's."""

ATARI_QUICK = small(
    ATARI_PAPER,
    env_steps=80_000,
    train_ratio=32,
    save_every=16_000,
    value_alignment=ValueAlignmentConfig(warmup_steps=8_000),
    video=VideoConfig(every=20_000),
)

GYMNASIUM_QUICK = dataclasses.replace(
    QUICK,
    suite="gymnasium",
    task="CartPole-v1",
    env_steps=30_000,
    action_repeat=1,
    save_every=6_000,
    value_alignment=ValueAlignmentConfig(warmup_steps=1_800),
    env=GymnasiumConfig(),
)

GYMNASIUM_PIXELS = dataclasses.replace(
    GYMNASIUM_QUICK,
    preset="pixels",
    task="vawm/GridWorld-v0",
    env_steps=16_000,
    train_ratio=32,
    save_every=4_000,
    value_alignment=ValueAlignmentConfig(warmup_steps=960),
    video=VideoConfig(every=4_000),
)
"""As quick, for images: an update takes several times as long, so there are fewer."""

PRESETS = {
    "dmc_proprio": {"quick": QUICK, "paper": PAPER},
    "dmc_vision": {"quick": VISION_QUICK, "paper": VISION_PAPER},
    "atari100k": {"quick": ATARI_QUICK, "paper": ATARI_PAPER},
    "gymnasium": {"quick": GYMNASIUM_QUICK, "pixels": GYMNASIUM_PIXELS},
}
"""Suite -> name -> config."""
