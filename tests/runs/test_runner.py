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
import numpy as np
import pytest
import rich.console
import tiny
import toy
from gymnasium.envs.classic_control import CartPoleEnv
from gymnasium.wrappers import TimeLimit
from refusals import refused
from runs import assert_same, events, files_of, lines, measured, quiet
from tensorboardX.proto.event_pb2 import SessionLog

from vawm import envs
from vawm.agent import Agent
from vawm.errors import InvalidInput
from vawm.learning import replay
from vawm.runs import budget, checkpoint, diagnosis, runner
from vawm.runs.checkpoint import manifest
from vawm.runs.reports import backends, film, tracking, video
from vawm.runs.runner import RunError
from vawm.runs.trainer import CompiledStep, Trainer
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
    """A time step that waits to be stored; replaces a `Collector`."""

    timestep: TimeStep


def arrived(reward=(0.0, 0.0)):
    """The time steps of two environments, with these rewards."""
    flag = jnp.zeros(2, bool)
    return Waiting(TimeStep(jnp.zeros((2, 1)), jnp.array(reward), flag, flag, flag))


def stored(reward=()):
    """Replay of two environments, 4 steps each, whose last rewards are `reward`, `[N, K]`."""
    zeros = jnp.zeros(2)
    example = Trajectory(zeros[:, None], zeros, zeros > 0, zeros > 0, zeros > 0, zeros[:, None])
    buffer = replay.init(example, (), capacity=4)
    steps = jax.tree.map(lambda x: jnp.stack([x] * 4, 1), example)
    buffer = replay.add(buffer, steps, ())  # full, so the next steps overwrite the oldest
    reward = jnp.asarray(reward or jnp.zeros((2, 0)), jnp.float32)
    steps = jax.tree.map(lambda x: x[:, : reward.shape[1]], steps)
    return replay.add(buffer, steps._replace(reward=reward), ())


@pytest.fixture
def fake(monkeypatch):
    """Replaces training by a `FakeStep` with the given losses."""

    def install(loss=lambda env_steps: env_steps, notices=()):
        trainer = Trainer(
            spec=toy.SPEC,
            agent=None,
            shapes=None,
            init=lambda seed: toy.state()._replace(replay=stored(), collector=arrived()),
            compile=lambda state: CompiledStep(FakeStep(loss), ()),
            episodes=lambda: None,
            resume=lambda state, _: (state, 0),
            close=lambda: None,
            notices=notices,
        )
        monkeypatch.setattr(runner, "prepare", lambda *_: trainer)

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
    assert result.stopped_by is None
    assert json.loads((tmp_path / "config.json").read_text())["config"]["env_steps"] == 96
    assert checkpoint.latest(tmp_path).name == "000000000096"
    # The advice for an environment that is not registered.
    assert f"vawm.evaluate.evaluate(vawm.load({str(tmp_path)!r})" in console.file.getvalue()
    resumption = f"vawm.runs.runner.run(config, {str(tmp_path)!r}, env=..., resume=True)"
    assert resumption in console.file.getvalue()


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
    warnings = [text for text in console.file.getvalue().splitlines() if "warning" in text]
    assert len(warnings) == 1
    assert "wandb" in warnings[0]
    assert measured(tmp_path / "with") == measured(tmp_path / "without")
    assert checkpoint.latest(tmp_path / "with").name == "000000000096"


def saves(logdir):
    return [line["env_steps"] for line in tracking.read(logdir / tracking.SAVE_LINES)]


def test_each_checkpoint_has_a_line(tmp_path, fake):
    fake()
    run(tiny.CONFIG, tmp_path)
    names = {"checkpoint/bytes", "checkpoint/seconds", "checkpoint/blocked_seconds"}
    assert saves(tmp_path) == [32, 64, 96]
    for line in tracking.read(tmp_path / tracking.SAVE_LINES):
        assert line.keys() == names | {"env_steps"}
    assert not any("checkpoint/bytes" in line for line in lines(tmp_path))


def test_checkpoints_by_time_do_not_change_the_metrics(tmp_path, fake):
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
    """As when every environment is reset. A decrease is an error."""
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
    with pytest.raises(RunError, match=r"env_steps.* 16 .* 8"):
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


