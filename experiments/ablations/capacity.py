"""Ablation of model size and image size, with and without value alignment, and VaGraM: Fig. 2.

    python experiments/ablations/capacity.py --jobs 2               # sizes of the model
    python experiments/ablations/capacity.py --vary image --jobs 2  # sizes of images
    python experiments/ablations/capacity.py --scale paper          # Fig. 2a
    python experiments/ablations/capacity.py --vary image --scale paper

Model sizes are the three smallest of the agent: 1m, 12m and 25m of DreamerV3, 1m and 16m of
STORM. Images have 64, 96 and 128 pixels per side; with the scale `paper`, the model size is the
preset's. VaGraM has the sizes and presets of DreamerV3 and is compared with it, not with STORM.

The quick scale is short because of the large models: batches of 2 x 32 steps, one seed, 8,000
or 6,000 environment steps, and a little more than twice the 300 updates of the learning-rate
warm-up of DreamerV3 and VaGraM. It shows that everything works at every size, how long a run
takes, and what the table looks like. It cannot show which size or method is better: at its end,
agents have hardly started to learn.
"""

from __future__ import annotations

import itertools
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from vawm.agent import registry
from vawm.cli import command_line, flags
from vawm.errors import InvalidInput
from vawm.sweep import ablation
from vawm.sweep.runs import Variant

ALIGNMENTS = {"adaptive": ablation.ADAPTIVE, "off": ablation.OFF}
VAGRAM = {"vagram": ("--agent", "vagram", *ablation.OFF)}
GAMES = ablation.paper("gopher", "krull")
SMALL_BATCHES = ("--replay.batch-size", "2", "--replay.batch-length", "32")
FEW_STATES = ("--num-envs", "4", "--train-ratio", "24", "--log-every", "1000", *SMALL_BATCHES)
FEW_IMAGES = ("--num-envs", "2", "--train-ratio", "32", "--log-every", "500", *SMALL_BATCHES)


@dataclass(frozen=True)
class Options(ablation.Options):
    """The runs of an ablation, and their folder."""

    vary: Literal["model", "image"] = "model"
    """model: size of the agent, Fig. 2a; image: pixels per side, Fig. 2b"""


def crossed(agent: str, flag: str, sizes: Sequence[str]) -> tuple[Variant, ...]:
    """Every size with every method.

    Raises:
      InvalidInput: for VaGraM, which is one of the methods.
    """
    if agent == "vagram":
        raise InvalidInput("agent", agent, "use dreamerv3, whose table includes vagram")
    methods = ALIGNMENTS | VAGRAM if agent == "dreamerv3" else ALIGNMENTS
    return tuple(
        Variant(f"{size} {name}", (flag, size, *words))
        for size, (name, words) in itertools.product(sizes, methods.items())
    )


MODEL = ablation.Ablation(
    name="capacity_model",
    title="Model size, value alignment and VaGraM (Fig. 2a).",
    variants=lambda agent: crossed(agent, "--size", list(registry.kind(agent).sizes)[:3]),
    quick=ablation.QUICK._replace(
        tasks=("cartpole_balance",), seeds=(0,), env_steps=8_000, flags=FEW_STATES
    ),
    paper=GAMES,
    factor="size, method",
)
IMAGE = ablation.Ablation(
    name="capacity_image",
    title="Image size, value alignment and VaGraM (Fig. 2b).",
    variants=lambda agent: crossed(agent, "--env.image-size", ("64", "96", "128")),
    quick=ablation.Scale("dmc_vision", "quick", ("cartpole_balance",), (0,), 6_000, FEW_IMAGES),
    paper=GAMES,
    factor="pixels, method",
)


def main(argv: Sequence[str] | None = None) -> int:
    """Trains and writes the table; returns the exit code, 1 if a run failed."""
    options = flags.read(Options, argv, description=__doc__)
    chosen = {"model": MODEL, "image": IMAGE}[options.vary]
    return ablation.run(chosen, options, script=__file__)


if __name__ == "__main__":
    sys.exit(command_line.guard(main))
