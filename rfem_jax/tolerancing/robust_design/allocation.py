"""Allocation: the cheapest tolerances with which limits on metrics hold (theory (10.12)).

Place in the pipeline: request, observations, corrected models -> **allocation** -> reports.

    min sum_i c_i(t_i)   subject to   criterion of every limited metric at t <= limit,
                                      smallest_i <= t_i <= largest_i

It is `optimise` without dimensions, where the quadratic model about the centre is nearly exact: solved in x = log t by
an augmented Lagrangian with gradients, first on this model, then by successive correction: observe the full problem at
the answer, correct the model there, solve again (steps of at most a factor `STEP` in t), until limits hold and the cost
does not change any more. The answer is then verified by a run with random numbers that have not been used before. See
corrected_worst_case.py and corrected_statistics.py for the meaning of "worst_case", "rss" and "yield" and for their
corrections. The search of `optimise` (search.py) on the same models stops at kinks of a quantile: at a yield of 24
tolerances its answer costs 5.7 % more.

Symbols: t (v,) half-widths [rad, m], c_i cost of error i, h = (f - limit)/headroom normalised limit,
headroom = |limit - f(centre)|.
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import numpy as np

from rfem_jax.description.basics.errors import InputError, require_choice
from rfem_jax.description.basics.precision import require_float64
from rfem_jax.tolerancing.checks import ErrorValues
from rfem_jax.tolerancing.optimisation.sizes import Zones
from rfem_jax.tolerancing.problems.distributions import Normal, Tolerance
from rfem_jax.tolerancing.problems.problem import ToleranceProblem
from rfem_jax.tolerancing.problems.quadratic_model import QuadraticModel
from rfem_jax.tolerancing.robust_design.corrected_model import Answer
from rfem_jax.tolerancing.robust_design.corrected_statistics import CorrectedStatistics
from rfem_jax.tolerancing.robust_design.corrected_worst_case import CorrectedWorstCase
from rfem_jax.tolerancing.robust_design.cost_models import CostModel
from rfem_jax.tolerancing.robust_design.observations import Observer
from rfem_jax.tolerancing.robust_design.request import check_allocation
from rfem_jax.tolerancing.robust_design.result import Allocation
from rfem_jax.tolerancing.robust_design.variables import at_ends
from rfem_jax.tolerancing.robust_design.verification import ErrorSample, Verified, check_limits
from rfem_jax.tolerancing.sampling.sequences import RandomKey
from rfem_jax.tolerancing.worst_cases import STARTS

CRITERIA = ("worst_case", "rss", "yield")
STEP = 2.0
ATTEMPTS = 4  # settled answers that a fresh run checks

Criterion = CorrectedWorstCase | CorrectedStatistics


def allocate(
    problem: ToleranceProblem,
    limits: Mapping[str, Any],
    cost: CostModel | Mapping[str, CostModel],
    bounds: Mapping[str, Sequence[float | str]],
    criterion: str = "worst_case",
    *,
    key: RandomKey,
    target: float = 0.9973,
    coverage: float = 3.0,
    statistic: str = "quantile",
    distribution: Callable[[float], Tolerance] = Normal,
    samples: int | None = None,
    verify_samples: int = 4096,
    at: ErrorValues | None = None,
    starts: Mapping[str, int] = STARTS,
    rounds: int = 12,
    tolerance: float = 1e-4,
    model: QuadraticModel | None = None,
    zones: Zones | None = None,
    mode: str = "auto",
    batch: int = 256,
) -> Allocation:
    """Find the cheapest tolerances with which limits on metrics hold.

    Args: limits {metric: upper limit, or (lower or None, upper or None)}; cost, one cost model for all errors or
        {error: model} (cost_models.py), a callable of one half-width; bounds {error: (smallest, largest half-width)},
        in rad or m, or strings with a unit, of the errors to allocate, and of drawing zones ("D.coaxiality") the
        diameter; criterion "worst_case", "rss" or "yield"; key, a JAX key; at {error: value}, the centre of the
        tolerances.
        "yield": target, the fraction of samples within all limits. "rss": coverage, the number c of standard
        deviations, and statistic "quantile" or "mean". Both: distribution, a class or callable half-width ->
        Tolerance; samples, the number of standard points (default: twenty or more beyond the yield, 2048 for "rss");
        verify_samples of the fresh run. "worst_case": starts of each search.
        rounds of correction until an answer settles and a fresh run checks it (a few times at most, each after a
        correction by the last run); tolerance on limits (of the headroom) and cost, ten times as much on the cost of a
        yield; model, a QuadraticModel of order 2 at the centre in the errors of `bounds` (None: by differences of
        gradients); zones, those among `bounds`: a study that has them in [tolerances], or {name: `Zone` of size 1} (a
        position or coaxiality is a disc unless it is here; errors are uniform in a zone, whatever the distribution);
        mode of the gradients; batch, the most samples at once on each device.
    The full problem is compiled twice, whatever the rounds: for values, and for values with derivatives.
    Raises: InputError for unknown names, bad bounds or options.
    """
    require_float64()
    require_choice(criterion, CRITERIA, "criterion")
    require_choice(statistic, ("quantile", "mean"), "statistic")
    if not 0 < target < 1:
        raise InputError(f"Argument `target` must lie between 0 and 1, but it is {target}.")
    together = criterion != "worst_case"
    observer = Observer(check_allocation(problem, limits, cost, bounds, at, mode, batch, model, zones, together))
    design, refine, verify, last = jax.random.split(key, 4)
    if criterion == "worst_case":
        study: Criterion = CorrectedWorstCase(observer, design, starts)
    else:
        count = _sample_number(samples, criterion, target)
        sample = ErrorSample(criterion, target, coverage, distribution, count, verify_samples)
        study = CorrectedStatistics(observer, design, sample, statistic)
    return _solve(study, criterion, rounds, tolerance, (refine, verify, last))


def _sample_number(samples, criterion, target) -> int:
    """The number given, or for a yield a power of two with twenty samples beyond the quantile."""
    if samples is not None:
        return int(samples)
    if criterion == "rss":
        return 2048  # its quantile comes from the moments; the samples give their correction
    return int(np.clip(2 ** np.ceil(np.log2(20 / (1 - target))), 256, 16384))


def _solve(study: Criterion, criterion, rounds, tolerance, keys) -> Allocation:
    refine, verify, last = keys
    answer, history, status, verified = _correct(study, rounds, tolerance, refine, verify)
    message = ""
    if verified is None:
        verified = study.verify(np.exp(answer.x), jax.random.fold_in(verify, rounds))
    if status != "ok":
        status, message = _explain(study, status, verified, last, tolerance)
    return _report(study, criterion, answer, history, (status, message), verified)


def _correct(
    study: Criterion, rounds, tolerance, refine, verify
) -> tuple[Answer, list[tuple[float, float]], str, Verified | None]:
    """Solve, observe, correct until settled and verified: answer, history, status, and the last fresh run."""
    lower, upper = np.log(study.variables.width_lower), np.log(study.variables.width_upper)
    answer = study.solve(0.5 * (lower + upper), lower, upper)
    history, before, fresh = [], np.inf, None
    settling = study.settling * tolerance
    for attempt in range(ATTEMPTS):
        for number in range(attempt * rounds, (attempt + 1) * rounds):
            t = np.exp(answer.x)
            worst = float(np.max(study.observe(t, jax.random.fold_in(refine, number))))
            history.append((answer.cost, worst))
            if worst <= tolerance and abs(answer.cost - before) <= settling * abs(answer.cost):
                break
            before = answer.cost
            following = _next(study, answer, lower, upper)
            stuck = np.max(np.abs(following.x - answer.x)) <= 1e-6
            if stuck and worst > tolerance and following.violation > tolerance:
                return answer, history, "not_converged", None
            answer = following
        else:
            return answer, history, "not_converged", None
        fresh = study.verify(t, jax.random.fold_in(verify, number))
        if _passes(study, fresh, tolerance):
            return answer, history, "ok", fresh
        study.learn(t, fresh)
        answer, before = _next(study, answer, lower, upper), np.inf
    return answer, history, "not_verified", fresh


def _next(study: Criterion, answer: Answer, lower, upper) -> Answer:
    """The cheapest point of the study's present model near the last one."""
    near = np.clip(answer.x - np.log(STEP), lower, upper)
    far = np.clip(answer.x + np.log(STEP), lower, upper)
    return study.solve(answer.x, near, far)


