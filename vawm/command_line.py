"""The command line of experiments: tyro over `Config`, two phases, one line per error.

`--preset` and `--size` choose the defaults, or `--resume` takes those of the saved run;
every other flag then overrides one field of `Config`.
"""

from __future__ import annotations

import argparse
import dataclasses
import datetime
import pathlib
import sys
from collections.abc import Callable, Sequence
from typing import Annotated, NamedTuple

import tyro

from vawm import config as config_lib
from vawm import flags as flags_lib
from vawm import resume, validate
from vawm.checkpoint import SaveError
from vawm.config import Config
from vawm.errors import InvalidInput
from vawm.runner import RunError


class Arguments(NamedTuple):
    """What a command line says."""

    config: Config
    logdir: pathlib.Path
    resume: bool


@dataclasses.dataclass(frozen=True)
class Flags:
    """What tyro reads: the fields of `Config`, and these."""

    config: Annotated[Config, tyro.conf.arg(name="")]
    logdir: pathlib.Path | None = None
    """folder of the run; runs/<task>/<preset>-seed<seed>-<time> if not given"""
    resume: bool = False
    """continue the run in --logdir, with its own settings as defaults"""


def parse(argv: Sequence[str] | None, *, preset: str, description: str) -> Arguments:
    """Reads `argv` (of the process if None); `preset` is the default one.

    Raises:
      InvalidInput: an unknown preset, size or flag, a wrong type, or nothing to resume.
      SystemExit: help was asked for (0).
    """
    argv = list(sys.argv[1:] if argv is None else argv)
    default = Flags(_defaults(argv, preset))
    flags = flags_lib.read(Flags, argv, default=default, description=description)
    return Arguments(flags.config, flags.logdir or default_logdir(flags.config), flags.resume)


def _defaults(argv: list[str], preset: str) -> Config:
    """First phase: the config that the flags of the second override."""
    parser = argparse.ArgumentParser(add_help=False, allow_abbrev=False, exit_on_error=False)
    parser.add_argument("--preset", nargs="?")
    parser.add_argument("--size", nargs="?")
    parser.add_argument("--logdir", nargs="?")
    parser.add_argument("--resume", action=argparse.BooleanOptionalAction)
    try:
        known, _ = parser.parse_known_args(argv)
    except argparse.ArgumentError:  # --resume=value
        raise InvalidInput("--resume", True, "takes no value; write --resume alone") from None
    if not known.resume or {"-h", "--help"} & set(argv):
        return validate.preset(known.preset or preset, known.size)
    if known.logdir is None:
        raise InvalidInput("logdir", None, "--resume needs the --logdir of the run")
    saved = resume.saved_config(known.logdir)
    if known.size not in (None, saved.size):
        validate.check_choice("size", known.size, config_lib.SIZES)
        return config_lib.with_size(saved, known.size)
    return saved


def default_logdir(config: Config) -> pathlib.Path:
    """A folder of its own for each run."""
    now = datetime.datetime.now().strftime("%Y%m%d-%H%M%S")
    return pathlib.Path("runs") / config.task / f"{config.preset}-seed{config.seed}-{now}"


def describe(config: Config) -> str:
    """What the chosen preset is for, in a few lines."""
    alignment = config.value_alignment
    head = (
        f"preset {config.preset}: {config.task}, {config.env_steps:,} env steps, "
        f"size {config.size}, seed {config.seed}"
    )
    unit = alignment.warmup_unit.replace("_", " ")
    warmup = f"{alignment.warmup_steps:,} {unit}"
    paper = config_lib.PAPER
    if alignment.weight == "off":
        start = "off"
    elif alignment.warmup_unit == "env_steps" and alignment.warmup_steps >= config.env_steps:
        start = f"never active in this run, which is not longer than its warm-up of {warmup}"
    else:
        start = f"after {warmup}"
        if config.preset == "quick":
            scale = f"{paper.value_alignment.warmup_steps:,} of {paper.env_steps:,}"
            start += f", a warm-up scaled to the short run (paper: {scale})"
    if config.preset != "quick":
        return f"{head}\nvalue alignment: {start}"
    return (
        f"{head}\n"
        "  for a CPU with 2 cores and some minutes; this is not the paper's setting\n"
        f"  value alignment: {start}\n"
        f"  the paper's setting: --preset paper ({paper.env_steps:,} env steps, "
        f"size {paper.size}, better on a GPU)"
    )


def guard(main: Callable[[], int]) -> int:
    """The exit code of `main`; what can go wrong becomes one line on standard error.

    Returns:
      2 for bad input, 1 for a run that had to stop, 130 after Ctrl-C, else main's own.
    """
    try:
        return main()
    except InvalidInput as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except (RunError, SaveError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    except KeyboardInterrupt:
        print("interrupted before the first step", file=sys.stderr)
        return 130
