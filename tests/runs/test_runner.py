"""The host loop: lines, checkpoints, signals, and resuming bit for bit."""

import errno
import io
import json
import math
import os
import re
import shutil
import signal
import time
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import pytest
import rich.console
import tiny
import toy
from runs import assert_same, events, files_of, lines, measured, quiet
from tensorboardX.proto.event_pb2 import SessionLog

from vawm import envs
from vawm.agent import Agent
from vawm.errors import InvalidInput
from vawm.learning import replay
from vawm.runs import budget, checkpoint, diagnosis, runner
from vawm.runs.checkpoint import manifest
from vawm.runs.reports import backends, tracking
from vawm.runs.runner import RunError
from vawm.runs.trainer import CompiledStep, Program
from vawm.types import TimeStep, Trajectory

LONG = tiny.config(env_steps=192)


class SignalAt(io.StringIO):
    """A console's file that sends SIGINT when it reads `text`."""

    def __init__(self, text):
        super().__init__()
        self._text = text

    def write(self, text):
        if self._text in text:
            os.kill(os.getpid(), signal.SIGINT)
        return super().write(text)


class FakeStep:
    """8 env steps and one update per chunk; `loss(env_steps)` is what it reports."""

    def __init__(self, loss):
        self._loss = loss

    def __call__(self, state):
        state = state._replace(env_steps=state.env_steps + 8)
        loss = self._loss(int(state.env_steps))
        return state, {
            "env_steps": state.env_steps,
            "updates": state.env_steps // 8,
            "chunk/updates": jnp.int32(1),
            "chunk/nonfinite": jnp.int32(0),
            "episode/count": jnp.int32(0),
            "episode/return": jnp.float32(0),
            "loss/critic": jnp.float32(loss),
        }


class Waiting(NamedTuple):
    """What has arrived, in place of a `Collector`."""

    timestep: TimeStep


def arrived(reward=(0.0, 0.0)):
    """Of two environments, with these rewards."""
    flag = jnp.zeros(2, bool)
    return Waiting(TimeStep(jnp.zeros((2, 1)), jnp.array(reward), flag, flag, flag))


def stored(reward=()):
    """Replay of two environments, 4 steps each, whose last rewards are `reward`, `[N, K]`."""
    zeros = jnp.zeros(2)
    example = Trajectory(zeros[:, None], zeros, zeros > 0, zeros > 0, zeros > 0, zeros[:, None])
    buffer = replay.init(example, (), capacity=4)
    steps = jax.tree.map(lambda x: jnp.stack([x] * 4, 1), example)
    buffer = replay.add(buffer, steps, ())  # and wraps with what follows
    reward = jnp.asarray(reward or jnp.zeros((2, 0)), jnp.float32)
    steps = jax.tree.map(lambda x: x[:, : reward.shape[1]], steps)
    return replay.add(buffer, steps._replace(reward=reward), ())


@pytest.fixture
def fake(monkeypatch):
    """Puts a `FakeStep` with the given losses in place of training."""

    def install(loss=lambda env_steps: env_steps):
        program = Program(
            spec=toy.SPEC,
            agent=None,
            shapes=None,
            init=lambda seed: toy.state()._replace(replay=stored(), collector=arrived()),
            compile=lambda state: CompiledStep(FakeStep(loss), ()),
            episodes=lambda: None,
            resume=lambda state, _: (state, 0),
            close=lambda: None,
        )
        monkeypatch.setattr(runner, "prepare", lambda *_: program)

    return install


def run(config, logdir, **changes):
    return runner.run(config, logdir, **{"env": tiny.env(), "console": quiet()} | changes)


def test_a_line_closes_each_interval_and_the_run(tmp_path, fake):
    fake()
    run(tiny.config(env_steps=56, log_every=24), tmp_path)
    assert [line["env_steps"] for line in lines(tmp_path)] == [24, 48, 56]
    assert [line["loss/critic"] for line in lines(tmp_path)] == [16.0, 40.0, 56.0]
    assert [line["updates"] for line in lines(tmp_path)] == [3, 6, 7]
    assert all(line["episode/return"] is None for line in lines(tmp_path))


