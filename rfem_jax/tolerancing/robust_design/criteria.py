"""When limits hold: at the perfect mechanism, everywhere within the tolerances, by root sum of squares, at a yield.

Place in the pipeline: observations -> **criteria** -> search.

A criterion has standard points z (n, k), where the problem is observed, and makes constraints g(y) <= 0 of what was
observed there, with their derivatives.  The first standard point is zero: the perfect mechanism, of which the objective
is a function.

    nominal     g_l = h_l(0)
    worst_case  g_j = h_l(z_j) for the worst points z_j of limit l found so far (theory (10.15)); `extend` finds more
    rss         g_l = mean + c deviations of h_l over a fixed sample, in the mean square the root sum of squares
    yield       g = quantile of max_l h_l over a fixed sample (Harrell and Davis, theory (10.17))

Symbols: y (p,) variables; h (n, l) normalised limits, at most 0 where they hold; dh (n, l, p) their derivatives.
"""

import abc
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from rfem_jax.tolerancing.optimisation.projected_gradient import climb_together
from rfem_jax.tolerancing.optimisation.sizes import Sizes
from rfem_jax.tolerancing.optimisation.starting_points import (
    box_corners,
    distinct,
    projection,
    sobol_units,
    spread_points,
)
from rfem_jax.tolerancing.robust_design.models import quantile_weights
from rfem_jax.tolerancing.robust_design.observations import Observed, Observer
from rfem_jax.tolerancing.robust_design.request import Limit
from rfem_jax.tolerancing.robust_design.verification import (
    ErrorSample,
    Verified,
    mean_and_deviations,
    without_interval,
)
from rfem_jax.tolerancing.sampling.sequences import RandomKey

ALL_CORNERS = 8  # errors, of which a fresh run tries all corners of the box
AGREES = 1e-3  # of a limit: how far a fresh worst case may exceed it
CORNERS = 4  # of so many errors the corners of the box are among the starts of a search for the worst point
SEARCH_STEPS = 40
STATIONARY = 1e-4  # residual of a search for a worst point, whose height is then exact to about its square
NEW_POINT = 1e-3  # points nearer than this are one
FAILED = 1e3  # a constraint whose sample failed: far from holding


class Constrained(NamedTuple):
    """Constraints (c,), at most 0 where they hold, their derivatives (c, p), and the limit (c,) of each (-1: all)."""

    value: Float[np.ndarray, " c"]
    derivative: Float[np.ndarray, "c p"]
    limit: tuple[int, ...]


class Criterion(abc.ABC):
    """See the module's docstring.

    Arguments: observer; points (n, k), standard points after the first, which is zero. level: fraction of mechanisms
    that hold all limits (NaN but for a yield).
    """

    level = np.nan

    def __init__(self, observer: Observer, points: Float[np.ndarray, "n k"] | None = None):
        self.observer, self.limits = observer, observer.request.limits
        self.variables = observer.request.variables
        origin = np.zeros((1, len(self.variables.errors)))
        self.points = origin if points is None else np.concatenate([origin, points])

    def observe(self, y: Float[np.ndarray, " p"]) -> Observed:
        """The problem at all standard points."""
        return self.observer.observe(y, self.points)

    def constraints(self, y: Float[np.ndarray, " p"]) -> Constrained:
        """Constraints at y, with derivatives."""
        seen = self.observe(y)
        request = self.observer.request
        back = self.variables.pull_back(y, self.points, seen.jacobian)
        return self.reduce(request.normalise(seen.values), request.normalise_slopes(back))

    @abc.abstractmethod
    def reduce(self, h: Float[np.ndarray, "n l"], dh: Float[np.ndarray, "n l p"]) -> Constrained:
        """Constraints from the normalised limits at all standard points."""

    def extend(self, y: Float[np.ndarray, " p"], key: RandomKey) -> bool:
        """Add standard points that the constraints at y lack; returns whether there were any."""
        del y, key
        return False

    @abc.abstractmethod
    def verify(self, y: Float[np.ndarray, " p"], key: RandomKey) -> Verified:
        """A fresh run at y."""

    def shortfall(self, verified: Verified) -> float:
        """How far a fresh run is beyond its limits, of a yield the fraction that lacks; 0 where it agrees."""
        beyond = float(np.max(verified.low, initial=0.0))
        return beyond if beyond > AGREES else 0.0

    def tighten(self, shortfall: float) -> None:
        """Aim higher after a fresh run fell short."""
        del shortfall


