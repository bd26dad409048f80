"""Ablation of the cost of value alignment: time and memory of a whole training step, Table 4.

    python experiments/ablations/overhead.py
    python experiments/ablations/overhead.py --scale paper
    python experiments/ablations/overhead.py --agent storm --scale paper

Needs no whole runs and no seeds: a process with value alignment and one without it (and without
its metrics) take turns, including environments and replay. Absolute times depend on the
machine; the overhead is the median over pairs. Peak memory is that of the accelerator; on a CPU
it is XLA's plan for a step: arguments (including replay), results and temporaries.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

from vawm.cli import command_line
from vawm.sweep import ablation, costs
from vawm.sweep.runs import Variant

VARIANTS = (Variant("adaptive", ablation.ADAPTIVE), Variant("off", ablation.OFF))
ABLATION = ablation.Ablation(
    name="overhead",
    title="Time and memory of a whole training step (Table 4).",
    variants=lambda agent: VARIANTS,
    quick=ablation.QUICK,
    paper=ablation.paper("krull"),
)


def main(argv: Sequence[str] | None = None) -> int:
    """Measures and writes the table; returns the exit code."""
    return costs.main(ABLATION, argv, description=__doc__, script=__file__)


if __name__ == "__main__":
    sys.exit(command_line.guard(main))
