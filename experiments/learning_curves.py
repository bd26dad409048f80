"""Learning curves of tasks x seeds, with and without value alignment: `vawm sweep`.

python experiments/learning_curves.py --jobs 2
"""

from __future__ import annotations

import sys

from vawm.cli import command_line
from vawm.sweep.learning_curves import main

if __name__ == "__main__":
    sys.exit(command_line.guard(main))