def test_a_run_leaves_its_config_a_checkpoint_and_advice(tmp_path, fake):
    fake()
    console = quiet()
    result = run(tiny.CONFIG, tmp_path, console=console)
    assert result == runner.Result(tmp_path, 96, 0)
    assert json.loads((tmp_path / "config.json").read_text())["config"]["env_steps"] == 96
    assert checkpoint.latest(tmp_path).name == "000000000096"
    # What to do where the environment is no registered one.
    assert f"vawm.evaluate.evaluate(vawm.load({str(tmp_path)!r})" in console.file.getvalue()
    resumption = (
        f"vawm.runs.runner.run(config, {str(tmp_path)!r}, env=..., resume=True), its env_st"
    )
    assert f"go on with: {resumption}" in console.file.getvalue()


def test_a_tracker_that_fails_changes_nothing_but_one_line_of_output(
    tmp_path, fake, monkeypatch
):
    def unreachable(*_):
        raise ConnectionError("unreachable")

    fake()
    monkeypatch.setitem(backends.OPENERS, "wandb", unreachable)
    monkeypatch.setattr(backends, "check", lambda _: None)
    console = quiet()
    run(tiny.config(tracker="wandb"), tmp_path / "with", console=console)
    run(tiny.CONFIG, tmp_path / "without")
    assert console.file.getvalue().count("warning: wandb gets no more") == 1
    assert measured(tmp_path / "with") == measured(tmp_path / "without")
    assert checkpoint.latest(tmp_path / "with").name == "000000000096"


def saves(logdir):
    return [line["env_steps"] for line in tracking.read(logdir / tracking.SAVE_LINES)]


def test_a_line_tells_of_each_checkpoint(tmp_path, fake):
    fake()
    run(tiny.CONFIG, tmp_path)
    names = {"checkpoint/bytes", "checkpoint/seconds", "checkpoint/blocked_seconds"}
    assert saves(tmp_path) == [32, 64, 96]
    for line in tracking.read(tmp_path / tracking.SAVE_LINES):
        assert line.keys() == names | {"env_steps"}
    assert not any("checkpoint/bytes" in line for line in lines(tmp_path))


def test_checkpoints_by_time_change_nothing_that_is_measured(tmp_path, fake):
    fake()
    for name, minutes in (("often", 1e-9), ("never", 0.0)):
        config = tiny.config(save_minutes=minutes, save_every=1000, env_steps=48)
        run(config, tmp_path / name)
    assert saves(tmp_path / "often") == [8, 16, 24, 32, 40, 48]
    assert saves(tmp_path / "never") == [48]
    assert measured(tmp_path / "often") == measured(tmp_path / "never")
    kept = [int(path.name) for path in checkpoint.complete(tmp_path / "often")]
    assert kept == [48, 40]


def test_a_chunk_without_a_step_forward_is_not_saved_again(tmp_path, fake, monkeypatch):
    """As where every environment is reset; one that goes back is an error."""
    steps = iter([8, 8, 16, 8])
    fake()
    advance = runner.advance
    monkeypatch.setattr(
        runner,
        "advance",
        lambda progress, metrics, began: advance(
            progress, metrics | {"env_steps": next(steps)}, began=began
        ),
    )
    with pytest.raises(RunError, match="env_steps went from 16 back to 8"):
        run(tiny.config(save_minutes=1e-9), tmp_path)
    assert saves(tmp_path) == [8, 16]


def test_a_disk_that_is_full_when_saving_ends_the_run_and_keeps_the_checkpoint(
    tmp_path, fake, monkeypatch
):
    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    def loss(env_steps):
        if env_steps == 64:
            while checkpoint.latest(tmp_path) is None:  # that at 32
                time.sleep(0.01)
            monkeypatch.setattr(manifest, "write", full)
        return 1.0

    fake(loss)
    with pytest.raises(checkpoint.SaveError, match=r"000000000064 could not .*No space left"):
        run(tiny.CONFIG, tmp_path)
    monkeypatch.undo()
    assert [path.name for path in checkpoint.root(tmp_path).iterdir()] == ["000000000032"]
    assert checkpoint.find(tmp_path).manifest.env_steps == 32


