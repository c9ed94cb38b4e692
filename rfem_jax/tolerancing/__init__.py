"""Many runs: sensitivities, Monte Carlo, worst cases, allocation of tolerances.

Every study takes a `problem(errors) -> (values, status)`: the simulator (`Problem`) or any function
(`FunctionProblem`).

    metrics, simulated_problem   the simulator as a problem
    distributions                of the errors within their tolerances
    sensitivities                first and second derivatives, principal error directions
    monte_carlo_study            scatter, yield, Sobol' indices
    worst_cases                  the largest value within the tolerances
    allocation                   the cheapest tolerances that keep the limits
"""

from rfem_jax.tolerancing.allocation import allocate
from rfem_jax.tolerancing.cost_models import Exponential, Reciprocal, ReciprocalSquared
from rfem_jax.tolerancing.distributions import (
    CorrelatedNormal,
    Normal,
    Tolerances,
    Triangular,
    TruncatedNormal,
    Uniform,
)
from rfem_jax.tolerancing.metrics import metric, register_metric
from rfem_jax.tolerancing.monte_carlo_study import monte_carlo
from rfem_jax.tolerancing.problem import FunctionProblem, Metric
from rfem_jax.tolerancing.quadratic_model import QuadraticModel, expand
from rfem_jax.tolerancing.sensitivities import sensitivity
from rfem_jax.tolerancing.simulated_problem import Problem
from rfem_jax.tolerancing.worst_cases import worst_case

__all__ = [
    "CorrelatedNormal",
    "Exponential",
    "FunctionProblem",
    "Metric",
    "Normal",
    "Problem",
    "QuadraticModel",
    "Reciprocal",
    "ReciprocalSquared",
    "Tolerances",
    "Triangular",
    "TruncatedNormal",
    "Uniform",
    "allocate",
    "expand",
    "metric",
    "monte_carlo",
    "register_metric",
    "sensitivity",
    "worst_case",
]
