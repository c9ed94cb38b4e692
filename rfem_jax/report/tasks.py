"""The tasks of a study as calls of the tolerance studies.

Place in the pipeline: study as loaded -> `build_problem`, `build_tolerances` -> one function per
task -> its result (of `rfem_jax.tolerancing`), which `task_files` and `task_figures` show.

Symbols: half-widths of tolerances in rad and m; limits in units of their metrics.
"""

import math
from dataclasses import dataclass, replace
from functools import partial

import jax
import jax.numpy as jnp

from rfem_jax.description.errors import InputError
from rfem_jax.mechanics import discretise
from rfem_jax.tolerancing import (
    CorrelatedNormal,
    Exponential,
    Normal,
    Problem,
    Reciprocal,
    ReciprocalSquared,
    Tolerances,
    Triangular,
    TruncatedNormal,
    Uniform,
    allocate,
    monte_carlo,
    sensitivity,
    worst_case,
)
from rfem_jax.tolerancing.cost_models import total_cost
from rfem_jax.tolerancing.quadratic_model import choose_mode, expand_by_differences
from rfem_jax.tolerancing.results_store import StudyFolderError

DISTRIBUTIONS = {
    "uniform": Uniform,
    "triangular": Triangular,
    "normal": Normal,
    "truncated_normal": TruncatedNormal,
}


@dataclass(frozen=True, eq=False)
class AllocationStudy:
    """An allocation and its neighbours: `answer`; `front` {scale of the limits' distance from the
    nominal values: Allocation}, scale 1 the answer itself; `before` {error: half-width} of the
    study's own tolerances (empty without), `cost_before` their cost (NaN without)."""

    answer: object
    front: dict
    before: dict
    cost_before: float


def build_problem(study, metrics, model=None) -> Problem:
    """The study's mechanism, drive and method as a function of its errors."""
    model = discretise(study.mechanism) if model is None else model
    return Problem(model, study.drive, study.duration, metrics, study.method, save_every=study.save_every)


def build_tolerances(specified) -> Tolerances:
    """Distributions of the errors as `rfem_jax.description.tolerances` states them."""
    independent = {}
    for one in specified.independent:
        settings = {} if one.deviations is None else {"deviations": one.deviations}
        independent[one.error] = DISTRIBUTIONS[one.distribution](interval=one.interval, **settings)
    groups = [
        CorrelatedNormal(group.half_widths, group.covariance(), deviations=group.deviations)
        for group in specified.correlated
    ]
    return Tolerances(independent, correlated=groups)


def finer_method(method):
    """The same method with half the step, or a tenth of its tolerances."""
    if method.step is not None:
        return replace(method, step=0.5 * method.step)
    if method.adaptive:
        return replace(method, rtol=0.1 * method.rtol, atol=0.1 * method.atol)
    accuracy = 1e-4 if method.accuracy is None else method.accuracy
    return replace(method, accuracy=0.1 * accuracy)


def run_sensitivity(study, progress=False):
    """Derivatives of all metrics of the task; returns (Sensitivities, undamped).

    Arguments: progress as for `sensitivity`.
    """
    task = study.tasks.sensitivity
    problem = build_problem(study, task.metrics)
    refined = problem.with_method(finer_method(study.method)) if task.half_step else None
    result = sensitivity(
        problem, task.at, task.order, build_tolerances(study.tasks.tolerances), task.mode,
        batch=task.batch, refined=refined, progress=progress,
    )  # fmt: skip
    return result, bool(getattr(problem, "undamped", False))


def run_monte_carlo(study, folder, progress=True):
    """The scatter of all metrics; chunks are kept in `folder`, where a run continues.

    Raises: InputError for a folder of another study (in the words of the command line, where the
        folder is in DIR of `--out DIR`); ChunkWriteError for a full disk.
    """
    task = study.tasks.monte_carlo
    try:
        return monte_carlo(
            build_problem(study, task.metrics), build_tolerances(study.tasks.tolerances), task.n,
            jax.random.key(task.seed), batch=task.batch, lanes=task.lanes, sampling=task.sampling,
            limits=task.limits, quantiles=task.quantiles, confidence=task.confidence,
            sobol_indices=task.sobol_indices, control_variate=task.control_variate or None,
            resume=folder, progress=progress,
        )  # fmt: skip
    except StudyFolderError as problem:
        raise InputError(
            "Argument `--out` must be a folder in which this Monte Carlo study can start or "
            f"continue, but {problem.finding}; choose another folder, state the same study, or "
            f"remove `{folder}` and its samples."
        ) from None


