"""Train DreamerV3, STORM or VaGraM on the DeepMind Control Suite, from proprioception.

    python experiments/dmc_proprio.py                                # minutes on a CPU
    python experiments/dmc_proprio.py --task walker_walk --preset paper        # on a GPU
    python experiments/dmc_proprio.py --value-alignment.weight off   # plain DreamerV3
    python experiments/dmc_proprio.py --agent storm                  # the transformer

Every field of `vawm.config.Config` is a flag; `--help` lists them.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

from vawm.cli import command_line
from vawm.process import huge_pages


def main(argv: Sequence[str] | None = None) -> int:
    """Trains one agent; returns the exit code."""
    return command_line.train(argv, suite="dmc_proprio", description=__doc__)


if __name__ == "__main__":
    huge_pages.use_huge_pages()
    sys.exit(command_line.guard(main))
