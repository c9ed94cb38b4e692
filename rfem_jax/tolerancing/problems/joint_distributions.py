"""Distributions of several errors together: correlated normal ones, and tolerance zones of round shape.

Place in the pipeline: **joint_distributions** -> `named_tolerances`, whose `Tolerances` hold groups beside the rest.

    CorrelatedNormal e = mean + L w                       L L^T = covariance S
    Zone             e = M y, y uniform in a product of unit balls of dimensions n_b
                     y_b = w_b/|w_b| P(n_b/2, |w_b|^2/2)^(1/n_b)

with w standard normal and P the regularised incomplete gamma function: P(n/2, r^2/2) is the distribution function of
|w_b|, so that |y_b|^n_b is uniform. The map is smooth, at w = 0 too, where it is linear.

Symbols: e (d,) errors [rad or m], u (d,) point of the unit cube, w = z(u) its standard normal quantiles.
Source: theory (10.1), (10.18), (10.19); K.-T. Fang, S. Kotz, K. W. Ng, Symmetric Multivariate and Related
Distributions (1990), chapter 2 (uniform in a ball).
"""

from collections.abc import Iterable, Sequence

import equinox as eqx
import jax.core
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import gammainc, gammaln, ndtri
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from rfem_jax.description.basics.errors import InputError
from rfem_jax.description.basics.precision import require_float64

NEAR = 1e-2  # of |w|^2/2: below it a power series of P is exact to rounding


class CorrelatedNormal(eqx.Module):
    """Several normal errors with a covariance.

    Args: names (d) of the errors; covariance S (d, d), symmetric positive definite [rad^2, m^2, rad m]; mean (d,)
        [rad or m], zero unless given; deviations k that count as the half-width.
    Raises: InputError for repeated names, wrong shapes, and an S that is not positive definite.
    """

    names: tuple[str, ...] = eqx.field(static=True)
    covariance: Float[Array, "d d"]
    mean: Float[Array, " d"]
    deviations: Float[Array, ""]

    def __init__(
        self,
        names: Iterable[str],
        covariance: ArrayLike | Sequence[Sequence[float | int]],
        *,
        mean: ArrayLike | Sequence[float | int] | None = None,
        deviations: ArrayLike = 3.0,
    ):
        require_float64()
        self.names = tuple(names)
        d = len(self.names)
        self.covariance = jnp.asarray(covariance, jnp.float64)
        self.mean = jnp.zeros(d) if mean is None else jnp.asarray(mean, jnp.float64)
        self.deviations = checked_number(deviations, "deviations", positive=True)
        if len(set(self.names)) != d:
            raise InputError(f"Argument `names` must not repeat a name, but it is {self.names}; merge the rows.")
        for what, array, shape in (
            ("covariance", self.covariance, (d, d)),
            ("mean", self.mean, (d,)),
        ):
            if array.shape != shape:
                raise InputError(
                    f"Argument `{what}` must have the shape {shape} of its {d} names, but it has "
                    f"{array.shape}; give one row per name."
                )
        if not isinstance(self.covariance, jax.core.Tracer):
            _check_covariance(np.asarray(self.covariance))

    def quantile(self, u: Float[Array, " d"]) -> Float[Array, " d"]:
        """Errors (d,) [rad or m] of a point u (d,) of the unit cube."""
        return self.from_normal(ndtri(u))

    def from_normal(self, w: Float[Array, " d"]) -> Float[Array, " d"]:
        """Errors (d,) [rad or m] of standard normal numbers w (d,)."""
        return self.mean + jnp.linalg.cholesky(self.covariance) @ w

    def half_widths(self) -> Float[Array, " d"]:
        """k standard deviations of each error (d,) [rad or m]."""
        return self.deviations * jnp.sqrt(jnp.diagonal(self.covariance))

    def scaled(self, factors: Float[Array, " d"]) -> "CorrelatedNormal":
        """The same group with every error's half-width times a factor (d,)."""
        return eqx.tree_at(lambda g: g.covariance, self, self.covariance * jnp.outer(factors, factors))


