"""Lines of metrics: means, counts, strictly valid JSON."""

import errno
import json
import math
import pathlib
import threading

import numpy as np
import pytest
from runs import events
from tensorboardX.proto.event_pb2 import SessionLog
from tensorboardX.proto.plugin_hparams_pb2 import HParamsPluginData
from tensorboardX.record_writer import RecordWriter

from vawm.runs.reports import tracking
from vawm.runs.reports.tracking import Interval
from vawm.runs.reports.video import Video


def chunk(updates, loss, *, episodes=0, returns=0.0):
    return {
        "env_steps": np.int32(100),
        "updates": np.int32(50),
        "chunk/updates": np.int32(updates),
        "episode/count": np.int32(episodes),
        "episode/return": np.float32(returns),
        "episode/length": np.int32(10 * episodes),
        "env/nonfinite": np.int32(1),
        "loss/critic": np.float32(loss),
    }


def closed(interval):
    return tracking.line(interval, env_steps=100, updates=50, seconds=12.0)


def add_all(*chunks):
    interval = Interval()
    for metrics in chunks:
        interval = tracking.add(interval, metrics, env_steps=8, seconds=0.5)
    return interval


def test_a_line_weights_each_chunk_by_its_updates():
    line = closed(add_all(chunk(1, 5.0), chunk(3, 1.0), chunk(0, math.nan)))
    assert line["loss/critic"] == (1 * 5.0 + 3 * 1.0) / 4
    assert line["updates_per_s"] == pytest.approx(4 / 1.5, abs=1e-3)
    assert line["env_steps_per_s"] == 16.0
    assert (line["env_steps"], line["updates"], line["time"]) == (100, 50, 12.0)


def test_episode_metrics_are_means_over_finished_episodes():
    line = closed(add_all(chunk(1, 0, episodes=1, returns=10), chunk(1, 0, episodes=3)))
    assert line["episode/count"] == 4
    assert line["episode/return"] == 10 / 4
    assert line["episode/length"] == 10
    assert line["env/nonfinite"] == 2


def test_means_without_samples_are_null():
    line = closed(add_all(chunk(0, math.nan)))
    assert line["episode/return"] is None
    assert line["loss/critic"] is None


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
def test_a_line_is_strictly_valid_json(value):
    def refuse(constant):
        raise AssertionError(constant)

    text = tracking.as_json(closed(add_all(chunk(1, value))))
    assert json.loads(text, parse_constant=refuse)["loss/critic"] is None


def test_an_interval_survives_json_exactly():
    interval = add_all(chunk(1, 0.1), chunk(3, 1 / 3, episodes=2, returns=0.7))
    assert Interval(**json.loads(json.dumps(interval._asdict()))) == interval


def test_truncation_drops_later_lines_and_half_a_line(tmp_path):
    path = tmp_path / "metrics.jsonl"
    path.write_text('{"env_steps": 1}\n{"env_steps": 2}\n{"env_steps": 3}\n{"env_st')
    tracking.truncate(path, 2)
    assert path.read_text() == '{"env_steps": 1}\n{"env_steps": 2}\n'


def test_a_truncation_on_a_full_disk_leaves_the_file_unchanged(tmp_path, monkeypatch):
    def full(_):
        raise OSError(28, "No space left on device")

    path, text = tmp_path / "metrics.jsonl", '{"env_steps": 1}\n{"env_steps": 2}\n'
    path.write_text(text)
    monkeypatch.setattr(tracking, "sync", full)
    with pytest.raises(OSError, match="No space"):
        tracking.truncate(path, 1)
    assert (path.read_text(), list(tmp_path.iterdir())) == (text, [path])


def test_truncating_a_missing_file_does_nothing(tmp_path):
    assert tracking.truncate(tmp_path / "metrics.jsonl", 2) == 0
    assert not list(tmp_path.iterdir())
    assert tracking.read(tmp_path / "metrics.jsonl") == []


@pytest.mark.parametrize(
    "damage",
    [b'{"env_steps": 2', b"\0\0\0", b"\xff\xfe", b"null", b"7", b'{"a": 1}', b"[" * 99_999],
)
def test_a_damaged_line_is_dropped_and_counted_and_later_ones_stay(tmp_path, damage):
    path = tmp_path / "metrics.jsonl"
    whole = [b'{"env_steps": %d}\n' % env_steps for env_steps in (1, 3, 4, 5)]
    path.write_bytes(
        b"".join([whole[0], damage + b"\n", *whole[1:3], damage + b"\n", whole[3]])
    )
    assert [line["env_steps"] for line in tracking.read(path)] == [1, 3, 4, 5]
    assert tracking.truncate(path, 4) == 1  # the other one is after the last line kept
    assert path.read_bytes() == b"".join(whole[:3])
    assert tracking.truncate(path, 4) == 0


