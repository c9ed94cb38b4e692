"""What each error contributes to the variance of the metrics, by the quadratic model.

Place in the pipeline: quadratic model + tolerances -> **contributions** -> sensitivities.

With errors e = mean + B y, y in independent parts y_a that look alike in all directions of the part (a single error, a
disc, a normal coordinate), of unit variance and of fourth moment mu_a (1 for a normal part), the quadratic model has
independent terms, and its variance is the sum of theirs:

    V_a  = |g_a|^2 + 1/4 (mu_a (2 tr H_aa^2 + (tr H_aa)^2) - (tr H_aa)^2)        of one part alone
    V_ab = |H_ab|^2                                                              of two together (Frobenius norm)

    linear |g_a|^2/sum |g|^2,   first-order S_a = V_a/V,   total T_a = (V_a + sum_b V_ab)/V,   V = sum V_a + sum V_ab

S and T are Sobol' indices of the model; those of the metric itself, from samples, are part of a Monte Carlo study.

Symbols: g, H gradient and Hessian by y, at the mean; factors: the independent sources of scatter, single errors or
groups (`Tolerances.factors`), each of one part or several.
Source: theory (10.29), (10.30); I. M. Sobol', Math. Comput. Simul. 55 (2001) 271-280 (indices).
"""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import ArrayLike, Float

from rfem_jax.tolerancing.problems.distributions import Tolerance
from rfem_jax.tolerancing.problems.named_tolerances import Tolerances
from rfem_jax.tolerancing.problems.quadratic_model import QuadraticModel

ROUNDING = 1e-10  # of a metric's value: what the errors together change it less is none of their effect
NO_SLOPE = 1e-6  # of the standard deviation: gradients that give less are those of an even metric, and rounding
NODES = np.linspace(-10.0, 10.0, 8001)  # of integrals over a standard normal number


@dataclass(frozen=True, eq=False)
class VarianceShares:
    """Parts of the variance of m metrics by f factors.

    factors: names of the errors of each; linear (m, f), by gradients alone, first_order (m, f) and total (m, f), NaN
    where the metric does not vary (linear: where all gradients vanish, to rounding beside the metric and its scatter;
    the last two: without second derivatives too);
    std (m,): standard deviation of the model [metric unit].
    """

    factors: tuple[tuple[str, ...], ...]
    linear: Float[np.ndarray, "m f"]
    first_order: Float[np.ndarray, "m f"]
    total: Float[np.ndarray, "m f"]
    std: Float[np.ndarray, " m"]

    def of_error(self, name: str) -> int:
        """Position of the factor that an error belongs to."""
        return next(i for i, factor in enumerate(self.factors) if name in factor)


@dataclass(frozen=True)
class _Part:
    """Columns of B that belong to one part, its factor, and its fourth moment mu."""

    columns: slice
    factor: int
    fourth: float


def variance_shares(model: QuadraticModel, tolerances: Tolerances) -> VarianceShares:
    """Contributions of all factors to the variance of every metric.

    Args: model, of all errors of the tolerances, in their order.
    """
    basis, parts = _parts(tolerances)
    gradient, hessian = np.asarray(model.gradient), model.hessian
    if hessian is not None:
        means = tolerances.means()
        away = np.array([float(means[name]) for name in model.names]) - np.asarray(model.point)
        curved = np.asarray(hessian)
        gradient = gradient + curved @ away
        curved = np.einsum("ia,mij,jb->mab", basis, curved, basis)
    else:
        curved = None
    slopes = gradient @ basis
    m, f = len(slopes), len(tolerances.factors)
    linear, alone, together = np.zeros((m, f)), np.zeros((m, f)), np.zeros((m, f))
    for part in parts:
        square = np.sum(slopes[:, part.columns] ** 2, axis=1)
        linear[:, part.factor] += square
        alone[:, part.factor] += square + (0.0 if curved is None else _curved(curved, part))
    if curved is not None:
        for i, a in enumerate(parts):
            for b in parts[:i]:
                mixed = np.sum(curved[:, a.columns, b.columns] ** 2, axis=(1, 2))
                if a.factor == b.factor:
                    alone[:, a.factor] += mixed
                else:
                    together[:, a.factor] += mixed
                    together[:, b.factor] += mixed
    variance = np.sum(alone + 0.5 * together, axis=1)
    noise = (ROUNDING * np.abs(np.asarray(model.value))) ** 2
    sloped = np.sum(linear, axis=1)
    sloped = np.where(sloped > np.maximum(noise, NO_SLOPE**2 * variance), sloped, 0.0)
    missing = np.full((m, f), np.nan)
    varies = np.where(variance > noise, variance, 0.0)
    return VarianceShares(
        tolerances.factors,
        _part_of(linear, sloped),
        missing if curved is None else _part_of(alone, varies),
        missing if curved is None else _part_of(alone + together, varies),
        np.sqrt(variance),
    )


