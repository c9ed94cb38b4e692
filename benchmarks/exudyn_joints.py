"""Joints of all kinds, and the forces along their motions, in Exudyn; and their loads in the conventions of rfem_jax.

Place in the pipeline: exudyn_models builds with it, exudyn_runs reads loads with it.

A joint is a constraint between the frames J0 on the parent (seat) and J1 on the child (bore): `RevoluteZ` for hinges,
for other kinds `GenericJoint` with the axes that the kind holds.  Multipliers of a constraint a . b = 0 between an axis
a of J0 and b of J1 are moments about b x a on the child.  Springs and dampers of compliant joints are one
`RigidBodySpringDamper` between the same frames; laws along one free motion and friction in it are scalar
spring-dampers, with formulas that Exudyn compiles where they are tables or friction.

Axes as in `exudyn_models`: (x, y, z) there = (z, x, y) here.
"""

import math
from typing import NamedTuple

import jax
import numpy as np
from exudyn_engine import BACK, HINGE, TURNED, exu, exut

from rfem_jax.description.basics.joint_kinds import KINDS
from rfem_jax.mechanics.laws.friction_laws import Friction
from rfem_jax.mechanics.laws.joint_laws import FunctionLaw, JointLaw, SpringLaw, TableLaw
from rfem_jax.mechanics.model.model import BASE

# Exudyn's universal constraint is x of J0 . z of J1; ours y . z is there z . x: both frames are turned by 180 deg.
CROSS = np.array([[0.0, 0.0, 1.0], [0.0, -1.0, 0.0], [1.0, 0.0, 0.0]])
Output = exu.OutputVariableType


class Side(NamedTuple):
    """A joint on one of its links: body (or BASE), frame (3, 3) and point (3,) [m] from the body's centre of mass."""

    node: int
    frame: np.ndarray
    point: np.ndarray


class LinkageJoint(NamedTuple):
    """A joint: name, kind, whether it is cut, its two sides; springs of a compliant one as ((6,) stiffness, (6,)
    damping), else None, and which axes they act along; laws: (law or friction, motion as "R_y", start) along motions.
    """

    name: str
    kind: str
    cut: bool
    parent: Side
    child: Side
    bushing: tuple[np.ndarray, np.ndarray] | None = None
    sprung: tuple[str, ...] = ()
    laws: tuple = ()

    @property
    def plain_hinge(self) -> bool:
        """Whether it is a hinge without springs."""
        return self.kind == "revolute" and self.bushing is None

    @property
    def frames(self) -> tuple[np.ndarray, np.ndarray]:
        """Frames of the constraint on both sides, in the bodies' axes."""
        turn = CROSS if self.kind == "universal" else np.eye(3)
        return self.parent.frame @ turn, self.child.frame @ turn

    @property
    def held(self) -> list[int]:
        """Exudyn's mask of translations and rotations that the constraint holds."""
        kind = KINDS[self.kind]
        free = {BACK["xyz".index(motion[2])] for motion in self.sprung if motion[0] == "T"}
        shifts = [int(TURNED[axis] in kind.across and axis not in free) for axis in range(3)]
        if any(motion[0] == "R" for motion in self.sprung):
            return [*shifts, 0, 0, 0]
        turns = {0: [1, 1, 1], 1: [1, 1, 0], 2: [0, 1, 0], 3: [0, 0, 0]}[kind.angles]
        return [*shifts, *turns]


class JointSensors(NamedTuple):
    """A joint's constraint, and sensors of its force, multipliers of rotations, angles x-y-z and displacement; of its
    bushing's force and moment; of springs and friction along a motion with (whether a rotation, axis)."""

    number: object
    force: object
    couples: object
    rotation: object
    shift: object
    bushing: tuple
    along: tuple


def axis_of(motion: str) -> int:
    """Exudyn's axis of a motion such as "T_x"."""
    return BACK["xyz".index(motion[2])]


