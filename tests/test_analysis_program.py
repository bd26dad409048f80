"""experiments/analyse.py: bad input in one line, and what a whole run of it leaves behind."""

import csv
import importlib.util
import json
import pathlib
import sys

import jax
import numpy as np
import pytest
import tiny
import tiny_storm

from vawm import checkpoint, command_line, rundir, train
from vawm.agent import make_agent
from vawm.analysis import figures, tables
from vawm.analysis.saliency import Look, Saliency
from vawm.analysis.trajectories import Trajectories

PATH = pathlib.Path(__file__).parents[1] / "experiments" / "analyse.py"
spec = importlib.util.spec_from_file_location("analyse", PATH)
analyse = importlib.util.module_from_spec(spec)
sys.modules["analyse"] = analyse  # where dataclasses look their types up
spec.loader.exec_module(analyse)


def save(logdir, config):
    """An untrained run in `logdir`, with two lines of metrics."""
    env = tiny.env()
    agent = make_agent(config, env.spec)
    state = jax.jit(lambda key: train.init(env, agent, config, key))(jax.random.key(3))
    checkpoint.save(logdir, state, env_steps=8, config=config, spec=env.spec, progress={})
    rundir.write_config(logdir, config)
    lines = [{"env_steps": n, "latent/kl": n / 8, "loss/dynamics": None} for n in (8, 16)]
    (logdir / "metrics.jsonl").write_text("".join(json.dumps(x) + "\n" for x in lines))
    return str(logdir)


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs")
    return save(folder / "rssm", tiny.CONFIG), save(folder / "storm", tiny_storm.CONFIG)


@pytest.fixture
def offline(monkeypatch):
    """No cache but that of the tests, and episodes of the probe that `save` is of."""
    monkeypatch.setattr(analyse.cache, "enable", lambda: None)

    def record(policy, *, episodes, seed, how):
        env = tiny.env()
        return analyse.episodes.record_in(env, policy, episodes=episodes, seed=seed, how=how)

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
        (["--logdirs", "RSSM", "--depth", "0"], "depth=0: use a whole number of at least 1"),
        (["--logdirs", "RSSM", "--context", "1"], "context=1: use at least 2"),
        (
            ["--logdirs", "RSSM", "STORM", "--context", "3", "--depth", "6"],
            "depth=6: use at most 5 after the context",
        ),
        (
            ["--logdirs", "RSSM", "--dept", "3"],
            "--dept='3': no such flag; did you mean --depth",
        ),
    ],
)
def test_bad_input_is_one_line_and_code_2(flags, message, runs, capsys, monkeypatch, tmp_path):
    places = dict(zip(("RSSM", "STORM"), runs, strict=True))
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(analyse, "play", None)  # nothing is computed
    flags = [places.get(word, word) for word in flags]
    assert command_line.guard(lambda: analyse.main(flags)) == 2
    output = capsys.readouterr()
    assert output.err.startswith(f"error: {message}")
    assert output.err.count("\n") == 1
    assert not output.out
    assert not list(tmp_path.iterdir())


def test_a_missing_package_is_told_before_anything_is_computed(runs, capsys, monkeypatch):
    monkeypatch.setattr(figures.importlib.util, "find_spec", lambda _: None)
    monkeypatch.setattr(analyse, "play", None)
    assert command_line.guard(lambda: analyse.main(["--logdirs", runs[0]])) == 1
    assert capsys.readouterr().err.startswith("error: matplotlib is missing: pip install")


def test_all_of_it_on_both_agents(runs, offline, tmp_path, capsys):
    output = tmp_path / "results"
    flags = ["--logdirs", *runs, "--output", str(output), "--episodes", "2"]
    flags += ["--depth", "2", "--context", "2", "--frames", "2"]
    assert analyse.main(flags) == 0
    files = {path.name for path in output.iterdir()}
    own = {
        f"{what}_{run}.png" for what in ("values", "coordinates") for run in ("rssm", "storm")
    }
    common = {"values_by_depth.png", "saliency_vectors.png", "curves.png", "summary.json"}
    tables = {"values.csv", "trajectories.csv", "saliency.csv", "curves.csv"}
    assert files == own | common | tables
    assert all((output / name).stat().st_size for name in files)
    with (output / "values.csv").open() as file:
        rows = list(csv.DictReader(file))
    zero = [row["mean"] for row in rows if row["measure"] == "value" and row["depth"] == "0"]
    assert zero == ["0", "0"]
    unknown = [
        row["mean"] for row in rows if (row["run"], row["measure"]) == ("storm", "latent_kl")
    ]
    assert unknown == 3 * [""]
    summary = json.loads((output / "summary.json").read_text())
    assert len(summary["rssm"]["returns"]) == 2
    assert "value error by depth\n  rssm" in capsys.readouterr().out


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
    look = Look(np.array([3, 4]), truth[:, 0], seen)
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
