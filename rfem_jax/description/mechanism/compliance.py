"""Compliance of joints: springs and dampers in directions that a joint's kind holds, as in bearings and bushings.

Place in the pipeline: a `Joint` holds it; `mechanics` makes coordinates of the sprung directions.

Displacements are those of the child's point of the joint in the axes of the joint's frame on the parent (errors
included), the tilt is the angle between the two axes; force and reaction act at the child's point. Source: theory
(13.1) to (13.5).
"""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from rfem_jax.description.basics.errors import InputError, Problems, suggestion
from rfem_jax.description.basics.joint_kinds import JointKind
from rfem_jax.description.basics.numbers import NumberTree, is_known, non_negative_number, positive_number
from rfem_jax.description.basics.units import Quantity, sequence

if TYPE_CHECKING:
    Stiffness = Quantity | Mapping[str, Any] | None
else:
    Stiffness = Any  # what is no stiffness is refused in a sentence


_DAMPING = "_damping"


@dataclass(frozen=True)
class SprungDirection(NumberTree):
    """A spring of a joint: its name, the motions that it acts on, stiffness [N/m, N m/rad] or a table (positions
    [m, rad], forces [N, N m]) of both senses, and damping [N s/m, N m s/rad]."""

    name: str
    motions: tuple[str, ...]
    stiffness: float
    damping: float
    positions: tuple[float, ...] | None = None
    forces: tuple[float, ...] | None = None

    @property
    def rotation(self) -> bool:
        """Whether it is a rotation."""
        return self.motions[0][0] == "R"


@dataclass(frozen=True)
class Compliance(NumberTree):
    """Stiffness and damping of a joint in directions that its kind holds; a direction that is left out stays rigid.

    A stiffness is a number, or a table { positions = [...], forces = [...] } of the force (moment) that displaces by a
    position (angle), linear in between and beyond its ends with the last stiffness, not decreasing: from 0, 0 and the
    same in both senses, or from negative to positive positions where the direction is one axis. Linear springs of
    "radial", "normal" and "tilt" are the same in all directions across the axis, and tables are over the resultant.

    Args:
        radial: [N/m] across the axis; of kinds without an axis (spherical, universal, fixed) in all directions.
        axial: [N/m] along the axis.
        normal: [N/m] across the axis of a prismatic joint.
        tilt: [N m/rad] of the angle between the axes of parent and child; of a universal joint the angle by which they
            are not perpendicular.
        roll: [N m/rad] about the axis of a prismatic joint.
        T_x: [N/m] along x of the joint's frame on the parent.
        T_y: [N/m] along y.
        T_z: [N/m] along z.
        R_x: [N m/rad] about x, of a fixed or prismatic joint; of several such rotations about axes that the ones before
            turn.
        R_y: [N m/rad] about y.
        R_z: [N m/rad] about z.
        radial_damping, axial_damping, normal_damping, T_x_damping, T_y_damping, T_z_damping: [N s/m] of a sprung
            direction.
        tilt_damping, roll_damping, R_x_damping, R_y_damping, R_z_damping: [N m s/rad] of a sprung direction.
    Raises:
        InputError: what is given is no stiffness or damping, when the joint is made.
    """

    radial: Stiffness = None
    axial: Stiffness = None
    normal: Stiffness = None
    tilt: Stiffness = None
    roll: Stiffness = None
    T_x: Stiffness = None
    T_y: Stiffness = None
    T_z: Stiffness = None
    R_x: Stiffness = None
    R_y: Stiffness = None
    R_z: Stiffness = None
    radial_damping: Quantity = 0.0
    axial_damping: Quantity = 0.0
    normal_damping: Quantity = 0.0
    tilt_damping: Quantity = 0.0
    roll_damping: Quantity = 0.0
    T_x_damping: Quantity = 0.0
    T_y_damping: Quantity = 0.0
    T_z_damping: Quantity = 0.0
    R_x_damping: Quantity = 0.0
    R_y_damping: Quantity = 0.0
    R_z_damping: Quantity = 0.0

    def springs(self, kind: JointKind, cut: bool, of: str) -> tuple[SprungDirection, ...]:
        """The springs of a joint of a kind; raises InputError if something does not fit it. `of`: "of joint `A`"."""
        problems, found = Problems(), []
        for name in (field.name for field in fields(self) if not field.name.endswith(_DAMPING)):
            stiffness, damping = getattr(self, name), getattr(self, name + _DAMPING)
            with problems.noted():
                if stiffness is not None or not is_known(damping) or damping != 0.0:
                    self._require_direction(kind, cut, name, of)
                    found.append(self._spring(name, kind.directions[name], stiffness, damping, of))
        problems.refuse()
        motions = [motion for spring in found for motion in spring.motions]
        twice = [motion for n, motion in enumerate(motions) if motion in motions[:n]]
        if twice:
            names = " and ".join(f"`{self._key(spring.name)}`" for spring in found if twice[0] in spring.motions)
            raise InputError(
                f"Argument `{self._table}` {of} must spring every direction once, but {names} both do so along or "
                f"about {twice[0][-1]}; leave one out."
            )
        if not found:
            raise InputError(
                f"Argument `{self._table}` {of} must spring a direction, but is empty; give one of "
                f"{', '.join(map(self._key, kind.directions))}, or leave it out."
            )
        return tuple(found)

    _table: ClassVar[str] = "compliance"  # what it is called where it is written

    @staticmethod
    def _key(direction: str) -> str:
        """Name of a direction where it is written."""
        return direction

    @staticmethod
    def _damping_key(direction: str) -> str:
        """Name of its damping where it is written."""
        return f"compliance.{direction}{_DAMPING}"

    def _require_direction(self, kind: JointKind, cut: bool, name: str, of: str) -> None:
        if not kind.directions:
            raise InputError(
                f"Argument `{self._table}` {of} must be left out because a {kind.name} joint holds nothing, but was "
                "given; remove it."
            )
        if name not in kind.directions:
            known = tuple(map(self._key, kind.directions))
            raise InputError(
                f"Argument `{self._table}` {of} must spring directions that a {kind.name} joint holds, but "
                f"`{self._key(name)}` is not one of them; {suggestion(self._key(name), known)}"
            )
        if cut and kind.angles == 0 and kind.directions[name][0][0] == "R":
            raise InputError(
                f"Argument `{self._table}` {of} must spring no rotation because the joint is {kind.name} and cut, but "
                f"has `{self._key(name)}`; cut another joint of the loop."
            )

    def _spring(self, name: str, motions: tuple[str, ...], stiffness: Any, damping: Any, of: str) -> SprungDirection:
        turns, key = "rotational_" if motions[0][0] == "R" else "", self._key(name)
        if stiffness is None:
            beside = self._damping_key(name).removeprefix(f"{self._table}.")
            raise InputError(
                f"Argument `{self._table}` {of} must have the stiffness `{key}` beside `{beside}`, but it is missing; "
                "give it."
            )
        what = f"{self._table}.{key}"
        where = f"`{what}` {of}"
        size = non_negative_number(damping, f"{turns}damping", f"`{self._damping_key(name)}` {of}")
        if not isinstance(stiffness, Mapping):
            return SprungDirection(name, motions, positive_number(stiffness, f"{turns}stiffness", where), size)
        if set(stiffness) != {"positions", "forces"}:
            raise InputError(
                f"Argument {where} must be a stiffness or a table with `positions` and `forces`, but was "
                f"{stiffness!r}; write {{ positions = [...], forces = [...] }}."
            )
        positions = sequence(stiffness["positions"], "angle" if turns else "length", f"`{what}.positions` {of}")
        forces = sequence(stiffness["forces"], "moment" if turns else "force", f"`{what}.forces` {of}")
        return SprungDirection(name, motions, 0.0, size, *_both_senses(positions, forces, len(motions) > 1, where))


