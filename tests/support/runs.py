"""Helpers for runs on disk, and the comparison of two runs."""

import contextlib
import io
import struct

import rich.console
import tiny
import toy
from tensorboardX.proto.event_pb2 import Event

from vawm.runs import checkpoint, runner
from vawm.runs.reports import tracking

WALL_TIME = ("time", "env_steps_per_s", "updates_per_s")


def quiet():
    return rich.console.Console(file=io.StringIO())


def save_toy(logdir, state, env_steps=8, **changes):
    """Saves a `toy` state as a checkpoint of `tiny.CONFIG`."""
    usual = {"config": tiny.CONFIG, "spec": toy.SPEC, "progress": {}}
    return checkpoint.save(logdir, state, env_steps=env_steps, **usual | changes)


def files_of(path):
    """All files of a checkpoint that are not empty."""
    return sorted(file for file in path.rglob("*") if file.is_file() and file.stat().st_size)


def lines(logdir):
    return tracking.read(logdir / "metrics.jsonl")


def measured(logdir):
    """The lines of metrics without times and speeds."""
    return [
        {name: value for name, value in line.items() if name not in WALL_TIME}
        for line in lines(logdir)
    ]


def events(logdir):
    """The events in TensorBoard's files. A record: length, its checksum, data, its checksum."""
    result = []
    for path in sorted(logdir.glob("events.out.tfevents.*")):
        data = path.read_bytes()
        while data:
            (length,) = struct.unpack("<Q", data[:8])
            result.append(Event.FromString(data[12 : 12 + length]))
            data = data[12 + length + 4 :]
    return result


def assert_same(actual, expected, config, env=None):
    """Checks that two complete runs have the same state bit for bit, and the same lines."""
    with contextlib.closing(runner.prepare(config, env)) as trainer:
        shapes = trainer.shapes
    (state, manifest), (other, other_manifest) = (
        checkpoint.restore(logdir, shapes) for logdir in (actual, expected)
    )
    toy.assert_equal(state, other)
    assert manifest.env_steps == other_manifest.env_steps == config.env_steps
    assert measured(actual) == measured(expected)
