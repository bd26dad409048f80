"""Analyses what value alignment does in trained runs; writes PNG, MP4, GIF, CSV and JSON.

    vawm analyse --logdirs runs/aligned runs/plain
    vawm analyse --logdirs runs/aligned --what values --episodes 20 --depth 15
    vawm analyse --logdirs runs/aligned runs/plain --player runs/plain

    trajectories   imagination against the truth, Figs 3 and 7
    saliency       what decoder and value depend on, Figs 3 and 13
    values         value errors by depth of imagination, and actual returns
    film           truth, imagination and value side by side, as a GIF; for vectors, coordinates
                   over time, truth against imagination
    curves         losses and the weight of value alignment in training, Figs 8, 9 and 12

Plays whole episodes of every run in its own environments; everything but `curves` uses these.
With `--player` one run plays, and all runs are judged on its episodes. Runs that differ only in
their seed are one group: its mean value errors have standard errors over runs. Works for every
agent, from vectors and from pixels. Needs the extra `analysis`.
"""

from __future__ import annotations

import pathlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import jax

from vawm import evaluate
from vawm.analysis import (
    curves,
    episodes,
    figures,
    film,
    inference,
    motion,
    saliency,
    tables,
    trajectories,
    values,
)
from vawm.analysis.episodes import Episodes
from vawm.cli import flags
from vawm.config import Config
from vawm.envs import coordinates
from vawm.envs.protocol import check_positive
from vawm.errors import InvalidInput
from vawm.policy import Policy, load, movies
from vawm.process import cache
from vawm.process.names import shown
from vawm.runs import checkpoint, run_folder
from vawm.types import is_image

FRAMES_PER_SECOND = 5  # slow enough to compare
FILM_FRAMES_PER_SECOND = 10
LONGEST_NAME = 50  # characters of a run in the names of files


@dataclass(frozen=True)
class Options:
    """The runs to analyse, the analyses, and the folder of the results."""

    logdirs: tuple[pathlib.Path, ...]
    """folders of runs"""
    what: Literal["all", "trajectories", "saliency", "film", "values", "curves"] = "all"
    """one of the analyses, or all that fit the runs"""
    output: pathlib.Path = pathlib.Path("analysis")
    """folder of the results; existing files are overwritten"""
    episodes: int = 5
    """whole episodes of every run"""
    depth: int = 20
    """steps of imagination"""
    context: int = 8
    """observed steps before imagination; a transformer infers every state from this many"""
    frames: int = 6
    """states with saliency maps"""
    every: int = 0
    """steps between columns of a strip; 0 for as many columns as fit"""
    unit: Literal["symlog", "raw"] = "symlog"
    """unit of the value in saliency"""
    how: Literal["sample", "mode"] = "sample"
    """sample actions from the policy, or take its mode"""
    player: pathlib.Path | None = None
    """folder of the run whose episodes all runs are judged on; by default each run plays its
    own"""
    seed: int = 0
    """of the episodes, and of everything that is sampled"""

    def wants(self, what: str) -> bool:
        return self.what in ("all", what)


class Loaded(NamedTuple):
    """Runs by name, and the policy that plays for all; policies only if they are needed."""

    policies: dict[str, Policy]
    runs: dict[str, curves.Run]
    player: Policy | None


class Played(NamedTuple):
    """A run, and the episodes that it is judged on."""

    name: str
    policy: Policy
    record: Episodes

    @property
    def config(self) -> Config:
        return self.policy.config


def run_names(logdirs: Sequence[pathlib.Path]) -> list[str]:
    """Names of the runs: the last parts of each path, as few as make them unique.

    They are printable, and leave room for the rest of a file's name.
    """
    parts = [path.absolute().parts for path in logdirs]
    for count in range(1, max(map(len, parts)) + 1):
        joined = ["-".join(own[-count:]).replace("/", "") for own in parts]
        found = [shown(name)[-LONGEST_NAME:] for name in joined]
        if len(set(found)) == len(found):
            return found
    raise InvalidInput("logdirs", [str(path) for path in logdirs], "give each run once")


