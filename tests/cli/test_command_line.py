"""Flags, defaults in two phases, and one line for every kind of bad input."""

import dataclasses
import importlib.util
import pathlib
import re

import pytest
import tiny
import toy

from vawm import presets
from vawm.agent import with_size
from vawm.cli import command_line
from vawm.errors import InvalidInput
from vawm.process import cache
from vawm.runs import checkpoint, run_folder, runner, suites

EXPERIMENT = pathlib.Path(__file__).parents[2] / "experiments" / "dmc_proprio.py"


def parse(*flags):
    return command_line.parse(flags, suite="dmc_proprio", description="")


UNUSUAL = with_size(tiny.config(task="walker_run", preset="quick", seed=7), "1m")


def save(logdir, config):
    checkpoint.save(
        logdir, toy.state(), env_steps=48, config=config, spec=toy.SPEC, progress={}
    )


@pytest.fixture
def experiment(monkeypatch, tmp_path):
    """The `main` of the experiment, in an empty folder, with nothing trained."""
    spec = importlib.util.spec_from_file_location("dmc_proprio", EXPERIMENT)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    monkeypatch.setattr(cache, "enable", lambda: None)
    monkeypatch.chdir(tmp_path)

    def run(config, logdir, *, banner, **_):
        print(banner)
        return runner.Result(logdir, config.env_steps, 0)

    monkeypatch.setattr(runner, "run", run)
    return lambda *flags: command_line.guard(lambda: module.main(flags))


@pytest.fixture
def saved(tmp_path):
    """The folder of a run with unusual choices."""
    logdir = tmp_path / "saved"
    save(logdir, UNUSUAL)
    return logdir, UNUSUAL


def test_the_defaults_are_the_preset():
    assert parse().config == presets.QUICK
    assert parse("--preset", "paper").config == presets.PAPER
    assert parse("--preset=paper", "--size=25m").config == with_size(presets.PAPER, "25m")
    assert parse("--agent", "storm").config == presets.STORM_QUICK
    assert parse("--size=16m", "--agent=storm").config == with_size(presets.STORM_QUICK, "16m")


def test_a_program_may_have_another_agent_and_task():
    choices = {
        "suite": "dmc_proprio",
        "description": "",
        "agent": "storm",
        "task": "hopper_hop",
    }
    config = command_line.parse([], **choices).config
    assert config == dataclasses.replace(presets.STORM_QUICK, task="hopper_hop")
    config = command_line.parse(["--agent", "vagram", "--task", "walker_run"], **choices).config
    assert (config.agent, config.task) == ("vagram", "walker_run")


def test_other_flags_override_preset_and_size_in_any_order():
    config = parse(
        *("--world-model.deter", "256", "--value-alignment.weight", "off"),
        *("--critic.no-replay-gradient", "--env_steps", "5000", "--seed", "3"),
        *("--imagination.lambda_", "0.9", "--size", "12m", "--preset", "quick"),
    ).config
    assert config.world_model.deter == 256
    assert config.world_model.units == 256  # of size 12m
    assert config.value_alignment.weight == "off"
    assert not config.critic.replay_gradient
    assert (config.env_steps, config.seed, config.imagination.lambda_) == (5000, 3, 0.9)
    assert config.num_envs == presets.QUICK.num_envs


@pytest.mark.parametrize("preset", [presets.QUICK, presets.STORM_QUICK])
def test_every_field_of_the_config_is_a_flag(preset, capsys):
    with pytest.raises(SystemExit, match="0"):
        parse("--agent", preset.agent, "--help")
    text = capsys.readouterr().out
    for name, _ in command_line.validate.values(preset):
        flag = "--" + name.replace("_", "-").replace("lambda-", "lambda_")
        assert flag in text, flag


