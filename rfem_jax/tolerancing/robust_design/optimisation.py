"""The best dimensions and tolerances of a mechanism that keep limits: `optimise`.

Place in the pipeline: request -> criteria, search, verification -> **optimisation** -> reports.

    1  starts: the nominal design and Sobol' points of the unit cube, evaluated together; the best ones are searched
    2  search: sequential quadratic programming; in the worst case new worst points become constraints, and the search
       goes on from where it was, until there are none (theory (10.15))
    3  verification by a fresh run; a sample that fell short aims higher and is searched again

The program of the third step is compiled while that of the first two is traced.

Dimensions and tolerances are found at once: a larger section lets tolerances grow, at its own price.
Source: A. Ben-Tal, L. El Ghaoui, A. Nemirovski, Robust Optimization (2009), ch. 1 (the problem); J. W. Blankenship,
J. E. Falk, J. Optim. Theory Appl. 19 (1976) 261-281 (exchange of worst points).
"""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rfem_jax.compilation.program import Program
from rfem_jax.description.basics.errors import InputError, require_choice
from rfem_jax.description.basics.precision import require_float64
from rfem_jax.tolerancing.checks import ErrorValue
from rfem_jax.tolerancing.layout import show_number
from rfem_jax.tolerancing.optimisation.sizes import Zones
from rfem_jax.tolerancing.optimisation.starting_points import sobol_units
from rfem_jax.tolerancing.problems.distributions import Normal, Tolerance
from rfem_jax.tolerancing.problems.named_tolerances import Tolerances
from rfem_jax.tolerancing.problems.problem import ToleranceProblem
from rfem_jax.tolerancing.robust_design.cost_models import CostModel, total_cost
from rfem_jax.tolerancing.robust_design.criteria import CRITERIA, FAILED, Criterion, verify_nominal
from rfem_jax.tolerancing.robust_design.observations import Observer
from rfem_jax.tolerancing.robust_design.request import COST, Bounds, Widths, check_request
from rfem_jax.tolerancing.robust_design.result import DesignOptimum, LimitCheck
from rfem_jax.tolerancing.robust_design.search import (
    HOLDS,
    PENALTY,
    Evaluation,
    Found,
    least_violation,
    minimise_within,
)
from rfem_jax.tolerancing.robust_design.verification import ErrorSample, Verified, check_limits, within
from rfem_jax.tolerancing.sampling.sequences import RandomKey

EXCHANGES = 12  # of worst points, at most
ATTEMPTS = 3  # searches, each after a fresh run that fell short
STATIONARY = 1e-4  # KKT residual of a search that has converged, of the objective at the start
TIED = 1e-4  # constraints that differ by this share of the largest stand against each other


@Program
def _price(
    models: Sequence[CostModel], widths: Float[Array, " free"]
) -> tuple[Float[Array, ""], Float[Array, " free"]]:
    """Total cost of tolerances [rad, m], and its derivatives by them; asked for at every point of a search."""
    return jax.value_and_grad(lambda t: total_cost(models, t))(widths)


