"""Malicious checkpoints: refused in one line, with no code run and nothing allocated."""

import contextlib
import hashlib
import json
import pathlib
import pickle
import re
import shutil

import numpy as np
import pytest
import toy
from runs import files_of, save_toy

from vawm.errors import InvalidInput
from vawm.runs import checkpoint
from vawm.runs.checkpoint import arrays, manifest

STATE = toy.state()


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    logdir = tmp_path_factory.mktemp("saved")
    save_toy(logdir, STATE, episodes={"length": np.array([1, 2])})
    return logdir


@pytest.fixture
def path(saved, tmp_path):
    """The only checkpoint of a folder, a copy."""
    return checkpoint.latest(shutil.copytree(saved, tmp_path / "run"))


def sign(path, text):
    """Writes a manifest with a matching checksum."""
    (path / manifest.NAME).write_bytes(text)
    (path / manifest.DIGEST).write_text(hashlib.sha256(text).hexdigest() + "\n")


def rewrite(path, change):
    """Changes the manifest with `change(content)`."""
    content = json.loads((path / manifest.NAME).read_bytes())
    change(content)
    sign(path, json.dumps(content).encode())


def rename(content, name):
    content["files"][name] = content["files"].pop(next(iter(content["files"])))


def refused(path, match):
    """Checks that all functions that read the only checkpoint refuse it in one line."""
    logdir, learner = path.parents[1], STATE.learner
    for read in (
        lambda: checkpoint.restore(logdir, STATE),
        lambda: checkpoint.restore_agent(logdir, learner.params, learner.model_state),
    ):
        with pytest.raises(InvalidInput, match=match) as error:
            read()
        assert "\n" not in str(error.value)
        assert len(str(error.value)) < 1000


@pytest.mark.parametrize(
    "name", ["../x", "/etc/passwd", "params/../../x", "params/./x", "params//x", "x", "", "a/b"]
)
def test_a_file_elsewhere_is_refused(path, name):
    rewrite(path, lambda content: rename(content, name))
    refused(path, f"manifest.*file {re.escape(repr(name))}")


@pytest.mark.parametrize("what", ["folder", "file"])
def test_a_link_to_the_right_file_is_refused(path, tmp_path, what):
    original = path / "params" if what == "folder" else files_of(path / "params")[0]
    moved = original.rename(tmp_path / "elsewhere")
    original.symlink_to(moved)
    refused(path, f"{original.name}': .*link")


@pytest.mark.parametrize("name", [manifest.NAME, manifest.DIGEST])
def test_a_link_to_a_manifest_is_refused(path, tmp_path, name):
    (path / name).symlink_to((path / name).rename(tmp_path / "elsewhere"))
    refused(path, f"{name}': ")


def test_files_too_large_for_their_leaves_are_refused_before_they_are_read(path, monkeypatch):
    def enlarge(content):
        name = next(name for name in content["files"] if name.startswith("params/"))
        content["files"][name][0] = 10**12

    monkeypatch.setattr(checkpoint.reading, "verify", None)
    rewrite(path, enlarge)
    refused(path, "params has 1000.* bytes")


def test_episodes_above_the_limit_are_refused(path):
    def enlarge(content):
        content["leaves"]["episodes"]["length"]["shape"] = [10**9, 10**6]

    rewrite(path, enlarge)
    refused(path, f"episodes has .* bytes, .*{manifest.MAX_EPISODES_BYTES}")


def test_small_files_do_not_expand_to_huge_parameters(path):
    def enlarge(content):
        leaves = content["leaves"]["params"]
        leaves[next(iter(leaves))]["shape"] = [10**9]

    rewrite(path, enlarge)
    refused(path, "params has 4000000")


def test_arrays_larger_than_the_manifest_says_are_refused_before_they_are_read(
    path, monkeypatch
):
    """A few compressed bytes can expand to any number of equal ones."""
    params = {"['bomb']": np.zeros(10_000_000, np.float32)}
    names = json.loads((path / manifest.NAME).read_bytes())["leaves"]["params"]
    for item in (params, dict.fromkeys(names, params["['bomb']"])):
        shutil.rmtree(path / "params")
        arrays.write(path / "params", item)

        def describe(content):
            for name in [name for name in content["files"] if name.startswith("params/")]:
                del content["files"][name]
            for file in files_of(path / "params"):
                size = [file.stat().st_size, manifest.sha256(file)]
                content["files"][str(file.relative_to(path))] = size

        rewrite(path, describe)
        monkeypatch.setattr(arrays.ocp.Checkpointer, "restore", None)
        refused(path, r"params': holds (other arrays|.* float32\[10000000\])")
        monkeypatch.undo()


class Payload:
    """Writes a file when it is unpickled."""

    def __init__(self, marker):
        self._marker = marker

    def __reduce__(self):
        return pathlib.Path.touch, (self._marker,)


