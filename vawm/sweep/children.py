"""Child processes side by side; whoever stops their parent stops them too."""

from __future__ import annotations

import contextlib
import os
import pathlib
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from typing import NamedTuple

from vawm.process import signals

POLL_SECONDS = 0.1
"""Well below `signals.BURST_SECONDS`: a child to which a terminal has sent Ctrl-C already takes
what follows from here for the same request."""


class Job(NamedTuple):
    """A command, and the file to which all that it prints is appended."""

    name: str
    command: Sequence[str]
    log: pathlib.Path


class Outcome(NamedTuple):
    """How they ended.

    Attributes:
      failed: jobs that ended by themselves, with another exit code than 0.
      exit_code: 0, or what a shell expects after the signal that stopped this process.
    """

    failed: list[tuple[Job, int]]
    exit_code: int


def run(jobs: Sequence[Job], *, at_once: int) -> Outcome:
    """Keeps `at_once` jobs going, on Linux each with its share of the cores.

    At Ctrl-C, SIGTERM or SIGHUP no further one is started; those that run get a SIGTERM, upon
    which a run of ours saves, and this returns when all have ended. At a second signal
    this process ends at once, and they go on saving.
    """
    cores = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []
    shares = [cores[i::at_once] for i in range(at_once)]
    waiting, failed = list(jobs), list[tuple[Job, int]]()
    running = dict[int, tuple[Job, subprocess.Popen]]()
    with signals.catch(lambda: print("stopping the runs ...", flush=True)) as stop:
        try:
            while stop.signal is None and (waiting or running):
                failed += _ended(running)
                for slot in range(at_once):
                    if slot not in running and waiting and stop.signal is None:
                        job = waiting.pop(0)
                        running[slot] = job, _start(job, shares[slot])
                time.sleep(POLL_SECONDS)
        finally:
            for _, process in running.values():
                process.terminate()
            for _, process in running.values():
                process.wait()
        return Outcome(failed, stop.exit_code)


def run_then(jobs: Sequence[Job], report: Callable[[], None], *, at_once: int) -> int:
    """Runs the jobs, then reports, of whichever succeeded; not after a signal.

    Returns:
      The exit code of a program that does no more: 1 if a job failed.
    """
    outcome = run(jobs, at_once=at_once)
    if outcome.exit_code:
        print("stopped; the same command goes on")
        return outcome.exit_code
    for job, code in outcome.failed:
        print(f"error: {job.name} ended with exit code {code}, see {job.log}", file=sys.stderr)
    report()
    return 1 if outcome.failed else 0


def _ended(running: dict[int, tuple[Job, subprocess.Popen]]) -> list[tuple[Job, int]]:
    """Takes those that have ended out of `running`; returns which of them failed."""
    failed = []
    for slot, (job, process) in list(running.items()):
        if process.poll() is not None:
            del running[slot]
            print(f"{job.name}: exit code {process.returncode}", flush=True)
            if process.returncode:
                failed.append((job, process.returncode))
    return failed


def _start(job: Job, cores: Sequence[int]) -> subprocess.Popen:
    job.log.parent.mkdir(parents=True, exist_ok=True)
    with job.log.open("a") as log:
        process = subprocess.Popen(job.command, stdout=log, stderr=log)
    if cores:  # threads that it starts from now on inherit them
        with contextlib.suppress(ProcessLookupError):
            os.sched_setaffinity(process.pid, cores)
    return process
