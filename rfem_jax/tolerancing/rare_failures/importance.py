"""Importance sampling about design points: probabilities of rare failures, with confidence intervals.

Place in the pipeline: design_points -> **importance** -> failure_study.

    q(w) = sum_j a_j n(w - w_j),   w_0 = 0,       p = E_q[1[fails] n(w)/q(w)]

One set of samples serves all limits, alone and together. The component about w = 0, a tenth of the samples, bounds
every weight n/q by 10 (defensive mixture), so that a failure which no design point has shown is not lost. Components
have fixed numbers of samples (strata), and the error of p is the root of the sum of their variances.

Symbols: w (n, k) samples in standard normal coordinates, n(w) standard normal density, a_j shares of the components,
p probability.
Source: theory (10.23), (10.24); M. Shinozuka, J. Struct. Eng. 109 (1983) 721-740 (sampling about design points);
T. Hesterberg, Technometrics 37 (1995) 185-194 (defensive mixtures).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import stats
from scipy.special import logsumexp

from rfem_jax.tolerancing.sampling.statistics import Estimate

DEFENSIVE = 0.1  # share of the samples about w = 0
LEAST = 0.05  # share of a limit's samples that each of its design points has at least


@dataclass(frozen=True, eq=False)
class Mixture:
    """Centres (c, k) of the components, w = 0 first, and their numbers of samples (c,)."""

    centres: Float[np.ndarray, "c k"]
    counts: Int[np.ndarray, " c"]

    @property
    def component(self) -> Int[np.ndarray, " n"]:
        """Component that each sample belongs to."""
        return np.repeat(np.arange(len(self.counts)), self.counts)

    def samples(self, generator: np.random.Generator) -> Float[np.ndarray, "n k"]:
        """Samples (n, k), component after component."""
        normal = generator.standard_normal((int(self.counts.sum()), self.centres.shape[1]))
        return self.centres[self.component] + normal

    def weights(self, w: Float[np.ndarray, "n k"]) -> Float[np.ndarray, " n"]:
        """Weights n(w)/q(w) of points w (n, k)."""
        exponents = w @ self.centres.T - 0.5 * np.sum(self.centres**2, axis=1)
        shares = self.counts / self.counts.sum()
        return np.exp(-np.asarray(logsumexp(exponents, axis=1, b=shares)))


def mixture_of(points: Sequence[Float[np.ndarray, "p k"]], n: int, k: int) -> Mixture:
    """The mixture about the design points of all limits, each limit with the same number of samples.

    Args: points, of each limit (p, k), possibly none; n samples, at least 10; k coordinates. Within a limit a point has
        samples by its probability N(-|w|), but not less than a share `LEAST`.
    """
    groups = [group for group in points if len(group)]
    if not groups:
        return Mixture(np.zeros((1, k)), np.array([n]))
    shares = [np.array([DEFENSIVE])]
    for group in groups:
        logarithms = stats.norm.logsf(np.linalg.norm(group, axis=1))
        part = np.maximum(np.exp(logarithms - np.max(logarithms)), LEAST)
        shares.append((1.0 - DEFENSIVE) / len(groups) * part / part.sum())
    counts = np.maximum(np.floor(n * np.concatenate(shares)), 2).astype(int)
    counts[1] += max(n - int(counts.sum()), 0)
    return Mixture(np.concatenate([np.zeros((1, k)), *groups]), counts)


def estimate_probability(
    mixture: Mixture, weights: Float[np.ndarray, " n"], fails: Bool[np.ndarray, " n"], confidence: float = 0.95
) -> Estimate:
    """Probability of failure and its interval.

    Args: weights (n,) and fails (n,) of the mixture's samples. Without design points the interval is that of Clopper
        and Pearson, and where no sample failed its upper end is that of the samples about w = 0 alone.
    """
    plain = int(mixture.counts[0])
    if len(mixture.counts) == 1 or not np.any(fails):
        failed = int(np.sum(fails[:plain]))
        tail = 0.5 * (1.0 - confidence)
        low = 0.0 if failed == 0 else float(stats.beta.ppf(tail, failed, plain - failed + 1))
        high = 1.0 if failed == plain else float(stats.beta.ppf(1.0 - tail, failed + 1, plain - failed))
        return Estimate(failed / plain, low, high)
    terms = np.where(fails, weights, 0.0)
    parts = np.split(terms, np.cumsum(mixture.counts)[:-1])
    shares = mixture.counts / mixture.counts.sum()
    value = float(np.mean(terms))
    variance = sum(share**2 * np.var(part, ddof=1) / len(part) for share, part in zip(shares, parts, strict=True))
    half = float(stats.norm.ppf(0.5 + 0.5 * confidence)) * math.sqrt(variance)
    return Estimate(value, max(value - half, 0.0), min(value + half, 1.0))
