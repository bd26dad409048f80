"""Metrics of a run: means over an interval, lines of JSON, TensorBoard events.

`metrics.jsonl` is the source of truth: one strictly valid JSON object per line, written
when the interval between two lines is complete. Means weight every chunk by its number of
updates; counts are sums. An `Interval` is plain numbers, so a checkpoint can store it.

TensorBoard's file is next to it. A full disk stops the run, because the next checkpoint would
fail too. At any other failure of TensorBoard, the run prints one warning and continues without
it. `vawm.runs.reports.backends` has further backends.
"""

from __future__ import annotations

import errno
import json
import math
import os
import pathlib
import socket
import struct
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Any, NamedTuple, Protocol

from tensorboardX.proto.event_pb2 import Event, SessionLog
from tensorboardX.proto.summary_pb2 import Summary
from tensorboardX.record_writer import RecordWriter
from tensorboardX.summary import hparams

from vawm.runs.checkpoint.manifest import sync
from vawm.runs.reports.video import Video, as_gif

Line = dict[str, Any]

COUNTERS = ("env_steps", "updates")
METRICS, VIDEOS, VIDEO_LINES = "metrics.jsonl", "videos", "videos.jsonl"
SAVE_LINES = "checkpoints.jsonl"
"""One line per checkpoint: its size, how long saving took, how long training waited."""
FULL = (errno.ENOSPC, errno.EDQUOT)
EPISODE_SUMS = ("episode/return", "episode/length")
COMPARED = "episode/return"
"""The metric beside the choices of each run in TensorBoard's tab HPARAMS."""


class Interval(NamedTuple):
    """Measurements since the last line.

    Attributes:
      updates: updates in the interval.
      weighted: name -> sum over updates, for metrics that are means.
      counted: name -> sum over chunks, for metrics that are counts.
      env_steps: env steps in the interval.
      seconds: of its steps, without the time for lines, videos and checkpoints.
    """

    updates: int = 0
    weighted: dict[str, float] = {}  # noqa: RUF012 - never mutated
    counted: dict[str, float] = {}  # noqa: RUF012
    env_steps: int = 0
    seconds: float = 0.0


class Backend(Protocol):
    """A destination of lines and videos besides `metrics.jsonl`."""

    def write(self, entry: Line) -> None:
        """Writes one line of metrics, at step `entry["env_steps"]`."""

    def write_video(self, name: str, gif: pathlib.Path, env_steps: int) -> None:
        """Writes a video; the file `gif` stays in place."""

    def close(self) -> None:
        """Finishes; nothing is written afterwards."""


def is_count(name: str) -> bool:
    """Whether this metric is summed over chunks instead of averaged."""
    return name.startswith(("episode/", "env/"))


def add(
    interval: Interval, metrics: Mapping[str, Any], *, env_steps: int, seconds: float
) -> Interval:
    """`interval` with one more chunk; `env_steps` and `seconds` are those of the chunk."""
    updates = int(metrics["chunk/updates"])
    weighted, counted = dict(interval.weighted), dict(interval.counted)
    for name, value in metrics.items():
        if name in COUNTERS or name.startswith("chunk/"):
            continue
        if is_count(name):
            counted[name] = counted.get(name, 0.0) + float(value)
        else:  # 0 updates add nothing
            chunk = updates * float(value) if updates else 0.0
            weighted[name] = weighted.get(name, 0.0) + chunk
    return Interval(
        updates=interval.updates + updates,
        weighted=weighted,
        counted=counted,
        env_steps=interval.env_steps + env_steps,
        seconds=interval.seconds + seconds,
    )


def line(interval: Interval, *, env_steps: int, updates: int, seconds: float) -> Line:
    """The line for a complete `interval`; the keyword arguments are totals of the run.

    Episode metrics are means over finished episodes, None if there are none; other means
    are None if there were no updates.
    """
    episodes = interval.counted.get("episode/count", 0.0)
    result: Line = {"env_steps": env_steps, "updates": updates}
    for name, total in sorted(interval.counted.items()):
        if name in EPISODE_SUMS:
            result[name] = total / episodes if episodes else None
        else:
            result[name] = int(total)
    for name, total in sorted(interval.weighted.items()):
        result[name] = total / interval.updates if interval.updates else None
    result["time"] = round(seconds, 3)
    for name, amount in [("env_steps", interval.env_steps), ("updates", interval.updates)]:
        speed = amount / interval.seconds if interval.seconds else 0.0
        result[f"{name}_per_s"] = round(speed, 3)
    return result


