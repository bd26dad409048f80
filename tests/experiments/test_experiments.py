"""The scripts beside the main experiment: bad input, and runs that are left to do."""

import dataclasses
import importlib.util
import json
import pathlib
import sys

import pytest
import tiny_storm

from vawm.agent import make_agent
from vawm.cli import command_line
from vawm.runs import run_folder
from vawm.sweep import learning_curves as curves
from vawm.types import EnvSpec, image

FOLDER = pathlib.Path(__file__).parents[2] / "experiments"


def load(name):
    spec = importlib.util.spec_from_file_location(name, FOLDER / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # where dataclasses look their types up
    spec.loader.exec_module(module)
    return module


benchmark, gradient_routes = load("benchmark"), load("gradient_routes")


@pytest.mark.parametrize(
    ("module", "flags", "message"),
    [
        (benchmark, ["--size", "2m"], "size='2m': did you mean"),
        (
            benchmark,
            ["--agent", "storm", "--batch-length", "65"],
            "replay.batch_length=65: ",
        ),
        (benchmark, ["--task", "walker_wlak"], "task='walker_wlak': did you mean"),
        (benchmark, ["--num-envs", "0"], "num_envs=0: use a whole number of at least 1"),
        (benchmark, ["--repeats", "0"], "repeats=0: use a whole number of at least 1"),
        (benchmark, ["--batch-size", "2147483648"], "batch_size=2147483648: use a number"),
        (benchmark, ["--compute-dtype", "float31"], "--compute-dtype='float31': did you"),
        (benchmark, ["--batchsize", "3"], "--batchsize='3': no such flag"),
        (curves, ["--tasks", "walker_wlak"], "task='walker_wlak': did you mean"),
        (curves, ["--alignments", "of"], "alignments='of': did you mean 'off'"),
        (curves, ["--preset", "quik"], "preset='quik': did you mean 'quick'"),
        (
            curves,
            ["--experiment", "gymnasum"],
            "experiment='gymnasum': did you mean 'gymn",
        ),
        (curves, ["--experiment", "gymnasium", "--tasks", "all"], "tasks='all': "),
        (curves, ["--env-steps", "7_999"], "env_steps=7999: "),
        (curves, ["--jobs", "0"], "jobs=0: use a whole number"),
        (curves, ["--env-steps", "0"], "env_steps=0: use a number above 0"),
        (curves, ["--seeds", "a"], "--seeds='a': use a whole number"),
        (curves, ["--seeds", "0", "-1"], "seed=-1: use a number from 0 to 4294967295"),
        (
            curves,
            ["--seeds", "1", "0", "1"],
            "seeds=(1, 0, 1): ",
        ),
        (curves, ["--seeds"], "seeds=(): use at least one"),
        (curves, ["--alignments", "off", "off"], "alignments=('off', 'off'): use at least one"),
        (curves, ["--tasks", *2 * ["walker_run"]], "tasks=('walker_run', 'walker_run'): use"),
        (
            curves,
            ["--results", "/dev/null/a"],
            "results='/dev/null/a': is not writable; choose",
        ),
        (curves, ["--runs", "/dev/null/a"], "runs='/dev/null/a': is not writable; choose anot"),
    ],
)
def test_bad_input_is_one_line_and_code_2(
    module, flags, message, capsys, monkeypatch, tmp_path
):
    monkeypatch.chdir(tmp_path)
    assert command_line.guard(lambda: module.main(flags)) == 2
    output = capsys.readouterr()
    assert output.err.startswith(f"error: {message}")
    assert output.err.count("\n") == 1
    assert not output.out
    assert not list(tmp_path.iterdir())


class FakeUpdate:
    """Takes 1, 2, 3 ... seconds an update; twice as long with value alignment."""

    compile_seconds = 5.0

    def __init__(self, agent, config, batch, aligned):
        self.learner = benchmark.init_learner(agent, config, benchmark.jax.random.key(0))
        self.factor, self.seconds = 1 + aligned, []

    def run(self):
        self.seconds.append(self.factor * (len(self.seconds) + 1.0))


def test_the_benchmark_prints_one_object_of_medians(capsys, monkeypatch):
    monkeypatch.setattr(benchmark, "TimedUpdate", FakeUpdate)
    monkeypatch.setattr(benchmark, "env_steps_per_s", lambda *_: 7.0)
    monkeypatch.setattr(benchmark.jax.config, "update", lambda *_: None)  # the cache stays on
    assert benchmark.main(["--size", "1m", "--json", "--repeats", "4"]) == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed["params"] == 640_867
    assert (printed["update_s_median"], printed["update_s_min"]) == (5.0, 2.0)
    assert (printed["update_s_median_off"], printed["overhead_percent"]) == (2.5, 100.0)
    assert printed["overhead_percent_quartiles"] == [100.0, 100.0]
    assert (printed["compile_s"], printed["env_steps_per_s"]) == (5.0, 7.0)
    assert printed["peak_rss_gb"] > 0


def test_a_benchmark_that_does_not_fit_is_refused(capsys, monkeypatch):
    monkeypatch.setattr(benchmark.budget, "available_bytes", lambda: 2**30)
    monkeypatch.setattr(benchmark.jax.config, "update", lambda *_: None)  # the cache stays on
    assert command_line.guard(lambda: benchmark.main(["--size", "400m"])) == 2
    output = capsys.readouterr()
    assert output.err.startswith("error: size='400m': needs ")
    assert output.err.endswith("1.00 GiB are free; use a smaller size or batch\n")
    assert not output.out


@pytest.fixture
def options(tmp_path):
    return curves.Options(
        tasks=("cartpole_balance",),
        seeds=(0,),
        alignments=("off",),
        runs=tmp_path / "runs",
        results=tmp_path / "results",
    )


def words(options):
    chosen = ["--tasks", *options.tasks, "--alignments", "off", "--seeds", "0"]
    return [*chosen, "--runs", str(options.runs), "--results", str(options.results)]


def test_the_command_of_a_run_says_all_of_it(options):
    sweep = curves.make_sweep(dataclasses.replace(options, env_steps=97))
    (run,) = curves.runs.all_runs(sweep)
    words = curves.runs.command(sweep, run)
    program, flags = words[:5], words[5:]
    assert program == [sys.executable, "-m", "vawm", "train", "dmc_proprio"]
    flags.remove("--no-film")
    assert dict(zip(flags[::2], flags[1::2], strict=True)) == {
        "--agent": "dreamerv3",
        "--task": "cartpole_balance",
        "--preset": "quick",
        "--seed": "0",
        "--value-alignment.weight": "off",
        "--env-steps": "97",
        "--logdir": str(options.runs / "dmc_proprio" / "cartpole_balance-off-seed0"),
    }


def test_a_run_that_failed_is_named_and_half_a_line_survived(options, monkeypatch, capsys):
    sweep = curves.make_sweep(options)
    (run,) = curves.runs.all_runs(sweep)
    folder = curves.runs.folder(sweep, run)
    folder.mkdir(parents=True)
    run_folder.write_config(folder, curves.runs.parsed(sweep, run, "dmc_proprio"))
    line = {"env_steps": 8, "updates": 1, "time": 60.0, "episode/return": 12.34}
    (folder / "metrics.jsonl").write_text(json.dumps(line) + '\n{"env_st')

    def fail(jobs, *, at_once):
        assert at_once == 1
        return curves.children.Outcome([(job, 137) for job in jobs], 0)

    monkeypatch.setattr(curves.children, "run", fail)
    assert curves.main(words(options)) == 1
    output = capsys.readouterr()
    assert "last   12.3" in output.out
    assert "exit code 137" in output.err
    assert "seed=0" in output.err
    table = options.result("csv").read_text().splitlines()
    assert table == [
        "task,alignment,seed,env_steps,updates,minutes,return",
        "cartpole_balance,off,0,8,1,1,12.3",
    ]
    assert options.result("png").stat().st_size


def test_nothing_is_written_when_the_runs_were_stopped(options, monkeypatch, capsys):
    stopped = curves.children.Outcome([], 143)
    monkeypatch.setattr(curves.children, "run", lambda *_, **__: stopped)
    assert curves.main(words(options)) == 143
    assert "stopped" in capsys.readouterr().out
    assert not options.results.exists()


def test_a_missing_matplotlib_is_reported_before_training(options, monkeypatch, capsys):
    monkeypatch.setattr(
        curves.runs.analysis_figures.importlib.util, "find_spec", lambda _: None
    )
    monkeypatch.setattr(curves.children, "run", None)
    assert command_line.guard(lambda: curves.main(words(options))) == 2
    told = capsys.readouterr().err
    assert "matplotlib" in told
    assert "pip install" in told


def test_gradient_routes_are_those_of_the_equations():
    """The prior's head is behind z~ alone, and with h stopped the posterior's behind z."""
    config = tiny_storm.config(world_model=tiny_storm.model(depth=1))
    agent = make_agent(config, EnvSpec("test", image(48), 3, True, 1, 1, None))
    options = gradient_routes.Options(seeds=2, batch_length=4, states=64)
    rows = gradient_routes.routes(agent, config, options)
    assert list(rows) == [
        f"{term}, {deter}"
        for term in ("KL(sg V(s), V(s~))", "KL(V(s), sg V(s~))")
        for deter in ("h live", "h stopped")
    ]
    nothing = [[part == [0.0, 0.0] for part in parts] for parts in rows.values()]
    assert nothing == [[False] * 5, [False] * 5, [True] + 4 * [False], [True] * 2 + [False] * 3]
    kls = gradient_routes.noise(agent, config, options)
    assert kls["shared"][0] == [0.0, 0.0]
    assert min(kls["independent"][0] + kls["shared"][1]) > 0
    text = gradient_routes.table(["factor", "1"], {"a": [[0.125, 0.5]], "b": [[0.0, 0.0]]})
    assert text.splitlines()[2:] == ["| a | 0.12 to 0.5 |", "| b | 0 |"]