def prepare(options: Options) -> Loaded:
    """Checks the options and reads the runs.

    Raises:
      InvalidInput: names the option, its value and the remedy, or a package to install.
    """
    evaluate.check(options.episodes, options.seed)
    check_positive("frames", options.frames)
    if options.every < 0:
        raise InvalidInput("every", options.every, "use 0 or a number above")
    if not options.logdirs:
        raise InvalidInput("logdirs", (), "give the folder of at least one run")
    folders = [checkpoint.expanded(path, "logdirs") for path in options.logdirs]
    called = dict(zip(run_names(folders), folders, strict=True))
    run_folder.check_writable(options.output, "output")
    figures.check()
    plays = options.what != "curves"
    loaded = Loaded(
        policies={name: load(path) for name, path in called.items() if plays},
        runs={
            name: curves.read(path) for name, path in called.items() if options.wants("curves")
        },
        player=load(options.player) if plays and options.player else None,
    )
    for name, policy in loaded.policies.items():
        check(options, name, policy, loaded.player)
    return loaded


def check(options: Options, name: str, policy: Policy, player: Policy | None) -> None:
    """Refuses a run that the options cannot be applied to."""
    if player is not None:
        episodes.check_can_watch(name, policy.spec, player.spec)
    inference.check(policy.config, context=options.context, depth=options.depth)
    if options.wants("trajectories") and has_images(policy):
        movies.check()


def has_images(policy: Policy) -> bool:
    return any(map(is_image, jax.tree.leaves(policy.spec.obs)))


def show_curves(options: Options, runs: dict[str, curves.Run]) -> None:
    found = curves.curves(curves.group(list(runs.values())))
    tables.write_csv(curves.rows(found), options.output / "curves.csv")
    figures.curves(found, options.output / "curves.png")


def show_trajectories(options: Options, played: Sequence[Played]) -> None:
    rows = []
    for name, policy, record in played:
        shown = trajectories.imagine(
            policy, record, context=options.context, depth=options.depth, seed=options.seed
        )
        rows += trajectories.rows(name, shown)
        kinds = trajectories.errors(shown)
        if "image" in kinds:
            figures.strip(
                name, shown, options.output / f"trajectories_{name}.png", every=options.every
            )
            path = options.output / f"trajectories_{name}.mp4"
            movies.write_mp4(trajectories.film(shown), path, per_second=FRAMES_PER_SECOND)
        if "vector" in kinds:
            figures.coordinates(name, shown, options.output / f"coordinates_{name}.png")
    tables.write_csv(rows, options.output / "trajectories.csv")


def show_saliency(options: Options, played: Sequence[Played]) -> None:
    looks = {
        name: saliency.look(
            policy,
            record,
            context=options.context,
            frames=options.frames,
            seed=options.seed,
            unit=options.unit,
        )
        for name, policy, record in played
    }
    rows: list[dict[str, Any]] = []
    with_vectors = {}
    for name, look in looks.items():
        rows += saliency.rows(name, look)
        if saliency.images(look.truth, look.saliency.value) is not None:
            figures.saliency_images(name, look, options.output / f"saliency_{name}.png")
        if saliency.coordinates(look.truth, look.saliency.value) is not None:
            with_vectors[name] = look
    if with_vectors:
        figures.saliency_vectors(with_vectors, options.output / "saliency_vectors.png")
    tables.write_csv(rows, options.output / "saliency.csv")


def show_film(options: Options, played: Sequence[Played]) -> None:
    for name, policy, record in played:
        if not has_images(policy):
            show_motion(options, name, policy, record)
        else:
            made = film.make(
                policy,
                record,
                context=options.context,
                depth=options.depth,
                seed=options.seed,
                unit=options.unit,
            )
            path = options.output / f"film_{name}.gif"
            movies.write_gif(film.frames(made), path, per_second=FILM_FRAMES_PER_SECOND)