def as_json(value: Line) -> str:
    """One line of strictly valid JSON; numbers that are not finite become null."""
    return json.dumps({k: _finite_or_none(v) for k, v in value.items()}, allow_nan=False)


def _finite_or_none(value: Any) -> Any:
    return None if isinstance(value, float) and not math.isfinite(value) else value


def finite(entry: Line) -> Line:
    """The entries of a line that are finite numbers."""
    return {name: value for name, value in entry.items() if _finite_or_none(value) is not None}


def read(path: str | os.PathLike[str]) -> list[Line]:
    """Reads a file such as `metrics.jsonl`; returns no lines if it does not exist.

    Skips damaged lines and a half-written last one.
    """
    return [entry for entry in _entries(pathlib.Path(path)) if entry is not None]


def truncate(path: str | os.PathLike[str], env_steps: int) -> int:
    """Drops the lines later than `env_steps`, and damaged or half-written ones.

    Returns:
      The number of damaged lines before the last line that is kept.
    """
    path = pathlib.Path(path)
    if not path.exists():
        return 0
    entries = _entries(path)
    stay = [entry is not None and entry["env_steps"] <= env_steps for entry in entries]
    last = max((number for number, stays in enumerate(stay) if stays), default=-1)
    kept = [entry for entry, stays in zip(entries, stay, strict=True) if entry and stays]
    scratch = path.with_suffix(".jsonl.tmp")
    try:
        scratch.write_text("".join(as_json(entry) + "\n" for entry in kept))
        sync(scratch)
        scratch.replace(path)
        sync(path.parent)
    except OSError:
        scratch.unlink(missing_ok=True)
        raise
    return entries[: last + 1].count(None)


def _entries(path: pathlib.Path) -> list[Line | None]:
    """The entry of each line; None for damaged and half-written lines."""
    try:
        text = path.read_text(errors="replace")
    except FileNotFoundError:
        return []
    return [_entry(line) for line in text.split("\n") if line]


def _entry(text: str) -> Line | None:
    try:
        entry = json.loads(text)
    except (ValueError, RecursionError):
        return None
    whole = isinstance(entry, dict) and isinstance(entry.get("env_steps"), int)
    return entry if whole else None


class Board:
    """TensorBoard's event file, written without a thread.

    tensorboardX's writer uses a thread; a full disk would end that thread and not the run.
    """

    def __init__(self, logdir: pathlib.Path, *, purge_after: int | None = None):
        name = f"events.out.tfevents.{time.time():.6f}.{socket.gethostname()}"
        self._file = RecordWriter(str((logdir / name).absolute()))  # `s3:x` is a folder
        self._add(Event(file_version="brain.Event:2"))
        self._first = 0 if purge_after is None else purge_after + 1
        if purge_after is not None:
            start = SessionLog(status=SessionLog.START)
            self._add(Event(step=self._first, session_log=start))

    def write_choices(self, choices: Mapping[str, bool | int | float | str]) -> None:
        """Adds the choices of the run for the tab HPARAMS, by name."""
        experiment, start, end = hparams(dict(choices), {COMPARED: None})
        for summary in (experiment, start, end):  # the end: its status, shown from the start
            self._add(Event(step=self._first, summary=summary))
        self._file.flush()

    def write(self, entry: Line) -> None:
        """Adds the finite numbers of one line of metrics."""
        values = [Summary.Value(tag=k, simple_value=v) for k, v in finite(entry).items()]
        self._add(Event(step=entry["env_steps"], summary=Summary(value=values)))
        self._file.flush()

    def write_video(self, name: str, gif: pathlib.Path, env_steps: int) -> None:
        """Adds an animated GIF in colour, which TensorBoard plays."""
        data = gif.read_bytes()
        width, height = struct.unpack("<HH", data[6:10])  # from the GIF header
        image = Summary.Image(
            height=height, width=width, colorspace=3, encoded_image_string=data
        )
        self._add(
            Event(step=env_steps, summary=Summary(value=[Summary.Value(tag=name, image=image)]))
        )
        self._file.flush()

    def _add(self, event: Event) -> None:
        event.wall_time = time.time()
        self._file.write(event.SerializeToString())

    def close(self) -> None:
        self._file.close()


