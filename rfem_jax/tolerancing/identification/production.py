"""The errors that production has, from several machines that were measured: means and standard deviations of the
distribution, of which the errors of each machine are a sample (empirical Bayes).

Place in the pipeline: identifications of machines -> **production** -> Production, and back to [tolerances].

    machine i:   log density of its data = eta_i x - x Lambda_i x / 2,   x ~ N(mu, T),  T = diag(sigma^2)      (17.22)
    l(sigma) = sum_i (eta_i M_i eta_i - log det(1 + T Lambda_i)) / 2 + (g A^-1 g - log det A) / 2              (17.24)

with M_i = (Lambda_i + T^-1)^-1, A = sum Lambda_i - Lambda_i M_i Lambda_i, g = sum (1 - Lambda_i M_i) eta_i, and
mu = A^-1 g.

Symbols: n machines, k errors, in standard deviations of what was known before, from its mean.
Source: theory (17.22) to (17.26); B. P. Carlin, T. A. Louis, Bayesian Methods for Data Analysis, 3rd ed. (2009), 5;
D. A. Harville, J. Am. Stat. Assoc. 72 (1977) 320-338 (restricted likelihood).
"""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.optimize import brentq, minimize
from scipy.stats import chi2
from scipy.stats import f as fisher
from scipy.stats import t as student

from rfem_jax.description.basics.errors import InputError
from rfem_jax.description.basics.precision import require_float64
from rfem_jax.description.tasks.settings import fraction
from rfem_jax.tolerancing.identification.identification_result import Identification
from rfem_jax.tolerancing.identification.production_result import Production

FEWEST = 3  # machines
MOST_LEFT_OUT = 0.1  # part of the machines without which the others may be a selection
LARGEST = 100.0  # deviation, in those known before, above which nothing bounds it
VAGUE = 0.01  # precision of a mean before the measurements: ten deviations
SUSPICIOUS = 0.05  # probability of a machine that may be unlike the others
UNLIKE = 1e-3  # probability of a machine that is as far from the others, shared among all


class Likelihoods(NamedTuple):
    """Of n machines: precision (n, k, k) Lambda and slope (n, k) eta; scale (k,) and centre (k,) [rad, m]."""

    precision: Float[np.ndarray, "n k k"]
    slope: Float[np.ndarray, "n k"]
    centre: Float[np.ndarray, " k"]
    scale: Float[np.ndarray, " k"]


class Posterior(NamedTuple):
    """For a deviation sigma (k,): the restricted likelihood; mu (k,) and A (k, k); M (n, k, k)."""

    log: Float[Array, ""]
    mean: Float[Array, " k"]
    precision: Float[Array, "k k"]
    spread: Float[Array, "n k k"]


def estimate_production(
    machines: Sequence[Identification] | Mapping[str, Identification], *, confidence: float = 0.95
) -> Production:
    """The distribution of errors that production has, from machines that were identified.

    Errors are normal and independent of each other. Machines whose identification is not `ok` are left out.

    Args:
        machines: results of `identify` with the same unknowns, in a list or by names; at least three.
        confidence: of the intervals.
    Returns: means and deviations with intervals, every machine's errors in the light of the others, and the lines of
        [tolerances] that say the same.
    Raises: InputError for too few machines, and for machines with other unknowns.
    """
    require_float64()
    level = fraction(confidence, "confidence")
    named = machines if isinstance(machines, Mapping) else {str(i): one for i, one in enumerate(machines, start=1)}
    if len(named) < FEWEST:
        raise InputError(
            f"Argument `machines` must be at least {FEWEST} identifications, but are {len(named)}; measure more "
            "machines."
        )
    first, *others = named.values()
    for one in others:
        if one.names != first.names:
            raise InputError(
                f"Argument `machines` must have the same unknowns, but one has {', '.join(one.names)}, another "
                f"{', '.join(first.names)}; identify all with the same `unknowns`."
            )
    used = {name: one for name, one in named.items() if one.status == "ok"}
    left = {name: one.status for name, one in named.items() if name not in used}
    if len(used) < FEWEST:
        return _without(first, level, left)
    known = likelihoods_of(list(used.values()))
    sigma, found = _most_probable(known)
    ends = np.array([_interval(known, sigma, j, level) for j in range(len(sigma))])
    return _conclude(first, list(used), left, known, sigma, found, ends, level)


