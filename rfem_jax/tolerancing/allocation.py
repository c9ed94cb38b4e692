"""Allocation: the cheapest tolerances such that limits on metrics hold (theory (10.12)).

Place in the pipeline: last of the studies; uses the quadratic model, worst cases and sampling.

    min sum_i c_i(t_i)   subject to   criterion of every limited metric at t <= limit,
                                      smallest_i <= t_i <= largest_i

Solved in x = log t by an augmented Lagrangian with gradients, first on the quadratic model about
the centre, then by successive correction: observe the full problem at the answer, correct the
model there, solve again (steps of at most a factor `STEP` in t), until limits hold and the cost
stands still. The answer is then verified by a run whose random numbers served nothing else.
worst_case_criterion.py and statistical_criteria.py say what "worst_case", "rss" and "yield" mean
and how each is corrected.

Symbols: t (k,) half-widths [rad, m], c_i cost of error i, h = (f - limit)/headroom normalised
limit, headroom = |limit - f(centre)|.
"""

from dataclasses import dataclass

import jax
import numpy as np

from rfem_jax.description.errors import InputError, require_choice
from rfem_jax.tolerancing.allocation_request import state_request
from rfem_jax.tolerancing.evaluation import require_float64
from rfem_jax.tolerancing.layout import align_columns, show_number, wrap_lines
from rfem_jax.tolerancing.statistical_criteria import StatisticalCriterion
from rfem_jax.tolerancing.tolerances import Normal
from rfem_jax.tolerancing.worst_case_criterion import WorstCaseCriterion
from rfem_jax.tolerancing.worst_cases import STARTS

CRITERIA = ("worst_case", "rss", "yield")
STEP = 2.0
ATTEMPTS = 4  # settled answers that are put to a fresh run


@dataclass(frozen=True, eq=False)
class LimitCheck:
    """One limit and its metric at the answer, all in the metric's unit.

    side "upper" or "lower"; nominal: at the centre; quadratic: by the quadratic model alone;
    predicted: by the corrected model that found the answer; verified: by the fresh run, with its
    confidence interval (a worst case has none: both ends are the value). Margins are distances to
    the limit, positive where it holds. shadow_price: d(cost)/d(limit), what relaxing the limit by
    one unit adds to the cost (negative or zero for an upper limit, zero where it is not active).
    """

    metric: str
    unit: str
    side: str
    limit: float
    nominal: float
    quadratic: float
    predicted: float
    verified: float
    verified_interval: tuple
    predicted_margin: float
    verified_margin: float
    shadow_price: float


@dataclass(frozen=True, eq=False)
class Allocation:
    """The answer of an allocation.

    status: "ok" (found, and the fresh run agrees), "not_verified" (found, but the fresh run
    violates a limit beyond its confidence interval), "not_converged", or "infeasible"; message:
    one sentence, for an infeasible request which limit cannot be met and the best reachable value;
    tolerances {name: half-width [rad or m]} (of an infeasible request the least bad ones), cost;
    at_bounds {name: "smallest" | "largest"}; limits: LimitCheck of each; level: the fraction of
    samples the statistical criteria look at (NaN for worst case); predicted_yield, verified_yield,
    yield_interval: fraction within all limits (NaN for worst case; predicted only for "yield");
    verified_by: what the fresh run was; history: (cost, largest h on the full problem) per round;
    failed: failed samples seen on the way and in the fresh run; hessian_error: the estimated
    relative error of the quadratic model's Hessian by differences (NaN where it is exact).
    """

    criterion: str
    status: str
    message: str
    tolerances: dict
    units: dict
    cost: float
    at_bounds: dict
    limits: tuple
    level: float
    predicted_yield: float
    verified_yield: float
    yield_interval: tuple
    verified_by: str
    history: tuple
    failed: int
    hessian_error: float

    def __str__(self):
        head = f"Allocation ({self.criterion}): status {self.status}, "
        head += f"cost {show_number(self.cost, 7)}"
        rows = [
            [n, f"{show_number(t)} {self.units[n]}", self.at_bounds.get(n, "")]
            for n, t in self.tolerances.items()
        ]
        parts = [head, wrap_lines(self.message)]
        parts.append(align_columns(["error", "tolerance", "bound"], rows))
        header = ["limit", "value", "nominal", "quadratic", "predicted", "verified", "interval"]
        header += ["margin"]
        parts.append(align_columns(header, [self._row(check) for check in self.limits]))
        if np.isfinite(self.verified_yield):
            low, high = self.yield_interval
            parts.append(f"verified yield {self.verified_yield:.5f} ({low:.5f} to {high:.5f})")
        parts.append(f"verified by {self.verified_by}; {self.failed} failed samples")
        if np.isfinite(self.hessian_error):
            parts.append(f"Hessian by differences of gradients, error {self.hessian_error:.0e}")
        return "\n".join(part for part in parts if part)

    @staticmethod
    def _row(check):
        numbers = (check.limit, check.nominal, check.quadratic, check.predicted, check.verified)
        ends = (show_number(end, scale=check.limit) for end in check.verified_interval)
        return [
            f"{check.metric} [{check.unit or 1}]",
            *(show_number(number, scale=check.limit) for number in numbers),
            " to ".join(ends),
            show_number(check.verified_margin),
        ]


