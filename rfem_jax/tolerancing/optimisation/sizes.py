"""Tolerances by their sizes: what allocation and optimisation find.

Place in the pipeline: bounds of an `allocate`, tolerances of an `optimise` -> **sizes** -> their requests and criteria.

    e = centre + M x,     x_i = t_j(i) z_i,     z in a product of unit balls

An error of its own has a half-width t, and its z lies in -1 ... 1. A zone of a drawing has one size t for several
errors, its diameter, and M is that of the zone of size 1 (`Zone`): its z lie in a ball, or in two. Errors of their own
come first, then those of zones, as in `Tolerances`.

Symbols: v sizes t, half-widths [rad, m] and diameters [m]; k errors e [rad, m], standard points z (n, k), j (k,) the
size of each coordinate.
"""

from collections.abc import Collection, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int
from scipy.linalg import block_diag

from rfem_jax.description.basics.errors import InputError, suggestion
from rfem_jax.description.study_file.study import Study
from rfem_jax.description.tolerances.tolerances import SpecifiedTolerances
from rfem_jax.description.tolerances.zones import CHARACTERISTICS, SpecifiedZone, is_zone
from rfem_jax.tolerancing.checks import check_variables
from rfem_jax.tolerancing.optimisation.starting_points import Region, spread_points
from rfem_jax.tolerancing.problems.distributions import Tolerance, Uniform
from rfem_jax.tolerancing.problems.joint_distributions import Zone
from rfem_jax.tolerancing.problems.named_tolerances import Tolerances
from rfem_jax.tolerancing.problems.problem import ToleranceProblem

Zones = Mapping[str, Zone] | Study | SpecifiedTolerances | Iterable[SpecifiedZone]


@dataclass(frozen=True, eq=False)
class Sizes:
    """Sizes (v) by name: of the errors `singles`, then of `zones` {name: zone of size 1}."""

    singles: tuple[str, ...]
    zones: dict[str, Zone]

    @property
    def names(self) -> tuple[str, ...]:
        """Names (v) of the sizes."""
        return (*self.singles, *self.zones)

    @property
    def errors(self) -> tuple[str, ...]:
        """Names (k) of the errors."""
        return (*self.singles, *(name for zone in self.zones.values() for name in zone.names))

    @property
    def owner(self) -> Int[np.ndarray, " k"]:
        """The size (k,) of each coordinate."""
        counts = [1] * len(self.singles) + [len(zone.names) for zone in self.zones.values()]
        return np.repeat(np.arange(len(counts)), counts)

    @property
    def matrix(self) -> Float[np.ndarray, "k k"]:
        """M (k, k)."""
        parts = (np.asarray(zone.matrix) for zone in self.zones.values())
        return np.asarray(block_diag(np.eye(len(self.singles)), *parts))

    @property
    def region(self) -> Region:
        """Where z lies: a box, or with zones the dimensions of balls."""
        balls = tuple(n for zone in self.zones.values() for n in zone.balls)
        return (1,) * len(self.singles) + balls if balls else "box"

    def spread(self, t: Float[np.ndarray, " v"]) -> Float[np.ndarray, " k"]:
        """The size (k,) of every coordinate."""
        return np.asarray(t)[self.owner]

    def coordinates(self, errors: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "n k"]:
        """x (n, k) of errors from the centre."""
        return np.linalg.solve(self.matrix, errors.T).T

    def reaches(self, t: Float[np.ndarray, " v"]) -> Float[np.ndarray, " k"]:
        """Largest magnitude (k,) of every error."""
        return np.concatenate(
            [
                t[: len(self.singles)],
                *(size * reach for size, reach in zip(t[len(self.singles) :], self._reaches(), strict=True)),
            ]
        )

    def _reaches(self) -> list[np.ndarray]:
        return [np.asarray(zone.half_widths()) for zone in self.zones.values()]

    def tolerances(self, t: Float[np.ndarray, " v"]) -> Tolerances | dict[str, float]:
        """The region of these sizes, as `worst_case` takes it."""
        widths = dict(zip(self.names, map(float, t), strict=True))
        if not self.zones:
            return widths
        zones = [zone.scaled(jnp.full(len(zone.names), widths[name])) for name, zone in self.zones.items()]
        uniform: Any = Uniform
        return Tolerances({name: uniform(widths[name]) for name in self.singles}, zones=zones)

    def standard(self, distribution: Tolerance, units: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "n k"]:
        """z (n, k) of points of the unit cube: errors of their own by a distribution of half-width 1, those of a zone
        uniform in its balls."""
        alone = len(self.singles)
        parts = [np.asarray(distribution.quantile(jnp.asarray(units[:, :alone])))]
        if self.zones:
            balls = tuple(n for zone in self.zones.values() for n in zone.balls)
            parts.append(spread_points(np.pad(units[:, alone:], ((0, 0), (0, 1))), balls))
        return np.concatenate(parts, axis=1)

    def deviations(self, distribution: Tolerance) -> Float[np.ndarray, " k"]:
        """Standard deviations (k,) of z."""
        single = float(jnp.sqrt(distribution.variance()))
        return np.concatenate(
            [
                np.full(len(self.singles), single),
                *(np.repeat([(n + 2.0) ** -0.5 for n in zone.balls], zone.balls) for zone in self.zones.values()),
            ]
        )


