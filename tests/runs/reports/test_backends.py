"""Backends besides TensorBoard: they get every line once and cannot harm a run."""

import importlib.util
import json
import os
import pathlib
import sqlite3
import subprocess
import sys
import threading
import time
import types

import numpy as np
import pytest
import tiny
import toy
from refusals import refused
from runs import events, save_toy

from vawm.runs import runner, validate
from vawm.runs.reports import backends, tracking
from vawm.runs.reports.backends import Feed
from vawm.runs.reports.tracking import Tracker
from vawm.runs.reports.video import Video

CONFIG = tiny.config(tracker="wandb")
LINE = {"env_steps": 8, "loss/total": 0.5, "episode/return": None}


def line(env_steps, loss=0.5):
    return LINE | {"env_steps": env_steps, "loss/total": loss}


class Remote:
    """A backend that records its calls; calls `fail(lines so far)` before every line."""

    def __init__(self, fail=lambda count: None):
        self.steps, self.videos, self.closed, self._fail = [], [], False, fail

    def write(self, entry):
        self._fail(len(self.steps))
        self.steps.append(entry["env_steps"])

    def write_video(self, name, gif, env_steps):
        self.videos.append((name, gif.name, env_steps))

    def close(self):
        self.closed = True


def raising(count):
    if count == 2:
        raise ConnectionError("no route to host\nand much more")


def unreachable():
    raise ConnectionError("unreachable")


@pytest.fixture
def stuck():
    """A function that hangs until the test is over."""
    event = threading.Event()
    yield lambda *_: event.wait()
    event.set()


def use(monkeypatch, open_backend):
    monkeypatch.setitem(backends.OPENERS, "wandb", open_backend)


def part(logdir, *steps, resumed=False, config=CONFIG, videos=()):
    """Writes lines, and videos, at these steps, as one part of a run; returns warnings."""
    said = []
    further = backends.connect(config, logdir, resumed=resumed, say=said.append)
    with Tracker(logdir, further=further, say=said.append) as tracker:
        for env_steps in steps:
            tracker.write(line(env_steps))
            if env_steps in videos:
                film = Video("episode", np.zeros((2, 16, 16, 3), np.uint8), {})
                tracker.write_videos([film], env_steps=env_steps)
    return said


def test_a_backend_gets_every_line_and_video_in_order(tmp_path, monkeypatch):
    remote = Remote()
    use(monkeypatch, lambda *_: remote)
    assert not part(tmp_path, 8, 16, 24, videos=[16])
    assert (remote.steps, remote.closed) == ([8, 16, 24], True)
    assert remote.videos == [("video/episode", "episode-000000000016.gif", 16)]


def test_without_a_tracker_there_is_no_thread_and_no_file(tmp_path):
    threads = threading.active_count()
    assert not backends.connect(tiny.CONFIG, tmp_path, resumed=False, say=print)
    assert threading.active_count() == threads
    assert not list(tmp_path.iterdir())


def assert_complete(logdir, steps):
    """Checks that `metrics.jsonl` and TensorBoard have all steps."""
    kept = tracking.read(logdir / "metrics.jsonl")
    assert [entry["env_steps"] for entry in kept] == steps
    assert [event.step for event in events(logdir) if event.HasField("summary")] == steps


@pytest.mark.parametrize(
    ("remote", "reason"),
    [(unreachable, "(unreachable)"), (lambda: Remote(raising), "(no route to host)")],
)
def test_a_backend_that_fails_causes_one_warning_and_the_run_continues(
    tmp_path, monkeypatch, remote, reason
):
    use(monkeypatch, lambda *_: remote())
    steps = list(range(8, 88, 8))
    assert_one_warning(part(tmp_path, *steps), "wandb", reason)
    assert_complete(tmp_path, steps)


def assert_one_warning(said, name, reason):
    """One warning that a run stopped reporting to `name`."""
    [warning] = said
    assert warning.startswith("warning: ")
    assert name in warning
    assert reason in warning
    assert "metrics.jsonl" in warning
    assert "\n" not in warning


