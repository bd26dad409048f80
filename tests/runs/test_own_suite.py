"""A fifth suite: one record and its presets, and all else finds it by its name."""

import dataclasses
import json

import pytest
import runs
import tiny
import tiny_storm

from vawm import evaluate, export, load, presets
from vawm.cli import command_line
from vawm.config import EnvConfig
from vawm.envs import probes
from vawm.errors import NOT_NEGATIVE, InvalidInput
from vawm.policy import scores
from vawm.runs import runner, suites, validate
from vawm.runs.suites import Protocol, Suite


@dataclasses.dataclass(frozen=True)
class ProbeConfig(EnvConfig):
    """What can be chosen of a probe."""

    steps: int = 4
    """of an episode"""
    spare: int = 0


def check(config, env):
    if env.spare > env.steps:
        raise InvalidInput("env.spare", env.spare, f"use at most env.steps={env.steps}")


def make(config, env):
    name = config.task.removeprefix("probe_")
    return probes.make(name, num_envs=config.num_envs, episode_length=env.steps)


SUITE = Suite(
    choices=ProbeConfig,
    rules={"spare": NOT_NEGATIVE},
    check=check,
    check_task=lambda task: probes.check_probe(task.removeprefix("probe_")),
    make=make,
    protocol=Protocol("whole episodes of twice the steps", 3, {"steps": 8}, ("steps",)),
    program="probes.py",
    usual_tasks=("probe_memory",),
    has_images=False,
)
CONFIG = tiny.config(suite="probes", env=ProbeConfig())


@pytest.fixture(scope="module", autouse=True)
def registered():
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(suites.SUITES, "probes", SUITE)
        named = {"quick": dataclasses.replace(CONFIG, preset="quick")}
        patch.setitem(presets.DREAMERV3, "probes", named)
        yield


@pytest.fixture(scope="module")
def logdir(registered, tmp_path_factory):
    """The folder of a whole run."""
    folder = tmp_path_factory.mktemp("probes")
    runner.run(CONFIG, folder, console=runs.quiet())
    return folder


def test_it_is_trained_and_its_config_is_read_again(logdir):
    lines = runs.lines(logdir)
    assert lines[-1]["env_steps"] == CONFIG.env_steps
    assert lines[-1]["updates"] > 0
    assert json.loads((logdir / "config.json").read_text())["config"]["env"]["steps"] == 4
    policy = load(logdir)
    assert policy.config == CONFIG
    assert policy.spec.task == CONFIG.task


def test_its_run_is_resumed(logdir):
    longer = dataclasses.replace(CONFIG, env_steps=CONFIG.env_steps + 16)
    runner.run(longer, logdir, resume=True, console=runs.quiet())
    assert runs.lines(logdir)[-1]["env_steps"] >= longer.env_steps > CONFIG.env_steps


def test_its_protocol_evaluates_it(logdir, capsys, monkeypatch):
    monkeypatch.setattr(evaluate.cache, "enable", lambda: None)
    score = evaluate.by_protocol(load(logdir))
    assert len(score.returns) == 3
    assert evaluate.by_protocol(load(logdir), steps=4, episodes=2) != score
    with pytest.raises(InvalidInput, match="spare=1: "):
        evaluate.by_protocol(load(logdir), spare=1)
    assert evaluate.main(["--logdir", str(logdir)]) == 0
    title, line = capsys.readouterr().out.splitlines()
    assert title.startswith(f"{CONFIG.task} (probes) at ")
    assert line == f"  sample {score}"


def test_human_scores_of_its_own_normalise_its_score(logdir, capsys, monkeypatch):
    monkeypatch.setattr(evaluate.cache, "enable", lambda: None)
    game = scores.Game(CONFIG.task, random=-1.0, human=2.0)
    monkeypatch.setattr(scores, "games", lambda table: {table: game})
    suite = SUITE._replace(tables=("probes",), human_table="probes")
    monkeypatch.setitem(suites.SUITES, "probes", suite)
    score = evaluate.by_protocol(load(logdir))
    assert evaluate.main(["--logdir", str(logdir)]) == 0
    _, line = capsys.readouterr().out.splitlines()
    assert line == f"  sample {score}, {(score.mean + 1) / 3:.3f} human-normalised"


def test_its_policy_is_exported_with_its_protocol(logdir, tmp_path):
    score = evaluate.by_protocol(load(logdir))
    folder = export.export(logdir, tmp_path / "policy", scores=score)
    text = (folder / "README.md").read_text()
    assert f"| task | {CONFIG.task} (probes) |" in text
    assert "(whole episodes of twice the steps; actions sampled)" in text
    assert load(folder).config == load(logdir).config


@pytest.mark.parametrize(
    ("changes", "field", "value"),
    [
        ({"env": EnvConfig()}, "env", "EnvConfig"),
        ({"env": ProbeConfig(spare=-1)}, "env.spare", -1),
        ({"env": ProbeConfig(steps=0)}, "env.steps", 0),
        ({"env": ProbeConfig(spare=5)}, "env.spare", 5),
        ({"suite": "prob"}, "suite", "prob"),
        ({"video": dataclasses.replace(CONFIG.video, every=8)}, "video.every", 8),
    ],
)
def test_what_it_does_not_allow_is_refused(changes, field, value):
    validate.check(CONFIG)
    with pytest.raises(InvalidInput) as refusal:
        validate.check(dataclasses.replace(CONFIG, **changes))
    assert (refusal.value.field, refusal.value.value) == (field, value)


def test_an_agent_without_presets_for_it_is_trained_with_a_config_of_ones_own():
    validate.check(dataclasses.replace(tiny_storm.CONFIG, suite="probes", env=ProbeConfig()))


def test_its_tasks_are_checked():
    suites.check_task(CONFIG)
    with pytest.raises(InvalidInput, match="probe='nothing': "):
        suites.check_task(dataclasses.replace(CONFIG, task="probe_nothing"))


def test_a_program_reads_its_choices_as_flags():
    flags = ["--env.steps", "6", "--env.spare", "2"]
    parsed = command_line.parse(flags, suite="probes", description="").config
    assert (parsed.suite, parsed.env) == ("probes", ProbeConfig(steps=6, spare=2))
