"""Sweeps over a program that does not train: starting, stopping, reading and writing."""

import json
import os
import pathlib
import signal
import sys
import threading
import time

import analysis_drawings
import numpy as np
import pytest
import tiny
from refusals import refused

from vawm.analysis import tables
from vawm.runs import run_folder, suites
from vawm.runs.runner import RunError
from vawm.sweep import (
    ablation,
    children,
    costs,
    figures,
    learning_curves,
    progress,
    results,
    runs,
)
from vawm.sweep.runs import Run, Sweep, Variant

# Takes the flags of a training program, and `--behave`: it writes the files of a run, then
# finishes, fails, or waits for a signal and saves.
PROGRAM = """
import json, os, pathlib, shutil, signal, sys, time

words = sys.argv[1:]
resumed = "--resume" in words
words = [word for word in words if word != "--resume"]
flags = dict(zip(words[::2], words[1::2]))
folder = pathlib.Path(flags["--logdir"])
folder.mkdir(exist_ok=True)
shutil.copy(pathlib.Path(__file__).with_name("config.json"), folder)
print("resumed" if resumed else "begun", sorted(os.sched_getaffinity(0)))

def leave(*lines):
    with (folder / "metrics.jsonl").open("a") as file:
        for steps, value in lines:
            line = {"env_steps": steps, "updates": steps // 8, "time": 6.0 * steps}
            file.write(json.dumps(line | {"episode/return": value, "loss": 1 / 3}) + "\\n")

if flags["--behave"] == "fail" and flags["--seed"] == "1":
    leave((32, 1.0))
    sys.exit(3)
if flags["--behave"] == "hang":
    def save(*_):
        (folder / "saved").touch()
        sys.exit(143)
    signal.signal(signal.SIGTERM, save)
    (folder / "ready").touch()
    time.sleep(60)
seed = int(flags["--seed"])
leave((32, 1.0 + seed), (64, None), (96, 3.0 + 3 * seed))
(folder / "checkpoints" / "000000000096").mkdir(parents=True)
"""


def make_sweep(folder, *behaviours, **changes):
    """A sweep of runs with these behaviours, with the length of `tiny.CONFIG`."""
    program = folder / "program.py"
    program.write_text(PROGRAM)
    run_folder.write_config(folder, tiny.CONFIG)
    variants = tuple(Variant(name, ("--behave", name)) for name in behaviours)
    given = {"variants": variants, "tasks": ("a/b",), "seeds": (0, 1)} | changes
    return Sweep(program=(sys.executable, str(program)), folder=folder / "runs", **given)


