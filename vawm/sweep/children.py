"""Child processes in parallel, stopped together with their parent."""

from __future__ import annotations

import contextlib
import functools
import os
import pathlib
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from typing import NamedTuple

from vawm.process import signals
from vawm.sweep.progress import Progress

POLL_SECONDS = 0.1
"""Well below `signals.BURST_SECONDS`: then a child that already got Ctrl-C from a terminal
counts the SIGTERM from this process as the same request."""


class Job(NamedTuple):
    """A command that trains, the file to which its output is appended, and the run's folder."""

    name: str
    command: Sequence[str]
    log: pathlib.Path
    folder: pathlib.Path


class Outcome(NamedTuple):
    """How the jobs ended.

    Attributes:
      failed: jobs that ended by themselves with an exit code other than 0.
      exit_code: 0, or the shell's exit code for the signal that stopped this process.
    """

    failed: list[tuple[Job, int]]
    exit_code: int


def run(jobs: Sequence[Job], *, at_once: int) -> Outcome:
    """Runs `at_once` jobs at a time, on Linux each on its share of the cores.

    Prints a line when a run starts, when it ends, and every minute for new scores.

    After Ctrl-C, SIGTERM or SIGHUP it starts no further job and sends SIGTERM to the running
    ones, which makes a run save and stop. It returns when all have ended. A second signal
    ends this process at once, while the jobs continue to save.
    """
    cores = sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else []
    shares = [cores[i::at_once] for i in range(at_once)]
    waiting, failed = list(jobs), list[tuple[Job, int]]()
    running = dict[int, tuple[Job, subprocess.Popen]]()
    progress = Progress([job.folder for job in jobs], say=functools.partial(print, flush=True))
    with signals.catch(lambda: print("stopping the runs ...", flush=True)) as stop:
        try:
            while stop.signal is None and (waiting or running):
                failed += _ended(running, progress)
                for slot in range(at_once):
                    if slot not in running and waiting and stop.signal is None:
                        job = waiting.pop(0)
                        running[slot] = job, _start(job, shares[slot])
                        progress.starts(job.name, job.folder)
                progress.look()
                time.sleep(POLL_SECONDS)
        finally:
            for _, process in running.values():
                process.terminate()
            for _, process in running.values():
                process.wait()
        return Outcome(failed, stop.exit_code)


def run_then(jobs: Sequence[Job], report: Callable[[], None], *, at_once: int) -> int:
    """Runs the jobs, then calls `report`, even if jobs failed, but not after a signal.

    Returns:
      The exit code for the program: 1 if a job failed.
    """
    outcome = run(jobs, at_once=at_once)
    if outcome.exit_code:
        print("stopped; run the same command to continue")
        return outcome.exit_code
    for job, code in outcome.failed:
        print(f"error: {job.name} failed with exit code {code}; see {job.log}", file=sys.stderr)
    report()
    return 1 if outcome.failed else 0


def _ended(
    running: dict[int, tuple[Job, subprocess.Popen]], progress: Progress
) -> list[tuple[Job, int]]:
    """Removes jobs that have ended from `running`; returns those that failed."""
    failed = []
    for slot, (job, process) in list(running.items()):
        if process.poll() is not None:
            del running[slot]
            progress.ends(job.name, job.folder, process.returncode)
            if process.returncode:
                failed.append((job, process.returncode))
    return failed


def _start(job: Job, cores: Sequence[int]) -> subprocess.Popen:
    job.log.parent.mkdir(parents=True, exist_ok=True)
    with job.log.open("a") as log:
        process = subprocess.Popen(job.command, stdout=log, stderr=log)
    if cores:  # threads that it starts from now on inherit the affinity
        with contextlib.suppress(ProcessLookupError):
            os.sched_setaffinity(process.pid, cores)
    return process
