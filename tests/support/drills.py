"""Drills: deliberate failures of a single run, with the required outcome.

    python tests/support/drills.py [NAME ...] [--count N]

runs the drills that take minutes, all or only those named: `kill`, `term`, `flip`, `full`,
`devices`, `huge`, `fuzz`, `corrupt`. It prints a table and exits with 1 if one of them
failed. `--count` sets the number of tries of `kill`, `term`, `fuzz` and `corrupt`.

All drills, each with its tests or its function in this file:

 1  SIGKILL at random moments: complete lines, none twice or missing, undamaged checkpoints
        support/drills::kill
        runs/checkpoint/test_saver::test_a_run_killed_at_any_moment_leaves_an_undamaged_checkpoint
        runs/reports/test_tracking::test_truncation_drops_later_lines_and_half_a_line
        runs/test_resume::test_missing_and_damaged_lines_before_the_checkpoint_cause_a_warning
 2  A resumed run equals an uninterrupted one bit for bit
        support/drills::kill
        runs/test_runner::test_a_resumed_run_equals_an_uninterrupted_one
        learning/test_host_train::test_a_run_that_is_resumed_equals_one_in_one_piece
 3  SIGTERM, SIGINT, SIGHUP: a checkpoint, exit codes 143, 130, 129; the second one kills
        support/drills::term
        runs/test_runner::test_a_run_stopped_by_a_signal_and_resumed_equals_an_uninterrupted_one
        process/test_signals::test_signals_end_a_process_with_the_code_that_shells_expect
 4  One byte flipped in every file of a checkpoint
        support/drills::flip
        support/drills::corrupt
        runs/checkpoint/test_damage::test_damage_to_any_file_is_named_and_the_one_before_is_used
        runs/test_runner::test_a_run_whose_newest_checkpoint_is_damaged_resumes_from_the_one_before
 5  Truncated and deleted files, empty folders, incomplete checkpoints
        support/drills::flip
        runs/checkpoint/test_damage::test_damage_to_any_file_is_named_and_the_one_before_is_used
        runs/checkpoint/test_damage::test_an_empty_folder_is_skipped
        runs/checkpoint/test_damage::test_incomplete_and_renamed_checkpoints_are_ignored
        runs/checkpoint/test_damage::test_a_run_with_only_empty_checkpoint_folders_is_not_restarted
        runs/test_resume::test_a_run_whose_checkpoints_are_missing_is_not_restarted
        runs/test_resume::test_a_run_that_saved_by_time_is_not_restarted_either
        runs/test_run_folder::test_files_that_are_not_of_a_run_are_not_put_aside
 6  A full disk while saving and while logging
        support/drills::full
        runs/test_runner::test_a_disk_that_is_full_when_saving_ends_the_run_and_keeps_the_checkpoint
        runs/test_runner::test_a_full_disk_is_explained_in_one_line
        runs/reports/test_tracking::test_a_full_disk_is_an_error_when_a_line_is_written
        process/test_streams::test_a_program_survives_the_loss_of_its_standard_output
 7  A folder that cannot be written to
        runs/test_run_folder::test_a_path_through_a_file_is_refused
        runs/test_run_folder::test_a_folder_without_permission_is_refused
        runs/test_runner::test_bad_input_is_refused_with_nothing_written
        runs/test_runner::test_a_checkpoint_folder_that_is_not_writable_is_refused_before_training
 8  Two runs in one folder; the lock of a dead process
        runs/test_run_folder::test_a_second_claim_is_refused_and_names_the_holder
        runs/test_run_folder::test_the_lock_of_a_killed_process_is_free
        runs/test_run_folder::test_a_file_system_without_locks_is_a_warning
 9  Rewards that are NaN, once and every time
        learning/test_host_train::test_what_is_not_finite_ends_the_run_with_environment_step_and_field
        learning/test_host_train::test_where_environments_may_restart_what_is_not_finite_is_never_learned_from
        envs/test_host_pool::test_failures_without_a_step_between_them_end_the_pool
        runs/test_runner::test_one_step_that_is_not_finite_stops_the_run_before_it_is_saved
        runs/test_runner::test_rewards_that_are_nan_in_replay_stop_the_run_and_are_named
        learning/test_train::test_a_nan_in_the_physics_ends_that_episode_and_is_never_stored
10  Infinite and huge observations, and actions
        learning/test_host_train::test_what_is_not_finite_ends_the_run_with_environment_step_and_field
        learning/test_host_train::test_huge_observations_and_rewards_are_learned_from_and_all_stays_finite
        learning/test_train_storm::test_observations_and_rewards_of_1e30_leave_all_that_is_learned_finite
        support/drills::huge
        envs/test_host_pool::test_continuous_actions_are_clipped_and_nan_is_no_action
        envs/test_stream::test_failed_physics_ends_the_episode_and_the_next_step_resets_it
        envs/test_stream::test_a_nan_action_counts_as_zero_and_a_large_one_is_clipped
11  A loss that is NaN: the run stops, with a diagnosis
        runs/test_runner::test_a_loss_that_is_not_finite_stops_the_run_and_keeps_the_checkpoint
        runs/test_runner::test_a_loss_that_is_not_finite_is_reported_even_if_a_save_failed
        runs/test_runner::test_rewards_that_are_nan_in_replay_stop_the_run_and_are_named
        runs/checkpoint/test_checkpoint::test_parameters_that_are_not_finite_are_not_saved
12  Environments that raise, die or hang
        envs/test_host_pool::test_a_failure_names_environment_and_step_and_ends_the_pool
        envs/test_host_pool::test_a_failure_can_start_a_new_episode_instead
        envs/test_host_pool::test_a_worker_that_is_killed_from_outside_is_noticed
        learning/test_host_train::test_an_environment_that_fails_ends_the_run_in_one_line
        learning/test_host_train::test_an_environment_that_may_restart_does_and_is_counted
13  Invalid environments: dtype, shape, range, flags
        envs/test_host_gymnasium::test_a_problem_is_named_with_a_remedy
        envs/test_host_gymnasium::test_all_problems_come_at_once
        envs/test_host_pool::test_invalid_outcomes_are_named
14  Choices with a typo, of a wrong type, or that conflict
        support/drills::fuzz
        runs/test_fuzz::test_a_config_is_refused_by_the_name_of_a_choice_or_not_at_all
        runs/test_fuzz::test_so_is_one_for_images_in_any_suite_on_the_host
        cli/test_flags::test_an_error_names_flag_value_and_remedy
        runs/test_validate::test_bad_values_come_with_a_remedy
15  Checkpoints of another size, task or version
        runs/checkpoint/test_checkpoint::test_another_width_is_refused_with_both_shapes
        runs/checkpoint/test_checkpoint::test_a_leaf_that_differs_is_named
        runs/test_resume::test_another_choice_is_refused_by_name
        runs/checkpoint/test_hostile::test_a_manifest_with_wrong_content_is_refused
        runs/test_run_folder::test_a_config_of_another_version_is_refused_with_the_version_and_a_remedy
        runs/test_resume::test_a_run_of_another_version_is_refused_even_if_it_can_be_read
        test_export::test_a_policy_of_another_version_is_loaded_with_a_warning
16  Malicious checkpoints
        runs/checkpoint/test_hostile::test_a_pickle_instead_of_any_file_is_not_executed
        runs/checkpoint/test_hostile::test_a_file_elsewhere_is_refused
        runs/checkpoint/test_hostile::test_a_link_to_the_right_file_is_refused
        runs/checkpoint/test_hostile::test_a_huge_manifest_is_not_read
        runs/checkpoint/test_hostile::test_small_files_do_not_expand_to_huge_parameters
        runs/test_budget::test_a_policy_that_does_not_fit_is_refused_with_the_numbers
        test_export::test_a_damaged_file_is_one_line
17  Runs too large for the memory
        runs/test_budget::test_five_million_images_are_refused_with_the_numbers
        runs/test_budget::test_what_does_not_fit_is_refused_with_the_largest_replay_that_would
        runs/test_runner::test_a_run_that_does_not_fit_is_refused_with_nothing_written
        runs/test_runner::test_running_out_of_memory_is_explained
18  Equal seeds, different seeds, seeds side by side
        learning/test_train::test_the_step_is_deterministic_and_seeds_differ
        learning/test_train::test_two_seeds_vmapped_equal_the_two_runs_alone
        envs/test_stream::test_equal_keys_give_equal_episodes_and_different_keys_do_not
19  A tracking backend that is down
        runs/reports/test_backends::test_a_backend_that_fails_causes_one_warning_and_the_run_continues
        runs/reports/test_backends::test_a_backend_that_hangs_delays_the_end_for_a_limited_time
        runs/reports/test_backends::test_a_resumed_run_continues_without_a_package_that_was_removed
        runs/test_runner::test_a_tracker_that_fails_changes_nothing_but_one_line_of_output
20  Env steps that decrease, clocks that jump
        runs/checkpoint/test_checkpoint::test_a_checkpoint_older_than_the_newest_is_refused
        runs/checkpoint/test_saver::test_an_older_checkpoint_is_refused_before_anything_is_copied
        runs/checkpoint/test_saver::test_time_is_counted_from_the_previous_save
        runs/test_runner::test_a_chunk_without_a_step_forward_is_not_saved_again
21  Another number of devices
        support/drills::devices
        learning/test_sharding::test_two_devices_give_what_one_gives
"""