def test_a_tracker_writes_lines_and_tensorboard_events_at_once(tmp_path):
    line = closed(add_all(chunk(1, 2.0)))
    with tracking.Tracker(tmp_path) as tracker:
        tracker.write(line)
        assert tracking.read(tmp_path / "metrics.jsonl")[0]["loss/critic"] == 2.0
        version, event = events(tmp_path)
    assert version.file_version == "brain.Event:2"
    assert event.step == 100
    assert {value.tag: value.simple_value for value in event.summary.value} == {
        name: pytest.approx(value) for name, value in line.items() if value is not None
    }


def test_tensorboard_purges_from_the_step_after_the_last_that_is_kept(tmp_path):
    with tracking.Tracker(tmp_path, purge_after=96):
        pass
    _, start = events(tmp_path)
    assert (start.step, start.session_log.status) == (97, SessionLog.START)


CHOICES = {"seed": 3, "task": "walker_walk", "critic.replay_gradient": True, "actor.scale": 0.5}


@pytest.mark.parametrize("purge_after", [None, 96])
def test_tensorboard_gets_the_choices_of_a_run_and_compares_returns(tmp_path, purge_after):
    with tracking.Tracker(tmp_path, purge_after=purge_after, choices=CHOICES):
        pass
    found = [(e.step, v) for e in events(tmp_path) for v in e.summary.value]
    assert {step for step, _ in found} == {0 if purge_after is None else 97}
    parts = {
        value.tag: HParamsPluginData.FromString(value.metadata.plugin_data.content)
        for _, value in found
        if value.metadata.plugin_data.plugin_name == "hparams"
    }
    shown = parts["_hparams_/session_start_info"].session_start_info.hparams
    assert {
        name: getattr(value, value.WhichOneof("kind")) for name, value in shown.items()
    } == CHOICES
    experiment = parts["_hparams_/experiment"].experiment
    assert {info.name for info in experiment.hparam_infos} == CHOICES.keys()
    assert [info.name.tag for info in experiment.metric_infos] == ["episode/return"]


@pytest.mark.skipif(not pathlib.Path("/dev/full").exists(), reason="needs /dev/full")
@pytest.mark.parametrize("name", ["metrics.jsonl", "events"])
def test_a_full_disk_is_an_error_when_a_line_is_written(tmp_path, monkeypatch, name):
    if name == "events":
        monkeypatch.setattr(tracking, "RecordWriter", lambda _: RecordWriter("/dev/full"))
    else:
        (tmp_path / name).symlink_to("/dev/full")
    threads = threading.active_count()
    with (
        pytest.raises(OSError, match="No space left") as error,
        tracking.Tracker(tmp_path) as tracker,
    ):
        tracker.write(closed(add_all(chunk(1, 2.0))))
    assert error.value.errno == errno.ENOSPC
    assert threading.active_count() == threads


def film(name="episode", **numbers):
    return Video(name, np.zeros((3, 16, 24, 3), np.uint8), numbers)


def test_videos_are_files_lines_and_events(tmp_path):
    with tracking.Tracker(tmp_path) as tracker:
        tracker.write_videos([film(**{"return": 3.0})], env_steps=40)
        tracker.write_videos([film("open_loop", error=[0.5, None])], env_steps=80)
    names = ["episode-000000000040.gif", "open_loop-000000000080.gif"]
    assert sorted(path.name for path in (tmp_path / "videos").iterdir()) == names
    assert tracking.read(tmp_path / "videos.jsonl") == [
        {"env_steps": 40, "video": names[0], "return": 3.0},
        {"env_steps": 80, "video": names[1], "error": [0.5, None]},
    ]
    shown = [(e.step, v) for e in events(tmp_path) for v in e.summary.value]
    assert [(step, v.tag) for step, v in shown] == [
        (40, "video/episode"),
        (80, "video/open_loop"),
    ]
    image = shown[0][1].image
    assert (image.height, image.width, image.colorspace) == (16, 24, 3)
    assert image.encoded_image_string == (tmp_path / "videos" / names[0]).read_bytes()


def test_a_resumed_run_sends_tensorboard_the_videos_that_it_dropped(tmp_path):
    with tracking.Tracker(tmp_path) as tracker:
        for env_steps in (40, 80, 90):
            tracker.write_videos([film()], env_steps=env_steps)
    before = len(events(tmp_path))
    (tmp_path / "videos" / "episode-000000000080.gif").unlink()
    with tracking.Tracker(tmp_path, purge_after=60) as tracker:
        tracker.show_videos(after=60)
    shown = [(e.step, v) for e in events(tmp_path)[before:] for v in e.summary.value]
    ((step, value),) = shown
    assert (step, value.tag) == (90, "video/episode")
    gif = (tmp_path / "videos" / "episode-000000000090.gif").read_bytes()
    assert (value.image.height, value.image.width) == (16, 24)
    assert value.image.encoded_image_string == gif


def test_a_video_that_cannot_be_written_leaves_no_file(tmp_path, monkeypatch):
    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(pathlib.Path, "replace", full)
    with tracking.Tracker(tmp_path) as tracker, pytest.raises(OSError, match="No space left"):
        tracker.write_videos([film()], env_steps=40)
    assert not list(tmp_path.glob("videos/*"))
    assert not (tmp_path / "videos.jsonl").exists()