def test_a_backend_that_hangs_delays_the_end_for_a_limited_time(stuck):
    said = []
    feed = Feed("wandb", lambda: Remote(stuck), said.append, patience=lambda: 0.2)
    began = time.monotonic()
    for env_steps in range(10):
        feed.write(line(env_steps))
    assert time.monotonic() - began < 0.1
    assert not said
    feed.close()
    assert 0.2 <= time.monotonic() - began < 5
    feed.close()
    assert_one_warning(said, "wandb", "0 s")


@pytest.mark.parametrize("when", ["opening", "writing"])
def test_a_backend_that_is_too_slow_is_dropped_without_waiting(stuck, when):
    said = []
    opened = stuck if when == "opening" else lambda: Remote(stuck)
    feed = Feed("wandb", opened, said.append, capacity=3)
    began = time.monotonic()
    for env_steps in range(20):
        feed.write(line(env_steps))
    feed.close()
    assert time.monotonic() - began < 5
    assert_one_warning(said, "wandb", "3 lines")


@pytest.mark.parametrize("name", ["wandb", "trackio"])
def test_a_missing_package_is_refused_with_the_command_that_installs_it(
    tmp_path, monkeypatch, name
):
    monkeypatch.setattr(importlib.util, "find_spec", lambda _: None)
    with refused("tracker", name, naming=f"pip install 'vawm[{name}]'"):
        runner.check(
            tiny.config(tracker=name), tmp_path / "run", resume=False, known_task=False
        )
    assert not list(tmp_path.iterdir())


def test_a_resumed_run_continues_without_a_package_that_was_removed(tmp_path, monkeypatch):
    save_toy(tmp_path, toy.state(), config=CONFIG)
    monkeypatch.setattr(importlib.util, "find_spec", lambda _: None)
    runner.check(CONFIG, tmp_path, resume=True, known_task=False)
    monkeypatch.setitem(sys.modules, "wandb", None)  # its import fails
    assert_one_warning(part(tmp_path, 8, 16, resumed=True), "wandb", "import of wandb halted")
    assert_complete(tmp_path, [8, 16])


def test_a_run_stopped_by_a_signal_waits_less(tmp_path, monkeypatch, stuck):
    monkeypatch.setattr(backends, "HURRIED_PATIENCE", 0.3)
    use(monkeypatch, lambda *_: Remote(stuck))
    said, asked = [], threading.Event()
    (feed,) = backends.connect(
        CONFIG, tmp_path, resumed=False, say=said.append, hurried=asked.is_set
    )
    feed.write(line(8))
    threading.Timer(0.2, asked.set).start()  # while `close` is waiting
    began = time.monotonic()
    feed.close()
    assert 0.2 < time.monotonic() - began < 5
    assert_one_warning(said, "wandb", " s after")


def test_a_folder_with_the_name_of_a_package_does_not_count_as_one(tmp_path, monkeypatch):
    (tmp_path / "wandb").mkdir()
    monkeypatch.setattr(sys, "path", [str(tmp_path)])
    monkeypatch.delitem(sys.modules, "wandb", raising=False)
    with refused("tracker", "wandb", naming="pip install"):
        backends.check(CONFIG)


@pytest.mark.parametrize("name", ["", "a/b", "-x", "x" * 101, None])
def test_a_project_is_a_plain_name(name):
    with refused("tracker_project", name):
        validate.check(tiny.config(tracker_project=name))
    validate.check(tiny.config(tracker_project="My-project_1.2"))


def test_a_resumed_run_continues_the_same_remote_run_without_repeating_lines(
    tmp_path, monkeypatch
):
    remote, ids = Remote(), []

    def open_backend(config, logdir, run):
        ids.append(run)
        return remote

    use(monkeypatch, open_backend)
    part(tmp_path, 8, 16, 24, videos=[8, 24])
    tracking.truncate(tmp_path / "metrics.jsonl", 16)
    part(tmp_path, 24, 32, videos=[24, 32], resumed=True)
    assert remote.steps == [8, 16, 24, 32]
    assert [step for *_, step in remote.videos] == [8, 24, 32]
    assert ids[0] == ids[1]


def test_a_resumed_run_sends_the_lines_that_a_failed_backend_missed(tmp_path, monkeypatch):
    remote = Remote(raising)
    use(monkeypatch, lambda *_: remote)
    assert len(part(tmp_path, 8, 16, 24, 32)) == 1
    assert remote.steps == [8, 16]
    remote._fail = lambda count: None
    assert not part(tmp_path, 40, resumed=True)
    assert remote.steps == [8, 16, 24, 32, 40]


