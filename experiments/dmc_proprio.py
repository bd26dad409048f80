"""Value-aligned DreamerV3 on the DeepMind Control Suite, from proprioception.

    python experiments/dmc_proprio.py                                # minutes on a CPU
    python experiments/dmc_proprio.py --task walker_walk --preset paper        # on a GPU
    python experiments/dmc_proprio.py --value-alignment.weight off   # plain DreamerV3

Every field of `vawm.config.Config` is a flag; `--help` lists them.
"""

from __future__ import annotations

import pathlib
import sys
from collections.abc import Sequence

from vawm import cache, command_line, huge_pages, runner


def main(argv: Sequence[str] | None = None) -> int:
    """Trains one agent; returns the exit code."""
    arguments = command_line.parse(argv, preset="quick", description=__doc__)
    runner.check(arguments.config, arguments.logdir, resume=arguments.resume)
    cache.enable()
    result = runner.run(
        arguments.config,
        arguments.logdir,
        resume=arguments.resume,
        banner=command_line.describe(arguments.config),
        command=f"python {pathlib.Path(sys.argv[0])}",
    )
    return result.exit_code


if __name__ == "__main__":
    huge_pages.use_huge_pages()
    sys.exit(command_line.guard(main))