def allocate(
    problem,
    limits,
    cost,
    bounds,
    criterion="worst_case",
    *,
    key,
    target=0.9973,
    coverage=3.0,
    statistic="quantile",
    distribution=Normal,
    samples=None,
    verify_samples=4096,
    at=None,
    starts=STARTS,
    rounds=12,
    tolerance=1e-4,
    model=None,
    mode="auto",
    batch=256,
):
    """Find the cheapest tolerances such that limits on metrics hold.

    Args: limits {metric: upper limit, or (lower or None, upper or None)}; cost one cost model for
        all errors or {error: model} (cost_models.py), a callable of one half-width; bounds {error:
        (smallest, largest half-width)} [rad, m], its keys are the errors allocated; criterion
        "worst_case", "rss" or "yield"; key a JAX key; at {error: value} centre of the tolerances.
        For "yield": target the fraction of samples within all limits. For "rss": coverage, the
        number c of standard deviations, and statistic "quantile" or "mean". For both:
        distribution, a class or callable half-width -> Tolerance; samples, standard points the
        full problem is observed at (default: twenty or more beyond the yield, 2048 for "rss");
        verify_samples of the fresh run. For worst case: starts of each search. rounds of
        correction until an answer settles and is put to a fresh run (a few times at most, each
        with what the last one taught); tolerance on limits (of the headroom) and cost, ten times
        as much on the cost of a yield; model a QuadraticModel of order 2 at the centre in the
        errors of `bounds` (None: by differences of gradients); mode of the gradients; batch the
        most samples at once. The full problem is compiled twice, whatever the rounds: for values,
        and for values with slopes.
    Returns: Allocation.
    Raises: InputError for unknown names, bad bounds or options.
    """
    require_float64()
    require_choice(criterion, CRITERIA, "criterion")
    require_choice(statistic, ("quantile", "mean"), "statistic")
    if not 0 < target < 1:
        raise InputError(f"Argument `target` must lie between 0 and 1, but it is {target}.")
    request = state_request(
        problem, limits, cost, bounds, at, mode, batch, model, together=criterion != "worst_case"
    )
    design, refine, verify, last = jax.random.split(key, 4)
    if criterion == "worst_case":
        study = WorstCaseCriterion(request, design, starts)
    else:
        study = StatisticalCriterion(
            request, design, criterion, level=target, coverage=coverage, statistic=statistic,
            distribution=distribution, samples=_sample_number(samples, criterion, target),
            verify_samples=verify_samples,
        )  # fmt: skip
    answer, history, status, verified = _correct(study, request, rounds, tolerance, refine, verify)
    message = ""
    if status != "ok":
        if verified is None:
            verified = study.verify(np.exp(answer.x), jax.random.fold_in(verify, rounds))
        status, message = _explain(study, request, criterion, status, verified, last, tolerance)
    return _report(study, request, criterion, answer, history, status, message, verified)


def _sample_number(samples, criterion, target):
    """The number given, or for a yield a power of two with twenty samples beyond the quantile."""
    if samples is not None:
        return int(samples)
    if criterion == "rss":
        return 2048  # its quantile comes from the moments; the samples give their correction
    return int(np.clip(2 ** np.ceil(np.log2(20 / (1 - target))), 256, 16384))


