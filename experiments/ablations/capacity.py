"""Ablation of capacity and of image size, each with and without value alignment: Fig. 2.

    python experiments/ablations/capacity.py --jobs 2               # sizes of the model
    python experiments/ablations/capacity.py --vary image --jobs 2  # sizes of images
    python experiments/ablations/capacity.py --scale paper          # Fig. 2a
    python experiments/ablations/capacity.py --vary image --scale paper

Models are up to three of the smallest of the agent: 1m, 12m and 25m of DreamerV3, 1m and 16m of
STORM. Images are 64, 96 and 128 pixels a side, in the paper at its preset's size. VaGraM is
what value alignment is compared with, so `--agent vagram` has no L_var. The quick scale is so
short, for the sake of the large ones, that it shows no more than that everything works: nothing
is learnt in it.
"""

from __future__ import annotations

import itertools
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from vawm import command_line, flags
from vawm import config as config_lib
from vawm.sweep import ablation
from vawm.sweep.runs import Variant

ALIGNMENTS = {"adaptive": ablation.ADAPTIVE, "off": ablation.OFF}
GAMES = ablation.paper("gopher", "krull")
FEW_UPDATES = ("--num-envs", "4", "--train-ratio", "32", "--log-every", "1000")
FEWER_UPDATES = ("--num-envs", "2", "--train-ratio", "16", "--log-every", "500")


@dataclass(frozen=True)
class Options(ablation.Options):
    """Which runs of an ablation, and where they go."""

    vary: Literal["model", "image"] = "model"
    """model: size of the agent, Fig. 2a; image: pixels a side, Fig. 2b"""


def crossed(agent: str, flag: str, sizes: Sequence[str]) -> tuple[Variant, ...]:
    alignments = {"off": ablation.OFF} if agent == "vagram" else ALIGNMENTS
    return tuple(
        Variant(f"{size} {name}", (flag, size, *words))
        for size, (name, words) in itertools.product(sizes, alignments.items())
    )


MODEL = ablation.Ablation(
    name="capacity_model",
    title="Model size and value alignment (Fig. 2a).",
    variants=lambda agent: crossed(agent, "--size", list(config_lib.SIZES[agent])[:3]),
    quick=ablation.QUICK._replace(
        tasks=("cartpole_balance",), seeds=(0,), env_steps=8_000, flags=FEW_UPDATES
    ),
    paper=GAMES,
    factor="size, value alignment",
)
IMAGE = ablation.Ablation(
    name="capacity_image",
    title="Image size and value alignment (Fig. 2b).",
    variants=lambda agent: crossed(agent, "--env.image-size", ("64", "96", "128")),
    quick=ablation.Scale(
        "dmc_vision", "quick", ("cartpole_balance",), (0,), 6_000, FEWER_UPDATES
    ),
    paper=GAMES,
    factor="pixels, value alignment",
)


def main(argv: Sequence[str] | None = None) -> int:
    """Trains and writes the table; returns the exit code, 1 if a run failed."""
    default = Options(results=ablation.results_folder(__file__))
    options = flags.read(Options, argv, default=default, description=__doc__)
    chosen = {"model": MODEL, "image": IMAGE}[options.vary]
    return ablation.run(chosen, options, script=__file__)


if __name__ == "__main__":
    sys.exit(command_line.guard(main))
