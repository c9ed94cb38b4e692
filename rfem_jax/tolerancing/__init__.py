"""Many runs: sensitivities, Monte Carlo, worst cases, allocation of tolerances.

Every study takes a `problem(errors) -> (values, status)`: the simulator (`Problem`) or any function
(`FunctionProblem`).

    problems        the simulator as a problem, its metrics; distributions of errors; evaluation in batches
    sensitivities   first and second derivatives, principal error directions
    sampling        Monte Carlo: scatter, yield, Sobol' indices
    optimisation    optimisers under bounds and constraints
    designs         sweeps over ranges of the errors, response surfaces
    rare_failures   probabilities of limits broken, by FORM and importance sampling
    worst_cases     the largest value within the tolerances
    allocation      the cheapest tolerances that keep the limits
    robust_design   dimensions and tolerances together
"""

from rfem_jax.tolerancing.allocation.allocation_study import allocate
from rfem_jax.tolerancing.allocation.cost_models import Exponential, Reciprocal, ReciprocalSquared
from rfem_jax.tolerancing.designs.response_surface import fit_response_surface
from rfem_jax.tolerancing.designs.sweep_study import sweep
from rfem_jax.tolerancing.problems.capability import process_capability
from rfem_jax.tolerancing.problems.distributions import Normal, ProcessNormal, Triangular, TruncatedNormal, Uniform
from rfem_jax.tolerancing.problems.joint_distributions import CorrelatedNormal, Zone
from rfem_jax.tolerancing.problems.metrics import metric, register_metric
from rfem_jax.tolerancing.problems.named_tolerances import Tolerances
from rfem_jax.tolerancing.problems.problem import FunctionProblem, Metric
from rfem_jax.tolerancing.problems.quadratic_model import QuadraticModel, expand
from rfem_jax.tolerancing.problems.simulated_problem import Problem
from rfem_jax.tolerancing.rare_failures.failure_study import reliability
from rfem_jax.tolerancing.robust_design.front import pareto_front
from rfem_jax.tolerancing.robust_design.optimisation import optimise
from rfem_jax.tolerancing.sampling.monte_carlo_study import monte_carlo
from rfem_jax.tolerancing.sensitivities import sensitivity
from rfem_jax.tolerancing.worst_cases import worst_case

__all__ = [
    "CorrelatedNormal",
    "Exponential",
    "FunctionProblem",
    "Metric",
    "Normal",
    "Problem",
    "ProcessNormal",
    "QuadraticModel",
    "Reciprocal",
    "ReciprocalSquared",
    "Tolerances",
    "Triangular",
    "TruncatedNormal",
    "Uniform",
    "Zone",
    "allocate",
    "expand",
    "fit_response_surface",
    "metric",
    "monte_carlo",
    "optimise",
    "pareto_front",
    "process_capability",
    "register_metric",
    "reliability",
    "sensitivity",
    "sweep",
    "worst_case",
]