@pytest.mark.parametrize("content", [None, "", "[]", '{"run": "x"}'])
def test_another_project_or_a_new_run_is_a_new_remote_run(tmp_path, monkeypatch, content):
    ids = []
    use(monkeypatch, lambda config, logdir, run: ids.append(run) or Remote())
    part(tmp_path, 8)
    if content is not None:
        (tmp_path / backends.RECORD).write_text(content)
    other = tiny.config(tracker="wandb", tracker_project="other")
    part(tmp_path, 16, resumed=True, config=other)
    part(tmp_path, 24, resumed=False, config=other)
    assert len(set(ids)) == 3
    assert json.loads((tmp_path / backends.RECORD).read_text())["line"] == 24


@pytest.mark.parametrize(
    ("changes", "group", "tags"),
    [
        ({}, None, []),
        (
            {"tracker_group": "sweep 1", "tracker_tags": "ours, tiny"},
            "sweep 1",
            ["ours", "tiny"],
        ),
    ],
)
def test_trackers_get_group_and_tags(tmp_path, monkeypatch, changes, group, tags):
    taken = {}
    wandb = types.SimpleNamespace(
        setup=lambda: types.SimpleNamespace(settings=types.SimpleNamespace(mode="offline")),
        init=lambda **given: taken.update(wandb=given),
        Settings=dict,
        Video=None,
    )
    trackio = types.SimpleNamespace(
        init=lambda **given: taken.update(trackio=given), Video=None
    )
    for name, module in (("wandb", wandb), ("trackio", trackio)):
        monkeypatch.setitem(sys.modules, name, module)
        backends.OPENERS[name](tiny.config(tracker=name, **changes), tmp_path, "id")
    assert (taken["wandb"]["group"], taken["wandb"]["tags"]) == (group, tags or None)
    assert (taken["trackio"]["group"], taken["trackio"]["config"]["tags"]) == (group, tags)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("tracker_group", "two\nlines"),
        ("tracker_group", " "),
        ("tracker_tags", "a,,b"),
        ("tracker_tags", "x" * 65),
        ("tracker_tags", 3),
    ],
)
def test_groups_and_tags_are_short_texts(field, value):
    with refused(field, value):
        validate.check(tiny.config(**{field: value}))


@pytest.mark.parametrize("mode", ["online", "shared", "offline", "disabled"])
def test_wandb_never_prompts_at_the_terminal(tmp_path, monkeypatch, mode):
    """Its prompt would wait for standard input in a thread and keep the process alive."""
    settings = types.SimpleNamespace(mode=mode)
    wandb = types.SimpleNamespace(
        setup=lambda: types.SimpleNamespace(settings=settings),
        login=lambda *, prompt, verify: prompt or verify,  # not logged in
        init=lambda **_: Remote(),
        Settings=dict,
        Video=None,
    )
    monkeypatch.setitem(sys.modules, "wandb", wandb)
    said = part(tmp_path, 8)
    if mode in ("online", "shared"):
        assert_one_warning(said, "wandb", "WANDB_MODE=offline")
    else:
        assert not any("WANDB_MODE" in text for text in said)


class Broken:
    """A TensorBoard writer that raises."""

    def __init__(self, error):
        self._error = error

    def write(self, data):
        raise self._error

    def close(self):
        pass


def test_a_failure_of_tensorboard_is_one_warning_and_the_run_continues(tmp_path, monkeypatch):
    monkeypatch.setattr(tracking, "RecordWriter", lambda _: Broken(ValueError("not a proto")))
    said = []
    with Tracker(tmp_path, say=said.append) as tracker:
        tracker.write(line(8))
        tracker.write(line(16))
    assert_one_warning(said, "TensorBoard", "not a proto")
    kept = tracking.read(tmp_path / "metrics.jsonl")
    assert [entry["env_steps"] for entry in kept] == [8, 16]


@pytest.mark.parametrize("number", tracking.FULL)
def test_a_full_disk_in_tensorboards_writer_stops_the_run(tmp_path, monkeypatch, number):
    monkeypatch.setattr(tracking, "RecordWriter", lambda _: Broken(OSError(number, "No space")))
    with pytest.raises(OSError, match="No space"):
        Tracker(tmp_path)


