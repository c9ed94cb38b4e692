"""Joints of several kinds between a parent (a link or the base) and a child link.

Place in the pipeline: joints connect the links of a mechanism; cut joints close its loops.

Frames: `position` and `orientation` place the joint's nominal frame F in the parent's frame (the
global frame for the base; the link frame, x along the beam, for a link); `child_position` and
`child_orientation` place the joint in the child's link frame. R = R_z R_y R_x.
Source: theory (2.3) to (2.6), (2.14) to (2.16).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

from rfem_jax.description.basics.errors import (
    Checks,
    ChecksItself,
    InputError,
    require_choice,
    require_flag,
    require_instance,
    require_name,
)
from rfem_jax.description.basics.joint_kinds import DEFAULT, KINDS, JointKind, require_kind
from rfem_jax.description.basics.numbers import ANY, Fields, Number, NumberTree, is_known, number, number_vector
from rfem_jax.description.mechanism.bearings import Bearing
from rfem_jax.description.mechanism.clearance import Clearance
from rfem_jax.description.mechanism.compliance import Compliance, SprungDirection

MODES = ("open", "crossed")


@dataclass(frozen=True)
class Joint(NumberTree, ChecksItself):
    """A joint that lets its child move relative to its parent as its kind says.

    Args:
        name: a word.
        parent: "base" or the name of a link.
        child: the name of a link other than the parent.
        position: (x, y, z) [m] in the parent's frame; None = the base's origin, or the link's end.
        orientation: angles (about x, y, z) [rad] in the parent's frame, R = R_z R_y R_x.
        child_position: (x, y, z) [m] in the child's frame; None = the child's origin for a joint of
            the tree, its far end for a cut joint.
        child_orientation: angles (about x, y, z) [rad] in the child's frame.
        angle: approximate start value [rad] of the angle of a kind that has one; a joint of the tree
            only, where None means 0 (a cut joint keeps None).
        cut: True if the joint closes a loop and is expressed by constraint equations.
        kind: "revolute" (about y), "prismatic" (along x), "cylindrical" (about and along y), "universal"
            (about the parent's y, then the child's z), "spherical", "planar" (along x and z, about y),
            "fixed" or "free".
        displacement: approximate start value [m] of the displacement of a kind that has one, as `angle`.
        start: approximate start values of a kind with several angles or displacements, in the order of
            its motions (universal: 2 angles; planar: x, z, angle; spherical: angles about x, y, z of
            R_z R_y R_x; free: x, y, z and these angles); None means zeros.
        compliance: springs and dampers in directions that the kind holds, a `Compliance`; None = rigid. All
            start values, errors and angles are those of the kind without springs.
        rate: initial rate [rad/s] of the angle of a kind that has one, of a simulation that starts as given; a joint of
            the tree only, whose angle no drive prescribes and no other joint determines. None: it follows from the
            rates of other joints, or is zero.
        speed: initial speed [m/s] of the displacement of a kind that has one, as `rate`.
        rates: initial rates of a kind with several angles or displacements, in the order of `start`, as `rate`;
            of a spherical or free joint the angular velocity about x, y, z of the joint's frame in its parent. Zeros
            may be of motions that follow from others.
        clearance: the play of the pin of a revolute joint in its bush, a `Clearance`, in the place of a compliance;
            None = none. Start values, errors and the angle are those of the joint without play.
        bearing: what it carries, a `Bearing`, for metrics of life and of loads against capacities; None = unknown.
        mode: how the loop of a cut joint closes at the start, if it has four joints, hinges or three of them and a
            slide: "open", with the driven joint and the one opposite to it on opposite sides of the diagonal of the two
            others, or with the larger displacement of the slide; or "crossed". None: as start values say.
    Raises:
        InputError: a value is out of range or of the wrong kind.
    """

    name: str
    parent: str
    child: str
    position: tuple[float, float, float] | None = None
    orientation: tuple[float, float, float] = (0.0, 0.0, 0.0)
    child_position: tuple[float, float, float] | None = None
    child_orientation: tuple[float, float, float] = (0.0, 0.0, 0.0)
    angle: float | None = None
    cut: bool = False
    kind: str = DEFAULT
    displacement: float | None = None
    start: tuple[float, ...] | None = None
    compliance: Compliance | None = None
    bearing: Bearing | None = None
    clearance: Clearance | None = None
    rate: float | None = None
    speed: float | None = None
    rates: tuple[float, ...] | None = None
    mode: str | None = None

    # But for start values and the rates of several motions, which are parameters only of some motions.
    numbers: ClassVar[Fields] = {
        "position": ("length", ANY),
        "orientation": ("angle", ANY),
        "child_position": ("length", ANY),
        "child_orientation": ("angle", ANY),
        "rate": ("rate", ANY),
        "speed": ("speed", ANY),
    }

    def _check_fields(self, checks: Checks) -> None:
        checks.convert("name", require_name, "`name` of a joint")
        of = f"of joint `{self.name}`"
        checks.convert("kind", _kind_name, f"`kind` {of}")
        checks.convert("parent", require_name, f"`parent` {of}")
        checks.convert("child", _child, of)
        checks.relation(("parent", "child"), self._check_child, of)
        checks.convert("cut", require_flag, f"`cut` {of}")
        for field in ("position", "orientation", "child_position", "child_orientation"):
            checks.convert(field, _vector, self.numbers[field][0], f"`{field}` {of}")
        for field, dimension in (("angle", "angle"), ("displacement", "length"), ("rate", "rate"), ("speed", "speed")):
            if getattr(self, field) is not None:
                checks.convert(field, number, dimension, f"`{field}` {of}")
        checks.relation(("kind", "cut"), self._check_cut, of)
        if checks.passed("kind", "cut"):
            self._set_start(checks, of)
            self._check_rates(checks, of)
        if self.mode is not None:
            checks.convert("mode", require_choice, MODES, f"`mode` {of}")
            checks.relation(("mode", "cut"), self._check_mode, of)
        if self.compliance is not None:
            write = 'write Compliance(radial="1e8 N/m").'
            checks.convert("compliance", require_instance, f"`compliance` {of}", Compliance, write)
            checks.relation(("kind", "cut", "compliance"), lambda: self.springs)
        if self.clearance is not None:
            write = 'write Clearance(radial="0.05 mm", length="20 mm", stiffness=1e10).'
            checks.convert("clearance", require_instance, f"`clearance` {of}", Clearance, write)
            checks.relation(("kind", "compliance", "clearance"), self._check_clearance, of)
        if self.bearing is not None:
            write = 'write Bearing(dynamic_capacity="4.6 kN").'
            checks.convert("bearing", require_instance, f"`bearing` {of}", Bearing, write)

    @property
    def springs(self) -> tuple[SprungDirection, ...]:
        """The springs of a compliant joint, in SI units."""
        if self.compliance is None:
            return ()
        return self.compliance.springs(KINDS[self.kind], self.cut, f"of joint `{self.name}`")

    @property
    def sprung(self) -> tuple[str, ...]:
        """Motions that the kind holds and that are sprung; with a clearance, whose contacts hold it, all of these."""
        if self.clearance is not None:
            kind = KINDS[self.kind]
            return (*(motion for motion in kind.directions if motion[0] == "T"), *kind.directions["tilt"])
        return tuple(motion for spring in self.springs for motion in spring.motions)

    def _check_clearance(self, of: str) -> None:
        if self.kind != "revolute":
            raise InputError(
                f"Argument `clearance` {of} must be left out because the joint is {self.kind}, but was given; a pin in "
                "a bush is a revolute joint: remove it, or change the kind."
            )
        if self.compliance is not None:
            raise InputError(
                f"Argument `clearance` {of} must be given or else `compliance`, but both are; the contacts of the "
                "clearance have stiffnesses of their own: remove the compliance."
            )

    def _check_mode(self, of: str) -> None:
        if not self.cut:
            raise InputError(
                f"Argument `mode` {of} must be left out because the joint is not cut, but was {self.mode!r}; it is how "
                "a loop closes: give it to the cut joint of the loop."
            )

    def _check_child(self, of: str) -> None:
        if self.parent == self.child:
            raise InputError(
                f"Argument `child` {of} must differ from its parent, but both are "
                f"`{self.child}`; name the two links that it joins."
            )

    def _check_cut(self, of: str) -> None:
        if self.cut and KINDS[self.kind].constraints == 0:
            raise InputError(
                f'Argument `kind` {of} must be another than "free" because the joint is cut, but was '
                '"free"; it would not join anything: leave the joint out.'
            )

    @property
    def start_values(self) -> tuple[Number, ...]:
        """Approximate start values of all coordinates of a joint of the tree, in the order of its motions."""
        kind = KINDS[self.kind]
        if _has_names(kind):
            given = [self.angle if one.rotation else self.displacement for one in kind.freedoms]
            return tuple(0.0 if value is None else value for value in given)
        return self.start or (0.0,) * len(kind.freedoms)

    def _set_start(self, checks: Checks, of: str) -> None:
        """Check `angle`, `displacement` and `start`, and set those that the kind has and that were left out."""
        kind = KINDS[self.kind]
        counts = {"angle": kind.angles, "displacement": kind.displacements}
        named = _has_names(kind)
        wanted = {field for field, count in counts.items() if count == 1} if named else {"start"}
        for field in ("angle", "displacement", "start"):
            value = getattr(self, field)
            if self.cut or field not in wanted:
                if value is not None:
                    checks.relation((field,), self._refuse_start, of, kind, field, value, sorted(wanted))
            elif field == "start":
                zeros = (0.0,) * len(kind.freedoms)
                checks.set(field, zeros if value is None else value, _start_values, kind, of)
            elif value is None:
                object.__setattr__(self, field, 0.0)

    def _check_rates(self, checks: Checks, of: str) -> None:
        """Check `rate`, `speed` and `rates`: those that the kind has, of a joint of the tree."""
        kind = KINDS[self.kind]
        counts = {"rate": kind.angles, "speed": kind.displacements}
        wanted = {field for field, count in counts.items() if count == 1} if _has_names(kind) else {"rates"}
        for field in ("rate", "speed", "rates"):
            value = getattr(self, field)
            if value is not None and (self.cut or field not in wanted):
                checks.relation((field,), self._refuse_start, of, kind, field, value, sorted(wanted))
            elif value is not None and field == "rates":
                checks.set(field, value, _rates, kind, of)

    @property
    def start_rates(self) -> tuple[Number | None, ...]:
        """Initial rates of all coordinates of a joint of the tree, in the order of its motions; None: not given."""
        kind = KINDS[self.kind]
        if _has_names(kind):
            return tuple(self.rate if one.rotation else self.speed for one in kind.freedoms)
        return self.rates or (None,) * len(kind.freedoms)

    def require_no_rate(self, motion: str) -> None:
        """Raise InputError if an initial rate is given of a motion that a drive prescribes."""
        kind = KINDS[self.kind]
        rate = self.start_rates[kind.motions.index(motion)]
        if rate is not None and not (is_known(rate) and rate == 0.0):
            raise InputError(
                f"Argument `{self.rate_field(motion.startswith('R'))}` of joint `{self.name}` must be left out where a "
                "drive prescribes this motion, and with it its rate, but was given; remove one of the two."
            )

    def rate_field(self, rotation: bool) -> str:
        """Name of the argument with the initial rate of a rotation or translation."""
        return ("rate" if rotation else "speed") if _has_names(KINDS[self.kind]) else "rates"

    def _refuse_start(self, of: str, kind: JointKind, field: str, value: object, wanted: Sequence[str]) -> None:
        if self.cut:
            reason, fix = "the joint is cut", f"a cut joint's {field} follows from closing the loop."
        else:
            reason = f"the joint is {kind.name}"
            fix = f"give {' and '.join(f'`{name}`' for name in wanted)}." if wanted else "it has no coordinate."
        raise InputError(f"Argument `{field}` {of} must be left out because {reason}, but was {value!r}; {fix}")


def _has_names(kind: JointKind) -> bool:
    """Whether the start of a kind is an angle, a displacement or both, and not a list."""
    return kind.angles <= 1 and kind.displacements <= 1


def _start_values(values: object, kind: JointKind, of: str) -> tuple[float, ...]:
    """A list of as many quantities as the kind has coordinates, each of its dimension."""
    return _of_each(values, kind, f"`start` {of}", [one.dimension for one in kind.freedoms])


def _rates(values: object, kind: JointKind, of: str) -> tuple[float, ...]:
    """A list of as many rates and speeds as the kind has coordinates."""
    return _of_each(values, kind, f"`rates` {of}", ["rate" if one.rotation else "speed" for one in kind.freedoms])


def _of_each(values: object, kind: JointKind, where: str, dimensions: Sequence[str]) -> tuple[float, ...]:
    freedoms = kind.freedoms
    if not isinstance(values, (list, tuple)) or len(values) != len(freedoms):
        raise InputError(
            f"Argument {where} must be a list of {len(freedoms)} numbers because the joint is {kind.name}, but was "
            f"{values!r}; write for example {[0.0] * len(freedoms)}."
        )
    entries = zip(values, dimensions, strict=True)
    return tuple(number(value, one, f"{where} (entry {n})") for n, (value, one) in enumerate(entries, 1))


def _kind_name(kind: object, where: str) -> str:
    return require_kind(kind, where).name


def _child(child: object, of: str) -> str:
    if child == "base":
        raise InputError(
            f"Argument `child` {of} must be a link, but was the base; make the base the parent and the link the child."
        )
    return require_name(child, f"`child` {of}")


def _vector(value: Any, dimension: str, where: str) -> tuple[float, float, float] | None:
    if value is None:
        return (0.0, 0.0, 0.0) if dimension == "angle" else None
    return number_vector(value, dimension, where)
