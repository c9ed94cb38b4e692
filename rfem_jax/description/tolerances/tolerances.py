"""Tolerances as a user specifies them: which errors vary, how far, and how they are distributed.

Place in the pipeline: the table [tolerances] of a study file; `tasks` holds it, `report` makes the
distributions of `rfem_jax.tolerancing.problems.named_tolerances` of it.

Symbols: half-widths t and centres c of errors in m and rad; deviations k [1], standard deviations
that a half-width holds (3 unless specified); correlation C [1].
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from rfem_jax.description.basics.errors import (
    ABSENT,
    Checks,
    ChecksItself,
    InputError,
    Problems,
    located,
    require_choice,
)
from rfem_jax.description.basics.iso_fits import clearance_fit, is_fit
from rfem_jax.description.basics.iso_fits import deviations as deviations_of_code
from rfem_jax.description.basics.tables import build, checked_list, checked_table, keys_of, read_table, require_table
from rfem_jax.description.basics.units import DERIVED, Quantity, positive_quantity, quantity
from rfem_jax.description.tolerances.error_catalogue import error_dimension, knows_dimension
from rfem_jax.description.tolerances.zones import CHARACTERISTICS, SpecifiedZone, is_zone

DISTRIBUTIONS = ("uniform", "triangular", "normal", "truncated_normal")
NORMAL = ("normal", "truncated_normal")


@dataclass(frozen=True)
class SpecifiedTolerance(ChecksItself):
    """One error on its own, within centre +- half_width.

    Args:
        error: its name.
        half_width: t [rad or m], > 0; this or else `interval`.
        distribution: "uniform", "triangular", "normal" or "truncated_normal".
        interval: (low, high) [rad or m].
        deviations: k, standard deviations in a half-width of the normal ones; None = 3.
        iso: size in mm and ISO code of a length, as "20 h9", which gives the interval; of a radial clearance that of a
            fit, as "20 H7/f7", about the middle that the description's `radial` has by the same code.
        cp: process capability, the interval's width over 6 standard deviations; the distribution is normal.
        cpk: the same of the limit that the mean is nearer to, at most cp; None = cp, a mean in the middle.
        side: "upper" or "lower", the limit that the mean is nearer to; None = "upper".
    Raises: InputError for names, numbers or settings that are out of range or do not fit each other.
    """

    error: str
    half_width: float = DERIVED
    distribution: str = "uniform"
    interval: tuple[float, float] = DERIVED
    deviations: float | None = None
    iso: str | None = None
    cp: float | None = None
    cpk: float | None = None
    side: str | None = None

    def _check_fields(self, checks: Checks) -> None:
        where = f"of the tolerance `{self.error}`"
        checks.convert("distribution", require_choice, DISTRIBUTIONS, f"`distribution` {where}")
        given = [one for one in (self.half_width, self.interval, self.iso) if one is not None]
        if len(given) != 1:
            found = ("neither is", "", "both are", "all are")[len(given)]
            checks.found.append(
                f"Argument `half_width` {where} must be given or else `interval` or `iso`, but {found}; keep one of "
                "them."
            )
        if self.half_width is not None:
            checks.convert("half_width", _half_width, self.error, f"`half_width` {where}")
        if self.interval is not None:
            checks.convert("interval", _interval, self.error, where)
        if self.iso is not None:
            checks.relation(("iso",), self._interval_of_code, where)
        checks.relation(("distribution",), self._check_deviations, where)
        for name in ("cp", "cpk"):
            if getattr(self, name) is not None:
                checks.convert(name, positive_quantity, "none", f"`{name}` {where}")
        if self.side is not None:
            checks.convert("side", require_choice, ("upper", "lower"), f"`side` {where}")
        checks.relation(("cp", "cpk", "distribution"), self._check_capability, where)
        if self.deviations is not None:
            checks.convert("deviations", positive_quantity, "none", f"`deviations` {where}")
        checks.refuse()
        if self.cp is not None:
            object.__setattr__(self, "distribution", "normal")
            object.__setattr__(self, "deviations", 3.0 * self.cp)
        if self.deviations is None and self.distribution in NORMAL:
            object.__setattr__(self, "deviations", 3.0)
        ends = (-self.half_width, self.half_width) if self.interval is None else self.interval
        object.__setattr__(self, "interval", ends)
        object.__setattr__(self, "half_width", 0.5 * (ends[1] - ends[0]))

    def _interval_of_code(self, where: str) -> None:
        with located("[tolerances]"):
            dimension = error_dimension(self.error)
        if dimension != "length":
            raise InputError(f"Argument `iso` {where} must be of a length, but this is an angle; give `half_width`.")
        ends = self._ends_of_code(self.iso or "", f"iso` {where[:-1]}")
        if self.interval is None:
            object.__setattr__(self, "interval", ends)

    def _ends_of_code(self, code: str, where: str) -> tuple[float, float]:
        if not is_fit(code):
            return deviations_of_code(code, where)
        if not self.error.endswith(".clearance.radial"):
            raise InputError(
                f"Argument `{where}` must be one size, since `{self.error}` is not a radial clearance, but {code!r} is "
                "a "
                'fit; write for example "25 H7".'
            )
        half = clearance_fit(code, where).radial[1]
        return -half, half

    def _check_capability(self, where: str) -> None:
        """See that a capability is given whole and alone; a study that was read has its distribution by it."""
        if self.cp is None and (self.cpk is not None or self.side is not None):
            raise InputError(
                f"Argument `cp` {where} must be given with `cpk` and `side`, but is missing; add it, since the "
                "standard deviation follows from it."
            )
        if self.cp is None:
            return
        if self.cpk is not None and self.cpk > self.cp:
            raise InputError(
                f"Argument `cpk` {where} must be at most cp, but is {self.cpk:g} with cp = {self.cp:g}; swap them."
            )
        if self.distribution not in ("uniform", "normal") or self.deviations not in (None, 3.0 * self.cp):
            raise InputError(
                f"Argument `cp` {where} must stand without `distribution` and `deviations`, which follow from it, but "
                "one is given; remove it."
            )

    def _check_deviations(self, where: str) -> None:
        if self.deviations is not None and self.distribution not in NORMAL and self.cp is None:
            raise InputError(
                f"Argument `deviations` {where} must be left out unless the distribution is "
                f'normal, but it is "{self.distribution}"; remove it.'
            )


def _half_width(width: Quantity, error: object, where: str) -> float:
    with located("[tolerances]"):
        dimension = error_dimension(error)
    return positive_quantity(width, dimension, where)


def _interval(interval: Any, error: str, where: str) -> tuple[float, float]:
    if not isinstance(interval, (list, tuple)) or len(interval) != 2:
        raise InputError(
            f"Argument `interval` {where} must be a pair [low, high], but was {interval!r}; "
            'write for example ["-0.1 mm", "0.3 mm"].'
        )
    low, high = (error_quantities({error: end}, "interval")[error] for end in interval)
    if not low < high:
        raise InputError(
            f"Argument `interval` {where} must rise from low to high, but was {interval!r}; swap or correct its ends."
        )
    return low, high


@dataclass(frozen=True)
class CorrelatedTolerances(ChecksItself):
    """Several normal errors that vary together.

    Args:
        half_widths: {error: k standard deviations} [rad or m], two or more.
        correlation: a number for every pair, or a matrix in the order of the errors.
        deviations: k, standard deviations in a half-width.
    Raises: InputError for wrong shapes and a correlation that is not positive definite.
    """

    half_widths: dict[str, float]
    correlation: tuple[tuple[float, ...], ...]
    deviations: float = 3.0

    def _check_fields(self, checks: Checks) -> None:
        where = "of correlated tolerances"
        checks.convert("half_widths", _half_widths, where)
        count = len(self.half_widths) if checks.passed("half_widths") else None
        checks.convert("correlation", _correlation, count, where)
        checks.convert("deviations", positive_quantity, "none", f"`deviations` {where}")

    def covariance(self) -> Float[np.ndarray, "errors errors"]:
        """Covariance (d, d) of the errors [rad^2, m^2, rad m], in their order."""
        sigma = np.array(list(self.half_widths.values())) / self.deviations
        return np.array(self.correlation) * np.outer(sigma, sigma)


@dataclass(frozen=True)
class SpecifiedTolerances(ChecksItself):
    """All tolerances of a study, every error once."""

    independent: tuple[SpecifiedTolerance, ...] = ()
    correlated: tuple[CorrelatedTolerances, ...] = ()
    zones: tuple[SpecifiedZone, ...] = ()

    def _check_fields(self, checks: Checks) -> None:
        names = self.names
        twice = dict.fromkeys(name for index, name in enumerate(names) if name in names[:index])
        for found in [f"`{name}` occurs twice" for name in twice] if names else ["no error is named"]:
            checks.found.append(
                f"Argument `tolerances` must name every error once, but {found}; "
                "give each error one tolerance, alone, in one group or in one zone."
            )

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the errors: the independent ones, then the groups', then the zones'."""
        alone = tuple(one.error for one in self.independent)
        groups = tuple(name for group in self.correlated for name in group.half_widths)
        return alone + groups + tuple(name for zone in self.zones for name in zone.errors)

    def half_widths(self) -> dict[str, float]:
        """{error: half-width [rad or m]}."""
        widths = {one.error: one.half_width for one in self.independent}
        for group in self.correlated:
            widths |= group.half_widths
        for zone in self.zones:
            widths |= zone.half_widths()
        return widths

    def sizes(self) -> dict[str, float]:
        """{error: half-width [rad or m], zone: diameter [m]}."""
        return self.half_widths() | {zone.name: zone.diameter for zone in self.zones}

    def reaches(self) -> dict[str, float]:
        """{error: largest magnitude [rad or m] that its interval or half-width has}."""
        widths = self.half_widths()
        return widths | {one.error: max(map(abs, one.interval)) for one in self.independent}


