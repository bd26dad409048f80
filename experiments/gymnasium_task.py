"""Train DreamerV3, STORM or VaGraM on any registered Gymnasium environment.

    python experiments/gymnasium_task.py --task CartPole-v1

Checks the environment first and lists all problems at once. To train in an environment that is
not registered, call `vawm.runs.runner.run(config, logdir, env=vawm.envs.from_gymnasium(...))`.
Every field of `vawm.config.Config` is a flag, those of `GymnasiumConfig` as `--env.*`; `--help`
lists them.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence

from vawm.cli import command_line
from vawm.process import huge_pages


def main(argv: Sequence[str] | None = None) -> int:
    """Trains one agent; returns the exit code."""
    return command_line.train(argv, suite="gymnasium", description=__doc__)


if __name__ == "__main__":
    huge_pages.use_huge_pages()
    sys.exit(command_line.guard(main))