def test_starting_over_on_purpose_moves_what_is_there_aside(tmp_path, fake):
    fake()
    run(tiny.CONFIG, tmp_path / "run", fresh=True)
    for number in (1, 2):
        before = measured(tmp_path / "run")
        console = quiet()
        config = tiny.config(seed=number, env_steps=48 + 8 * number)
        run(config, tmp_path / "run", fresh=True, console=console)
        aside = tmp_path / "run" / f"replaced-{number}"
        assert f"is in {aside} now: this run starts over" in console.file.getvalue()
        assert measured(aside) == before
        assert checkpoint.find(aside).manifest.config.seed == number - 1
        assert checkpoint.find(tmp_path / "run").manifest.config.seed == number
    with pytest.raises(InvalidInput, match="fresh=True: starts over, and --resume goes on"):
        run(tiny.CONFIG, tmp_path / "run", fresh=True, resume=True)


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_loss_that_is_not_finite_stops_the_run_and_keeps_the_checkpoint(
    tmp_path, fake, value
):
    fake(lambda env_steps: value if env_steps > 40 else 1.0)
    with pytest.raises(runner.RunError, match=r"loss/critic is .* at env_steps=48.* at 32"):
        run(tiny.CONFIG, tmp_path)
    assert checkpoint.latest(tmp_path).name == "000000000032"
    assert lines(tmp_path)[-1]["loss/critic"] is None
    found = json.loads((tmp_path / "diagnosis.json").read_text())
    optimizer, last = found.pop("optimizer"), found.pop("last_finite_line")
    assert optimizer["learning_rate"] == tiny.CONFIG.optimizer.learning_rate
    assert (last["env_steps"], last["loss/critic"]) == (32, 1.0)
    assert found == {
        "loss": "loss/critic",
        "value": str(value),
        "env_steps": 48,
        "updates": 6,
        "nonfinite_metrics": {"loss/critic": str(value)},
        "nonfinite_parameters": [],
        "nonfinite_replay": [],
    }


def test_a_parameter_that_the_last_update_broke_is_told_as_well(tmp_path, fake, monkeypatch):
    """Its loss is that of the parameters before; one of the update after it never comes."""
    call = FakeStep.__call__

    def breaks(self, state):
        state, metrics = call(self, state)
        if state.env_steps == 96:
            actor = {"bias": jnp.full(1, jnp.nan)}
            learner = state.learner
            params = learner.params._replace(actor=actor)
            state = state._replace(learner=learner._replace(params=params))
        return state, metrics

    fake()
    monkeypatch.setattr(FakeStep, "__call__", breaks)
    told = r"parameter \.actor\['bias'\] is not finite at env_steps=96; kept: .* at 64.*"
    with pytest.raises(RunError, match=told + "more in .*diagnosis.json"):
        run(tiny.CONFIG, tmp_path)
    found = json.loads((tmp_path / "diagnosis.json").read_text())
    assert found["nonfinite_parameters"] == [".actor['bias']"]
    assert (found["loss"], found["value"]) == (None, None)
    assert lines(tmp_path)[-1]["env_steps"] == 96


def test_a_loss_that_is_not_finite_is_told_though_a_save_has_failed(
    tmp_path, fake, monkeypatch
):
    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    def loss(env_steps):
        if env_steps < 40:
            return 1.0
        time.sleep(0.3)  # for the save at 32
        return math.nan

    fake(loss)
    monkeypatch.setattr(manifest, "write", full)
    with pytest.raises(RunError, match=r"loss/critic is nan at env_steps=40; kept: no check"):
        run(tiny.CONFIG, tmp_path)
    assert (tmp_path / "diagnosis.json").exists()


def test_what_replay_holds_that_is_not_finite_is_named_by_environment_and_step():
    nan, inf = math.nan, math.inf
    replay_of_both = stored([[1.0, nan, 2.0], [-inf, 0.0, nan]])
    state = toy.state()._replace(replay=replay_of_both, collector=arrived())
    assert diagnosis.nonfinite_steps(state) == [
        {"field": "reward", "environment": 1, "steps_ago": 2, "steps": 3}
    ]
    assert not diagnosis.nonfinite_steps(state._replace(replay=stored([[1e30], [-1e30]])))


def test_what_has_arrived_and_is_not_stored_yet_comes_after_what_is():
    state = toy.state()._replace(replay=stored([[1.0], [math.nan]]), collector=arrived())
    before = {"field": "reward", "environment": 1, "steps_ago": 0, "steps": 1}
    assert diagnosis.nonfinite_steps(state) == [before]
    state = state._replace(collector=arrived([math.inf, 0.0]))
    now = {"field": "reward", "environment": 0, "steps_ago": -1, "steps": 1}
    assert diagnosis.nonfinite_steps(state) == [before, now]


