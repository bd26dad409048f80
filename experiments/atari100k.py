"""Train DreamerV3, STORM or VaGraM on the 26 games of Atari 100k.

    python experiments/atari100k.py --game breakout                  # small, on a CPU
    python experiments/atari100k.py --game krull --preset paper      # 100k steps, on a GPU
    python experiments/atari100k.py --agent storm --game kung_fu_master
    python experiments/atari100k.py --game freeway --actor.collect-temperature 0.01

`--game` is short for `--task`. Every field of `vawm.config.Config` is a flag, those of
`AtariConfig` as `--env.*`; `--help` lists them. Needs the extra `atari`.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

from vawm.cli import command_line
from vawm.process import huge_pages


def main(argv: Sequence[str] | None = None) -> int:
    """Trains one agent; returns the exit code."""
    return command_line.train(argv, suite="atari100k", description=__doc__)


if __name__ == "__main__":
    huge_pages.use_huge_pages()
    sys.exit(command_line.guard(main))