def test_starting_over_moves_the_old_files_to_a_subfolder(tmp_path, fake):
    fake()
    run(tiny.CONFIG, tmp_path / "run", fresh=True)
    for number in (1, 2):
        before = measured(tmp_path / "run")
        console = quiet()
        config = tiny.config(seed=number, env_steps=48 + 8 * number)
        run(config, tmp_path / "run", fresh=True, console=console)
        aside = tmp_path / "run" / f"replaced-{number}"
        assert str(aside) in console.file.getvalue()
        assert measured(aside) == before
        assert checkpoint.find(aside).manifest.config.seed == number - 1
        assert checkpoint.find(tmp_path / "run").manifest.config.seed == number
    with refused("fresh", True, naming="--resume"):
        run(tiny.CONFIG, tmp_path / "run", fresh=True, resume=True)


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_loss_that_is_not_finite_stops_the_run_and_keeps_the_checkpoint(
    tmp_path, fake, value
):
    fake(lambda env_steps: value if env_steps > 40 else 1.0)
    with pytest.raises(runner.RunError, match=r"loss/critic .*env_steps=48.* at 32"):
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
        "largest_reward": {"environment": 0, "reward": 0.0},
    }


def test_a_parameter_broken_by_the_last_update_stops_the_run_too(tmp_path, fake, monkeypatch):
    """The loss of that update is finite, and there is no later one."""
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
    told = r"\.actor\['bias'\].*env_steps=96.* at 64.*diagnosis.json"
    with pytest.raises(RunError, match=told):
        run(tiny.CONFIG, tmp_path)
    found = json.loads((tmp_path / "diagnosis.json").read_text())
    assert found["nonfinite_parameters"] == [".actor['bias']"]
    assert (found["loss"], found["value"]) == (None, None)
    assert lines(tmp_path)[-1]["env_steps"] == 96


def test_a_loss_that_is_not_finite_is_reported_even_if_a_save_failed(
    tmp_path, fake, monkeypatch
):
    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    def loss(env_steps):
        if env_steps < 40:
            return 1.0
        time.sleep(0.3)  # until the save at 32 has failed
        return math.nan

    fake(loss)
    monkeypatch.setattr(manifest, "write", full)
    with pytest.raises(RunError, match=r"loss/critic is nan .*env_steps=40.*no checkpoint"):
        run(tiny.CONFIG, tmp_path)
    assert (tmp_path / "diagnosis.json").exists()


def test_replayed_steps_that_are_not_finite_are_named_by_environment_and_step():
    nan, inf = math.nan, math.inf
    replay_of_both = stored([[1.0, nan, 2.0], [-inf, 0.0, nan]])
    state = toy.state()._replace(replay=replay_of_both, collector=arrived())
    assert diagnosis.nonfinite_steps(state) == [
        {"field": "reward", "environment": 1, "steps_ago": 2, "steps": 3}
    ]
    assert not diagnosis.nonfinite_steps(state._replace(replay=stored([[1e30], [-1e30]])))


def test_a_step_that_is_not_stored_yet_comes_after_those_in_replay():
    state = toy.state()._replace(replay=stored([[1.0], [math.nan]]), collector=arrived())
    before = {"field": "reward", "environment": 1, "steps_ago": 0, "steps": 1}
    assert diagnosis.nonfinite_steps(state) == [before]
    state = state._replace(collector=arrived([math.inf, 0.0]))
    now = {"field": "reward", "environment": 0, "steps_ago": -1, "steps": 1}
    assert diagnosis.nonfinite_steps(state) == [before, now]


def test_an_environment_is_not_blamed_if_an_earlier_action_was_not_finite():
    nan = math.nan
    replay_of_both = stored([[1.0, 1.0], [1.0, nan]])
    blamed = toy.state()._replace(replay=replay_of_both, collector=arrived())
    assert blames_environment(diagnosis.advice(blamed, tiny.CONFIG))
    actions = blamed.replay.trajectory.action
    same, before = (actions.at[1, slot].set(nan) for slot in newest(blamed.replay, 0, 1))
    for action, environment in ((same, True), (before, False)):
        trajectory = blamed.replay.trajectory._replace(action=action)
        state = blamed._replace(replay=blamed.replay._replace(trajectory=trajectory))
        assert blames_environment(diagnosis.advice(state, tiny.CONFIG)) == environment
        reason = diagnosis.reason(state, {"chunk/nonfinite": 1}, last=False)
        assert ("an environment" in reason) == environment
        assert ("action" in reason) != environment
    whole = toy.state()._replace(replay=stored(), collector=arrived())
    reason = diagnosis.reason(whole, {"chunk/nonfinite": 1}, last=False)
    assert "an environment" in reason  # the step has been overwritten


