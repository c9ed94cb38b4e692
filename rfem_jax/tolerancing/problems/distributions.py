"""Distributions of single errors within their tolerances.

Place in the pipeline: `named_tolerances` holds one for each error. A tolerance is an interval symmetric about zero or a
given one; its distribution maps a point u of (0, 1) to an error by the inverse of the distribution function, which is
differentiable in the half-width t.

    Uniform          e = c + t (2u - 1)                                   variance t^2/3
    Triangular       e = c + t s (1 - sqrt(1 - |2u - 1|)), s = sign(2u-1)  variance t^2/6
    Normal           e = c + sigma z(u),  sigma = t/k                     variance sigma^2
    TruncatedNormal  the same cut off at c +- t                           variance < sigma^2
    ProcessNormal    the same with a mean off the middle and sigma by the capability of a process

Symbols: t half-width [rad or m], c centre of the interval [rad or m], k standard deviations within the half-width (3
unless given: 99.73 % of a normal error lies inside), z(u) standard normal quantile, u (d,) point of the unit cube,
one coordinate per error.
Source: theory (10.1); L. Devroye, Non-Uniform Random Variate Generation (1986), chapter II.2 (inversion);
N. L. Johnson, S. Kotz, N. Balakrishnan, Continuous Univariate Distributions, vol. 1 (1994), 10.1 (truncated normal).
"""

from collections.abc import Sequence
from contextlib import suppress
from typing import Any

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import numpy as np
from jax.scipy.special import erf, ndtr, ndtri
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from rfem_jax.description.basics.errors import InputError
from rfem_jax.description.basics.precision import require_float64
from rfem_jax.tolerancing.checks import parse_error
from rfem_jax.tolerancing.problems.capability import mean_shift
from rfem_jax.tolerancing.problems.joint_distributions import checked_number


class Tolerance(eqx.Module):
    """Base of the distributions of a single error: an interval of half-width `tolerance` about `centre` [rad or m].

    Args: tolerance, half-width t of the interval -t ... t, a number in rad or m or a string with a unit such as
        "0.25 deg" or "0.1 mm"; or instead interval=(low, high), numbers or strings.
    Raises: InputError for a negative or non-finite width, for strings that are no angle or length, and for both or
        none of the two arguments.
    """

    tolerance: Float[Array, ""]
    centre: Float[Array, ""]
    unit: str | None = eqx.field(static=True)  # "rad" or "m" if a string said so

    def __init__(self, tolerance: ArrayLike | str | None = None, *, interval: Sequence[ArrayLike | str] | None = None):
        self.tolerance, self.centre, self.unit = _half_width_and_centre(tolerance, interval)

    @property
    def interval(self) -> tuple[Float[Array, ""], Float[Array, ""]]:
        """Ends (low, high) [rad or m]; for a normal error they are centre +- k sigma."""
        return self.centre - self.tolerance, self.centre + self.tolerance

    def quantile(self, u: Float[Array, "*shape"] | float) -> Float[Array, "*shape"]:
        """The errors [rad or m] at which the distribution function has the values u in (0, 1)."""
        return self.centre + self.tolerance * self._unit_quantile(u)

    def variance(self) -> Float[Array, ""]:
        """Variance of the error [rad^2 or m^2]."""
        return self.tolerance**2 * self._unit_variance()

    @property
    def mean(self) -> Float[Array, ""]:
        """Mean error [rad or m]."""
        return self.centre

    def from_normal(self, w: Float[Array, "*shape"] | float) -> Float[Array, "*shape"]:
        """The errors [rad or m] of standard normal numbers w: those of `quantile` at u = N(w), exact far out too."""
        return self.centre + self.tolerance * self._unit_from_normal(w)

    def _unit_quantile(self, u):
        raise NotImplementedError

    def _unit_from_normal(self, w):
        raise NotImplementedError

    def _unit_variance(self):
        raise NotImplementedError


class Uniform(Tolerance):
    """Every error of the interval is equally likely."""

    def _unit_quantile(self, u):
        return 2.0 * u - 1.0

    def _unit_from_normal(self, w):
        return erf(w / jnp.sqrt(2.0))

    def _unit_variance(self):
        return 1.0 / 3.0


class Triangular(Tolerance):
    """Most likely in the middle of the interval; the density falls linearly to zero at its ends."""

    def _unit_quantile(self, u):
        v = 2.0 * u - 1.0
        return jnp.sign(v) * (1.0 - jnp.sqrt(1.0 - jnp.abs(v)))

    def _unit_from_normal(self, w):
        return _odd(w, lambda x: 1.0 - jnp.sqrt(2.0 * ndtr(-x)))

    def _unit_variance(self):
        return 1.0 / 6.0


class Normal(Tolerance):
    """Normal; the half-width is `deviations` standard deviations (k), and errors beyond it occur."""

    deviations: Float[Array, ""]

    def __init__(
        self,
        tolerance: ArrayLike | str | None = None,
        *,
        interval: Sequence[ArrayLike | str] | None = None,
        deviations: ArrayLike = 3.0,
    ):
        super().__init__(tolerance, interval=interval)
        self.deviations = checked_number(deviations, "deviations", positive=True)

    def _unit_quantile(self, u):
        return ndtri(u) / self.deviations

    def _unit_from_normal(self, w):
        return w / self.deviations

    def _unit_variance(self):
        return 1.0 / self.deviations**2


