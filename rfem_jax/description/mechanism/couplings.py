"""Couplings between two joint coordinates: gears, racks, screws, belts, cams, ideal or by an elastic mesh.

Place in the pipeline: `Mechanism` holds them among its forces; the mechanics evaluates them inside compiled code.

The mesh is a spring with a damper on q_b - f(q_a), f a ratio or a table: it exerts a load along q_b, and along q_a the
opposite one times f', each between the parent and the child of its joint, beside what the joint itself carries. An
ideal coupling has no mesh: q_b = f(q_a) + offset is a constraint, and the load along q_b what it takes.
Source: theory (16.1) to (16.9).
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from rfem_jax.description.basics.errors import Checks, ChecksItself, InputError, require_flag, require_name
from rfem_jax.description.basics.joint_kinds import KINDS
from rfem_jax.description.basics.numbers import ANY, NOT_NEGATIVE, POSITIVE, Fields, read_number
from rfem_jax.description.basics.units import Quantities, Quantity, sequence
from rfem_jax.description.drives.driven_motions import plain_motion
from rfem_jax.description.mechanism.forces import Force
from rfem_jax.description.mechanism.joints import Joint

RATIOS = {  # dimension of b's coordinate over a's, by whether these turn
    (True, True): "none",
    (False, False): "none",
    (True, False): "length_per_angle",
    (False, True): "angle_per_length",
}
_TABLE = "positions", "values"
_OF_MESH = {"damping": 0.0, "backlash": None, "one_sided": False, "contact_damping": 0.0, "exponent": 1.0}


@dataclass(frozen=True)
class Coupling(ChecksItself, Force):
    """A coupling of the coordinates q_a and q_b of two joints: q_b = f(q_a) + offset, ideal or by an elastic mesh.

    f is a `ratio` times q_a: of a gear pair teeth_a / teeth_b, negative for an external pair, of bevel gears or a belt
    likewise; of a rack the pinion's radius, of a screw its lead ("5 mm/rev"), from a rotation to a translation. Or f is
    a smooth table of `positions` and `values`, as the lift of a cam. With g = q_b - f(q_a) - offset the load along q_b
    is -stiffness g - damping g', and along q_a the opposite one times f'. The part of tooth and belt forces across the
    joints' axes, which loads bearings, is not in it: give it as forces at points where it matters.

    Args:
        name: a word.
        joints: names of the joints of q_a and q_b, which are not cut; a screw in one cylindrical joint names it twice,
            with two `motions`.
        stiffness: of the mesh at q_b, > 0: [N m/rad] about an axis, [N/m] along one; with an `exponent` n other than 1
            in N m/rad^n or N/m^n, a plain number; None = ideal, a constraint without play or damping.
        ratio: dq_b / dq_a: a plain number between two rotations or two translations, [m/rad] from a rotation to a
            translation, [rad/m] the other way.
        positions: of a table instead: [rad, m] of q_a, increasing; at least three.
        values: [rad, m] of q_b at these. In between is a cubic spline with two continuous derivatives, beyond the ends
            a straight line.
        periodic: whether the table repeats from its last row, whose value is that of the first; else its ends are
            without curvature.
        damping: of the mesh at q_b, >= 0: [N m s/rad], [N s/m].
        offset: [rad, m] q_b - f(q_a) at which the perfect mesh is without load, or that an ideal coupling keeps;
            None = that of the start, about which the coupling then says nothing.
        backlash: [rad, m] play at q_b between the two flanks, >= 0; None = none, and the mesh pulls as it pushes.
        one_sided: whether it only pushes q_b, in its positive direction, as a cam without a groove.
        contact_damping: [s/rad, s/m] chi >= 0 of flanks that only push, with the force K d^n (1 + chi d'), in the place
            of `damping`.
        exponent: n of flanks that only push, from 1 to 3; above 1 the stiffness begins smoothly.
        pitch_error: [rad, m] deviation of q_a: f is taken at q_a + pitch_error.
        eccentricity: [rad, m] amplitude at q_b of a transmission error eccentricity * sin(waves * q_a + phase).
        eccentricity_phase: [rad] its phase.
        waves: of the transmission error in a turn of q_a, > 0; teeth_a / teeth_b for an eccentric gear b.
        motions: which free motions of the two joints, as ["R_y", "T_x"]; None = each joint's only one.
    Raises:
        InputError: a value is out of range or of the wrong kind, missing, or not used.
    """

    name: str
    joints: tuple[str, str]
    stiffness: Quantity | None = None
    ratio: Quantity | None = None
    positions: Quantities | None = None
    values: Quantities | None = None
    periodic: bool = False
    damping: Quantity = 0.0
    offset: Quantity | None = None
    backlash: Quantity | None = None
    one_sided: bool = False
    contact_damping: Quantity = 0.0
    exponent: Quantity = 1.0
    pitch_error: Quantity = 0.0
    eccentricity: Quantity = 0.0
    eccentricity_phase: Quantity = 0.0
    waves: Quantity = 1.0
    motions: tuple[str, str] | None = None

    def _check_fields(self, checks: Checks) -> None:
        checks.convert("name", require_name, "`name` of a coupling")
        if not checks.passed("name"):
            return
        of = f"of coupling `{self.name}`"
        checks.convert("joints", _two_names, f"`joints` {of}")
        if self.motions is not None:
            checks.convert("motions", _two_names, f"`motions` {of}")
        for name in ("periodic", "one_sided"):
            checks.convert(name, require_flag, f"`{name}` {of}")
        checks.convert("exponent", _exponent, f"`exponent` {of}")
        checks.relation(("ratio", *_TABLE, "periodic"), self._check_function)
        checks.relation(("stiffness", *_OF_MESH), self._check_flanks)

    @property
    def ideal(self) -> bool:
        """Whether it is a constraint, without a mesh that gives way."""
        return self.stiffness is None

    @property
    def coordinates(self) -> tuple[tuple[str, str], tuple[str, str]]:
        """Joint and motion of both coordinates; of a coupling that a mechanism has resolved."""
        assert self.motions is not None, "a mechanism names the motions"
        return (self.joints[0], self.motions[0]), (self.joints[1], self.motions[1])

    @property
    def flanks(self) -> bool:
        """Whether the mesh has flanks that only push, which may part."""
        return self.one_sided or self.backlash is not None

    @property
    def turns(self) -> tuple[bool, bool]:
        """Whether the two coordinates are rotations; of a coupling that a mechanism has resolved."""
        assert self.motions is not None, "a mechanism names the motions"
        return self.motions[0][0] == "R", self.motions[1][0] == "R"

    @property
    def numbers_between(self) -> Fields:
        """Its numbers; their dimensions follow from the two coordinates."""
        first, second = self.turns
        at, turn = ("angle" if second else "length"), "rotational_" if second else ""
        stiffness = f"{turn}stiffness" if self.exponent == 1.0 else "none"
        fields = {
            "stiffness": (stiffness, POSITIVE),
            "ratio": (RATIOS[first, second], ANY),
            "damping": (f"{turn}damping", NOT_NEGATIVE),
            "offset": (at, ANY),
            "backlash": (at, NOT_NEGATIVE),
            "contact_damping": (f"{turn}contact_damping", NOT_NEGATIVE),
            "pitch_error": ("angle" if first else "length", ANY),
        }
        if first:  # a wave needs a turn
            fields |= {"eccentricity": (at, ANY), "eccentricity_phase": ("angle", ANY), "waves": ("none", POSITIVE)}
        return fields

    def resolved(self, first: Joint, second: Joint) -> "Coupling":
        """The coupling with numbers in SI units and the names of its motions, on its two joints; raises InputError if
        something does not fit them."""
        of, given = f"coupling `{self.name}`", self.motions or (None, None)
        motions = [plain_motion(motion, one.kind, one.name, of) for motion, one in zip(given, (first, second))]
        if first is second and motions[0] == motions[1]:
            raise InputError(
                f"Argument `joints` of {of} must name two coordinates, but both are {motions[0]} of joint "
                f"`{first.name}`; name two joints, or two `motions` of one joint."
            )
        for motion, joint in zip(motions, (first, second)):
            if motion[0] == "R" and any(sprung[0] == "R" for sprung in joint.sprung):
                raise InputError(
                    f"Argument `joints` of {of} must not tilt where a rotation is coupled, but the tilt of "
                    f"`{joint.name}` is sprung; leave `tilt` out of its compliance, or its clearance."
                )
        named = replace(self, motions=(motions[0], motions[1]))
        found: dict[str, Any] = {}
        for name, field in named.numbers_between.items():
            if (value := getattr(self, name)) is not None:
                found[name] = read_number(value, field, f"`{name}` of {of}")
        if found.get("ratio") == 0.0:
            raise InputError(
                f"Argument `ratio` of {of} must not be 0, with which the second coordinate follows nothing, but was "
                f"{self.ratio}; give dq_b / dq_a, negative where they turn against each other."
            )
        if not named.turns[0] and self.eccentricity != 0.0:
            raise InputError(
                f"Argument `eccentricity` of {of} must be left out unless the first of its coordinates is a rotation, "
                f"but {motions[0]} of `{first.name}` is a translation; name the joint that turns first."
            )
        if self.positions is not None:
            found |= dict(zip(_TABLE, self._table(named.turns)))
        return replace(named, **found)

    def _table(self, turns: tuple[bool, bool]) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """Rows of the table in SI units."""
        of = f"of coupling `{self.name}`"
        positions, values = (
            sequence(given, "angle" if turn else "length", f"`{name}` {of}")  # pyright: ignore[reportArgumentType]
            for name, given, turn in zip(_TABLE, (self.positions, self.values), turns)
        )
        if len(positions) < 3 or not all(np.diff(positions) > 0.0):
            raise InputError(
                f"Argument `positions` {of} must hold at least three positions, increasing, but was "
                f"{list(positions)}; sort the table and give each position once."
            )
        if len(values) != len(positions):
            raise InputError(
                f"Argument `values` {of} must have as many entries as `positions` ({len(positions)}), but has "
                f"{len(values)}; give one for each position."
            )
        if self.periodic and abs(values[-1] - values[0]) > 1e-9 * max(map(abs, values)):
            raise InputError(
                f"Argument `values` {of} must end as it begins where the table is periodic, but begins with "
                f"{values[0]:g} and ends with {values[-1]:g}; repeat the first row one period later."
            )
        return positions, values

    def _check_function(self) -> None:
        """f is given once."""
        of, given = f"of coupling `{self.name}`", [name for name in _TABLE if getattr(self, name) is not None]
        if len(given) == 1:
            missing = _TABLE[given == ["positions"]]
            raise InputError(f"Argument `{missing}` {of} must be given with `{given[0]}`, but is missing; give both.")
        if (self.ratio is None) == (not given):
            raise InputError(
                f"Argument `ratio` {of} must be given, or else a table of `positions` and `values`, but "
                f"{'both are' if given else 'neither is'}; give one of the two."
            )
        if self.periodic and not given:
            raise InputError(f"Argument `periodic` {of} must be left out without a table, but was given; leave it out.")

    def _check_flanks(self) -> None:
        """What only flanks have comes with them, and the damper of a mesh without flanks does not."""
        of = f"of coupling `{self.name}`"
        for name, usual in _OF_MESH.items() if self.ideal else ():
            if getattr(self, name) != usual:
                raise InputError(
                    f"Argument `{name}` {of} must be left out without a `stiffness`, with which it is ideal, but was "
                    "given; give the stiffness of the mesh, too, or leave it out."
                )
        if self.one_sided and self.backlash is not None:
            raise InputError(
                f"Argument `backlash` {of} must be left out where `one_sided` is true, but was given, and one flank "
                "has no play; leave out one of the two."
            )
        unused = {"damping": 0.0} if self.flanks else {"contact_damping": 0.0, "exponent": 1.0}
        where, fix = ("with", "give `contact_damping`") if self.flanks else ("without", "give one of the two")
        for name, usual in unused.items():
            if getattr(self, name) != usual:
                raise InputError(
                    f"Argument `{name}` {of} must be left out {where} `backlash` or `one_sided`, but was given and is "
                    f"not used; leave it out, or {fix}."
                )

    def coordinate(self, side: int, joint: Joint) -> int:
        """Index of the motion among the coordinates of its first or second joint."""
        assert self.motions is not None, "a mechanism names the motions"
        return KINDS[joint.kind].motions.index(self.motions[side])


def _two_names(value: object, where: str) -> tuple[str, str]:
    if not isinstance(value, (list, tuple)) or len(value) != 2:
        raise InputError(f'Argument {where} must be a list of two names, but was {value!r}; write ["A", "B"].')
    first, second = (require_name(one, where) for one in value)
    return first, second


def _exponent(value: Any, where: str) -> float:
    """From 1 to 3."""
    exponent = read_number(value, ("none", POSITIVE), where)
    if not 1.0 <= exponent <= 3.0:
        raise InputError(f"Argument {where} must be from 1 to 3, but was {exponent:g}; 1.5 is that of Hertz.")
    return exponent
