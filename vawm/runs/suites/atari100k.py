"""Atari 100k: 26 games, in the Arcade Learning Environment."""

from __future__ import annotations

import functools

from vawm.config import AtariConfig, Config
from vawm.envs.host import atari
from vawm.envs.host.frames import check_smaller
from vawm.envs.host.pool import Pool
from vawm.envs.protocol import check_image_size
from vawm.errors import BELOW_ONE, NOT_NEGATIVE, InvalidInput
from vawm.runs.suites import on_host
from vawm.runs.suites.record import Protocol, Suite


def check(config: Config, env: AtariConfig) -> None:
    """Refuses to see more frames than a step has, and impossible images.

    Raises:
      InvalidInput: names the field and the remedy.
    """
    if env.pooling > config.action_repeat:
        remedy = f"use at most action_repeat={config.action_repeat}, the frames of a step"
        raise InvalidInput("env.pooling", env.pooling, remedy)
    if env.resize == "area":
        check_smaller("env.image_size", env.image_size)
    check_image_size("env.image_size", env.image_size)


def make(config: Config, env: AtariConfig) -> Pool:
    """The environments of a run, in processes of their own."""
    simulator = functools.partial(
        atari.AtariSimulator,
        config.task,
        frame_skip=config.action_repeat,
        pooling=env.pooling,
        image_size=env.image_size,
        resize=env.resize,
        noops=env.noops,
        sticky=env.sticky,
        life_loss=env.life_loss,
        clip_reward=env.clip_reward,
        max_frames=env.max_frames,
        full_action_set=env.full_action_set,
    )
    return on_host.pool(config, env, simulator)


SUITE = Suite(
    choices=AtariConfig,
    rules={"noops": NOT_NEGATIVE, "sticky": BELOW_ONE},
    check=check,
    check_task=atari.check_game,
    make=make,
    protocol=Protocol(
        text="whole games with their whole scores, without sticky actions",
        episodes=100,
        changes={"sticky": 0.0, "life_loss": "ignore", "clip_reward": False},
        options=("sticky",),
    ),
    program="atari100k.py",
    usual_tasks=("breakout",),
    title="the 26 games of Atari 100k",
    examples={
        "--game breakout": "small, on a CPU",
        "--game krull --preset paper": "100k steps, on a GPU",
        "--agent storm --game kung_fu_master": "the transformer",
        "--game freeway --actor.collect-temperature 0.01": "as the paper plays it",
    },
    notes="`--game` is short for `--task`. Needs the extra `atari`.",
    tasks=tuple(atari.GAMES),
    aliases={"--game": "--task"},
    tables=("atari100k", "atari100k_dreamerv3", "atari100k_storm"),
    human_table="atari100k",
)
