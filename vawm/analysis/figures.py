"""Draws the numbers of this package to PNG; imports matplotlib only when drawing."""

from __future__ import annotations

import contextlib
import importlib.util
import pathlib
from collections.abc import Iterator, Mapping
from typing import Any

import jax
import numpy as np

from vawm.analysis import saliency
from vawm.analysis.curves import METRICS, Curves
from vawm.analysis.saliency import Look
from vawm.analysis.trajectories import Trajectories, vectors
from vawm.analysis.values import MEASURES, Group, Report
from vawm.errors import InvalidInput
from vawm.runs.reports import video

DPI = 110
COLUMNS = 12  # of a strip, at most
COORDINATES = 8  # panels of a plot of vectors, at most

LABELS = {
    "value": "|V(imagined) - V(inferred)|",
    "return": "|V(imagined) - return|",
    "bootstrapped": "|V(imagined) - bootstrapped return|",
    "reward": "|imagined reward - reward|",
    "value_kl": "KL of the critic's distributions (nats)",
    "latent_kl": "KL of posterior and prior (nats)",
    "distance": "half squared distance of z, mean over categoricals",
    "relative_value": "|V(imagined) - V(inferred)| / spread",
    "relative_return": "|V(imagined) - return| / spread",
    "relative_bootstrapped": "|V(imagined) - bootstrapped return| / spread",
}
MAPS = {
    "sensitivity": "decoder's sensitivity to z",
    "value": "weighted by dV/dz",
    "observed": "dV/dx of the input",
}


def check() -> None:
    """Checks that matplotlib is installed.

    Raises:
      InvalidInput: names the package and the command that installs it.
    """
    if importlib.util.find_spec("matplotlib") is None:
        raise InvalidInput("matplotlib", "not installed", "pip install 'vawm[analysis]'")


def plain(name: str) -> str:
    r"""The name of a run as text of a figure.

    Matplotlib would typeset what is between two `$`, and leave names that begin with `_` out of
    legends.
    """
    return name.replace("$", r"\$").replace("_", " _", 1 if name.startswith("_") else 0)


@contextlib.contextmanager
def panels(
    path: pathlib.Path, rows: int, columns: int, *, size: tuple[float, float]
) -> Iterator[np.ndarray]:
    """Yields `[rows, columns]` axes of `size` inches each, and saves them to `path`."""
    check()
    from matplotlib.figure import Figure  # not pyplot, which would change the caller's backend

    figure = Figure(figsize=(size[0] * columns, size[1] * rows), layout="constrained")
    yield figure.subplots(rows, columns, squeeze=False)
    figure.savefig(path, dpi=DPI)


