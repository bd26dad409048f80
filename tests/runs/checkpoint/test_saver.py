"""Saving in the background: copies, waits, failures, and kills."""

import errno
import subprocess
import sys
import threading

import jax
import killed_saver
import numpy as np
import pytest
import tiny
import toy
from runs import save_toy

from vawm.runs import checkpoint
from vawm.runs.checkpoint import manifest, saver


@pytest.fixture
def gate(monkeypatch):
    """An event that saves wait for after the copy."""
    event, write = threading.Event(), checkpoint.write

    def gated(*args):
        assert event.wait(60)
        return write(*args)

    monkeypatch.setattr(saver.writing, "write", gated)
    yield event
    event.set()


def make_saver(logdir, log=lambda _: None, **changes):
    return checkpoint.Saver(logdir, tiny.config(**changes), toy.SPEC, log=log)


def test_a_copy_is_saved_even_if_the_state_is_changed_or_deleted(tmp_path, gate):
    pictures = {"picture": np.zeros((2, 3), np.uint8)}
    state = {"learner": toy.state().learner, "pixels": pictures, "key": jax.random.key(1)}
    episodes = {"length": np.array([1, 2])}
    target = jax.eval_shape(lambda: state)
    with make_saver(tmp_path) as saving:
        saving.save(state, env_steps=8, progress={"seconds": 1.5}, episodes=episodes)
        pictures["picture"][:] = 1
        episodes["length"][:] = 0
        for leaf in jax.tree.leaves(state):
            if isinstance(leaf, jax.Array):
                leaf.delete()
        saving.check()
        assert checkpoint.latest(tmp_path) is None
        gate.set()
    restored, saved = checkpoint.restore(tmp_path, target)
    assert not restored["pixels"]["picture"].any()
    toy.assert_equal(restored["learner"], toy.state().learner)
    assert list(checkpoint.restore_episodes(tmp_path)["length"]) == [1, 2]
    assert saved.progress == {"seconds": 1.5}


def test_a_snapshot_shares_no_memory_with_the_state():
    state = toy.state()
    usual = {"config": tiny.CONFIG, "spec": toy.SPEC, "progress": {}}
    taken = checkpoint.take(state, env_steps=8, **usual)
    for item in taken.arrays:
        prefix = checkpoint.leaves.PREFIXES[item]
        for name, array in taken.arrays[item].items():
            leaf = checkpoint.flatten(state)[prefix + name]
            assert not np.shares_memory(array, toy.plain(leaf))


def test_the_next_save_waits_for_the_one_before(tmp_path, gate):
    lines = []
    with make_saver(tmp_path, lines.append) as saving:
        saving.save(toy.state(8), env_steps=8, progress={})
        assert not lines
        threading.Timer(0.3, gate.set).start()
        saving.save(toy.state(16), env_steps=16, progress={})
        assert [line["env_steps"] for line in lines] == [8]
        assert lines[0]["checkpoint/blocked_seconds"] > 0.25
    assert [line["env_steps"] for line in lines] == [8, 16]
    for line in lines:
        assert 0 < line["checkpoint/blocked_seconds"] <= line["checkpoint/seconds"]
    files = [file for file in checkpoint.latest(tmp_path).rglob("*") if file.is_file()]
    assert lines[-1]["checkpoint/bytes"] == sum(file.stat().st_size for file in files)
    toy.assert_equal(checkpoint.restore(tmp_path, toy.state())[0], toy.state(16))


def test_a_slow_disk_causes_one_warning(tmp_path, gate, monkeypatch):
    monkeypatch.setattr(saver, "SLOW_SECONDS", 0.1)
    said = []
    with checkpoint.Saver(tmp_path, tiny.CONFIG, toy.SPEC, say=said.append) as saving:
        saving.save(toy.state(8), env_steps=8, progress={})
        threading.Timer(0.3, gate.set).start()
        for env_steps in (16, 24, 32):
            saving.save(toy.state(env_steps), env_steps=env_steps, progress={})
    [line] = said
    assert "warning" in line
    assert "--save-every" in line
    assert "--save-minutes" in line


def test_metrics_are_on_the_disk_before_a_checkpoint_is_complete(tmp_path, monkeypatch):
    def synced(path):
        assert checkpoint.latest(tmp_path) is None
        order.append(path)

    order, metrics = [], tmp_path / "metrics.jsonl"
    metrics.touch()
    monkeypatch.setattr(saver, "sync", synced)
    with checkpoint.Saver(tmp_path, tiny.CONFIG, toy.SPEC, before=metrics) as saving:
        saving.save(toy.state(8), env_steps=8, progress={})
    assert order == [metrics, tmp_path]
    assert checkpoint.latest(tmp_path) is not None


