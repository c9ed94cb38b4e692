"""Distributions of the assembly errors within their tolerances.

Place in the pipeline: input of every study of this package. Each error has a tolerance, an interval symmetric about
zero or a given one; its distribution maps a point u of (0, 1) to an error by the inverse of the distribution
function, which is differentiable in the half-width t.

    Uniform          e = c + t (2u - 1)                                   variance t^2/3
    Triangular       e = c + t s (1 - sqrt(1 - |2u - 1|)), s = sign(2u-1)  variance t^2/6
    Normal           e = c + sigma z(u),  sigma = t/k                     variance sigma^2
    TruncatedNormal  the same cut off at c +- t                           variance < sigma^2
    CorrelatedNormal e = mean + L z(u),   L L^T = covariance S            several errors at once

Symbols: t half-width [rad or m], c centre of the interval [rad or m], k standard deviations within the half-width (3
unless given: 99.73 % of a normal error lies inside), z(u) standard normal quantile, u (d,) point of the unit cube,
one coordinate per error.
Source: theory (10.1); L. Devroye, Non-Uniform Random Variate Generation (1986), chapter II.2 (inversion);
N. L. Johnson, S. Kotz, N. Balakrishnan, Continuous Univariate Distributions, vol. 1 (1994), 10.1 (truncated normal).
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.core
import jax.numpy as jnp
import jax.scipy.linalg
import numpy as np
from jax.scipy.special import ndtr, ndtri
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from rfem_jax.description.errors import InputError
from rfem_jax.description.precision import require_float64
from rfem_jax.description.study import Study
from rfem_jax.description.tolerances import SpecifiedTolerances
from rfem_jax.tolerancing.checks import DIMENSIONS, check_known, parse_error
from rfem_jax.tolerancing.problems.problem import ToleranceProblem


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

    def _unit_quantile(self, u):
        raise NotImplementedError

    def _unit_variance(self):
        raise NotImplementedError


class Uniform(Tolerance):
    """Every error of the interval is equally likely."""

    def _unit_quantile(self, u):
        return 2.0 * u - 1.0

    def _unit_variance(self):
        return 1.0 / 3.0


class Triangular(Tolerance):
    """Most likely in the middle of the interval; the density falls linearly to zero at its ends."""

    def _unit_quantile(self, u):
        v = 2.0 * u - 1.0
        return jnp.sign(v) * (1.0 - jnp.sqrt(1.0 - jnp.abs(v)))

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
        self.deviations = _number(deviations, "deviations", positive=True)

    def _unit_quantile(self, u):
        return ndtri(u) / self.deviations

    def _unit_variance(self):
        return 1.0 / self.deviations**2


class TruncatedNormal(Normal):
    """Normal of standard deviation t/k, cut off at the ends of the interval."""

    def _unit_quantile(self, u):
        below = ndtr(-self.deviations)
        inside = below + jnp.asarray(u) * (1.0 - 2.0 * below)
        return jnp.clip(ndtri(inside) / self.deviations, -1.0, 1.0)

    def _unit_variance(self):
        k = self.deviations
        density = jnp.exp(-0.5 * k**2) / jnp.sqrt(2.0 * jnp.pi)
        return (1.0 - 2.0 * k * density / (1.0 - 2.0 * ndtr(-k))) / k**2


# By their names in study files.
DISTRIBUTIONS = {"uniform": Uniform, "triangular": Triangular, "normal": Normal, "truncated_normal": TruncatedNormal}


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
        self.deviations = _number(deviations, "deviations", positive=True)
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
        return self.mean + jnp.linalg.cholesky(self.covariance) @ ndtri(u)

    def half_widths(self) -> Float[Array, " d"]:
        """k standard deviations of each error (d,) [rad or m]."""
        return self.deviations * jnp.sqrt(jnp.diagonal(self.covariance))


class Tolerances(eqx.Module):
    """Named tolerances: the box, the distribution and the covariance of all errors of a study.

    Args: tolerances {error name: Uniform, Triangular, Normal or TruncatedNormal}; correlated, a sequence of
        CorrelatedNormal groups. Names and coordinates of the unit cube have the order of the mapping, then of the
        groups. Different entries are independent of each other.
    Raises: InputError for repeated names, for no name at all, and for objects of another kind.
    """

    independent: dict[str, Tolerance]
    correlated: tuple[CorrelatedNormal, ...]
    names: tuple[str, ...] = eqx.field(static=True)

    def __init__(
        self,
        tolerances: Mapping[str, Tolerance] | None = None,
        *,
        correlated: CorrelatedNormal | Iterable[CorrelatedNormal] = (),
    ):
        self.independent = dict(tolerances or {})
        self.correlated = (correlated,) if isinstance(correlated, CorrelatedNormal) else tuple(correlated)
        for name, tolerance in self.independent.items():
            if not isinstance(tolerance, Tolerance):
                raise InputError(
                    f"Argument `tolerances` must map names to tolerances, but `{name}` is "
                    f"{tolerance!r}; write for example Uniform({tolerance!r})."
                )
        for group in self.correlated:
            if not isinstance(group, CorrelatedNormal):
                raise InputError(
                    "Argument `correlated` must hold CorrelatedNormal groups, but one entry is "
                    f"{group!r}; write CorrelatedNormal(names, covariance)."
                )
        # A dict is a pytree with sorted keys; the order of the names is the user's.
        self.names = (*self.independent, *(n for g in self.correlated for n in g.names))
        repeated = next((n for i, n in enumerate(self.names) if n in self.names[:i]), None)
        if repeated is not None or not self.names:
            found = "it names none" if repeated is None else f"`{repeated}` occurs twice"
            raise InputError(
                f"Argument `tolerances` must name every error once, but {found}; "
                "give each error one tolerance, alone or in one group."
            )

    @classmethod
    def of(cls, study: Study | SpecifiedTolerances) -> "Tolerances":
        """The distributions that a study specifies, for `monte_carlo`, `worst_case` and the like.

        Args: study, as `load_study` gives it, or its `tolerances`.
        Raises: InputError for a study without tolerances, and for anything else.
        """
        specified = study.tolerances if isinstance(study, Study) else study
        if not isinstance(specified, SpecifiedTolerances):
            found = "specifies none" if isinstance(study, Study) else f"was {study!r}"
            raise InputError(
                f"Argument `study` must be a study with tolerances, but {found}; add a table [tolerances], or write "
                "Tolerances({...})."
            )
        independent = {}
        for one in specified.independent:
            settings = {} if one.deviations is None else {"deviations": one.deviations}
            independent[one.error] = DISTRIBUTIONS[one.distribution](interval=one.interval, **settings)
        groups = [
            CorrelatedNormal(group.half_widths, group.covariance(), deviations=group.deviations)
            for group in specified.correlated
        ]
        return cls(independent, correlated=groups)

    @property
    def factors(self) -> tuple[tuple[str, ...], ...]:
        """Independent sources of scatter, each a tuple of names: single errors, then correlated groups."""
        single = tuple((name,) for name, _ in self._single())
        return single + tuple(group.names for group in self.correlated)

    def _single(self):
        """(name, tolerance) of the errors outside of groups, in the order of `names`."""
        return [(n, self.independent[n]) for n in self.names if n in self.independent]

    def errors(self, point: Float[Array, " d"]) -> dict[str, Float[Array, ""]]:
        """{name: error [rad or m]} of one point (d,) of the unit cube."""
        single = self._single()
        errors = {name: tol.quantile(point[i]) for i, (name, tol) in enumerate(single)}
        position = len(single)
        for group in self.correlated:
            drawn = group.quantile(point[position : position + len(group.names)])
            errors |= {name: drawn[i] for i, name in enumerate(group.names)}
            position += len(group.names)
        return errors

    def half_widths(self) -> dict[str, Float[Array, ""]]:
        """{name: half-width [rad or m]}; for a correlated error k standard deviations."""
        widths = {name: tol.tolerance for name, tol in self._single()}
        for group in self.correlated:
            widths |= dict(zip(group.names, group.half_widths(), strict=True))
        return widths

    def intervals(self) -> dict[str, tuple[Float[Array, ""], Float[Array, ""]]]:
        """{name: (low, high) [rad or m]}, the box; normal errors lie outside of it now and then."""
        means, widths = self.means(), self.half_widths()
        return {n: (means[n] - widths[n], means[n] + widths[n]) for n in self.names}

    def means(self) -> dict[str, Float[Array, ""]]:
        """{name: mean error [rad or m]}; zero where the interval is symmetric about zero."""
        means = {name: tol.centre for name, tol in self._single()}
        for group in self.correlated:
            means |= dict(zip(group.names, group.mean, strict=True))
        return means

    def covariance(self) -> Float[Array, "d d"]:
        """Covariance (d, d) of the errors [rad^2, m^2, rad m], in the order of `names`."""
        blocks = [tol.variance()[None, None] for _, tol in self._single()]
        blocks += [group.covariance for group in self.correlated]
        return jax.scipy.linalg.block_diag(*blocks)

    def with_half_widths(self, half_widths: Mapping[str, ArrayLike]) -> "Tolerances":
        """The same distributions about the same centres with new half-widths {name: [rad or m]}.

        A correlated group keeps its correlations. Names that are missing keep their width.
        Raises: InputError for unknown names.
        """
        check_known(half_widths, self.names, "half_widths")
        independent = {}
        for name, tol in self._single():
            width = _number(half_widths.get(name, tol.tolerance), "half_widths")
            independent[name] = eqx.tree_at(lambda t: t.tolerance, tol, width)
        groups = []
        for group in self.correlated:
            old = dict(zip(group.names, group.half_widths(), strict=True))
            new = [jnp.asarray(half_widths.get(name, old[name])) for name in group.names]
            scale = jnp.stack(new) / group.half_widths()
            covariance = group.covariance * jnp.outer(scale, scale)
            groups.append(eqx.tree_at(lambda g: g.covariance, group, covariance))
        return Tolerances(independent, correlated=groups)

    def require_units(self, problem: ToleranceProblem) -> None:
        """Raise InputError for an angle with a tolerance given as a length, or the other way round."""
        for name, tolerance in self._single():
            unit = problem.error_unit(name)
            if tolerance.unit not in (None, unit):
                raise InputError(
                    f"Argument `tolerances` must be in the units of the errors, but `{name}` is an "
                    f"{DIMENSIONS[unit]} [{unit}] and its tolerance is in {tolerance.unit}; correct its unit."
                )


def distributions_of(tolerances: Any) -> Any:
    """`Tolerances` of a study or of what it specifies; anything else as it is."""
    return Tolerances.of(tolerances) if isinstance(tolerances, (Study, SpecifiedTolerances)) else tolerances


def _number(value, what: str, positive: bool = False) -> Float[Array, ""]:
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
        return _number(value, "tolerance"), jnp.zeros((), jnp.float64), unit
    if len(interval) != 2:
        raise InputError(f"Argument `interval` must be a pair (low, high), but it is {interval!r}.")
    require_float64()
    (low, unit), (high, other) = (_parsed(end, "interval") for end in interval)
    if unit is not None and other is not None and unit != other:
        raise InputError(
            f"Argument `interval` must have two ends of one unit, but it is {interval!r}; correct one of them."
        )
    low, high = jnp.asarray(low, jnp.float64), jnp.asarray(high, jnp.float64)
    if not isinstance(low, jax.core.Tracer) and not isinstance(high, jax.core.Tracer):
        if not (np.isfinite(low) and np.isfinite(high) and low <= high):
            raise InputError(
                f"Argument `interval` must be finite and rise from low to high, but it is "
                f"({low}, {high}); swap or correct its ends."
            )
    return 0.5 * (high - low), 0.5 * (low + high), unit or other


def _parsed(value, what: str):
    """(number, unit) of a string, (value, None) of anything else."""
    return parse_error(value, what) if isinstance(value, str) else (value, None)


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
