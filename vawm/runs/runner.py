"""The host loop around the jitted step: logging, progress, checkpoints, signals.

A checkpoint has everything that a run needs to continue bit for bit: the `TrainState`, and the
host's `Progress` with the interval since the last line of metrics. A resumed run cuts
`metrics.jsonl` back to that line and continues from there.
"""

from __future__ import annotations

import contextlib
import errno
import functools
import pathlib
import signal
import sys
import time
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, NoReturn

import jax
import rich.console

from vawm.agent import Agent, registry
from vawm.config import Config
from vawm.envs import made
from vawm.envs.protocol import (
    Environment,
    EnvironmentFailure,
    HostEnvironment,
    check_environment,
)
from vawm.errors import InvalidInput, assignment
from vawm.learning.state import Learner
from vawm.process import names, signals, streams
from vawm.runs import budget, checkpoint, diagnosis, run_folder, settings, suites, validate
from vawm.runs.checkpoint import manifest
from vawm.runs.reports import backends, film, header, tracking, video
from vawm.runs.reports.display import Display, Mode
from vawm.runs.reports.pace import Pace, Totals
from vawm.runs.reports.tracking import Interval, Line
from vawm.runs.resume import check as check_resume
from vawm.runs.resume import check_environments, cut_back, restore, saved_made, saved_spec
from vawm.runs.trainer import Kept, Trainer, everything
from vawm.runs.trainer import make as make_trainer
from vawm.types import PyTree


class RunError(RuntimeError):
    """A run had to stop; its last checkpoint is intact.

    Attributes:
      settings: choices of the config that the message names, see `errors.assignment`.
    """

    def __init__(self, message: str, **settings: Any):
        super().__init__(message)
        self.settings = settings


class Progress(NamedTuple):
    """The counters of the host loop, as plain numbers.

    Attributes:
      env_steps: control steps so far.
      updates: updates so far.
      seconds: of all steps so far, without the time for lines, videos and checkpoints.
      logged: env steps at the last line of metrics.
      interval: measured since that line.
    """

    env_steps: int = 0
    updates: int = 0
    seconds: float = 0.0
    logged: int = 0
    interval: Interval = Interval()

    @property
    def totals(self) -> Totals:
        return Totals(self.env_steps, self.updates, self.seconds)


class Result(NamedTuple):
    """How a run ended.

    Attributes:
      logdir: the folder of the run.
      env_steps: control steps done.
      exit_code: 0, or the shell's exit code for the signal that asked the run to stop.
    """

    logdir: pathlib.Path
    env_steps: int
    exit_code: int

    @property
    def stopped_by(self) -> signal.Signals | None:
        """The signal that asked the run to stop, such as SIGTERM; None without one.

        A script that trains several runs has to end then: `if result.stopped_by: break`.
        """
        return signal.Signals(self.exit_code - 128) if self.exit_code else None


