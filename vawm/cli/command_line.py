"""The command line of experiments: tyro over `Config`, two phases, one line per error.

`--agent`, `--preset` and `--size` choose the defaults, or `--resume` takes those of the saved
run; every other flag then overrides one field of `Config`. Two fields follow from others: a new
run of a small preset gets a warm-up for its length, and one with widths of its own is of size
custom.
"""

from __future__ import annotations

import argparse
import dataclasses
import datetime
import pathlib
import sys
from collections.abc import Callable, Mapping, Sequence
from typing import Annotated, NamedTuple

import tyro

from vawm.agent import registry
from vawm.cli import flags
from vawm.config import CUSTOM, AgentName, Config
from vawm.envs.protocol import EnvironmentFailure
from vawm.errors import InvalidInput
from vawm.process import cache, names, streams
from vawm.runs import resume, runner, suites, validate
from vawm.runs.checkpoint import SaveError
from vawm.runs.reports.display import Mode
from vawm.runs.runner import RunError

FIRST = (
    "--task",
    "--agent",
    "--preset",
    "--size",
    "--seed",
    "--env-steps",
    "--num-envs",
    "--logdir",
    "--resume",
    "--value-alignment.weight",
)
"""The flags that matter most, in the order of the help."""


class Arguments(NamedTuple):
    """What a command line says."""

    config: Config
    logdir: pathlib.Path
    resume: bool
    fresh: bool = False
    display: Mode = "auto"
    film: bool = True


@dataclasses.dataclass(frozen=True)
class Flags:
    """What tyro reads: the fields of `Config`, and these."""

    config: Annotated[Config, tyro.conf.arg(name="")]
    logdir: pathlib.Path | None = None
    """folder of the run; `runs/<suite>/<task>/<preset>-seed<seed>-<time>` if not given"""
    resume: bool = False
    """continue the run in --logdir, with its own settings as defaults"""
    fresh: bool = False
    """start over in --logdir; what is there is moved into a folder replaced-1, -2 ... in it"""
    display: Mode = "auto"
    """a bar, plain lines for a log, or quiet: warnings alone; auto: a bar on a terminal, else
    plain"""
    film: bool = True
    """at the end of the run, film its policy for ten seconds, where a renderer works"""


def train(
    argv: Sequence[str] | None,
    *,
    suite: str,
    description: str | None = None,
    agent: AgentName = "dreamerv3",
    task: str | None = None,
    command: str | None = None,
) -> int:
    """Reads a command line, as `parse` does, and trains; returns the exit code."""
    arguments = parse(
        argv, suite=suite, description=description, agent=agent, task=task, command=command
    )
    config, logdir = arguments.config, arguments.logdir
    runner.check(config, logdir, resume=arguments.resume, fresh=arguments.fresh)
    cache.enable()
    result = runner.run(
        config,
        logdir,
        resume=arguments.resume,
        fresh=arguments.fresh,
        display=arguments.display,
        film_policy=arguments.film,
        banner=describe(config),
        command=command or f"python {names.quoted(pathlib.Path(sys.argv[0]))}",
    )
    return result.exit_code


def parse(
    argv: Sequence[str] | None,
    *,
    suite: str,
    description: str | None = None,
    agent: AgentName = "dreamerv3",
    preset: str = "quick",
    task: str | None = None,
    command: str | None = None,
) -> Arguments:
    """Reads `argv` (of the process if None).

    Args:
      argv: the words after the program's name.
      suite: whose presets there are to choose from.
      description: for the help; as the suite's record says if None.
      agent: the default one.
      preset: the default one.
      task: the default one; that of the preset if None.
      command: what the user has typed before `argv`, for the help.

    Raises:
      InvalidInput: an unknown preset, size or flag, a wrong type, nothing to resume, or a
        run of another suite.
      SystemExit: help was asked for (0).
    """
    argv = flags.load_plugins(list(sys.argv[1:] if argv is None else argv))
    argv = [_without_alias(word, suites.SUITES[suite].aliases) for word in argv]
    default = Flags(_defaults(argv, suite, agent, preset, task))
    if description is None:
        description = describe_suite(suite, command or "")
    told = f"{description.rstrip()}\n\n{_first_flags(default)}" if _asks_help(argv) else ""
    given = flags.read(Flags, argv, default=default, description=told, prog=command)
    if given.fresh and given.logdir is None:
        raise InvalidInput("logdir", None, "--fresh needs the --logdir to start over in")
    config = _with_its_size(given.config)
    if config.suite != suite:
        remedy = f"this program runs suite {suite}; use the one of that suite"
        raise InvalidInput("suite", config.suite, remedy)
    logdir = given.logdir or default_logdir(config)
    return Arguments(config, logdir, given.resume, given.fresh, given.display, given.film)