class Tracker:
    """Writes lines to `metrics.jsonl`, TensorBoard and further backends; a context manager.

    Args:
      logdir: the folder of the run.
      purge_after: TensorBoard drops earlier events after this env step; None keeps all.
      further: backends that handle their own failures, from
        `vawm.runs.reports.backends.connect`.
      say: prints a warning.
      choices: of the run, by name; TensorBoard shows them, if there are any.

    Raises:
      OSError: `metrics.jsonl` or a video cannot be written; every method raises it.
    """

    def __init__(
        self,
        logdir: pathlib.Path,
        *,
        purge_after: int | None = None,
        further: Sequence[Backend] = (),
        say: Callable[[str], None] = print,
        choices: Mapping[str, bool | int | float | str] | None = None,
    ):
        self._logdir, self._further, self._say = logdir, further, say
        self._file = (logdir / METRICS).open("a")
        self._board: Board | None = None
        try:
            self._board = Board(logdir, purge_after=purge_after)
        except Exception as error:
            self._drop_board(error)
        if choices:
            self._to_board(lambda board: board.write_choices(choices))

    def write(self, entry: Line) -> None:
        """Appends one line and flushes the files."""
        self._file.write(as_json(entry) + "\n")
        self._file.flush()
        self._to_board(lambda board: board.write(entry))
        for backend in self._further:
            backend.write(entry)

    def write_videos(self, videos: Sequence[Video], *, env_steps: int) -> None:
        """Writes each as `videos/<name>-<env steps>.gif`, its numbers to `videos.jsonl`."""
        folder = self._logdir / VIDEOS
        for video in videos:
            folder.mkdir(exist_ok=True)
            gif, path = as_gif(video.frames), folder / f"{video.name}-{env_steps:012d}.gif"
            scratch = path.with_suffix(".gif.tmp")
            try:
                scratch.write_bytes(gif)
                scratch.replace(path)
            except OSError:
                scratch.unlink(missing_ok=True)
                raise
            self._show(video.name, path, env_steps)
            for backend in self._further:
                backend.write_video(f"video/{video.name}", path, env_steps)
            entry = {"env_steps": env_steps, "video": path.name} | video.numbers
            with (self._logdir / VIDEO_LINES).open("a") as file:
                file.write(as_json(entry) + "\n")

    def show_videos(self, *, after: int) -> None:
        """Sends TensorBoard the videos that it dropped at a resume, those later than `after`.

        `after` is the env step of the last line of metrics.
        """
        path = self._logdir / VIDEO_LINES
        for entry in read(path):
            video = self._logdir / VIDEOS / entry["video"]
            if entry["env_steps"] > after and video.exists():
                self._show(entry["video"].partition("-")[0], video, entry["env_steps"])

    def _show(self, name: str, gif: pathlib.Path, env_steps: int) -> None:
        self._to_board(lambda board: board.write_video(f"video/{name}", gif, env_steps))

    def _to_board(self, call: Callable[[Board], None]) -> None:
        if self._board is not None:
            try:
                call(self._board)
            except Exception as error:
                self._drop_board(error)

    def _drop_board(self, error: Exception) -> None:
        """Continues without TensorBoard, unless the disk is full."""
        if isinstance(error, OSError) and error.errno in FULL:
            raise error
        self._board = None
        reason = (str(error).strip() or repr(error)).splitlines()[0][:200]
        self._say(
            f"warning: stopped reporting to TensorBoard ({reason}); {METRICS} is complete"
        )

    def __enter__(self) -> Tracker:
        return self

    def __exit__(self, *_: object) -> None:
        try:
            self._file.close()
            self._to_board(lambda board: board.close())
        finally:
            for backend in self._further:
                backend.close()