def _correct(study, request, rounds, tolerance, refine, verify):
    """Solve, observe, correct until settled and verified: (answer, history, status, verified)."""
    lower, upper = np.log(request.lower), np.log(request.upper)
    answer = study.solve(0.5 * (lower + upper), lower, upper)
    history, before = [], np.inf
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


def _next(study, answer, lower, upper):
    """The cheapest point of the study's present model near the last one."""
    near = np.clip(answer.x - np.log(STEP), lower, upper)
    far = np.clip(answer.x + np.log(STEP), lower, upper)
    return study.solve(answer.x, near, far)


def _passes(study, verified, tolerance):
    """Whether the fresh run agrees: no limit (or the joint yield) violated beyond its interval."""
    if study.joint:
        return verified.fraction_interval[1] >= study.level
    return bool(np.all(verified.low <= 10 * tolerance))


def _explain(study, request, criterion, status, verified, key, tolerance):
    """Tell an infeasible request from one that did not converge, and word it."""
    if status == "not_verified":
        return status, (
            "Fresh runs kept violating a limit beyond their confidence interval; use more samples "
            "or rounds."
        )
    best = np.minimum(study.best(key), np.where(np.isfinite(verified.h), verified.h, np.inf))
    out = [i for i in range(len(request.limits)) if not best[i] <= tolerance]
    if out:
        i = max(out, key=lambda j: best[j])
        limit = request.limits[i]
        word = "at most" if limit.sign > 0 else "at least"
        return "infeasible", (
            f"The limit {word} {show_number(limit.bound, 6)} {limit.unit} on {limit.metric} "
            f"cannot be "
            f"met: the best value within the bounds is {show_number(limit.restore(best[i]), 6)} "
            f"{limit.unit}; relax it to that, or allow smaller tolerances."
        )
    if criterion == "yield" and study.best_yield() < study.level:
        return "infeasible", (
            f"The yield {study.level} cannot be met by all limits together: with the smallest "
            f"tolerances "
            f"it is {study.best_yield():.5f}; relax a limit or allow smaller tolerances."
        )
    return status, "The corrections did not settle; ask for more rounds or a looser tolerance."


def _report(study, request, criterion, answer, history, status, message, verified):
    t = np.exp(answer.x)
    quadratic, _ = study.quadratic_worst(t)
    checks = []
    for i, limit in enumerate(request.limits):
        predicted, value = limit.restore(answer.h[i]), limit.restore(verified.h[i])
        ends = sorted(float(limit.restore(h[i])) for h in (verified.low, verified.high))
        checks.append(
            LimitCheck(
                metric=limit.metric,
                unit=limit.unit,
                side="upper" if limit.sign > 0 else "lower",
                limit=limit.bound,
                nominal=limit.nominal,
                quadratic=float(limit.restore(quadratic[i])),
                predicted=float(predicted),
                verified=float(value),
                verified_interval=tuple(ends),
                predicted_margin=float(limit.sign * (limit.bound - predicted)),
                verified_margin=float(limit.sign * (limit.bound - value)),
                shadow_price=float(-limit.sign * answer.prices[i] / limit.headroom),
            )
        )
    at_bounds = {}
    for name, x, low, high in zip(request.names, t, request.lower, request.upper, strict=True):
        if x <= low * (1 + 1e-6):
            at_bounds[name] = "smallest"
        elif x >= high * (1 - 1e-6):
            at_bounds[name] = "largest"
    statistical = criterion != "worst_case"
    by = "worst-case searches from fresh starts"
    if statistical:
        by = f"a fresh Monte Carlo run of {study.verify_samples} samples"
    return Allocation(
        criterion=criterion,
        status=status,
        message=message,
        tolerances=request.tolerances(t),
        units={name: request.problem.error_unit(name) for name in request.names},
        cost=answer.cost,
        at_bounds=at_bounds,
        limits=tuple(checks),
        level=study.level if statistical else np.nan,
        predicted_yield=study.predicted_yield(t) if criterion == "yield" else np.nan,
        verified_yield=verified.fraction,
        yield_interval=verified.fraction_interval,
        verified_by=by,
        history=tuple(history),
        failed=study.failed + (verified.failed if statistical else 0),
        hessian_error=_hessian_error(request),
    )


def _hessian_error(request):
    """The largest estimated error of a limited metric's Hessian, NaN where Hessians are exact."""
    error = request.model.hessian_error
    return np.nan if error is None else max(float(error[limit.index]) for limit in request.limits)
