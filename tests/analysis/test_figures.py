"""Pictures: they show the numbers of the analysis."""

import pathlib

import analysis_drawings
import numpy as np
import pytest
from PIL import Image

from vawm.analysis import figures, values
from vawm.analysis.curves import Curve
from vawm.analysis.saliency import Look, Saliency
from vawm.analysis.trajectories import Trajectories
from vawm.losses.transforms import symlog

PATH = pathlib.Path("a.png")


@pytest.fixture
def drawn(monkeypatch):
    return analysis_drawings.keep(monkeypatch)


def band(axes, index=0):
    """Lower and upper edge of the band, at every depth."""
    x, y = axes.collections[index].get_paths()[0].vertices.T
    return np.array([[y[x == at].min(), y[x == at].max()] for at in np.unique(x)]).T


def report():
    """Two episodes, of four states and of two."""
    rng = np.random.default_rng(0)
    errors = {name: rng.uniform(1, 2, (2, 3)) for name in values.MEASURES}
    errors["latent_kl"] = np.full((2, 3), np.nan)
    return values.Report(
        by_depth=values.ErrorByDepth(states={}, errors=errors),
        first=1,
        value=rng.normal(size=(2, 4)),
        imagined=rng.normal(size=(2, 4, 3)),
        returns=rng.normal(size=(2, 4)),
        bootstrapped=rng.normal(size=(2, 4)),
        counts=np.array([4 * [True], 2 * [True] + 2 * [False]]),
        spread=1.0,
    )


def test_errors_by_depth_are_lines_with_bands(drawn):
    one = report()
    members = one.by_depth._replace(
        units="runs", errors={m: e + 1 for m, e in one.by_depth.errors.items()}
    )
    entries = {"one": one, "several (2 runs)": values.Group(members, 1.0)}
    figures.value_errors(entries, PATH)
    figure = drawn[PATH.name]
    panels = [ax for ax in figure.axes if ax.get_visible()]
    found = [name for name in values.MEASURES if name != "latent_kl"]  # of none
    assert [ax.get_title() for ax in panels] == [figures.LABELS[name] for name in found]
    for name, ax in zip(found, panels, strict=True):
        lines = analysis_drawings.lines(ax)
        assert list(lines) == list(entries)
        for index, (label, entry) in enumerate(entries.items()):
            mean, error = entry.by_depth.mean(name), entry.by_depth.standard_error(name)
            np.testing.assert_allclose(lines[label], mean)
            np.testing.assert_allclose(band(ax, index), [mean - error, mean + error])
    (legend,) = figure.legends
    assert [text.get_text() for text in legend.get_texts()] == list(entries)


def test_values_over_time_and_against_returns(drawn):
    one = report()
    figures.values("run", one, PATH, rollouts=2)
    over_time, against = drawn[PATH.name].axes
    lines = analysis_drawings.lines(over_time)
    np.testing.assert_array_equal(lines["return"], one.returns[0])
    np.testing.assert_array_equal(lines["bootstrapped return"], one.bootstrapped[0])
    np.testing.assert_array_equal(lines["V of inferred states"], one.value[0])
    np.testing.assert_array_equal(lines["V of imagined states"], one.imagined[0, 0])
    assert len(over_time.lines) == 3 + 2
    np.testing.assert_array_equal(over_time.lines[-1].get_data(), [[4], one.imagined[0, 3, :1]])
    points, *_ = against.lines
    inside = one.counts.ravel()
    assert np.isnan(points.get_ydata()[~inside]).all()
    np.testing.assert_array_equal(points.get_xdata()[inside], one.returns.ravel()[inside])
    np.testing.assert_array_equal(points.get_ydata()[inside], one.value.ravel()[inside])


def windows():
    """A picture and two numbers; the last of five steps is outside the first episode."""
    rng = np.random.default_rng(0)
    truth = {
        "picture": rng.integers(0, 256, (2, 5, 48, 48, 3), dtype=np.uint8),
        "vector": rng.normal(size=(2, 5, 2)).astype(np.float32),
    }
    told = {
        "picture": rng.uniform(-0.1, 1.1, (2, 5, 48, 48, 3)).astype(np.float32),
        "vector": rng.normal(size=(2, 5, 2)).astype(np.float32),
    }
    inside = np.array([[True] * 4 + [False], [True] * 5])
    return Trajectories(np.array([3, 1]), truth, told, inside, context=2)


def test_a_strip_has_truth_imagination_and_difference(drawn):
    shown = windows()
    figures.strip("run", shown, PATH, every=2)
    figure, steps = drawn[PATH.name], [1, 3]  # the last seen, and every second from there
    assert [ax.get_title() for ax in figure.axes[:2]] == ["seen", "+2"]
    truth, guess, difference = np.array(analysis_drawings.pictures(figure)).reshape(
        3, 2, 48, 48, 3
    )
    np.testing.assert_array_equal(truth, shown.truth["picture"][0, steps])
    told = np.clip(shown.predicted["picture"][0, steps], 0, 1)
    np.testing.assert_allclose(guess, 255 * told, atol=0.5)
    np.testing.assert_allclose(difference, (255 * told - truth + 255) / 2, atol=1)


def test_a_strip_is_a_png_of_as_many_columns_as_fit(tmp_path):
    figures.strip("run", windows(), tmp_path / "strip.png")
    width, height = Image.open(tmp_path / "strip.png").size
    assert width == pytest.approx(4 * 1.15 * figures.DPI, abs=1)  # of five, four are inside
    assert height == pytest.approx(3 * 1.2 * figures.DPI, abs=1)


