"""Tolerance zones of drawings: position, coaxiality, parallelism, and the play of a fit, as errors of a joint.

Place in the pipeline: errors, units, iso_fits -> **zones** -> `tolerances`.

The axis of a joint (its local y axis) lies in a cylinder of diameter D about its nominal place. Its points at the ends
y = +- l/2 of the bearing lie in discs of radius D/2, each uniform in its own, and the errors follow from them:

    position, coaxiality with a length    d = (p_+ + p_-)/2,  delta_x = (p_+ - p_-)_z/l,  delta_z = -(p_+ - p_-)_x/l
    the same without a length             d_x, d_z in a disc of radius D/2; nothing is said of tilts
    parallelism, perpendicularity         delta_x, delta_z in a disc of radius D/l
    sphere (ball joints)                  d_x, d_y, d_z in a ball of radius D/2
    straightness of a link                bow_y, bow_z in a disc of radius D: a half-wave of the amplitude D just lies
                                          in a cylinder of the diameter D

A fit "25 H7/g6" in the place of a diameter is a cylinder of the largest clearance, in which the pin lies. Other zones
(between parallel planes or lines) are intervals of one error: give this error a tolerance of its own.

Symbols: diameter D and length l [m], p_+ and p_- [m], errors [m, rad].
Source: theory (10.18); ISO 1101:2017; ISO 286-1 for the clearance.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from rfem_jax.description.basics.errors import Checks, ChecksItself, InputError, require_choice
from rfem_jax.description.basics.iso_fits import clearance_fit
from rfem_jax.description.basics.units import DERIVED, positive_quantity
from rfem_jax.description.tolerances.error_catalogue import BOWS

STRAIGHTNESS = "straightness"
CHARACTERISTICS = ("position", "coaxiality", "parallelism", "perpendicularity", STRAIGHTNESS)
OF_DIRECTION = CHARACTERISTICS[2:4]
SHAPES = ("cylinder", "sphere")


@dataclass(frozen=True)
class SpecifiedZone(ChecksItself):
    """The tolerance zone of a joint's axis or centre.

    Args:
        name: the seat or bore and the characteristic: "D.position", "D.child.position", "D.coaxiality",
            "D.parallelism" or "D.perpendicularity"; or a link and "straightness".
        diameter: D of the zone [m]; this or else `fit`.
        zone: its shape, "cylinder" or "sphere" (position alone).
        length: l of the bearing [m], over which the axis lies in the cylinder; None, for a position: tilts are not
            limited, and not errors of this zone.
        fit: hole and shaft, as "25 H7/g6"; the diameter is the largest clearance.
    Raises: InputError for names, numbers or settings that are out of range or do not fit each other.
    """

    name: str
    diameter: float = DERIVED
    zone: str = "cylinder"
    length: float | None = None
    fit: str | None = None

    def _check_fields(self, checks: Checks) -> None:
        where = f"of the zone `{self.name}`"
        checks.convert("name", _zone_name)
        checks.convert("zone", require_choice, SHAPES, f"`zone` {where}")
        if (self.diameter is None) == (self.fit is None):
            found = "neither is" if self.fit is None else "both are"
            checks.found.append(
                f"Argument `diameter` {where} must be given or else `fit`, but {found}; keep one of them."
            )
        if self.diameter is not None:
            checks.convert("diameter", positive_quantity, "length", f"`diameter` {where}")
        if self.fit is not None:
            checks.relation(("fit",), self._largest_clearance, where)
        if self.length is not None:
            checks.convert("length", positive_quantity, "length", f"`length` {where}")
        checks.relation(("name", "zone", "length"), self._fitting, where)

    def _largest_clearance(self, where: str) -> None:
        clearance = clearance_fit(self.fit or "", f"fit` {where[:-1]}").clearance
        if self.diameter is None:
            object.__setattr__(self, "diameter", clearance[1])

    def _fitting(self, where: str) -> None:
        if self.characteristic == STRAIGHTNESS and self.length is not None:
            raise InputError(
                f"Argument `length` {where} must be left out, since a straightness is of all of a link, but was given; "
                "remove it."
            )
        if self.zone == "sphere" and (self.characteristic != "position" or self.length is not None):
            raise InputError(
                f'Argument `zone` {where} must be "cylinder" for what has a direction, but is "sphere"; a sphere is '
                "for a position without length."
            )
        if self.characteristic in OF_DIRECTION and self.length is None:
            raise InputError(
                f"Argument `length` {where} must be given, since a direction has a tolerance over a length, but is "
                "missing; add the length of the bearing."
            )

    @property
    def characteristic(self) -> str:
        """The last part of the name."""
        return self.name.rpartition(".")[2]

    @property
    def errors(self) -> tuple[str, ...]:
        """Names of the errors, in the order of the matrix."""
        owner = self.name.rpartition(".")[0]
        if self.characteristic == STRAIGHTNESS:
            return tuple(f"{owner}.{name}" for name in BOWS)
        if self.characteristic in OF_DIRECTION:
            names: tuple[str, ...] = ("delta_x", "delta_z")
        elif self.zone == "sphere":
            names = ("d_x", "d_y", "d_z")
        else:
            names = ("d_x", "d_z") if self.length is None else ("d_x", "d_z", "delta_x", "delta_z")
        return tuple(f"{owner}.{name}" for name in names)

    @property
    def balls(self) -> tuple[int, ...]:
        """Dimensions of the unit balls that the matrix maps to the errors."""
        return {2: (2,), 3: (3,), 4: (2, 2)}[len(self.errors)]

    def matrix(self) -> Float[np.ndarray, "d d"]:
        """M (d, d) [m, rad] of the errors e = M y, y in the balls; with a length y = (p_+, p_-)/(D/2)."""
        radius = 0.5 * self.diameter
        if self.characteristic == STRAIGHTNESS:
            return self.diameter * np.eye(2)
        if self.characteristic in OF_DIRECTION:
            return 2.0 * radius / _given(self.length) * np.eye(2)
        if self.length is None or self.zone == "sphere":
            return radius * np.eye(len(self.errors))
        tilt = 1.0 / self.length
        rows = [[0.5, 0.0, 0.5, 0.0], [0.0, 0.5, 0.0, 0.5], [0.0, tilt, 0.0, -tilt], [-tilt, 0.0, tilt, 0.0]]
        return radius * np.array(rows)

    def half_widths(self) -> dict[str, float]:
        """{error: largest magnitude in the zone [m or rad]}."""
        starts = np.cumsum((0, *self.balls[:-1]))
        reach = np.sqrt(np.add.reduceat(self.matrix() ** 2, starts, axis=1)).sum(axis=1)
        return dict(zip(self.errors, map(float, reach), strict=True))


def is_zone(name: object) -> bool:
    """Whether a name of the table [tolerances] is of a zone, not of an error."""
    return str(name).rpartition(".")[2] in CHARACTERISTICS


def _zone_name(name: object) -> str:
    owner, _, characteristic = str(name).rpartition(".")
    if not owner or characteristic not in CHARACTERISTICS:
        raise InputError(
            f"Argument `name` of a zone must be a joint, or a link for straightness, a dot and one of "
            f'{", ".join(CHARACTERISTICS)}, but was {name!r}; write for example "D.position".'
        )
    return str(name)


def _given(length: float | None) -> float:
    assert length is not None, "checked"
    return length