def likelihoods_of(machines: Sequence[Identification]) -> Likelihoods:
    """What the data of each machine alone say of its errors: its posterior without its prior."""
    first = machines[0]
    centre = np.where(np.isfinite(first.prior_deviation), first.prior_mean, first.estimate)
    scale = np.where(np.isfinite(first.prior_deviation), first.prior_deviation, first.deviation)
    precisions, slopes = [], []
    for one in machines:
        mean, covariance = one.estimate, one.covariance
        if one.method == "importance":
            part = one.weights / one.weights.sum()
            mean = part @ one.sampled
        whole = np.linalg.inv(covariance / np.outer(scale, scale))
        before = one.prior_precision * np.outer(scale, scale)
        values, vectors = np.linalg.eigh(whole - before)
        precisions.append((vectors * np.maximum(values, 0.0)) @ vectors.T)
        slopes.append(whole @ ((mean - centre) / scale) - before @ ((one.prior_mean - centre) / scale))
    return Likelihoods(np.array(precisions), np.array(slopes), centre, scale)


def restricted(sigma: Float[Array, " k"], precision: Float[Array, "n k k"], slope: Float[Array, "n k"]) -> Posterior:
    """See the module; traced. Without a division by sigma, which may be 0."""
    k = len(sigma)
    t, one = jnp.diag(sigma**2), jnp.eye(k)

    def of_machine(precision, slope):
        inner = one + t @ precision
        spread = jnp.linalg.solve(inner, t)
        log = 0.5 * slope @ spread @ slope - 0.5 * jnp.linalg.slogdet(inner)[1]
        return log, precision - precision @ spread @ precision, slope - precision @ (spread @ slope), spread

    logs, parts, slopes, spreads = jax.vmap(of_machine)(precision, slope)
    total, along = parts.sum(axis=0) + VAGUE * one, slopes.sum(axis=0)
    mean = jnp.linalg.solve(total, along)
    log = logs.sum() + 0.5 * along @ mean - 0.5 * jnp.linalg.slogdet(total)[1]
    return Posterior(log, mean, total, spreads)


_restricted = jax.jit(restricted)


@jax.jit
def _cost(sigma, precision, slope):
    return jax.value_and_grad(lambda s: -restricted(s, precision, slope).log)(sigma)


def _most_probable(known: Likelihoods) -> tuple[Float[np.ndarray, " k"], Posterior]:
    """The deviations (k,) of the largest restricted likelihood, and what follows from them."""
    k = len(known.scale)
    ends = [_least(known, np.full(k, start), {}) for start in (0.1, 1.0)]
    sigma = min(ends, key=lambda one: one[1])[0]
    return sigma, _restricted(jnp.asarray(sigma), known.precision, known.slope)


def _least(
    known: Likelihoods, start: Float[np.ndarray, " k"], fixed: dict[int, float]
) -> tuple[Float[np.ndarray, " k"], float]:
    """The deviations of the largest likelihood, some of them fixed, and its negative logarithm."""
    bounds = [(fixed[j], fixed[j]) if j in fixed else (0.0, LARGEST) for j in range(len(start))]

    def function(sigma):
        value, gradient = _cost(jnp.asarray(sigma), known.precision, known.slope)
        return float(value), np.asarray(gradient)

    begin = np.array([fixed.get(j, one) for j, one in enumerate(start)])
    end = minimize(function, begin, jac=True, bounds=bounds, method="L-BFGS-B")
    return end.x, float(end.fun)


def _interval(known: Likelihoods, sigma: Float[np.ndarray, " k"], j: int, level: float) -> tuple[float, float]:
    """Ends of deviation j, at which the likelihood, the largest over all others, has fallen by half a quantile of
    chi^2; 0 and infinity where it does not fall so far."""
    least, fall = _least(known, sigma, {})[1], 0.5 * float(chi2.ppf(level, 1))

    def risen(s):
        return _least(known, np.maximum(sigma, 0.01), {j: s})[1] - least - fall

    def end_between(a, b):
        return float(np.asarray(brentq(risen, a, b, xtol=1e-4)))

    low = end_between(0.0, sigma[j]) if sigma[j] > 0.0 and risen(0.0) > 0.0 else 0.0
    beyond = max(2.0 * sigma[j], 0.05)
    while beyond < LARGEST and risen(beyond) < 0.0:
        beyond *= 2.0
    return low, end_between(sigma[j], beyond) if beyond < LARGEST else np.inf