def describe_suite(suite: str, command: str) -> str:
    """The help of the program of a suite: what it trains on, with examples."""
    record = suites.SUITES[suite]
    agents = ", ".join(registry.names())
    lines = [f"Train an agent ({agents}) on {record.title}.", ""]
    width = max(map(len, record.examples), default=0)
    for words, what in record.examples.items():
        lines.append(f"    {command} {words:{width}}  # {what}")
    lines += ["", *([record.notes, ""] if record.notes else [])]
    return "\n".join([*lines, "Every choice is a flag."])


def _first_flags(default: Flags) -> str:
    """The part of the help with the flags that matter most."""
    said = flags.sentences(Flags, default)
    width = max(map(len, FIRST))
    lines = [f"    {flag:{width}}  {said[flag].partition(';')[0]}" for flag in FIRST]
    return "\n".join(["The flags that matter most:", "", *lines])


def _asks_help(argv: Sequence[str]) -> bool:
    return not {"-h", "--help"}.isdisjoint(argv)


def _without_alias(word: str, aliases: Mapping[str, str]) -> str:
    """`--game` or `--game=breakout` as `--task` or `--task=breakout`."""
    flag, equals, value = word.partition("=")
    return aliases.get(flag, flag) + equals + value


def _defaults(
    argv: list[str], suite: str, agent: AgentName, preset: str, task: str | None
) -> Config:
    """First phase: the config that the flags of the second override."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    parser.add_argument("--task", nargs="?")
    parser.add_argument("--agent", nargs="?")
    parser.add_argument("--preset", nargs="?")
    parser.add_argument("--size", nargs="?")
    parser.add_argument("--env-steps", "--env_steps", nargs="?")
    parser.add_argument("--logdir", nargs="?")
    parser.add_argument("--resume", action=argparse.BooleanOptionalAction)
    try:
        known, _ = parser.parse_known_args(argv)
    except argparse.ArgumentError:  # --resume=value
        raise InvalidInput("--resume", True, "takes no value; write --resume alone") from None
    if not known.resume or _asks_help(argv):
        if known.task is not None and not _asks_help(argv):
            suites.SUITES[suite].check_task(known.task)  # before any number
        size = None if known.size == CUSTOM else known.size
        chosen = known.agent or agent
        config = validate.preset(chosen, suite, known.preset or preset, size)
        config = dataclasses.replace(config, task=task or config.task)
        return _with_its_warmup(config, known.env_steps)
    if known.logdir is None:
        raise InvalidInput("logdir", None, "--resume needs the --logdir of the run")
    saved = resume.saved_config(known.logdir)
    if known.agent not in (None, saved.agent):  # whose choices are others: refused here
        validate.check_choice("agent", known.agent, registry.names())
        resume.check(known.logdir, dataclasses.replace(saved, agent=known.agent))
    if known.size not in (None, saved.size, CUSTOM):
        validate.check_choice("size", known.size, registry.kind(saved.agent).sizes)
        return registry.with_size(saved, known.size)
    return saved


def _with_its_warmup(config: Config, env_steps: str | None) -> Config:
    """`config`; of a small preset, with the warm-up for a run of the length that was given."""
    try:
        length = int(flags.whole(env_steps or ""))
    except ValueError:  # none, or one that the second phase refuses
        return config
    if not is_small(config):
        return config
    warmup = scaled_warmup(config, length)
    alignment = dataclasses.replace(config.value_alignment, warmup_steps=warmup)
    return dataclasses.replace(config, value_alignment=alignment)


def is_small(config: Config) -> bool:
    """Whether this run is of a preset for a CPU: any but that of the paper."""
    return config.preset != "paper" and config.preset in registry.presets_of(config)


def scaled_warmup(config: Config, env_steps: int) -> int:
    """The warm-up of a small preset, in env steps, for another length: the same share."""
    usual = registry.presets_of(config)[config.preset]
    return usual.value_alignment.warmup_steps * env_steps // usual.env_steps


def _with_its_size(config: Config) -> Config:
    """`config`; of size custom where a width is not the one of its size."""
    size = config.size
    sizes = registry.kind(config.agent).sizes
    if size not in sizes or config == registry.with_size(config, size):
        return config
    return dataclasses.replace(config, size=CUSTOM)


def default_logdir(config: Config) -> pathlib.Path:
    """A folder of its own for each run."""
    now = datetime.datetime.now().strftime("%Y%m%d-%H%M%S")
    name = f"{config.preset}-seed{config.seed}-{now}"
    return pathlib.Path("runs") / config.suite / config.task.replace("/", "-") / name


def describe(config: Config) -> str:
    """What the chosen preset is for, in a few lines."""
    head = (
        f"{config.agent}, preset {config.preset}: {config.suite} {config.task}, "
        f"{config.env_steps:,} env steps, size {config.size}, seed {config.seed}"
    )
    alignment, paper = _describe_alignment(config), registry.presets_of(config).get("paper")
    if not is_small(config):
        return f"{head}\nvalue alignment: {alignment}"
    lines = [head, "  for a CPU with 2 cores; this is not the paper's setting"]
    lines.append(f"  value alignment: {alignment}")
    if paper:
        lines.append(
            f"  the paper's setting: --preset paper ({paper.env_steps:,} env steps, "
            f"size {paper.size}, better on a GPU)"
        )
    return "\n".join(lines)


def _describe_alignment(config: Config) -> str:
    """From when on value alignment is active, and for how much of the run."""
    alignment = config.value_alignment
    if alignment.weight == "off":
        return "off"
    in_updates = alignment.warmup_unit == "updates"
    length = _updates(config) if in_updates else config.env_steps
    warmup, unit = alignment.warmup_steps, alignment.warmup_unit.replace("_", " ")
    about = "about " if in_updates else ""
    if warmup >= length:
        return (
            f"never active in this run of {about}{length:,} {unit}, whose warm-up is {warmup:,}"
        )
    percent = 100 * (length - warmup) // length
    share = f"{about}{percent} %" if percent else "less than 1 %"
    text = f"active after {warmup:,} {unit}, for {share} of the run"
    paper = registry.presets_of(config).get("paper")
    if paper is None or not is_small(config) or config.env_steps >= paper.env_steps:
        return text
    if not in_updates and warmup == scaled_warmup(config, config.env_steps):
        scale = f"{paper.value_alignment.warmup_steps:,} of {paper.env_steps:,}"
        text += f"; the warm-up is shortened with the run (paper: {scale})"
    return text


def _updates(config: Config) -> int:
    """Updates of the whole run, but for those that the reset of each episode adds."""
    replayed = config.env_steps // config.action_repeat - validate.smallest_replay(config)
    return max(0, replayed) * config.train_ratio // config.replay.batch_steps


@streams.outlive()
def guard(main: Callable[[], int]) -> int:
    """The exit code of `main`; what can go wrong becomes one line on standard error.

    Returns:
      2 for bad input, 1 for a run that had to stop, 130 after Ctrl-C, else main's own.
    """
    try:
        return main()
    except InvalidInput as error:
        print(f"error: {flags.in_flags(error)}", file=sys.stderr)
        return 2
    except (RunError, SaveError, EnvironmentFailure) as error:
        print(f"error: {flags.in_flags(error)}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("interrupted", file=sys.stderr)
        return 130
