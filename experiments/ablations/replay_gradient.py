"""Ablation of the replay value loss's gradient, crossed with value alignment.

    python experiments/ablations/replay_gradient.py --jobs 2
    python experiments/ablations/replay_gradient.py --scale paper

DreamerV3's critic also learns the values of replayed states, and the gradient of that loss goes
into the world model. So DreamerV3 is value-aware even without L_var, which is the main confound
of comparisons with and without value alignment. Without that gradient, the effect of L_var
alone is visible. STORM has no replay value loss, so it is refused.
"""

from __future__ import annotations

import itertools
import sys
from collections.abc import Sequence

from vawm.cli import command_line
from vawm.errors import InvalidInput
from vawm.runs import validate
from vawm.sweep import ablation
from vawm.sweep.runs import Variant

GRADIENTS = {
    "on": ("--critic.replay-gradient",),
    "off": ("--critic.no-replay-gradient",),
}
ALIGNMENTS = {"adaptive": ablation.ADAPTIVE, "off": ablation.OFF}


def variants(agent: str) -> tuple[Variant, ...]:
    """All four variants; refuses an agent without the loss."""
    if not validate.preset(agent, "dmc_proprio", "quick").critic.replay_scale:
        raise InvalidInput("agent", agent, "has no replay value loss; use dreamerv3")
    return tuple(
        Variant(f"{alignment}, replay gradient {gradient}", ALIGNMENTS[alignment] + words)
        for alignment, (gradient, words) in itertools.product(ALIGNMENTS, GRADIENTS.items())
    )


ABLATION = ablation.Ablation(
    name="replay_gradient",
    title="Value alignment with and without the replay value loss in the world model.",
    variants=variants,
    quick=ablation.QUICK,
    paper=ablation.paper(*ablation.TABLE_3),
    extra=ablation.ALIGNMENT,
)


def main(argv: Sequence[str] | None = None) -> int:
    """Trains and writes the table; returns the exit code, 1 if a run failed."""
    return ablation.main(ABLATION, argv, description=__doc__, script=__file__)


if __name__ == "__main__":
    sys.exit(command_line.guard(main))
