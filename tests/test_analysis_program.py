"""experiments/analyse.py: bad input in one line, and what a whole run of it leaves behind."""

import csv
import importlib.util
import json
import pathlib
import sys

import numpy as np
import pytest
import tiny
import toy
from analysis_records import make_episodes, make_policy

from vawm import checkpoint, command_line, rundir
from vawm.analysis import figures, tables
from vawm.analysis.saliency import Look, Saliency
from vawm.analysis.trajectories import Trajectories

PATH = pathlib.Path(__file__).parents[1] / "experiments" / "analyse.py"
spec = importlib.util.spec_from_file_location("analyse", PATH)
analyse = importlib.util.module_from_spec(spec)
sys.modules["analyse"] = analyse  # where dataclasses look their types up
spec.loader.exec_module(analyse)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """The folder of a run that saved what acting needs, with two lines of metrics."""
    logdir = tmp_path_factory.mktemp("runs") / "tiny"
    logdir.mkdir()
    policy = make_policy(tiny.CONFIG, tiny.env().spec)
    state = toy.state()
    state = state._replace(learner=state.learner._replace(params=policy.params))
    checkpoint.save(
        logdir, state, env_steps=8, config=policy.config, spec=policy.spec, progress={}
    )
    rundir.write_config(logdir, policy.config)
    lines = [{"env_steps": n, "latent/kl": n / 8, "loss/dynamics": None} for n in (8, 16)]
    (logdir / "metrics.jsonl").write_text("".join(json.dumps(x) + "\n" for x in lines))
    return str(logdir)


@pytest.fixture
def offline(monkeypatch):
    """No cache but that of the tests, and made-up episodes."""
    monkeypatch.setattr(analyse.cache, "enable", lambda: None)

    def record(policy, *, episodes, seed, how):
        assert how == "sample"
        return make_episodes(policy, episodes=episodes, length=6, seed=seed)

    monkeypatch.setattr(analyse.episodes, "record", record)


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        ([], "--logdirs=None: is required"),
        (["--logdirs"], "logdirs=(): name the folder of at least one run"),
        (["--logdirs", "."], "logdir='.': holds no checkpoint"),
        (["--logdirs", ".", "--what", "curves"], "logdirs='.': holds no metrics"),
        (["--logdirs", ".", "."], "logdirs=['.', '.']: name each run once"),
        (["--logdirs", ".", "--what", "curve"], "--what='curve': did you mean 'curves'"),
        (["--logdirs", ".", "--episodes", "0"], "episodes=0: use a whole number of at least 1"),
        (["--logdirs", ".", "--seed", "-1"], "seed=-1: use a number from 0"),
        (["--logdirs", ".", "--frames", "0"], "frames=0: use a whole number of at least 1"),
        (["--logdirs", ".", "--every", "-1"], "every=-1: use 0 or a number above"),
        (
            ["--logdirs", ".", "--output", "/dev/null/a"],
            "output='/dev/null/a': is not writable",
        ),
        (["--logdirs", "RUN", "--depth", "0"], "depth=0: use a whole number of at least 1"),
        (["--logdirs", "RUN", "--context", "1"], "context=1: use at least 2"),
        (
            ["--logdirs", "RUN", "--dept", "3"],
            "--dept='3': no such flag; did you mean --depth",
        ),
    ],
)
def test_bad_input_is_one_line_and_code_2(flags, message, run, capsys, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(analyse, "play", None)  # nothing is computed
    flags = [run if word == "RUN" else word for word in flags]
    assert command_line.guard(lambda: analyse.main(flags)) == 2
    output = capsys.readouterr()
    assert output.err.startswith(f"error: {message}")
    assert output.err.count("\n") == 1
    assert not output.out
    assert not list(tmp_path.iterdir())


def test_a_missing_package_is_told_before_anything_is_computed(run, capsys, monkeypatch):
    monkeypatch.setattr(figures.importlib.util, "find_spec", lambda _: None)
    monkeypatch.setattr(analyse, "play", None)
    assert command_line.guard(lambda: analyse.main(["--logdirs", run])) == 1
    assert capsys.readouterr().err.startswith("error: matplotlib is missing: pip install")


def test_all_of_it(run, offline, tmp_path, capsys):
    output = tmp_path / "results"
    flags = ["--logdirs", run, "--output", str(output), "--episodes", "2"]
    flags += ["--depth", "2", "--context", "2", "--frames", "2"]
    assert analyse.main(flags) == 0
    files = {path.name for path in output.iterdir()}
    pictures = {
        "values_by_depth",
        "saliency_vectors",
        "curves",
        "values_tiny",
        "coordinates_tiny",
    }
    written = {"values", "trajectories", "saliency", "curves"}
    expected = {f"{name}.png" for name in pictures} | {f"{name}.csv" for name in written}
    assert files == expected | {"summary.json"}
    assert all((output / name).stat().st_size for name in files)
    with (output / "values.csv").open() as file:
        rows = [row for row in csv.DictReader(file) if row["measure"] == "value"]
    assert [row["depth"] for row in rows] == ["0", "1", "2"]
    assert [row["mean"] == "0" for row in rows] == [True, False, False]
    summary = json.loads((output / "summary.json").read_text())
    assert len(summary["tiny"]["returns"]) == 2
    assert "value error by depth\n  tiny" in capsys.readouterr().out


def test_runs_are_named_by_what_tells_them_apart():
    paths = [pathlib.Path(path) for path in ("/a/x/run", "/a/y/run", "/a/y/other")]
    assert analyse.names(paths[1:]) == ["run", "other"]
    assert analyse.names(paths) == ["x-run", "y-run", "y-other"]


def test_rows_and_objects_are_written_as_they_are(tmp_path):
    tables.write_csv(
        [{"a": 1, "b": 0.1234567891}, {"a": "x", "b": float("nan")}], tmp_path / "a"
    )
    assert (tmp_path / "a").read_text() == "a,b\n1,0.123457\nx,\n"
    tables.write_json({"a": {"b": float("inf"), "c": [1.5]}}, tmp_path / "b")
    assert json.loads((tmp_path / "b").read_text()) == {"a": {"b": None, "c": [1.5]}}


def test_pictures_of_pixels_are_drawn(tmp_path):
    rng = np.random.default_rng(0)
    truth = rng.integers(0, 256, (2, 5, 48, 48, 3), dtype=np.uint8)
    told = rng.uniform(-0.1, 1.1, truth.shape).astype(np.float32)
    inside = np.array([[True] * 4 + [False], [True] * 5])
    shown = Trajectories(np.array([1, 1]), truth, told, inside, context=2)
    figures.strip("run", shown, tmp_path / "strip.png", every=2)
    maps = rng.uniform(size=(2, 48, 48))
    seen = Saliency(told[:, 0], maps, 0 * maps, None, np.ones(2))
    look = Look(np.array([3, 4]), truth[:, 0], seen, "symlog")
    figures.saliency_images("run", look, tmp_path / "saliency.png")
    assert all((tmp_path / name).stat().st_size for name in ("strip.png", "saliency.png"))


def test_heat_is_dark_grey_where_a_map_is_zero_and_colour_where_it_is_not():
    seen = np.full((1, 2, 2, 3), 200, np.uint8)
    maps = np.zeros((1, 2, 2))
    np.testing.assert_array_equal(figures.heat(seen, maps), np.full((1, 2, 2, 3), 100))
    maps[0, 0, 0] = 1.0
    heated = figures.heat(seen, maps)
    np.testing.assert_array_equal(heated[0, 1], np.full((2, 3), 100))
    assert len(set(heated[0, 0, 0].tolist())) > 1
