"""The command line: bad input in one line, and the results of a whole analysis."""

import csv
import importlib.util
import json
import os
import pathlib
import re
import shlex
import sys

import analysis_drawings
import imageio.v3 as imageio
import numpy as np
import pytest
import tiny
import tiny_pixels
import tiny_vagram
from analysis_records import make_episodes, make_policy, save_run
from PIL import Image

from vawm.analysis import figures, tables
from vawm.analysis import program as analyse
from vawm.cli import command_line
from vawm.sweep import ablation, runs
from vawm.types import vector

ROOT = pathlib.Path(__file__).parents[2]
# As in the other tests of analysis, so that one of them compiles: steps, seen, and imagined.
LENGTH, CONTEXT, DEPTH = 13, 3, 4
NUMBERS = ("--episodes", "2", "--context", str(CONTEXT), "--depth", str(DEPTH))


def load(name, path):
    spec = importlib.util.spec_from_file_location(name, ROOT / "experiments" / path)
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # where dataclasses look their types up
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("runs")


@pytest.fixture(scope="module")
def run(folder):
    return save_run(folder / "tiny", make_policy(tiny.CONFIG, tiny.env().spec))


@pytest.fixture(scope="module")
def second(folder):
    """As `run`, except for the seed and the steps."""
    policy = make_policy(tiny.config(seed=1), tiny.env().spec, seed=1)
    return save_run(folder / "second", policy, env_steps=16)


@pytest.fixture(scope="module")
def vagram(folder):
    return save_run(folder / "vagram", make_policy(tiny_vagram.CONFIG, tiny.env().spec))


@pytest.fixture(scope="module")
def stranger(folder):
    """A run of the same task that observes more."""
    spec = tiny.env().spec._replace(obs=vector(3))
    return save_run(folder / "stranger", make_policy(tiny.CONFIG, spec))


@pytest.fixture
def offline(monkeypatch):
    """Replaces the cache and the episodes; returns the policies that played."""
    monkeypatch.setattr(analyse.cache, "enable", lambda: None)
    players = []

    def record(policy, *, episodes, seed, how):
        assert how == "sample"
        players.append(policy)
        return make_episodes(policy, episodes=episodes, length=LENGTH, seed=seed)

    monkeypatch.setattr(analyse.episodes, "record", record)
    return players