@streams.outlive()
def run(
    config: Config,
    logdir: str | pathlib.Path,
    *,
    resume: bool = False,
    fresh: bool = False,
    env: Environment | HostEnvironment | None = None,
    console: rich.console.Console | None = None,
    display: Mode = "auto",
    film_policy: bool = False,
    banner: str = "",
    command: str = "the same command",
) -> Result:
    """Trains until `config.env_steps`, or until a signal asks to stop.

    Args:
      config: all choices of the run.
      logdir: a new or empty folder; with `resume`, the folder of the run.
      resume: continue from the newest undamaged checkpoint in `logdir`, or from the start if
        the run stopped before its first one. Renames newer checkpoints, which are damaged.
      fresh: start over in `logdir`; moves its content to a folder `replaced-<number>`.
      env: replaces the environment that `config.task` names, or that the resumed run was
        trained in; a host environment is closed at the end.
      console: prints progress; standard output by default.
      display: a bar, a line per line of metrics (plain), or warnings alone (quiet); auto: a
        bar if `console` is a terminal, else plain.
      film_policy: whether a run that reaches its end makes a short film of its policy.
      banner: what the run is, printed below its folder when all checks are done; some of the
        config if empty.
      command: the caller's command line, for the advice at the end.

    Raises:
      InvalidInput: before anything is compiled, allocated or written.
      RunError: a loss or a parameter is not finite, an environment failed, memory ran out, or
        the disk is full.
      SaveError: a checkpoint could not be written.
    """
    logdir = checkpoint.expanded(logdir)
    shown = Display(console, mode=display)
    if env is not None:
        check_environment(env)
    with contextlib.ExitStack() as stack:
        stack.enter_context(_explained(logdir, known_task=env is None))
        if not isinstance(env, Environment | None):
            stack.enter_context(contextlib.closing(env))
        by_command = env is None
        check(config, logdir, resume=resume, fresh=fresh, known_task=by_command)
        if env is None and resume:
            env = _made_again(config, logdir)
        trainer = stack.enter_context(contextlib.closing(prepare(config, env)))
        differences = check_environments(logdir, trainer.spec) if resume else []
        warnings = [f"WARNING: {difference}" for difference in differences]
        stack.enter_context(run_folder.claim(logdir, say=warnings.append))
        stack.enter_context(shown)
        shown.note(f"logdir: {names.shown(logdir)}")
        shown.head(banner or header.text(config, trainer.spec.task))
        for warning in warnings:
            shown.warn(warning)
        for notice in trainer.notices:
            shown.note(f"note: {notice}")
        if resume and checkpoint.latest(logdir):
            state, progress = _continue(logdir, trainer, shown)
            run_folder.write_config(logdir, config, trainer.spec.made)
        else:
            if fresh and (aside := run_folder.put_aside(logdir)):
                old, new = names.shown(logdir), names.shown(aside)
                shown.note(f"starting over; moved the old content of {old} to {new}")
            if resume:
                run_folder.clear(logdir)
                folder = names.shown(logdir)
                shown.note(f"no checkpoint in {folder} yet; starting from the beginning")
            run_folder.write_config(logdir, config, trainer.spec.made)
            with shown.busy("preparing"):
                state, progress = trainer.init(config.seed), Progress()
            _refuse_nonfinite(state)
        result = _loop(config, logdir, trainer, state, progress, shown, film_policy=film_policy)
    known = trainer.spec.made is not None and made.can_be_made_again(trainer.spec.made)
    again = by_command or known
    _summarise(config, result, shown.note, command, by_command=by_command, again=again)
    return result


def _made_again(config: Config, logdir: pathlib.Path) -> Environment | HostEnvironment:
    """The environments of the run in `logdir`, as its record says."""
    spec = saved_spec(logdir)
    task = config.task if spec is None else spec.task
    return suites.make_again(config, saved_made(logdir), task=task, python=_in_python(logdir))


def _check_made_again(config: Config, logdir: pathlib.Path) -> None:
    """Refuses a run whose environments only its caller can make."""
    record = saved_made(logdir)
    suites.check_made(record, python=_in_python(logdir))
    if record is None:
        suites.check_task(config)


def _in_python(logdir: pathlib.Path) -> str:
    """The statements that resume the run in `logdir` in environments of the caller's."""
    folder = repr(str(logdir))
    return (
        f"config = vawm.runs.resume.saved_config({folder}); "
        f"vawm.runs.runner.run(config, {folder}, resume=True, env=...)"
    )


def _refuse_nonfinite(state: PyTree) -> None:
    """Refuses first observations that are not finite: no chunk counts them."""
    if found := diagnosis.nonfinite_steps(state):
        raise RunError(f"{diagnosis.where(found[0])} at the first reset; fix the environment")


def check(
    config: Config,
    logdir: pathlib.Path,
    *,
    resume: bool,
    fresh: bool = False,
    known_task: bool = True,
) -> None:
    """Refuses a run that cannot work; compiles nothing and writes nothing.

    Raises:
      InvalidInput: names field, value and remedy.
    """
    settings.check_training()
    if known_task and not resume:  # a wrong name first: numbers depend on what it stands for
        validate.check_task(config)
    validate.check(config)
    logdir = checkpoint.expanded(logdir)
    if not resume:  # a resumed run continues even without its tracker
        backends.check(config)
    if resume and fresh:
        raise InvalidInput(
            "fresh", True, "cannot be combined with --resume; remove one of them"
        )
    if resume:
        check_resume(logdir, config)
        if known_task:
            _check_made_again(config, logdir)
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
    kept: Kept = everything,
) -> Trainer:
    """Builds the trainer of a run; refuses a run that does not fit into memory.

    Metrics that are not `kept` are not computed.

    Raises:
      InvalidInput: too little memory; names the numbers and the largest replay that fits.
    """
    trainer = make_trainer(config, env, kept=kept)
    try:
        budget.check(
            budget.estimate(trainer.shapes, trainer.spec, config),
            budget.available(),
            config,
            smallest=validate.smallest_replay(config),
        )
    except BaseException:
        trainer.close()
        raise
    return trainer


