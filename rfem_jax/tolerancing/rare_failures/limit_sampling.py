"""Samples of all limits, and how far what they say of each limit can be trusted.

Place in the pipeline: design_points, subset, importance -> **limit_sampling** -> failure_study.

Importance sampling is right on the average, whatever its components are; a set of samples that misses a part of what
fails says too little nearly always, with a narrow interval. An answer therefore counts only if

    many samples make it      n_eff = (sum t)^2/sum t^2 >= `FEWEST`, and no sample is more than `LARGEST` of it
    nothing new is found      the last searches of design points ended where the samples are
    another method agrees     its ratio to the probability by subset simulation is within what both scatter

Where this does not hold, the samples that failed, by their weights, give new components and new starts of searches, and
new samples are drawn, up to `ROUNDS` times. What does not hold then either is not told as an answer: the interval spans
those of both methods, and the limit is "uncertain".

Symbols: t = 1[fails] n/q; w (n, k) samples.
Source: theory (10.26); O. Cappe et al., Stat. Comput. 18 (2008) 447-459 (components by weighted samples).
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from rfem_jax.tolerancing.rare_failures.design_points import LimitState
from rfem_jax.tolerancing.rare_failures.importance import (
    Mixture,
    Weighing,
    estimate_probability,
    weigh,
)
from rfem_jax.tolerancing.rare_failures.subset import SubsetRun
from rfem_jax.tolerancing.sampling.statistics import Estimate

ROUNDS = 3
FEWEST = 50.0  # failing samples of equal weight, or a tenth of all
LARGEST = 0.1  # part of the probability that one sample may have
APART = 3.3  # standard deviations of the logarithm that two methods may be apart
RESAMPLED = 400  # failing samples from which new components are made


@dataclass(frozen=True, eq=False)
class Samples:
    """Samples w (n, k) of a mixture, their weights (n,), and which of them break each limit (limits, n)."""

    mixture: Mixture
    w: Float[np.ndarray, "n k"]
    weights: Float[np.ndarray, " n"]
    broken: Bool[np.ndarray, "limits n"]
    failed: int
    """Simulations that failed."""

    def resampled(self, limit: int, generator: np.random.Generator) -> Float[np.ndarray, "n k"]:
        """Samples (n, k) that break a limit, as often as their weights say; equal ones follow each other."""
        rows = generator.permutation(np.flatnonzero(self.broken[limit]))
        if not len(rows):
            return self.w[:0]
        ends = np.cumsum(self.weights[rows])
        places = (np.arange(RESAMPLED) + generator.uniform()) / RESAMPLED * ends[-1]
        return self.w[rows[np.minimum(np.searchsorted(ends, places), len(rows) - 1)]]


@dataclass(frozen=True)
class Finding:
    """The probability of one limit, or of any (then without a check).

    status: "ok", "not_reached" or "uncertain", with the reason in words; method: "importance_sampling" or, where that
    cannot be trusted, "subset_simulation"; check: the probability by subset simulation.
    """

    status: str
    probability: Estimate
    method: str
    weighing: Weighing
    check: Estimate
    reason: str = ""


def draw_samples(
    mixture: Mixture,
    states: Sequence[LimitState],
    values_of: Callable[[Float[np.ndarray, "n k"]], Float[np.ndarray, "n m"]],
    generator: np.random.Generator,
    k: int,
) -> Samples:
    """Samples of a mixture with the limits that they break; a simulation that failed breaks all."""
    w = mixture.samples(generator, k)
    values = values_of(w)
    missing = ~np.all(np.isfinite(values), axis=1)
    broken = np.stack([(state.of(values) < 0.0) | missing for state in states])
    return Samples(mixture, w, mixture.weights(w), broken, int(np.sum(missing)))


def find_probability(
    samples: Samples, limit: int, subset: SubsetRun, points: int, new: float, confidence: float
) -> Finding:
    """What samples say of a limit, judged. Args: points, number of its design points; new, share of the last
    searches that found further ones."""
    fails, check = samples.broken[limit], subset.estimate(confidence)
    weighing = weigh(samples.weights, fails)
    found = estimate_probability(samples.mixture, samples.weights, fails, confidence)
    if not (points or subset.reached or np.any(fails)):
        return Finding("not_reached", found, "importance_sampling", weighing, check)
    reason = _doubt(found, weighing, subset, new, len(samples.w), samples.mixture.plain)
    if not reason:
        return Finding("ok", found, "importance_sampling", weighing, check)
    low, high = min(found.low, check.low), max(found.high, check.high)
    if not subset.reached:
        return Finding("uncertain", Estimate(found.value, low, high), "importance_sampling", weighing, check, reason)
    return Finding("uncertain", Estimate(check.value, low, high), "subset_simulation", weighing, check, reason)


def _doubt(found: Estimate, weighing: Weighing, subset: SubsetRun, new: float, samples: int, plain: bool) -> str:
    """Why an estimate cannot be trusted, in words; empty where it can. Plain Monte Carlo (`plain`) is not judged by
    its weights, which are equal."""
    if not plain and weighing.effective < min(FEWEST, 0.1 * samples):
        return f"only {weighing.effective:.3g} of the samples that break it count"
    if not plain and weighing.largest > LARGEST:
        return f"one sample is {100.0 * weighing.largest:.2g} % of its probability"
    if not plain and new > 0.0:
        return f"{100.0 * new:.2g} % of the last searches found further ways to break it"
    if not subset.reached:
        return "" if found.low <= 10.0 * subset.bound else "subset simulation did not reach it"
    spread = math.sqrt(math.log1p(subset.variation**2) + 1.0 / max(weighing.effective, 1.0))
    if found.value <= 0.0 or abs(math.log(found.value / subset.probability)) > APART * spread:
        return f"subset simulation has {subset.probability:.2g} and importance sampling {found.value:.2g}"
    return ""


def find_any(samples: Samples, findings: Sequence[Finding], confidence: float) -> Estimate:
    """The probability that at least one limit is broken; where one of them is uncertain, between their bounds."""
    found = estimate_probability(samples.mixture, samples.weights, np.any(samples.broken, axis=0), confidence)
    if all(one.status != "uncertain" for one in findings):
        return found
    parts = [one.probability for one in findings]
    value, low = max(found.value, *(one.value for one in parts)), max(one.low for one in parts)
    return Estimate(value, min(low, found.low), min(max(found.high, sum(one.high for one in parts)), 1.0))