def show_motion(options: Options, name: str, policy: Policy, record: Episodes) -> None:
    """The film of a run that observes vectors."""
    window = trajectories.imagine(
        policy,
        record,
        context=options.context,
        depth=options.depth,
        seed=options.seed,
        at_most=1,
    )
    size = sum(leaf.shape[0] for leaf in jax.tree.leaves(policy.spec.obs))
    shown = motion.frames(window, coordinates.names(policy.spec.task, size))
    path = options.output / f"film_{name}.gif"
    movies.write_gif(shown, path, per_second=FILM_FRAMES_PER_SECOND)


def show_values(options: Options, played: Sequence[Played]) -> None:
    """Writes and prints the value errors, and names groups of unequal length."""
    reports = {
        name: values.report(
            policy, record, context=options.context, depth=options.depth, seed=options.seed
        )
        for name, policy, record in played
    }
    groups = curves.group(played)
    pooled = values.pooled(
        reports, {group: [run.name for run in runs] for group, runs in groups.items()}
    )
    entries = reports | pooled
    rows = [row for name, entry in entries.items() for row in values.rows(name, entry)]
    tables.write_csv(rows, options.output / "values.csv")
    figures.value_errors(pooled, options.output / "values_by_depth.png")
    for name, report in reports.items():
        figures.values(name, report, options.output / f"values_{name}.png")
    print(values.table(entries))
    for line in uneven(groups):
        print(line)


def uneven(groups: Mapping[str, Sequence[Played]]) -> list[str]:
    """Names the groups with runs of different length.

    A run may exceed its env steps by a few, so differences up to 1 % are ignored.
    """
    lines = []
    for group, runs in groups.items():
        steps = sorted({run.policy.env_steps for run in runs})
        if steps[-1] - steps[0] > steps[-1] / 100:
            listed = ", ".join(map(str, steps))
            lines.append(f"{group}: its runs are at {listed} environment steps")
    return lines


def play(options: Options, loaded: Loaded) -> list[Played]:
    """Records the episodes of every run, or of the one that plays for all.

    Writes their returns to `summary.json`.
    """

    def record(name: str, policy: Policy) -> Episodes:
        found = episodes.record(
            policy, episodes=options.episodes, seed=options.seed, how=options.how
        )
        print(f"{name}: {evaluate.Score(tuple(found.returns))}", flush=True)
        return found

    if loaded.player is None:
        played = [
            Played(name, policy, record(name, policy))
            for name, policy in loaded.policies.items()
        ]
    else:
        shared = record(f"{options.player} (plays for all runs)", loaded.player)
        played = [
            Played(name, policy, episodes.watched_by(policy, shared, seed=options.seed))
            for name, policy in loaded.policies.items()
        ]
    tables.write_json(summary(options, played), options.output / "summary.json")
    return played


def summary(options: Options, played: Sequence[Played]) -> dict[str, dict[str, Any]]:
    """For each run: its group, and the episodes that it is judged on."""
    return {
        run.name: {
            "group": group,
            "seed": run.config.seed,
            "env_steps": run.policy.env_steps,
            "player": run.name if options.player is None else str(options.player),
            "returns": [round(float(x), 3) for x in run.record.returns],
            "steps": [int(x) for x in run.record.length],
        }
        for group, runs in curves.group(played).items()
        for run in runs
    }


def main(argv: Sequence[str] | None = None) -> int:
    """Analyses the runs; returns the exit code."""
    options = flags.read(Options, argv, description=__doc__)
    loaded = prepare(options)
    options.output.mkdir(parents=True, exist_ok=True)
    cache.enable()
    if options.wants("curves"):
        show_curves(options, loaded.runs)
    if loaded.policies:
        played = play(options, loaded)
        for what, show in {
            "trajectories": show_trajectories,
            "saliency": show_saliency,
            "film": show_film,
            "values": show_values,
        }.items():
            if options.wants(what):
                show(options, played)
    print(f"results are in {shown(options.output)}")
    return 0
