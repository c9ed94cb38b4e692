"""A run: methods, the integration, loads, balances and metrics.

    specification        what is simulated: mechanism, drive, time, method
    simulating           one simulation: the function that users call
    motion_equations     the equations of motion as a vector field, for other solvers
    driving              which joint a drive acts on
    time_grid            intervals between saved times and jumps, divided into steps
    equations            the first-order system that is integrated
    stabilisation        Baumgarte's gains
    observation          what is recorded of an instant
    records              what is recorded beside it where a metric asks for it
    batches              the same batch axes in functions with rules of their own
    implicit_step        one implicit step as a differentiable function
    generalised_alpha    the implicit method as a diffrax solver
    solvers              all methods as diffrax solvers
    contact_steps        parts of implicit steps that follow contacts
    recorded_steps       steps found before, for reverse mode of adaptive methods
    stepping             one interval by any method
    integration          prepare -> advance -> conclude
    conclusion           what a simulation ends with, and its arrays by name
    locking              where a drive prescribes what the loops do not let it
    cases                all cases of a study as one batch
    vibration            modes of the perfect mechanism at rest, for limits of the step
    modes                natural frequencies about assembled configurations, differentiable
    statics              loads at rest, at given positions; labelled_statics: as tables
    turn                 the mechanism held at positions of its drive; labelled_turn: as tables
    cycle                the motion that repeats with every revolution of a drive
    stability            the largest stable step
    accuracy             the method that "auto" stands for
    run                  the result

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
    "modes": "NaturalModes natural_frequencies",
    "run": "STATUS Run derivative_residual one_of",
    "solvers.catalogue": "register_method",
    "solvers.explicit": "LeapfrogSolver PeakTracking RungeKutta4Solver",
    "stability": "check_step largest_stable_step",
    "statics": "StaticLoads inverse_dynamics static_loads",
    "turn": "Turn kinetostatic_turn",
}

__getattr__, __dir__, __all__ = lazy_names(__name__, _names)