def blames_environment(advice):
    """Whether advice names the reward of environment 1, and not the learning rate."""
    named = "reward" in advice and "environment 1" in advice
    assert named != ("--optimizer.learning-rate" in advice)
    return named


@pytest.mark.parametrize("reward", [3e38, -3e38])
def test_rewards_beyond_the_returns_of_float32_are_named_and_not_the_learning_rate(
    tmp_path, reward
):
    """They are finite, and so is their symlog, but not their sum."""
    plain = tiny.env()

    def step(state, action):
        state, timestep = plain.step(state, action)
        return state, timestep._replace(reward=jnp.full_like(timestep.reward, reward))

    with pytest.raises(RunError, match=r"loss/.* is nan ") as error:
        run(tiny.CONFIG, tmp_path, env=plain._replace(step=step))
    for name in ("environment", f"{reward:.3g}", "float32"):
        assert name in str(error.value)
    assert "learning-rate" not in str(error.value)
    diagnosed = json.loads((tmp_path / "diagnosis.json").read_text())
    assert diagnosed["largest_reward"]["reward"] == pytest.approx(reward)


def test_rewards_that_returns_can_hold_are_not_blamed():
    for reward, blamed in ((1e35, False), (1.1e36, True), (-1.1e36, True)):
        state = toy.state()._replace(replay=stored([[1.0], [reward]]), collector=arrived())
        assert blames_environment(diagnosis.advice(state, tiny.CONFIG)) == blamed


def newest(buffer, *ago):
    """The slots of these steps, counted back from the newest."""
    return [(int(buffer.head) - 1 - a) % buffer.trajectory.reward.shape[1] for a in ago]


@pytest.mark.parametrize("field", ["reward", "obs"])
def test_a_first_observation_that_is_not_finite_stops_the_run(tmp_path, field):
    plain = tiny.env()

    def reset(key):
        state, timestep = plain.reset(key)
        value = getattr(timestep, field).at[1].set(jnp.nan)
        return state, timestep._replace(**{field: value})

    with pytest.raises(RunError, match=f"{field}.*environment 1.*first reset"):
        run(tiny.CONFIG, tmp_path, env=plain._replace(reset=reset))
    assert checkpoint.latest(tmp_path) is None


def test_a_nan_action_stops_the_run_even_if_the_environment_accepts_it(tmp_path, monkeypatch):
    """The message blames the policy."""
    act = Agent.act

    def wild(*args, **kwargs):
        carry, action = act(*args, **kwargs)
        action = action.at[1].set(jnp.nan)
        return carry._replace(action=action), action

    monkeypatch.setattr(Agent, "act", wild)
    plain = tiny.env()
    tolerant = plain._replace(step=lambda state, a: plain.step(state, jnp.nan_to_num(a)))
    with pytest.raises(RunError, match=r"action .*--optimizer\.learning-rate"):
        run(tiny.CONFIG, tmp_path, env=tolerant)
    assert checkpoint.latest(tmp_path) is None


class Counted(NamedTuple):
    """The state of an environment, and the number of calls of `step`."""

    inner: Any
    steps: jax.Array
    key: jax.Array
    calls: jax.Array


def breaking(field, at):
    """The environments of `tiny`; the second one returns one NaN, at call `at`."""
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
    """In a user's environment on the device. After a fix, the run can be resumed."""
    told = (
        rf"environment.*env_steps=40.* at 32.*diagnosis\.json.*{field}.*environment 1.*"
        rf"{ago} steps before.*--resume"
    )
    with pytest.raises(RunError, match=told):  # after the 24 calls of six chunks
        run(tiny.CONFIG, tmp_path, env=breaking(field, at=24 - ago))
    diagnosed = json.loads((tmp_path / "diagnosis.json").read_text())
    assert diagnosed["nonfinite_replay"][0]["field"] == field  # before the action that follows
    assert not diagnosed["nonfinite_parameters"]
    fixed = run(tiny.CONFIG, tmp_path, env=breaking(field, at=-1), resume=True)
    assert fixed.env_steps == tiny.CONFIG.env_steps