def value_errors(entries: Mapping[str, Report | Group], path: pathlib.Path) -> None:
    """Draws every measure by depth, with a line per run or group of runs.

    Bands are standard errors over the episodes of a run or the runs of a group.
    """
    shown = [
        measure
        for measure in MEASURES
        if any(np.isfinite(run.by_depth.errors[measure]).any() for run in entries.values())
    ]
    columns = min(4, len(shown))
    with panels(path, -(-len(shown) // columns), columns, size=(3.6, 2.9)) as axes:
        for ax in axes.ravel()[len(shown) :]:
            ax.set_visible(False)
        for ax, measure in zip(axes.ravel(), shown, strict=False):
            for color, (name, run) in enumerate(entries.items()):
                mean = run.by_depth.mean(measure)
                error = np.nan_to_num(run.by_depth.standard_error(measure))
                depth = np.arange(len(mean))
                ax.plot(depth, mean, color=f"C{color}", label=plain(name))
                ax.fill_between(
                    depth, mean - error, mean + error, color=f"C{color}", alpha=0.2, lw=0
                )
            ax.set_title(LABELS[measure], fontsize=9)
            ax.set_xlabel("steps of imagination", fontsize=9)
            ax.set_ylim(bottom=0)
        _legend_below(axes)


def values(name: str, report: Report, path: pathlib.Path, *, rollouts: int = 12) -> None:
    """Draws values: left, one episode over time with imagined rollouts; right, all episodes."""
    value, returns, bootstrapped = (
        np.where(report.counts, x, np.nan)
        for x in (report.value, report.returns, report.bootstrapped)
    )
    truths = {"return": (returns, "0.6")}
    if np.nan_to_num(bootstrapped - returns).any():  # truncated by a time limit
        truths["bootstrapped return"] = bootstrapped, "C2"
    with panels(path, 1, 2, size=(5.6, 3.6)) as axes:
        over_time, against = axes[0]
        time = report.first + np.arange(value.shape[1])
        length = int(report.counts[0].sum())
        for label, (truth, color) in truths.items():
            over_time.plot(time, truth[0], color=color, label=label)
            against.plot(
                truth.ravel(), value.ravel(), ".", ms=3, alpha=0.4, color=color, label=label
            )
        over_time.plot(time, value[0], color="C0", label="V of inferred states")
        for i in np.unique(np.linspace(0, max(0, length - 1), rollouts).astype(int)):
            steps = min(report.imagined.shape[2], length - i)
            over_time.plot(
                time[i] + np.arange(steps),
                report.imagined[0, i, :steps],
                color="C3",
                lw=1,
                label="V of imagined states" if i == 0 else None,
            )
        over_time.set(title=plain(name), xlabel="step of the first episode")
        known = np.concatenate([truth.ravel() for truth, _ in truths.values()])
        if np.isfinite(known).any():
            ends = [np.nanmin(known), np.nanmax(known)]
            against.plot(ends, ends, color="0.3", lw=1)
        against.set(title="all episodes", xlabel="return", ylabel="V of inferred states")
        over_time.legend(fontsize=8)
        against.legend(fontsize=8, markerscale=3)


def strip(name: str, trajectories: Trajectories, path: pathlib.Path, *, every: int = 0) -> None:
    """Draws truth, imagination and difference of the first window, a column per shown step.

    Args:
      name: of the run.
      trajectories: with images.
      path: of the PNG.
      every: steps between columns; 0 for as many columns as fit.
    """
    truth = video.side_by_side(trajectories.truth)[0]
    guess = video.side_by_side(
        jax.tree.map(video.to_bytes, trajectories.predicted, trajectories.truth)
    )[0]
    difference = ((guess.astype(int) - truth + 255) // 2).astype(np.uint8)
    length = max(1, int(trajectories.inside[0].sum()))
    every = every or -(-length // COLUMNS)
    # Such that the last observed step is one of the columns.
    shown = range((trajectories.context - 1) % every, length, every)
    wide = truth.shape[2] / truth.shape[1]
    with panels(path, 3, len(shown), size=(1.15 * wide, 1.2)) as axes:
        for column, t in enumerate(shown):
            ahead = t + 1 - trajectories.context
            title = f"+{ahead}" if ahead > 0 else f"seen {ahead}" if ahead else "seen"
            axes[0, column].set_title(title, fontsize=8, color="C3" if ahead > 0 else "C2")
            for row, picture in enumerate((truth, guess, difference)):
                _show(axes[row, column], picture[t])
        for row, label in enumerate(("truth", "imagined", "difference")):
            axes[row, 0].set_ylabel(label, fontsize=8)
        axes[0, 0].figure.suptitle(
            f"{plain(name)}, from step {trajectories.start[0]} of an episode", fontsize=9
        )


def _show(ax: Any, picture: np.ndarray) -> None:
    ax.imshow(picture, interpolation="nearest")
    ax.set(xticks=[], yticks=[])
    for spine in ax.spines.values():
        spine.set_visible(False)


def coordinates(name: str, trajectories: Trajectories, path: pathlib.Path) -> None:
    """Draws coordinates of the first window over time, at most those that vary most."""
    truth, guess = (x[0] for x in vectors(trajectories))
    inside = trajectories.inside[0]
    moving = np.argsort(-truth[inside].std(0), kind="stable")[:COORDINATES]
    columns = min(4, len(moving))
    time = trajectories.start[0] + np.arange(len(truth))
    with panels(path, -(-len(moving) // columns), columns, size=(3.2, 2.2)) as axes:
        for ax in axes.ravel()[len(moving) :]:
            ax.set_visible(False)
        for ax, i in zip(axes.ravel(), np.sort(moving), strict=False):
            ax.plot(time[inside], truth[inside, i], color="0.5", label="truth")
            ax.plot(time[inside], guess[inside, i], color="C3", label="imagined")
            ax.axvline(time[trajectories.context - 1], color="C2", lw=1, label="last seen")
            ax.set_title(f"symlog of coordinate {i}", fontsize=9)
        axes[0, 0].legend(fontsize=8)
        axes[0, 0].figure.suptitle(
            f"{plain(name)}, one window by step of its episode", fontsize=9
        )


def saliency_images(name: str, look: Look, path: pathlib.Path) -> None:
    """Draws the observed and the decoded images, and each map as heat over the observed ones.

    The colours of a map range from 0 to its 99.5th percentile over all shown frames.
    """
    seen = video.side_by_side(jax.tree.map(lambda x: x[:, None], look.truth))[:, 0]
    told = jax.tree.map(lambda x: x[:, None], look.saliency.decoded)
    told = jax.tree.map(video.to_bytes, told, jax.tree.map(lambda x: x[:, None], look.truth))
    decoded = video.side_by_side(told)[:, 0]
    maps = {
        label: saliency.images(look.truth, getattr(look.saliency, kind))
        for kind, label in MAPS.items()
    }
    heats = {label: heat(seen, found) for label, found in maps.items() if found is not None}
    rows = {"observed": seen, "decoded": decoded} | heats
    wide = seen.shape[2] / seen.shape[1]
    with panels(path, len(rows), len(seen), size=(1.5 * wide, 1.55)) as axes:
        for row, (label, pictures) in enumerate(rows.items()):
            axes[row, 0].set_ylabel(label, fontsize=7)
            for column, picture in enumerate(pictures):
                _show(axes[row, column], picture)
        name_of_v = "V" if look.unit == "raw" else "symlog V"
        for column, (step, value) in enumerate(
            zip(look.step, look.saliency.states, strict=True)
        ):
            axes[0, column].set_title(f"step {step}, {name_of_v} {value:.3g}", fontsize=7)
        axes[0, 0].figure.suptitle(plain(name), fontsize=9)


def heat(seen: np.ndarray, maps: np.ndarray) -> np.ndarray:
    """Colours `[F, H, W, 3]` uint8 of `maps` `[F, H, W]`, over a dark grey copy of `seen`."""
    from matplotlib import colormaps

    top = np.quantile(maps, 0.995)
    strength = np.clip(maps / top, 0, 1) if top > 0 else np.zeros_like(maps)
    grey = seen.mean(-1, keepdims=True) / 255
    share = strength[..., None] ** 0.5
    colors = colormaps["inferno"](0.25 + 0.75 * strength)[..., :3]
    return np.round(255 * ((1 - share) * 0.5 * grey + share * colors)).astype(np.uint8)


def saliency_vectors(looks: Mapping[str, Look], path: pathlib.Path) -> None:
    """Draws each map by coordinate, as the mean over frames, with a colour per run."""
    with panels(path, 1, len(MAPS), size=(4.2, 3)) as axes:
        for ax, (kind, label) in zip(axes[0], MAPS.items(), strict=True):
            for number, (name, look) in enumerate(looks.items()):
                found = saliency.coordinates(look.truth, getattr(look.saliency, kind))
                assert found is not None
                width = 0.8 / len(looks)
                place = np.arange(found.shape[1]) + (number + 0.5) * width - 0.4
                ax.bar(place, found.mean(0), width, label=plain(name))
            ax.set_title(label, fontsize=9)
            ax.set_xlabel("coordinate", fontsize=9)
        axes[0, 0].legend(fontsize=8)


def curves(all_curves: Curves, path: pathlib.Path) -> None:
    """Draws a panel per metric and a colour per group; bands from lowest to highest seed."""
    shown = [metric for metric in METRICS if any(metric in own for own in all_curves.values())]
    columns = min(3, max(1, len(shown)))
    with panels(path, max(1, -(-len(shown) // columns)), columns, size=(3.6, 3)) as axes:
        for ax in axes.ravel()[len(shown) :]:
            ax.set_visible(False)
        for ax, metric in zip(axes.ravel(), shown, strict=False):
            for color, (name, own) in enumerate(all_curves.items()):
                if metric in own:
                    line = own[metric]
                    steps = line.env_steps / 1000
                    seeds = f" ({line.seeds} seeds)" if line.seeds > 1 else ""
                    ax.plot(steps, line.mean, color=f"C{color}", label=plain(name) + seeds)
                    ax.fill_between(
                        steps, line.low, line.high, color=f"C{color}", alpha=0.2, lw=0
                    )
            ax.set_title(metric, fontsize=9)
            ax.set_xlabel("thousand environment steps", fontsize=9)
        _legend_below(axes)


def _legend_below(axes: np.ndarray) -> None:
    """Puts one legend with the names of all panels below them."""
    named: dict[str, Any] = {}
    for ax in axes.ravel():
        handles, labels = ax.get_legend_handles_labels()
        named |= dict(zip(labels, handles, strict=True))
    figure = axes[0, 0].figure
    figure.legend(list(named.values()), list(named), loc="outside lower center", fontsize=8)
