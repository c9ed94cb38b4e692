"""How sure an estimate is: the normal approximation at every mode of the posterior, checked by samples of it.

Place in the pipeline: ends of searches -> **posterior** -> conclusion.

    covariance = H^-1 at a mode (Laplace);   P(mode) ~ exp(-Phi/2) |H|^(-1/2)                       (17.7)
    w_j ~ exp(-Phi(theta_j)/2) / q(theta_j),   effective number = (sum w)^2 / sum w^2               (17.8)

q is the mixture over the modes of Student's t with `TAILS` degrees of freedom, whose tails are wider than a normal
posterior's, so that no weight is large without being seen.

Symbols: p parameters of which the first k are the unknowns, N samples; theta (p,), cost Phi.
Source: A. O'Hagan, J. Forster, Bayesian Inference, 2nd ed. (2004), 8; A. Kong, A note on importance sampling using
standardized weights, Tech. Rep. 348, Univ. of Chicago (1992).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from scipy.special import gammaln, logsumexp
from scipy.stats import chi2, norm

from rfem_jax.tolerancing.identification.levenberg_marquardt import Searches
from rfem_jax.tolerancing.identification.residuals import Misfit, Residuals, efficiency
from rfem_jax.tolerancing.sampling.sequences import RandomKey, unit_points

TAILS = 5.0
APART = 1.0  # standard deviations from which two ends of searches are two modes
IMPROBABLE = 1e-3  # of a mode beside the best one
FEW = 30.0  # effective samples below which nothing is said
LEAST_EFFECTIVE = 0.2  # part of the samples
DEPARTURE = 0.3  # of means in standard deviations, and of logarithms of standard deviations

Costs = Callable[[Float[np.ndarray, "n p"]], Float[np.ndarray, " n"]]


@dataclass(eq=False)
class Mode:
    """A mode: theta (p,), its cost, H^-1 (p, p), which search ended there, and its probability."""

    theta: Float[np.ndarray, " p"]
    cost: float
    covariance: Float[np.ndarray, "p p"]
    search: int
    probability: float = 1.0


class Sampled(NamedTuple):
    """theta (N, p) and normalised weights (N,), their effective number, and the mode (N,) next to each."""

    theta: Float[np.ndarray, "N p"]
    weights: Float[np.ndarray, " N"]
    effective: float
    nearest: Int[np.ndarray, " N"]

    def moments(self, mode: int) -> tuple[Float[np.ndarray, " p"], Float[np.ndarray, " p"]]:
        """Means and standard deviations of the samples next to a mode."""
        w = np.where(self.nearest == mode, self.weights, 0.0)
        w = w / max(w.sum(), 1e-300)
        mean = w @ self.theta
        return mean, np.sqrt(w @ (self.theta - mean) ** 2)

    def quantiles(self, values: Float[np.ndarray, " N"], mode: int, at: Sequence[float]) -> list[float]:
        """Quantiles of a number of each sample, of the samples next to a mode."""
        w = np.where(self.nearest == mode, self.weights, 0.0)
        order = np.argsort(values)
        reached = np.cumsum(w[order]) - 0.5 * w[order]
        return [float(np.interp(one * w.sum(), reached, values[order])) for one in at]


def information(residuals: Residuals, misfit: Misfit, w: int) -> Float[np.ndarray, "p p"]:
    """H (p, p) of guess w, for a robust loss with its efficiency."""
    if residuals.loss == "gaussian":
        return misfit.curvature[w]
    of_data = misfit.jacobian[w].T @ misfit.jacobian[w]
    return of_data / efficiency(residuals.loss, misfit.residual[w]) + np.diag(residuals.weights)


def invert(h: Float[np.ndarray, "p p"]) -> Float[np.ndarray, "p p"] | None:
    """H^-1, or None where it says nothing about some combination."""
    scale = np.sqrt(np.maximum(np.diag(h), 1e-300))
    values, vectors = np.linalg.eigh(h / np.outer(scale, scale))
    if not np.isfinite(values).all() or values[0] < 1e-10:
        return None
    return (vectors / values) @ vectors.T / np.outer(scale, scale)


def find_modes(residuals: Residuals, searches: Searches) -> list[Mode]:
    """The different ends of the searches that converged, best first; none where the best has no covariance."""
    cost = np.where(searches.converged, searches.misfit.cost, np.inf)
    modes: list[Mode] = []
    for w in map(int, np.argsort(cost, kind="stable")):
        if not np.isfinite(cost[w]):
            break
        h = information(residuals, searches.misfit, w)
        covariance = invert(h)
        if covariance is None:
            return modes
        away = [searches.theta[w] - one.theta for one in modes]
        if all(d @ h @ d > APART**2 for d in away):
            modes.append(Mode(searches.theta[w], float(cost[w]), covariance, w))
    return weighed(modes)


def weighed(modes: list[Mode]) -> list[Mode]:
    """The modes with their probabilities by Laplace, without improbable ones."""
    if not modes:
        return modes
    logs = np.array([-0.5 * one.cost + 0.5 * np.linalg.slogdet(one.covariance)[1] for one in modes])
    parts = np.exp(logs - logsumexp(logs))
    kept = [(one, part) for one, part in zip(modes, parts, strict=True) if part > IMPROBABLE * parts.max()]
    total = sum(part for _, part in kept)
    for one, part in kept:
        one.probability = float(part / total)
    return [one for one, _ in kept]


def without_saddles(modes: list[Mode], costs: Costs, k: int) -> list[Mode]:
    """The modes without points between two of them, at which derivatives vanish, too, as by symmetry at zero errors:
    one standard deviation along every principal direction the cost must not fall on average (theory (17.10))."""
    if len(modes) < 2:
        return modes
    points = []
    for one in modes:
        _, vectors = np.linalg.eigh(one.covariance[:k, :k])
        along = one.covariance[:, :k] @ vectors
        along = along / np.sqrt(np.sum(vectors * along[:k], axis=0))
        points.append(np.concatenate([one.theta + along.T, one.theta - along.T]))
    rises = costs(np.concatenate(points)).reshape(len(modes), 2, k).mean(axis=1)
    kept = [one for one, rise in zip(modes, rises, strict=True) if not np.any(rise < one.cost)]
    return weighed(kept) or modes[:1]


def draw(modes: list[Mode], costs: Costs, low: np.ndarray, high: np.ndarray, key: RandomKey, n: int) -> Sampled:
    """N weighed samples of the posterior; a sample beyond bounds, or whose run fails, weighs nothing."""
    p = len(modes[0].theta)
    points = unit_points(key, n, p + 2, "sobol")
    ends = np.cumsum([one.probability for one in modes])
    chosen = np.minimum(np.searchsorted(ends, points[:, p]), len(modes) - 1)
    normal = norm.ppf(points[:, :p]) * np.sqrt(TAILS / chi2.ppf(points[:, p + 1], TAILS))[:, None]
    roots = [np.linalg.cholesky(one.covariance) for one in modes]
    theta = np.stack([modes[m].theta + roots[m] @ z for m, z in zip(chosen, normal, strict=True)])
    distance, log_q = np.empty((len(modes), n)), np.empty((len(modes), n))
    constant = float(gammaln(0.5 * (TAILS + p)) - gammaln(0.5 * TAILS) - 0.5 * p * np.log(TAILS * np.pi))
    for m, (one, root) in enumerate(zip(modes, roots, strict=True)):
        distance[m] = np.sum(np.linalg.solve(root, (theta - one.theta).T) ** 2, axis=0)
        spread = constant - float(np.log(np.diag(root)).sum()) - 0.5 * (TAILS + p) * np.log1p(distance[m] / TAILS)
        log_q[m] = np.log(one.probability) + spread
    inside = np.all((theta >= low) & (theta <= high), axis=1)
    cost = costs(np.clip(theta, low, high))
    with np.errstate(invalid="ignore"):
        logs = np.where(inside, -0.5 * cost - np.logaddexp.reduce(log_q, axis=0), -np.inf)
    if not np.isfinite(logs).any():
        return Sampled(theta, np.zeros(n), 0.0, np.argmin(distance, axis=0))
    weights = np.exp(logs - logsumexp(logs))
    return Sampled(theta, weights, float(1.0 / np.sum(weights**2)), np.argmin(distance, axis=0))


def departure(modes: list[Mode], drawn: Sampled, k: int) -> float:
    """How far the samples next to the best mode are from its normal approximation: the largest shift of a mean in
    standard deviations, or logarithm of a ratio of standard deviations."""
    mean, deviation = drawn.moments(0)
    expected = np.sqrt(np.diag(modes[0].covariance))
    with np.errstate(divide="ignore"):
        parts = np.abs(mean - modes[0].theta) / expected, np.abs(np.log(deviation / expected))
    return float(np.max([one[:k].max() for one in parts]))
