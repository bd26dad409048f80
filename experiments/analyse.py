"""What value alignment does in trained runs: `vawm analyse`, from a checkout.

python experiments/analyse.py --logdirs runs/aligned runs/plain
"""

from __future__ import annotations

import sys

from vawm.analysis.program import main
from vawm.cli import command_line
from vawm.process import huge_pages

if __name__ == "__main__":
    huge_pages.use_huge_pages()
    sys.exit(command_line.guard(main))
