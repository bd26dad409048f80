"""Many runs of one program: variants x tasks x seeds, with tables and figures.

`runs` lists the runs and their commands, `children` runs several of them at a time and
`progress` tells how they are doing, `results` reads their metrics, and `figures` draws them.
`learning_curves` (`vawm sweep`) and `ablation` combine everything in one command line. `costs`
compares time and memory, without whole runs.
"""

from vawm.sweep import (
    ablation,
    children,
    costs,
    figures,
    learning_curves,
    progress,
    results,
    runs,
)

__all__ = [
    "ablation",
    "children",
    "costs",
    "figures",
    "learning_curves",
    "progress",
    "results",
    "runs",
]