class TruncatedNormal(Normal):
    """Normal of standard deviation t/k, cut off at the ends of the interval."""

    def _unit_quantile(self, u):
        below = ndtr(-self.deviations)
        inside = below + jnp.asarray(u) * (1.0 - 2.0 * below)
        return jnp.clip(ndtri(inside) / self.deviations, -1.0, 1.0)

    def _unit_from_normal(self, w):
        below = ndtr(-self.deviations)
        return _odd(w, lambda x: -ndtri(below + ndtr(-x) * (1.0 - 2.0 * below)) / self.deviations)

    def _unit_variance(self):
        k = self.deviations
        density = jnp.exp(-0.5 * k**2) / jnp.sqrt(2.0 * jnp.pi)
        return (1.0 - 2.0 * k * density / (1.0 - 2.0 * ndtr(-k))) / k**2


class ProcessNormal(Normal):
    """Normal, as a process of known capability makes the error; the interval is that of the drawing.

    Args: cp, width of the interval / 6 sigma; cpk, the distance of the mean to the nearer end / 3 sigma, cp (a centred
        process) unless given; side "upper" or "lower", the end that the mean is nearer to.
    Raises: InputError for a cpk above cp, and for what `Normal` refuses.
    """

    shift: Float[Array, ""]

    def __init__(
        self,
        tolerance: ArrayLike | str | None = None,
        *,
        interval: Sequence[ArrayLike | str] | None = None,
        cp: ArrayLike,
        cpk: ArrayLike | None = None,
        side: str = "upper",
    ):
        ratio = checked_number(cp, "cp", positive=True)
        nearer = ratio if cpk is None else checked_number(cpk, "cpk")
        super().__init__(tolerance, interval=interval, deviations=3.0 * ratio)
        self.shift = mean_shift(ratio, nearer, side)

    @property
    def mean(self) -> Float[Array, ""]:
        return self.centre + self.tolerance * self.shift

    def _unit_quantile(self, u):
        return self.shift + super()._unit_quantile(u)

    def _unit_from_normal(self, w):
        return self.shift + super()._unit_from_normal(w)


# By their names in study files.
DISTRIBUTIONS = {"uniform": Uniform, "triangular": Triangular, "normal": Normal, "truncated_normal": TruncatedNormal}


def _odd(w, half):
    """The odd function of w that is half(w) for w >= 0."""
    return jnp.where(w >= 0.0, half(jnp.abs(w)), -half(jnp.abs(w)))


_NUMBERS = int | float | np.ndarray | np.generic | jax.Array


def _half_width_and_centre(tolerance, interval) -> tuple[Float[Array, ""], Float[Array, ""], str | None]:
    """Half-width and centre [rad or m], and the unit, "rad" or "m", that a string gives them."""
    if (tolerance is None) == (interval is None):
        both = "neither is" if tolerance is None else "both are"
        raise InputError(
            f"Argument `tolerance` must be given or else `interval`, but {both}; "
            "write Uniform(0.01) or Uniform(interval=(-0.005, 0.01))."
        )
    if interval is None:
        value, unit = _parsed(tolerance, "tolerance")
        return checked_number(value, "tolerance"), jnp.zeros((), jnp.float64), unit
    if len(interval) != 2:
        raise InputError(f"Argument `interval` must be a pair (low, high), but it is {interval!r}.")
    require_float64()
    (low, unit), (high, other) = (_parsed(end, "interval") for end in interval)
    if unit is not None and other is not None and unit != other:
        raise InputError(
            f"Argument `interval` must have two ends of one unit, but it is {interval!r}; correct one of them."
        )
    low, high = _as_numbers(low, high)
    if not isinstance(low, jax.core.Tracer) and not isinstance(high, jax.core.Tracer):
        if not (np.isfinite(low) and np.isfinite(high) and low <= high):
            raise InputError(
                f"Argument `interval` must be finite and rise from low to high, but it is "
                f"({low}, {high}); swap or correct its ends."
            )
    halves = 0.5 * low, 0.5 * high  # whose sum and difference do not overflow
    width, centre = (jnp.asarray(one, jnp.float64) for one in (halves[1] - halves[0], halves[0] + halves[1]))
    return width, centre, unit or other


def _as_numbers(low: Any, high: Any) -> tuple[Any, Any]:
    """Ends of an interval as arrays without axes: of NumPy if both are known, since JAX would compile every operation.

    Raises: InputError for anything else than numbers.
    """
    known = all(isinstance(x, _NUMBERS) and not isinstance(x, jax.core.Tracer) for x in (low, high))
    numbers: Any = np if known else jnp
    with suppress(TypeError, ValueError):
        ends = numbers.asarray(low, jnp.float64), numbers.asarray(high, jnp.float64)
        if not (ends[0].ndim or ends[1].ndim):
            return ends
    raise InputError(f"Argument `interval` must be a pair of numbers (low, high), but it is {(low, high)!r}.")


def _parsed(value, what: str):
    """(number, unit) of a string, (value, None) of anything else."""
    return parse_error(value, what) if isinstance(value, str) else (value, None)
