"""A run: methods, the integration, loads, balances and metrics.

    specification      what is simulated: mechanism, drive, time, method
    simulating         one simulation: the function that users call
    cases              all cases of a study as one batch; unfinished: where an interruption left it
    cycle              the motion that repeats with every revolution of a drive
    motion_equations   the equations of motion as a vector field, for solvers of one's own
    accuracy           the method that "auto" stands for
    locking            where a drive prescribes what the loops do not let it
    rest               the mechanism held still: loads at rest, turns of a drive
    vibrations         natural frequencies, and the largest stable step
    stages             prepare -> advance -> conclude, and the balances
    solvers            all methods as diffrax solvers
    outcome            what is recorded and returned
    system             the first-order system, what drives it, and the grid of times

Names are imported when they are first used: checking a study does not import the integrators.
"""

from rfem_jax.lazy_names import lazy_names

_names = {
    "accuracy": "choose_method",
    "cases": "run_cases",
    "cycle": "Cycle cycle_run steady_cycle",
    "simulating": "simulate",
    "specification": "Simulation",
    "locking": "DriveLimit drive_limit",
    "motion_equations": "EquationsOfMotion equations_of_motion",
    "vibrations.modes": "NaturalModes natural_frequencies",
    "outcome.run": "STATUS Run derivative_residual one_of",
    "solvers.catalogue": "register_method",
    "solvers.explicit": "LeapfrogSolver PeakTracking RungeKutta4Solver",
    "vibrations.stability": "check_step largest_stable_step",
    "rest.statics": "StaticLoads inverse_dynamics static_loads",
    "rest.turn": "Turn kinetostatic_turn",
}

__getattr__, __dir__, __all__ = lazy_names(__name__, _names)