def constrain(mbs, joint: LinkageJoint, markers, sensor) -> JointSensors:
    """Add a joint with its bushing and laws; `sensor(number, what)` adds a sensor of an object."""
    first, second = joint.frames
    if joint.plain_hinge:
        number = mbs.AddObject(
            exut.ObjectJointRevoluteZ(markerNumbers=markers, rotationMarker0=first, rotationMarker1=second)
        )
    else:
        number = mbs.AddObject(
            exut.ObjectJointGeneric(
                markerNumbers=markers, constrainedAxes=joint.held, rotationMarker0=first, rotationMarker1=second
            )
        )
    kinds = (Output.ForceLocal, Output.TorqueLocal, Output.Rotation)
    found = [sensor(number, kind) for kind in kinds]
    # Of a hinge nothing moves along an axis; fewer sensors cost Exudyn less time.
    shift = None if joint.plain_hinge else sensor(number, Output.DisplacementLocal)
    along = [_law(mbs, joint, number, markers, sensor, *law) for law in joint.laws]
    return JointSensors(
        number, *found, shift, _bushing(mbs, joint, markers, sensor), tuple(x for x in along if x is not None)
    )


def _bushing(mbs, joint: LinkageJoint, markers, sensor) -> tuple:
    if joint.bushing is None:
        return ()
    stiffness, damping = joint.bushing
    if joint.parent.node != BASE and np.abs(joint.parent.frame - np.eye(3)).max() > 1e-9:
        # ObjectConnectorRigidBodySpringDamper multiplies the two rotations of its first marker in the wrong order.
        raise NotImplementedError(f"Joint {joint.name}: a bushing in a moving parent must have the parent's axes.")
    number = mbs.AddObject(
        exut.ObjectConnectorRigidBodySpringDamper(
            markerNumbers=markers,
            stiffness=np.diag(stiffness),
            damping=np.diag(damping),
            rotationMarker0=joint.parent.frame,
            rotationMarker1=joint.child.frame,
        )
    )
    return sensor(number, Output.ForceLocal), sensor(number, Output.TorqueLocal)


def _law(mbs, joint: LinkageJoint, held, markers, sensor, law: JointLaw | Friction, motion: str, start: float):
    """A law along a motion; its sensor if the load contains it, as that of springs and friction does. held: the
    joint's constraint."""
    rotation, axis = motion[0] == "R", axis_of(motion)
    numbers = {}
    if isinstance(law, SpringLaw):
        stiffness, preload = float(law.stiffness), float(law.preload)
        numbers = {"stiffness": stiffness, "damping": float(law.damping), "offset": float(law.rest)}
        numbers["torque" if rotation else "force"] = -preload
    if rotation:
        turns = mbs.AddNode(exut.NodeGenericData(numberOfDataCoordinates=1, initialCoordinates=[start]))
        number = mbs.AddObject(
            exut.ObjectConnectorTorsionalSpringDamper(
                markerNumbers=markers,
                nodeNumber=turns,
                rotationMarker0=joint.parent.frame,
                rotationMarker1=joint.child.frame,
                **numbers,
            )
        )
    else:
        axes = list(joint.parent.frame[:, axis])
        number = mbs.AddObject(
            exut.ObjectConnectorLinearSpringDamper(markerNumbers=markers, axisMarker0=axes, **numbers)
        )
    if not isinstance(law, SpringLaw):
        _set_formula(
            mbs, number, "springTorqueUserFunction" if rotation else "springForceUserFunction", law, joint, held
        )
    if not isinstance(law, SpringLaw | Friction):
        return None
    return sensor(number, Output.TorqueLocal if rotation else Output.ForceLocal), rotation, axis


def _set_formula(mbs, number, name: str, law, joint: LinkageJoint, held) -> None:
    """Let a spring-damper exert a law: compiled by Exudyn but for the user's own function and friction by the load,
    which Python calls."""
    if isinstance(law, FunctionLaw):
        force = jax.jit(law.force)
        mbs.SetObjectParameter(number, name, lambda mbs, t, i, x, v, *_: -float(force(x, v)))
        return
    if isinstance(law, Friction) and law.load is not None:
        mbs.SetObjectParameter(number, name, _friction_by_load(law, joint, held))
        return
    formula = _table(law) if isinstance(law, TableLaw) else _friction(law)
    mbs.SetObjectParameter(number, name, formula)
    mbs.SetObjectParameter(number, name, exut.CreateSymbolicUserFunction(mbs, formula, name, number))