def test_a_run_gets_a_folder_of_its_own():
    assert parse("--logdir", "here").logdir == pathlib.Path("here")
    parts = parse("--task", "walker_walk", "--seed", "2").logdir.parts
    assert parts[:3] == ("runs", "dmc_proprio", "walker_walk")
    assert parts[3].startswith("quick-seed2-")


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--task", "walker_wlak"], "task='walker_wlak': .*'walker_walk'"),
        (["--preset", "papers"], "preset='papers': .*'paper'"),
        (["--size", "13m"], "size='13m': "),
        (["--agent", "strom"], "agent='strom': .*'storm'"),
        (["--agent", "storm", "--size", "12m"], "size='12m': .*'1m'"),
        (["--agent", "storm", "--preset", "paper"], "preset='paper': "),
        (
            ["--agent", "storm", "--world-model.hidden", "8"],
            "--world-model.hidden='8': ",
        ),
        (["--world-model.dropout", "0.1"], "--world-model.dropout='0.1': "),
        (["--env-steps", "0"], "env_steps=0: .*0"),
        (["--replay.capacity", "100"], "replay.capacity=100: "),
        (["--resume"], "logdir=None: .*--resume.*--logdir"),
        (["--fresh"], "logdir=None: .*--fresh.*--logdir"),
        (["--resume", "--logdir", "nowhere"], "logdir='nowhere': "),
        (["--resume", "--logdir", "file"], "logdir='file': "),
        (["--logdir", "."], "logdir='.': "),
        (["--logdir", "file/run"], "logdir='file/run': "),
        (["--env-step", "5"], "--env-step='5': .*--env-steps"),
        (["--env-steps", "1.5e0"], "--env-steps='1.5e0': use a whole number"),
        (["--env-steps", "1e-3"], "--env-steps='1e-3': use a whole number"),
        (["--lr", "1e-4"], "--lr='1e-4': .*'--optimizer.learning-rate'"),
        (["--seeds", "0", "1"], "--seeds='0 1': .*'--seed'"),
        (["--steps", "5"], "--steps='5': .*'--env-steps'"),
        (["--total-timesteps=5"], "--total-timesteps='5': .*'--env-steps'"),
        (["--env", "Pong"], "--env='Pong': .*'--task'"),
        (["--game", "pong"], "--game='pong': .*'--task'"),
        (["--batch-size", "8"], "--batch-size='8': .*'--replay.batch-size'"),
        (["--device", "cuda"], "--device='cuda': .*JAX_PLATFORMS"),
        (["--value-alignment.weight", "none"], ".*'none': did you mean 'off'"),
        (["--value-alignment.weight=0"], ".*'0': did you mean 'off'"),
        (["--tracker", "off"], ".*'off': did you mean 'none'"),
        (["--task", "walker_wlak", "--env-steps", "0"], "task='walker_wlak': .*'walker_walk'"),
        (["--critic.units", "x", "--task", "walker_wlak"], "task='walker_wlak': "),
        (["--seed", "x"], "--seed='x': "),
        (["stray"], "argument='stray': "),
        (["--resume=yes"], "--resume=True: "),
        (["--replay.batch-size", "100000"], "replay.batch_size=100000: "),
    ],
)
def test_bad_input_is_one_line_and_code_2(experiment, capsys, flags, message):
    pathlib.Path("file").touch()
    assert experiment(*flags) == 2
    output = capsys.readouterr()
    assert re.match(f"error: {message}", output.err)
    assert output.err.count("\n") == 1
    assert not output.out
    assert [path.name for path in pathlib.Path().iterdir()] == ["file"]


def test_the_preset_says_what_it_is(experiment, capsys):
    quick = presets.QUICK
    assert experiment() == 0
    text = capsys.readouterr().out
    what = f"dmc_proprio {quick.task}, {quick.env_steps:,} env steps, size 1m"
    assert f"dreamerv3, preset quick: {what}" in text
    assert "not the paper's setting" in text
    warmup = quick.value_alignment.warmup_steps
    assert f"value alignment: active after {warmup:,} env steps, for 94 % of the run" in text
    assert "the warm-up is shortened with the run (paper: 10,000 of 500,000)" in text
    assert "--preset paper" in text


@pytest.mark.parametrize("preset", ["quick", "paper"])
def test_value_alignment_that_is_off_is_called_off(preset):
    text = command_line.describe(
        parse("--preset", preset, "--value-alignment.weight", "off").config
    )
    assert "value alignment: off" in text.splitlines()[-1 if preset == "paper" else -2]
    assert "warm-up" not in text


@pytest.mark.parametrize("flag", [["--env-steps", "240000"], ["--env_steps=240000"]])
def test_the_warm_up_of_quick_keeps_its_share_of_another_length(flag):
    alignment = parse(*flag).config.value_alignment
    assert alignment == dataclasses.replace(
        presets.QUICK.value_alignment, warmup_steps=2 * 7_200
    )
    given = parse(*flag, "--value-alignment.warmup-steps", "5").config
    assert given.value_alignment.warmup_steps == 5
    paper = parse(*flag, "--preset", "paper").config
    assert paper.value_alignment == presets.PAPER.value_alignment


def test_the_warm_up_of_a_saved_run_stays_when_it_is_extended(saved):
    flags = "--resume", "--logdir", str(saved[0]), "--env-steps", "10000"
    assert parse(*flags).config.value_alignment == UNUSUAL.value_alignment


WARMUP, UPDATES = "--value-alignment.warmup-steps", "--value-alignment.warmup-unit=updates"


@pytest.mark.parametrize(
    ("flags", "expected"),
    [
        ([], "active after 7,200 env steps, for 94 % of the run; the warm-up is shortened"),
        (["--env-steps=5000"], "active after 300 env steps, for 94 % of the run; the warm-up"),
        (["--env-steps=500000"], "active after 30,000 env steps, for 94 % of the run\n"),
        ([WARMUP, "60000"], "active after 60,000 env steps, for 50 % of the run\n"),
        ([WARMUP, "119999"], "active after 119,999 env steps, for less than 1 % of the run\n"),
        ([WARMUP, "120000"], "never active in this run of 120,000 env steps, whose warm-up is"),
        ([UPDATES, WARMUP, "3686"], "active after 3,686 updates, for about 50 % of the run\n"),
        ([UPDATES], "active after 7,200 updates, for about 2 % of the run\n"),
        ([UPDATES, WARMUP, "7372"], "never active in this run of about 7,372 updates, whose"),
        ([UPDATES, "--env-steps=2080"], "never active in this run of about 2 updates, whose"),
    ],
)
def test_the_share_of_the_run_with_value_alignment_is_told(flags, expected):
    assert f"value alignment: {expected}" in command_line.describe(parse(*flags).config)


