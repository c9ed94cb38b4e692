"""The adjustment that a fitter should make: what reduces a metric most, given what is known of a machine's errors.

Place in the pipeline: posterior of an identification, problem -> **correction** -> Correction.

    minimise  sum_j w_j M(x_j + E u)   over the amounts u in their bounds                                (17.20)

for every adjustment alone and for all together, from the samples x_j of the posterior with their weights w_j. The
searches see `points` samples that represent them; what is told of the amounts found comes from all samples.

Symbols: N samples, k unknowns, e (k + those adjusted besides) names, a adjustments, m metrics; u (a,) [rad, m];
y (a,) = (u - low) / (high - low).
Source: theory (17.20), (17.21); A. Shapiro, D. Dentcheva, A. Ruszczynski, Lectures on Stochastic Programming, 2nd ed.
(2014), 5 (sample average approximation).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from rfem_jax.description.basics.errors import InputError
from rfem_jax.description.basics.precision import require_float64
from rfem_jax.description.tasks.settings import fraction, whole_number
from rfem_jax.simulation.specification import Simulation
from rfem_jax.tolerancing.checks import ErrorValues, check_known, read_limits
from rfem_jax.tolerancing.designs.sweep_study import Bounds, read_bounds
from rfem_jax.tolerancing.identification.correction_result import AS_IT_IS, TOGETHER, Correction, Outcome
from rfem_jax.tolerancing.identification.identification_result import Identification
from rfem_jax.tolerancing.identification.posterior import Sampled
from rfem_jax.tolerancing.problems.evaluation import evaluate_points, metric_index, read_point
from rfem_jax.tolerancing.problems.linearisation import linearise_points
from rfem_jax.tolerancing.problems.problem import Metric, ToleranceProblem
from rfem_jax.tolerancing.problems.sample_values import Base
from rfem_jax.tolerancing.problems.simulated_problem import Problem
from rfem_jax.tolerancing.progress import ProgressBar, ProgressOption
from rfem_jax.tolerancing.robust_design.search import minimise_within

STATIONARY = 1e-3  # slope of the mean over its spread, by amounts over their ranges, at which a search ends
ROUNDING = 1e-9  # of means: an adjustment that changes less does nothing
FAILED = 1e3  # that mean where a run failed, which rises from the start on, so that searches turn back
SMALLEST_GAIN = 1e-3  # of the metric
MOST_FAILURES = 0.01  # probability that the machine does not work, above which no promise is made


def correct(
    problem: ToleranceProblem | Simulation,
    found: Identification,
    metric: str | Metric,
    adjustments: Bounds,
    *,
    multiples_of: ErrorValues | None = None,
    limits: Mapping[str, Any] | None = None,
    at: ErrorValues | None = None,
    quantile: float = 0.95,
    points: int = 16,
    steps: int = 40,
    progress: ProgressOption = False,
) -> Correction:
    """Find the adjustment that reduces a metric of a measured machine most, and what the metric is after it.

    Args:
        problem: a `Simulation` or `Problem` (whose metrics do not matter), of the motion that counts, which may be
            another than was measured; or another problem that has the metrics.
        found: of `identify`.
        metric: what is to be less: a name, or a `Metric`.
        adjustments: {error or parameter: (least, largest change)} in rad or m, or strings with a unit: shims, turns;
            0, no change, lies within.
        multiples_of: {adjustment: amount in rad or m, or a string with a unit}: it comes in whole multiples of that, as
            shims do: the better ones of those on both sides of the best amounts, while others stay.
        limits: {metric: largest value, or (low, high)}, whose probabilities to be broken are told.
        at: {error: value} of errors that are known, as of `identify`.
        quantile: the metric is below `reached` with this probability.
        points: samples of the posterior that the searches see.
        steps: the most of a search, each with derivatives at all of these samples.
        progress: shows it, or is told (steps done, the most of all searches).
    Returns: the result, whose status says what is in doubt.
    Raises: InputError for an identification without a posterior, unknown names and bad numbers.
    """
    require_float64()
    level = fraction(quantile, "quantile")
    for what, number in (("points", points), ("steps", steps)):
        whole_number(number, what, 1)
    if not len(found.weights):
        raise InputError(
            f"Argument `found` must have a posterior, but its status is {found.status}: {found.message}; correct that "
            "first."
        )
    machine = _read(problem, found, metric, adjustments, limits, at)
    packs = _read_multiples(machine, multiples_of)
    nothing = np.zeros(len(machine.adjustments))
    before = machine.evaluate(nothing)
    ends, works = [(AS_IT_IS, nothing, True)], np.isfinite(before[:, machine.index])
    if works.any():
        seen = _representatives(before[:, machine.index], found.weights, points)
        alone_and_together = len(machine.adjustments) + (len(machine.adjustments) > 1)
        with ProgressBar(progress, steps * alone_and_together, unit="step") as bar:
            ends += [_in_multiples(machine, seen, packs, *end) for end in _search(machine, found, seen, steps, bar)]
    outcomes = tuple(_outcome(machine, found, before, end, level) for end in ends)
    return Correction(
        metric=machine.problem.metrics[machine.index].name, unit=machine.problem.metrics[machine.index].unit,
        adjustments=machine.adjustments, error_units=tuple(map(machine.problem.error_unit, machine.adjustments)),
        bounds=machine.bounds, names=found.names, outcomes=outcomes, weights=found.weights,
        confidence=found.confidence, quantile=level, status=_status(found, outcomes),
    )  # fmt: skip


@dataclass(frozen=True, eq=False)
class _Machine:
    """Metrics of the problem at changed samples of the posterior: names (e), samples x (N, e), the errors `base` held
    fixed, index of the metric, limits {metric: (low, high)}; reach (a,): where the adjusted ones are among the names;
    bounds (a, 2) of their amounts."""

    problem: ToleranceProblem
    names: tuple[str, ...]
    x: Float[np.ndarray, "N e"]
    base: Base
    index: int
    limits: dict[str, tuple[float, float]]
    adjustments: tuple[str, ...]
    reach: Int[np.ndarray, " a"]
    bounds: Float[np.ndarray, "a 2"]

    def changed(self, amounts: Float[np.ndarray, "p a"], rows: Any = slice(None)) -> Float[np.ndarray, "p n e"]:
        """Errors of the samples `rows` after each of p adjustments."""
        moved = np.repeat(self.x[None, rows], len(amounts), axis=0)
        moved[:, :, self.reach] += amounts[:, None]
        return moved

    def evaluate(self, amounts: Float[np.ndarray, " a"]) -> Float[np.ndarray, "N m"]:
        """All metrics after an adjustment, NaN where a run failed."""
        return evaluate_points(self.problem, self.names, self.base, self.changed(amounts[None])[0])[0]

    def means(self, amounts: Float[np.ndarray, "p a"], rows: Int[np.ndarray, " n"]) -> Float[np.ndarray, " p"]:
        """Mean of the metric over the samples `rows` after each of p adjustments, NaN where a run failed."""
        moved = self.changed(amounts, rows).reshape(-1, len(self.names))
        values = evaluate_points(self.problem, self.names, self.base, moved)[0][:, self.index]
        return values.reshape(len(amounts), -1).mean(axis=1)

    def slopes(
        self, amounts: Float[np.ndarray, "p a"], rows: Int[np.ndarray, " n"]
    ) -> tuple[Float[np.ndarray, " p"], Float[np.ndarray, "p a"]]:
        """As `means`, with their derivatives by the amounts."""
        moved = self.changed(amounts, rows).reshape(-1, len(self.names))
        values, slopes, _ = linearise_points(self.problem, self.names, self.base, moved, metric=self.index)
        p, a = amounts.shape
        slopes = slopes[:, self.reach].reshape(p, -1, a)
        return values[:, self.index].reshape(p, -1).mean(axis=1), slopes.mean(axis=1)


def _read(problem, found: Identification, metric, adjustments, limits, at) -> _Machine:
    """Raises: InputError."""
    if isinstance(problem, Simulation):
        problem = Problem(problem, [metric])
    if isinstance(problem, Problem):
        known = {one if isinstance(one, str) else one.name: one for one in (*(limits or {}), metric)}
        problem = problem.with_metrics(known.values())
    names, ends = read_bounds(problem, adjustments, "adjustments")
    for name, (low, high) in zip(names, ends, strict=True):
        if low > 0.0 or high < 0.0:
            raise InputError(
                f"Argument `adjustments` must be changes, 0 among them, but `{name}` goes from {low:g} to {high:g}; "
                "give the least and the largest change from what was measured."
            )
    check_known(found.names, problem.error_names, "found")
    fixed = read_point(problem, at)
    own = (*found.names, *(name for name in names if name not in found.names))
    x = np.zeros((len(found.weights), len(own)))
    x[:, : len(found.names)] = found.sampled
    for i, name in enumerate(own[len(found.names) :], start=len(found.names)):
        x[:, i] = fixed.get(name, 0.0)
    base = {name: jnp.asarray(value, jnp.float64) for name, value in fixed.items() if name not in own}
    known = [one.name for one in problem.metrics]
    return _Machine(
        problem, own, x, base, metric_index(problem, metric), read_limits(limits, known), names,
        np.array([own.index(name) for name in names]), np.array(ends),
    )  # fmt: skip


def _representatives(
    values: Float[np.ndarray, " N"], weights: Float[np.ndarray, " N"], n: int
) -> Int[np.ndarray, " n"]:
    """Samples that stand for all: one of each of n parts of equal probability, in the order of the metric."""
    order = np.argsort(values)[: int(np.isfinite(values).sum())]
    reached = np.cumsum(weights[order])
    return order[np.searchsorted(reached, (np.arange(n) + 0.5) / n * reached[-1]).clip(max=len(order) - 1)]


def _search(
    machine: _Machine, found: Identification, seen: Int[np.ndarray, " n"], steps: int, bar: ProgressBar
) -> list[tuple[str, Float[np.ndarray, " a"], bool]]:
    """(name, amounts (a,), converged) of every adjustment alone, and of all together where there are several."""
    a, starts = len(machine.adjustments), _starts(machine, found)
    ends = [
        (name, *_minimise(machine, seen, np.arange(a) == i, starts, steps, bar))
        for i, name in enumerate(machine.adjustments)
    ]
    if a > 1:
        further = np.array([*starts, *(amounts for _, amounts, _ in ends)])
        ends.append((TOGETHER, *_minimise(machine, seen, np.ones(a, dtype=bool), further, steps, bar)))
    return ends


def _starts(machine: _Machine, found: Identification) -> Float[np.ndarray, "c a"]:
    """Amounts to begin with: none, what makes errors zero, and half-way to the ends."""
    mean = dict(zip(found.names, found.weights @ found.sampled / found.weights.sum(), strict=True))
    undone = np.array([-mean.get(name, 0.0) for name in machine.adjustments])
    low, high = machine.bounds.T
    return np.array([np.zeros(len(low)), np.clip(undone, low, high), 0.5 * low, 0.5 * high])


def _minimise(
    machine: _Machine,
    seen: Int[np.ndarray, " n"],
    free: Bool[np.ndarray, " a"],
    starts: Float[np.ndarray, "c a"],
    steps: int,
    bar: ProgressBar,
) -> tuple[Float[np.ndarray, " a"], bool]:
    """Amounts (a,), of adjustments that are not free 0, with the least mean over the samples seen, from the best of c
    starts; and whether the search converged. `bar` counts its steps, at the end those that it did not need, too."""
    ends_at = bar.done + steps
    low, width = machine.bounds[free, 0], np.ptp(machine.bounds[free], axis=1)
    starts = np.unique(np.where(free, starts, 0.0), axis=0)
    means = machine.means(starts, seen)
    good = np.isfinite(means)
    if not good.any():
        bar.advance(steps)
        return np.zeros(len(free)), False
    lowest, nothing = float(means[good].min()), int(np.argmin(np.abs(starts).sum(axis=1)))
    spread, negligible = float(np.ptp(means[good])), ROUNDING * float(np.abs(means[good]).max())
    scale = spread if spread > negligible else 1.0
    best = nothing if means[nothing] <= lowest + negligible else int(np.nanargmin(means))
    known: dict[bytes, tuple[float, np.ndarray]] = {}

    def at(y):
        return np.where(free, np.array([*(low + width * y)])[np.cumsum(free) - 1], 0.0)

    start = (starts[best][free] - low) / width

    def function(y):
        if y.tobytes() not in known:
            mean, slope = (one[0] for one in machine.slopes(at(y)[None], seen))
            found = (mean - lowest) / scale, slope[free] * width / scale
            if not (np.isfinite(mean) and np.isfinite(slope).all()):
                found = FAILED * (1.0 + float(np.sum((y - start) ** 2))), 2.0 * FAILED * (y - start)
            known[y.tobytes()] = found
            bar.advance(min(1, ends_at - bar.done))
        return *known[y.tobytes()], np.zeros(0), np.zeros((0, len(y)))

    end = minimise_within(function, start, most=steps, stationary=STATIONARY)
    bar.advance(ends_at - bar.done)
    return at(end.y), end.residual <= STATIONARY


def _read_multiples(machine: _Machine, multiples_of: ErrorValues | None) -> Float[np.ndarray, " a"]:
    """Amounts (a,) of which adjustments are whole multiples, 0 of those that are free. Raises: InputError."""
    check_known(multiples_of or {}, machine.adjustments, "multiples_of")
    known = read_point(machine.problem, multiples_of, "multiples_of")
    for name, amount in known.items():
        if not amount > 0.0:
            raise InputError(
                f"Argument `multiples_of` must give positive amounts, but `{name}` has {amount:g}; leave out an "
                "adjustment that is free."
            )
    return np.array([known.get(name, 0.0) for name in machine.adjustments])


def _in_multiples(
    machine: _Machine, seen: Int[np.ndarray, " n"], packs: Float[np.ndarray, " a"],
    name: str, amounts: Float[np.ndarray, " a"], converged: bool,
) -> tuple[str, Float[np.ndarray, " a"], bool]:  # fmt: skip
    """The adjustment with the multiples next to what was found, on either side, after which the mean over the samples
    seen is least; free amounts stay."""
    sides = []
    for amount, pack, (low, high) in zip(amounts, packs, machine.bounds, strict=True):
        next_to = {amount} if pack == 0.0 or amount == 0.0 else {k * pack for k in _whole(amount / pack)}
        slack = 1e-9 * (high - low)
        sides.append(sorted(one for one in next_to if low - slack <= one <= high + slack))
    choices = np.array(list(product(*sides)))
    means = machine.means(choices, seen)
    best = int(np.argmin(np.where(np.isfinite(means), means, np.inf)))
    return name, choices[best], converged


def _whole(ratio: float) -> set[float]:
    """Whole numbers on both sides of a number, the same one of what is whole but for rounding."""
    near = round(ratio)
    return {float(near)} if abs(ratio - near) < 1e-9 else {float(np.floor(ratio)), float(np.ceil(ratio))}


def _outcome(
    machine: _Machine, found: Identification, before: Float[np.ndarray, "N m"],
    end: tuple[str, Float[np.ndarray, " a"], bool], quantile: float,
) -> Outcome:  # fmt: skip
    """What all samples say of a machine after an adjustment. A run that fails breaks all limits."""
    name, amounts, converged = end
    values = before if name == AS_IT_IS else machine.evaluate(amounts)
    part, tail = found.weights / found.weights.sum(), 0.5 * (1.0 - found.confidence)
    metric = values[:, machine.index]
    works = np.isfinite(metric)
    low, high, reached, mean, deviation = (np.nan,) * 5
    if works.any():
        w, m = part[works] / part[works].sum(), metric[works]
        mean = float(w @ m)
        deviation = float(np.sqrt(w @ (m - mean) ** 2))
        drawn = Sampled(machine.x[works], w, np.nan, np.zeros(len(w), dtype=int))
        low, high, reached = drawn.quantiles(m, 0, (tail, 1.0 - tail, quantile))
    known = [one.name for one in machine.problem.metrics]
    broken = {}
    for limited, (least, most) in machine.limits.items():
        limited_values = values[:, known.index(limited)]
        broken[limited] = float(part @ ~((limited_values >= least) & (limited_values <= most)))
    errors = machine.changed(amounts[None])[0][:, : len(found.names)]
    outside = (errors < found.tolerances[:, 0]) | (errors > found.tolerances[:, 1])
    given = np.isfinite(found.tolerances[:, 0])
    return Outcome(
        name=name, amounts=amounts, values=metric, mean=mean, deviation=deviation, low=low, high=high, reached=reached,
        less=float(part @ (metric < before[:, machine.index])), failed=float(part @ ~works), broken=broken,
        beyond=np.where(given, part @ outside, np.nan),
        any_beyond=float(part @ outside.any(axis=1)) if given.any() else np.nan, converged=converged,
    )  # fmt: skip


def _status(found: Identification, outcomes: Sequence[Outcome]) -> str:
    """See `STATUSES` of the result."""
    before, after = outcomes[0], outcomes[1:]
    if not after:
        return "failed"
    best = min(after, key=lambda one: one.mean if np.isfinite(one.mean) else np.inf)
    if found.status not in ("ok", "ambiguous") or not max(before.failed, best.failed) <= MOST_FAILURES:
        return "doubtful"
    if not all(one.converged for one in after):
        return "not_converged"
    return "ok" if best.mean < before.mean - SMALLEST_GAIN * abs(before.mean) else "no_gain"
