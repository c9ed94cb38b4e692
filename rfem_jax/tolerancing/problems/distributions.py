"""Distributions of the assembly errors within their tolerances.

Place in the pipeline: input of every study of this package. Each error has a tolerance, an interval symmetric about
zero or a given one; its distribution maps a point u of (0, 1) to an error by the inverse of the distribution
function, which is differentiable in the half-width t.

    Uniform          e = c + t (2u - 1)                                   variance t^2/3
    Triangular       e = c + t s (1 - sqrt(1 - |2u - 1|)), s = sign(2u-1)  variance t^2/6
    Normal           e = c + sigma z(u),  sigma = t/k                     variance sigma^2
    TruncatedNormal  the same cut off at c +- t                           variance < sigma^2
    ProcessNormal    the same with a mean off the middle and sigma by the capability of a process
    CorrelatedNormal, Zone   several errors at once, see `joint_distributions`

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
from jax.scipy.special import erf, ndtr, ndtri
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from rfem_jax.description.errors import InputError
from rfem_jax.description.precision import require_float64
from rfem_jax.description.study import Study
from rfem_jax.description.tolerances import SpecifiedTolerance, SpecifiedTolerances
from rfem_jax.tolerancing.checks import DIMENSIONS, check_known, parse_error
from rfem_jax.tolerancing.problems.capability import mean_shift
from rfem_jax.tolerancing.problems.joint_distributions import CorrelatedNormal as CorrelatedNormal
from rfem_jax.tolerancing.problems.joint_distributions import Zone as Zone
from rfem_jax.tolerancing.problems.joint_distributions import checked_number
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


class Tolerances(eqx.Module):
    """Named tolerances: the box, the distribution and the covariance of all errors of a study.

    Args: tolerances {error name: Uniform, Triangular, Normal, ProcessNormal or TruncatedNormal}; correlated, a sequence
        of CorrelatedNormal groups; zones, of Zone groups. Names and coordinates of the unit cube have the order of the
        mapping, then of the groups. Different entries are independent of each other.
    Raises: InputError for repeated names, for no name at all, and for objects of another kind.
    """

    independent: dict[str, Tolerance]
    correlated: tuple[CorrelatedNormal, ...]
    zones: tuple[Zone, ...]
    names: tuple[str, ...] = eqx.field(static=True)

    def __init__(
        self,
        tolerances: Mapping[str, Tolerance] | None = None,
        *,
        correlated: CorrelatedNormal | Iterable[CorrelatedNormal] = (),
        zones: Zone | Iterable[Zone] = (),
    ):
        self.independent = dict(tolerances or {})
        self.correlated = (correlated,) if isinstance(correlated, CorrelatedNormal) else tuple(correlated)
        self.zones = (zones,) if isinstance(zones, Zone) else tuple(zones)
        for name, tolerance in self.independent.items():
            if not isinstance(tolerance, Tolerance):
                raise InputError(
                    f"Argument `tolerances` must map names to tolerances, but `{name}` is "
                    f"{tolerance!r}; write for example Uniform({tolerance!r})."
                )
        for what, groups, kind, example in (
            ("correlated", self.correlated, CorrelatedNormal, "CorrelatedNormal(names, covariance)"),
            ("zones", self.zones, Zone, "Zone(names, matrix, balls)"),
        ):
            wrong = [group for group in groups if not isinstance(group, kind)]
            if wrong:
                raise InputError(
                    f"Argument `{what}` must hold {kind.__name__} groups, but one entry is {wrong[0]!r}; "
                    f"write {example}."
                )
        # A dict is a pytree with sorted keys; the order of the names is the user's.
        self.names = (*self.independent, *(n for g in self.groups for n in g.names))
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
        independent = {one.error: _distribution(one) for one in specified.independent}
        groups = [
            CorrelatedNormal(group.half_widths, group.covariance(), deviations=group.deviations)
            for group in specified.correlated
        ]
        zones = [Zone(zone.errors, zone.matrix(), zone.balls) for zone in specified.zones]
        return cls(independent, correlated=groups, zones=zones)

    @property
    def groups(self) -> tuple[CorrelatedNormal | Zone, ...]:
        """The groups of errors that vary together, in the order of `names`."""
        return (*self.correlated, *self.zones)

    @property
    def factors(self) -> tuple[tuple[str, ...], ...]:
        """Independent sources of scatter, each a tuple of names: single errors, then correlated groups."""
        single = tuple((name,) for name, _ in self._single())
        return single + tuple(group.names for group in self.groups)

    def _single(self):
        """(name, tolerance) of the errors outside of groups, in the order of `names`."""
        return [(n, self.independent[n]) for n in self.names if n in self.independent]

    def errors(self, point: Float[Array, " d"]) -> dict[str, Float[Array, ""]]:
        """{name: error [rad or m]} of one point (d,) of the unit cube."""
        single = self._single()
        errors = {name: tol.quantile(point[i]) for i, (name, tol) in enumerate(single)}
        return errors | self._of_groups(point, lambda group, part: group.quantile(part))

    def from_normal(self, w: Float[Array, " d"]) -> dict[str, Float[Array, ""]]:
        """{name: error [rad or m]} of standard normal numbers w (d,): `errors` at N(w), exact far out too."""
        errors = {name: tol.from_normal(w[i]) for i, (name, tol) in enumerate(self._single())}
        return errors | self._of_groups(w, lambda group, part: group.from_normal(part))

    def _of_groups(self, point, draw):
        errors, position = {}, len(self.independent)
        for group in self.groups:
            drawn = draw(group, point[position : position + len(group.names)])
            errors |= {name: drawn[i] for i, name in enumerate(group.names)}
            position += len(group.names)
        return errors

    def half_widths(self) -> dict[str, Float[Array, ""]]:
        """{name: half-width [rad or m]}; for a correlated error k standard deviations, for one of a zone its reach."""
        widths = {name: tol.tolerance for name, tol in self._single()}
        for group in self.groups:
            widths |= dict(zip(group.names, group.half_widths(), strict=True))
        return widths

    def intervals(self) -> dict[str, tuple[Float[Array, ""], Float[Array, ""]]]:
        """{name: (low, high) [rad or m]}, the box; normal errors lie outside of it now and then."""
        centres, widths = self.centres(), self.half_widths()
        return {n: (centres[n] - widths[n], centres[n] + widths[n]) for n in self.names}

    def centres(self) -> dict[str, Float[Array, ""]]:
        """{name: middle of the interval [rad or m]}, which is the mean but for a `ProcessNormal` off its middle."""
        return self.means() | {name: tol.centre for name, tol in self._single()}

    def means(self) -> dict[str, Float[Array, ""]]:
        """{name: mean error [rad or m]}."""
        means = {name: tol.mean for name, tol in self._single()}
        for group in self.groups:
            means |= dict(zip(group.names, group.mean, strict=True))
        return means

    def covariance(self) -> Float[Array, "d d"]:
        """Covariance (d, d) of the errors [rad^2, m^2, rad m], in the order of `names`."""
        blocks = [tol.variance()[None, None] for _, tol in self._single()]
        blocks += [group.covariance for group in self.groups]
        return jax.scipy.linalg.block_diag(*blocks)

    def with_half_widths(self, half_widths: Mapping[str, ArrayLike]) -> "Tolerances":
        """The same distributions about the same centres with new half-widths {name: [rad or m]}.

        A correlated group keeps its correlations, a zone its shape. Names that are missing keep their width.
        Raises: InputError for unknown names.
        """
        check_known(half_widths, self.names, "half_widths")
        independent = {}
        for name, tol in self._single():
            width = checked_number(half_widths.get(name, tol.tolerance), "half_widths")
            independent[name] = eqx.tree_at(lambda t: t.tolerance, tol, width)
        groups = []
        for group in self.groups:
            old = dict(zip(group.names, group.half_widths(), strict=True))
            new = [jnp.asarray(half_widths.get(name, old[name])) for name in group.names]
            groups.append(group.scaled(jnp.stack(new) / group.half_widths()))
        number = len(self.correlated)
        return Tolerances(independent, correlated=groups[:number], zones=groups[number:])

    def require_units(self, problem: ToleranceProblem) -> None:
        """Raise InputError for an angle with a tolerance given as a length, or the other way round."""
        for name, tolerance in self._single():
            unit = problem.error_unit(name)
            if tolerance.unit not in (None, unit):
                raise InputError(
                    f"Argument `tolerances` must be in the units of the errors, but `{name}` is an "
                    f"{DIMENSIONS[unit]} [{unit}] and its tolerance is in {tolerance.unit}; correct its unit."
                )


def _distribution(one: SpecifiedTolerance) -> Tolerance:
    """The distribution of one error on its own."""
    if one.cp is not None:
        return ProcessNormal(interval=one.interval, cp=one.cp, cpk=one.cpk, side=one.side or "upper")
    settings = {} if one.deviations is None else {"deviations": one.deviations}
    return DISTRIBUTIONS[one.distribution](interval=one.interval, **settings)


def _odd(w, half):
    """The odd function of w that is half(w) for w >= 0."""
    return jnp.where(w >= 0.0, half(jnp.abs(w)), -half(jnp.abs(w)))


def distributions_of(tolerances: Any) -> Any:
    """`Tolerances` of a study or of what it specifies; anything else as it is."""
    return Tolerances.of(tolerances) if isinstance(tolerances, (Study, SpecifiedTolerances)) else tolerances


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
