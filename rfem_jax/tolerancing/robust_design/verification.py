"""A fresh run at the answer of an optimisation, which did not serve to find it.

Place in the pipeline: criteria, search -> **verification** -> optimisation.

Values come from the program without derivatives.  nominal: the perfect mechanism; worst_case: searches from new
starting points, and all corners of the box where they are few; rss and yield: an independent Monte Carlo run.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import numpy as np
from jaxtyping import Float

from rfem_jax.tolerancing.optimisation.starting_points import box_corners
from rfem_jax.tolerancing.problems.distributions import Tolerance
from rfem_jax.tolerancing.robust_design.criteria import (
    NormalisedLimit,
    search_starts,
    worst_points,
)
from rfem_jax.tolerancing.robust_design.observations import Observer
from rfem_jax.tolerancing.sampling.sequences import RandomKey
from rfem_jax.tolerancing.sampling.statistics import estimate_mean, estimate_std, estimate_yield

ALL_CORNERS = 8  # errors, of which all corners of the box are tried


class Verified(NamedTuple):
    """Normalised limits (l,) of a fresh run, between low and high (l,) with 95 % confidence; fraction of samples
    within all limits with its interval (NaN but for samples); failed samples; what the run was, in words."""

    h: Float[np.ndarray, " l"]
    low: Float[np.ndarray, " l"]
    high: Float[np.ndarray, " l"]
    fraction: float
    interval: tuple[float, float]
    failed: int
    what: str


def verify_nominal(observer: Observer, limits: Sequence[NormalisedLimit], y: Float[np.ndarray, " p"]) -> Verified:
    """The perfect mechanism."""
    values = observer.values(y, np.zeros((1, len(observer.variables.errors))))
    return _exact(np.array([limit.normalise(values[0]) for limit in limits]), values, "a run of the perfect mechanism")


def verify_worst_case(
    observer: Observer, limits: Sequence[NormalisedLimit], y: Float[np.ndarray, " p"], key: RandomKey
) -> Verified:
    """Searches from new starting points, and corners of the box."""
    sizes = observer.variables.sizes
    k, starts = len(sizes.errors), search_starts(sizes, key)
    points = np.concatenate([worst_points(observer, limit, y, starts)[0][:2] for limit in limits])
    what = "searches for the worst case from new starting points"
    if k <= ALL_CORNERS and sizes.region == "box":
        points, what = np.concatenate([points, box_corners(k)]), f"{what} and at all {2**k} corners"
    values = observer.values(y, np.concatenate([np.zeros((1, k)), points]))
    h = np.array([np.nanmax(limit.normalise(values)) for limit in limits])
    return _exact(h, values, what)


def verify_sample(
    observer: Observer,
    limits: Sequence[NormalisedLimit],
    y: Float[np.ndarray, " p"],
    key: RandomKey,
    distribution: Callable[[float], Tolerance],
    samples: int,
    coverage: float,
) -> Verified:
    """An independent Monte Carlo run: mean + `coverage` deviations of every limit, and the yield."""
    units = np.asarray(jax.random.uniform(key, (samples, len(observer.variables.errors)), minval=1e-12))
    values = observer.values(y, observer.variables.sizes.standard(distribution(1.0), units))
    h = np.stack([limit.normalise(values) for limit in limits], axis=1)
    good = np.isfinite(h).all(axis=1)
    fraction = estimate_yield(np.all(np.where(np.isfinite(h), h, np.inf) <= 0.0, axis=1))
    what = f"an independent Monte Carlo run of {samples} samples"
    interval = (float(fraction.low), float(fraction.high))
    failed = int(np.sum(~good))
    if good.sum() < 2:
        none = np.full(len(limits), np.inf)
        return Verified(none, none, none, float(fraction.value), interval, failed, what)
    ends = [(estimate_mean(column), estimate_std(column)) for column in h[good].T]
    found, low, high = (
        np.array([getattr(mean, end) + coverage * getattr(spread, end) for mean, spread in ends])
        for end in ("value", "low", "high")
    )
    return Verified(found, low, high, float(fraction.value), interval, failed, what)


def _exact(h: Float[np.ndarray, " l"], values: Float[np.ndarray, "n m"], what: str) -> Verified:
    """A run without an interval; limits that have no value do not hold."""
    h = np.where(np.isfinite(h), h, np.inf)
    return Verified(h, h, h, np.nan, (np.nan, np.nan), int(np.sum(~np.isfinite(values).all(axis=1))), what)
