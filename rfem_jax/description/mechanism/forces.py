"""Forces along the free motions of joints: springs with dampers, friction, laws of the joint's own position and rate.

Place in the pipeline: `Mechanism` holds them; the mechanics evaluates them inside compiled code.

A force acts on one free motion of a joint of the tree, which is about or along one axis: a moment [N m] about it or a
force [N] along it, of the parent on the child, positive as the joint's coordinate, and the opposite one on the parent.
A spring is part of its joint and of the joint's load; a law acts beside the joint, as a drive does, and is not.
Friction is part of its joint, too, and acts at cut joints as well.
Source: theory (3.14) to (3.17); of friction (12.1) to (12.5).
"""

import abc
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from rfem_jax.description.basics.errors import Checks, ChecksItself, InputError, require_choice, require_name
from rfem_jax.description.basics.joint_kinds import KINDS, Freedom
from rfem_jax.description.basics.numbers import ANY, NOT_NEGATIVE, POSITIVE, Fields, NumberTree, is_known, read_number
from rfem_jax.description.basics.own_functions import as_tree, checked_function
from rfem_jax.description.basics.units import Quantities, Quantity, sequence
from rfem_jax.description.drives.driven_motions import plain_motion
from rfem_jax.description.mechanism.joints import Joint

if TYPE_CHECKING:
    Law = Callable[[Any, Any], Any]
else:
    Law = Any  # checked in `_check_fields`, with a sentence, and not by its type


FRICTION_LAWS = ("tanh", "brown_mcphee")
FRICTION_KINDS = ("revolute", "prismatic", "cylindrical")


class Force(abc.ABC, NumberTree):
    """A force that a mechanism holds: along joints, or at points of links (`point_forces`)."""

    numbers: ClassVar[Fields] = {}
    name: str


class JointForce(Force):
    """A force along one free motion of a joint of the tree."""

    joint: str
    motion: str | None

    @abc.abstractmethod
    def resolved(self, joint: Joint) -> "JointForce":
        """The force with numbers in SI units, and the name of its motion, on its joint; raises InputError if something
        does not fit the joint."""

    def numbers_along(self, freedom: Freedom) -> Fields:
        """Its numbers, whose dimensions are those along a coordinate of a joint."""
        del freedom
        return self.numbers

    def coordinate(self, joint: Joint) -> int:
        """Index of the motion among the coordinates of its joint."""
        motions = KINDS[joint.kind].motions
        return motions.index(_motion_of(self, joint))


@dataclass(frozen=True)
class JointSpring(ChecksItself, JointForce):
    """A spring with a damper: preload - stiffness * (position - rest) - damping * rate.

    Args:
        name: a word.
        joint: name of a joint that is not cut.
        stiffness: [N m/rad] about an axis, [N/m] along one, >= 0.
        damping: [N m s/rad], [N s/m], >= 0.
        rest: position [rad, m] at which the spring exerts its preload.
        preload: moment [N m] or force [N] at the position `rest`.
        motion: which free motion of the joint, as "R_y" or "T_x" (a rotation about y, a translation along x); None =
            the joint's only one.
    Raises:
        InputError: a value is out of range or of the wrong kind.
    """

    name: str
    joint: str
    stiffness: Quantity = 0.0
    damping: Quantity = 0.0
    rest: Quantity = 0.0
    preload: Quantity = 0.0
    motion: str | None = None

    def _check_fields(self, checks: Checks) -> None:
        _check_names(checks)

    def resolved(self, joint: Joint) -> "JointSpring":
        return replace(self, **_read_numbers(self, _freedom_of(self, joint)), motion=_motion_of(self, joint))

    def numbers_along(self, freedom: Freedom) -> Fields:
        return {
            "stiffness": (_dimension(freedom, "stiffness"), NOT_NEGATIVE),
            "damping": (_dimension(freedom, "damping"), NOT_NEGATIVE),
            "rest": (freedom.dimension, ANY),
            "preload": (_dimension(freedom, "force"), ANY),
        }


@dataclass(frozen=True)
class JointForceTable(ChecksItself, JointForce):
    """A force given at positions of its joint, linear in between and constant outside, as gas pressure over a stroke.

    Args:
        name: a word.
        joint: name of a joint that is not cut.
        positions: [rad] about an axis, [m] along one, increasing; at least two.
        forces: moments [N m] or forces [N], as many as positions.
        motion: which free motion of the joint, as "R_y" or "T_x" (a rotation about y, a translation along x); None =
            the joint's only one.
    Raises:
        InputError: a value is out of range or of the wrong kind.
    """

    name: str
    joint: str
    positions: Quantities
    forces: Quantities
    motion: str | None = None

    def _check_fields(self, checks: Checks) -> None:
        _check_names(checks)

    def resolved(self, joint: Joint) -> "JointForceTable":
        freedom = _freedom_of(self, joint)
        of = f"of force `{self.name}`"
        positions = sequence(self.positions, freedom.dimension, f"`positions` {of}")
        forces = sequence(self.forces, _dimension(freedom, "force"), f"`forces` {of}")
        if len(positions) < 2 or not all(np.diff(positions) > 0.0):
            raise InputError(
                f"Argument `positions` {of} must hold at least two positions, increasing, but was {list(positions)}; "
                "sort the table and give each position once."
            )
        if len(forces) != len(positions):
            raise InputError(
                f"Argument `forces` {of} must have as many entries as `positions` ({len(positions)}), but has "
                f"{len(forces)}; give one for each position."
            )
        return replace(self, positions=positions, forces=forces, motion=_motion_of(self, joint))


