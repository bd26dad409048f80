"""Measures how much more time and memory a training step needs than another.

Each variant runs in its own process, with its own memory. They take turns, so that other load
on the machine affects them equally. A sample is the smallest number of training steps with a
whole number of updates, including environments and replay.

The process runs `python -m vawm.sweep.overhead SUITE FLAGS...`, with the flags of the programs
that train. It reports once when it is ready, then times a sample for every line that it reads.
"""

from __future__ import annotations

import contextlib
import json
import math
import os
import resource
import statistics
import subprocess
import sys
import time
from collections.abc import Sequence
from typing import IO, Any, NamedTuple

import jax

from vawm.cli import command_line
from vawm.config import Config
from vawm.process import huge_pages
from vawm.runs import runner, suites, validate
from vawm.runs.runner import RunError
from vawm.runs.trainer import Kept, everything

WARM_UP = 2
"""Number of first samples that are not counted."""
COMMAND = (sys.executable, "-m", "vawm.sweep.overhead")
"""The command that measures one variant."""


class Measured(NamedTuple):
    """The time and memory of one variant.

    Attributes:
      seconds: of every sample.
      updates, env_steps: in a sample.
      compile_s: the time to compile a step, without a cache.
      peak_bytes: peak memory of the accelerator; on a CPU, `planned_bytes`.
      run_env_steps: of a whole run.
    """

    seconds: list[float]
    updates: int
    env_steps: int
    compile_s: float
    peak_bytes: int
    run_env_steps: int

    @property
    def run_hours(self) -> float:
        """Hours of a whole run, extrapolated from the median sample."""
        samples = self.run_env_steps / self.env_steps
        return samples * statistics.median(self.seconds) / 3600


def compare(suite: str, variants: Sequence[Sequence[str]], *, repeats: int) -> list[Measured]:
    """Measures every variant, given as flags of the program of `suite`, `repeats` times.

    Raises:
      RunError: the process of a variant ended early.
    """
    with contextlib.ExitStack() as stack:
        steppers = []
        for flags in variants:  # one by one, because compiling uses all cores
            steppers.append(stack.enter_context(_Stepper(suite, flags)))
        for number in range(WARM_UP + repeats):
            ordered = steppers if number % 2 else steppers[::-1]
            for stepper in ordered:
                stepper.sample()
        return [stepper.finish() for stepper in steppers]


class _Stepper:
    """The process of one variant."""

    def __init__(self, suite: str, flags: Sequence[str]):
        # Two processes share a GPU: neither may allocate all of it in advance.
        environment = os.environ | {"XLA_PYTHON_CLIENT_PREALLOCATE": "false"}
        pipe = subprocess.PIPE
        self._flags, self._seconds = flags, list[float]()
        self._process = subprocess.Popen(
            [*COMMAND, suite, *flags], stdin=pipe, stdout=pipe, text=True, env=environment
        )
        self._ready = self._read()

    def sample(self) -> None:
        self._ask("sample")
        self._seconds.append(self._read()["seconds"])

    def finish(self) -> Measured:
        self._ask("finish")
        peak = self._read()["peak_bytes"]
        return Measured(self._seconds[WARM_UP:], peak_bytes=peak, **self._ready)

    def _ask(self, word: str) -> None:
        assert self._process.stdin is not None
        with contextlib.suppress(BrokenPipeError):  # then `_read` raises
            self._process.stdin.write(word + "\n")
            self._process.stdin.flush()

    def _read(self) -> dict[str, Any]:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            code = self._process.wait()
            raise RunError(f"measuring {' '.join(self._flags)} failed with exit code {code}")
        return json.loads(line)

    def __enter__(self) -> _Stepper:
        return self

    def __exit__(self, *_: object) -> None:
        self._process.terminate()
        self._process.communicate()


def main(suite: str, flags: Sequence[str], asked: IO[str], answers: IO[str]) -> int:
    """The process of one variant: answers every line of `asked` with a line of JSON."""
    config = command_line.parse(flags, suite=suite, description="").config
    validate.check(config)
    suites.check_task(config)
    with contextlib.closing(runner.prepare(config, kept=_kept(config))) as trainer:
        state = trainer.init(config.seed)
        begin = time.perf_counter()
        step, executables = trainer.compile(state)
        compile_s = time.perf_counter() - begin
        updates = 0
        while not updates:  # until replay has enough steps for a batch
            state, metrics = step(state)
            updates = int(metrics["chunk/updates"])
        steps = steps_of_a_sample(config)
        earned = config.num_envs * config.collect_steps
        ready = {
            "updates": steps * earned * config.train_ratio // config.replay.batch_steps,
            "env_steps": steps * earned * config.action_repeat,
            "compile_s": compile_s,
            "run_env_steps": config.env_steps,
        }
        print(json.dumps(ready), file=answers, flush=True)
        for word in asked:
            if word.strip() == "finish":
                break
            begin = time.perf_counter()
            for _ in range(steps):
                state, metrics = step(state)
                metrics = jax.device_get(metrics)
            seconds = time.perf_counter() - begin
            print(json.dumps({"seconds": seconds}), file=answers, flush=True)
        print(json.dumps({"peak_bytes": peak_bytes(executables)}), file=answers, flush=True)
    return 0


def steps_of_a_sample(config: Config) -> int:
    """The smallest number of training steps with a whole number of updates."""
    earned = config.num_envs * config.collect_steps * config.train_ratio
    return config.replay.batch_steps // math.gcd(config.replay.batch_steps, earned)


def _kept(config: Config) -> Kept:
    """Keeps all metrics, or without value alignment only the others."""
    if config.value_alignment.weight == "off":
        return lambda name: "alignment" not in name
    return everything


def peak_bytes(executables: Sequence[jax.stages.Compiled]) -> int:
    """Peak memory of the accelerator so far; on a CPU, `planned_bytes`.

    The peak of the process would include compiling.
    """
    stats = jax.devices()[0].memory_stats()
    return stats["peak_bytes_in_use"] if stats else planned_bytes(executables)


def planned_bytes(executables: Sequence[jax.stages.Compiled]) -> int:
    """Memory of the largest executable by XLA's plan: arguments, results and temporaries."""

    def of(executable: jax.stages.Compiled) -> int:
        plan = executable.memory_analysis()
        assert plan is not None, "XLA plans memory on every CPU"
        fresh = plan.output_size_in_bytes - plan.alias_size_in_bytes
        return plan.argument_size_in_bytes + fresh + plan.temp_size_in_bytes

    return max(of(executable) for executable in executables)


def peak_process_bytes() -> int:
    """Peak memory of this process on the host."""
    return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss  # KiB on Linux


def percent_more(values: Sequence[float], others: Sequence[float]) -> list[float]:
    """How much larger each of `values` is than its neighbour in `others`, in percent."""
    return [100 * (a / b - 1) for a, b in zip(values, others, strict=True)]


def quartiles(values: Sequence[float]) -> list[float]:
    """The first and the third quartile; both are the value itself if there is only one."""
    if len(values) == 1:
        return [values[0], values[0]]
    first, _, third = statistics.quantiles(values, n=4, method="inclusive")
    return [first, third]


if __name__ == "__main__":
    huge_pages.use_huge_pages()
    words = sys.argv[1:]
    sys.exit(command_line.guard(lambda: main(words[0], words[1:], sys.stdin, sys.stdout)))
