"""Resuming a run: the fields that may differ, and a replay that grows."""

import dataclasses
import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
import tiny
import toy
from refusals import refused

from vawm.learning import replay
from vawm.runs import checkpoint, resume, run_folder
from vawm.runs.checkpoint import manifest
from vawm.runs.reports import tracking
from vawm.types import Latent, Trajectory


def steps(start, count, num_envs=2):
    """Trajectory and latent with the time index as value everywhere."""
    time = jnp.broadcast_to(jnp.arange(start, start + count), (num_envs, count))
    flag = jnp.zeros((num_envs, count), bool)
    value = time.astype(jnp.float32)
    trajectory = Trajectory(value[..., None], value, flag, flag, flag, value[..., None])
    stoch = jax.nn.one_hot(time[..., None] % 4, 4)
    return trajectory, Latent(value[..., None], stoch)


def filled(count, capacity):
    example = jax.tree.map(lambda x: x[:, 0], steps(0, 1))
    buffer = replay.init(*example, capacity=capacity)
    for start in range(0, count, 2):
        buffer = replay.add(buffer, *steps(start, 2))
    return buffer


@pytest.mark.parametrize("count", [0, 4, 6])
def test_a_replay_that_has_not_wrapped_grows_into_the_larger_one(count):
    toy.assert_equal(resume.grow(filled(count, 6), 10), filled(count, 10))


def test_a_replay_that_has_wrapped_keeps_its_steps_in_order():
    grown = resume.grow(filled(8, 6), 10)
    np.testing.assert_array_equal(grown.trajectory.reward[0, :6], np.arange(2, 8))
    assert (int(grown.head), int(grown.size)) == (6, 6)
    np.testing.assert_array_equal(
        replay.add(grown, *steps(8, 2)).trajectory.reward[0, :8], np.arange(2, 10)
    )


@pytest.fixture
def saved(tmp_path):
    checkpoint.save(
        tmp_path, toy.state(), env_steps=48, config=tiny.CONFIG, spec=toy.SPEC, progress={}
    )
    return tmp_path


def test_a_run_of_another_version_is_refused_even_if_it_can_be_read(saved, monkeypatch):
    before = manifest.version()
    monkeypatch.setattr(manifest, "version", lambda: "9.9.9")
    with refused("checkpoint", naming=[f"vawm {before}", "vawm 9.9.9"]):
        resume.check(saved, tiny.config(env_steps=10_000))


def test_a_run_may_be_extended_and_logged_differently(saved):
    resume.check(saved, tiny.config(env_steps=10_000, log_every=3, save_every=5))
    resume.check(saved, tiny.config(env_steps=96, save_minutes=0.0, keep_checkpoints=5))


@pytest.mark.parametrize(
    ("changes", "field", "value", "before"),
    [
        ({"task": "walker_walk"}, "task", "walker_walk", repr(tiny.CONFIG.task)),
        ({"size": "12m"}, "size", "12m", repr(tiny.CONFIG.size)),
        ({"seed": 1}, "seed", 1, "0"),
        (
            {"value_alignment": dataclasses.replace(tiny.CONFIG.value_alignment, weight="off")},
            "value_alignment.weight",
            "off",
            repr(tiny.CONFIG.value_alignment.weight),
        ),
    ],
)
def test_another_choice_is_refused_by_name(saved, changes, field, value, before):
    with refused(field, value, naming=before):
        resume.check(saved, tiny.config(**changes))


def test_a_run_without_a_checkpoint_is_compared_with_its_initial_config(tmp_path):
    run_folder.write_config(tmp_path, tiny.CONFIG)
    resume.check(tmp_path, tiny.config(env_steps=10_000))
    with refused("seed", 1, naming="0"):
        resume.check(tmp_path, tiny.config(seed=1))


@pytest.mark.parametrize("content", ["", "[]", '{"config": {}}', '{"schema": 1}'])
def test_a_folder_that_is_not_of_a_run_is_refused(tmp_path, content):
    (tmp_path / run_folder.CONFIG).write_text(content)
    with refused("logdir", str(tmp_path)):
        resume.check(tmp_path, tiny.CONFIG)


def started(logdir, *reached, **changes):
    """A run without a checkpoint whose metrics have lines at the env steps `reached`."""
    run_folder.write_config(logdir, tiny.config(**changes))
    lines = "".join(f'{{"env_steps": {env_steps}}}\n' for env_steps in reached)
    (logdir / "metrics.jsonl").write_text(lines + '{"half a li')


@pytest.mark.parametrize("reached", [[], [16], [16, 31]])
def test_a_run_too_short_to_have_saved_may_be_restarted(tmp_path, reached):
    started(tmp_path, *reached)
    resume.check(tmp_path, tiny.config(save_every=1))


@pytest.mark.parametrize(
    ("reached", "changes"),
    [([16, 32], {}), ([96], {}), ([48], {"env_steps": 48, "save_every": 1000})],
)
def test_a_run_whose_checkpoints_are_missing_is_not_restarted(tmp_path, reached, changes):
    started(tmp_path, *reached, **changes)
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    named = [f"{reached[-1]} env steps", "--logdir", "--fresh"]
    with refused("logdir", str(tmp_path), naming=named):
        resume.check(str(tmp_path), tiny.config(env_steps=10_000, save_every=5_000))
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_a_run_that_saved_by_time_is_not_restarted_either(tmp_path):
    """Before the first checkpoint by env steps."""
    started(tmp_path, 16)
    (tmp_path / "checkpoints.jsonl").write_text('{"env_steps": 24}\n')
    with refused("logdir", str(tmp_path), naming="24 env steps"):
        resume.check(tmp_path, tiny.config(env_steps=10_000))


def with_lines(logdir, *written, name="metrics.jsonl"):
    """A file of lines at these env steps; None is a damaged one."""
    texts = ["damaged" if x is None else f'{{"env_steps": {x}}}' for x in written]
    (logdir / name).write_text("".join(text + "\n" for text in texts))


@pytest.mark.parametrize(
    ("written", "numbers"),
    [
        ((16, 32, 48), None),
        ((16, 32), None),
        ((16, None, 32, 48), ["1"]),
        ((16, 32, None), None),
        ((16,), ["16", "32"]),
        ((), ["0", "32"]),
    ],
)
def test_missing_and_damaged_lines_before_the_checkpoint_cause_a_warning(
    tmp_path, written, numbers
):
    with_lines(tmp_path, *written)
    with_lines(tmp_path, 16, 40, 48, name="checkpoints.jsonl")
    told = resume.cut_back(tmp_path, env_steps=40, logged=32)
    assert (told and re.findall(r"\d+", told)) == numbers
    assert told is None or "metrics.jsonl" in told
    for name, last in (("metrics.jsonl", 32), ("checkpoints.jsonl", 40)):
        assert all(line["env_steps"] <= last for line in tracking.read(tmp_path / name))
    assert len(tracking.read(tmp_path / "checkpoints.jsonl")) == 2


def test_a_width_that_differs_is_named_rather_than_the_size_custom(saved):
    model = dataclasses.replace(tiny.CONFIG.world_model, units=8)
    with refused("world_model.units", 8):
        resume.check(saved, tiny.config(world_model=model))


def test_a_finished_run_is_not_continued(saved):
    with refused("env_steps", 48, naming="48"):
        resume.check(saved, tiny.config(env_steps=48))