@dataclass(frozen=True)
class JointForceFunction(ChecksItself, JointForce):
    """A force given by a Python function written in JAX.

    Args:
        name: a word.
        joint: name of a joint that is not cut.
        function: (position [rad, m], rate [rad/s, m/s]) -> moment [N m] or force [N], a float64 scalar. It may
            close over what is differentiated; an `equinox.Module` that has it as arrays is compiled once for all
            values.
        motion: which free motion of the joint, as "R_y" or "T_x" (a rotation about y, a translation along x); None =
            the joint's only one.
    Raises:
        InputError: a value is of the wrong kind.
    """

    name: str
    joint: str
    function: Law
    motion: str | None = None

    def _check_fields(self, checks: Checks) -> None:
        _check_names(checks)
        where = f"`function` of force `{self.name}`"
        checks.convert("function", as_tree, where, "position and rate", "pass for example lambda q, v: -3.0 * q**3")
        if checks.passed("function"):
            checks.convert("function", checked_function, where, "position, rate", ("float64", "float64"))

    def resolved(self, joint: Joint) -> "JointForceFunction":
        _freedom_of(self, joint)
        return replace(self, motion=_motion_of(self, joint))


@dataclass(frozen=True)
class JointFriction(ChecksItself, JointForce):
    """Friction against one free motion of a joint: -(constant + coefficient * radius * N) * s(rate) - viscous * rate.

    N is the joint's normal load, the resultant of its force across the axis; for a bearing or a guide of a given length
    the sum of those at both ends, which misalignment moments press, too. Along an axis there is no radius. s is a
    smooth sign, so that a joint does not stick but creeps; at rest friction is exactly zero. Each motion of a
    cylindrical joint has its own friction. Load-dependent friction needs the implicit method.

    Args:
        name: a word.
        joint: name of a revolute, prismatic or cylindrical joint, cut or not.
        coefficient: of friction by the normal load, >= 0; None = friction does not depend on loads.
        radius: of the pin [m]; needed with `coefficient` for friction about an axis.
        length: of the bearing or the guide's shoe [m], centred on the joint's point on the child; None = moments
            across the axis do not press.
        constant: moment [N m] about an axis, force [N] along one, >= 0; None = none.
        viscous: [N m s/rad] about an axis, [N s/m] along one, >= 0.
        sliding_rate: of the smooth sign [rad/s, m/s], far below the rates of interest: "tanh" has 76 % of its friction
            there, "brown_mcphee" all; needed with `coefficient` or `constant`.
        law: the smooth sign, "tanh" or "brown_mcphee" (whose friction may be larger before sliding).
        static_coefficient: largest coefficient before sliding, >= `coefficient`, of "brown_mcphee"; None = the same.
        static_constant: largest constant before sliding, >= `constant`, of "brown_mcphee"; None = the same.
        load_scale: force [N] far below the loads of interest, below which the normal load is rounded off to be smooth
            at zero.
        motion: which free motion of the joint, as "R_y" or "T_x" (a rotation about y, a translation along x); None =
            the joint's only one.
    Raises:
        InputError: a value is out of range or of the wrong kind, missing, or not used.
    """

    name: str
    joint: str
    coefficient: Quantity | None = None
    radius: Quantity | None = None
    length: Quantity | None = None
    constant: Quantity | None = None
    viscous: Quantity = 0.0
    sliding_rate: Quantity | None = None
    law: str = "tanh"
    static_coefficient: Quantity | None = None
    static_constant: Quantity | None = None
    load_scale: Quantity = 1e-3
    motion: str | None = None

    def _check_fields(self, checks: Checks) -> None:
        _check_names(checks)
        checks.convert("law", require_choice, FRICTION_LAWS, f"`law` of force `{self.name}`")

    def resolved(self, joint: Joint) -> "JointFriction":
        if joint.clearance is not None:
            raise InputError(
                f"Argument `joint` of force `{self.name}` must have no clearance for friction about its axis, but "
                f"`{joint.name}` has one; give `friction` in its clearance, which acts at the contacts."
            )
        if joint.kind not in FRICTION_KINDS:
            raise InputError(
                f"Argument `joint` of force `{self.name}` must be revolute, prismatic or cylindrical, but "
                f"`{joint.name}` is {joint.kind}; take a damper, since this kind of joint has no friction."
            )
        freedom = _freedom_of(self, joint)
        self._check_what_is_given(freedom)
        if freedom.rotation and not joint.cut and any(motion[0] == "R" for motion in joint.sprung):
            raise InputError(
                f"Argument `joint` of force `{self.name}` must not tilt, or must be cut, for friction about its axis, "
                f"but the tilt of `{joint.name}` is sprung; leave `tilt` out of its compliance, or cut it."
            )
        found = _read_numbers(self, freedom)
        for name in ("coefficient", "constant"):
            static, sliding = found[f"static_{name}"], found[name]
            if static is not None and is_known(static, sliding) and static < sliding:
                raise InputError(
                    f"Argument `static_{name}` of force `{self.name}` must be at least `{name}` ({sliding:g}), but was "
                    f"{static:g}; friction does not grow with the rate, but for its viscous part."
                )
        return replace(self, **found, motion=_motion_of(self, joint))

    def numbers_along(self, freedom: Freedom) -> Fields:
        force = _dimension(freedom, "force")
        return {
            "coefficient": ("none", NOT_NEGATIVE),
            "radius": ("length", POSITIVE),
            "length": ("length", POSITIVE),
            "constant": (force, NOT_NEGATIVE),
            "viscous": (_dimension(freedom, "damping"), NOT_NEGATIVE),
            "sliding_rate": ("rate" if freedom.rotation else "speed", POSITIVE),
            "static_coefficient": ("none", NOT_NEGATIVE),
            "static_constant": (force, NOT_NEGATIVE),
            "load_scale": ("force", POSITIVE),
        }

    def _check_what_is_given(self, freedom: Freedom) -> None:
        """What needs another argument comes with it, and what nothing uses does not come."""
        of = f"of force `{self.name}`"
        loaded, sliding = self.coefficient is not None, self.coefficient is not None or self.constant is not None
        if sliding and self.sliding_rate is None:
            raise InputError(
                f"Argument `sliding_rate` {of} must be given with `coefficient` or `constant`, but is missing; give "
                "about a hundredth of the joint's RMS rate, as a run without friction shows it."
            )
        if loaded and freedom.rotation and self.radius is None:
            raise InputError(
                f"Argument `radius` {of} must be given with `coefficient` for friction about an axis, but is missing; "
                "give the radius of the pin."
            )
        needs = {
            "radius": loaded and freedom.rotation,
            "length": loaded,
            "sliding_rate": sliding,
            "static_coefficient": loaded and self.law == "brown_mcphee",
            "static_constant": self.constant is not None and self.law == "brown_mcphee",
        }
        with_what = {
            "radius": "`coefficient` and a rotation",
            "length": "`coefficient`",
            "sliding_rate": "`coefficient` or `constant`",
            "static_coefficient": '`coefficient` and the law "brown_mcphee"',
            "static_constant": '`constant` and the law "brown_mcphee"',
        }
        for name, used in needs.items():
            if getattr(self, name) is not None and not used:
                raise InputError(
                    f"Argument `{name}` {of} must be given with {with_what[name]}, but was given without and is not "
                    "used; leave it out, or give what it belongs to."
                )


