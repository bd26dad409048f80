"""Ablation of the gradient of L_var through h: live, or stopped at the critic's input.

    python experiments/ablations/deter_gradient.py --jobs 2
    python experiments/ablations/deter_gradient.py --scale paper

V(s) and V(s~) share h. If the gradient is live, L_var may also change h such that the critic
depends less on z; if it is stopped, L_var can only change z and z~.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

from vawm.cli import command_line
from vawm.sweep import ablation
from vawm.sweep.runs import Variant

VARIANTS = tuple(
    Variant(gradient, (*ablation.ADAPTIVE, "--value-alignment.deter-gradient", gradient))
    for gradient in ("live", "stop")
)
ABLATION = ablation.Ablation(
    name="deter_gradient",
    title="The gradient of L_var through h, live or stopped.",
    variants=lambda agent: VARIANTS,
    quick=ablation.QUICK,
    paper=ablation.paper(*ablation.TABLE_3),
    factor="gradient through h",
    extra=ablation.ALIGNMENT,
)


def main(argv: Sequence[str] | None = None) -> int:
    """Trains and writes the table; returns the exit code, 1 if a run failed."""
    return ablation.main(ABLATION, argv, description=__doc__, script=__file__)


if __name__ == "__main__":
    sys.exit(command_line.guard(main))
