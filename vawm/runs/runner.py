"""The host loop around the jitted step: logging, progress, checkpoints, signals.

Everything a run needs to continue bit for bit is in its checkpoint: the `TrainState`, and
the host's `Progress`, with the interval since the last line of metrics. A resumed run cuts
`metrics.jsonl` back to that line and goes on as if nothing had happened.
"""

from __future__ import annotations

import contextlib
import errno
import functools
import pathlib
import shlex
import time
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, NoReturn

import jax
import rich.console

from vawm.config import Config
from vawm.envs.protocol import Environment, EnvironmentFailure, HostEnvironment
from vawm.errors import InvalidInput
from vawm.process import signals, streams
from vawm.runs import budget, checkpoint, diagnosis, run_folder, suites, validate
from vawm.runs import resume as resume_lib
from vawm.runs import trainer as program_lib
from vawm.runs.checkpoint import manifest as manifest_lib
from vawm.runs.reports import backends, tracking, video
from vawm.runs.reports.display import Display
from vawm.runs.reports.tracking import Interval, Line
from vawm.runs.trainer import Program
from vawm.types import PyTree


class RunError(RuntimeError):
    """A run had to stop; its last checkpoint is intact."""


class Progress(NamedTuple):
    """What the host knows of a run, in plain numbers.

    Attributes:
      env_steps: control steps so far.
      updates: updates so far.
      seconds: of all steps so far; what lines, videos and checkpoints took is not in it.
      logged: env steps at the last line of metrics.
      interval: measured since that line.
    """

    env_steps: int = 0
    updates: int = 0
    seconds: float = 0.0
    logged: int = 0
    interval: Interval = Interval()


class Result(NamedTuple):
    """How a run ended.

    Attributes:
      logdir: where everything is.
      env_steps: control steps done.
      exit_code: 0, or what a shell expects after the signal that stopped it.
    """

    logdir: pathlib.Path
    env_steps: int
    exit_code: int


@streams.outlive()
def run(
    config: Config,
    logdir: str | pathlib.Path,
    *,
    resume: bool = False,
    fresh: bool = False,
    env: Environment | HostEnvironment | None = None,
    console: rich.console.Console | None = None,
    banner: str = "",
    command: str = "the same command",
) -> Result:
    """Trains until `config.env_steps`, or until a signal asks for the end.

    Args:
      config: all choices of the run.
      logdir: a folder that is empty or not there yet; of the run to resume otherwise.
      resume: continue from the newest whole checkpoint in `logdir`, or from the start where
        a run was stopped before its first. Newer ones that are damaged are renamed.
      fresh: start over in `logdir`; what is there goes into a folder `replaced-<number>`.
      env: an environment in place of the one that `config.task` names; one on the host is
        closed at the end.
      console: where progress goes; standard output by default.
      banner: printed once the run is known to start.
      command: how the caller was started, for the advice at the end.

    Raises:
      InvalidInput: before anything is compiled, allocated or written.
      RunError: a loss or a parameter is not finite, an environment failed, memory ran out, or
        the disk is full.
      SaveError: a checkpoint could not be written.
    """
    logdir = pathlib.Path(logdir).expanduser()
    console = console or rich.console.Console()
    say = functools.partial(console.print, highlight=False, soft_wrap=True, markup=False)
    with contextlib.ExitStack() as stack:
        stack.enter_context(_explained(logdir))
        if not isinstance(env, Environment | None):
            stack.enter_context(contextlib.closing(env))
        check(config, logdir, resume=resume, fresh=fresh, known_task=env is None)
        program = stack.enter_context(contextlib.closing(prepare(config, env)))
        stack.enter_context(run_folder.claim(logdir, say=say))
        if banner:
            say(banner)
        if resume and checkpoint.latest(logdir):
            state, progress = _continue(logdir, program, say)
            run_folder.write_config(logdir, config)
        else:
            if fresh and (aside := run_folder.put_aside(logdir)):
                say(f"what was in {logdir} is in {aside} now: this run starts over")
            if resume:
                run_folder.clear(logdir)
                say(f"no checkpoint in {logdir} yet: this run starts from the beginning")
            run_folder.write_config(logdir, config)
            state, progress = program.init(config.seed), Progress()
            _refuse_nonfinite(state)
        result = _loop(config, logdir, program, state, progress, console)
    _summarise(config, result, say, command, known_task=env is None)
    return result


def _refuse_nonfinite(state: PyTree) -> None:
    """Refuses first observations that are not finite, which no chunk has counted."""
    if found := diagnosis.nonfinite_steps(state):
        raise RunError(f"{diagnosis.where(found[0])} where the run begins: mend that")