def test_rewards_that_are_nan_in_replay_stop_the_run_and_are_named(tmp_path, monkeypatch):
    """However they got there: the loss shows it."""
    prepare, chunks = runner.prepare, []

    def poisoned(*arguments):
        trainer = prepare(*arguments)

        def compile_step(state):
            step = trainer.compile(state).run

            def call(state):
                chunks.append(len(chunks))
                if len(chunks) == 4:  # the first 8 steps of the second environment
                    reward = state.replay.trajectory.reward.at[1, :8].set(jnp.nan)
                    trajectory = state.replay.trajectory._replace(reward=reward)
                    state = state._replace(replay=state.replay._replace(trajectory=trajectory))
                return step(state)

            return CompiledStep(call, ())

        return trainer._replace(compile=compile_step)

    monkeypatch.setattr(runner, "prepare", poisoned)
    with pytest.raises(RunError, match=r"loss/.* is nan .*diagnosis.json") as error:
        run(tiny.CONFIG, tmp_path)
    assert re.search("reward .*environment 1", str(error.value))
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
    with pytest.raises(runner.RunError, match="no checkpoint"):
        run(tiny.CONFIG, tmp_path)
    with refused("logdir", str(tmp_path), naming="--resume"):
        run(tiny.CONFIG, tmp_path)
    fake()
    console = quiet()
    assert run(tiny.CONFIG, tmp_path, resume=True, console=console).env_steps == 96
    assert f"no checkpoint in {tmp_path}" in console.file.getvalue()
    assert [line["env_steps"] for line in lines(tmp_path)] == [16, 32, 48, 64, 80, 96]
    assert len(list(tmp_path.glob("events.out.tfevents.*"))) == 1


def test_the_banner_is_printed_after_the_folder_is_locked(tmp_path, fake, monkeypatch):
    fake()
    console = quiet()
    run(tiny.CONFIG, tmp_path / "run", console=console, banner="who I am")
    first = f"logdir: {tmp_path / 'run'}\n"
    assert console.file.getvalue().startswith(f"{first}who I am\n")
    console = quiet()
    monkeypatch.setattr(runner.run_folder, "check_new", lambda _: None)
    (tmp_path / "file").touch()
    with refused("logdir", str(tmp_path / "file" / "run")):
        run(tiny.CONFIG, tmp_path / "file" / "run", console=console, banner="who I am")
    assert not console.file.getvalue()


def test_a_run_without_a_banner_says_where_and_what_it_is(tmp_path, fake):
    fake()
    console = rich.console.Console(file=io.StringIO(), width=200)
    run(tiny.CONFIG, tmp_path, console=console)
    first, second, third, *_ = console.file.getvalue().splitlines()
    assert first == f"logdir: {tmp_path}"
    for told in ("dreamerv3", "preset custom", toy.SPEC.task, "96 env steps", "size custom"):
        assert told in second
    assert "after 24 env steps" in third


@pytest.mark.parametrize("why", ["", "no renderer here"])
def test_a_finished_run_films_its_policy_or_says_why_not(tmp_path, fake, monkeypatch, why):
    def of_run(config, agent, learner):
        if why:
            raise InvalidInput("renderer", "auto", why)
        return video.Video("policy", np.zeros((2, 16, 16, 3), np.uint8), {"return": 3.0})

    fake()
    monkeypatch.setattr(film, "of_run", of_run)
    console = quiet()
    run(tiny.CONFIG, tmp_path, console=console, film_policy=True)
    shown = [entry["video"] for entry in tracking.read(tmp_path / "videos.jsonl")]
    assert shown == ([] if why else ["policy-000000000096.gif"])
    tags = {value.tag for event in events(tmp_path) for value in event.summary.value}
    assert ("video/policy" in tags) == (not why)
    assert ("no film of the policy: " in console.file.getvalue()) == bool(why)
    assert why in console.file.getvalue()
    assert "finished at 96 env steps" in console.file.getvalue()


