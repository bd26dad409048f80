"""The tiny configuration with VaGraM instead of DreamerV3."""

import dataclasses

import tiny

from vawm.config import VagramConfig, ValueAlignmentConfig

CONFIG = dataclasses.replace(
    tiny.CONFIG,
    agent="vagram",
    world_model=VagramConfig(
        deter=32, hidden=16, stoch=4, classes=4, units=16, blocks=4, bins=41
    ),
    value_alignment=ValueAlignmentConfig(weight="off"),
)