def sizes_of(problem: ToleranceProblem, names: Collection[str], zones: Zones | None, what: str) -> Sizes:
    """The sizes that are called so, errors of the problem or zones.

    Args: zones, those of a study, or {name: zone of size 1}; a position or coaxiality that is not among them is a disc
        of this diameter; what, argument that has the names.
    Raises: InputError for names of neither, for zones that need a length, and for an error that is in two of them.
    """
    known = unit_zones(zones)
    alone = [name for name in names if name not in known and not _is_new_zone(problem, name)]
    for name in alone:
        _require_size(problem, name, known, what)
    found = {
        name: known[name] if name in known else unit_zones([SpecifiedZone(name, 1.0)])[name]
        for name in names
        if name not in alone
    }
    sizes = Sizes(tuple(alone), found)
    check_variables([name for name in sizes.errors if name in problem.error_names], problem, what)
    for name in sizes.errors:
        if name not in problem.error_names:
            owner = next((zone for zone, one in found.items() if name in one.names), name)
            raise InputError(
                f"Argument `{what}` must name zones of joints that have their errors, but `{owner}` needs "
                f"`{name}`, which the problem does not have; {suggestion(name, problem.error_names)}"
            )
        if sizes.errors.count(name) > 1:
            raise InputError(
                f"Argument `{what}` must give every error one tolerance, but `{name}` is in two of them; leave one out."
            )
    return sizes


def unit_zones(zones: Zones | None) -> dict[str, Zone]:
    """{name: zone of size 1} of what a study or the user specifies."""
    if isinstance(zones, Mapping):
        return {str(name): zone for name, zone in zones.items()}
    specified = zones.tasks.tolerances if isinstance(zones, Study) else zones
    several = specified.zones if isinstance(specified, SpecifiedTolerances) else tuple(specified or ())
    return {one.name: Zone(one.errors, one.matrix() / one.diameter, one.balls) for one in several}


def _is_new_zone(problem: ToleranceProblem, name: Any) -> bool:
    return is_zone(name) and name not in problem.error_names


def _require_size(problem: ToleranceProblem, name: str, zones: Mapping[str, Zone], what: str) -> None:
    if name in problem.error_names:
        return
    owners = {error.rpartition(".")[0] for error in problem.error_names if error.endswith(".d_x")}
    possible = (
        *problem.error_names,
        *zones,
        *(f"{owner}.{one}" for owner in sorted(owners) for one in CHARACTERISTICS),
    )
    raise InputError(
        f"Argument `{what}` must name what the problem has, but `{name}` is not known; {suggestion(name, possible)}"
    )
