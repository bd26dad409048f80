"""Ablation of the noise with which z and z~ are sampled: independent, or shared.

    python experiments/ablations/noise.py --jobs 2
    python experiments/ablations/noise.py --scale paper

With independent noise (the default, and our reading of the paper), L_var is above 0 even if
prior and posterior agree, unless the critic does not distinguish their samples. With shared
noise, z and z~ are equal in that case, and L_var is 0.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

from vawm.agent import registry
from vawm.cli import command_line
from vawm.errors import InvalidInput
from vawm.sweep import ablation
from vawm.sweep.runs import Variant


def variants(agent: str) -> tuple[Variant, ...]:
    """Both variants; refuses an agent that does not sample z."""
    if not registry.kind(agent).samples_latents:
        raise InvalidInput("agent", agent, "does not sample z, so has no noise; use another")
    return tuple(
        Variant(noise, (*ablation.ADAPTIVE, "--value-alignment.noise", noise))
        for noise in ("independent", "shared")
    )


ABLATION = ablation.Ablation(
    name="noise",
    title="Independent or shared noise of z and z~ in L_var.",
    variants=variants,
    quick=ablation.QUICK,
    paper=ablation.paper(*ablation.TABLE_3),
    factor="noise",
    extra=ablation.ALIGNMENT | {"prior_entropy": "latent/prior_entropy"},
)


def main(argv: Sequence[str] | None = None) -> int:
    """Trains and writes the table; returns the exit code, 1 if a run failed."""
    return ablation.main(ABLATION, argv, description=__doc__, script=__file__)


if __name__ == "__main__":
    sys.exit(command_line.guard(main))
