"""Importance sampling where limits are broken: probabilities of rare failures, with confidence intervals.

Place in the pipeline: design_points, subset -> **importance** -> failure_study.

    q(w) = sum_j a_j q_j(w),       p = E_q[1[fails] n(w)/q(w)]

    Normal  q_j = n(w - c_j)               about a design point, about the mean of samples that fail, about w = 0
    Shell   q_j = n(w)/P(|B^T w| > r)      where |B^T w| > r: beyond a sphere (a cylinder, two planes)

A design point stands for a limit that is nearly a plane. A sum of k squares has a sphere of them, and n(w - w_j) about
some of them never sees the others; the shell, whose space B and radius r are those in which the samples of the subset
simulation lie farthest out, has weights that are nearly equal then.

One set of samples serves all limits, alone and together. The component about w = 0, a tenth of the samples, bounds
every weight n/q by 10 (defensive mixture), so that a failure which nothing has shown is not lost. Components have
fixed numbers of samples (strata), and the error of p is the root of the sum of their variances. Few samples of unequal
weights have a skew distribution: the interval is that of a gamma distribution of this mean and variance, at its upper
end with one more sample of the largest weight.

Symbols: w (n, k) samples in standard normal coordinates, n(w) standard normal density, a_j shares of the components,
t = 1[fails] n/q, p probability.
Source: theory (10.23), (10.24); M. Shinozuka, J. Struct. Eng. 109 (1983) 721-740 (sampling about design points);
A. Harbitz, Structural Safety 3 (1986) 109-115 (beyond a sphere); C. G. Bucher, Structural Safety 5 (1988) 119-126
(about the mean); T. Hesterberg, Technometrics 37 (1995) 185-194 (defensive mixtures); M. P. Fay, E. J. Feuer, Stat. in
Medicine 16 (1997) 791-801 (interval).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import stats
from scipy.cluster.vq import kmeans2
from scipy.special import logsumexp

from rfem_jax.tolerancing.sampling.statistics import Estimate

DEFENSIVE = 0.1  # share of the samples about w = 0
LEAST = 0.05  # share of the samples about design points that each of them has at least
FEWEST = 20  # failing samples from which components are made
INSIDE = 0.02  # share of the failing samples that may lie inside of a shell
CLUSTERS = 4  # of failing samples, that have a component each
SLACK = 0.999  # radius of a shell by that of the nearest design point


@dataclass(frozen=True, eq=False)
class Normal:
    """n(w - centre), centre (k,)."""

    centre: Float[np.ndarray, " k"]

    def log_ratio(self, w: Float[np.ndarray, "n k"]) -> Float[np.ndarray, " n"]:
        """log(q_j/n) (n,) of points w (n, k)."""
        return w @ self.centre - 0.5 * self.centre @ self.centre

    def place(self, normal: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "n k"]:
        """Samples (n, k), of standard normal ones."""
        return normal + self.centre


@dataclass(frozen=True, eq=False)
class Shell:
    """The standard normal density where |basis^T w| > radius, basis (k, d) of orthonormal columns."""

    basis: Float[np.ndarray, "k d"]
    radius: float

    @cached_property
    def log_probability(self) -> float:
        """log P(|basis^T w| > radius)."""
        return float(stats.chi2.logsf(self.radius**2, self.basis.shape[1]))

    def log_ratio(self, w: Float[np.ndarray, "n k"]) -> Float[np.ndarray, " n"]:
        """log(q_j/n) (n,) of points w (n, k)."""
        return np.where(np.sum((w @ self.basis) ** 2, axis=1) > self.radius**2, -self.log_probability, -np.inf)

    def place(self, normal: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "n k"]:
        """Samples (n, k), of standard normal ones: |basis^T w| at the same level among those beyond the radius."""
        inside = normal @ self.basis
        length = np.linalg.norm(inside, axis=1)
        d = self.basis.shape[1]
        level = stats.chi2.sf(length**2, d) * math.exp(self.log_probability)
        factor = np.sqrt(stats.chi2.isf(level, d)) / length
        return normal + (inside * (factor - 1.0)[:, None]) @ self.basis.T


@dataclass(frozen=True, eq=False)
class Stretched:
    """The normal density about w = 0 with standard deviations `widths` (k,), at least 1, along `axes` (k, k)."""

    axes: Float[np.ndarray, "k k"]
    widths: Float[np.ndarray, " k"]

    def log_ratio(self, w: Float[np.ndarray, "n k"]) -> Float[np.ndarray, " n"]:
        """log(q_j/n) (n,) of points w (n, k)."""
        return 0.5 * (w @ self.axes) ** 2 @ (1.0 - self.widths**-2) - float(np.sum(np.log(self.widths)))

    def place(self, normal: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "n k"]:
        """Samples (n, k), of standard normal ones."""
        return (normal * self.widths) @ self.axes.T


Component = Normal | Shell | Stretched
Weighted = tuple[Component, float]  # with its share within a limit


@dataclass(frozen=True, eq=False)
class Mixture:
    """Components, that about w = 0 first, and their numbers of samples (c,)."""

    components: tuple[Component, ...]
    counts: Int[np.ndarray, " c"]

    @property
    def shares(self) -> Float[np.ndarray, " c"]:
        """Share of each component."""
        return self.counts / self.counts.sum()

    @property
    def plain(self) -> bool:
        """Whether this is plain Monte Carlo."""
        return len(self.counts) == 1

    def samples(self, generator: np.random.Generator, k: int) -> Float[np.ndarray, "n k"]:
        """Samples (n, k), component after component."""
        normal = np.split(generator.standard_normal((int(self.counts.sum()), k)), np.cumsum(self.counts)[:-1])
        return np.concatenate([one.place(part) for one, part in zip(self.components, normal, strict=True)])

    def weights(self, w: Float[np.ndarray, "n k"]) -> Float[np.ndarray, " n"]:
        """Weights n(w)/q(w) of points w (n, k)."""
        ratios = np.stack([one.log_ratio(w) for one in self.components], axis=1)
        return np.exp(-np.asarray(logsumexp(ratios, axis=1, b=self.shares)))


def components_of(points: Float[np.ndarray, "p k"], failing: Float[np.ndarray, "n k"]) -> list[Weighted]:
    """Where the samples of one limit have to be, as components with their shares.

    Args: points (p, k), design points; failing (n, k), samples that break the limit, those that depend on each other
        one after the other: one half of them gives directions and centres, the other half judges.
    """
    groups: list[list[Weighted]] = []
    if len(points):
        logarithms = stats.norm.logsf(np.linalg.norm(points, axis=1))
        part = np.maximum(np.exp(logarithms - np.max(logarithms)), LEAST)
        groups.append([(Normal(point), float(one)) for point, one in zip(points, part / part.sum(), strict=True)])
    if len(failing) >= FEWEST:
        one, other = np.array_split(failing, 2)
        least, whole = _shells(points, one, other)
        clusters = [(centre, 0.1 / CLUSTERS) for centre in _clusters(one)]
        mean = Normal(np.mean(one, axis=0))
        groups.append([(whole, 0.4), (least, 0.2), (_stretched(one, other), 0.2), (mean, 0.1), *clusters])
    return [(one, share / len(groups)) for group in groups for one, share in group]


def _clusters(failing: Float[np.ndarray, "n k"]) -> list[Component]:
    """Normal densities about the means of clusters of failing samples; none of samples that are mostly the same."""
    if len(np.unique(failing, axis=0)) < FEWEST:
        return []
    generator = np.random.default_rng(0)  # of the first means: which ones hardly matters
    means, owners = kmeans2(failing, CLUSTERS, minit="++", rng=generator, missing="warn")
    return [Normal(mean) for number, mean in enumerate(means) if np.any(owners == number)]


def _shells(
    points: Float[np.ndarray, "p k"], one: Float[np.ndarray, "n k"], other: Float[np.ndarray, "n k"]
) -> tuple[Shell, Shell]:
    """The least probable shell, in directions in which failing samples are farthest out, and that in all directions.

    The directions are those of the design points, or of one half of the samples, judged by the other half: with its
    own ones, any space looks far out that is not too small for its noise. A shell holds nearly all of the samples and
    all design points.
    """
    k = one.shape[1]
    found = _nested(_axes(one), other)[: k - 1]
    if len(points):
        found += _nested(_axes(points)[:, : np.linalg.matrix_rank(points, tol=1e-2)], other, points)[-1:]
    (whole,) = _nested(np.eye(k), np.concatenate([one, other]), points)[-1:]
    least = min([*found, whole], key=lambda shell: shell.log_probability)
    return least, whole


def _axes(points: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "k k"]:
    """Orthonormal directions (columns), those in which points are farthest from w = 0 first."""
    return np.linalg.eigh(points.T @ points)[1][:, ::-1]


def _nested(axes: Float[np.ndarray, "k d"], *points: Float[np.ndarray, "n k"]) -> list[Shell]:
    """The shells of the first 1, 2, ... d axes, which hold nearly all of the first points and all others."""
    lengths = [np.sqrt(np.cumsum((one @ axes) ** 2, axis=1)) for one in points if len(one)]
    radii = np.quantile(lengths[0], INSIDE, axis=0)
    for others in lengths[1:]:
        radii = np.minimum(radii, SLACK * np.min(others, axis=0))
    return [Shell(axes[:, : d + 1], float(radius)) for d, radius in enumerate(radii)]


def _stretched(one: Float[np.ndarray, "n k"], other: Float[np.ndarray, "n k"]) -> Stretched:
    """Normal about 0, as wide as the failing samples lie; widths of one half in the directions of the other one."""
    axes = _axes(one)
    return Stretched(axes, np.sqrt(np.maximum(np.mean((other @ axes) ** 2, axis=0), 1.0)))


def mixture_of(limits: Sequence[Sequence[Weighted]], n: int, k: int) -> Mixture:
    """The mixture of the components of all limits, each limit with the same number of samples.

    Args: limits, the components of each; none of a limit about which samples about w = 0 tell most; n samples, at least
        10; k coordinates.
    """
    components: list[Component] = [Normal(np.zeros(k))]
    shares = [DEFENSIVE]
    for group in limits:
        whole = (1.0 - DEFENSIVE) / len(limits)
        total = sum(share for _, share in group)
        shares[0] += 0.0 if group else whole
        components += [one for one, _ in group]
        shares += [whole * share / total for _, share in group]
    counts = np.maximum(np.floor(n * np.array(shares)), 2).astype(int)
    counts[np.argmax(counts)] += max(n - int(counts.sum()), 0)
    return Mixture(tuple(components), counts)


@dataclass(frozen=True)
class Weighing:
    """How far an estimate by importance sampling can be trusted.

    effective: number of failing samples of equal weight that would tell as much, (sum t)^2/sum t^2; largest: part of
    the estimate that its heaviest sample has.
    """

    effective: float
    largest: float


def weigh(weights: Float[np.ndarray, " n"], fails: Bool[np.ndarray, " n"]) -> Weighing:
    """Effective number and largest part of the samples that fail (n,)."""
    terms = weights[fails]
    if not len(terms):
        return Weighing(0.0, 1.0)
    return Weighing(float(np.sum(terms) ** 2 / np.sum(terms**2)), float(np.max(terms) / np.sum(terms)))


def estimate_probability(
    mixture: Mixture, weights: Float[np.ndarray, " n"], fails: Bool[np.ndarray, " n"], confidence: float = 0.95
) -> Estimate:
    """Probability of failure and its interval.

    Args: weights (n,) and fails (n,) of the mixture's samples. Without another component than that about w = 0 the
        interval is that of Clopper and Pearson, and where no sample failed its upper end is that of the samples about
        w = 0 alone.
    """
    plain, tail = int(mixture.counts[0]), 0.5 * (1.0 - confidence)
    if mixture.plain or not np.any(fails):
        failed = int(np.sum(fails[:plain]))
        low = 0.0 if failed == 0 else float(stats.beta.ppf(tail, failed, plain - failed + 1))
        high = 1.0 if failed == plain else float(stats.beta.ppf(1.0 - tail, failed + 1, plain - failed))
        return Estimate(failed / plain, low, high)
    terms = np.where(fails, weights, 0.0)
    parts = np.split(terms, np.cumsum(mixture.counts)[:-1])
    value, shares = float(np.mean(terms)), mixture.shares
    variance = sum(share**2 * np.var(part, ddof=1) / len(part) for share, part in zip(shares, parts, strict=True))
    more = float(np.max(terms)) / len(terms)
    low, _ = _gamma_ends(value, float(variance), tail)
    _, high = _gamma_ends(value + more, float(variance) + more**2, tail)
    return Estimate(value, max(low, 0.0), min(high, 1.0))


def _gamma_ends(mean: float, variance: float, tail: float) -> tuple[float, float]:
    """Quantiles `tail` and 1 - `tail` of the gamma distribution of this mean and variance."""
    if variance <= 0.0:
        return mean, mean
    scale = variance / mean
    low, high = stats.gamma.ppf([tail, 1.0 - tail], mean / scale, scale=scale)
    return float(low), float(high)