from __future__ import annotations

import argparse
import collections
import concurrent.futures
import contextlib
import json
import multiprocessing
import os
import pathlib
import random
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator
from typing import NamedTuple

import damage
import fuzz as fuzzing
import huge_numbers
import hurry
import hypothesis
import jax
import rich.console
import rich.markup
import rich.table
import runs
import tiny

from vawm.config import Config
from vawm.errors import InvalidInput
from vawm.process import cache
from vawm.runs import checkpoint, runner

GRACE = 30  # seconds between a signal and the end
PATIENCE = 600  # seconds for a run to reach given env steps
LOG_EVERY = 16


class Outcome(NamedTuple):
    """How a drill ended: the number of tries, and what happened."""

    tries: int
    seen: str


class Skipped(Exception):
    """A drill that cannot run on this machine."""


def config_for(env_steps: int, save_every: int = 16) -> Config:
    """A tiny run that logs and saves often."""
    return tiny.config(env_steps=env_steps, log_every=LOG_EVERY, save_every=save_every)


# Runs in child processes.


def train(logdir: str, env_steps: int, save_every: int) -> int:
    """Starts or resumes a run, in a child process."""
    console = rich.console.Console(width=200)
    print(f"devices: {jax.device_count()}", flush=True)
    begun = (pathlib.Path(logdir) / "config.json").exists()
    try:
        return runner.run(
            config_for(env_steps, save_every),
            logdir,
            resume=begun,
            env=tiny.env(),
            console=console,
        ).exit_code
    except (InvalidInput, runner.RunError, checkpoint.SaveError) as error:
        print(error, flush=True)
        return 1


