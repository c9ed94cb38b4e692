"""A fresh run at an answer, which did not serve to find it, and what it says of the limits.

Place in the pipeline: observations -> **verification** -> criteria, which say how they are verified. Values come from
the program without derivatives.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from rfem_jax.tolerancing.optimisation.sizes import Sizes
from rfem_jax.tolerancing.optimisation.starting_points import sobol_units
from rfem_jax.tolerancing.problems.distributions import Tolerance
from rfem_jax.tolerancing.robust_design.observations import Observer
from rfem_jax.tolerancing.robust_design.request import Limit
from rfem_jax.tolerancing.robust_design.result import LimitCheck
from rfem_jax.tolerancing.sampling.sequences import RandomKey
from rfem_jax.tolerancing.sampling.statistics import estimate_mean, estimate_std, estimate_yield

Statistic = Callable[[Float[np.ndarray, " n"]], tuple[float, float, float]]


class Verified(NamedTuple):
    """Normalised limits (l,) of a fresh run, between low and high (l,) with 95 % confidence; fraction of samples
    within all limits with its interval (NaN but for samples); failed samples; what the run was, in words; the worst
    cases (`WorstCase`) of an allocation."""

    h: Float[np.ndarray, " l"]
    low: Float[np.ndarray, " l"]
    high: Float[np.ndarray, " l"]
    fraction: float
    interval: tuple[float, float]
    failed: int
    what: str
    worst: tuple[Any, ...] = ()


def without_interval(h: Float[np.ndarray, " l"], values: Float[np.ndarray, "n m"], what: str) -> Verified:
    """A run without an interval; limits that have no value do not hold."""
    h = np.where(np.isfinite(h), h, np.inf)
    return Verified(h, h, h, np.nan, (np.nan, np.nan), int(np.sum(~np.isfinite(values).all(axis=1))), what)


@dataclass(frozen=True)
class ErrorSample:
    """The samples of errors with which limits hold by root sum of squares, or at a yield.

    kind "rss" or "yield"; level, the fraction of a yield; coverage, number of deviations of "rss"; distribution, a
    callable half-width -> Tolerance; samples, the number of standard points; verify_samples of a fresh run.
    """

    kind: str
    level: float
    coverage: float
    distribution: Callable[[float], Tolerance]
    samples: int
    verify_samples: int

    @property
    def joint(self) -> bool:
        """Whether one constraint counts all limits."""
        return self.kind == "yield"

    @property
    def of_width_one(self) -> Tolerance:
        """The distribution of half-width 1."""
        return self.distribution(1.0)

    def points(self, sizes: Sizes, key: RandomKey) -> Float[np.ndarray, "n k"]:
        """Standard points."""
        return sizes.standard(self.of_width_one, sobol_units(len(sizes.errors), self.samples, key))

    def verify(
        self,
        observer: Observer,
        deviations: Callable[[Float[np.ndarray, "n k"]], Float[np.ndarray, "n names"]],
        key: RandomKey,
        statistic: Statistic,
    ) -> Verified:
        """An independent Monte Carlo run: a statistic of every limit, and the yield.

        Args: deviations, of standard points at the answer; statistic, h (n,) of a limit, NaN where a sample failed ->
            value, low and high end.
        """
        sizes, count = observer.request.variables.sizes, self.verify_samples
        units = np.asarray(jax.random.uniform(key, (count, len(sizes.errors)), minval=1e-12))
        h, failed = sampled_limits(observer, deviations(sizes.standard(self.of_width_one, units)))
        value, low, high = np.array([statistic(column) for column in h.T]).T
        fraction = estimate_yield(within(h))
        interval, what = (fraction.low, fraction.high), f"an independent Monte Carlo run of {count} samples"
        return Verified(value, low, high, fraction.value, interval, failed, what)


def sampled_limits(observer: Observer, points: Float[np.ndarray, "n names"]) -> tuple[Float[np.ndarray, "n l"], int]:
    """Normalised limits at deviations, NaN for failed samples, and the number of these."""
    h = observer.request.normalise(observer.values(points))
    failed = ~np.all(np.isfinite(h), axis=1)
    return np.where(failed[:, None], np.nan, h), int(failed.sum())


def within(h: Float[np.ndarray, "n l"]) -> np.ndarray:
    """Which samples keep all limits; failed ones do not."""
    return np.all(np.where(np.isfinite(h), h, np.inf) <= 0.0, axis=1)


def mean_and_deviations(coverage: float) -> Statistic:
    """Mean + `coverage` standard deviations of the samples that did not fail, each with its interval."""

    def statistic(h: Float[np.ndarray, " n"]) -> tuple[float, float, float]:
        good = h[np.isfinite(h)]
        if len(good) < 2:
            return np.inf, np.inf, np.inf
        mean, spread = estimate_mean(good), estimate_std(good)
        value, low, high = (getattr(mean, one) + coverage * getattr(spread, one) for one in ("value", "low", "high"))
        return value, low, high

    return statistic


def check_limits(
    limits: Sequence[Limit],
    nominal: Mapping[str, float],
    predicted: Float[np.ndarray, " l"],
    verified: Verified,
    prices: Float[np.ndarray, " l"],
    quadratic: Float[np.ndarray, " l"] | None = None,
) -> tuple[LimitCheck, ...]:
    """The limits at the answer.

    Args: nominal {metric: value}; predicted, quadratic (l,) normalised limits by the criterion and by the quadratic
        model; prices (l,), d(cost)/d(normalised limit).
    """
    checks = []
    for i, limit in enumerate(limits):
        low, high = sorted(float(limit.restore(end[i])) for end in (verified.low, verified.high))
        checks.append(
            LimitCheck(
                metric=limit.metric,
                unit=limit.unit,
                side="upper" if limit.sign > 0 else "lower",
                limit=limit.bound,
                nominal=nominal[limit.metric],
                quadratic=np.nan if quadratic is None else float(limit.restore(quadratic[i])),
                predicted=float(limit.restore(predicted[i])),
                verified=float(limit.restore(verified.h[i])),
                verified_interval=(low, high),
                shadow_price=float(-limit.sign * prices[i] / limit.scale),
            )
        )
    return tuple(checks)
