"""Types of what is reported, for annotations only.

Place in the pipeline: read by all modules of this package that show something; imports nothing at run time. The
modules of these types take seconds to import, or are not there without the extra `plots`, and any object with the
same fields will do: at run time they are `Any`.
"""

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure
    from mpl_toolkits.mplot3d import Axes3D

    from rfem_jax.description.study_file.study import Study
    from rfem_jax.mechanics.model.discretisation import StartHeld, Structure
    from rfem_jax.mechanics.model.model import Model
    from rfem_jax.simulation.cycle import Cycle
    from rfem_jax.simulation.outcome.run import CouplingHistory, Run
else:
    Axes = Axes3D = CouplingHistory = Cycle = Figure = Model = Run = StartHeld = Structure = Study = Any

# {case: the numbers of its run}, as `summary.summarise` makes them.
Summaries = dict[str, dict[str, Any]]

__all__ = [
    "Axes", "Axes3D", "CouplingHistory", "Cycle", "Figure", "Model", "Run", "StartHeld", "Structure", "Study",
    "Summaries",
]  # fmt: skip
