"""Sends reports to Weights & Biases or trackio, without risk to the run.

`metrics.jsonl` is the source of truth and TensorBoard is always written. `Config.tracker` adds
one backend. A daemon thread opens it and writes to it from a bounded queue. At the first
failure, or if the queue is full, the run prints one warning and continues without the backend.

`tracker.json` in the run's folder names the remote run and the last line and video sent to it.
A resumed run continues the same remote run: it sends the missing lines from `metrics.jsonl`,
and does not send steps again. If a process is killed between sending a line and recording it,
one line may be sent twice. Sent lines are never deleted: if a run is extended later, the line
of its incomplete last interval stays. The step of both backends is `env_steps`.

    wandb     refuses steps below its newest, so it has no line twice. It completes a step when
              the next one starts or the run ends, so a killed process loses the last line.
              With WANDB_MODE=offline it writes to <logdir>/wandb, one folder for each part of a
              run; `wandb sync` sends them. WANDB_ENTITY and wandb's other variables apply.
    trackio   a database on this machine (TRACKIO_DIR), or a server (TRACKIO_SPACE_ID,
              TRACKIO_SERVER_URL). Accepts steps in any order and repeatedly. The field `time`
              of a line is called `seconds` there. It has no tags: they are the entry `tags` of
              the run's config.
"""

from __future__ import annotations

import importlib.util
import json
import pathlib
import queue
import threading
import time
import uuid
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

from vawm.config import Config, as_dict
from vawm.errors import InvalidInput
from vawm.runs.reports.tracking import METRICS, Backend, Line, finite, read

CAPACITY = 256
"""Lines and videos that may wait for a backend; if more wait, it is too slow and dropped."""
PATIENCE, HURRIED_PATIENCE = 30.0, 5.0
"""Seconds for which the end of a run waits until everything is sent. The second number applies
after a signal, because its sender may kill the process soon."""
RECORD = "tracker.json"


class Feed:
    """Writes to a backend in a thread; only `close` waits for it, for a limited time.

    Args:
      name: of the backend, for the warning.
      open_backend: called in the thread.
      say: prints the warning; called in the caller's thread.
      capacity: entries that may wait; if more wait, the backend is dropped.
      patience: returns the seconds that `close` may wait in total; asked repeatedly.
    """

    def __init__(
        self,
        name: str,
        open_backend: Callable[[], Backend],
        say: Callable[[str], None],
        *,
        capacity: int = CAPACITY,
        patience: Callable[[], float] = lambda: PATIENCE,
    ):
        self._name, self._say, self._patience = name, say, patience
        self._calls: queue.Queue[Callable[[Backend], None] | None] = queue.Queue(capacity)
        self._failure, self._dropped = "", False
        self._thread = threading.Thread(target=self._work, args=[open_backend], daemon=True)
        self._thread.start()

    def write(self, entry: Line) -> None:
        self._put(lambda backend: backend.write(entry))

    def write_video(self, name: str, gif: pathlib.Path, env_steps: int) -> None:
        self._put(lambda backend: backend.write_video(name, gif, env_steps))

    def close(self) -> None:
        self._put(None)
        if self._dropped:
            return
        began = time.monotonic()
        while self._thread.is_alive() and time.monotonic() - began < self._patience():
            self._thread.join(0.1)
        if self._thread.is_alive():
            self._drop(f"not finished {time.monotonic() - began:.0f} s after the run's end")
        elif self._failure:
            self._drop(self._failure)

    def _put(self, call: Callable[[Backend], None] | None) -> None:
        if self._failure and not self._dropped:
            self._drop(self._failure)
        if self._dropped:
            return
        try:
            self._calls.put_nowait(call)
        except queue.Full:
            self._drop(f"too slow, {self._calls.maxsize} lines are waiting")

    def _drop(self, why: str) -> None:
        self._dropped = True
        self._say(f"warning: stopped reporting to {self._name} ({why}); {METRICS} is complete")

    def _work(self, open_backend: Callable[[], Backend]) -> None:
        try:
            backend = open_backend()
            while (call := self._calls.get()) and not self._dropped:
                call(backend)
            backend.close()
        except BaseException as error:  # the run must continue, whatever ends this thread
            self._failure = (str(error).strip() or repr(error)).splitlines()[0][:200]


class Record(NamedTuple):
    """What a backend has received of a run; stored in `tracker.json`.

    Attributes:
      tracker: name of the backend.
      project: its project.
      run: id of the remote run.
      line: env steps of the last line sent, -1 for none.
      video: env steps of the last video sent, -1 for none.
    """

    tracker: str
    project: str
    run: str
    line: int = -1
    video: int = -1


class Once:
    """Sends a backend what earlier parts of the run have not, and updates `tracker.json`."""

    def __init__(self, backend: Backend, logdir: pathlib.Path, record: Record):
        self._backend, self._logdir = backend, logdir
        self._earlier, self._now = record, record

    def write(self, entry: Line) -> None:
        if entry["env_steps"] > self._earlier.line:
            self._backend.write(entry)
            self._note(self._now._replace(line=entry["env_steps"]))

    def write_video(self, name: str, gif: pathlib.Path, env_steps: int) -> None:
        if env_steps > self._earlier.video:
            self._backend.write_video(name, gif, env_steps)
            self._note(self._now._replace(video=env_steps))

    def close(self) -> None:
        self._backend.close()

    def _note(self, record: Record) -> None:
        self._now = record
        _write(self._logdir, record)