class TablesByDirection(Compliance):
    """A Compliance that is written as two tables, `stiffness` and `damping`: its refusals name their keys."""

    _table: ClassVar[str] = "stiffness"

    @staticmethod
    def _key(direction: str) -> str:
        """As x for T_x and rx for R_x."""
        letter, _, axis = direction.partition("_")
        return {"T": axis, "R": f"r{axis}"}.get(letter, direction)

    @staticmethod
    def _damping_key(direction: str) -> str:
        return f"damping.{TablesByDirection._key(direction)}"

    @classmethod
    def keys(cls) -> dict[str, str]:
        """{key of both tables: name of the direction}."""
        return {cls._key(one.name): one.name for one in fields(cls) if not one.name.endswith(_DAMPING)}

    @classmethod
    def of(cls, stiffness: Mapping[str, Any], damping: Mapping[str, Any]) -> "TablesByDirection":
        """Return the Compliance of two tables whose keys are known."""
        names = cls.keys()
        return cls(
            **{names[key]: value for key, value in stiffness.items()},
            **{names[key] + _DAMPING: value for key, value in damping.items()},
        )


def _both_senses(
    positions: tuple[float, ...], forces: tuple[float, ...], resultant: bool, where: str
) -> tuple[tuple[float, ...], tuple[float, ...]]:
    """A table of both senses from one that begins with 0, 0; checked."""
    if len(positions) < 2 or len(positions) != len(forces):
        raise InputError(
            f"Argument {where} must have as many `forces` as `positions`, at least two, but has {len(forces)} and "
            f"{len(positions)}; give one for each position."
        )
    if not (all(np.diff(positions) > 0.0) and all(np.diff(forces) >= 0.0) and forces[-1] > forces[0]):
        raise InputError(
            f"Argument {where} must have increasing `positions` and `forces` that do not decrease, but has "
            f"{list(positions)} and {list(forces)}; a force displaces in its own sense."
        )
    if positions[0] == forces[0] == 0.0:
        mirrored = tuple(-x for x in reversed(positions[1:])), tuple(-x for x in reversed(forces[1:]))
        return (*mirrored[0], *positions), (*mirrored[1], *forces)
    if resultant or not (positions[0] < 0.0 < positions[-1] and np.interp(0.0, positions, forces) == 0.0):
        both = "" if resultant else ", or pass from a negative position through 0, 0 to a positive one"
        raise InputError(
            f"Argument {where} must begin with the position 0 and the force 0{both}, but begins with {positions[0]:g} "
            f"and {forces[0]:g}; a joint without load is not displaced."
        )
    return positions, forces
