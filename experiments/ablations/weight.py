"""Ablation of the weight of value alignment: adaptive, static or none.

    python experiments/ablations/weight.py --jobs 2
    python experiments/ablations/weight.py --agent storm --scale paper
    python experiments/ablations/weight.py --agent storm --scale paper --tasks kung_fu_master

The second command is for Table 3, the third for Figs 9-11, where the paper finds that a static
weight of 50 aligns values at the cost of the dynamics. `ablation_weight_..._curves.png` shows
the dynamics loss, L_var before its weight, the weight and the KL of the latents over time, as
Fig. 9. `experiments/analyse.py --what trajectories --logdirs RUNS` draws trajectories as in
Figs 10 and 11.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

from vawm.cli import command_line
from vawm.sweep import ablation
from vawm.sweep.runs import Variant


def static(weight: str) -> Variant:
    chosen = ("--value-alignment.weight", "static", "--value-alignment.static-weight", weight)
    return Variant(f"static {weight}", chosen)


VARIANTS = (
    Variant("adaptive", ablation.ADAPTIVE),
    static("0.5"),
    static("50"),
    Variant("off", ablation.OFF),
)
ABLATION = ablation.Ablation(
    name="weight",
    title="The weight of value alignment (Table 3, Fig. 9).",
    variants=lambda agent: VARIANTS,
    quick=ablation.QUICK,
    paper=ablation.paper(*ablation.TABLE_3),
    factor="weight",
    extra=ablation.ALIGNMENT,
)


def main(argv: Sequence[str] | None = None) -> int:
    """Trains and writes the table; returns the exit code, 1 if a run failed."""
    return ablation.main(ABLATION, argv, description=__doc__, script=__file__)


if __name__ == "__main__":
    sys.exit(command_line.guard(main))