def optimise(
    problem: ToleranceProblem,
    designs: Bounds,
    tolerances: Tolerances | Widths | None,
    objective: str | Mapping[str, float],
    limits: Mapping[str, Any] | None = None,
    *,
    robust: str = "worst_case",
    cost: CostModel | Mapping[str, CostModel] | None = None,
    key: RandomKey,
    at: Mapping[str, ErrorValue] | None = None,
    target: float = 0.9973,
    coverage: float = 3.0,
    distribution: Callable[[float], Tolerance] = Normal,
    samples: int = 128,
    verify_samples: int = 2048,
    starts: int = 8,
    searches: int = 1,
    steps: int = 60,
    mode: str = "auto",
    batch: int = 64,
    zones: Zones | None = None,
    progress: Callable[[int], object] | None = None,
) -> DesignOptimum:
    """Find the dimensions and tolerances that make an objective least while limits hold.

    Arguments: designs {name: (lowest, highest value)} of parameters [unit of each, or strings with a unit]; tolerances
    {error: half-width, or (smallest, largest) where it is to be found; zone of a drawing: its diameter likewise}, or a
    Tolerances collection; objective, a metric of the perfect mechanism, "cost" of the tolerances to be found, or
    {these: weight}; limits {metric: largest value, or (low, high)}; robust, when they hold: "nominal" (perfect
    mechanism), "worst_case", "rss" (mean + `coverage` deviations) or "yield" (fraction `target` of mechanisms holds all
    limits); cost and zones, as of `allocate`; key, a JAX key; at {error: value} with fixed values; distribution, a
    callable half-width -> Tolerance, samples and verify_samples, of "rss" and "yield"; starts, compared at first, and
    searches, of the best of them; steps of a search; mode and batch as of `allocate`; progress, is called with the
    number of simulations.  An interrupted call continues within `kept_evaluations.kept_in(folder)`.

    Returns: DesignOptimum; "infeasible" says which limit is in the way.
    Raises: InputError for unknown names, bad bounds and options.
    """
    require_float64()
    require_choice(robust, tuple(CRITERIA), "robust")
    if not 0.0 < target < 1.0:
        raise InputError(f"Argument `target` must lie between 0 and 1, but it is {target}.")
    for name, number in (("samples", samples), ("starts", starts), ("searches", searches)):
        if number < 1:
            raise InputError(f"Argument `{name}` must be at least 1, but it is {number}.")
    request = check_request(problem, designs, tolerances, objective, limits, cost, at, robust, zones, mode, batch)
    observer = Observer(request, progress)
    observer.require_reproduced()
    keys = jax.random.split(key, 4)
    sample = ErrorSample(robust, target, coverage, distribution, samples, verify_samples)
    criterion = CRITERIA[robust](observer, keys[0], sample)
    study = _Study(observer, criterion, robust, steps)
    begun = study.begin(starts, keys[1])[:searches]
    solved = [study.solve(start, jax.random.fold_in(keys[2], n)) for n, start in enumerate(begun)]
    return study.finish(min(solved, key=study.merit), keys[3], starts)