def test_another_error_of_tensorboards_file_does_not_stop_the_run(tmp_path, monkeypatch):
    monkeypatch.setattr(tracking, "RecordWriter", lambda _: Broken(OSError(5, "I/O error")))
    said = []
    with Tracker(tmp_path, say=said.append) as tracker:
        tracker.write(line(8))
    assert "I/O error" in said[0]
    assert [entry["env_steps"] for entry in tracking.read(tmp_path / "metrics.jsonl")] == [8]


# The real backends: two parts of a resumed run, each in its own process.

PARTS = """
import pathlib, sys
import tiny
from vawm.runs.reports import backends
from vawm.runs.reports.tracking import Tracker

logdir, name, gif, resumed, steps = *sys.argv[1:4], sys.argv[4] == "resumed", sys.argv[5:]
logdir = pathlib.Path(logdir)
config = tiny.config(tracker=name, tracker_project="the-project")
backends.check(config)
further = backends.connect(config, logdir, resumed=resumed, say=print)
with Tracker(logdir, further=further) as tracker:
    for step in map(int, steps):
        line = {"env_steps": step, "loss/total": step / 10, "episode/return": None, "time": 1.5}
        tracker.write(line)
        further[0].write_video("video/episode", pathlib.Path(gif), step)
"""


def in_two_parts(logdir, name, gif, **environ):
    """Lines at 8 and 16, then at 16 and 24; what was printed to standard output."""
    run = [sys.executable, "-c", PARTS, str(logdir), name, str(gif)]
    path = os.pathsep.join(
        str(folder) for folder in (pathlib.Path(tiny.__file__).parent, *sys.path)
    )
    printed = ""
    for words in (["new", "8", "16"], ["resumed", "16", "24"]):
        done = subprocess.run(
            [*run, *words],
            env=os.environ | {"PYTHONPATH": path, "JAX_PLATFORMS": "cpu"} | environ,
            cwd=logdir,
            capture_output=True,
            text=True,
            timeout=120,
            check=False,
        )
        assert done.returncode == 0, done.stderr
        printed += done.stdout
    return printed


@pytest.fixture
def gif(tmp_path):
    path = tmp_path / "film.gif"
    with Tracker(tmp_path) as tracker:
        film = Video("episode", np.zeros((2, 16, 16, 3), np.uint8), {})
        tracker.write_videos([film], env_steps=8)
    (tmp_path / "videos" / "episode-000000000008.gif").rename(path)
    (tmp_path / "metrics.jsonl").unlink()
    return path


def test_wandb_takes_lines_and_videos_offline(tmp_path, gif):
    pytest.importorskip("wandb", reason="the extra wandb is not installed")
    printed = in_two_parts(tmp_path, "wandb", gif, WANDB_MODE="offline", WANDB_SILENT="true")
    assert "warning" not in printed
    assert json.loads((tmp_path / backends.RECORD).read_text())["line"] == 24
    folders = sorted((tmp_path / "wandb").glob("offline-run-*"))
    assert len({folder.name.rpartition("-")[2] for folder in folders}) == 1
    written = [b"".join(p.read_bytes() for p in f.glob("*.wandb")) for f in folders]
    assert all(b"loss/total" in data for data in written)
    assert list((tmp_path / "wandb").rglob("*.gif"))


def test_trackio_takes_lines_and_videos_into_its_database(tmp_path, gif):
    pytest.importorskip("trackio", reason="the extra trackio is not installed")
    printed = in_two_parts(tmp_path, "trackio", gif, TRACKIO_DIR=str(tmp_path / "trackio"))
    assert "warning" not in printed
    (database,) = (tmp_path / "trackio").glob("the-project*.db")
    with sqlite3.connect(database) as connection:
        rows = connection.execute("select run_name, step, metrics from metrics").fetchall()
    assert len({name for name, *_ in rows}) == 1
    stored = [(step, json.loads(metrics)) for _, step, metrics in rows]
    losses = [(step, entry["loss/total"]) for step, entry in stored if "loss/total" in entry]
    assert sorted(losses) == [(8, 0.8), (16, 1.6), (24, 2.4)]
    assert sum("video/episode" in entry for _, entry in stored) == 3
    assert [entry["seconds"] for _, entry in stored if "loss/total" in entry] == [1.5] * 3