@pytest.mark.parametrize("display", ["plain", "quiet"])
def test_a_run_can_be_quiet(tmp_path, fake, capsys, display):
    fake()
    run(tiny.CONFIG, tmp_path, console=None, display=display)
    assert bool(capsys.readouterr().out) == (display == "plain")
    assert len(lines(tmp_path)) == 6


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
    with pytest.raises(RunError, match=r"memory.*replay\.capacity.*(RES|Una)") as told:
        run(tiny.CONFIG, tmp_path)
    assert "\n" not in str(told.value)


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"env_steps": "8"}, "env_steps is '8'"),
        ({"seconds": None}, "seconds is None"),
        ({"interval": {"weighted": []}}, "weighted is []"),
        ({"interval": {"more": 1}}, "more"),
        ({"interval": None}, ()),
        ({"more": 1}, "more"),
    ],
)
def test_counters_of_another_type_are_refused(changes, named):
    saved = runner.Progress()._asdict() | {"interval": {}}
    assert runner._progress(saved) == runner.Progress()
    with refused("checkpoint", "progress", naming=named):
        runner._progress(saved | changes)


def test_a_checkpoint_folder_that_is_not_writable_is_refused_before_training(
    tmp_path, fake, monkeypatch
):
    fake()
    run(tiny.CONFIG, tmp_path)
    folder = checkpoint.root(tmp_path)
    access = os.access
    monkeypatch.setattr(os, "access", lambda path, mode: path != folder and access(path, mode))
    with refused("logdir", str(folder)):
        run(LONG, tmp_path, resume=True)


@pytest.mark.parametrize(
    "broken",
    [
        "reports.tracking.Tracker.write",
        "run_folder.write_config",
        "reports.tracking.Tracker.__init__",
    ],
)
def test_a_full_disk_is_explained_in_one_line(tmp_path, fake, monkeypatch, broken):
    def full(*_, **__):
        raise OSError(errno.ENOSPC, "No space left on device")

    fake()
    monkeypatch.setattr(f"vawm.runs.{broken}", full)
    with pytest.raises(runner.RunError) as error:
        run(tiny.CONFIG, tmp_path)
    assert re.search(rf"{tmp_path}.*No space left.*[\d.]+ \w+ free", str(error.value))
    assert "\n" not in str(error.value)


def test_a_run_whose_checkpoints_are_missing_keeps_its_metrics(tmp_path, fake):
    fake()
    run(tiny.CONFIG, tmp_path)
    shutil.rmtree(tmp_path / "checkpoints")
    before = measured(tmp_path)
    with refused("logdir", str(tmp_path)):
        run(LONG, tmp_path, resume=True)
    assert measured(tmp_path) == before


def test_a_run_with_a_signal_in_its_last_chunk_is_finished(tmp_path, fake):
    def loss(env_steps):
        if env_steps == 96:
            os.kill(os.getpid(), signal.SIGINT)
        return 1.0

    fake(loss)
    console = quiet()
    result = run(tiny.CONFIG, tmp_path, console=console)
    assert (result.exit_code, result.stopped_by) == (130, signal.SIGINT)
    text = console.file.getvalue()
    assert "finished at 96 env steps" in text
    assert "vawm.runs.runner.run(config" in text
    assert "resume with" not in text


@pytest.mark.parametrize(
    "changes", [{"env": None}, {"resume": True}, {"config": tiny.config(num_envs=0)}]
)
def test_bad_input_is_refused_with_nothing_written(tmp_path, changes):
    with pytest.raises(InvalidInput):
        run(**{"config": tiny.CONFIG, "logdir": tmp_path / "run"} | changes)
    assert not list(tmp_path.iterdir())


def test_environments_on_the_host_are_closed_if_a_run_is_refused(tmp_path):
    class Host:
        closed = 0
        spec = reset = send = receive = None

        def close(self):
            self.closed += 1

    env = Host()
    with refused("num_envs", 0):
        runner.run(tiny.config(num_envs=0), tmp_path / "run", env=env)
    assert env.closed == 1


@pytest.mark.parametrize(
    ("env", "naming"),
    [
        (TimeLimit(CartPoleEnv(), 9), "from_gymnasium(lambda: CartPoleEnv(...)"),
        (CartPoleEnv, "from_gymnasium(CartPoleEnv"),
        ("CartPole-v1", "from_gymnasium('CartPole-v1'"),
        (7, "from_gymnasium"),
    ],
)
def test_what_is_no_environment_is_the_mistake(tmp_path, env, naming):
    with refused("env", env, naming=naming):
        runner.run(tiny.CONFIG, tmp_path / "run", env=env)
    assert not (tmp_path / "run").exists()


def test_what_to_know_of_the_environments_is_said_at_the_start(tmp_path, fake):
    fake(notices=("the text is left out",))
    console = quiet()
    run(tiny.config(env_steps=56), tmp_path, console=console)
    assert "note: the text is left out\n" in console.file.getvalue()