def test_who_returned_it_is_not_blamed_on_the_environment_where_an_action_came_before():
    nan = math.nan
    replay_of_both = stored([[1.0, 1.0], [1.0, nan]])
    blamed = toy.state()._replace(replay=replay_of_both, collector=arrived())
    assert diagnosis.advice(blamed).startswith("environment 1 returned reward that is")
    actions = blamed.replay.trajectory.action
    same, before = (actions.at[1, slot].set(nan) for slot in newest(blamed.replay, 0, 1))
    for action, told in (
        (same, "environment 1 returned"),
        (before, "Start again with a small"),
    ):
        trajectory = blamed.replay.trajectory._replace(action=action)
        state = blamed._replace(replay=blamed.replay._replace(trajectory=trajectory))
        assert diagnosis.advice(state).startswith(told)
        reason = diagnosis.reason(state, {"chunk/nonfinite": 1}, last=False)
        assert reason.startswith("an action" if told.startswith("Start") else "what an env")
    whole = toy.state()._replace(replay=stored(), collector=arrived())
    reason = diagnosis.reason(whole, {"chunk/nonfinite": 1}, last=False)
    assert reason.startswith("what an env")  # and was overwritten since


def newest(buffer, *ago):
    """The slots of steps counted back from the newest."""
    return [(int(buffer.head) - 1 - a) % buffer.trajectory.reward.shape[1] for a in ago]


@pytest.mark.parametrize("field", ["reward", "obs"])
def test_a_first_observation_that_is_not_finite_begins_no_run(tmp_path, field):
    plain = tiny.env()

    def reset(key):
        state, timestep = plain.reset(key)
        value = getattr(timestep, field).at[1].set(jnp.nan)
        return state, timestep._replace(**{field: value})

    told = f"environment 1 returned {field} that is not finite where the run begins: mend that"
    with pytest.raises(RunError, match=told):
        run(tiny.CONFIG, tmp_path, env=plain._replace(reset=reset))
    assert checkpoint.latest(tmp_path) is None


def test_a_nan_action_that_an_environment_puts_up_with_is_not_saved_either(
    tmp_path, monkeypatch
):
    """That is the policy's fault, and the line says so."""
    act = Agent.act

    def wild(*args, **kwargs):
        carry, action = act(*args, **kwargs)
        action = action.at[1].set(jnp.nan)
        return carry._replace(action=action), action

    monkeypatch.setattr(Agent, "act", wild)
    plain = tiny.env()
    tolerant = plain._replace(step=lambda state, a: plain.step(state, jnp.nan_to_num(a)))
    with pytest.raises(RunError, match=r"an action is not finite at .* Start again with a"):
        run(tiny.CONFIG, tmp_path, env=tolerant)
    assert checkpoint.latest(tmp_path) is None


class Counted(NamedTuple):
    """The state of an environment, and how often it was stepped."""

    inner: Any
    steps: jax.Array
    key: jax.Array
    calls: jax.Array


def breaking(field, at):
    """The environment of `tiny`; its second one returns one NaN, by call `at`."""
    plain = tiny.env()

    def counted(state, calls):
        return Counted(state, state.steps, state.key, calls)

    def reset(key):
        state, timestep = plain.reset(key)
        return counted(state, jnp.zeros((), jnp.int32)), timestep

    def step(state, action):
        calls = state.calls + 1
        state, timestep = plain.step(state.inner, action)
        value = getattr(timestep, field)
        value = value.at[1].set(jnp.where(calls == at, jnp.nan, value[1]))
        return counted(state, calls), timestep._replace(**{field: value})

    return plain._replace(reset=reset, step=step)


@pytest.mark.parametrize(("field", "ago"), [("reward", 2), ("obs", 2), ("obs", 0)])
def test_one_step_that_is_not_finite_stops_the_run_before_it_is_saved(tmp_path, field, ago):
    """Of an environment of one's own on the device. Mended, the run goes on."""
    told = (
        "what an environment returned is not finite at env_steps=40; kept: the checkpoint at "
        rf"32; .*json. environment 1 returned {field} that is not finite, {ago} steps before "
        "the newest: mend what returned it, then go on with --resume"
    )
    with pytest.raises(RunError, match=told):  # after the 24 calls of six chunks
        run(tiny.CONFIG, tmp_path, env=breaking(field, at=24 - ago))
    diagnosed = json.loads((tmp_path / "diagnosis.json").read_text())
    assert diagnosed["nonfinite_replay"][0]["field"] == field  # the action that followed, too
    assert not diagnosed["nonfinite_parameters"]
    mended = run(tiny.CONFIG, tmp_path, env=breaking(field, at=-1), resume=True)
    assert mended.env_steps == tiny.CONFIG.env_steps