class Child:
    """A child process that trains; a context manager that kills it at the end.

    Its output goes to a file: nothing reads a pipe, and a full pipe would block the child.
    """

    def __init__(
        self, logdir: pathlib.Path, env_steps: int, save_every: int = 16, devices: int = 1
    ):
        command = [sys.executable, __file__, "child", logdir, env_steps, save_every]
        self._file = tempfile.TemporaryFile("w+")  # noqa: SIM115
        self.process = subprocess.Popen(
            [str(word) for word in command],
            stdout=self._file,
            stderr=subprocess.STDOUT,
            env=os.environ | {"XLA_FLAGS": with_devices(devices)},
        )

    def said(self) -> str:
        self._file.seek(0)
        return self._file.read()

    def __enter__(self) -> Child:
        return self

    def __exit__(self, *_: object) -> None:
        self.process.kill()
        self.process.wait()
        self._file.close()


def with_devices(count: int) -> str:
    """XLA flags that make a CPU count as several devices."""
    flags = os.environ.get("XLA_FLAGS", "")
    return f"{flags} --xla_force_host_platform_device_count={count}".strip()


def finish(logdir: pathlib.Path, env_steps: int, save_every: int = 16, devices: int = 1) -> str:
    """Starts or resumes a run, waits for its end, and returns its output."""
    with Child(logdir, env_steps, save_every, devices) as child:
        code = child.process.wait(timeout=PATIENCE)
        assert code == 0, child.said()[-2000:]
        return child.said()


