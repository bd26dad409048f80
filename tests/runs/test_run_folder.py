"""A run's folder: new, writable, and used by one process."""

import errno
import json
import os
import pathlib
import subprocess
import sys
import tempfile

import pytest
import tiny
from refusals import refused

from vawm.errors import InvalidInput
from vawm.runs import run_folder
from vawm.runs.checkpoint import manifest


def test_a_new_or_empty_folder_is_accepted_and_not_made(tmp_path):
    run_folder.check_new(tmp_path)
    run_folder.check_new(tmp_path / "a" / "b")
    assert not list(tmp_path.iterdir())


def test_a_folder_that_holds_something_is_refused(tmp_path):
    run_folder.write_config(tmp_path, tiny.CONFIG)
    with refused("logdir", str(tmp_path), naming=["--resume", "--fresh", "--logdir"]):
        run_folder.check_new(tmp_path)
    run_folder.put_aside(tmp_path)
    with refused("logdir", str(tmp_path), naming=["--fresh", "--logdir"]) as refusal:
        run_folder.check_new(tmp_path)
    assert "--resume" not in refusal.value.remedy


def test_what_a_folder_without_a_run_cannot_do_is_not_suggested(tmp_path):
    (tmp_path / "thesis.tex").touch()
    with refused("logdir", str(tmp_path), naming="--logdir") as refusal:
        run_folder.check_new(tmp_path)
    assert not {"--resume", "--fresh"} & set(refusal.value.remedy.replace(",", "").split())


def test_a_folder_with_only_a_lock_counts_as_empty(tmp_path):
    with run_folder.claim(tmp_path):
        run_folder.check_new(tmp_path)


@pytest.mark.parametrize("below", [".", "a", "a/b"])
def test_a_path_through_a_file_is_refused(tmp_path, below):
    (tmp_path / "file").touch()
    with refused("logdir", str(tmp_path / "file" / below)):
        run_folder.check_new(tmp_path / "file" / below)


@pytest.fixture
def nobody():
    """Runs the test as another user than root, who may write everywhere."""
    if os.geteuid():
        yield
        return
    try:
        os.setresuid(65534, 65534, 0)
    except OSError:
        pytest.skip("root may write everywhere, and may not be another user")
    try:
        yield
    finally:
        os.setresuid(0, 0, 0)


def test_a_folder_without_permission_is_refused(nobody):
    with tempfile.TemporaryDirectory() as folder:  # pytest's own are hidden from others
        os.chmod(folder, 0o500)
        for logdir in (pathlib.Path(folder), pathlib.Path(folder, "run")):
            with refused("logdir", str(logdir)):
                run_folder.check_new(logdir)
        os.chmod(folder, 0o700)
        run_folder.check_new(pathlib.Path(folder, "run"))


def test_a_second_claim_is_refused_and_names_the_holder(tmp_path):
    with (
        run_folder.claim(tmp_path),
        refused("logdir", str(tmp_path), naming=f"process {os.getpid()} on "),
        run_folder.claim(tmp_path),
    ):
        pass
    with run_folder.claim(tmp_path):
        pass


@pytest.mark.parametrize(
    ("number", "error"), [(errno.EACCES, InvalidInput), (errno.EIO, OSError)]
)
def test_other_errors_of_a_lock_are_raised(tmp_path, monkeypatch, number, error):
    def flock(*_):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(run_folder.fcntl, "flock", flock)
    with pytest.raises(error), run_folder.claim(tmp_path):
        pytest.fail("entered")


@pytest.mark.parametrize("number", [errno.ENOSYS, errno.ENOLCK])
def test_a_file_system_without_locks_is_a_warning(tmp_path, monkeypatch, number):
    def flock(*_):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(run_folder.fcntl, "flock", flock)
    said = []
    with run_folder.claim(tmp_path, say=said.append):
        assert (tmp_path / run_folder.LOCK).read_text().startswith(f"process {os.getpid()} on ")
    [line] = said
    assert line.startswith("WARNING: ")
    assert str(tmp_path) in line
    assert os.strerror(number) in line


def test_starting_over_is_allowed_in_a_new_folder_and_in_that_of_a_run(tmp_path):
    run_folder.check_fresh(tmp_path / "not there")
    run_folder.check_fresh(tmp_path)
    for name in ("lock", "replaced-12"):
        (tmp_path / name).touch()
    run_folder.check_fresh(tmp_path)
    (tmp_path / "notes").touch()
    run_folder.write_config(tmp_path, tiny.CONFIG)
    run_folder.check_fresh(tmp_path)
    (tmp_path / "config.json").write_text("damaged")
    (tmp_path / "checkpoints" / "000000000008").mkdir(parents=True)
    run_folder.check_fresh(tmp_path)