def check(
    config: Config,
    logdir: pathlib.Path,
    *,
    resume: bool,
    fresh: bool = False,
    known_task: bool = True,
) -> None:
    """Refuses what cannot work; takes milliseconds and writes nothing.

    Raises:
      InvalidInput: names field, value and remedy.
    """
    validate.check(config)
    if known_task:
        suites.check_task(config)
    if not resume:  # a run that was begun goes on without its tracker
        backends.check(config)
    if resume and fresh:
        raise InvalidInput("fresh", True, "starts over, and --resume goes on; leave one out")
    if resume:
        resume_lib.check(logdir, config)
        for folder in (logdir, checkpoint.root(logdir)):
            run_folder.check_writable(folder)
    elif fresh:
        run_folder.check_fresh(logdir)
    else:
        run_folder.check_new(logdir)


def prepare(
    config: Config,
    env: Environment | HostEnvironment | None = None,
    *,
    kept: program_lib.Kept = program_lib.everything,
) -> Program:
    """Builds the run's functions and refuses one that does not fit into memory.

    Metrics that are not `kept` are not computed either.

    Raises:
      InvalidInput: with the numbers, and the largest replay that would fit.
    """
    program = program_lib.make(config, env, kept=kept)
    try:
        budget.check(
            budget.estimate(program.shapes, program.spec, config),
            budget.available(),
            config,
            smallest=validate.smallest_replay(config),
        )
    except BaseException:
        program.close()
        raise
    return program


def _continue(
    logdir: pathlib.Path, program: Program, say: Callable[[str], None]
) -> tuple[PyTree, Progress]:
    restored = resume_lib.restore(logdir, program.shapes)
    if restored.warning:
        say(f"WARNING: {restored.warning}")
    then, now = restored.manifest.computed, manifest_lib.computed()
    if then != now:
        say(f"WARNING: begun with {then}, goes on with {now}: not bit for bit one piece")
    state, lost = program.resume(restored.state, restored.episodes)
    if lost:
        say(
            f"warning: {lost} of {program.spec.num_envs} environments did not do the same "
            "again when their episodes were played once more; they begin new ones"
        )
    progress = _progress(restored.manifest.progress)
    missing = resume_lib.cut_back(logdir, env_steps=progress.env_steps, logged=progress.logged)
    if missing:
        say(f"WARNING: {missing}")
    say(f"going on at {progress.env_steps} env steps")
    return state, progress


def _progress(saved: dict[str, Any]) -> Progress:
    """What `Saver` was given.

    Raises:
      InvalidInput: it was written with other counters.
    """
    try:
        progress = Progress(**saved | {"interval": Interval(**saved["interval"])})
        for read, usual in ((progress, Progress()), (progress.interval, Interval())):
            for name, value, like in zip(usual._fields, read, usual, strict=True):
                if type(value) is not type(like):
                    raise TypeError(f"{name} is {value!r:.40}")
        return progress
    except (TypeError, KeyError) as error:
        remedy = f"does not have the counters of a run ({error}); it is of another version"
        raise InvalidInput("checkpoint", "progress", remedy) from error


def _loop(
    config: Config,
    logdir: pathlib.Path,
    program: Program,
    state: PyTree,
    progress: Progress,
    console: rich.console.Console,
) -> Result:
    """Chunk after chunk; the only place where the device and the host meet."""
    display = Display(console, start=progress.env_steps, total=config.env_steps)
    film = video.make(program, config)
    log_save = functools.partial(_append, logdir / tracking.SAVE_LINES)
    last_saved = progress.env_steps
    resumed = bool(progress.env_steps)
    with (
        signals.catch(lambda: display.note("stopping after this step ...")) as stop,
        tracking.Tracker(
            logdir,
            purge_after=progress.logged if resumed else None,
            further=backends.connect(
                config,
                logdir,
                resumed=resumed,
                say=display.note,
                hurried=lambda: stop.signal is not None,
            ),
            say=display.note,
        ) as tracker,
        display,
        checkpoint.Saver(
            logdir,
            config,
            program.spec,
            before=logdir / tracking.METRICS,
            log=log_save,
            say=display.note,
        ) as saver,
    ):
        tracker.show_videos(after=progress.logged)
        display.note("compiling (a minute for new settings, seconds for those of before) ...")
        step = program.compile(state).run
        last = progress.env_steps >= config.env_steps or stop.signal is not None
        while not last:
            before, began = progress.env_steps, time.perf_counter()
            state, metrics = step(state)
            metrics = jax.device_get(metrics)
            progress = advance(progress, metrics, began=began)
            done = progress.env_steps >= config.env_steps
            last = done or stop.signal is not None  # read once: what ends a run is saved
            if reason := diagnosis.reason(state, metrics, last=last):
                _stop(reason, config, logdir, state, metrics, progress, tracker, saver)
            saver.check()  # after that, which says more than a save that fails for it
            if _crossed(before, progress.env_steps, config.log_every):
                line = _line(progress)
                tracker.write(line)
                display.log(line)
                progress = progress._replace(logged=progress.env_steps, interval=Interval())
            elif done:  # an incomplete interval, dropped again if the run is extended
                tracker.write(_line(progress))
            if film and _crossed(before, progress.env_steps, config.video.every):
                tracker.write_videos(film(state), env_steps=progress.env_steps)
            due = last or saver.is_time()
            due = due or _crossed(before, progress.env_steps, config.save_every)
            if due and progress.env_steps > last_saved:
                saver.save(
                    state,
                    env_steps=progress.env_steps,
                    progress=progress._asdict() | {"interval": progress.interval._asdict()},
                    episodes=program.episodes(),
                )
                last_saved = progress.env_steps
            display.advance(progress.env_steps, progress.interval)
    return Result(logdir, progress.env_steps, stop.exit_code)