def _conclude(
    first: Identification, used: list[str], left: dict[str, str], known: Likelihoods, sigma: Float[np.ndarray, " k"],
    found: Posterior, ends: Float[np.ndarray, "k 2"], level: float,
) -> Production:  # fmt: skip
    mean, spread, scale = np.asarray(found.mean), np.asarray(found.spread), known.scale
    of_mean = np.linalg.inv(np.asarray(found.precision))
    half = student.ppf(0.5 + 0.5 * level, len(used) - 1) * np.sqrt(np.diag(of_mean))
    residual = known.slope - known.precision @ mean
    own = mean + np.einsum("nij,nj->ni", spread, residual)
    kept = np.eye(len(mean)) - spread @ known.precision  # of the mean in a machine's errors
    variances = np.diagonal(spread + kept @ of_mean @ np.swapaxes(kept, 1, 2), axis1=1, axis2=2)
    rest = np.diagonal(spread, axis1=1, axis2=2).mean(axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        shrinkage = np.where(sigma > 0.0, rest / sigma**2, 1.0)
    chances = np.array([_chance(known, i, sigma, found) for i in range(len(used))])
    unlike = tuple(name for name, one in zip(used, chances, strict=True) if one < UNLIKE / len(used))
    status = "undetermined" if np.isinf(ends[:, 1]).any() else "unlike" if unlike else "ok"
    if status == "ok" and len(left) > MOST_LEFT_OUT * (len(used) + len(left)):
        status = "selected"
    return Production(
        names=first.names, error_units=first.error_units, mean=known.centre + scale * mean,
        mean_low=known.centre + scale * (mean - half), mean_high=known.centre + scale * (mean + half),
        deviation=scale * sigma, deviation_low=scale * ends[:, 0], deviation_high=scale * ends[:, 1],
        shrinkage=shrinkage, machines=tuple(used), errors=known.centre + scale * own,
        errors_deviation=scale * np.sqrt(variances), chances=chances, unlike=unlike, left_out=left,
        tolerances=first.tolerances, confidence=level, status=status,
    )  # fmt: skip


def _chance(known: Likelihoods, i: int, sigma: Float[np.ndarray, " k"], found: Posterior) -> float:
    """Probability that a machine is as far from the others, by what its data say: where it may be too far, these are
    estimated without it."""
    n = len(known.slope)
    together = _as_far(known, i, sigma, found, np.inf)
    if together > SUSPICIOUS or n <= FEWEST:
        return together
    kept = np.arange(n) != i  # one of whose data nothing is known tells nothing
    others = known._replace(precision=known.precision * kept[:, None, None], slope=known.slope * kept[:, None])
    return _as_far(known, i, *_most_probable(others), float(n - 2))


def _as_far(known: Likelihoods, i: int, sigma: Float[np.ndarray, " k"], found: Posterior, freedom: float) -> float:
    """Of machine i beside a mean and deviations; `freedom` of the latter, infinite where they are known."""
    precision = known.precision[i]
    of_mean = np.linalg.inv(np.asarray(found.precision)) if np.isfinite(freedom) else 0.0
    covariance = precision + precision @ (np.diag(sigma**2) + of_mean) @ precision
    values, vectors = np.linalg.eigh(covariance)
    seen = values > 1e-9 * max(float(values[-1]), 1e-300)
    residual = vectors.T @ (known.slope[i] - precision @ np.asarray(found.mean))
    squares, count = float(np.sum(residual[seen] ** 2 / values[seen])), int(seen.sum())
    return float(fisher.sf(squares / count, count, freedom)) if count else 1.0


def _without(first: Identification, level: float, left: dict[str, str]) -> Production:
    """The result where too few machines were identified."""
    nan, none = np.full(len(first.names), np.nan), np.zeros((0, len(first.names)))
    return Production(
        names=first.names, error_units=first.error_units, mean=nan, mean_low=nan, mean_high=nan, deviation=nan,
        deviation_low=nan, deviation_high=nan, shrinkage=nan, machines=(), errors=none, errors_deviation=none,
        chances=np.zeros(0), unlike=(), left_out=left, tolerances=first.tolerances, confidence=level, status="failed",
    )  # fmt: skip