class Zone(eqx.Module):
    """Several errors, uniform in a tolerance zone about zero that is the image e = M y of a product of unit balls.

    A disc of radius R for two errors is Zone(names, R * eye(2), (2,)); theory (10.18) has those of drawings.

    Args: names (d) of the errors; matrix M (d, d) [rad or m], of full rank; balls, dimensions of the balls, whose sum
        is d.
    Raises: InputError for repeated names, wrong shapes, and a matrix without full rank.
    """

    names: tuple[str, ...] = eqx.field(static=True)
    matrix: Float[Array, "d d"]
    balls: tuple[int, ...] = eqx.field(static=True)

    def __init__(self, names: Iterable[str], matrix: ArrayLike | Sequence[Sequence[float]], balls: Sequence[int]):
        require_float64()
        self.names, self.balls = tuple(names), tuple(int(n) for n in balls)
        self.matrix = jnp.asarray(matrix, jnp.float64)
        d = len(self.names)
        if len(set(self.names)) != d:
            raise InputError(f"Argument `names` must not repeat a name, but it is {self.names}; merge the rows.")
        if sum(self.balls) != d or min(self.balls, default=0) < 1:
            raise InputError(
                f"Argument `balls` must be dimensions whose sum is that of the {d} names, but it is {self.balls}; "
                "a disc of two errors is (2,)."
            )
        if self.matrix.shape != (d, d):
            raise InputError(
                f"Argument `matrix` must have the shape {(d, d)} of its {d} names, but it has {self.matrix.shape}; "
                "give one row per name."
            )
        if not isinstance(self.matrix, jax.core.Tracer):
            _check_rank(np.asarray(self.matrix))

    @property
    def mean(self) -> Float[Array, " d"]:
        """Zero: the zone is about the nominal place."""
        return jnp.zeros(len(self.names))

    @property
    def covariance(self) -> Float[Array, "d d"]:
        """Covariance (d, d) of the errors: a unit ball of dimension n has the variance 1/(n + 2) along each axis."""
        variances = jnp.concatenate([jnp.full(n, 1.0 / (n + 2.0)) for n in self.balls])
        return (self.matrix * variances[None]) @ self.matrix.T

    def quantile(self, u: Float[Array, " d"]) -> Float[Array, " d"]:
        """Errors (d,) [rad or m] of a point u (d,) of the unit cube."""
        return self.from_normal(ndtri(u))

    def from_normal(self, w: Float[Array, " d"]) -> Float[Array, " d"]:
        """Errors (d,) [rad or m] of standard normal numbers w (d,)."""
        parts = jnp.split(w, np.cumsum(self.balls)[:-1])
        return self.matrix @ jnp.concatenate([_in_ball(part) for part in parts])

    def half_widths(self) -> Float[Array, " d"]:
        """Largest magnitude (d,) [rad or m] of each error in the zone."""
        blocks = jnp.split(self.matrix, np.cumsum(self.balls)[:-1], axis=1)
        return sum((jnp.linalg.norm(block, axis=1) for block in blocks), jnp.zeros(len(self.names)))

    def scaled(self, factors: Float[Array, " d"]) -> "Zone":
        """The same zone with every error's half-width times a factor (d,)."""
        return eqx.tree_at(lambda g: g.matrix, self, self.matrix * jnp.asarray(factors)[:, None])


def _in_ball(w: Float[Array, " n"]) -> Float[Array, " n"]:
    """Uniform in the unit ball, of standard normal numbers w (n,)."""
    a, x = 0.5 * len(w), 0.5 * jnp.sum(w**2)
    near = x < NEAR
    # P(a, x)/x^a = e^-x/Gamma(a + 1) (1 + x/(a+1) + x^2/((a+1)(a+2)) + ...)
    small = jnp.where(near, x, 0.0)
    series, term = jnp.ones(()), jnp.ones(())
    for i in range(1, 7):
        term = term * small / (a + i)
        series = series + term
    series = jnp.exp(-small - gammaln(a + 1.0)) * series
    large = jnp.where(near, 1.0, x)
    ratio = jnp.where(near, series, gammainc(a, large) / large**a)
    return w * (0.5**a * ratio) ** (1.0 / len(w))


def checked_number(value, what: str, positive: bool = False) -> Float[Array, ""]:
    """`value` as a float64 scalar; traced values pass unchecked. Raises InputError."""
    require_float64()
    try:
        number = jnp.asarray(value, jnp.float64)
    except (TypeError, ValueError):
        number = None
    if number is None or number.ndim:
        raise InputError(f"Argument `{what}` must be one number, but it is {value!r}.")
    if not isinstance(number, jax.core.Tracer):
        if not (np.isfinite(number) and (number > 0 if positive else number >= 0)):
            bound = "positive" if positive else "zero or positive"
            fix = "3 is usual" if positive else "give a half-width in rad or m"
            raise InputError(f"Argument `{what}` must be {bound} and finite, but it is {value}; {fix}.")
    return number


def _check_covariance(covariance: Float[np.ndarray, "d d"]) -> None:
    scale = np.sqrt(np.abs(np.outer(np.diag(covariance), np.diag(covariance))))
    symmetric = np.all(np.abs(covariance - covariance.T) <= 1e-12 * scale)
    positive = False
    if symmetric and np.all(np.isfinite(covariance)) and np.all(np.diag(covariance) > 0):
        deviation = np.sqrt(np.diag(covariance))
        positive = np.linalg.eigvalsh(covariance / np.outer(deviation, deviation))[0] > 1e-14
    if not positive:
        found = "has an eigenvalue that is not" if symmetric else "is not symmetric"
        raise InputError(
            f"Argument `covariance` must be symmetric and positive definite, but it {found}; "
            "leave out errors that follow from the others."
        )


def _check_rank(matrix: Float[np.ndarray, "d d"]) -> None:
    scale = np.max(np.abs(matrix), axis=1, initial=0.0)
    proper = np.all(np.isfinite(matrix)) and np.all(scale > 0)
    if not proper or np.linalg.matrix_rank(matrix / scale[:, None]) < len(matrix):
        raise InputError(
            "Argument `matrix` must be finite and of full rank, but is not; give every error a width, and leave out "
            "errors that follow from the others."
        )
