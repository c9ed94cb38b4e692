"""The kinds of joints: one table of their free motions, from which everything about them follows.

Place in the pipeline: `joints`, `error_catalogue` and the mechanics read it; a new kind is a row of the table.

A kind is the list of its free motions in their order from the parent to the child: "R_y" is a rotation about y,
"T_x" a translation along x, of the frame that the motions before it lead to, and "R" any rotation. Of this list
follow the coordinates of a joint of the tree and the closure equations of a cut one, the errors that mean something,
and the axis of its loads. Source: theory (2.14) to (2.17).
"""

from dataclasses import dataclass
from functools import cached_property

from rfem_jax.description.errors import require_choice

_AXES = "xyz"


@dataclass(frozen=True)
class Freedom:
    """One coordinate of a joint: a rotation or a translation about or along axis 0, 1 or 2 (x, y, z).

    any_axis: whether it is one of the three of any rotation ("R"), which are about the axes of one frame; first:
    whether it is the first coordinate of its motion.
    """

    rotation: bool
    axis: int
    any_axis: bool = False
    first: bool = True

    @property
    def dimension(self) -> str:
        """ "angle" or "length"."""
        return "angle" if self.rotation else "length"


@dataclass(frozen=True)
class JointKind:
    """A kind of joint: its name, and its free motions in order."""

    name: str
    motions: tuple[str, ...]

    @cached_property
    def freedoms(self) -> tuple[Freedom, ...]:
        """The coordinates, in the order of the motions; three for any rotation."""
        found: list[Freedom] = []
        for motion in self.motions:
            letter, _, axis = motion.partition("_")
            axes = range(3) if not axis else (_AXES.index(axis),)
            found += [Freedom(letter == "R", i, any_axis=not axis, first=n == 0) for n, i in enumerate(axes)]
        return tuple(found)

    @property
    def ball(self) -> bool:
        """Whether it turns about any axis."""
        return "R" in self.motions

    @property
    def angles(self) -> int:
        """Number of rotations among the freedoms."""
        return sum(freedom.rotation for freedom in self.freedoms)

    @property
    def displacements(self) -> int:
        """Number of translations among the freedoms."""
        return len(self.freedoms) - self.angles

    @property
    def axis(self) -> int | None:
        """The axis that axial and normal loads refer to: of the only rotation, else of the only translation."""
        for rotation in (True, False):
            axes = [freedom.axis for freedom in self.freedoms if freedom.rotation is rotation]
            if axes:
                return axes[0] if len(axes) == 1 else None
        return None

    @property
    def coincident(self) -> bool:
        """Whether the joint's centres on both sides coincide."""
        return self.displacements == 0

    @property
    def across(self) -> tuple[int, ...]:
        """Axes of the parent's frame along which the child's centre cannot move away from the parent's."""
        free = {freedom.axis for freedom in self.freedoms if not freedom.rotation}
        return tuple(axis for axis in range(3) if axis not in free)

    @property
    def perpendicular(self) -> tuple[tuple[int, int], ...]:
        """Pairs (axis of the parent's frame, axis of the child's) that stay perpendicular."""
        turns = [freedom.axis for freedom in self.freedoms if freedom.rotation]
        if not turns:
            return (1, 0), (1, 2), (0, 2)
        if len(turns) == 1:
            return tuple((turns[0], other) for other in range(3) if other != turns[0])
        return ((turns[0], turns[1]),) if len(turns) == 2 else ()

    @property
    def constraints(self) -> int:
        """Number of closure equations of a cut joint."""
        return 6 - len(self.freedoms)

    def errors(self, child: bool) -> tuple[str, ...]:
        """Names of the errors of the joint's frame on the child or on the parent: those that no free motion makes good.

        A rotation makes good only the error of the side that its axis belongs to.
        """
        free = {f"d_{_AXES[freedom.axis]}" for freedom in self.freedoms if not freedom.rotation}
        turns = [freedom.axis for freedom in self.freedoms if freedom.rotation]
        if len(turns) == 3:
            free |= {"delta_x", "delta_y", "delta_z"}
        elif turns:
            free.add(f"delta_{_AXES[turns[-1 if child else 0]]}")
        return tuple(name for name in COMPONENTS if name not in free)


COMPONENTS = ("delta_x", "delta_y", "delta_z", "d_x", "d_y", "d_z")

KINDS = {
    name: JointKind(name, tuple(motions.split()))
    for name, motions in {
        "revolute": "R_y",
        "prismatic": "T_x",
        "cylindrical": "R_y T_y",
        "universal": "R_y R_z",
        "spherical": "R",
        "planar": "T_x T_z R_y",
        "fixed": "",
        "free": "T_x T_y T_z R",
    }.items()
}
DEFAULT = "revolute"


def require_kind(name: object, where: str) -> JointKind:
    """The kind `name`; raises InputError with the nearest name if there is none."""
    return KINDS[require_choice(name, KINDS, where)]


def joint_errors(kind: JointKind) -> dict[str, str]:
    """{name of an error of a joint after the joint's name and a dot: "angle" or "length"}.

    A crooked pin is one axis through both links, so that only a revolute joint has one.
    """
    names = [*kind.errors(child=False), *(f"child.{name}" for name in kind.errors(child=True))]
    pin = ["pin_tilt_x", "pin_tilt_z"] if kind.motions == ("R_y",) else []
    return {name: "length" if ".d_" in f".{name}" else "angle" for name in (*names, *pin)}