def _read_numbers(force: JointForce, freedom: Freedom) -> dict[str, Any]:
    """The numbers of a force along a coordinate in SI units; None stays."""
    given = {name: (getattr(force, name), field) for name, field in force.numbers_along(freedom).items()}
    return {
        name: None if value is None else read_number(value, field, f"`{name}` of force `{force.name}`")
        for name, (value, field) in given.items()
    }


def _check_names(checks: Checks) -> None:
    checks.convert("name", require_name, "`name` of a force")
    if checks.passed("name"):  # in a joint's table both are made of the joint's name: one mistake is told once
        checks.convert("joint", require_name, f"`joint` of force `{checks.owner.name}`")


def _motion_of(force: JointForce, joint: Joint) -> str:
    """Name of the motion that a force acts on."""
    return plain_motion(force.motion, joint.kind, joint.name, f"force `{force.name}`")


def _freedom_of(force: JointForce, joint: Joint) -> Freedom:
    """The coordinate that a force acts on."""
    motion = _motion_of(force, joint)
    kind = KINDS[joint.kind]
    # Motions about any axis come last, so that those before have one coordinate each.
    return kind.freedoms[kind.motions.index(motion)]


def _dimension(freedom: Freedom, of: str) -> str:
    """Dimension of a force, a stiffness or a damping along a coordinate, or about it."""
    if not freedom.rotation:
        return of
    return "moment" if of == "force" else f"rotational_{of}"