class NominalCriterion(Criterion):
    """Limits hold at the perfect mechanism."""

    def reduce(self, h: Float[np.ndarray, "n l"], dh: Float[np.ndarray, "n l p"]) -> Constrained:
        """As `Criterion.reduce`."""
        return _constrained(h[0], dh[0], range(len(self.limits)))

    def verify(self, y: Float[np.ndarray, " p"], key: RandomKey) -> Verified:
        """As `Criterion.verify`."""
        return verify_nominal(self.observer, y)


class WorstCaseCriterion(Criterion):
    """Limits hold everywhere in the box of the tolerances: at all worst points that were found."""

    def __init__(self, observer: Observer):
        super().__init__(observer)
        self.owner = [*range(len(self.limits))]  # every limit at the centre, until worse points are found
        self.row = [0] * len(self.limits)

    def reduce(self, h: Float[np.ndarray, "n l"], dh: Float[np.ndarray, "n l p"]) -> Constrained:
        """As `Criterion.reduce`."""
        return _constrained(h[self.row, self.owner], dh[self.row, self.owner], self.owner)

    def extend(self, y: Float[np.ndarray, " p"], key: RandomKey) -> bool:
        """Add the worst points of the limits at y, where they are worse than those known; returns whether any is."""
        before = [*zip(self.constraints(y).value, self.owner, strict=True)]
        starts = search_starts(self.variables.sizes, key)
        added = False
        for number in range(len(self.limits)):
            known = max(g for g, owner in before if owner == number)
            points, heights = worst_points(self.observer, self.limits[number], y, starts)
            for z, height in zip(points[:2], heights[:2], strict=True):
                if height > max(known, 0.0) + NEW_POINT**2:
                    added = self._add(number, z) or added
        return added

    def verify(self, y: Float[np.ndarray, " p"], key: RandomKey) -> Verified:
        """As `Criterion.verify`: searches from new starting points, and corners of the box where they are few."""
        sizes, k = self.variables.sizes, len(self.variables.errors)
        starts = search_starts(sizes, key)
        points = np.concatenate([worst_points(self.observer, limit, y, starts)[0][:2] for limit in self.limits])
        what = "searches for the worst case from new starting points"
        if k <= ALL_CORNERS and sizes.region == "box":
            points, what = np.concatenate([points, box_corners(k)]), f"{what} and at all {2**k} corners"
        values = self.observer.values(self.variables.deviations(y, np.concatenate([np.zeros((1, k)), points])))
        return without_interval(np.nanmax(self.observer.request.normalise(values), axis=0), values, what)

    def _add(self, number: int, z: Float[np.ndarray, " k"]) -> bool:
        """Let a limit hold at a point, which may be that of another limit; returns whether it did not before."""
        distances = np.max(np.abs(self.points - z), axis=1)
        row = int(np.argmin(distances))
        if distances[row] > NEW_POINT:
            self.points, row = np.concatenate([self.points, z[None]]), len(self.points)
        if (number, row) in zip(self.owner, self.row, strict=True):
            return False
        self.owner.append(number)
        self.row.append(row)
        return True


