"""Damaged checkpoints: named, skipped with a warning, never read as another state."""

import errno
import os
import random
import shutil

import pytest
import tiny
import toy
from damage import corrupt, delete, flip, truncate
from refusals import refused
from runs import files_of, save_toy

from vawm.policy import policy
from vawm.runs import checkpoint, resume
from vawm.runs.checkpoint import manifest


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    """A folder with checkpoints of `toy.state(8)` at 8 env steps and of 16 at 16."""
    logdir = tmp_path_factory.mktemp("saved")
    for env_steps in (8, 16):
        save_toy(logdir, toy.state(env_steps), env_steps)
    return logdir


@pytest.fixture
def logdir(saved, tmp_path):
    """A copy of `saved`."""
    return shutil.copytree(saved, tmp_path / "run")


def largest(path):
    return max(files_of(path), key=lambda file: file.stat().st_size)


@pytest.mark.parametrize("harm", [flip, truncate, delete])
def test_damage_to_any_file_is_named_and_the_one_before_is_used(logdir, harm):
    old, newest = sorted(checkpoint.complete(logdir))
    for file in files_of(newest):
        content = file.read_bytes()
        harm(file)
        found = checkpoint.find(logdir)
        assert found.path == old
        [(path, error)] = found.damaged
        assert path == newest
        # If the manifest and its checksum differ, either may be the damaged one.
        assert file.name in str(error)
        assert "\n" not in str(error)
        file.write_bytes(content)
    assert checkpoint.find(logdir) == checkpoint.Found(newest, manifest.read(newest))


def test_the_older_state_is_restored_instead_with_one_warning(logdir, caplog):
    damaged = largest(checkpoint.latest(logdir) / "state")
    flip(damaged)
    state, saved = checkpoint.restore(logdir, toy.state())
    toy.assert_equal(state, toy.state(8))
    assert saved.env_steps == 8
    [record] = [record for record in caplog.records if record.name == "vawm"]
    assert record.levelname == "WARNING"
    assert str(damaged) in record.getMessage()
    assert "8 env steps" in record.getMessage()


def test_a_policy_uses_the_newest_checkpoint_with_undamaged_parameters(logdir, caplog):
    newest = checkpoint.latest(logdir)
    learner = toy.state(16).learner
    delete(largest(newest / "state"))
    (params, _), saved = checkpoint.restore_agent(logdir, learner.params, ())
    toy.assert_equal(params, learner.params)
    assert (saved.env_steps, caplog.text) == (16, "")
    delete(largest(newest / "params"))
    (params, _), saved = checkpoint.restore_agent(logdir, learner.params, ())
    toy.assert_equal(params, toy.state(8).learner.params)
    assert saved.env_steps == 8
    assert "8 env steps" in caplog.text


@pytest.mark.parametrize("read", [policy.load, lambda path: resume.restore(path, None)])
def test_if_all_are_damaged_the_first_damaged_file_is_named_and_nothing_changed(logdir, read):
    first = largest(checkpoint.latest(logdir) / "params")
    for path in checkpoint.complete(logdir):
        flip(largest(path / "params"))
    before = {file: file.read_bytes() for file in files_of(logdir)}
    with refused("checkpoint", str(first), naming=["checksum", "--fresh"]):
        read(logdir)
    assert {file: file.read_bytes() for file in files_of(logdir)} == before


def test_a_checkpoint_that_a_run_deletes_while_it_is_read_is_not_damaged(logdir, monkeypatch):
    verify = checkpoint.reading.verify

    def meanwhile(folder, *arguments):
        if folder.name == "000000000016":
            for env_steps in (24, 32):
                save_toy(logdir, toy.state(env_steps), env_steps)
        verify(folder, *arguments)

    monkeypatch.setattr(checkpoint.reading, "verify", meanwhile)
    found = checkpoint.find(logdir)
    assert (found.path.name, found.damaged) == ("000000000032", ())


def test_an_empty_folder_is_skipped(logdir):
    empty = checkpoint.root(logdir) / "000000000024"
    empty.mkdir()
    found = checkpoint.find(logdir)
    assert found.manifest.env_steps == 16
    [(_, error)] = found.damaged
    assert error.path == empty / manifest.DIGEST


@pytest.mark.parametrize("names", [[], ["tmp-000000000008"], ["damaged-000000000008"]])
def test_incomplete_and_renamed_checkpoints_are_ignored(saved, tmp_path, names):
    for name in names:
        shutil.copytree(checkpoint.latest(saved), tmp_path / "checkpoints" / name)
    with refused("logdir", str(tmp_path)):
        checkpoint.find(tmp_path)


def test_a_folder_without_permission_to_read_is_refused_in_one_line(logdir, monkeypatch):
    def refuse(_):
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr(os, "listdir", refuse)
    with refused("logdir", str(logdir), naming="Permission denied"):
        policy.load(logdir)


def test_a_run_with_only_empty_checkpoint_folders_is_not_restarted(tmp_path):
    (tmp_path / "checkpoints" / "000000000008").mkdir(parents=True)
    with refused("checkpoint", naming="--fresh"):
        resume.check(tmp_path, tiny.CONFIG)


def test_a_damaged_checkpoint_is_renamed_and_earlier_renamed_ones_stay(logdir):
    for number in ("", "-2"):
        newest = checkpoint.latest(logdir)
        aside = checkpoint.set_aside(newest)
        assert aside.name == f"damaged-000000000016{number}"
        assert not newest.exists()
        shutil.copytree(aside, newest)
    save_toy(logdir, toy.state(24), 24)
    assert len(list(checkpoint.root(logdir).glob("damaged-*"))) == 2


def test_a_complete_run_may_be_resumed_if_its_last_checkpoint_is_damaged(logdir):
    config = tiny.config(env_steps=16)
    with refused("env_steps", 16):
        resume.check(logdir, config)
    flip(largest(checkpoint.latest(logdir) / "state"))
    resume.check(logdir, config)


def test_none_of_500_random_corruptions_restores_wrong_values(saved, tmp_path):
    shutil.copytree(checkpoint.complete(saved)[-1], tmp_path / "checkpoints" / "000000000008")
    assert corrupt(tmp_path, toy.state(8), 500, random.Random(0)) > 450