def _table(law: TableLaw):
    """Minus the table as a sum of kinks, constant outside."""
    x, f = np.asarray(law.positions), np.asarray(law.forces)
    kinks = 0.5 * np.diff(np.diff(f) / np.diff(x), prepend=0.0, append=0.0)
    constant = float(f[0] - kinks @ np.abs(x[0] - x))
    pairs = [(float(kink), float(at)) for kink, at in zip(kinks, x, strict=True)]

    def force(mbs, t, itemNumber, x, v, stiffness, damping, offset):
        return -constant - sum(kink * exu.symbolic.abs(x - at) for kink, at in pairs)

    return force


def _friction(law: Friction):
    _require_tanh(law)
    constant, viscous, rate = float(law.constant), float(law.viscous), float(law.sliding_rate)

    def force(mbs, t, itemNumber, x, v, stiffness, damping, offset):
        return constant * exu.symbolic.tanh(v / rate) + viscous * v

    return force


def _friction_by_load(law: Friction, joint: LinkageJoint, held):
    """Friction by the resultant force across the axis, which is that of the constraint at the present iterate."""
    _require_tanh(law)
    if law.load.length is not None or joint.bushing is not None:
        raise NotImplementedError(
            f"Joint {joint.name}: friction by the load on both ends of a bearing, or of a compliant joint, is not "
            "translated."
        )
    constant, viscous, rate = float(law.constant), float(law.viscous), float(law.sliding_rate)
    arm, scale = float(law.load.arm), float(law.load.scale)
    first, second = (axis for axis in range(3) if axis != BACK[law.axis])

    def force(mbs, t, itemNumber, x, v, stiffness, damping, offset):
        by_constraint = mbs.GetObjectOutput(held, Output.ForceLocal)
        square = by_constraint[first] ** 2 + by_constraint[second] ** 2
        normal = square / math.sqrt(square + scale**2)
        return (constant + arm * normal) * math.tanh(v / rate) + viscous * v

    return force


def _require_tanh(law: Friction) -> None:
    if law.law != "tanh":
        raise NotImplementedError("Friction by Brown and McPhee is not translated.")


class JointRows(NamedTuple):
    """What the sensors of a joint measured, (T, n) each, as `JointSensors`; along: with (T,)."""

    force: np.ndarray
    couples: np.ndarray
    rotation: np.ndarray
    shift: np.ndarray | None
    bushing: tuple
    along: tuple


def rows_of(sensors: JointSensors, read) -> JointRows:
    """The rows of all sensors of a joint by `read(sensor)`."""
    return JointRows(
        *(read(one) for one in (sensors.force, sensors.couples, sensors.rotation)),
        None if sensors.shift is None else read(sensors.shift),
        tuple(read(one) for one in sensors.bushing),
        tuple((read(one)[:, 0], *where) for one, *where in sensors.along),
    )


def joined(parts: list[JointRows]) -> JointRows:
    """Rows of several pieces of a run one after the other."""
    first = parts[0]

    def all_of(pick):
        return np.concatenate([pick(part) for part in parts])

    return JointRows(
        *(all_of(lambda part, k=k: part[k]) for k in range(3)),
        None if first.shift is None else all_of(lambda part: part.shift),
        tuple(all_of(lambda part, k=k: part.bushing[k]) for k in range(len(first.bushing))),
        tuple((all_of(lambda part, k=k: part.along[k][0]), *one[1:]) for k, one in enumerate(first.along)),
    )


