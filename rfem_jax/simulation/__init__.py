"""A run: methods, the integration, loads, balances and metrics.

    time_grid, solvers   when and how to step
    equations            what is integrated
    generalised_alpha    implicit steps
    implicit_step        their derivatives, and how they are evaluated
    observation          what is recorded of an instant
    stepping             one interval by any method
    integration          prepare -> advance -> conclude
    cases                all cases of a study as one batch
    stability            the largest stable step
    accuracy             the method that "auto" stands for
    run                  the result
"""

from rfem_jax.mechanics.status import STATUS
from rfem_jax.simulation.accuracy import choose_method
from rfem_jax.simulation.cases import run_cases
from rfem_jax.simulation.integration import simulate
from rfem_jax.simulation.run import Run, one_of
from rfem_jax.simulation.solvers import Leapfrog, PeakTracking, RungeKutta4
from rfem_jax.simulation.stability import check_step, largest_stable_step

__all__ = [
    "STATUS",
    "Leapfrog",
    "PeakTracking",
    "Run",
    "RungeKutta4",
    "check_step",
    "choose_method",
    "largest_stable_step",
    "one_of",
    "run_cases",
    "simulate",
]