class _Study:
    """One optimisation while it is solved."""

    def __init__(self, observer: Observer, criterion: Criterion, robust: str, steps: int):
        self.request, self.observer = observer.request, observer
        self.criterion, self.robust, self.steps = criterion, robust, steps
        self.scale = 1.0
        self.history: list[tuple[float, float]] = []

    def evaluate(self, y: Float[np.ndarray, " p"]) -> Evaluation:
        """Objective over its size at the start, constraints, and their derivatives."""
        objective, gradient = self.objective(y)
        if not self.request.limits:
            return objective / self.scale, gradient / self.scale, np.zeros(0), np.zeros((0, len(y)))
        found = self.criterion.constraints(y)
        return objective / self.scale, gradient / self.scale, found.value, found.derivative

    def objective(self, y: Float[np.ndarray, " p"]) -> tuple[float, Float[np.ndarray, " p"]]:
        """Objective and its gradient; far too large, and flat, where the perfect mechanism fails."""
        variables, weights = self.request.variables, self.request.metric_weights
        seen = self.criterion.observe(y)
        back = variables.pull_back(y, self.criterion.points[:1], seen.jacobian[:1])[0]
        used = weights != 0.0
        value, gradient = weights[used] @ seen.values[0, used], weights[used] @ back[used]
        if not np.isfinite(value) or not np.isfinite(gradient).all():
            return FAILED * self.scale, np.zeros(len(y))
        price, slope = self.cost(y)
        weight = self.request.weights.get(COST, 0.0)
        gradient[len(variables.designs) :] += weight * slope
        return float(value + weight * price), gradient

    def cost(self, y: Float[np.ndarray, " p"]) -> tuple[float, Float[np.ndarray, " free"]]:
        """Cost of the tolerances to be found, and its derivatives by their variables."""
        variables, models = self.request.variables, self.request.costs
        widths = jnp.asarray(variables.widths(y)[list(variables.free)])
        price, slope = _price(models, widths)
        return float(price), np.asarray(slope) * variables.width_slopes(y)

    def begin(self, starts: int, key: RandomKey) -> list[Float[np.ndarray, " p"]]:
        """Starts, the best first: evaluated at once, by the objective with a penalty on violated constraints."""
        variables = self.request.variables
        spread = sobol_units(variables.size, max(starts - 1, 1), key)[: starts - 1]
        points = np.concatenate([variables.start[None], spread])
        size, _ = self.objective(points[0])
        self.scale = abs(size) if np.isfinite(size) and size not in (0.0, FAILED) else 1.0
        self._together(points)
        ranks = []
        for y in points:
            objective, _, constraints, _ = self.evaluate(y)
            ranks.append(objective + PENALTY * max(np.max(constraints, initial=0.0), 0.0))
        return [points[i] for i in np.argsort(ranks, kind="stable")]

    def _together(self, points: Float[np.ndarray, "starts p"]) -> None:
        """Observe all starts in one batch; what each asks for afterwards is known then."""
        z, variables = self.criterion.points, self.request.variables
        if len(z) > 1 or len(points) == 1:
            return  # a sample fills the batches by itself
        self.observer.learn([variables.deviations(y, z) for y in points])

    def solve(self, start: Float[np.ndarray, " p"], key: RandomKey) -> Found:
        """The best point from a start, all worst points found."""
        return self._exchange(minimise_within, start, key, self._note)

    def nearest(self, start: Float[np.ndarray, " p"], key: RandomKey) -> Found:
        """The point that comes nearest to the limits, all worst points found."""
        return self._exchange(least_violation, start, key, lambda found: None)

    def _exchange(self, search, start, key, note) -> Found:
        """Search until there are no more worst points at the end that the constraints lack."""
        found = search(self.evaluate, start, most=self.steps)
        for number in range(EXCHANGES):
            note(found)
            if not self.criterion.extend(found.y, jax.random.fold_in(key, number)):
                break
            found = search(self.evaluate, found.y, most=self.steps)
        return found

    def _note(self, found: Found) -> None:
        self.history.append((found.objective * self.scale, float(np.max(found.constraints, initial=0.0))))

    def merit(self, found: Found) -> float:
        """What is least for the best solution."""
        return found.objective + PENALTY * (found.violation if not found.feasible else 0.0)

    def finish(self, found: Found, key: RandomKey, starts: int) -> DesignOptimum:
        """Verify the answer, search again where a fresh run falls short, and explain what cannot be met."""
        verified = self.verify(found.y, key)
        for attempt in range(1, ATTEMPTS):
            short = self.shortfall(verified)
            if not found.feasible or short <= 0.0:
                break
            again = jax.random.fold_in(key, attempt)
            self.criterion.tighten(short)
            self.criterion.extend(found.y, again)
            found = self.solve(found.y, again)
            verified = self.verify(found.y, jax.random.fold_in(again, 1))
        status, message = self.judge(found, verified)
        if status == "infeasible":
            nearest = self.nearest(found.y, jax.random.fold_in(key, ATTEMPTS + 3))
            if nearest.violation <= HOLDS:  # the search for the best point missed what there is
                found = self.solve(nearest.y, jax.random.fold_in(key, ATTEMPTS))
                verified = self.verify(found.y, jax.random.fold_in(key, ATTEMPTS + 1))
                status, message = self.judge(found, verified)
            if status == "infeasible":
                found = nearest._replace(objective=self.evaluate(nearest.y)[0])
                verified = self.verify(found.y, jax.random.fold_in(key, ATTEMPTS + 2))
                message = self.explain(found)
        return self.report(found, verified, (status, message), starts)

    def verify(self, y: Float[np.ndarray, " p"], key: RandomKey) -> Verified:
        """A fresh run at y."""
        return self.criterion.verify(y, key) if self.request.limits else verify_nominal(self.observer, y)

    def shortfall(self, verified: Verified) -> float:
        """As `Criterion.shortfall`; 0 where there are no limits."""
        return self.criterion.shortfall(verified) if self.request.limits else 0.0

    def judge(self, found: Found, verified: Verified) -> tuple[str, str]:
        """Status and message of an answer."""
        if not found.feasible:
            return "infeasible", ""
        if self.shortfall(verified) > 0.0:
            return "not_verified", "A fresh run violates a limit; use more samples or searches."
        if found.residual > STATIONARY:
            return "not_converged", (
                f"The conditions of optimality hold to {found.residual:.1e} of the objective only; allow more steps, "
                "or smooth the metrics (mean squares instead of their roots)."
            )
        return "ok", ""

    def explain(self, found: Found) -> str:
        """Which limit is in the way of an infeasible request, and how near it comes."""
        constrained = self.criterion.constraints(found.y)
        owner = constrained.limit[int(np.argmax(constrained.value))]
        if owner < 0:
            seen = self.criterion.observe(found.y)
            h = self.request.normalise(seen.values[1:])
            good = np.isfinite(h).all(axis=1)
            owner = int(np.argmax((h[good] > 0.0).mean(axis=0))) if good.any() else 0
            limit, share = self.request.limits[owner], np.mean(within(h))
            return (
                f"The yield {self.criterion.level:g} cannot be met: it is {share:.4f} at the nearest design, and the "
                f"limit {show_number(limit.bound)} {limit.unit} on {limit.metric} is missed most often; relax it, or "
                "widen the bounds."
            )
        largest = np.max(constrained.value)
        binding = {}
        for value, number in zip(constrained.value, constrained.limit, strict=True):
            if value >= largest - TIED * abs(largest):
                binding[number] = value
        limits = [self.request.limits[number] for number in binding]
        words = [limit.words for limit in limits]
        reached = [limit.reached(value) for limit, value in zip(limits, binding.values(), strict=True)]
        if len(binding) == 1:
            head, tail = f"The limit {words[0]} cannot be met", f"reaches {reached[0]}; relax it to that"
        else:
            head = f"The limits {' and '.join(words)} cannot be met together"
            tail = f"reaches {' and '.join(reached)}; relax them to that"
        return f"{head}: the nearest design {tail}, or widen the bounds."

    def report(self, found: Found, verified: Verified, outcome: tuple[str, str], starts: int) -> DesignOptimum:
        """The result."""
        request, variables, y = self.request, self.request.variables, found.y
        seen = self.criterion.observe(y)
        nominal = {metric.name: float(value) for metric, value in zip(request.problem.metrics, seen.values[0])}
        terms = {name: nominal[name] for name in request.weights if name != COST}
        if request.costs:
            terms[COST] = self.cost(y)[0]
        metric_units = {metric.name: metric.unit for metric in request.problem.metrics}
        objective = sum(weight * terms[name] for name, weight in request.weights.items())
        return DesignOptimum(
            criterion=self.robust,
            status=outcome[0],
            message=outcome[1],
            designs=variables.named_values(y),
            tolerances=variables.named_widths(y),
            units=request.units,
            initial=dict(zip(variables.designs, map(float, variables.nominal), strict=True)),
            objective=float(objective),
            terms=terms,
            term_units={name: metric_units.get(name, "") for name in terms},
            weights=request.weights,
            limits=self._limits(found, verified, nominal),
            at_bounds=variables.at_bounds(y),
            kkt_residual=found.residual,
            verified_yield=verified.fraction,
            yield_interval=verified.interval,
            verified_by=verified.what,
            simulations=self.observer.simulations,
            failed=self.observer.failed + verified.failed,
            starts=starts,
            history=tuple(self.history),
        )

    def _limits(self, found: Found, verified: Verified, nominal: dict[str, float]) -> tuple[LimitCheck, ...]:
        if not self.request.limits:
            return ()
        constrained = self.criterion.constraints(found.y)
        owners = [np.flatnonzero(np.array(constrained.limit) == i) for i in range(len(self.request.limits))]
        # Of a yield, which counts all limits together, none has constraints of its own.
        predicted = np.array([np.max(constrained.value[own]) if len(own) else np.nan for own in owners])
        prices = np.array([np.sum(found.multipliers[own]) * self.scale if len(own) else np.nan for own in owners])
        return check_limits(self.request.limits, nominal, predicted, verified, prices)
