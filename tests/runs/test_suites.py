"""The command lines of the suites on the host, and the environments that a config names."""

import contextlib
import dataclasses
import importlib.util
import pathlib

import pytest

from vawm import presets
from vawm.agent import registry
from vawm.cli import command_line
from vawm.errors import InvalidInput
from vawm.process import cache
from vawm.runs import run_folder, runner, suites

FOLDER = pathlib.Path(__file__).parents[2] / "experiments"
PROGRAMS = {
    "dmc_proprio": "dmc_proprio",
    "dmc_vision": "dmc_vision",
    "atari100k": "atari100k",
    "gymnasium": "gymnasium_task",
}


@pytest.fixture
def experiment(monkeypatch, tmp_path):
    """`(suite, *flags) -> exit code` of a program, in an empty folder, with nothing trained."""
    monkeypatch.setattr(cache, "enable", lambda: None)
    monkeypatch.chdir(tmp_path)
    seen = []

    def run(config, logdir, *, banner, **_):
        print(banner)
        seen.append((config, logdir))
        return runner.Result(logdir, config.env_steps, 0)

    monkeypatch.setattr(runner, "run", run)

    def main(suite, *flags):
        path = FOLDER / f"{PROGRAMS[suite]}.py"
        spec = importlib.util.spec_from_file_location(PROGRAMS[suite], path)
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        return command_line.guard(lambda: module.main(flags))

    main.seen = seen
    return main


@pytest.mark.parametrize("suite", PROGRAMS)
@pytest.mark.parametrize("agent", registry.names())
def test_every_program_runs_its_suite_and_says_what_its_preset_is(
    experiment, suite, agent, capsys
):
    assert experiment(suite, *([] if agent == "dreamerv3" else ["--agent", agent])) == 0
    config, logdir = experiment.seen[0]
    assert config == registry.kind(agent).presets[suite]["quick"]
    assert logdir.parts[:2] == ("runs", suite)
    text = capsys.readouterr().out
    assert f"{agent}, preset quick: {suite} {config.task}, " in text
    assert "for a CPU with 2 cores; this is not the paper's setting" in text
    assert ("--preset paper" in text) == ("paper" in registry.kind(agent).presets[suite])


@pytest.mark.parametrize("flag", [["--game", "krull"], ["--game=krull"], ["--task", "krull"]])
def test_a_game_is_a_task(experiment, flag):
    flags = *flag, "--agent", "dreamerv3", "--env.sticky", "0.25", "--env.life-loss", "end"
    assert experiment("atari100k", *flags) == 0
    config, _ = experiment.seen[0]
    assert config.task == "krull"
    assert (config.env.sticky, config.env.life_loss) == (0.25, "end")


def test_presets_of_pixels_and_of_the_paper_can_be_named(experiment):
    assert experiment("gymnasium", "--preset", "pixels") == 0
    assert experiment("dmc_vision", "--preset", "paper", "--env-steps", "500000") == 0
    assert experiment("gymnasium", "--preset", "pixels", "--env-steps", "32000") == 0
    configs = [config for config, _ in experiment.seen]
    assert configs[0] == presets.GYMNASIUM_PIXELS
    assert configs[1].value_alignment == presets.PAPER.value_alignment
    warmup = presets.GYMNASIUM_PIXELS.value_alignment.warmup_steps
    assert configs[2].value_alignment.warmup_steps == 2 * warmup


@pytest.mark.parametrize(
    ("suite", "flags", "message"),
    [
        ("atari100k", ["--game", "brekout"], "game='brekout': did you mean 'breakout'?"),
        ("atari100k", ["--env.stiky", "1"], "--env.stiky='1': no such flag; did you mean"),
        ("atari100k", ["--env.sticky", "2"], "env.sticky=2.0: use a number from 0 up to"),
        ("atari100k", ["--agent", "strom"], "agent='strom': did you mean 'storm'? use"),
        ("dmc_vision", ["--task", "humanoid_run"], "task='humanoid_run': "),
        ("dmc_vision", ["--env.image-size", "84"], "env.image_size=84: use a multiple of 16"),
        ("dmc_vision", ["--env.renderer", "glx"], "--env.renderer='glx': did you mean 'egl'"),
        ("gymnasium", ["--task", "CartPole-v7"], "env='CartPole-v7': "),
        ("dmc_proprio", ["--env.sticky", "0.2"], "--env.sticky='0.2': no such flag"),
        ("dmc_proprio", ["--suite", "atari100k"], "suite='atari100k': this program runs"),
        ("dmc_proprio", ["--replay.images", "host"], "replay.images='host': there are no"),
    ],
)
def test_bad_input_is_one_line_and_code_2(experiment, suite, flags, message, capsys):
    assert experiment(suite, *flags) == 2
    output = capsys.readouterr()
    assert output.err.startswith(f"error: {message}")
    assert output.err.count("\n") == 1
    assert not output.out
    assert not list(pathlib.Path().iterdir())


def test_a_run_of_another_suite_is_not_resumed(experiment, tmp_path, capsys):
    (tmp_path / "run").mkdir()
    run_folder.write_config(tmp_path / "run", presets.ATARI_QUICK)
    assert experiment("dmc_vision", "--resume", "--logdir", "run") == 2
    assert "suite='atari100k': this program runs suite dmc_vision" in capsys.readouterr().err
    assert experiment("atari100k", "--resume", "--logdir", "run", "--env.workers", "2") == 0
    assert experiment.seen[0][0].env.workers == 2
    assert experiment("atari100k", "--resume", "--logdir", "run", "--env.noops", "2") == 2
    assert "env.noops=2: the run was started with 30" in capsys.readouterr().err


def test_a_config_makes_the_environments_that_it_names():
    config = dataclasses.replace(presets.ATARI_QUICK, task="pong", num_envs=2)
    with contextlib.closing(suites.make(config)) as env:
        assert (env.spec.task, env.spec.num_envs, env.spec.action_repeat) == ("pong", 2, 4)
        assert (env.spec.action_size, env.spec.discrete) == (6, True)
        assert env.spec.obs.shape == (64, 64, 3)
    config = dataclasses.replace(presets.GYMNASIUM_PIXELS, num_envs=1)
    with contextlib.closing(suites.make(config)) as env:
        assert (env.spec.task, env.spec.action_size) == ("vawm/GridWorld-v0", 4)
    proprio = suites.make(dataclasses.replace(presets.QUICK, task="pendulum_swingup"))
    assert proprio.spec.task == "pendulum_swingup"


def test_a_suite_without_a_simulator_is_a_mistake_of_ours():
    with pytest.raises(TypeError, match="no simulator for GymnasiumConfig"):
        suites.simulator(presets.GYMNASIUM_QUICK, presets.GYMNASIUM_QUICK.env)


def test_every_task_of_a_suite_is_known():
    for config, tasks, count in [
        (presets.QUICK, suites.envs.TASKS, 18),
        (presets.VISION_QUICK, suites.vision.VISION_TASKS, 20),
        (presets.ATARI_QUICK, tuple(suites.atari.GAMES), 26),
    ]:
        assert len(tasks) == count
        for task in tasks:
            suites.check_task(dataclasses.replace(config, task=task))
        with pytest.raises(InvalidInput):
            suites.check_task(dataclasses.replace(config, task="nothing"))
