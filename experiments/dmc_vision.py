"""Train DreamerV3, STORM or VaGraM on the DeepMind Control Suite, from pixels.

    python experiments/dmc_vision.py                                 # small, on a CPU
    python experiments/dmc_vision.py --task walker_walk --preset paper         # on a GPU
    python experiments/dmc_vision.py --env.image-size 96

Every field of `vawm.config.Config` is a flag, those of `VisionConfig` as `--env.*`; `--help`
lists them. Needs the extra `vision`.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

from vawm.cli import command_line
from vawm.process import huge_pages


def main(argv: Sequence[str] | None = None) -> int:
    """Trains one agent; returns the exit code."""
    return command_line.train(argv, suite="dmc_vision", description=__doc__)


if __name__ == "__main__":
    huge_pages.use_huge_pages()
    sys.exit(command_line.guard(main))
