"""Real runs at tiny size: games of Atari and a task of DMC vision, most of 2,000 steps."""

import dataclasses
import json
import math

import jax
import pytest
import runs
import tiny
import tiny_storm

from vawm import evaluate, presets
from vawm.agent import registry
from vawm.config import LaPropConfig, ReplayConfig, ValueAlignmentConfig
from vawm.envs.host import rendering
from vawm.policy import policy
from vawm.runs import runner, suites
from vawm.runs.reports import tracking

STEPS = 2_000  # of the agent


def tiny_version(config, steps=STEPS, **changes):
    """`config` with everything small but the environment, and an update per 8 steps."""
    frames = steps * config.action_repeat
    return dataclasses.replace(
        config,
        preset="custom",
        size="custom",
        env_steps=frames,
        train_ratio=8,
        log_every=frames // 10,
        save_every=frames // 2,
        world_model=dataclasses.replace(tiny.CONFIG.world_model, depth=2),
        actor=tiny.CONFIG.actor,
        critic=tiny.CONFIG.critic,
        imagination=tiny.CONFIG.imagination,
        value_alignment=ValueAlignmentConfig(warmup_steps=steps // 2),
        optimizer=LaPropConfig(learning_rate=1e-3, warmup_updates=10),
        replay=ReplayConfig(capacity=steps, batch_size=4, batch_length=16),
        video=dataclasses.replace(config.video, every=frames // 2, sequences=2),
        **changes,
    )


STORM = registry.kind("storm").presets["atari100k"]["quick"]
CONFIGS = {
    "atari100k": tiny_version(presets.ATARI_QUICK, task="breakout"),
    "dmc_vision": tiny_version(
        presets.VISION_QUICK,
        task="cartpole_balance",
        num_envs=2,
        env=dataclasses.replace(presets.VISION_QUICK.env, fast_rendering=True),
    ),
    "atari100k_storm": tiny_storm.storm(
        tiny_version(STORM, STEPS // 2, task="breakout", random_steps=STEPS // 8),
        world_model=tiny_storm.model(depth=4),
    ),
}


@pytest.fixture(scope="module", params=CONFIGS)
def run(request, tmp_path_factory):
    """The folder of a whole run, and its config."""
    if request.param.startswith("atari100k"):
        pytest.importorskip("ale_py")
    if request.param == "dmc_vision" and rendering.fault("egl") and rendering.fault("osmesa"):
        pytest.skip(rendering.fault("egl"))
    config = CONFIGS[request.param]
    logdir = tmp_path_factory.mktemp(request.param)
    console = runs.quiet()
    runner.run(config, logdir, console=console, command="python train.py")
    assert f"python -m vawm.evaluate --logdir {logdir}" in console.file.getvalue()
    assert f"python train.py --resume --logdir {logdir} --env" in console.file.getvalue()
    return logdir, config


def test_losses_are_finite_and_fall(run):
    logdir, config = run
    lines = [line for line in runs.lines(logdir) if line["loss/total"] is not None]
    assert lines[-1]["env_steps"] >= config.env_steps
    assert lines[-1]["updates"] > config.env_steps / config.action_repeat / 10
    for line in lines:
        assert all(math.isfinite(x) for name, x in line.items() if name.startswith("loss/"))
    first, last = lines[0], lines[-1]
    assert last["loss/reconstruction"] < 0.5 * first["loss/reconstruction"]
    assert last["loss/total"] < 0.5 * first["loss/total"]
    assert last["loss/continue"] < first["loss/continue"]
    assert lines[0]["value_alignment/weight"] == 0 < last["value_alignment/weight"]


def test_episodes_were_played_and_filmed(run):
    logdir, config = run
    lines = runs.lines(logdir)
    assert sum(line["episode/count"] for line in lines) > 0
    assert sum(line["env/restarts"] for line in lines) == 0
    entries = tracking.read(logdir / "videos.jsonl")
    assert {entry["video"].split("-")[0] for entry in entries} == {"open_loop", "episode"}
    error = [entry["error"] for entry in entries if "error" in entry][-1]
    assert len(error) == config.replay.batch_length
    assert 0 < max(error) < 0.2
    tags = {value.tag for event in runs.events(logdir) for value in event.summary.value}
    assert {"video/open_loop", "video/episode", "loss/total"} <= tags


def test_its_protocol_evaluates_it(run, capsys, monkeypatch):
    logdir, config = run
    monkeypatch.setattr(evaluate, "AT_ONCE", 2)
    assert evaluate.main(["--logdir", str(logdir), "--episodes", "2"]) == 0
    title, score = capsys.readouterr().out.splitlines()
    assert title.startswith(f"{config.task} ({config.suite}) at ")
    assert "over 2 episodes" in score
    assert ("human-normalised" in score) == (config.suite == "atari100k")


def test_what_was_trained_acts_after_loading(run):
    logdir, config = run
    loaded = policy.load(logdir)
    env = suites.make(dataclasses.replace(loaded.config, num_envs=1))
    try:
        timestep = env.reset(0)
        _, action = loaded.act(jax.random.key(0), loaded.initial(1), timestep)
        assert action.shape == (1, loaded.spec.action_size)
    finally:
        env.close()
    assert json.loads((logdir / "config.json").read_text())["config"]["suite"] == config.suite