def test_starting_over_works_after_an_interrupted_put_aside(tmp_path, monkeypatch):
    run_folder.write_config(tmp_path, tiny.CONFIG)
    for name in ("checkpoints", "metrics.jsonl", "videos"):
        (tmp_path / name).touch()
    renamed, rename = [], pathlib.Path.rename

    def killed(path, to):
        if len(renamed) == 2:
            raise KeyboardInterrupt
        renamed.append(path.name)
        return rename(path, to)

    with monkeypatch.context() as patch:
        patch.setattr(pathlib.Path, "rename", killed)
        with pytest.raises(KeyboardInterrupt):
            run_folder.put_aside(tmp_path)
    assert renamed == ["checkpoints", "config.json"]
    run_folder.check_fresh(tmp_path)
    run_folder.put_aside(tmp_path)
    (tmp_path / "config.json.tmp").touch()
    run_folder.check_fresh(tmp_path)
    aside = {p.name for folder in tmp_path.glob("replaced-*") for p in folder.iterdir()}
    assert aside == {"checkpoints", "metrics.jsonl", "videos", "config.json"}


@pytest.mark.parametrize(
    "names", [["lock", "thesis.tex"], ["checkpoints", "a"], ["config.json"], ["replaced-notes"]]
)
def test_files_that_are_not_of_a_run_are_not_put_aside(tmp_path, names):
    for name in names:
        (tmp_path / name).write_text(
            '{"format": "vawm policy", "schema": 1, "vawm": "", "config": {}}'
        )
    with refused("logdir", str(tmp_path), naming="--logdir"):
        run_folder.check_fresh(tmp_path)


def test_the_lock_of_a_killed_process_is_free(tmp_path):
    script = (
        "import os, pathlib, sys; from vawm.runs import run_folder\n"
        "with run_folder.claim(pathlib.Path(sys.argv[1])): os.kill(os.getpid(), 9)"
    )
    ended = subprocess.run([sys.executable, "-c", script, tmp_path], check=False)
    assert ended.returncode == -9
    with run_folder.claim(tmp_path):
        pass


def test_the_config_is_written_with_the_version(tmp_path):
    run_folder.write_config(tmp_path, tiny.CONFIG)
    content = json.loads((tmp_path / "config.json").read_text())
    assert content["vawm"] == manifest.version()
    assert run_folder.read_config(tmp_path) == tiny.CONFIG
    assert run_folder.read_config(tmp_path / "nowhere") is None


def test_a_config_of_another_version_is_refused_with_the_version_and_a_remedy(tmp_path):
    run_folder.write_config(tmp_path, tiny.CONFIG)
    path = tmp_path / "config.json"
    content = json.loads(path.read_text()) | {"vawm": "9.9"}
    content["config"]["colour"] = 1
    path.write_text(json.dumps(content))
    ours = f"vawm {manifest.version()}"
    with refused("logdir", str(path), naming=["Config.colour=1", "vawm 9.9", ours, "--fresh"]):
        run_folder.read_config(tmp_path)
    path.write_text(json.dumps(content | {"vawm": manifest.version()}))
    with refused("logdir", str(path), naming=["Config.colour=1", ours]):
        run_folder.read_config(tmp_path)


def test_a_config_that_cannot_be_written_leaves_the_folder_as_it_was(tmp_path, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    run_folder.write_config(tmp_path, tiny.CONFIG)
    monkeypatch.setattr(run_folder.pathlib.Path, "replace", full)
    with pytest.raises(OSError, match="No space left"):
        run_folder.write_config(tmp_path, tiny.config(seed=1))
    assert [path.name for path in tmp_path.iterdir()] == ["config.json"]
    assert run_folder.read_config(tmp_path) == tiny.CONFIG


def test_clearing_keeps_the_config_and_other_files(tmp_path):
    run_folder.write_config(tmp_path, tiny.CONFIG)
    for name in ("metrics.jsonl", "events.out.tfevents.1.host", "notes.txt"):
        (tmp_path / name).touch()
    run_folder.clear(tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["config.json", "notes.txt"]