def read_tolerances(table: object) -> SpecifiedTolerances:
    """The tolerances of the table [tolerances]. Raises: InputError for unknown keys and bad values."""
    place = "[tolerances]"
    checked = require_table(table, place)
    alone: list[SpecifiedTolerance] = []
    groups: list[CorrelatedTolerances] = []
    zones: list[SpecifiedZone] = []
    problems = Problems()
    for name, entry in checked.items():
        if name == "correlated":
            continue
        with problems.noted():
            if is_zone(name):
                zones.append(_read_zone(name, entry, place))
            else:
                alone.append(_read_tolerance(name, entry, place))
    header = "[[tolerances.correlated]]"
    with problems.noted():
        for entry in checked_list(checked.get("correlated", []), header):
            with problems.noted():
                groups.append(read_table(CorrelatedTolerances, entry, header))
    problems.refuse()
    with located(place):
        return SpecifiedTolerances(tuple(alone), tuple(groups), tuple(zones))


def _read_tolerance(error: str, entry: object, place: str) -> SpecifiedTolerance:
    problems = Problems()
    with problems.noted(), located(place):
        error_dimension(error, CHARACTERISTICS)
    known = not problems.found
    settings = entry if isinstance(entry, dict) else {"half_width": entry}
    settings = checked_table(settings, f"{place} `{error}`", *keys_of(SpecifiedTolerance, ("error",)), problems)
    if not known:  # nor the unit of its values
        settings = settings | {key: ABSENT for key in ("half_width", "interval") if key in settings}
    return build(SpecifiedTolerance, {"error": error, **settings}, place, problems)


