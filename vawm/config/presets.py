"""Values of `Config` by agent, suite and name: the paper's, and small ones for a CPU.

Programs look them up in `vawm.agent.registry`.
"""

from __future__ import annotations

import dataclasses
from typing import Any

from vawm.config import (
    RSSM_SIZES,
    STORM_SIZES,
    ActorConfig,
    AdamConfig,
    AtariConfig,
    Config,
    CriticConfig,
    EnvConfig,
    GymnasiumConfig,
    ImaginationConfig,
    LaPropConfig,
    ReplayConfig,
    StormConfig,
    VagramConfig,
    ValueAlignmentConfig,
    VideoConfig,
    VisionConfig,
    with_widths,
)

PAPER = Config()

QUICK = dataclasses.replace(
    with_widths(PAPER, "1m", RSSM_SIZES["1m"]._asdict()),
    preset="quick",
    env_steps=120_000,
    num_envs=8,
    action_repeat=4,
    train_ratio=64,
    log_every=2_000,
    save_every=24_000,
    imagination=ImaginationConfig(discount_horizon=150.0),
    value_alignment=ValueAlignmentConfig(warmup_steps=7_200),
    optimizer=LaPropConfig(learning_rate=6e-4, warmup_updates=300),
    replay=ReplayConfig(batch_size=8, batch_length=32),
)
"""For a CPU with 2 cores, where simulation is cheap and updates are expensive: few small
updates with a high learning rate, and an action repeat of 4."""

SMALL = ("size", "world_model", "actor", "critic", "imagination", "optimizer", "replay")
"""Fields that small presets of the other suites share with `QUICK`: what an update costs."""


def small(config: Config, **changes: Any) -> Config:
    """`config` with the small updates of `QUICK` and further changes."""
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
"""100,000 agent steps of 4 frames. The warm-up is 10,000 agent steps, which is what the paper
calls training steps. The train ratio is the official code's."""

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
"""Like quick, for images: fewer updates, since each takes several times as long."""

STORM = Config(
    suite="atari100k",
    task="breakout",
    agent="storm",
    size="16m",
    env_steps=408_000,
    num_envs=1,
    action_repeat=4,
    train_ratio=1024,
    random_steps=4_096,
    save_every=40_000,
    world_model=StormConfig(),
    actor=ActorConfig(layers=2, units=512, network="storm", unimix=0.0, entropy_scale=3e-4),
    critic=CriticConfig(
        layers=2,
        units=512,
        network="storm",
        bin_spacing="symlog",
        slow_target="returns",
        replay_scale=0.0,
    ),
    imagination=ImaginationConfig(
        horizon=16,
        discount_horizon=200 / 3,
        starts="contexts",
        value_index="current",
        continuation="threshold",
        reach_weights=False,
    ),
    value_alignment=ValueAlignmentConfig(warmup_steps=40_000),
    optimizer=AdamConfig(),
    replay=ReplayConfig(capacity=100_000),
    video=VideoConfig(every=40_000),
    env=AtariConfig(resize="area", noops=0, sticky=0.25, life_loss="terminal"),
)
"""STORM as in its official code and Table 14: 102,000 agent steps of 4 frames, the first 1,024
with random actions, and one update for every step."""

STORM_QUICK = dataclasses.replace(
    with_widths(STORM, "1m", STORM_SIZES["1m"]._asdict()),
    suite="dmc_proprio",
    task="cartpole_swingup",
    preset="quick",
    env_steps=QUICK.env_steps,
    num_envs=QUICK.num_envs,
    action_repeat=QUICK.action_repeat,
    train_ratio=QUICK.train_ratio,
    random_steps=0,
    log_every=QUICK.log_every,
    save_every=QUICK.save_every,
    imagination=dataclasses.replace(
        STORM.imagination,
        batch_size=256,
        discount_horizon=QUICK.imagination.discount_horizon,
    ),
    value_alignment=QUICK.value_alignment,
    optimizer=AdamConfig(learning_rate=6e-4, behaviour_learning_rate=3e-4),
    replay=QUICK.replay,
    video=VideoConfig(),
    env=EnvConfig(),
)
"""Like `QUICK`, for a CPU with 2 cores. In the paper STORM reads images only."""


def small_storm(like: Config) -> Config:
    """`like`, a run of DreamerV3, with STORM and its small updates instead."""
    taken = ("agent", "size", "world_model", "actor", "critic", "imagination", "optimizer")
    return dataclasses.replace(like, **{name: getattr(STORM_QUICK, name) for name in taken})


def vagram(like: Config) -> Config:
    """`like`, a run of DreamerV3, with a deterministic world model and VaGraM instead."""
    return dataclasses.replace(
        like,
        agent="vagram",
        world_model=VagramConfig(**RSSM_SIZES[like.size]._asdict()),
        value_alignment=dataclasses.replace(like.value_alignment, weight="off"),
    )


DREAMERV3 = {
    "dmc_proprio": {"quick": QUICK, "paper": PAPER},
    "dmc_vision": {"quick": VISION_QUICK, "paper": VISION_PAPER},
    "atari100k": {"quick": ATARI_QUICK, "paper": ATARI_PAPER},
    "gymnasium": {"quick": GYMNASIUM_QUICK, "pixels": GYMNASIUM_PIXELS},
}
"""Suite -> name -> config."""

STORM_PRESETS = {
    "dmc_proprio": {"quick": STORM_QUICK},
    "dmc_vision": {"quick": small_storm(VISION_QUICK)},
    "atari100k": {
        "quick": dataclasses.replace(small_storm(ATARI_QUICK), env=STORM.env),
        "paper": STORM,
    },
    "gymnasium": {
        "quick": small_storm(GYMNASIUM_QUICK),
        "pixels": dataclasses.replace(
            small_storm(GYMNASIUM_PIXELS),
            actor=dataclasses.replace(STORM_QUICK.actor, unimix=0.01, entropy_scale=3e-3),
        ),
    },
}

VAGRAM_PRESETS = {
    suite: {name: vagram(config) for name, config in named.items()}
    for suite, named in DREAMERV3.items()
}
