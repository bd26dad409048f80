"""Many runs of one program: variants x tasks x seeds, their tables and their figures.

`runs` says which there are and how each is started, `children` keeps some of them going,
`results` reads what they measured, `figures` draws it, and `ablation` is all of it behind one
command line. `costs` is the same for time and memory, of which no run is needed.
"""

from vawm.sweep import ablation, children, costs, figures, results, runs

__all__ = ["ablation", "children", "costs", "figures", "results", "runs"]