def advance(progress: Progress, metrics: Mapping[str, Any], *, began: float) -> Progress:
    """`progress` after one more chunk, which started at `began`.

    Raises:
      RunError: the chunk was a step backwards.
    """
    seconds = time.perf_counter() - began
    env_steps = int(metrics["env_steps"])
    if env_steps < progress.env_steps:  # as many where all environments were reset
        raise RunError(f"env_steps went from {progress.env_steps} back to {env_steps}")
    return Progress(
        env_steps=env_steps,
        updates=int(metrics["updates"]),
        seconds=progress.seconds + seconds,
        logged=progress.logged,
        interval=tracking.add(
            progress.interval,
            metrics,
            env_steps=env_steps - progress.env_steps,
            seconds=seconds,
        ),
    )


def _crossed(before: int, now: int, every: int) -> bool:
    return before // every < now // every


def _line(progress: Progress) -> Line:
    return tracking.line(
        progress.interval,
        env_steps=progress.env_steps,
        updates=progress.updates,
        seconds=progress.seconds,
    )


def _append(path: pathlib.Path, line: Line) -> None:
    with path.open("a") as file:
        file.write(tracking.as_json(line) + "\n")


def _stop(
    reason: str,
    config: Config,
    logdir: pathlib.Path,
    state: PyTree,
    metrics: Mapping[str, Any],
    progress: Progress,
    tracker: tracking.Tracker,
    saver: checkpoint.Saver,
) -> NoReturn:
    """What is not finite never comes back: better no run than a wrong one."""
    tracker.write(_line(progress))
    written = diagnosis.write(logdir, config, state, metrics)
    with contextlib.suppress(checkpoint.SaveError, OSError):  # not the reason
        saver.wait()
    raise RunError(
        f"{reason} at env_steps={progress.env_steps}; "
        f"kept: {checkpoint.kept(logdir)}; more in {written}. "
        f"{diagnosis.advice(state)}"
    )


@contextlib.contextmanager
def _explained(logdir: pathlib.Path):
    """One line for what ends a run from outside: memory, an environment, the disk.

    Checkpoints have a `SaveError` of their own.
    """
    try:
        yield
    except jax.errors.JaxRuntimeError as error:
        if "RESOURCE_EXHAUSTED" not in str(error):
            raise
        first = str(error).splitlines()[0][:200]
        remedy = "use a smaller replay.capacity, replay.batch_size or size"
        raise RunError(f"out of memory: {remedy} ({first})") from error
    except MemoryError as error:
        remedy = "use a smaller replay.capacity or batch, or a machine with more memory"
        raise RunError(f"out of memory on the host: {remedy} ({error})") from error
    except EnvironmentFailure as error:
        remedy = "to begin a new episode instead, start with --env.on-failure restart"
        raise RunError(f"{error}; kept: {checkpoint.kept(logdir)}; {remedy}") from error
    except OSError as error:
        full = error.errno == errno.ENOSPC
        free = f" ({checkpoint.free_space(logdir)} free)" if full else ""
        raise RunError(
            f"{error.filename or logdir}: {error.strerror or error}{free}; "
            "put that right, then go on with --resume or start again"
        ) from error


def _summarise(
    config: Config,
    result: Result,
    say: Callable[[str], None],
    command: str,
    *,
    known_task: bool,
) -> None:
    lines = tracking.read(result.logdir / "metrics.jsonl")
    returns = [e["episode/return"] for e in lines if e.get("episode/return") is not None]
    shown = f"last {returns[-1]:.1f}, best {max(returns):.1f}" if returns else "none finished"
    finished = result.env_steps >= config.env_steps
    saved = "checkpoints" if checkpoint.latest(result.logdir) else "no checkpoint yet"
    text = [
        f"{'finished' if finished else 'stopped'} at {result.env_steps} env steps",
        f"episode return: {shown}",
        f"metrics, TensorBoard events and {saved}: {result.logdir}",
    ]
    evaluation = f"python -m vawm.evaluate --logdir {shlex.quote(str(result.logdir))}"
    resumption = f"{command} --resume --logdir {shlex.quote(str(result.logdir))}"
    longer = f" --env-steps {2 * config.env_steps}"
    if not known_task:  # no command line makes its environment
        folder = repr(str(result.logdir))
        evaluation = f"vawm.evaluate.evaluate(vawm.load({folder}), episodes=..., env=...)"
        resumption = f"vawm.runs.runner.run(config, {folder}, env=..., resume=True)"
        longer = ", its env_steps larger"
    if finished:
        text += [f"evaluate with: {evaluation}", f"go on with: {resumption}{longer}"]
    else:
        text.append(f"resume with: {resumption}")
    say("\n".join(text))
