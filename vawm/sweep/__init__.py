"""Many runs of one program: variants x tasks x seeds, with tables and figures.

`runs` lists the runs and their commands, `children` runs several of them at a time, `results`
reads their metrics, `figures` draws them, and `ablation` combines everything in one command
line. `costs` compares time and memory, without whole runs.
"""

from vawm.sweep import ablation, children, costs, figures, results, runs

__all__ = ["ablation", "children", "costs", "figures", "results", "runs"]
