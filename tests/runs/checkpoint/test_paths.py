"""Checkpoints in folders of any name: they are read again, or refused before the run."""

import os
import pathlib
import shutil
import tempfile

import numpy as np
import pytest
import tiny
import toy
from damage import flip, save_unmerged
from refusals import refused
from runs import files_of, save_toy

from vawm.policy import policy
from vawm.runs import checkpoint, run_folder, runner
from vawm.runs.checkpoint import arrays, handle, store

NAMES = {
    "brackets": "lr=[1e-4],b]c[",
    "globs": "*?{a,b}**",
    "backslash": r"a\[b\n",
    "URL": "gs:",
    "escapes": "%41#&a=b+;|`x`$HOME!",
    "quotes": "'\"",
    "spaces": " a b ",
    "line breaks": "a\nb\tc\r",
    "home": "~",
    "flag": "-dash",
    "not UTF-8": os.fsdecode(b"\xff\x80a"),
    "not ASCII": "é漢字😀",
    "long": 255 * "n",
}


@pytest.mark.parametrize("name", NAMES.values(), ids=NAMES)
def test_a_checkpoint_is_read_again_from_a_folder_of_any_name(tmp_path, name):
    logdir = tmp_path / name / name
    for env_steps in (8, 16):
        save_toy(logdir, toy.state(env_steps), env_steps)
    state, saved = checkpoint.restore(logdir, toy.state())
    toy.assert_equal(state, toy.state(16))
    assert saved.env_steps == 16


def test_a_checkpoint_is_read_again_through_a_link_to_a_folder_of_any_name(tmp_path):
    target = tmp_path / "[x]*"
    target.mkdir()
    link = tmp_path / "run"
    link.symlink_to(target)
    save_toy(link, toy.state(8), 8)
    for logdir in (link, target):
        toy.assert_equal(checkpoint.restore(logdir, toy.state())[0], toy.state(8))


def test_a_checkpoint_is_read_again_from_a_relative_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in ("[x]", "s3:x"):
        save_toy(name, toy.state(8), 8)
        toy.assert_equal(checkpoint.restore(name, toy.state())[0], toy.state(8))


def test_without_proc_a_private_link_is_used_and_removed(tmp_path, monkeypatch):
    private = tmp_path / "private"
    private.mkdir()
    monkeypatch.setattr(handle, "DESCRIPTORS", tmp_path / "no proc")
    monkeypatch.setattr(tempfile, "tempdir", str(private))
    logdir = tmp_path / "[x]"
    save_toy(logdir, toy.state(8), 8)
    toy.assert_equal(checkpoint.restore(logdir, toy.state())[0], toy.state(8))
    assert not list(private.iterdir())


def test_no_descriptor_stays_open(tmp_path):
    save_toy(tmp_path, toy.state(8), 8)
    before = os.listdir("/proc/self/fd")
    save_toy(tmp_path, toy.state(16), 16)
    checkpoint.restore(tmp_path, toy.state())
    assert len(os.listdir("/proc/self/fd")) <= len(before)


@pytest.mark.parametrize(
    ("logdir", "naming"),
    [
        ("gs://bucket/run", "URL"),
        (pathlib.Path("s3://bucket/run"), "URL"),
        ("~nobody-of-this-name/run", "unknown user"),
        ("a\0b", "zero byte"),
        ("n" * 256, "255"),
        ("/".join(["n" * 200] * 25), "bytes"),
    ],
)
def test_a_folder_that_cannot_work_is_refused_before_anything_is_written(
    tmp_path, monkeypatch, logdir, naming
):
    monkeypatch.chdir(tmp_path)
    with refused("logdir", str(logdir), naming=naming):
        runner.run(tiny.CONFIG, logdir, env=tiny.env())
    assert not list(tmp_path.iterdir())


