"""The tolerances of all errors of a study: their box, their distribution and its covariance.

Place in the pipeline: distributions, joint_distributions -> **named_tolerances** -> every study of this package.

Symbols: u (d,) point of the unit cube, one coordinate per error; w (d,) standard normal numbers, u = N(w).
Source: theory (10.1).
"""

from collections.abc import Iterable, Mapping
from typing import Any

import equinox as eqx
import jax.numpy as jnp
import jax.scipy.linalg
from jax.typing import ArrayLike
from jaxtyping import Array, Float

from rfem_jax.description.basics.errors import InputError
from rfem_jax.description.study_file.study import Study
from rfem_jax.description.tolerances.tolerances import SpecifiedTolerance, SpecifiedTolerances
from rfem_jax.tolerancing.checks import DIMENSIONS, check_known
from rfem_jax.tolerancing.problems.distributions import DISTRIBUTIONS, ProcessNormal, Tolerance
from rfem_jax.tolerancing.problems.joint_distributions import CorrelatedNormal, Zone, checked_number
from rfem_jax.tolerancing.problems.problem import ToleranceProblem


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


def distributions_of(tolerances: Any) -> Any:
    """`Tolerances` of a study or of what it specifies; anything else as it is."""
    return Tolerances.of(tolerances) if isinstance(tolerances, (Study, SpecifiedTolerances)) else tolerances