def _continue(
    logdir: pathlib.Path, trainer: Trainer, display: Display
) -> tuple[PyTree, Progress]:
    with display.busy("reading the checkpoint"):
        restored = restore(logdir, trainer.shapes)
    if restored.warning:
        display.warn(f"WARNING: {restored.warning}")
    then, now = restored.manifest.computed, manifest.computed()
    if then != now:
        text = f"started with {then}, resuming with {now}: results may not be bit-identical"
        display.warn(f"WARNING: {text}")
    state, lost = trainer.resume(restored.state, restored.episodes)
    if lost:
        display.warn(
            f"warning: the episodes of {lost} of {trainer.spec.num_envs} environments could "
            "not be replayed exactly; starting new episodes"
        )
    progress = _progress(restored.manifest.progress)
    missing = cut_back(logdir, env_steps=progress.env_steps, logged=progress.logged)
    if missing:
        display.warn(f"WARNING: {missing}")
    display.note(f"resuming at {progress.env_steps} env steps")
    return state, progress


def _progress(saved: dict[str, Any]) -> Progress:
    """The `Progress` that was saved in a checkpoint.

    Raises:
      InvalidInput: it has other counters, because another version wrote it.
    """
    try:
        progress = Progress(**saved | {"interval": Interval(**saved["interval"])})
        for read, usual in ((progress, Progress()), (progress.interval, Interval())):
            for name, value, like in zip(usual._fields, read, usual, strict=True):
                if type(value) is not type(like):
                    raise TypeError(f"{name} is {value!r:.40}")
        return progress
    except (TypeError, KeyError) as error:
        remedy = f"has wrong counters ({error}); resume with the version that wrote it"
        raise InvalidInput("checkpoint", "progress", remedy) from error


def _loop(
    config: Config,
    logdir: pathlib.Path,
    trainer: Trainer,
    state: PyTree,
    progress: Progress,
    display: Display,
    *,
    film_policy: bool,
) -> Result:
    """Runs chunk after chunk; the only place where the host waits for the device."""
    film_replay = video.make(trainer, config)
    log_save = functools.partial(_append, logdir / tracking.SAVE_LINES)
    last_saved = progress.env_steps
    resumed = bool(progress.env_steps)
    with (
        signals.catch(display.stopping, at_end=display.release) as stop,
        tracking.Tracker(
            logdir,
            purge_after=progress.logged if resumed else None,
            further=backends.connect(
                config,
                logdir,
                resumed=resumed,
                say=display.warn,
                hurried=lambda: stop.signal is not None,
            ),
            say=display.warn,
            choices=dict(validate.values(config)),
        ) as tracker,
        checkpoint.Saver(
            logdir,
            config,
            trainer.spec,
            before=logdir / tracking.METRICS,
            log=log_save,
            say=display.warn,
        ) as saver,
    ):
        tracker.show_videos(after=progress.logged)
        with display.busy("compiling", done="compiled", hint="a minute, seconds if cached"):
            step = trainer.compile(state).run
        last = progress.env_steps >= config.env_steps or stop.signal is not None
        if not last:
            display.begin(
                progress.totals,
                total=config.env_steps,
                pace=Pace(_updates_per_env_step(config), progress.totals),
                lines=tracking.read(logdir / tracking.METRICS) if resumed else [],
            )
        while not last:
            before, began = progress.env_steps, time.perf_counter()
            state, metrics = step(state)
            metrics = jax.device_get(metrics)
            progress = advance(progress, metrics, began=began)
            display.advance(progress.totals, progress.interval)
            done = progress.env_steps >= config.env_steps
            last = done or stop.signal is not None  # read once, so that the last step is saved
            if reason := diagnosis.reason(state, metrics, last=last):
                _stop(reason, config, logdir, state, metrics, progress, tracker, saver)
            saver.check()  # after `_stop`: its error says more than a failed save
            if _crossed(before, progress.env_steps, config.log_every):
                line = _line(progress)
                tracker.write(line)
                display.log(line)
                progress = progress._replace(logged=progress.env_steps, interval=Interval())
            elif done:  # an incomplete interval; its line is dropped if the run is extended
                tracker.write(_line(progress))
            if film_replay and _crossed(before, progress.env_steps, config.video.every):
                tracker.write_videos(film_replay(state), env_steps=progress.env_steps)
            due = last or saver.is_time()
            due = due or _crossed(before, progress.env_steps, config.save_every)
            if due and progress.env_steps > last_saved:
                saver.save(
                    state,
                    env_steps=progress.env_steps,
                    progress=progress._asdict() | {"interval": progress.interval._asdict()},
                    episodes=trainer.episodes(),
                )
                last_saved = progress.env_steps
        if film_policy and stop.signal is None:
            films = _film(config, trainer.agent, state.learner, display)
            tracker.write_videos(films, env_steps=progress.env_steps)
    return Result(logdir, progress.env_steps, stop.exit_code)


