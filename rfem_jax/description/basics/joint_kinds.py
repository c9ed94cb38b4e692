"""The kinds of joints: one table of their free motions, from which everything about them follows.

Place in the pipeline: `joints`, `error_catalogue` and the mechanics read it; a new kind is a row of the table.

A kind is the list of its free motions in their order from the parent to the child: "R_y" is a rotation about y,
"T_x" a translation along x, of the frame that the motions before it lead to, and "R" any rotation. Of this list
follow the coordinates of a joint of the tree and the closure equations of a cut one, the errors that mean something,
and the axis of its loads. Source: theory (2.14) to (2.17).

What a kind holds may be sprung instead (`directions`, `compliant`): a compliant joint has those directions as
coordinates, too (theory (13.1)).
"""

from dataclasses import dataclass
from functools import cache, cached_property

from rfem_jax.description.basics.errors import InputError, require_choice, subject

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

    @property
    def nominal(self) -> "JointKind":
        """The kind without its springs."""
        return self

    @cached_property
    def own(self) -> tuple[int, ...]:
        """Places among the freedoms of those that are no springs, in the order of the nominal kind."""
        return tuple(range(len(self.freedoms)))

    @cached_property
    def to_hinge_frame(self) -> int:
        """Number of freedoms, first ones, that lead to the axes of the hinge frame H."""
        return len(self.freedoms)

    @property
    def turns_held(self) -> tuple[str, ...]:
        """Rotations that the kind holds: about axes of the parent where it turns about one or none."""
        free = {freedom.axis for freedom in self.freedoms if freedom.rotation}
        return tuple(f"R_{letter}" for axis, letter in enumerate(_AXES) if axis not in free)

    @cached_property
    def directions(self) -> dict[str, tuple[str, ...]]:
        """Directions that may be sprung, by name, and the motions of each.

        "T_x" and so on: one translation, or one rotation of a kind that turns about no axis. With several motions the
        spring acts on their resultant: "radial" ("normal" of a slide) across the axis, "axial" along it, "tilt" of the
        axis, "roll" about it.
        """
        axis = None if self.axis is None else _AXES[self.axis]
        shifts = tuple(f"T_{_AXES[i]}" for i in self.across)
        turns, slides_only = self.turns_held, self.angles == 0
        found = {motion: (motion,) for motion in (*shifts, *(turns if slides_only else ()))}
        groups = {
            "normal" if slides_only and axis else "radial": [m for m in shifts if not axis or m[-1] != axis],
            "axial": [m for m in shifts if axis and m[-1] == axis],
            "tilt": [] if slides_only and not axis else [m for m in turns if not axis or m[-1] != axis],
            "roll": [m for m in turns if axis and m[-1] == axis],
        }
        return {**{name: tuple(motions) for name, motions in groups.items() if motions}, **found}

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


@dataclass(frozen=True)
class CompliantKind(JointKind):
    """A kind some of whose held directions are sprung: `motions` are all that move, `of` the kind without springs.

    Translations come first, along the axes of the parent; then the rotation of the nominal kind, whose angle that of
    the next but one axis of the child about the parent's axis is; then the tilts (theory (13.1)). Name, axis of loads
    and errors are those of the nominal kind.
    """

    of: JointKind

    @property
    def nominal(self) -> JointKind:
        return self.of

    @cached_property
    def own(self) -> tuple[int, ...]:
        found = []
        for one in self.of.freedoms:
            same = (
                n for n, other in enumerate(self.freedoms) if (other.rotation, other.axis) == (one.rotation, one.axis)
            )
            found.append(next(same))
        return tuple(found)

    @cached_property
    def to_hinge_frame(self) -> int:
        turns = [n for n in self.own if self.freedoms[n].rotation]
        return 1 + max(turns) if turns else self.displacements

    @property
    def axis(self) -> int | None:
        return self.of.axis

    def errors(self, child: bool) -> tuple[str, ...]:
        return self.of.errors(child)


@cache
def compliant(kind: JointKind, sprung: tuple[str, ...]) -> JointKind:
    """The kind with motions that it holds as coordinates, too."""
    if not sprung:
        return kind
    free = set(kind.motions) | set(sprung)
    shifts = [motion for motion in ("T_x", "T_y", "T_z") if motion in free]
    turns = [motion for motion in kind.motions if motion[0] == "R"]
    tilts = [motion for motion in sprung if motion[0] == "R"]
    if len(turns) == 2:
        turns = [turns[0], *tilts, turns[1]]  # the axis across both
    elif tilts:
        first = _AXES.index(turns[0][-1]) if turns else 0
        order = [f"R_{_AXES[(first + n) % 3]}" for n in range(3)]
        turns = [motion for motion in order if motion in free]
    return CompliantKind(kind.name, (*shifts, *turns), kind)


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


# Words for kinds in other programs and books; refused, with the name that is meant.
OTHER_WORDS = {
    "hinge": "revolute", "pin": "revolute", "rotational": "revolute",
    "slider": "prismatic", "translational": "prismatic", "guide": "prismatic", "sliding": "prismatic",
    "ball": "spherical", "cardan": "universal", "hooke": "universal",
    "weld": "fixed", "rigid": "fixed", "clamp": "fixed", "plane": "planar",
}  # fmt: skip


def require_kind(name: object, where: str) -> JointKind:
    """The kind `name`; raises InputError with the nearest name if there is none."""
    if isinstance(name, str) and (meant := OTHER_WORDS.get(name.lower())) is not None:
        listed = ", ".join(f'"{kind}"' for kind in KINDS)
        raise InputError(f"{subject(where)} must be one of {listed}, but was {name!r}; write {meant!r}.")
    return KINDS[require_choice(name, KINDS, where)]


def why_no_error(kind: str, name: str) -> str:
    """Why joints of a kind have no error `name` (what follows the joint's name), "" if no joint has such one."""
    if name not in {**joint_errors(KINDS["fixed"]), **joint_errors(KINDS[DEFAULT])}:
        return ""
    if "pin" in name:
        return f"only revolute joints have crooked pins, and this one is {kind}; tilt its seat or its child's bore."
    return f"the free motions of a {kind} joint make it good, so that it has no effect; leave it out."


def joint_errors(kind: JointKind) -> dict[str, str]:
    """{name of an error of a joint after the joint's name and a dot: "angle" or "length"}.

    A crooked pin is one axis through both links, so that only a revolute joint has one.
    """
    names = [*kind.errors(child=False), *(f"child.{name}" for name in kind.errors(child=True))]
    pin = ["pin_tilt_x", "pin_tilt_z"] if kind.motions == ("R_y",) else []
    return {name: "length" if ".d_" in f".{name}" else "angle" for name in (*names, *pin)}