@pytest.fixture
def drawn(monkeypatch):
    return analysis_drawings.keep(monkeypatch)


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        ([], "--logdirs=None: is required"),
        (["--logdirs"], "logdirs=(): "),
        (["--logdirs", "."], "logdir='.': "),
        (["--logdirs", ".", "--what", "curves"], "logdirs='.': "),
        (["--logdirs", ".", "."], "logdirs=['.', '.']: "),
        (["--logdirs", ".", "--what", "curve"], "--what='curve': did you mean 'curves'"),
        (["--logdirs", ".", "--episodes", "0"], "episodes=0: "),
        (["--logdirs", ".", "--seed", "-1"], "seed=-1: "),
        (["--logdirs", ".", "--frames", "0"], "frames=0: "),
        (["--logdirs", ".", "--every", "-1"], "every=-1: "),
        (["--logdirs", ".", "--output", "/dev/null/a"], "output='/dev/null/a': "),
        (["--logdirs", "RUN", "--depth", "0"], "depth=0: "),
        (["--logdirs", "RUN", "--context", "1"], "context=1: "),
        (["--logdirs", "RUN", "--player", "."], "logdir='.': "),
        (
            ["--logdirs", "RUN", "STRANGER", "--player", "RUN"],
            "player='obs ShapeDtypeStruct(shape=(2,), dtype=float32)': stranger was trained "
            "with ShapeDtypeStruct(shape=(3,), dtype=float32)",
        ),
        (
            ["--logdirs", "RUN", "--player", "STRANGER"],
            "player='obs ShapeDtypeStruct(shape=(3,)",
        ),
        (["--logdirs", "RUN", "--dept", "3"], "--dept='3': "),
    ],
)
def test_bad_input_is_one_line_and_code_2(
    flags, message, run, stranger, capsys, monkeypatch, tmp_path
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(analyse, "play", None)  # nothing is computed
    flags = [{"RUN": run, "STRANGER": stranger}.get(word, word) for word in flags]
    assert command_line.guard(lambda: analyse.main(flags)) == 2
    output = capsys.readouterr()
    assert output.err.startswith(f"error: {message}")
    assert output.err.count("\n") == 1
    assert not output.out
    assert not list(tmp_path.iterdir())


def test_a_missing_package_is_reported_before_anything_is_computed(run, capsys, monkeypatch):
    monkeypatch.setattr(figures.importlib.util, "find_spec", lambda _: None)
    monkeypatch.setattr(analyse, "play", None)
    assert command_line.guard(lambda: analyse.main(["--logdirs", run])) == 2
    told = capsys.readouterr().err
    assert "matplotlib" in told
    assert "pip install" in told
    assert told.count("\n") == 1


def test_a_whole_analysis(run, offline, tmp_path, capsys):
    output = tmp_path / "results"
    flags = ["--logdirs", run, "--output", str(output), "--frames", "2", *NUMBERS]
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
    assert files == expected | {"summary.json", "film_tiny.gif"}
    assert all((output / name).stat().st_size for name in files)
    with (output / "values.csv").open() as file:
        rows = [row for row in csv.DictReader(file) if row["measure"] == "value"]
    assert [row["depth"] for row in rows] == ["0", "1", "2", "3", "4"]
    assert [row["mean"] == "0" for row in rows] == [True] + DEPTH * [False]
    summary = json.loads((output / "summary.json").read_text())
    assert len(summary["tiny"]["returns"]) == 2
    assert summary["tiny"]["player"] == "tiny"
    assert "value error by depth\n  tiny" in capsys.readouterr().out


@pytest.fixture
def judged(monkeypatch):
    """The episodes that runs are judged on, in order."""
    records, report = [], analyse.values.report

    def keep(policy, record, **choices):
        records.append(record)
        return report(policy, record, **choices)

    monkeypatch.setattr(analyse.values, "report", keep)
    return records


def test_one_run_plays_for_all(run, second, vagram, offline, judged, drawn, tmp_path, capsys):
    """Two seeds are one group, with errors over runs; each model has its own memory."""
    flags = ["--logdirs", run, second, vagram, "--player", second, "--output", str(tmp_path)]
    flags += ["--what", "values", *NUMBERS]
    assert analyse.main(flags) == 0
    (player,) = offline
    assert player.config.seed == 1
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert {own["player"] for own in summary.values()} == {second}
    returns = make_episodes(player, episodes=2, length=LENGTH).returns
    for own in summary.values():
        np.testing.assert_allclose(own["returns"], returns, atol=1e-3)
    assert all(record.trajectory is judged[0].trajectory for record in judged)
    memories = [np.asarray(record.memory.deter)[:, 1:] for record in judged]
    for memory, other in zip(memories, memories[1:] + memories[:1], strict=True):
        assert (abs(memory - other).max(-1) > 0).all()

    groups = [own["group"] for own in summary.values()]
    assert groups[0] == groups[1] != groups[2]

    with (tmp_path / "values.csv").open() as file:
        rows = {(row["run"], row["measure"], row["depth"]): row for row in csv.DictReader(file)}
    label = f"{groups[0]} (2 runs)"
    for measure in ("value", "relative_return", "latent_kl"):
        own = [float(rows[name, measure, "2"]["mean"]) for name in ("tiny", "second")]
        pooled = rows[label, measure, "2"]
        assert own[0] != own[1]
        assert float(pooled["mean"]) == pytest.approx(np.mean(own), rel=1e-4)
        error = abs(own[0] - own[1]) / 2  # of two
        assert float(pooled["standard_error"]) == pytest.approx(error, rel=1e-4, abs=1e-6)
        assert (pooled["over"], pooled["count"]) == ("runs", "2")
        assert rows["vagram", measure, "2"]["over"] == "episodes"
    value, relative = (rows["vagram", name, "1"] for name in ("value", "relative_value"))
    ratio = float(value["mean"]) / float(value["spread"])
    assert float(relative["mean"]) == pytest.approx(ratio, rel=1e-4)

    lines = analysis_drawings.lines(drawn["values_by_depth.png"].axes[0])
    assert list(lines) == [label, "vagram"]
    for name, line in lines.items():
        expected = [float(rows[name, "value", str(k)]["mean"]) for k in range(DEPTH + 1)]
        np.testing.assert_allclose(line, expected, rtol=1e-4)
    output = capsys.readouterr().out
    assert output.startswith(second)
    assert output.count(f"{second} ") == 1
    assert f"{groups[0]}: its runs are at 8, 16 environment steps" in output


def test_a_group_is_uneven_if_its_runs_differ_by_more_than_they_exceed_their_length():
    policy = make_policy(tiny.CONFIG, tiny.env().spec)

    def at(*steps):
        return [analyse.Played("a", policy._replace(env_steps=n), None) for n in steps]

    groups = {"alike": at(1000, 1010), "apart": at(1000, 1011, 500), "one": at(7)}
    expected = ["apart: its runs are at 500, 1000, 1011 environment steps"]
    assert analyse.uneven(groups) == expected


@pytest.fixture(scope="module")
def pixels(folder):
    """The folder of a run from pixels, and episodes that its policy has played."""
    with pytest.MonkeyPatch.context() as patch:
        env = tiny_pixels.pool()
        patch.setattr(analyse.evaluate.suites, "make", lambda config: env)
        policy = make_policy(tiny_pixels.CONFIG, env.spec)
        record = analyse.episodes.record(policy, episodes=2, seed=0)
    return save_run(folder / "pixels", policy), record


@pytest.fixture
def from_pixels(pixels, drawn, monkeypatch, tmp_path):
    """Analyses that run; returns its episodes, and the frames of films as they were written."""
    logdir, record = pixels
    frames, write = {}, analyse.movies.write_mp4

    def keep(film, path, **choices):
        frames[path.name] = film
        write(film, path, **choices)

    monkeypatch.setattr(analyse.cache, "enable", lambda: None)
    monkeypatch.setattr(analyse.episodes, "record", lambda *_, **__: record)
    monkeypatch.setattr(analyse.movies, "write_mp4", keep)

    def main(*flags):
        assert analyse.main(["--logdirs", logdir, "--output", str(tmp_path), *flags]) == 0
        return record, frames

    return main


def test_imagined_pixels_are_a_strip_and_a_film(from_pixels, drawn, tmp_path):
    record, written = from_pixels("--what", "trajectories", "--context", "2", "--depth", "2")
    truth = np.asarray(record.trajectory.obs["picture"])[0, 1:5]
    columns = 4
    shown = analysis_drawings.pictures(drawn["trajectories_pixels.png"])
    np.testing.assert_array_equal(shown[:columns], truth)
    assert (np.asarray(shown[columns : 2 * columns]) != truth).any()
    assert "coordinates_pixels.png" in drawn

    (frames,) = written.values()
    film = imageio.imread(tmp_path / "trajectories_pixels.mp4", plugin="FFMPEG")
    assert film.shape == (4, 3 * 3 * 48, 3 * 2 * 48, 3)  # enlarged; 3 rows of 2 windows
    seen = film[:, 1::3, 1::3].astype(float)
    apart = abs(seen[:, None] - frames[None]).mean((2, 3, 4))
    assert (apart.argmin(1) == np.arange(4)).all()  # every frame in its place
    assert apart.diagonal().max() < 8

    with (tmp_path / "trajectories.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert {row["kind"] for row in rows} == {"image", "vector"}


def test_truth_imagination_and_value_are_a_gif(from_pixels, tmp_path):
    record, _ = from_pixels("--what", "film", "--context", "2", "--depth", "2")
    with Image.open(tmp_path / "film_pixels.gif") as film:
        assert film.n_frames == 4
        first = np.asarray(film.convert("RGB"), float)
    truth = np.asarray(record.trajectory.obs["picture"])[0, 1]
    panel = first[28 : 28 + 288, :288]
    np.testing.assert_allclose(panel.mean(), truth.mean(), atol=8)


def test_saliency_is_drawn_over_pixels(from_pixels, drawn, tmp_path):
    record, _ = from_pixels("--what", "saliency", "--context", "3", "--frames", "2")
    truth = np.asarray(record.trajectory.obs["picture"])[0, [2, 4]]
    shown = analysis_drawings.pictures(drawn["saliency_pixels.png"])
    assert len(shown) == 5 * 2  # observed, decoded and three maps
    np.testing.assert_array_equal(shown[:2], truth)
    assert "saliency_vectors.png" in drawn
    with (tmp_path / "saliency.csv").open() as file:
        rows = {(row["map"], row["what"]): float(row["value"]) for row in csv.DictReader(file)}
    for kind in ("sensitivity", "value", "observed"):
        assert 0.1 < rows[kind, "concentration"] < 1
        assert rows[kind, "coordinate 0"] > 0


def expanded(word):
    """Expands braces as bash does."""
    found = re.search(r"\{([^}]*)\}", word)
    if not found:
        return {word}
    choices = found[1].split(",")
    return set().union(*(expanded(word.replace(found[0], one, 1)) for one in choices))


def test_the_guide_names_the_folders_of_its_ablations():
    """Another command has trained the runs for its figures."""
    guide = (ROOT / "docs" / "guides" / "analysis.md").read_text()
    weight = load("weight", "ablations/weight.py")
    trains = r"^python experiments/ablations/weight.py (.*)\n(\w)=(.*)$"
    found = re.findall(trains, guide, re.MULTILINE)
    assert len(found) == 2
    for flags, variable, where in found:
        options = analyse.flags.read(ablation.Options, shlex.split(flags))
        sweep = ablation.make_sweep(weight.ABLATION, options)
        folders = {str(runs.folder(sweep, own)) for own in runs.all_runs(sweep)}
        words = re.findall(rf"\${variable}(-\S+)", guide)
        assert len(words) >= 4
        assert set().union(*(expanded(where + word) for word in words)) <= folders


def test_runs_are_named_by_unique_parts_of_their_paths():
    paths = [pathlib.Path(path) for path in ("/a/x/run", "/a/y/run", "/a/y/other")]
    assert analyse.run_names(paths[1:]) == ["run", "other"]
    assert analyse.run_names(paths) == ["x-run", "y-run", "y-other"]


def test_names_of_runs_are_printable_and_leave_room_for_endings():
    paths = [pathlib.Path("/a") / name for name in (os.fsdecode(b"\xff\n[1]"), 250 * "n" + "1")]
    assert analyse.run_names(paths) == [r"\xff\n[1]", 49 * "n" + "1"]


def test_rows_and_objects_are_written_as_they_are(tmp_path):
    tables.write_csv(
        [{"a": 1, "b": 0.1234567891}, {"a": "x", "b": float("nan")}], tmp_path / "a"
    )
    assert (tmp_path / "a").read_text() == "a,b\n1,0.123457\nx,\n"
    tables.write_json({"a": {"b": float("inf"), "c": [1.5]}}, tmp_path / "b")
    assert json.loads((tmp_path / "b").read_text()) == {"a": {"b": None, "c": [1.5]}}
