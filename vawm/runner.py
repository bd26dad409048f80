"""The host loop around the jitted step: logging, progress, checkpoints, signals.

Everything a run needs to continue bit for bit is in its checkpoint: the `TrainState`, and
the host's `Progress`, with the interval since the last line of metrics. A resumed run cuts
`metrics.jsonl` back to that line and goes on as if nothing had happened.
"""

from __future__ import annotations

import contextlib
import functools
import math
import pathlib
import time
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import jax
import rich.console

from vawm import checkpoint, envs, memory, rundir, signals, tracking, train, validate
from vawm import resume as resume_lib
from vawm.agent import make_agent
from vawm.config import Config
from vawm.display import Display
from vawm.envs.protocol import Environment
from vawm.tracking import Interval, Line
from vawm.types import PyTree


class RunError(RuntimeError):
    """A run had to stop; its last checkpoint is intact."""


class Progress(NamedTuple):
    """What the host knows of a run, in plain numbers.

    Attributes:
      env_steps: control steps so far.
      updates: updates so far.
      seconds: wall time so far, pauses between resumed parts left out.
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


class Start(NamedTuple):
    """What is known of a run before its first step; nothing is allocated yet."""

    env: Environment
    init: Callable[[jax.Array], PyTree]
    step: jax.stages.Wrapped  # (state) -> (state, metrics), donates
    shapes: PyTree


def run(
    config: Config,
    logdir: str | pathlib.Path,
    *,
    resume: bool = False,
    env: Environment | None = None,
    console: rich.console.Console | None = None,
    banner: str = "",
    command: str = "the same command",
) -> Result:
    """Trains until `config.env_steps`, or until a signal asks for the end.

    Args:
      config: all choices of the run.
      logdir: a folder that is empty or not there yet; of the run to resume otherwise.
      resume: continue from the newest checkpoint in `logdir`, or from the start where a
        run was stopped before its first.
      env: an environment in place of the one that `config.task` names.
      console: where progress goes; standard output by default.
      banner: printed once the run is known to start.
      command: how the caller was started, for the advice at the end.

    Raises:
      InvalidInput: before anything is compiled, allocated or written.
      RunError: a loss is not finite, memory ran out, or the disk is full.
      SaveError: a checkpoint could not be written.
    """
    logdir = pathlib.Path(logdir).expanduser()
    console = console or rich.console.Console()
    check(config, logdir, resume=resume, known_task=env is None)
    start = prepare(config, env)
    with _disk_explained(logdir), _out_of_memory_explained(), rundir.claim(logdir):
        if banner:
            console.print(banner, highlight=False, soft_wrap=True, markup=False)
        if resume and checkpoint.latest(logdir):
            state, progress = _continue(logdir, start)
            rundir.write_config(logdir, config)
        else:
            if resume:
                rundir.clear(logdir)
                text = f"no checkpoint in {logdir} yet: this run starts from the beginning"
                console.print(text, highlight=False, soft_wrap=True, markup=False)
            rundir.write_config(logdir, config)
            state, progress = start.init(jax.random.key(config.seed)), Progress()
        result = _loop(config, logdir, start, state, progress, console)
    _summarise(config, result, console, command)
    return result


def check(
    config: Config, logdir: pathlib.Path, *, resume: bool, known_task: bool = True
) -> None:
    """Refuses what cannot work; takes milliseconds and writes nothing.

    Raises:
      InvalidInput: names field, value and remedy.
    """
    if known_task:
        envs.check_task(config.task)
    validate.check(config)
    if resume:
        resume_lib.check(logdir, config)
        rundir.check_writable(logdir)
    else:
        rundir.check_new(logdir)


def prepare(config: Config, env: Environment | None = None) -> Start:
    """Builds the run's functions and refuses one that does not fit into memory.

    Raises:
      InvalidInput: with the numbers, and the largest replay that would fit.
    """
    if env is None:
        env = envs.make(
            config.task, num_envs=config.num_envs, action_repeat=config.action_repeat
        )
    agent = make_agent(config, env.spec)
    init = jax.jit(functools.partial(train.init, env, agent, config))
    shapes = init.eval_shape(jax.random.key(0))
    memory.check(
        memory.estimate(shapes, config),
        memory.available_bytes(),
        configured=config.replay.capacity,
        smallest=validate.smallest_replay(config),
    )
    step = jax.jit(train.make_train_step(env, agent, config), donate_argnums=0)
    return Start(env, init, step, shapes)


def _continue(logdir: pathlib.Path, start: Start) -> tuple[PyTree, Progress]:
    state, manifest = resume_lib.restore(logdir, start.shapes)
    saved = manifest.progress
    progress = Progress(**saved | {"interval": Interval(**saved["interval"])})
    tracking.truncate(logdir / "metrics.jsonl", progress.logged)
    return state, progress


def _loop(
    config: Config,
    logdir: pathlib.Path,
    start: Start,
    state: PyTree,
    progress: Progress,
    console: rich.console.Console,
) -> Result:
    """Chunk after chunk; the only place where the device and the host meet."""
    display = Display(console, start=progress.env_steps, total=config.env_steps)
    save = functools.partial(_save, logdir=logdir, config=config, spec=start.env.spec)
    last_saved = progress.env_steps
    purge_after = progress.logged if progress.env_steps else None
    with (
        signals.catch(lambda: display.note("stopping after this step ...")) as stop,
        tracking.Tracker(logdir, purge_after=purge_after) as tracker,
        display,
    ):
        display.note("compiling (takes a minute the first time, seconds from then on) ...")
        step = start.step.lower(state).compile()
        while progress.env_steps < config.env_steps and stop.signal is None:
            before, began = progress.env_steps, time.perf_counter()
            state, metrics = step(state)
            metrics = jax.device_get(metrics)
            progress = advance(progress, metrics, began=began)
            _stop_if_nonfinite(metrics, progress, tracker, last_saved)
            done = progress.env_steps >= config.env_steps
            if _crossed(before, progress.env_steps, config.log_every):
                line = _line(progress)
                tracker.write(line)
                display.log(line)
                progress = progress._replace(logged=progress.env_steps, interval=Interval())
            elif done:  # an incomplete interval, dropped again if the run is extended
                tracker.write(_line(progress))
            if done or stop.signal or _crossed(before, progress.env_steps, config.save_every):
                save(state, progress=progress)
                last_saved = progress.env_steps
            display.advance(progress.env_steps, progress.interval)
    return Result(logdir, progress.env_steps, stop.exit_code)


def advance(progress: Progress, metrics: Mapping[str, Any], *, began: float) -> Progress:
    """`progress` after one more chunk, which started at `began`."""
    seconds = time.perf_counter() - began
    env_steps = int(metrics["env_steps"])
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


def _save(state: PyTree, *, progress: Progress, **where: Any) -> None:
    plain = progress._asdict() | {"interval": progress.interval._asdict()}
    checkpoint.save(state=state, env_steps=progress.env_steps, progress=plain, **where)


def _stop_if_nonfinite(
    metrics: Mapping[str, Any], progress: Progress, tracker: tracking.Tracker, last_saved: int
) -> None:
    """A loss that is not finite never comes back: better no run than a wrong one."""
    if not int(metrics["chunk/updates"]):
        return
    for name, value in metrics.items():
        if name.startswith("loss/") and not math.isfinite(value):
            tracker.write(_line(progress))
            kept = f"the checkpoint at {last_saved}" if last_saved else "no checkpoint yet"
            raise RunError(
                f"{name} is {float(value)} at env_steps={progress.env_steps}; kept: {kept}. "
                "Start again with a smaller --optimizer.learning-rate or another --seed"
            )


@contextlib.contextmanager
def _out_of_memory_explained():
    try:
        yield
    except jax.errors.JaxRuntimeError as error:
        if "RESOURCE_EXHAUSTED" not in str(error):
            raise
        first = str(error).splitlines()[0][:200]
        remedy = "use a smaller replay.capacity, replay.batch_size or size"
        raise RunError(f"out of memory: {remedy} ({first})") from error


@contextlib.contextmanager
def _disk_explained(logdir: pathlib.Path):
    """What a run writes besides its checkpoints, which have a `SaveError` of their own."""
    try:
        yield
    except OSError as error:
        raise RunError(
            f"{error.filename or logdir}: {error.strerror or error}; "
            "put that right, then go on with --resume or start again"
        ) from error


def _summarise(
    config: Config, result: Result, console: rich.console.Console, command: str
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
    if finished:
        text.append(f"evaluate with: python -m vawm.evaluate --logdir {result.logdir}")
        longer = f"--env-steps {2 * config.env_steps}"
        text.append(f"go on with: {command} --resume --logdir {result.logdir} {longer}")
    else:
        text.append(f"resume with: {command} --resume --logdir {result.logdir}")
    console.print("\n".join(text), highlight=False, soft_wrap=True, markup=False)