def _passes(study: Criterion, verified: Verified, tolerance) -> bool:
    """Whether the fresh run agrees: no limit (or the joint yield) violated beyond its interval."""
    if study.joint:
        return verified.interval[1] >= study.level
    return bool(np.all(verified.low <= 10 * tolerance))


def _explain(study: Criterion, status, verified: Verified, key, tolerance) -> tuple[str, str]:
    """Status and message: tells an infeasible request from one that did not converge."""
    if status == "not_verified":
        return status, (
            "Independent samples kept violating a limit beyond their confidence interval; use more samples or rounds."
        )
    best = np.minimum(study.best(key), np.where(np.isfinite(verified.h), verified.h, np.inf))
    i = int(np.argmax(np.where(best <= tolerance, -np.inf, best)))
    if not best[i] <= tolerance:
        limit = study.request.limits[i]
        return "infeasible", (
            f"The limit {limit.words} cannot be met: the best value within the bounds is {limit.reached(best[i])}; "
            "relax it to that, or allow smaller tolerances."
        )
    if study.joint and study.best_yield() < study.level:
        return "infeasible", (
            f"The yield {study.level} cannot be met by all limits together: with the smallest tolerances it is "
            f"{study.best_yield():.5f}; relax a limit or allow smaller tolerances."
        )
    return status, "The corrections did not converge; allow more rounds or a looser tolerance."


def _report(study: Criterion, criterion, answer: Answer, history, outcome, verified: Verified) -> Allocation:
    """`outcome`: status, message."""
    request, variables, t = study.request, study.variables, np.exp(answer.x)
    model, names = request.model, variables.sizes.names
    assert model is not None  # of an allocation
    nominal = {metric.name: float(value) for metric, value in zip(request.problem.metrics, np.asarray(model.value))}
    errors = [] if model.hessian_error is None else [float(model.hessian_error[one.position]) for one in request.limits]
    return Allocation(
        criterion=criterion,
        status=outcome[0],
        message=outcome[1],
        tolerances=dict(zip(names, map(float, t), strict=True)),
        units={name: request.units[name] for name in names},
        at_bounds=at_ends(names, t, variables.width_lower * (1 + 1e-6), variables.width_upper * (1 - 1e-6)),
        limits=check_limits(request.limits, nominal, answer.h, verified, answer.prices, study.quadratic_worst(t)),
        verified_yield=verified.fraction,
        yield_interval=verified.interval,
        verified_by=verified.what,
        history=tuple(history),
        failed=study.failed + verified.failed,
        cost=answer.cost,
        level=study.level,
        predicted_yield=study.predicted_yield(t),
        hessian_error=max(errors, default=np.nan),
    )