def log(sweep, run):
    return runs.log(sweep, run).read_text()


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A complete sweep in which a seed failed, and its outcome."""
    sweep = make_sweep(tmp_path_factory.mktemp("sweep"), "finish", "fail")
    return sweep, children.run(runs.unfinished_jobs(sweep), at_once=2)


def test_runs_that_fail_are_named_with_their_exit_codes(finished):
    _, outcome = finished
    ((job, code),) = outcome.failed
    assert (job.name, code, outcome.exit_code) == ("a/b fail seed=1", 3, 0)
    assert job.log.name == "a-b-fail-seed1.log"


def test_every_run_has_its_share_of_the_cores(finished):
    sweep, _ = finished
    cores = sorted(os.sched_getaffinity(0))
    shares = {f"begun {cores[i::2]}\n" for i in range(2)}
    assert {log(sweep, run) for run in runs.all_runs(sweep)} <= shares


def test_finished_runs_are_skipped_and_started_runs_are_resumed(tmp_path):
    sweep = make_sweep(tmp_path, "finish", seeds=(0, 1, 2))
    first, second, third = runs.all_runs(sweep)
    children.run(runs.unfinished_jobs(sweep)[:1], at_once=1)
    runs.folder(sweep, second).mkdir()
    run_folder.write_config(runs.folder(sweep, second), tiny.CONFIG)
    assert [runs.finished(sweep, run) for run in (first, second, third)] == [True, False, False]
    assert [job.name for job in runs.unfinished_jobs(sweep)] == [str(second), str(third)]
    assert not children.run(runs.unfinished_jobs(sweep), at_once=1).failed
    assert [log(sweep, run).split()[0] for run in (first, second, third)] == [
        "begun",
        "resumed",
        "begun",
    ]
    assert not runs.unfinished_jobs(sweep)
    longer = runs.dataclasses.replace(sweep, env_steps=97)
    assert len(runs.unfinished_jobs(longer)) == 3


def test_progress_tells_counts_scores_and_the_time_left(tmp_path):
    folders = [tmp_path / name for name in ("a", "b", "c")]
    now, said = [0.0], []

    def reach(folder, env_steps, value):
        folder.mkdir(exist_ok=True)
        run_folder.write_config(folder, tiny.config(env_steps=100))
        line = {"env_steps": env_steps, "episode/return": value}
        with (folder / "metrics.jsonl").open("a") as file:
            file.write(json.dumps(line) + "\n")

    reach(folders[0], 50, 1.0)  # in an earlier sweep
    watch = progress.Progress(folders, say=said.append, clock=lambda: now[0])
    watch.starts("a", folders[0])
    assert said == ["[0 of 3 finished, 1 running, ? left] a: started"]
    now[0] = 3600.0
    reach(folders[0], 100, 2.0)
    watch.ends("a", folders[0], 0)  # half a run an hour, and two are to do
    finished = "[1 of 3 finished, 0 running, 4:00 h left] a: finished"
    assert said[1] == f"{finished}, return 2.0 at 100 env steps"
    watch.starts("b", folders[1])
    watch.look()  # nothing new
    now[0] = 7200.0
    reach(folders[1], 50, None)
    watch.look()
    counts = "[1 of 3 finished, 1 running, 3:00 h left]"
    assert said[3:] == [f"{counts} b: no return yet at 50 env steps"]
    watch.ends("b", folders[1], 7)  # what it lacks is not done
    counts = "[1 of 3 finished, 0 running, 1 failed, 2:00 h left]"
    text = f"{counts} b: failed with exit code 7, no return yet at 50 env steps"
    assert said[4:] == [text]


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_signal_stops_the_children_which_save(tmp_path, number):
    sweep = make_sweep(tmp_path, "hang", seeds=(0, 1, 2))
    folders = [runs.folder(sweep, run) for run in runs.all_runs(sweep)]

    def interrupt():
        deadline = time.monotonic() + 30
        while not all((folder / "ready").exists() for folder in folders[:2]):
            if time.monotonic() > deadline:
                break
            time.sleep(0.02)
        os.kill(os.getpid(), number)

    thread = threading.Thread(target=interrupt)
    thread.start()
    outcome = children.run(runs.unfinished_jobs(sweep), at_once=2)
    thread.join()
    assert outcome == children.Outcome([], 128 + number)
    assert [(folder / "saved").exists() for folder in folders] == [True, True, False]
    assert not folders[2].exists()


def test_children_are_stopped_when_one_cannot_be_started(tmp_path):
    sweep = make_sweep(tmp_path, "hang")
    job, other = runs.unfinished_jobs(sweep)
    ready = runs.folder(sweep, runs.all_runs(sweep)[0]) / "ready"
    wait = "import os, sys, time\nwhile not os.path.exists(sys.argv[1]): time.sleep(0.02)"
    patient = other._replace(command=[sys.executable, "-c", wait, str(ready)])
    with pytest.raises(FileNotFoundError):
        children.run([job, patient, other._replace(command=["/no/such"])], at_once=2)
    assert ready.with_name("saved").exists()


def test_there_is_a_row_for_every_line_with_a_column(finished):
    sweep, _ = finished
    rows = results.read(sweep, results.RETURN | {"loss": "loss", "other": "none"})
    own = [row for row in rows if (row["variant"], row["seed"]) == ("finish", 1)]
    assert [row["env_steps"] for row in own] == [32, 64, 96]
    assert own[1] == {
        "task": "a/b",
        "variant": "finish",
        "seed": 1,
        "env_steps": 64,
        "updates": 8,
        "minutes": 6.4,
        "return": None,
        "loss": 0.33333,
        "other": None,
    }
    assert [row["env_steps"] for row in results.read(sweep)] == [32, 96, 32, 96, 32, 96, 32]


def test_missing_seeds_are_named_and_not_averaged(finished):
    sweep, _ = finished
    longer = runs.dataclasses.replace(sweep, seeds=(0, 1, 2))
    done, failed = results.summarise(longer, results.read(longer))
    assert (done.seeds, failed.seeds) == ((0, 1), (0,))
    assert done.missing == {2: "has no returns"}
    assert failed.missing == {1: "is at 32 of 96 env steps", 2: "has no returns"}
    assert done.last == [3.0, 6.0]
    assert done.best == [3.0, 6.0]
    assert done.area == [2.0, 4.0]
    assert failed.area == [2.0]


def test_a_shorter_sweep_reads_longer_runs_up_to_its_length(finished):
    sweep, _ = finished
    shorter = runs.dataclasses.replace(sweep, env_steps=30)
    rows = results.read(shorter)
    assert {row["env_steps"] for row in rows} == {32}  # the first line at or after 30
    done, _ = results.summarise(shorter, rows)
    assert done.last == [1.0, 2.0]


def test_the_table_equals_one_computed_by_hand(finished):
    sweep, _ = finished
    columns = results.RETURN | {"the_loss": "loss"}
    table = results.markdown(
        results.summarise(sweep, results.read(sweep, columns), columns),
        factor="behaviour",
        command="python it.py",
        notes="Two kinds.",
    )
    # Of 3 and 6, and of 2 and 4: sqrt(4.5 / 2) and sqrt(2 / 2).
    assert table == (
        "Two kinds.\n"
        "\n"
        "| task | behaviour | seeds | last return | best | mean return | the loss | minutes |\n"
        "| --- | --- | --- | --- | --- | --- | --- | --- |\n"
        "| a/b | finish | 2 | 4.5 +- 1.5 | 4.5 +- 1.5 | 3 +- 1 | 0.333 +- 0 | 9.6 |\n"
        "| a/b | fail | **1 of 2** | 3 | 3 | 2 | 0.333 | 9.6 |\n"
        "\n"
        "- Not in the means: a/b, fail, seed 1: is at 32 of 96 env steps.\n"
        "\n"
        "Made by `python it.py`.\n"
    )


def test_a_table_without_metrics_names_the_missing_seeds(tmp_path):
    sweep = make_sweep(tmp_path, "finish", seeds=(4,))
    assert results.read(sweep) == []
    with pytest.raises(RunError, match=str(sweep.folder)):
        results.read_some(sweep)
    table = results.markdown(results.summarise(sweep, []), factor="x", command="c", notes="n")
    assert "| a/b | finish | **0 of 1** | - | - | - | - |" in table
    assert "a/b, finish, seed 4: has no returns" in table


def test_the_error_is_that_of_the_mean_and_a_single_run_has_none():
    values = [812.0, 790.5, 801.25]
    error = np.std(values, ddof=1) / np.sqrt(3)
    assert results.with_error(values) == f"{np.mean(values):.1f} +- {error:.1f}"
    assert results.with_error(values[:1]) == "812.0"
    assert results.with_error([]) == "-"


@pytest.mark.parametrize("count", [2, 3, 20])
def test_the_area_follows_the_trapezoidal_rule(count):
    rng = np.random.default_rng(count)
    steps, values = np.cumsum(rng.integers(1, 9, count)), rng.normal(size=count)
    rows = [{"env_steps": s, "return": v} for s, v in zip(steps, values, strict=True)]
    area = 0.0
    for i in range(count - 1):
        area += (steps[i + 1] - steps[i]) * (values[i] + values[i + 1]) / 2
    np.testing.assert_allclose(results.area(rows), area / (steps[-1] - steps[0]))


def test_the_area_of_uneven_steps_by_hand():
    rows = [{"env_steps": s, "return": v} for s, v in [(10, 1.0), (20, 3.0), (40, 5.0)]]
    assert results.area(rows) == pytest.approx((10 * 2 + 20 * 4) / 30)
    assert results.area(rows[:1]) == 1.0


def test_other_columns_are_means_over_the_last_tenth_of_a_run():
    lines = [(80, 100.0), (90, 10.0), (91, 1.0), (95, 2.0), (100, 6.0)]
    rows = [{"env_steps": steps, "loss": loss} for steps, loss in lines]
    assert results.late_mean(rows, "loss") == (1.0 + 2.0 + 6.0) / 3
    assert results.late_mean(rows[:1], "loss") == 100.0


def test_curves_are_compared_on_their_common_range():
    def curve(*pairs):
        return [{"env_steps": s, "return": v} for s, v in pairs]

    steps, values = figures.interpolated(
        [curve((0, 0.0), (10, 10.0), (20, 0.0)), curve((5, 1.0), (15, 3.0))], "return"
    )
    np.testing.assert_array_equal(steps, [5, 10, 15])
    np.testing.assert_allclose(values, [[5, 10, 5], [1, 2, 3]])


@pytest.mark.parametrize("seeds", ["lines", "band"])
def test_figures_are_drawn_with_a_panel_for_everything(finished, seeds, tmp_path):
    sweep, _ = finished
    rows = results.read(sweep, results.RETURN | {"loss": "loss"})
    sweep = runs.dataclasses.replace(sweep, tasks=("a/b", "never begun"))
    path = tmp_path / "figure.png"
    figures.plot(rows, sweep, path, quantities=("return", "loss"), seeds=seeds)
    data = path.read_bytes()
    width, height = (int.from_bytes(data[i : i + 4], "big") for i in (16, 20))
    assert (width, height) == (2 * 495, 2 * 352)


def test_a_band_leaves_out_the_seed_that_the_table_leaves_out(finished, tmp_path, monkeypatch):
    drawn = analysis_drawings.keep(monkeypatch)
    sweep, _ = finished
    figures.plot(results.read(sweep), sweep, tmp_path / "band.png", seeds="band")
    (panel,) = drawn["band.png"].axes
    lines = analysis_drawings.lines(panel)
    assert lines.keys() == {"finish", "fail (1 of 2 seeds)"}
    np.testing.assert_array_equal(lines["finish"], [1.5, 4.5])
    np.testing.assert_array_equal(lines["fail (1 of 2 seeds)"], [1.0, 3.0])


def test_columns_are_written_in_order_under_their_headings(finished, tmp_path):
    sweep, _ = finished
    path = tmp_path / "table.csv"
    columns = results.RETURN | {"loss": "loss"}
    rows = results.read(sweep, columns)[1:2]
    tables.write_csv(results.headed(rows, "behaviour"), path)
    assert path.read_text() == (
        "task,behaviour,seed,env_steps,updates,minutes,return,loss\n"
        "a/b,finish,0,64,8,6.4,,0.33333\n"
    )


def test_folders_have_plain_names(tmp_path):
    sweep = make_sweep(tmp_path, "static 0.5, on")
    run = Run("vawm/GridWorld-v0", "static 0.5, on", 3)
    name = "vawm-GridWorld-v0-static-0.5-on-seed3"
    assert runs.folder(sweep, run) == tmp_path / "runs" / name
    assert runs.log(sweep, run) == tmp_path / "runs" / f"{name}.log"


@pytest.mark.parametrize(
    ("changes", "field", "value", "named"),
    [
        ({"tasks": ()}, "tasks", (), ()),
        ({"seeds": (1, 1)}, "seeds", (1, 1), ()),
        ({"seeds": (0, -1)}, "seed", -1, ()),
        ({"tasks": ("walker_run", "walker_wlak")}, "task", "walker_wlak", "'walker_walk'"),
        ({"env_steps": 8}, "env_steps", 8, "2048"),
        ({"flags": ("--preset", "quik")}, "preset", "quik", "'quick'"),
        ({"variants": (Variant("a", ("--sede", "1")),)}, "--sede", "1", "--seed"),
    ],
)
def test_options_that_every_run_would_refuse_are_refused_at_once(
    changes, field, value, named, tmp_path
):
    given = {"tasks": ("walker_run",), "variants": (Variant("plain", ()),)} | changes
    with refused(field, value, naming=named):
        runs.check(make_sweep(tmp_path, **given), "dmc_proprio")


EPISODES = "--num-envs", "8", "--replay.batch-size", "2", "--replay.batch-length", "8"


def test_a_sweep_in_which_no_episode_can_end_is_refused(tmp_path):
    given = QUICK | {"flags": EPISODES}
    runs.check(make_sweep(tmp_path, **given, env_steps=8_000), "dmc_proprio")
    with refused("env_steps", 7_999, naming="8000"):
        runs.check(make_sweep(tmp_path, **given, env_steps=7_999), "dmc_proprio")


def test_episodes_of_unknown_length_may_end_at_any_time(tmp_path):
    given = QUICK | {"tasks": ("CartPole-v1",), "flags": EPISODES}
    runs.check(make_sweep(tmp_path, **given, env_steps=200), "gymnasium")


@pytest.mark.parametrize("suite", ["dmc_proprio", "dmc_vision", "atari100k"])
def test_all_stands_for_all_tasks_of_a_suite(suite):
    tasks = runs.named_tasks(suite, ("all",))
    assert len(set(tasks)) == {"dmc_proprio": 18, "dmc_vision": 20, "atari100k": 26}[suite]
    for task in tasks:
        suites.SUITES[suite].check_task(task)
    assert runs.named_tasks(suite, ("a", "b")) == ("a", "b")


def test_all_tasks_of_a_suite_that_cannot_list_them_are_refused():
    with refused("tasks", "all"):
        runs.named_tasks("gymnasium", ("all",))


def test_sweeps_write_to_a_folder_of_their_own():
    for options in (learning_curves.Options(), ablation.Options(), costs.Options()):
        assert options.results.parts[0] == "runs"


QUICK = {"tasks": ("walker_run",), "variants": (Variant("plain", ()),)}


def begin(sweep, run, **changes):
    """Writes the files of a run that was started in a sweep with these changes."""
    config = runs.parsed(runs.dataclasses.replace(sweep, **changes), run, "dmc_proprio")
    runs.folder(sweep, run).mkdir(parents=True)
    run_folder.write_config(runs.folder(sweep, run), config)


def test_a_sweep_does_not_mix_the_warm_ups_of_runs_of_two_lengths(tmp_path):
    sweep = make_sweep(tmp_path, **QUICK, env_steps=80_000)
    first, second = runs.all_runs(sweep)
    begin(sweep, first)
    runs.check(sweep, "dmc_proprio")
    begin(sweep, second, env_steps=40_000)
    named = [str(runs.folder(sweep, second)), "2400", "--runs", "--env-steps 40000"]
    with refused("value_alignment.warmup_steps", 4800, naming=named):
        runs.check(sweep, "dmc_proprio")


def test_a_sweep_of_the_paper_can_be_made_longer(tmp_path):
    """Neither its warm-up nor anything else depends on the length."""
    sweep = make_sweep(tmp_path, **QUICK, env_steps=80_000, flags=("--preset", "paper"))
    for run in runs.all_runs(sweep):
        begin(sweep, run, env_steps=40_000)
    runs.check(sweep, "dmc_proprio")


def test_runs_of_another_preset_are_refused(tmp_path):
    sweep = make_sweep(tmp_path, **QUICK, flags=("--preset", "paper"))
    begin(sweep, runs.all_runs(sweep)[0], flags=())
    with refused("preset", "paper", naming="'quick'"):
        runs.check(sweep, "dmc_proprio")


def test_every_suite_has_a_program():
    folder = pathlib.Path(__file__).parents[2] / "experiments"
    programs = [suite.program for suite in suites.SUITES.values()]
    assert all((folder / name).exists() for name in programs)
    assert len(set(programs)) == len(programs)