def test_rewards_that_are_nan_in_replay_stop_the_run_and_are_named(tmp_path, monkeypatch):
    """However they came there: it is the loss that tells."""
    prepare, chunks = runner.prepare, []

    def poisoned(*arguments):
        program = prepare(*arguments)

        def compile_step(state):
            step = program.compile(state).run

            def call(state):
                chunks.append(len(chunks))
                if len(chunks) == 4:  # the first 8 steps of the second environment
                    reward = state.replay.trajectory.reward.at[1, :8].set(jnp.nan)
                    trajectory = state.replay.trajectory._replace(reward=reward)
                    state = state._replace(replay=state.replay._replace(trajectory=trajectory))
                return step(state)

            return CompiledStep(call, ())

        return program._replace(compile=compile_step)

    monkeypatch.setattr(runner, "prepare", poisoned)
    with pytest.raises(
        RunError, match=r"loss/.* is nan at .*; more in .*diagnosis.json"
    ) as error:
        run(tiny.CONFIG, tmp_path)
    assert "environment 1 returned reward that is not finite" in str(error.value)
    found = json.loads((tmp_path / "diagnosis.json").read_text())
    ago = 4 * len(chunks) - 1  # 4 calls in a chunk
    assert found["nonfinite_replay"] == [
        {"field": "reward", "environment": 1, "steps_ago": ago, "steps": 8}
    ]
    assert any(".critic" in name for name in found["nonfinite_parameters"])
    for path in checkpoint.complete(tmp_path):
        assert int(path.name) < found["env_steps"]


def test_a_run_that_was_killed_before_its_first_checkpoint_starts_again(tmp_path, fake):
    fake(lambda env_steps: math.nan if env_steps > 16 else 1.0)
    with pytest.raises(runner.RunError, match="no checkpoint yet"):
        run(tiny.CONFIG, tmp_path)
    with pytest.raises(InvalidInput, match="exists; continue that run with --resume"):
        run(tiny.CONFIG, tmp_path)
    fake()
    console = quiet()
    assert run(tiny.CONFIG, tmp_path, resume=True, console=console).env_steps == 96
    assert f"no checkpoint in {tmp_path} yet" in console.file.getvalue()
    assert [line["env_steps"] for line in lines(tmp_path)] == [16, 32, 48, 64, 80, 96]
    assert len(list(tmp_path.glob("events.out.tfevents.*"))) == 1


def test_the_banner_comes_only_once_the_folder_is_claimed(tmp_path, fake, monkeypatch):
    fake()
    console = quiet()
    run(tiny.CONFIG, tmp_path / "run", console=console, banner="who I am")
    assert console.file.getvalue().startswith("who I am\n")
    console = quiet()
    monkeypatch.setattr(runner.rundir, "check_new", lambda _: None)
    (tmp_path / "file").touch()
    with pytest.raises(InvalidInput, match="is not writable"):
        run(tiny.CONFIG, tmp_path / "file" / "run", console=console, banner="who I am")
    assert not console.file.getvalue()


@pytest.mark.parametrize(
    "error",
    [
        jax.errors.JaxRuntimeError("RESOURCE_EXHAUSTED: out of memory\nlong trace"),
        MemoryError("Unable to allocate 1.5 GiB"),
    ],
)
def test_running_out_of_memory_is_explained(tmp_path, fake, error):
    def exhausted(_):
        raise error

    fake(exhausted)
    with pytest.raises(
        RunError, match=r"memory.* smaller replay.capacity.*\((RES|Una)"
    ) as told:
        run(tiny.CONFIG, tmp_path)
    assert "\n" not in str(told.value)


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"env_steps": "8"}, "env_steps is '8'"),
        ({"seconds": None}, "seconds is None"),
        ({"interval": {"weighted": []}}, "weighted is \\[\\]"),
        ({"interval": {"more": 1}}, "more"),
        ({"interval": None}, "counters of a run"),
        ({"more": 1}, "more"),
    ],
)
def test_counters_of_another_kind_are_refused(changes, reason):
    saved = runner.Progress()._asdict() | {"interval": {}}
    assert runner._progress(saved) == runner.Progress()
    with pytest.raises(InvalidInput, match=reason):
        runner._progress(saved | changes)


