"""The command lines of the suites on the host, and the environments that a config names."""

import ast
import contextlib
import dataclasses
import importlib.util
import pathlib

import pytest
from refusals import refused

import vawm
from vawm import envs, presets
from vawm.agent import registry
from vawm.cli import command_line
from vawm.envs.host import atari, vision
from vawm.errors import InvalidInput
from vawm.policy import scores
from vawm.process import cache
from vawm.runs import run_folder, runner, suites

FOLDER = pathlib.Path(__file__).parents[2] / "experiments"
PACKAGE = pathlib.Path(vawm.__file__).parent


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
        path = FOLDER / suites.SUITES[suite].program
        spec = importlib.util.spec_from_file_location(path.stem, path)
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        return command_line.guard(lambda: module.main(flags))

    main.seen = seen
    return main


@pytest.mark.parametrize("suite", suites.SUITES)
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
        ("atari100k", ["--task", "ALE/Pong-v5"], "game='ALE/Pong-v5': use 'pong', "),
        ("atari100k", ["--env.stiky", "1"], "--env.stiky='1': no such flag; did you mean"),
        ("atari100k", ["--env.sticky", "2"], "env.sticky=2.0: use a number from 0 up to"),
        ("atari100k", ["--agent", "strom"], "agent='strom': did you mean 'storm'? use"),
        ("dmc_vision", ["--task", "humanoid_run"], "task='humanoid_run': "),
        ("dmc_vision", ["--env.image-size", "84"], "env.image_size=84: use a multiple of 16"),
        ("dmc_vision", ["--env.renderer", "glx"], "--env.renderer='glx': did you mean 'egl'"),
        ("gymnasium", ["--task", "CartPole-v7"], "env='CartPole-v7': "),
        ("gymnasium", ["--env.image-size", "84"], "env.image_size=84: use a multiple of 16"),
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


def test_a_wrong_task_is_told_before_wrong_numbers(tmp_path):
    def check(task):
        config = dataclasses.replace(presets.QUICK, task=task, env_steps=0)
        runner.check(config, tmp_path, resume=False)

    with refused("task", "walker_wlak", naming="'walker_walk'"):
        check("walker_wlak")
    with refused("task", 3):
        check(3)
    with refused("env_steps", 0):
        check("walker_walk")


def test_remedies_name_fields_in_python_and_flags_on_the_command_line(capsys):
    """A problem of the look, with the setting that ends it."""
    env = dataclasses.replace(presets.GYMNASIUM_QUICK.env, workers=1)
    config = dataclasses.replace(presets.GYMNASIUM_QUICK, task="CliffWalking-v1", env=env)
    with refused("env", "CliffWalking-v1", naming="env.time_limit=1000") as refusal:
        suites.make(config)
    assert refusal.value.settings == {"env.time_limit": 1000}

    def fail():
        raise refusal.value

    assert command_line.guard(fail) == 2
    text = capsys.readouterr().err
    assert "--env.time-limit 1000" in text
    assert "time_limit" not in text


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


@pytest.mark.parametrize("name", suites.SUITES)
def test_every_suite_has_a_whole_record(name):
    suite = suites.SUITES[name]
    assert (FOLDER / suite.program).exists()
    assert suite.usual_tasks
    for task in suite.usual_tasks:
        suite.check_task(task)
    kinds = {field.name: field.type for field in dataclasses.fields(suite.choices)}
    assert all(kinds[number] in ("int", "float") for number in suite.rules)
    protocol = suite.protocol
    assert protocol.text
    assert protocol.episodes > 0
    assert protocol.changes.keys() <= kinds.keys()
    assert set(protocol.options) <= protocol.changes.keys()
    if suite.returns:
        assert suite.returns[0] < suite.returns[1]
    for config in presets.DREAMERV3[name].values():
        assert suites.of(config) is suite
        assert type(config.env) is suite.choices
        assert (config.video.every > 0) <= suite.has_images
        suites.check_task(config)


def test_every_table_of_scores_is_of_one_suite_and_has_its_tasks():
    named = [table for suite in suites.SUITES.values() for table in suite.tables]
    assert sorted(named) == sorted(scores.TABLES)
    for suite in suites.SUITES.values():
        for table in suite.tables:
            for row in scores.table(table):
                suite.check_task(scores.snake_case(row))
        if suite.human_table:
            assert suite.human_table in suite.tables
            for row in scores.table(suite.human_table).values():
                assert {"random", "human"} <= row.keys()


def test_only_records_and_presets_know_one_suite_from_another():
    """No other module names a class of choices, or compares with the name of a suite."""
    classes = {"AtariConfig", "VisionConfig", "GymnasiumConfig"}
    for path in PACKAGE.rglob("*.py"):
        name = path.relative_to(PACKAGE).as_posix()
        if name.startswith(("config/", "runs/suites/")):
            continue
        nodes = list(ast.walk(ast.parse(path.read_text())))
        assert not classes & {node.id for node in nodes if isinstance(node, ast.Name)}, name
        compared = [
            side
            for node in nodes
            if isinstance(node, ast.Compare)
            for side in (node.left, *node.comparators)
        ]
        constants = {side.value for side in compared if isinstance(side, ast.Constant)}
        assert not constants & suites.SUITES.keys(), name


def test_only_suites_on_the_host_have_choices_of_processes():
    own = {name: presets.DREAMERV3[name]["quick"] for name in suites.SUITES}
    hosts = {name: suites.host_choices(config) for name, config in own.items()}
    assert hosts.pop("dmc_proprio") is None
    assert hosts == {name: own[name].env for name in hosts}


def test_every_task_of_a_suite_is_known():
    for config, tasks, count in [
        (presets.QUICK, envs.TASKS, 18),
        (presets.VISION_QUICK, vision.VISION_TASKS, 20),
        (presets.ATARI_QUICK, tuple(atari.GAMES), 26),
    ]:
        assert len(tasks) == count
        for task in tasks:
            suites.check_task(dataclasses.replace(config, task=task))
        with pytest.raises(InvalidInput):
            suites.check_task(dataclasses.replace(config, task="nothing"))
