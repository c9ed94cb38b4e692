"""A run: methods, the integration, loads, balances and metrics.

    time_grid            when to step
    equations            what is integrated
    observation          what is recorded of an instant
    batches              results batched alike in a function and in its derivative
    implicit_step        implicit steps and their derivatives
    generalised_alpha    the implicit method as a diffrax solver
    solvers              all methods as diffrax solvers
    stepping             one interval by any method
    integration          prepare -> advance -> conclude
    cases                all cases of a study as one batch
    stability            the largest stable step
    accuracy             the method that "auto" stands for
    vibration            modes at rest
    run                  the result

Names are loaded when they are first used: a check needs no integrator.
"""

from importlib import import_module

_MODULES = {
    "accuracy": "choose_method",
    "cases": "run_cases",
    "integration": "simulate",
    "run": "STATUS Run derivative_residual one_of",
    "solvers": "Leapfrog PeakTracking RungeKutta4",
    "stability": "check_step largest_stable_step",
}
_MODULE_OF = {name: module for module, names in _MODULES.items() for name in names.split()}

__all__ = sorted(_MODULE_OF)


def __getattr__(name: str):
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_MODULE_OF[name]}"), name)


def __dir__():
    return __all__