def test_the_longest_path_that_is_accepted_holds_a_checkpoint(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    most = os.pathconf("/", "PC_PATH_MAX") - run_folder.LONGEST_INSIDE
    deep = tmp_path
    while len(str(deep)) < most - 60:
        deep /= "n" * 50
    logdir = deep / ("n" * (most - len(str(deep)) - 1))
    run_folder.check_new(logdir)
    with refused("logdir", naming=str(most)):
        run_folder.check_new(logdir.with_name(logdir.name + "n"))
    save_toy(logdir, toy.state(8), 8)
    toy.assert_equal(checkpoint.restore(logdir, toy.state())[0], toy.state(8))


def test_a_folder_that_is_called_like_a_url_is_used_if_it_exists(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    pathlib.Path("gs:/bucket").mkdir(parents=True)
    assert checkpoint.expanded("gs:/bucket") == pathlib.Path("gs:/bucket")


def test_files_that_were_not_merged_are_read_and_named(tmp_path, caplog):
    path = save_unmerged(tmp_path, toy.state(8), 8)
    assert not (path / "params" / store.MANIFEST).exists()
    state, _ = checkpoint.restore(tmp_path, toy.state())
    toy.assert_equal(state, toy.state(8))
    [record] = [record for record in caplog.records if record.name == "vawm"]
    for name in (str(path), "params", "state"):
        assert name in record.getMessage()
    assert str(path) in checkpoint.warning(checkpoint.find(tmp_path))
    save_toy(tmp_path, toy.state(16), 16)
    assert checkpoint.warning(checkpoint.find(tmp_path)) is None


def test_damage_to_files_that_were_not_merged_is_noticed(tmp_path):
    path = save_unmerged(tmp_path, toy.state(8), 8)
    damaged = max(files_of(path / "params"), key=lambda file: file.stat().st_size)
    flip(damaged)
    with refused("checkpoint", str(damaged), naming="checksum"):
        policy.load(tmp_path)


def test_arrays_that_were_not_merged_must_be_those_of_the_manifest(tmp_path):
    path = save_unmerged(tmp_path, toy.state(8), 8)
    infos = dict(checkpoint.find(tmp_path).manifest.leaves["params"])
    assert arrays.read(path / "params", infos).keys() == infos.keys()
    name = next(iter(infos))
    with refused("checkpoint", str(path / "params"), naming=name):
        arrays.read(path / "params", infos | {name: infos[name]._replace(shape=(10**9,))})
    del infos[name]
    with refused("checkpoint", str(path / "params")):
        arrays.read(path / "params", infos)


def test_a_save_that_cannot_be_read_back_is_an_error_and_the_older_ones_stay(
    tmp_path, monkeypatch
):
    """Orbax as it was before: it finds nothing to merge, and does not say so."""
    for env_steps in (8, 16):
        save_toy(tmp_path, toy.state(env_steps), env_steps)
    before = sorted(checkpoint.root(tmp_path).iterdir())

    async def nothing(*_, **__): ...

    monkeypatch.setattr(
        "orbax.checkpoint._src.serialization.ocdbt_utils.merge_ocdbt_per_process_files", nothing
    )
    with pytest.raises(checkpoint.SaveError) as error:
        save_toy(tmp_path, toy.state(24), 24)
    for name in ("000000000024", "params", "checkpoint at 16", "--resume"):
        assert name in str(error.value)
    assert "\n" not in str(error.value)
    assert sorted(checkpoint.root(tmp_path).iterdir()) == before
    monkeypatch.undo()
    toy.assert_equal(checkpoint.restore(tmp_path, toy.state())[0], toy.state(16))


def other_values(path, named):
    first = next(iter(named))
    WRITE(path, named | {first: np.zeros_like(named[first])})


def other_arrays(path, named):
    WRITE(path, dict(list(named.items())[1:] or [("other", np.zeros(1))]))


def other_dtypes(path, named):
    WRITE(path, {name: np.zeros(array.shape, np.float16) for name, array in named.items()})


WRITE = arrays.write


@pytest.mark.parametrize("read_back", [arrays.READ_BACK, 40])
@pytest.mark.parametrize("write", [other_values, other_arrays, other_dtypes])
def test_a_save_of_something_else_is_an_error(tmp_path, monkeypatch, write, read_back):
    """With 40 bytes, arrays are read back in several parts."""
    monkeypatch.setattr(arrays, "READ_BACK", read_back)
    monkeypatch.setattr(arrays, "write", write)
    with pytest.raises(checkpoint.SaveError, match="read back"):
        save_toy(tmp_path, toy.state(8), 8)
    assert not list(checkpoint.root(tmp_path).iterdir())


def test_large_arrays_without_data_are_an_error(tmp_path, monkeypatch):
    """They are not read back, but their data must be there."""
    monkeypatch.setattr(arrays, "READ_BACK", 0)
    save_toy(tmp_path, toy.state(8), 8)
    keys = store._keys
    monkeypatch.setattr(
        store, "_keys", lambda *x: [key for key in keys(*x) if key.endswith(store.ARRAY)]
    )
    with pytest.raises(checkpoint.SaveError, match="no data"):
        save_toy(tmp_path, toy.state(16), 16)


def test_a_copied_run_is_read_under_its_new_name(tmp_path):
    save_toy(tmp_path / "[a]", toy.state(8), 8)
    shutil.move(tmp_path / "[a]", tmp_path / "b")
    toy.assert_equal(checkpoint.restore(tmp_path / "b", toy.state())[0], toy.state(8))
