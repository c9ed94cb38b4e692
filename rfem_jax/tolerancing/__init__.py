"""Many runs: sensitivities, Monte Carlo, worst cases, allocation of tolerances.

Every study takes a `problem(errors) -> (values, status)`: the simulator (`Problem`) or any function
(`FunctionProblem`).

    problems        the simulator as a problem, its metrics; distributions of errors; evaluation in batches
    sensitivities   first and second derivatives, principal error directions
    sampling        Monte Carlo: scatter, yield, Sobol' indices
    optimisation    optimisers under bounds and constraints
    designs         sweeps over ranges of the errors, response surfaces
    rare_failures   probabilities of limits broken, by FORM, importance sampling and subset simulation
    identification  from measurements to errors, and what measurements can tell
    refinement      how many rigid finite elements an accuracy takes
    worst_cases     the largest value within the tolerances
    robust_design   the best dimensions and tolerances that keep limits; the cheapest tolerances alone

Names are imported when they are first used: a problem needs no statistics.
"""

from rfem_jax.lazy_names import lazy_names

_names = {
    "designs.response_surface": "fit_response_surface",
    "designs.sweep_study": "sweep",
    "identification.correction": "correct",
    "identification.identification_study": "identifiability identify",
    "identification.production": "estimate_production",
    "problems.capability": "process_capability",
    "problems.distributions": "Normal ProcessNormal Triangular TruncatedNormal Uniform",
    "problems.joint_distributions": "CorrelatedNormal Zone",
    "problems.metrics": "metric register_metric",
    "problems.named_tolerances": "Tolerances",
    "problems.problem": "FunctionProblem Metric",
    "problems.quadratic_model": "QuadraticModel expand",
    "problems.simulated_problem": "Problem",
    "problems.static_problem": "StaticProblem",
    "rare_failures.failure_study": "reliability",
    "refinement": "mesh_convergence",
    "robust_design.allocation": "allocate",
    "robust_design.cost_models": "Exponential Reciprocal ReciprocalSquared",
    "robust_design.front": "pareto_front",
    "robust_design.optimisation": "optimise",
    "sampling.monte_carlo_study": "first_samples monte_carlo",
    "sampling.sampled_paths": "path_bands",
    "sensitivities": "sensitivity",
    "worst_cases": "worst_case",
}

__getattr__, __dir__, __all__ = lazy_names(__name__, _names)