class WeightsAndBiases:
    """A run on Weights & Biases.

    Raises:
      ConnectionError: not logged in, and not set to offline mode.
    """

    def __init__(self, config: Config, logdir: pathlib.Path, run: str):
        import wandb

        online = wandb.setup().settings.mode not in ("offline", "dryrun", "disabled")
        # Otherwise wandb would prompt at the terminal, from this thread.
        if online and not wandb.login(prompt=False, verify=False):
            raise ConnectionError("not logged in: `wandb login`, or set WANDB_MODE=offline")
        self._video = wandb.Video
        # Both timeouts also limit wandb's hook at the end of the process.
        settings = wandb.Settings(console="off", init_timeout=PATIENCE, finish_timeout=PATIENCE)
        self._run = wandb.init(
            project=config.tracker_project,
            id=run,
            name=logdir.name,
            dir=str(logdir),
            group=config.tracker_group or None,
            tags=tags(config) or None,
            config=as_dict(config),
            allow_val_change=True,
            resume="allow",
            settings=settings,
        )

    def write(self, entry: Line) -> None:
        self._run.log(finite(entry), step=entry["env_steps"])

    def write_video(self, name: str, gif: pathlib.Path, env_steps: int) -> None:
        self._run.log({name: self._video(str(gif), format="gif")}, step=env_steps)

    def close(self) -> None:
        self._run.finish()


class Trackio:
    """A run in trackio, identified by its name. `time` is reserved there."""

    def __init__(self, config: Config, logdir: pathlib.Path, run: str):
        import trackio

        self._video = trackio.Video
        self._run = trackio.init(
            project=config.tracker_project,
            name=f"{logdir.name}-{run}",
            group=config.tracker_group or None,
            config=as_dict(config) | {"tags": tags(config)},
            resume="allow",
            auto_log_cpu=False,
            auto_log_gpu=False,
        )

    def write(self, entry: Line) -> None:
        renamed = {
            "seconds" if name == "time" else name: x for name, x in finite(entry).items()
        }
        self._run.log(renamed, step=entry["env_steps"])

    def write_video(self, name: str, gif: pathlib.Path, env_steps: int) -> None:
        self._run.log({name: self._video(gif)}, step=env_steps)

    def close(self) -> None:
        self._run.finish()


def tags(config: Config) -> list[str]:
    """The tags of a run."""
    return [tag.strip() for tag in config.tracker_tags.split(",") if tag.strip()]


OPENERS: dict[str, Callable[[Config, pathlib.Path, str], Backend]] = {
    "wandb": WeightsAndBiases,
    "trackio": Trackio,
}


def check(config: Config) -> None:
    """Refuses a tracker whose package is not installed.

    Raises:
      InvalidInput: names the command that installs it.
    """
    name = config.tracker
    if name == "none":
        return
    found = importlib.util.find_spec(name)
    if found is None or found.origin is None:  # no origin: a folder that wandb wrote
        remedy = f"{name} is not installed: pip install 'vawm[{name}]'"
        raise InvalidInput("tracker", name, remedy)


def connect(
    config: Config,
    logdir: pathlib.Path,
    *,
    resumed: bool,
    say: Callable[[str], None],
    hurried: Callable[[], bool] = lambda: False,
) -> Sequence[Backend]:
    """The backends that `config` names, one or none; each is opened in its own thread.

    Args:
      config: of the run.
      logdir: folder of the run.
      resumed: whether `metrics.jsonl` has lines of an earlier part of the same run.
      say: prints a warning.
      hurried: returns whether a signal has asked the run to stop.
    """
    if config.tracker == "none":
        return ()
    record = _record(config, logdir, resumed=resumed)
    path = logdir / METRICS
    past = read(path) if resumed else []

    def open_backend() -> Backend:
        _write(logdir, record)
        opened = OPENERS[config.tracker](config, logdir, record.run)
        backend = Once(opened, logdir, record)
        for entry in past:
            backend.write(entry)
        return backend

    def patience() -> float:
        return HURRIED_PATIENCE if hurried() else PATIENCE

    return [Feed(config.tracker, open_backend, say, patience=patience)]


def _record(config: Config, logdir: pathlib.Path, *, resumed: bool) -> Record:
    """The record of the run, or a new one for a new run, another tracker or project."""
    new = Record(config.tracker, config.tracker_project, uuid.uuid4().hex[:12])
    try:
        kept = Record(**json.loads((logdir / RECORD).read_text()))
    except (OSError, ValueError, TypeError):
        return new
    return kept if resumed and kept[:2] == new[:2] else new


def _write(logdir: pathlib.Path, record: Record) -> None:
    content: dict[str, Any] = record._asdict()
    scratch = logdir / (RECORD + ".tmp")
    scratch.write_text(json.dumps(content) + "\n")
    scratch.replace(logdir / RECORD)