def loads_of(joint: LinkageJoint, rows: JointRows, sign: float = 1.0):
    """Force and moment (T, 3) on the child about its point, in the hinge frame (the parent's at a cut joint), in our
    axes; and the angle (T,) about the hinge.

    sign: of the multipliers; the static solver's have the opposite one of the dynamic solvers'.  force: what the
    constraint measures, its negative acts on the child.
    """
    force, couples = sign * rows.force, sign * rows.couples
    if joint.plain_hinge and not rows.along:
        # The multipliers of z0 . x1 = 0 and z0 . y1 = 0 are moments along the child's y and -x.
        angle = rows.rotation[:, HINGE]
        moment = np.stack([-couples[:, 1], couples[:, 0], np.zeros(len(couples))], axis=1)
        force, moment = (-force, spun(moment, angle)) if joint.cut else (spun(-force, -angle), moment)
        return force[:, BACK], moment[:, BACK], angle
    turned = _relative_rotations(joint, rows.rotation)
    force, moment = -force, _moment_in_seat(joint, couples, turned)
    if joint.kind == "universal":
        force = force @ CROSS
    if rows.bushing:
        force, moment = force - rows.bushing[0], moment - rows.bushing[1]
    for values, rotation, axis in rows.along:
        (moment if rotation else force)[:, axis] -= values
    if not joint.cut:
        force, moment = (np.einsum("tji,tj->ti", _to_hinge_frame(joint, turned), x) for x in (force, moment))
    return force[:, BACK], moment[:, BACK], np.arctan2(-turned[:, 0, 1], turned[:, 1, 1])


def idle_moment(joint: LinkageJoint, rows: JointRows, axis: int, multiplier: float):
    """Moment (1, 3) on the child, in the hinge frame and our axes, of the constraint on a small rotation about an axis
    of the parent's frame: of y0 . z1, x0 . z1 or x0 . y1 = 0."""
    in_seat = np.eye(3)[axis] * multiplier * (-1.0 if axis == 1 else 1.0)
    turned = _to_hinge_frame(joint, _relative_rotations(joint, rows.rotation))
    return np.einsum("tji,j->ti", turned, in_seat)[:, BACK]


def spun(vectors, angle):
    """Vectors (T, 3) turned about z by the angle (T,)."""
    c, s = np.cos(angle), np.sin(angle)
    x, y, z = vectors.T
    return np.stack([c * x - s * y, s * x + c * y, z], axis=1)


def _relative_rotations(joint: LinkageJoint, angles):
    """Rotations (T, 3, 3) from the child's frame of a joint to the parent's, from angles about x, y, z in turn."""
    (ca, cb, cc), (sa, sb, sc) = np.cos(angles.T), np.sin(angles.T)
    rotation = np.array(
        [
            [cb * cc, -cb * sc, sb],
            [ca * sc + sa * sb * cc, ca * cc - sa * sb * sc, -sa * cb],
            [sa * sc - ca * sb * cc, sa * cc + ca * sb * sc, ca * cb],
        ]
    ).transpose(2, 0, 1)
    return CROSS @ rotation @ CROSS if joint.kind == "universal" else rotation


def _moment_in_seat(joint: LinkageJoint, couples, turned):
    """Moments (T, 3) of the constraint on the child, in the parent's axes."""
    held = joint.held[3:]
    zero = np.zeros(len(couples))
    if sum(held) == 3:  # z0 . y1 = z0 . x1 = x0 . y1 = 0
        return np.stack([-couples[:, 0], couples[:, 1], couples[:, 2]], axis=1)
    if sum(held) == 2:
        in_child = np.stack([-couples[:, 1], couples[:, 0], zero], axis=1)
        return np.einsum("tij,tj->ti", turned, in_child)
    if sum(held) == 1:  # z0 . x1 = 0
        return -couples[:, 1:2] * np.cross(turned[:, :, 0], [0.0, 0.0, 1.0])
    return np.zeros((len(couples), 3))


def _to_hinge_frame(joint: LinkageJoint, turned):
    """Rotations (T, 3, 3) from the hinge frame to the parent's: all of the joint's turns, but the tilts of a compliant
    joint."""
    if KINDS[joint.kind].angles == 0:
        return np.broadcast_to(np.eye(3), turned.shape)
    if not any(motion[0] == "R" for motion in joint.sprung):
        return turned
    angle = np.arctan2(-turned[:, 0, 1], turned[:, 1, 1])
    c, s, zero, one = np.cos(angle), np.sin(angle), np.zeros_like(angle), np.ones_like(angle)
    return np.array([[c, -s, zero], [s, c, zero], [zero, zero, one]]).transpose(2, 0, 1)