def test_checkpoints_that_could_not_be_written_are_refused_before_training(
    tmp_path, fake, monkeypatch
):
    fake()
    run(tiny.CONFIG, tmp_path)
    folder = checkpoint.root(tmp_path)
    access = os.access
    monkeypatch.setattr(os, "access", lambda path, mode: path != folder and access(path, mode))
    with pytest.raises(InvalidInput, match=r"checkpoints': is not writable"):
        run(LONG, tmp_path, resume=True)


@pytest.mark.parametrize(
    "broken", ["tracking.Tracker.write", "rundir.write_config", "tracking.Tracker.__init__"]
)
def test_a_full_disk_is_explained_in_one_line(tmp_path, fake, monkeypatch, broken):
    def full(*_, **__):
        raise OSError(errno.ENOSPC, "No space left on device")

    fake()
    monkeypatch.setattr(f"vawm.{broken}", full)
    with pytest.raises(runner.RunError) as error:
        run(tiny.CONFIG, tmp_path)
    told = rf"{tmp_path}: No space left on device \([\d.]+ \w+ free\); "
    assert re.match(told, str(error.value))
    assert "\n" not in str(error.value)


def test_a_run_whose_checkpoints_are_gone_keeps_its_metrics(tmp_path, fake):
    fake()
    run(tiny.CONFIG, tmp_path)
    shutil.rmtree(tmp_path / "checkpoints")
    before = measured(tmp_path)
    with pytest.raises(InvalidInput, match="its checkpoints are gone"):
        run(LONG, tmp_path, resume=True)
    assert measured(tmp_path) == before


def test_a_signal_in_the_last_chunk_does_not_unfinish_a_run(tmp_path, fake):
    def loss(env_steps):
        if env_steps == 96:
            os.kill(os.getpid(), signal.SIGINT)
        return 1.0

    fake(loss)
    console = quiet()
    assert run(tiny.CONFIG, tmp_path, console=console).exit_code == 130
    text = console.file.getvalue()
    assert "finished at 96 env steps" in text
    assert "go on with: vawm.runs.runner.run(config" in text
    assert "resume with" not in text


@pytest.mark.parametrize(
    "changes", [{"env": None}, {"resume": True}, {"config": tiny.config(num_envs=0)}]
)
def test_bad_input_is_refused_with_nothing_written(tmp_path, changes):
    with pytest.raises(InvalidInput):
        run(**{"config": tiny.CONFIG, "logdir": tmp_path / "run"} | changes)
    assert not list(tmp_path.iterdir())


def test_environments_on_the_host_are_closed_where_a_run_is_refused(tmp_path):
    class Host:
        closed = 0

        def close(self):
            self.closed += 1

    env = Host()
    with pytest.raises(InvalidInput, match="num_envs=0"):
        runner.run(tiny.config(num_envs=0), tmp_path / "run", env=env)
    assert env.closed == 1


def test_environments_that_cannot_be_started_are_one_line(tmp_path, monkeypatch):
    def no_room(*_):
        raise OSError(errno.EMFILE, "Too many open files")

    monkeypatch.setattr(runner, "prepare", no_room)
    with pytest.raises(RunError, match="Too many open files; put that right"):
        run(tiny.CONFIG, tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_a_run_that_does_not_fit_is_refused_with_nothing_written(tmp_path, monkeypatch):
    monkeypatch.setattr(budget, "available", lambda: {"device": 1000})
    with pytest.raises(InvalidInput, match=r"replay.capacity=64: needs .* are free"):
        run(tiny.CONFIG, tmp_path / "run")
    assert not list(tmp_path.iterdir())


def test_every_task_can_be_named(tmp_path):
    for task in envs.TASKS:
        runner.check(tiny.config(task=task), tmp_path / "run", resume=False)


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory):
    """A folder with a whole run of `tiny.CONFIG`, twice as long."""
    logdir = tmp_path_factory.mktemp("uninterrupted")
    run(LONG, logdir)
    return logdir


