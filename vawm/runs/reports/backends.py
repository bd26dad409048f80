"""Where else a run may report to: Weights & Biases or trackio, fed so that neither can harm it.

`metrics.jsonl` is the source of truth and TensorBoard is always written; `Config.tracker` names
one backend more. It is opened and written to by a daemon thread that reads a bounded queue: the
first failure, or a queue that is full, costs the run one line of warning and the backend, and
nothing else.

`tracker.json` in the run's folder names the remote run and the last line and video that it was
given. A resumed run goes on in the same remote run: lines that the backend never got, such as
those after it failed, are caught up from `metrics.jsonl`, and steps that it has are not sent
again. A process that is killed between sending and noting that may send one line twice. What
was sent is not taken back: the line of an incomplete interval, at the end of a run that is
extended later, stays. The step of both backends is `env_steps`.

    wandb     refuses steps below its newest, so it has no line twice. It completes a step when
              the next begins or the run ends, so a killed process costs it the last line. With
              WANDB_MODE=offline it writes to <logdir>/wandb, one folder for each part of a run,
              which `wandb sync` sends. WANDB_ENTITY and the other variables of its own apply.
    trackio   a database on this machine (TRACKIO_DIR), or a server (TRACKIO_SPACE_ID,
              TRACKIO_SERVER_URL); any order of steps is taken, any number of times. What lines
              call `time` is `seconds` there.
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

from vawm import config as config_lib
from vawm.config import Config
from vawm.errors import InvalidInput
from vawm.runs.reports.tracking import METRICS, Backend, Line, finite, read

CAPACITY = 256
"""Lines and paths of videos that wait for a backend before it counts as too slow."""
PATIENCE, HURRIED_PATIENCE = 30.0, 5.0
"""Seconds that the end of a run waits for what is still to be sent; the second after a signal,
since whoever sent it may kill the process soon."""
RECORD = "tracker.json"


class Feed:
    """Hands a backend its lines in a thread; only `close` waits for it, and not for long.

    Args:
      name: of the backend, for the warning.
      open_backend: called in the thread.
      say: prints the one line of warning; called by whoever calls the methods.
      capacity: what may wait; more drops the backend.
      patience: tells, as often as asked, how many seconds `close` may wait in all.
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
            self._drop(f"not done after {time.monotonic() - began:.0f} s at the end")
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
            self._drop(f"does not keep up, {self._calls.maxsize} lines wait")

    def _drop(self, why: str) -> None:
        self._dropped = True
        self._say(f"warning: {self._name} gets no more of this run ({why}); {METRICS} has all")

    def _work(self, open_backend: Callable[[], Backend]) -> None:
        try:
            backend = open_backend()
            while (call := self._calls.get()) and not self._dropped:
                call(backend)
            backend.close()
        except BaseException as error:  # whatever ends this thread, the run goes on
            self._failure = (str(error).strip() or repr(error)).splitlines()[0][:200]


class Record(NamedTuple):
    """What a backend has of a run, as `tracker.json` keeps it.

    Attributes:
      tracker: which backend.
      project: of its.
      run: the remote run's id.
      line: env steps of the last line that it was given, -1 for none.
      video: of the last videos.
    """

    tracker: str
    project: str
    run: str
    line: int = -1
    video: int = -1


class Once:
    """Gives a backend what earlier parts of the run did not, and notes it in `tracker.json`."""

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
      ConnectionError: nobody is logged in, and it is not told to stay offline.
    """

    def __init__(self, config: Config, logdir: pathlib.Path, run: str):
        import wandb

        online = wandb.setup().settings.mode not in ("offline", "dryrun", "disabled")
        # Else it asks who sits at the terminal, in a thread that nobody waits for.
        if online and not wandb.login(prompt=False, verify=False):
            raise ConnectionError("not logged in: `wandb login`, or set WANDB_MODE=offline")
        self._video = wandb.Video
        # Both also bound what its own hook at the end of the process waits for.
        settings = wandb.Settings(console="off", init_timeout=PATIENCE, finish_timeout=PATIENCE)
        self._run = wandb.init(
            project=config.tracker_project,
            id=run,
            name=logdir.name,
            dir=str(logdir),
            config=config_lib.as_dict(config),
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
    """A run in trackio, which knows it by its name; `time` is a word of its own there."""

    def __init__(self, config: Config, logdir: pathlib.Path, run: str):
        import trackio

        self._video = trackio.Video
        self._run = trackio.init(
            project=config.tracker_project,
            name=f"{logdir.name}-{run}",
            config=config_lib.as_dict(config),
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


OPENERS: dict[str, Callable[[Config, pathlib.Path, str], Backend]] = {
    "wandb": WeightsAndBiases,
    "trackio": Trackio,
}


def check(config: Config) -> None:
    """Refuses a tracker whose package is not installed.

    Raises:
      InvalidInput: with the command that installs it.
    """
    name = config.tracker
    if name == "none":
        return
    found = importlib.util.find_spec(name)
    if found is None or found.origin is None:  # or a folder of that name, where wandb wrote
        remedy = f"{name} is missing: pip install 'vawm[{name}]'"
        raise InvalidInput("tracker", name, remedy)


def connect(
    config: Config,
    logdir: pathlib.Path,
    *,
    resumed: bool,
    say: Callable[[str], None],
    hurried: Callable[[], bool] = lambda: False,
) -> Sequence[Backend]:
    """The backend that `config` names, or none; it is opened in a thread of its own.

    Args:
      config: of the run.
      logdir: its folder.
      resumed: whether `metrics.jsonl` is that of an earlier part of the same run.
      say: prints a warning.
      hurried: whether the run was asked to end soon.
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
    """The run's own; a new remote run's for a first part, another tracker or project."""
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