def test_a_pickle_instead_of_any_file_is_not_executed(path, tmp_path):
    marker = tmp_path / "executed"
    payload = pickle.dumps(Payload(marker))
    for file in files_of(path):
        content = file.read_bytes()
        file.write_bytes(payload)
        with pytest.raises(InvalidInput):
            checkpoint.restore(path.parents[1], STATE)
        name = str(file.relative_to(path))
        if name.startswith(("params/", "state/")):  # also with the right checksum

            def describe(content, name=name):
                content["files"][name] = [len(payload), hashlib.sha256(payload).hexdigest()]

            before = (path / manifest.NAME).read_bytes()
            rewrite(path, describe)
            with contextlib.suppress(InvalidInput):  # Orbax does not read every file
                checkpoint.restore(path.parents[1], STATE)
            sign(path, before)
        file.write_bytes(content)
    assert not marker.exists()
    pickle.loads(payload)
    assert marker.exists()


@pytest.mark.parametrize(
    ("text", "match"),
    [
        (b"[" * 200_000, "nested too deep"),
        (b'{"a":' * 200_000, "nested too deep"),
        (b"", "Expecting value"),
        (b"null", "is not a manifest"),
        (b"[]", "is not a manifest"),
        (b"{}", "is missing"),
        (b"\xff\xfe\xff", "is not a manifest"),
        (b"1" * 5000, "is not a manifest"),
        (b'{"schema": 1, "version": "1"', "Expecting ',' delimiter"),
    ],
)
def test_other_content_than_a_manifest_is_refused(path, text, match):
    sign(path, text)
    refused(path, match)


def test_a_huge_manifest_is_not_read(path, monkeypatch):
    with (path / manifest.NAME).open("r+b") as file:
        file.truncate(2**40)  # a sparse file, which takes no space on disk
    refused(path, "16777216")


FIELDS = ("schema", "version", "computed", "env_steps", "config", "spec", "progress", "leaves")


@pytest.mark.parametrize("field", [*FIELDS, "files"])
def test_a_field_that_is_missing_or_of_another_kind_is_refused(path, field):
    text = (path / manifest.NAME).read_bytes()
    rewrite(path, lambda content: content.pop(field))
    refused(path, f"{field} is missing")
    for value in (None, [], [[]], True, 1.5):
        sign(path, text)
        rewrite(path, lambda content, value=value: content.update({field: value}))
        refused(path, f"{field} is ")


@pytest.mark.parametrize(
    ("change", "match"),
    [
        (lambda c: c.update(more=1), "'more'"),
        (lambda c: c.update(schema=3, version="9.9"), "schema 3.*vawm 9.9"),
        (
            lambda c: c["config"].update(colour=1) or c.update(version="9.9"),
            r"run/checkpoints/0.*': Config\.colour=1: .*vawm 9.9.* --fresh",
        ),
        (lambda c: c.update(env_steps=5), "5 env steps"),
        (lambda c: c.update(env_steps=-1), "-1"),
        (lambda c: c["config"].update(colour=1), r"Config\.colour=1"),
        (lambda c: c["config"].pop("seed"), r"Config\.seed=None"),
        (lambda c: c["config"].update(num_envs="2"), r"num_envs='2'"),
        (lambda c: c["config"].update(num_envs=0), "num_envs=0"),
        (lambda c: c["config"].update(actor=3), "ActorConfig='3'"),
        (lambda c: c["config"].update(suite=["a"]), r"Config\.suite=\['a'\]"),
        (lambda c: c["config"]["actor"].update(units=10**20), "actor.units=10"),
        (lambda c: c["spec"].update(more=1), "'more'"),
        (lambda c: c["spec"].update(num_envs="2"), "num_envs is '2'"),
        (lambda c: c["spec"].update(obs={"shape": [-1], "dtype": "uint8"}), "'-1'"),
        (lambda c: c["spec"].update(obs={"shape": [1], "dtype": "object"}), "'object'"),
        (lambda c: c["leaves"].update(other={}), "item 'other'"),
        (lambda c: c["leaves"].update(params=[]), "item params"),
        (lambda c: c["leaves"]["params"].update(x=1), "'1' .*shape, dtype"),
        (
            lambda c: c["leaves"]["params"].update(x={"shape": [], "dtype": "O", "impl": None}),
            "dtype 'O'",
        ),
        (lambda c: c["files"].update({"params/x": "y"}), "'params/x'"),
        (lambda c: c["files"].update({"params/x": [1, "y"]}), "'params/x'"),
        (lambda c: c["files"].update({"params/x": [-1, "0" * 64]}), "'-1'"),
        (lambda c: c["files"].clear(), "params/.*': is not in the manifest"),
        (lambda c: rename(c, "params/x"), "params/x': is missing"),
    ],
)
def test_a_manifest_with_wrong_content_is_refused(path, change, match):
    rewrite(path, change)
    refused(path, match)
