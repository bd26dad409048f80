"""Damaged checkpoints: named, passed over with a warning, and never read as something else."""

import errno
import os
import random
import shutil

import pytest
import tiny
import toy
from damage import corrupt, delete, flip, truncate
from runs import files_of, save_toy

from vawm.errors import InvalidInput
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
        # Which of the two is wrong is not known where the manifest and its checksum differ.
        assert file.name in str(error)
        assert "\n" not in str(error)
        file.write_bytes(content)
    assert checkpoint.find(logdir) == checkpoint.Found(newest, manifest.read(newest))


def test_what_is_restored_instead_is_the_older_state_with_one_warning(logdir, caplog):
    damaged = largest(checkpoint.latest(logdir) / "state")
    flip(damaged)
    state, saved = checkpoint.restore(logdir, toy.state())
    toy.assert_equal(state, toy.state(8))
    assert saved.env_steps == 8
    [record] = [record for record in caplog.records if record.name == "vawm"]
    assert record.levelname == "WARNING"
    assert record.getMessage() == (
        f"damaged checkpoint: {damaged} does not match its checksum; "
        "using the one at 8 env steps instead"
    )


def test_acting_goes_by_what_it_needs(logdir, caplog):
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
    assert "using the one at 8 env steps instead" in caplog.text


@pytest.mark.parametrize("read", [policy.load, lambda path: resume.restore(path, None)])
def test_if_none_is_whole_the_first_damaged_file_is_named_and_nothing_changed(logdir, read):
    first = largest(checkpoint.latest(logdir) / "params")
    for path in checkpoint.complete(logdir):
        flip(largest(path / "params"))
    before = {file: file.read_bytes() for file in files_of(logdir)}
    with pytest.raises(InvalidInput, match=r"no older checkpoint is whole.*--fresh") as error:
        read(logdir)
    assert str(error.value).startswith(f"checkpoint='{first}': does not match its checksum")
    assert "\n" not in str(error.value)
    assert {file: file.read_bytes() for file in files_of(logdir)} == before


def test_one_that_its_run_deletes_while_it_is_read_is_not_damaged(logdir, monkeypatch):
    verify = checkpoint.reading.verify

    def meanwhile(folder, *arguments):
        if folder.name == "000000000016":
            for env_steps in (24, 32):
                save_toy(logdir, toy.state(env_steps), env_steps)
        verify(folder, *arguments)

    monkeypatch.setattr(checkpoint.reading, "verify", meanwhile)
    found = checkpoint.find(logdir)
    assert (found.path.name, found.damaged) == ("000000000032", ())


def test_an_empty_folder_is_passed_over(logdir):
    empty = checkpoint.root(logdir) / "000000000024"
    empty.mkdir()
    found = checkpoint.find(logdir)
    assert found.manifest.env_steps == 16
    assert str(found.damaged[0][1]).startswith(f"checkpoint='{empty}/{manifest.DIGEST}': is m")


@pytest.mark.parametrize("names", [[], ["tmp-000000000008"], ["damaged-000000000008"]])
def test_what_is_not_complete_is_no_checkpoint(saved, tmp_path, names):
    for name in names:
        shutil.copytree(checkpoint.latest(saved), tmp_path / "checkpoints" / name)
    with pytest.raises(InvalidInput, match="holds no checkpoint"):
        checkpoint.find(tmp_path)


def test_a_folder_that_may_not_be_read_is_one_line(logdir, monkeypatch):
    def refuse(_):
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setattr(os, "listdir", refuse)
    with pytest.raises(InvalidInput, match=r"logdir=.*: cannot be read \(Permission denied\)"):
        policy.load(logdir)


def test_only_empty_folders_are_no_reason_to_start_over(tmp_path):
    (tmp_path / "checkpoints" / "000000000008").mkdir(parents=True)
    with pytest.raises(InvalidInput, match=r"is missing; and no older .* --fresh"):
        resume.check(tmp_path, tiny.CONFIG)


def test_a_damaged_one_is_renamed_and_what_was_renamed_before_stays(logdir):
    for number in ("", "-2"):
        newest = checkpoint.latest(logdir)
        aside = checkpoint.set_aside(newest)
        assert aside.name == f"damaged-000000000016{number}"
        assert not newest.exists()
        shutil.copytree(aside, newest)
    save_toy(logdir, toy.state(24), 24)
    assert len(list(checkpoint.root(logdir).glob("damaged-*"))) == 2


def test_a_run_that_is_as_far_as_it_should_be_may_go_on_where_that_is_damaged(logdir):
    config = tiny.config(env_steps=16)
    with pytest.raises(InvalidInput, match="the checkpoint is at 16 already"):
        resume.check(logdir, config)
    flip(largest(checkpoint.latest(logdir) / "state"))
    resume.check(logdir, config)


def test_none_of_500_random_corruptions_restores_wrong_values(saved, tmp_path):
    shutil.copytree(checkpoint.complete(saved)[-1], tmp_path / "checkpoints" / "000000000008")
    assert corrupt(tmp_path, toy.state(8), 500, random.Random(0)) > 450
