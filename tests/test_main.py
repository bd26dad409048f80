"""The command `vawm`: its help, its errors in one line, and what it starts."""

import pathlib
import subprocess
import sys
import tomllib

import pytest

import vawm
from vawm import __main__ as front_door
from vawm.process import cache, huge_pages
from vawm.runs import runner, suites

ROOT = pathlib.Path(__file__).parents[1]


@pytest.fixture
def command(monkeypatch, tmp_path):
    """`vawm` in an empty folder, with nothing trained; `command.ran` has what would be."""
    monkeypatch.setattr(huge_pages, "use_huge_pages", lambda: None)
    monkeypatch.setattr(cache, "enable", lambda: None)
    monkeypatch.setattr(sys, "argv", ["vawm"])
    monkeypatch.chdir(tmp_path)
    ran = []

    def run(config, logdir, **choices):
        ran.append((config, choices["command"]))
        return runner.Result(logdir, config.env_steps, 0)

    monkeypatch.setattr(runner, "run", run)

    def main(*words):
        return front_door.main(words)

    main.ran = ran
    return main


def test_the_help_comes_without_jax():
    script = """
import sys
from vawm import __main__ as front_door
assert front_door.main([]) == front_door.main(["--help"]) == front_door.main(["--version"]) == 0
assert front_door.main(["trian"]) == 2
assert not {"jax", "numpy", "tyro"} & set(sys.modules)
"""
    ended = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True
    )
    assert all(ended.stdout.count(f"\n    {name}") == 2 for name in front_door.PROGRAMS)
    assert f"\nvawm {vawm.__version__}\n" in ended.stdout
    assert ended.stderr.startswith("error: program='trian': did you mean 'train'?")
    assert ended.stderr.count("\n") == 1


def test_the_wheel_has_the_command():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert project["scripts"] == {"vawm": f"{front_door.__name__}:main"}


@pytest.mark.parametrize("suite", suites.SUITES)
def test_a_suite_is_trained_by_its_name(command, suite):
    task = suites.SUITES[suite].usual_tasks[-1]
    assert command("train", suite, "--task", task, "--num-envs", "2") == 0
    [(config, told)] = command.ran
    assert (config.suite, config.task, config.num_envs) == (suite, task, 2)
    assert told == f"vawm train {suite}"


def test_other_names_of_flags_are_those_of_the_suite(command):
    assert command("train", "atari100k", "--game=krull") == 0
    assert command.ran[0][0].task == "krull"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["train"], "suite=None: "),
        (["train", "--task", "walker_run"], "suite='--task': "),
        (["train", "dmc_propio"], "suite='dmc_propio': did you mean 'dmc_proprio'?"),
        (["train", "dmc_proprio", "--task", "hop"], "task='hop': "),
        (["evaluate"], "--logdir=None: "),
        (["export", "--logdr", "x"], "--logdr='x': "),
        (["analyse"], "--logdirs=None: "),
        (["sweep", "--jobs", "0"], "jobs=0: "),
    ],
)
def test_bad_input_is_one_line_and_code_2(command, capsys, words, message):
    assert command(*words) == 2
    output = capsys.readouterr()
    assert output.err.startswith(f"error: {message}")
    assert output.err.count("\n") == 1
    assert not output.out
    assert not command.ran


def test_the_help_of_training_lists_the_suites(command, capsys):
    assert command("train", "--help") == 0
    text = capsys.readouterr().out
    assert all(f"    {name}" in text for name in suites.SUITES)


@pytest.mark.parametrize("name", sorted(set(front_door.PROGRAMS) - {"train"}))
def test_the_help_of_a_program_has_its_name(command, capsys, name):
    with pytest.raises(SystemExit, match="0"):
        command(name, "--help")
    assert f"usage: vawm {name} " in capsys.readouterr().out