def _read_zone(name: str, entry: object, place: str) -> SpecifiedZone:
    problems = Problems()
    settings = entry if isinstance(entry, dict) else {"diameter": entry}
    settings = checked_table(settings, f"{place} `{name}`", *keys_of(SpecifiedZone, ("name",)), problems)
    return build(SpecifiedZone, {"name": name, **settings}, place, problems)


def error_quantities(values: object, where: str) -> dict[str, float]:
    """{error: number or string with a unit} in rad and m. Raises InputError."""
    if not isinstance(values, dict):
        raise InputError(
            f"Argument `{where}` must be a table of errors and values, but was {values!r}; "
            'write for example { "D.delta_x" = "0.5 deg" }.'
        )
    found, problems = {}, Problems()
    for name, value in values.items():
        with problems.noted():
            if isinstance(value, float) and not knows_dimension(name):
                found[name] = value  # of a parameter, read before; that it exists is checked with the mechanism
                continue
            with located(f"`{where}`"):
                dimension = error_dimension(name)
            found[name] = quantity(value, dimension, f"`{name}` of `{where}`")
    problems.refuse()
    return found


def _half_widths(widths: Any, where: str) -> dict[str, float]:
    if not isinstance(widths, dict) or len(widths) < 2:
        raise InputError(
            f"Argument `half_widths` {where} must be a table of two errors or more, but was "
            f'{widths!r}; write {{ "D.d_x" = "0.1 mm", "D.d_z" = "0.1 mm" }}.'
        )
    found = error_quantities(widths, "half_widths")
    problems = Problems()
    for name, width in found.items():
        with problems.noted():
            positive_quantity(width, "none", f"`{name}` {where}")
    problems.refuse()
    return found


def _correlation(correlation: Any, d: int | None, where: str) -> tuple[tuple[float, ...], ...]:
    """Rows of the correlation of d errors (None where these are wrong: of as many as a matrix has rows)."""
    if d is None:
        d = max(len(correlation), 2) if isinstance(correlation, (list, tuple)) else 2
    if isinstance(correlation, (int, float)) and not isinstance(correlation, bool):
        matrix = np.full((d, d), float(correlation))
        np.fill_diagonal(matrix, 1.0)
    else:
        try:
            matrix = np.array(correlation, dtype=float)
        except (TypeError, ValueError):
            matrix = np.zeros(0)
    shaped = matrix.shape == (d, d) and bool(np.all(np.isfinite(matrix)))
    proper = shaped and np.all(np.diag(matrix) == 1.0) and np.all(matrix == matrix.T)
    if not proper or np.linalg.eigvalsh(matrix)[0] <= 1e-12:
        raise InputError(
            f"Argument `correlation` {where} must be a number or a symmetric positive definite "
            f"matrix of {d} rows with ones on its diagonal, but was {correlation!r}; write 0.5 for "
            "example."
        )
    rows: Any = matrix.tolist()
    return tuple(tuple(row) for row in rows)
