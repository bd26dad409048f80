"""Runs in folders of any name: trained, resumed, loaded, exported, and told on one line."""

import io
import json
import os
import subprocess

import jax
import pytest
import rich.console
import tiny
import toy

import vawm
from vawm.evaluate import evaluate
from vawm.export import export
from vawm.process import names
from vawm.runs import checkpoint, runner
from vawm.runs.reports import tracking

NAME = os.fsdecode(b"lr=[1e-4]*\n\xff 'gs:")


def strict():
    """A console that refuses what its encoding lacks, and its text so far."""
    file = io.TextIOWrapper(io.BytesIO(), "utf-8", errors="strict", write_through=True)
    return rich.console.Console(file=file), lambda: file.buffer.getvalue().decode()


def test_a_run_in_a_folder_of_any_name_is_trained_resumed_loaded_and_exported(tmp_path):
    logdir = tmp_path / NAME / "run"
    logdir.parent.mkdir()
    (tmp_path / "link").symlink_to(logdir.parent)
    console, told = strict()
    runner.run(tiny.config(env_steps=32), logdir, env=tiny.env(), console=console)
    runner.run(
        tiny.CONFIG, tmp_path / "link" / "run", env=tiny.env(), resume=True, console=console
    )
    assert checkpoint.find(logdir).manifest.env_steps == 96
    assert tracking.read(logdir / tracking.METRICS)[-1]["env_steps"] == 96
    assert list(logdir.glob("events.out.tfevents.*"))
    assert repr(str(logdir)) in told()  # the Python line that evaluates it
    policy = vawm.load(logdir)
    assert evaluate(policy, episodes=2, env=tiny.env()).returns
    exported = export(logdir, tmp_path / "out" / NAME)
    assert json.loads((exported / "config.json").read_text())["env_steps"] == 96
    jax.tree.map(
        lambda a, b: toy.assert_equal([a], [b]), vawm.load(exported).params, policy.params
    )


@pytest.mark.parametrize(
    ("name", "shown"),
    [
        ("runs/a b", "runs/a b"),
        ("é漢", "é漢"),
        ("a\nb\tc\rd\x1b", r"a\nb\tc\rd\x1b"),
        (os.fsdecode(b"\xff'"), r"\xff'"),
        ("\u2028", r"\xe2\x80\xa8"),
    ],
)
def test_names_are_shown_on_one_printable_line(name, shown):
    assert names.shown(name) == shown


@pytest.mark.parametrize(
    "name", ["a b", "-x", "~", r"a\n'b", "$HOME", "'\n\\'", os.fsdecode(b"\xff\x01"), NAME]
)
def test_a_shell_reads_a_quoted_name_as_it_is(name):
    word = names.flag("logdir", name)
    assert word.isprintable()
    done = subprocess.run(
        ["bash", "-c", f"printf '%s\\0' {word}"], capture_output=True, check=True
    )
    found = os.fsdecode(done.stdout).rstrip("\0").replace("\0", "=")
    assert found == f"--logdir={name}"