def advance(progress: Progress, metrics: Mapping[str, Any], *, began: float) -> Progress:
    """`progress` after one more chunk, which started at `began`.

    Raises:
      RunError: `env_steps` decreased.
    """
    seconds = time.perf_counter() - began
    env_steps = int(metrics["env_steps"])
    if env_steps < progress.env_steps:  # equal if the chunk reset all environments
        raise RunError(f"env_steps decreased from {progress.env_steps} to {env_steps}")
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


def _film(
    config: Config, agent: Agent, learner: Learner, display: Display
) -> list[video.Video]:
    """A film of the policy; none where it cannot be made, which must not fail a whole run."""
    try:
        with display.busy("filming the policy"):
            return [film.of_run(config, agent, learner)]
    except Exception as error:
        reason = (str(error).strip() or repr(error)).splitlines()[0]
        display.note(f"no film of the policy: {reason}")
        return []


def _updates_per_env_step(config: Config) -> float:
    """While the run learns."""
    return config.train_ratio / config.replay.batch_steps / config.action_repeat


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
    """Stops the run with a diagnosis: NaN and infinity do not recover."""
    tracker.write(_line(progress))
    written = diagnosis.write(logdir, config, state, metrics)
    with contextlib.suppress(checkpoint.SaveError, OSError):  # report `reason` instead
        saver.wait()
    raise RunError(
        f"{reason} at env_steps={progress.env_steps}; "
        f"kept: {checkpoint.kept(logdir)}; details in {names.shown(written)}. "
        f"{diagnosis.advice(state, config)}"
    )


@contextlib.contextmanager
def _explained(logdir: pathlib.Path, *, known_task: bool):
    """Turns errors of memory, environments and the disk into a `RunError` with one line.

    A checkpoint that cannot be written raises `SaveError`.
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
        settings = {"env.on_failure" if known_task else "on_failure": "restart"}
        remedy = " ".join(assignment(*setting) for setting in settings.items())
        remedy = f"to start a new episode instead, use {remedy}"
        if not known_task:
            remedy += " where you make the environments"
        text = f"{error}; kept: {checkpoint.kept(logdir)}; {remedy}"
        raise RunError(text, **settings) from error
    except OSError as error:
        full = error.errno == errno.ENOSPC
        free = f" ({checkpoint.free_space(logdir)} free)" if full else ""
        raise RunError(
            f"{names.shown(str(error.filename or logdir))}: {error.strerror or error}{free}; "
            "fix the cause, then continue with --resume or start again"
        ) from error


def _summarise(
    config: Config,
    result: Result,
    say: Callable[[str], None],
    command: str,
    *,
    by_command: bool,
    again: bool,
) -> None:
    """Says what came out and how to go on.

    Args:
      config: of the run.
      result: of the run.
      say: prints a line.
      command: that trained it, if it is `by_command` and not a script of the caller's.
      by_command: whether the run made its environments itself.
      again: whether commands can make the environments again.
    """
    lines = tracking.read(result.logdir / "metrics.jsonl")
    returns = [e["episode/return"] for e in lines if e.get("episode/return") is not None]
    shown = f"last {returns[-1]:.1f}, best {max(returns):.1f}" if returns else "none finished"
    finished = result.env_steps >= config.env_steps
    saved = "checkpoints" if checkpoint.latest(result.logdir) else "no checkpoint yet"
    text = [
        f"{'finished' if finished else 'stopped'} at {result.env_steps} env steps",
        f"episode return: {shown}",
        f"metrics, TensorBoard events and {saved}: {names.shown(result.logdir)}",
    ]
    where = names.flag("logdir", result.logdir)
    evaluation, resumption = f"python -m vawm.evaluate {where}", f"{command} --resume {where}"
    if plugin := registry.plugin_of(config.agent):
        words = " " + names.flag("plugin", plugin)
        evaluation += words
        resumption += (
            "" if pathlib.Path(sys.argv[0]).name == pathlib.Path(plugin).name else words
        )
    longer = f" --env-steps {2 * config.env_steps}"
    folder = repr(str(result.logdir))
    if not again:  # there is no command line for the user's environment
        evaluation = f"vawm.evaluate.evaluate(vawm.load({folder}), episodes=..., env=...)"
    if not by_command:
        resumption = f"vawm.runs.runner.run(config, {folder}, env=..., resume=True)"
        longer = ", with larger config.env_steps"
    if finished:
        text += [f"evaluate with: {evaluation}", f"train longer with: {resumption}{longer}"]
    else:
        text.append(f"resume with: {resumption}")
    say("\n".join(text))