def _part_of(parts: Float[np.ndarray, "m f"], whole: Float[np.ndarray, " m"]) -> Float[np.ndarray, "m f"]:
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(whole[:, None] > 0.0, parts / whole[:, None], np.nan)


def _curved(hessian: Float[np.ndarray, "m k k"], part: _Part) -> Float[np.ndarray, " m"]:
    """Variance (m,) of the squares of one part."""
    block = hessian[:, part.columns, part.columns]
    trace, square = np.trace(block, axis1=1, axis2=2), np.sum(block**2, axis=(1, 2))
    return 0.25 * (part.fourth * (2.0 * square + trace**2) - trace**2)


def _parts(tolerances: Tolerances) -> tuple[Float[np.ndarray, "k k"], list[_Part]]:
    """B (k, k) and its parts, in the order of the names."""
    k = len(tolerances.names)
    basis, parts = np.zeros((k, k)), []
    position, number = 0, len(tolerances.independent)
    for name in tolerances.names[:number]:
        tolerance = tolerances.independent[name]
        basis[position, position], fourth = _moments(tolerance)
        parts.append(_Part(slice(position, position + 1), position, fourth))
        position += 1
    for factor, (matrix, sizes) in enumerate(_groups(tolerances), start=number):
        first = position
        for n, fourth in sizes:
            parts.append(_Part(slice(position, position + n), factor, fourth))
            position += n
        basis[first:position, first:position] = matrix
    return basis, parts


def _groups(tolerances: Tolerances) -> Iterator[tuple[np.ndarray, list[tuple[int, float]]]]:
    """Block of B of each group, and the sizes and fourth moments of its parts."""
    for group in tolerances.correlated:
        yield np.linalg.cholesky(np.asarray(group.covariance)), [(1, 1.0)] * len(group.names)
    for zone in tolerances.zones:
        scale = np.concatenate([np.full(n, (n + 2.0) ** -0.5) for n in zone.balls])
        # Of a unit ball of dimension n: E y_i^2 = 1/(n + 2), E y_i^4 = 3/((n + 2)(n + 4)).
        yield np.asarray(zone.matrix) * scale, [(n, (n + 2.0) / (n + 4.0)) for n in zone.balls]


@eqx.filter_jit
def _variance_and_errors(tolerance: Tolerance) -> tuple[ArrayLike, ArrayLike, ArrayLike]:
    """Variance and mean of an error, and the errors at the nodes, of standard normal numbers, by one program."""
    return tolerance.variance(), tolerance.mean, tolerance.from_normal(jnp.asarray(NODES))


def _moments(tolerance: Tolerance) -> tuple[float, float]:
    """Standard deviation of an error, and its fourth moment about its mean, by that of a normal one of the same
    variance."""
    variance, mean, errors = map(np.asarray, _variance_and_errors(tolerance))
    away = errors - mean
    density = np.exp(-0.5 * NODES**2) / math.sqrt(2.0 * math.pi)
    square, fourth = (np.trapezoid(away**power * density, NODES) for power in (2, 4))
    return float(np.sqrt(variance)), float(fourth / (3.0 * square**2)) if square > 0.0 else 1.0
