"""A mechanism as other programs know it: rigid bodies somewhere in space, and joints between frames on them.

Place in the pipeline: readers and `study_layout` make a `Layout`; `laying` completes it, `study_writer` and the writers
write it.

Frames of joints follow the conventions of rfem_jax: y is the axis of a hinge, x that of a slide (theory (2.14) to
(2.17)). SI units, rad.
"""

from dataclasses import dataclass, field, replace

import numpy as np
from jaxtyping import Float

from rfem_jax.description.basics.joint_kinds import KINDS
from rfem_jax.exchange.rigid_frames import Frame, angles_of, at_origin, rotation_about, rotation_from

BASE = "base"


@dataclass(frozen=True)
class Body:
    """A rigid body: name; pose of its frame in global axes at the start; mass [kg]; centre (3,) [m] and inertia (3, 3)
    [kg m^2] about it, in the body's frame; length [m], None where nothing says it."""

    name: str
    pose: Frame
    mass: float
    centre: Float[np.ndarray, "3"]
    inertia: Float[np.ndarray, "3 3"]
    length: float | None = None


@dataclass(frozen=True)
class Along:
    """A spring with a damper along a motion of a joint, as "R_y" or "T_x": stiffness, damping, rest, preload as those
    of a `JointSpring` (SI units)."""

    motion: str
    stiffness: float = 0.0
    damping: float = 0.0
    rest: float = 0.0
    preload: float = 0.0


@dataclass(frozen=True)
class Connection:
    """A joint: name, kind, names of parent (or "base") and child; its frame on the parent (seat) and on the child
    (bore), in their frames; whether it closes a loop; coordinates at the start, in the order of the kind's motions
    (theory (2.14)), as turns of more than half a revolution are seen nowhere else; springs along its motions."""

    name: str
    kind: str
    parent: str
    child: str
    seat: Frame
    bore: Frame
    cut: bool = False
    start: tuple[float, ...] = ()
    springs: tuple[Along, ...] = ()


@dataclass(frozen=True)
class Pull:
    """A spring with a damper between points (3,) [m] of two bodies, as a `PointSpring`."""

    name: str
    bodies: tuple[str, str]
    points: tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]
    stiffness: float
    damping: float
    free_length: float
    preload: float = 0.0


@dataclass(frozen=True)
class Ratio:
    """An ideal coupling q_b = ratio q_a + offset of the coordinates of two joints with one motion each."""

    name: str
    joints: tuple[str, str]
    ratio: float
    offset: float


@dataclass(frozen=True)
class Layout:
    """Bodies and joints at one position; gravity (3,) [m/s^2]; springs between points; couplings; sentences on what
    could not be taken over. framed: whether the frames of bodies and joints are those that a study has."""

    title: str
    bodies: tuple[Body, ...]
    joints: tuple[Connection, ...]
    gravity: Float[np.ndarray, "3"] = field(default_factory=lambda: np.array([0.0, 0.0, -9.81]))
    pulls: tuple[Pull, ...] = ()
    ratios: tuple[Ratio, ...] = ()
    remarks: tuple[str, ...] = ()
    framed: bool = False

    def body(self, name: str) -> Body:
        """The body of a name."""
        return next(one for one in self.bodies if one.name == name)

    def pose(self, name: str) -> Frame:
        """The pose of a body, or of the base."""
        return at_origin() if name == BASE else self.body(name).pose

    def sides(self, joint: Connection) -> tuple[Frame, Frame]:
        """The frames of a joint on its parent and on its child, in global axes at the start."""
        return self.pose(joint.parent).then(joint.seat), self.pose(joint.child).then(joint.bore)

    def remarked(self, *sentences: str) -> "Layout":
        """The same with further remarks."""
        return replace(self, remarks=(*self.remarks, *sentences))


def motion_frame(kind: str, start: tuple[float, ...]) -> Frame:
    """The child's frame relative to the parent's of a joint with these coordinates."""
    found, values = at_origin(), list(start)
    for motion in KINDS[kind].motions:
        if motion == "R":
            found = found.then(Frame(rotation_from(np.array(values[:3])), np.zeros(3)))
            values = values[3:]
            continue
        axis, value = "xyz".index(motion[2]), values.pop(0)
        turn = motion[0] == "R"
        step = np.zeros(3) if turn else value * np.eye(3)[axis]
        found = found.then(Frame(rotation_about(axis, value) if turn else np.eye(3), step))
    return found


def coordinates_of(kind: str, apart: Frame) -> tuple[float, ...]:
    """The coordinates of a joint whose child's frame is `apart` from the parent's, as far as its kind lets it be."""
    r, p = apart
    about_y = float(np.arctan2(r[0, 2], r[0, 0]))
    found: dict[str, tuple[float, ...]] = {
        "revolute": (about_y,),
        "prismatic": (float(p[0]),),
        "cylindrical": (about_y, float(p[1])),
        "universal": (float(np.arctan2(r[0, 2], r[2, 2])), float(np.arctan2(r[1, 0], r[1, 1]))),
        "spherical": tuple(map(float, angles_of(r))),
        "planar": (float(p[0]), float(p[2]), about_y),
        "fixed": (),
        "free": (*map(float, p), *map(float, angles_of(r))),
    }
    return found[kind]