def run_worst_case(study, report=lambda text: None):
    """{metric: WorstCase} of the task's metrics, with one quadratic model for all of them.

    Arguments: report is called with the name of each stage that takes long.
    """
    task = study.tasks.worst_case
    problem = build_problem(study, task.metrics)
    tolerances = build_tolerances(study.tasks.tolerances)
    keys = jax.random.split(jax.random.key(task.seed), len(task.metrics))
    report("Expanding to second order")
    centre = {name: float(mean) for name, mean in tolerances.means().items()}
    mode = choose_mode(task.mode, len(tolerances.names), 1)  # that of the searches: one program
    model = expand_by_differences(problem, centre, tolerances, mode=mode, batch=task.batch)
    search = partial(
        worst_case, problem, tolerances, model=model, region=task.region, starts=task.starts,
        sense=task.sense, corners="auto" if task.corners is None else task.corners, mode=mode,
        evaluations=task.evaluations, batch=task.batch,
    )  # fmt: skip
    found = {}
    for name, key in zip(task.metrics, keys, strict=True):
        report(f"Searching the worst case of {name}")
        found[name] = search(name, key=key)
    return found


def build_cost(cost):
    """Callable of one half-width [rad or m] for an `ErrorCost`."""
    if cost.model == "reciprocal":
        return Reciprocal(cost.price * cost.at, cost.fixed)
    if cost.model == "reciprocal_squared":
        return ReciprocalSquared(cost.price * cost.at**2, cost.fixed)
    return Exponential(cost.price, 1.0 / cost.at, cost.fixed)


def scaled_limits(checks, scale) -> dict:
    """Limits {metric: (low, high)} with their distances from the nominal values times `scale`.

    Arguments: checks, the `LimitCheck`s of an allocation with the limits as stated.
    """
    limits = {}
    for check in checks:
        low, high = limits.get(check.metric, (None, None))
        moved = check.nominal + scale * (check.limit - check.nominal)
        limits[check.metric] = (low, moved) if check.side == "upper" else (moved, high)
    return limits


def run_allocation(study, report=lambda text: None):
    """The cheapest tolerances, and those of the task's scaled limits: an AllocationStudy.

    Arguments: report is called with the name of each allocation.
    """
    task = study.tasks.allocation
    problem = build_problem(study, task.metrics)
    costs = {name: build_cost(cost) for name, cost in task.costs.items()}
    keys = jax.random.split(jax.random.key(task.seed), 1 + len(task.scales))
    solve = partial(
        allocate, problem, cost=costs, bounds=task.bounds, criterion=task.criterion,
        target=task.target, coverage=task.coverage, statistic=task.statistic,
        distribution=DISTRIBUTIONS[task.distribution], samples=task.samples,
        verify_samples=task.verify_samples, starts=task.starts, rounds=task.rounds,
        tolerance=task.accuracy, batch=task.batch,
    )  # fmt: skip
    report("Expanding to second order")
    together = task.criterion != "worst_case"
    mode = choose_mode(task.mode, len(task.bounds), len(problem.metrics) if together else 1)
    typical = {name: math.sqrt(low * high) for name, (low, high) in task.bounds.items()}
    model = expand_by_differences(problem, None, typical, mode=mode, batch=task.batch)
    solve = partial(solve, model=model, mode=mode)
    report(f"Allocating {len(task.bounds)} tolerances")
    limits = {name: tuple(map(_closed, pair)) for name, pair in task.limits.items()}
    answer = solve(limits, key=keys[0])
    front = {1.0: answer}
    for scale, key in zip(task.scales, keys[1:], strict=True):
        if scale not in front:
            report(f"Allocating with limits scaled by {scale:g}")
            front[scale] = solve(scaled_limits(answer.limits, scale), key=key)
    before, cost = _before(study, costs)
    return AllocationStudy(answer, dict(sorted(front.items())), before, cost)


def _closed(end):
    """An end of a limit, None where it is open."""
    return end if math.isfinite(end) else None


def _before(study, costs):
    """The study's own tolerances of the errors allocated, and their cost if it has all of them."""
    specified = study.tasks.tolerances
    widths = {} if specified is None else specified.half_widths()
    before = {name: widths[name] for name in costs if name in widths}
    if len(before) < len(costs):
        return before, math.nan
    models = tuple(costs[name] for name in before)
    return before, float(total_cost(models, jnp.asarray(list(before.values()))))