def full(*_):
    raise OSError(errno.ENOSPC, "No space left on device")


def begin_and_fail(saving, monkeypatch):
    """Starts a save that finds the disk full in the background."""
    with monkeypatch.context() as patch:
        patch.setattr(manifest, "write", full)
        saving.save(toy.state(), env_steps=8, progress={})
        assert saving._pending.future.exception(timeout=60) is not None


@pytest.mark.parametrize("call", ["check", "wait", "save"])
def test_the_next_call_raises_the_error_of_a_full_disk(tmp_path, monkeypatch, call):
    before = save_toy(tmp_path, toy.state(), 4)
    again = {"state": toy.state(), "env_steps": 16, "progress": {}} if call == "save" else {}
    with make_saver(tmp_path) as saving:
        begin_and_fail(saving, monkeypatch)
        with pytest.raises(checkpoint.SaveError, match=r"[KMG]iB .*No space left") as error:
            getattr(saving, call)(**again)
        assert "\n" not in str(error.value)
        assert list(checkpoint.root(tmp_path).iterdir()) == [before]


def test_the_exit_waits_for_the_last_save_and_raises_its_error(tmp_path, monkeypatch):
    with (
        pytest.raises(checkpoint.SaveError, match="No space left"),
        make_saver(tmp_path) as saving,
    ):
        begin_and_fail(saving, monkeypatch)


def test_a_failed_save_does_not_hide_the_error_that_ends_a_run(tmp_path, monkeypatch):
    def run():
        with make_saver(tmp_path) as saving:
            begin_and_fail(saving, monkeypatch)
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        run()


def test_a_save_in_progress_is_completed_when_the_run_fails(tmp_path, gate):
    def run():
        with make_saver(tmp_path) as saving:
            saving.save(toy.state(), env_steps=8, progress={})
            raise ZeroDivisionError

    threading.Timer(0.2, gate.set).start()
    with pytest.raises(ZeroDivisionError):
        run()
    assert checkpoint.find(tmp_path).manifest.env_steps == 8


@pytest.mark.parametrize("env_steps", [4, 8])
def test_an_older_checkpoint_is_refused_before_anything_is_copied(tmp_path, env_steps):
    save_toy(tmp_path, toy.state(), 8)
    with make_saver(tmp_path) as saving:
        with pytest.raises(checkpoint.SaveError, match="8 env steps"):
            saving.save(toy.state(), env_steps=env_steps, progress={})
        saving.wait()


def test_the_folder_of_a_run_is_not_made_again(tmp_path):
    logdir = tmp_path / "run"
    logdir.mkdir()
    with make_saver(logdir) as saving:
        saving.save(toy.state(), env_steps=8, progress={})
        saving.wait()
        moved = logdir.rename(tmp_path / "moved")
        with pytest.raises(checkpoint.SaveError, match=f"{logdir} .*--resume"):
            saving.save(toy.state(), env_steps=16, progress={})
    assert list(tmp_path.iterdir()) == [moved]


def test_time_is_counted_from_the_previous_save(tmp_path, monkeypatch):
    now = 1000.0
    monkeypatch.setattr(saver.time, "monotonic", lambda: now)
    never = make_saver(tmp_path, save_minutes=0.0)
    with make_saver(tmp_path, save_minutes=0.5) as saving:
        now += 29
        assert not saving.is_time()
        now += 1
        assert saving.is_time()
        saving.save(toy.state(), env_steps=8, progress={})
        assert not saving.is_time()
        now += 1e9
        assert saving.is_time()
        assert not never.is_time()


def test_a_run_killed_at_any_moment_leaves_an_undamaged_checkpoint(tmp_path):
    """Ten kills of a process that saves without a pause; `killed_saver` checks the files."""
    done = subprocess.run(
        [sys.executable, killed_saver.__file__, str(tmp_path)], capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    steps = [int(line) for line in done.stdout.split()]
    assert len(steps) == 10
    assert steps == sorted(steps)
    state, saved = checkpoint.restore(tmp_path, killed_saver.state(0))
    assert saved.env_steps == steps[-1] > steps[0]
    toy.assert_equal(state, killed_saver.state(saved.env_steps))
    save_toy(tmp_path, toy.state(), saved.env_steps + 8)
    assert not list(checkpoint.root(tmp_path).glob(checkpoint.SCRATCH + "*"))