class SampleCriterion(Criterion):
    """Limits hold for a fixed sample of a distribution: by root sum of squares, or at a yield."""

    def __init__(self, observer: Observer, key: RandomKey, sample: ErrorSample):
        super().__init__(observer, sample.points(observer.request.variables.sizes, key))
        self.sample, self.level, self.aim = sample, sample.level, sample.level
        self.extra = 0.0

    def reduce(self, h: Float[np.ndarray, "n l"], dh: Float[np.ndarray, "n l p"]) -> Constrained:
        """As `Criterion.reduce`; failed samples are left out of "rss", and count as bad for a yield."""
        h, dh = h[1:], dh[1:]
        good = np.isfinite(h).all(axis=1) & np.isfinite(dh).all(axis=(1, 2))
        count, limits = len(h), range(len(self.limits))
        if not good.any() or (self.sample.joint and np.mean(good) <= self.aim):
            return _failed(len(self.limits), dh.shape[2], limits)
        h, dh = h[good], dh[good]
        if not self.sample.joint:
            mean, slope = h.mean(axis=0), dh.mean(axis=0)
            away = h - mean
            deviation = np.sqrt((away**2).sum(axis=0) / max(len(h) - 1, 1))
            along = np.einsum("nl,nlp->lp", away, dh - slope) / max(len(h) - 1, 1)
            safe = np.where(deviation > 0.0, deviation, 1.0)
            value = mean + self.sample.coverage * deviation + self.extra
            return _constrained(value, slope + self.sample.coverage * along / safe[:, None], limits)
        worst = np.argmax(h, axis=1)
        rows = np.arange(len(h))
        order = np.argsort(h[rows, worst], kind="stable")
        weights = quantile_weights(len(h), min(self.aim * count / len(h), 1.0))
        return _constrained(
            np.array([weights @ h[rows, worst][order]]), (weights @ dh[rows, worst][order])[None], (-1,)
        )

    def verify(self, y: Float[np.ndarray, " p"], key: RandomKey) -> Verified:
        """As `Criterion.verify`: an independent Monte Carlo run."""
        statistic = mean_and_deviations(self.sample.coverage)
        return self.sample.verify(self.observer, lambda z: self.variables.deviations(y, z), key, statistic)

    def shortfall(self, verified: Verified) -> float:
        """As `Criterion.shortfall`."""
        if not self.sample.joint:
            return super().shortfall(verified)
        return self.level - verified.fraction if verified.interval[1] < self.level else 0.0

    def tighten(self, shortfall: float) -> None:
        """Aim higher after a fresh run fell short: of a yield by the fraction, of "rss" by the normalised limit."""
        if not self.sample.joint:
            self.extra += shortfall
        else:
            self.aim += min(shortfall, 0.5 * (1.0 - self.aim))


def verify_nominal(observer: Observer, y: Float[np.ndarray, " p"]) -> Verified:
    """A run of the perfect mechanism."""
    request = observer.request
    values = observer.values(request.variables.deviations(y, np.zeros((1, len(request.variables.errors)))))
    h = np.array([limit.normalise(values[0, limit.position]) for limit in request.limits])
    return without_interval(h, values, "a run of the perfect mechanism")


def search_starts(sizes: Sizes, key: RandomKey) -> Float[np.ndarray, "starts k"]:
    """Where searches for a worst point begin: corners of the box, where they are few, and Sobol' points."""
    k = len(sizes.errors)
    if sizes.region != "box":
        return spread_points(sobol_units(k + 1, 8, key), sizes.region)
    spread = 2.0 * sobol_units(k, 8, key) - 1.0
    return np.concatenate([box_corners(k), spread]) if k <= CORNERS else spread


def worst_points(
    observer: Observer, limit: Limit, y: Float[np.ndarray, " p"], starts: Float[np.ndarray, "starts k"]
) -> tuple[Float[np.ndarray, "n k"], Float[np.ndarray, " n"]]:
    """The distinct local maxima of a normalised limit over the box or zones of the tolerances at y, the worst first."""

    variables = observer.request.variables

    def function(z: Float[np.ndarray, "n k"]) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n k"]]:
        seen = observer.observe(y, z)
        slopes = variables.by_errors(y, seen.jacobian)[:, limit.position] * (limit.sign / limit.scale)
        return limit.normalise(seen.values[:, limit.position]), slopes

    within = projection(variables.sizes.region)
    search = climb_together(function, within, starts, evaluations=SEARCH_STEPS, tolerance=STATIONARY)
    points, heights = np.asarray(search.point), np.asarray(search.value)
    kept = distinct(points, heights, NEW_POINT)
    return points[kept], heights[kept]


def _constrained(
    value: Float[np.ndarray, " c"], derivative: Float[np.ndarray, "c p"], limits: Sequence[int]
) -> Constrained:
    """Constraints, those of failed samples far from holding."""
    good = np.isfinite(value) & np.isfinite(derivative).all(axis=1)
    return Constrained(np.where(good, value, FAILED), np.where(good[:, None], derivative, 0.0), tuple(limits))


def _failed(count: int, variables: int, limits: Sequence[int]) -> Constrained:
    return Constrained(np.full(count, FAILED), np.zeros((count, variables)), tuple(limits))


CRITERIA: dict[str, Callable[[Observer, RandomKey, ErrorSample], Criterion]] = {
    "nominal": lambda observer, key, sample: NominalCriterion(observer),
    "worst_case": lambda observer, key, sample: WorstCaseCriterion(observer),
    "rss": SampleCriterion,
    "yield": SampleCriterion,
}