def reached(logdir: pathlib.Path) -> int:
    """Env steps of the last complete line of metrics."""
    with contextlib.suppress(OSError, ValueError, IndexError):
        return json.loads((logdir / "metrics.jsonl").read_bytes().splitlines()[-1])["env_steps"]
    return 0


def wait_for(logdir: pathlib.Path, env_steps: int, child: Child) -> None:
    """Waits until a run has reached `env_steps`; fails if it ends before."""
    end = time.monotonic() + PATIENCE
    while reached(logdir) < env_steps:
        ended = child.process.poll() is not None and reached(logdir) < env_steps
        if ended or time.monotonic() > end:
            raise AssertionError(f"not at {env_steps}: {child.said()[-2000:]}")
        time.sleep(0.002)


def check_metrics(logdir: pathlib.Path, env_steps: int) -> None:
    """Checks that every line is complete and that there is one per interval, in order."""
    text = (logdir / "metrics.jsonl").read_text()
    assert text.endswith("\n")
    steps = [json.loads(line)["env_steps"] for line in text.splitlines()]
    intervals = [step // LOG_EVERY for step in steps]
    assert intervals == list(range(1, env_steps // LOG_EVERY + 1)), steps


# The drills.


def kill(folder: pathlib.Path, count: int = 30) -> Outcome:
    """SIGKILL, usually during training and saving, every fifth time during the start."""

    def strike(child: Child, number: int, target: int) -> None:
        if number % 5 == 4:
            time.sleep(RANDOM.uniform(0.5, 10))
        else:
            wait_for(folder / "run", target, child)
            time.sleep(RANDOM.uniform(0, 0.1))
        child.process.kill()
        child.process.wait()
        if checkpoint.latest(folder / "run"):
            found = checkpoint.find(folder / "run")
            assert not found.damaged, found.damaged

    return interrupt(folder, count, strike)


def term(folder: pathlib.Path, count: int = 10) -> Outcome:
    """SIGTERM and SIGINT in turns."""
    slowest = 0.0

    def strike(child: Child, number: int, target: int) -> None:
        nonlocal slowest
        wait_for(folder / "run", target, child)
        time.sleep(RANDOM.uniform(0, 0.1))
        name = ("SIGTERM", "SIGINT")[number % 2]
        before, began = reached(folder / "run"), time.monotonic()
        child.process.send_signal(getattr(signal, name))
        code = child.process.wait(timeout=GRACE)
        slowest = max(slowest, time.monotonic() - began)
        assert code == {"SIGTERM": 143, "SIGINT": 130}[name], child.said()[-2000:]
        assert "resume with:" in child.said(), child.said()[-2000:]
        found = checkpoint.find(folder / "run")
        assert not found.damaged, found.damaged
        assert found.manifest.env_steps >= before

    outcome = interrupt(folder, count, strike)
    return outcome._replace(seen=f"{outcome.seen}; at most {slowest:.1f} s to the end")


def interrupt(
    folder: pathlib.Path,
    count: int,
    strike: Callable[[Child, int, int], None],
) -> Outcome:
    """Interrupts a run `count` times, resumes it, and compares with an uninterrupted run."""
    env_steps = 192 + 96 * count
    targets = sorted(RANDOM.randrange(LOG_EVERY, env_steps - 96) for _ in range(count))
    for number, target in enumerate(targets):
        with Child(folder / "run", env_steps) as child:
            strike(child, number, target)
    finish(folder / "run", env_steps)
    finish(folder / "whole", env_steps)
    for name in ("run", "whole"):
        check_metrics(folder / name, env_steps)
    runs.assert_same(folder / "run", folder / "whole", config_for(env_steps), tiny.env())
    return Outcome(count, f"{env_steps} env steps as uninterrupted, bit for bit")


def flip(folder: pathlib.Path) -> Outcome:
    """Every file of a run's newest checkpoint: a byte flipped, the end cut off, deleted."""
    finish(folder / "run", 96)
    old, newest = sorted(checkpoint.complete(folder / "run"))
    tries = 0
    for file in runs.files_of(newest):
        content = file.read_bytes()
        for harm in (damage.flip, damage.truncate, damage.delete):
            harm(file)
            found = checkpoint.find(folder / "run")
            assert found.path == old, f"{harm.__name__} {file}: read {found.path}"
            assert file.name in str(found.damaged[0][1]), f"{found.damaged} for {file}"
            file.write_bytes(content)
            tries += 1
    assert checkpoint.find(folder / "run").path == newest
    return Outcome(tries, "each named, and the previous checkpoint used")


def corrupt(folder: pathlib.Path, count: int = 500) -> Outcome:
    """Random damage to a run's only checkpoint never reads as another state."""
    finish(folder / "run", 96)
    (folder / "one" / "checkpoints").mkdir(parents=True)
    newest = checkpoint.latest(folder / "run")
    assert newest
    shutil.copytree(newest, folder / "one" / "checkpoints" / newest.name)
    with contextlib.closing(runner.prepare(config_for(96), tiny.env())) as trainer:
        expected, _ = checkpoint.restore(folder / "one", trainer.shapes)
    refused = damage.corrupt(folder / "one", expected, count, RANDOM)
    return Outcome(count, f"{refused} refused in one line, {count - refused} changed nothing")


def full(folder: pathlib.Path) -> Outcome:
    """A full disk of 10 MB, while saving and while logging."""
    mount = ["mount", "-t", "tmpfs", "-o", "size=10m", "tmpfs"]
    seen = []
    for what, save_every in (("saving", 16), ("logging", 10**6)):
        disk = folder / what
        disk.mkdir()
        mounted = subprocess.run([*mount, str(disk)], capture_output=True, text=True)
        if mounted.returncode:
            raise Skipped(f"no small disk can be mounted: {mounted.stderr.strip()[:80]}")
        try:
            seen.append(fill(disk, save_every))
        finally:
            subprocess.run(["umount", str(disk)], check=True)
    return Outcome(len(seen), "; ".join(seen))


def fill(disk: pathlib.Path, save_every: int) -> str:
    """Fills the disk of a run: it must end with one line and be resumable afterwards."""
    logdir, filler, env_steps = disk / "run", disk / "filler", 4000
    with Child(logdir, env_steps, save_every) as child:
        wait_for(logdir, 64, child)
        deadline = time.monotonic() + PATIENCE
        while child.process.poll() is None:  # it deletes old checkpoints meanwhile
            assert time.monotonic() < deadline, "continues with a full disk"
            with contextlib.suppress(OSError), filler.open("ab", buffering=0) as file:
                while child.process.poll() is None:
                    file.write(bytes(1024))
            time.sleep(0.001)
        code, output = child.process.returncode, child.said()
    assert code == 1, output[-2000:]
    told = [line for line in output.splitlines() if "No space left" in line]
    assert len(told) == 1, output[-2000:]
    assert re.match(rf"(checkpoint )?{logdir}", told[0]), told
    assert " free)" in told[0], told
    scratch = list(checkpoint.root(logdir).glob(f"{checkpoint.SCRATCH}*"))
    assert not scratch, scratch
    newest = checkpoint.latest(logdir)
    if newest:
        assert not checkpoint.find(logdir).damaged
    filler.unlink()
    end = reached(logdir) // 96 * 96 + 96
    finish(logdir, end, save_every)
    check_metrics(logdir, end)
    kept = f"kept {int(newest.name)}" if newest else "no checkpoint yet"
    return f"{told[0].replace(str(logdir), 'LOGDIR')} ({kept}, then resumed)"


def devices(folder: pathlib.Path) -> Outcome:
    """A run on one device is resumed on four, and then on one again."""
    for env_steps, count in ((64, 1), (128, 4), (192, 1)):
        said = finish(folder / "run", env_steps, devices=count)
        assert f"devices: {count}\n" in said, said[-2000:]
    finish(folder / "whole", 192)
    check_metrics(folder / "run", 192)
    runs.assert_same(folder / "run", folder / "whole", config_for(192), tiny.env())
    return Outcome(3, "1, 4 and 1 devices, as uninterrupted on one, bit for bit")


def huge(folder: pathlib.Path) -> Outcome:
    """Every agent learns from observations and rewards of 1e30, and acts on them."""
    del folder
    for config in huge_numbers.AGENTS:
        huge_numbers.learn_from_them(config)
    names = [config.agent for config in huge_numbers.AGENTS]
    return Outcome(len(names), f"{', '.join(names)}: all parameters stay finite")


def fuzz(folder: pathlib.Path, count: int = 2000) -> Outcome:
    """Random configs are refused by name, or they compile and make updates."""
    accepted: dict[Config, int] = {}
    refused = 0

    @hypothesis.seed(RANDOM.randrange(2**32))
    @hypothesis.settings(
        max_examples=count,
        database=None,
        deadline=None,
        phases=[hypothesis.Phase.generate],
        suppress_health_check=list(hypothesis.HealthCheck),
    )
    @hypothesis.given(fuzzing.configs())
    def collect(config: Config) -> None:
        nonlocal refused
        if fuzzing.refusal(config, folder / "nowhere"):
            refused += 1
        else:
            accepted[config] = accepted.get(config, 0) + 1

    collect()
    assert not (folder / "nowhere").exists()
    print(f"{refused} refused, {len(accepted)} different ones to run", flush=True)
    ends = collections.Counter(run_all(list(accepted)))
    seen = ", ".join(f"{number} {end}" for end, number in ends.items())
    tries = sum(accepted.values())
    what = f"{refused} refused, {tries} accepted; of {len(accepted)} different ones {seen}"
    return Outcome(refused + tries, what)


def run_alone(config: Config) -> str:
    """Calls `fuzzing.run`, then frees the compiled functions."""
    try:
        return fuzzing.run(config)
    finally:
        jax.clear_caches()


def run_all(configs: list[Config]) -> Iterator[str]:
    """Runs all configs in separate processes, compiled without optimisation."""
    hurry.hurry()
    spawn = multiprocessing.get_context("spawn")
    with concurrent.futures.ProcessPoolExecutor(mp_context=spawn) as pool:
        runs = {pool.submit(run_alone, config): config for config in configs}
        for number, done in enumerate(concurrent.futures.as_completed(runs), 1):
            if error := done.exception():
                pool.shutdown(cancel_futures=True)
                raise AssertionError(f"{error!r} of {runs[done]}") from error
            if number % 20 == 0:
                print(f"{number} of {len(configs)} run", flush=True)
            yield done.result()


DRILLS = {
    drill.__name__: drill for drill in (kill, term, flip, full, devices, huge, fuzz, corrupt)
}
RANDOM = random.Random()


def main() -> int:
    parser = argparse.ArgumentParser()
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"of {', '.join(DRILLS)}")
    parser.add_argument("--count", type=int, help="number of tries, instead of the default")
    parser.add_argument("--seed", type=int, default=0, help="seed of all random choices")
    arguments = parser.parse_args()
    if unknown := set(arguments.names) - set(DRILLS):
        parser.error(f"{', '.join(sorted(unknown))}: use some of {', '.join(DRILLS)}")
    table = rich.table.Table("drill", "tries", "outcome", "seconds")
    failed = False
    for name in arguments.names or DRILLS:
        print(f"{name} ...", flush=True)
        RANDOM.seed(arguments.seed)
        counted = arguments.count and name in ("kill", "term", "fuzz", "corrupt")
        choices = {"count": arguments.count} if counted else {}
        began = time.monotonic()
        try:
            with tempfile.TemporaryDirectory() as folder:
                tries, seen = DRILLS[name](pathlib.Path(folder), **choices)
            row = str(tries), f"passed: {seen}"
        except Skipped as reason:
            row = "0", f"not done: {reason}"
        except Exception as error:
            traceback.print_exc()
            row, failed = ("", f"FAILED: {error}"[:500]), True
        table.add_row(name, *map(rich.markup.escape, row), f"{time.monotonic() - began:.0f}")
    rich.console.Console(width=None if sys.stdout.isatty() else 160).print(table)
    return int(failed)


if __name__ == "__main__":
    os.environ.setdefault("JAX_PLATFORMS", "cpu")
    cache.enable()
    if sys.argv[1:2] == ["child"]:
        sys.exit(train(sys.argv[2], int(sys.argv[3]), int(sys.argv[4])))
    jax.config.update("jax_numpy_rank_promotion", "raise")
    sys.exit(main())