def test_a_line_reports_what_was_promised(uninterrupted):
    last = lines(uninterrupted)[-1]
    names = ["env_steps", "updates", "time", "env_steps_per_s", "updates_per_s", "latent/kl"]
    names += ["episode/return", "episode/length", "episode/count", "env/nonfinite"]
    names += ["value_alignment/weight", "value_alignment/loss", "loss/total"]
    assert all(math.isfinite(last[name]) for name in names)
    assert last["episode/length"] == 4


@pytest.mark.parametrize("env_steps", [96, 104])
def test_k_steps_and_the_rest_equal_a_run_in_one_piece(tmp_path, uninterrupted, env_steps):
    """104 is not a multiple of `log_every`: its last line is written and dropped again."""
    run(tiny.config(env_steps=env_steps), tmp_path)
    run(LONG, tmp_path, resume=True)
    assert_same(tmp_path, uninterrupted, LONG, tiny.env())
    assert starts(tmp_path) == [97]


def test_a_run_whose_newest_checkpoint_is_damaged_goes_on_from_the_one_before(
    tmp_path, uninterrupted
):
    logdir = shutil.copytree(uninterrupted, tmp_path / "run")
    damaged = files_of(checkpoint.latest(logdir) / "state")[-1]
    damaged.write_bytes(damaged.read_bytes()[:-1])
    console = quiet()
    run(LONG, logdir, resume=True, console=console)
    [line] = [line for line in console.file.getvalue().splitlines() if "WARNING" in line]
    assert str(damaged) in line
    assert line.endswith("using the one at 160 env steps instead")
    assert "going on at 160 env steps" in console.file.getvalue().splitlines()
    assert (checkpoint.root(logdir) / "damaged-000000000192").is_dir()
    assert saves(logdir) == saves(uninterrupted)
    assert_same(logdir, uninterrupted, LONG, tiny.env())


def test_another_jax_is_told_because_bits_may_differ(tmp_path, monkeypatch):
    run(tiny.CONFIG, tmp_path)
    monkeypatch.setattr(manifest, "computed", lambda: "jax 99 on gpu")
    console = quiet()
    run(tiny.config(env_steps=104), tmp_path, resume=True, console=console)
    now = f"jax {jax.__version__} on cpu"
    assert f"WARNING: begun with {now}, goes on with jax 99 on gpu: " in console.file.getvalue()


def starts(logdir):
    """From where on TensorBoard drops what an earlier part of the run wrote."""
    sessions = [event for event in events(logdir) if event.HasField("session_log")]
    assert all(event.session_log.status == SessionLog.START for event in sessions)
    return [event.step for event in sessions]


def test_tensorboard_drops_a_last_line_that_is_the_only_one(tmp_path):
    run(tiny.config(log_every=1000), tmp_path)
    assert not starts(tmp_path)
    run(tiny.config(log_every=1000, env_steps=112), tmp_path, resume=True)
    assert starts(tmp_path) == [1]
    assert len(lines(tmp_path)) == 1


def test_metrics_that_cannot_be_cut_back_are_explained_and_kept(
    tmp_path, uninterrupted, monkeypatch
):
    def full(path, _):
        raise OSError(errno.ENOSPC, "No space left on device", str(path))

    logdir = shutil.copytree(uninterrupted, tmp_path / "run")
    before = measured(logdir)
    monkeypatch.setattr(runner.tracking.pathlib.Path, "write_text", full)
    with pytest.raises(runner.RunError, match=r"metrics.jsonl.tmp: No space left on device"):
        run(tiny.config(env_steps=200), logdir, resume=True)
    assert measured(logdir) == before


def test_a_run_that_a_signal_stopped_goes_on_as_if_nothing_had_happened(
    tmp_path, uninterrupted
):
    console = rich.console.Console(file=SignalAt("env_steps 84/"), width=200)
    result = run(LONG, tmp_path, console=console)
    assert result.exit_code == 130
    assert 84 <= result.env_steps < 192
    assert "resume with: vawm.runs.runner.run(config" in console.file.getvalue()
    with (tmp_path / "metrics.jsonl").open("a") as file:
        file.write('{"env_steps": 10000}\n{"half a line')
    run(LONG, tmp_path, resume=True)
    assert_same(tmp_path, uninterrupted, LONG, tiny.env())