def test_coordinates_are_drawn_inside_the_episode(drawn):
    shown = windows()
    figures.coordinates("run", shown, PATH)
    for i, ax in enumerate(drawn[PATH.name].axes):
        lines = analysis_drawings.lines(ax)
        np.testing.assert_allclose(lines["truth"], symlog(shown.truth["vector"][0, :4, i]))
        np.testing.assert_array_equal(lines["imagined"], shown.predicted["vector"][0, :4, i])
        assert ax.lines[0].get_xdata().tolist() == [3, 4, 5, 6]
        assert ax.lines[2].get_xdata()[0] == 4  # the last that was seen


def look(unit="symlog"):
    rng = np.random.default_rng(1)
    truth = {
        "picture": rng.integers(0, 256, (2, 48, 48, 3), dtype=np.uint8),
        "vector": rng.normal(size=(2, 3)).astype(np.float32),
    }
    decoded = {"picture": rng.uniform(-0.1, 1.1, (2, 48, 48, 3)), "vector": truth["vector"]}
    maps = [
        {"picture": rng.uniform(size=(2, 48, 48)), "vector": rng.uniform(size=(2, 3))}
        for _ in range(3)
    ]
    return Look(np.array([3, 4]), truth, Saliency(decoded, *maps, np.array([0.5, 2.0])), unit)


def test_maps_are_drawn_over_the_observed_images(drawn):
    seen = look()
    figures.saliency_images("run", seen, PATH)
    figure = drawn[PATH.name]
    assert [ax.get_title() for ax in figure.axes[:2]] == [
        "step 3, symlog V 0.5",
        "step 4, symlog V 2",
    ]
    pictures = np.array(analysis_drawings.pictures(figure)).reshape(5, 2, 48, 48, 3)
    truth = seen.truth["picture"]
    np.testing.assert_array_equal(pictures[0], truth)
    told = np.clip(seen.saliency.decoded["picture"], 0, 1)
    np.testing.assert_allclose(pictures[1], 255 * told, atol=0.5)
    for row, kind in zip(pictures[2:], figures.MAPS, strict=True):
        maps = getattr(seen.saliency, kind)["picture"]
        np.testing.assert_array_equal(row, figures.heat(truth, maps))


def test_a_map_that_is_missing_has_no_row(drawn):
    seen = look()
    alone = seen._replace(
        truth=seen.truth["picture"],
        saliency=Saliency(
            seen.saliency.decoded["picture"],
            seen.saliency.sensitivity["picture"],
            np.zeros((2, 48, 48)),
            None,
            seen.saliency.states,
        ),
    )
    figures.saliency_images("run", alone, PATH)
    assert len(drawn[PATH.name].axes) == 4 * 2


def test_maps_of_coordinates_are_bars_by_run(drawn):
    first = look()
    second = first.saliency._replace(value={**first.truth, "vector": np.ones((2, 3))})
    looks = {"a": first, "b": first._replace(saliency=second)}
    figures.saliency_vectors(looks, PATH)
    for kind, ax in zip(figures.MAPS, drawn[PATH.name].axes, strict=True):
        for bars, (name, seen) in zip(ax.containers, looks.items(), strict=True):
            assert bars.get_label() == name
            expected = getattr(seen.saliency, kind)["vector"].mean(0)
            np.testing.assert_allclose([bar.get_height() for bar in bars], expected)


def test_curves_are_lines_with_bands_over_thousands_of_steps(drawn):
    steps = np.array([1000, 3000])
    several = Curve(steps, np.array([2.0, 3.0]), np.array([1.0, 2.0]), np.array([4.0, 6.0]), 3)
    single = Curve(steps, *3 * [np.array([5.0, 4.0])], 1)
    found = {"a": {"latent/kl": several, "loss/dynamics": single}, "b": {"latent/kl": single}}
    figures.curves(found, PATH)
    dynamics, kl = drawn[PATH.name].axes
    assert (dynamics.get_title(), kl.get_title()) == ("loss/dynamics", "latent/kl")
    lines = analysis_drawings.lines(kl)
    assert list(lines) == ["a (3 seeds)", "b"]
    np.testing.assert_array_equal(lines["a (3 seeds)"], several.mean)
    np.testing.assert_array_equal(kl.lines[0].get_xdata(), [1, 3])
    np.testing.assert_array_equal(band(kl), [several.low, several.high])


def test_heat_is_dark_grey_for_zeros_and_coloured_elsewhere():
    seen = np.full((1, 2, 2, 3), 200, np.uint8)
    maps = np.zeros((1, 2, 2))
    np.testing.assert_array_equal(figures.heat(seen, maps), np.full((1, 2, 2, 3), 100))
    maps[0, 0, 0] = 1.0
    heated = figures.heat(seen, maps)
    np.testing.assert_array_equal(heated[0, 1], np.full((2, 3), 100))
    assert len(set(heated[0, 0, 0].tolist())) > 1


def test_any_name_of_a_run_is_drawn_as_it_is(tmp_path):
    """`$` is not mathematics, and `_` does not leave a run out of the legend."""
    name = r"_a$x_{$ \frac$"
    with figures.panels(tmp_path / "[1]*\n.png", 1, 1, size=(3, 3)) as axes:
        axes[0, 0].plot([0, 1], [0, 1], label=figures.plain(name))
        shown = axes[0, 0].legend().get_texts()
    assert [text.get_text().replace(r"\$", "$").strip() for text in shown] == [name]
    assert list(tmp_path.iterdir())