def test_the_warm_up_of_the_paper_is_told_and_not_called_scaled():
    text = command_line.describe(presets.PAPER)
    assert text.endswith("value alignment: active after 10,000 env steps, for 98 % of the run")


def test_a_run_with_widths_of_its_own_is_of_size_custom(tmp_path):
    config = parse("--world-model.units", "128").config
    assert config.size == "custom"
    assert (config.world_model.units, config.actor.units) == (128, 64)
    command_line.validate.check(config)
    assert parse("--world-model.units", "64").config.size == "1m"
    assert parse("--size", "custom", "--world-model.units", "128").config == config


def test_a_run_of_size_custom_is_resumed_as_such(experiment, tmp_path, capsys):
    config = parse("--task", "walker_run", "--critic.units", "128").config
    save(tmp_path / "custom", config)
    resume = "--resume", "--logdir", "custom"
    assert parse(*resume).config == config
    assert experiment(*resume) == experiment(*resume, "--size", "custom") == 0
    for flags, message in [
        (["--size", "1m"], "size='1m': .*'custom'"),
        (["--critic.units", "64"], "critic.units=64: .*128"),
        (["--size", "2m"], "size='2m': "),
    ]:
        assert experiment(*resume, *flags) == 2
        assert re.search(message, capsys.readouterr().err)


def test_a_run_without_a_checkpoint_keeps_its_settings(tmp_path):
    run_folder.write_config(tmp_path, UNUSUAL)
    assert parse("--resume", "--logdir", str(tmp_path)).config == UNUSUAL


def test_resume_takes_the_settings_of_the_saved_run(saved):
    logdir, config = saved
    arguments = parse("--resume", "--logdir", str(logdir), "--env-steps", "1000")
    assert arguments.resume
    assert arguments.config == dataclasses.replace(UNUSUAL, env_steps=1000)
    assert parse("--resume", "--logdir", str(logdir), "--preset", "quick").config == config


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (["--size", "12m"], "size='12m': .*'1m'"),
        (["--task", "walker_walk"], "task='walker_walk': "),
        (["--agent", "storm"], "agent='storm': .*'dreamerv3'"),
        (["--preset", "paper"], "preset='paper': "),
        (["--world-model.stoch", "8"], "world_model.stoch=8: "),
        (["--world-model.units", "8"], "world_model.units=8: "),
        (["--size", "custom"], "size='custom': .*'1m'"),
        (["--env-steps", "40"], "env_steps=40: .*48"),
    ],
)
def test_resume_refuses_other_settings_by_name(experiment, saved, capsys, flags, message):
    before = sorted(saved[0].rglob("*"))
    assert experiment("--resume", "--logdir", str(saved[0]), *flags) == 2
    assert re.search(message, capsys.readouterr().err)
    assert sorted(saved[0].rglob("*")) == before


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (InvalidInput("a", 1, "b"), 2),
        (runner.RunError("loss"), 1),
        (checkpoint.SaveError("disk"), 1),
        (KeyboardInterrupt(), 130),
    ],
)
def test_what_goes_wrong_is_one_line(capsys, error, code):
    def fail():
        raise error

    assert command_line.guard(fail) == code
    assert capsys.readouterr().err.count("\n") == 1


@pytest.mark.parametrize("length", ["240000", "240_000", "2.4e5", "24e4", "2.4E+05"])
def test_whole_numbers_may_be_written_in_other_ways(length):
    config = parse("--env-steps", length, "--replay.capacity=1e6").config
    assert (config.env_steps, config.replay.capacity) == (240_000, 1_000_000)
    assert config.value_alignment.warmup_steps == 2 * 7_200
    assert parse("--optimizer.learning-rate", "1e-3").config.optimizer.learning_rate == 1e-3


@pytest.mark.parametrize("suite", suites.SUITES)
def test_the_help_says_first_what_matters_most(suite, capsys):
    with pytest.raises(SystemExit, match="0"):
        command_line.parse(["--help"], suite=suite, command=f"vawm train {suite}")
    text = capsys.readouterr().out
    assert f"usage: vawm train {suite} " in text
    assert suites.SUITES[suite].title in " ".join(text.split())
    text = text.partition("The flags that matter most:")[2]
    places = [text.index(flag) for flag in command_line.FIRST]
    assert places == sorted(places)
    assert max(places) < text.index("--help ")


def test_starting_over_is_a_flag_and_not_the_usual():
    assert parse("--logdir", "run", "--fresh").fresh
    assert not parse("--logdir", "run").fresh