def test_environments_that_cannot_be_started_are_one_line(tmp_path, monkeypatch):
    def no_room(*_):
        raise OSError(errno.EMFILE, "Too many open files")

    monkeypatch.setattr(runner, "prepare", no_room)
    with pytest.raises(RunError, match="Too many open files"):
        run(tiny.CONFIG, tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_a_run_that_does_not_fit_is_refused_with_nothing_written(tmp_path, monkeypatch):
    monkeypatch.setattr(budget, "available", lambda: {"device": 1000})
    with refused("replay.capacity", 64):
        run(tiny.CONFIG, tmp_path / "run")
    assert not list(tmp_path.iterdir())


def test_every_task_is_accepted(tmp_path):
    for task in envs.TASKS:
        runner.check(tiny.config(task=task), tmp_path / "run", resume=False)


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory):
    """The folder of a complete run of `tiny.CONFIG`, twice as long."""
    logdir = tmp_path_factory.mktemp("uninterrupted")
    run(LONG, logdir)
    return logdir


def test_a_line_has_all_documented_metrics(uninterrupted):
    last = lines(uninterrupted)[-1]
    names = ["env_steps", "updates", "time", "env_steps_per_s", "updates_per_s", "latent/kl"]
    names += ["episode/return", "episode/length", "episode/count", "env/nonfinite"]
    names += ["value_alignment/weight", "value_alignment/loss", "loss/total"]
    assert all(math.isfinite(last[name]) for name in names)
    assert last["episode/length"] == 4


@pytest.mark.parametrize("env_steps", [96, 104])
def test_a_resumed_run_equals_an_uninterrupted_one(tmp_path, uninterrupted, env_steps):
    """104 is not a multiple of `log_every`: the last line is written, then dropped."""
    run(tiny.config(env_steps=env_steps), tmp_path)
    run(LONG, tmp_path, resume=True)
    assert_same(tmp_path, uninterrupted, LONG, tiny.env())
    assert starts(tmp_path) == [97]


def test_a_run_whose_newest_checkpoint_is_damaged_resumes_from_the_one_before(
    tmp_path, uninterrupted
):
    logdir = shutil.copytree(uninterrupted, tmp_path / "run")
    damaged = files_of(checkpoint.latest(logdir) / "state")[-1]
    damaged.write_bytes(damaged.read_bytes()[:-1])
    console = quiet()
    run(LONG, logdir, resume=True, console=console)
    [line] = [line for line in console.file.getvalue().splitlines() if "WARNING" in line]
    assert str(damaged) in line
    assert "160 env steps" in line
    assert "resuming at 160 env steps" in console.file.getvalue().splitlines()
    assert (checkpoint.root(logdir) / "damaged-000000000192").is_dir()
    assert saves(logdir) == saves(uninterrupted)
    assert_same(logdir, uninterrupted, LONG, tiny.env())


def test_a_resumed_run_shows_the_last_return_before(tmp_path, uninterrupted):
    logdir = shutil.copytree(uninterrupted, tmp_path / "run")
    told = [x for line in lines(logdir) if (x := line["episode/return"]) is not None]
    console = quiet()
    run(tiny.config(env_steps=200), logdir, resume=True, console=console)
    assert f"last episode return {told[-1]:.1f}\n" in console.file.getvalue()


def test_resuming_with_another_jax_causes_a_warning(tmp_path, monkeypatch):
    run(tiny.CONFIG, tmp_path)
    monkeypatch.setattr(manifest, "computed", lambda: "jax 99 on gpu")
    console = quiet()
    run(tiny.config(env_steps=104), tmp_path, resume=True, console=console)
    [line] = [line for line in console.file.getvalue().splitlines() if "WARNING" in line]
    assert f"jax {jax.__version__} on cpu" in line
    assert "jax 99 on gpu" in line


def starts(logdir):
    """The steps from which TensorBoard drops what an earlier part of the run wrote."""
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
    with pytest.raises(runner.RunError, match=r"metrics.jsonl.tmp.*No space left on device"):
        run(tiny.config(env_steps=200), logdir, resume=True)
    assert measured(logdir) == before


def test_a_run_stopped_by_a_signal_and_resumed_equals_an_uninterrupted_one(
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
