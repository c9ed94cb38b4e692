"""Any linkage of rfem_jax as a multibody system of Exudyn.

    Model + errors -> Linkage (plain numbers) -> System -> exudyn_runs: statics, motion, loads

Only numbers are shared (`apply_errors`: masses, inertias, joint frames with their errors, stiffnesses);
kinematics, element, constraints, statics and integration are Exudyn's own.  Every rfe is a rigid
body with absolute coordinates, every sde a six-dof connector between its two faces, every joint a
constraint with multipliers (`exudyn_joints`).

The connector.  Exudyn's default form measures the rotation by Tait-Bryan angles in the axes of its
first marker and applies the force at both markers: not symmetric, and the pair of forces leaves a
moment.  The `intrinsic` form takes the logarithm of the relative motion in SE(3) and acts in the
mid-frame: it does not depend on the order of the markers and keeps the balance of moments, so it is
the nearest to a geometrically exact element, and the default here.

Not translated, and refused: forces and moments at points other than springs; tables of compliant joints, and their
sprung rotations if not all that the joint holds are sprung, or if it has several rotations of its own; friction by
Brown and McPhee, by the loads at both ends of a bearing and by the load of a compliant joint; a force between two
links as a drive, more than one drive; joints with a clearance.

Units: SI, rad.  Source: J. Gerstmayr, Exudyn - a C++-based Python package for flexible multibody
systems, Multibody Syst. Dyn. 60 (2024) 533-561.
"""

from typing import NamedTuple

import equinox as eqx
import numpy as np
from exudyn_engine import BACK, HINGE, TURNED, exu, exut
from exudyn_forces import add_point_springs, laws_of, point_springs_of, springs_of
from exudyn_joints import JointSensors, LinkageJoint, Side, axis_of, constrain

from rfem_jax.mechanics.dynamics.loads import static_state
from rfem_jax.mechanics.kinematics.motion import all_frames, motion_of
from rfem_jax.mechanics.model.errors import AssemblyErrors
from rfem_jax.mechanics.model.model import BASE, Model
from rfem_jax.mechanics.model.with_errors import apply_errors

__all__ = ["BACK", "HINGE", "Settings", "build", "exu", "linkage"]


class Linkage(NamedTuple):
    """A discretised mechanism with its errors in Exudyn's axes; bodies are the rfes.

    rotation (n, 3, 3), centre (n, 3): nominal start poses of the bodies, loops still open by the
    errors; mass (n,), inertia (n, 3, 3) about the centre of mass; elements: (left body, right body, point on each,
    stiffness (6,), damping time); driven: index of the driven joint, motion: which of its motions; start: of this
    motion [rad, m]; idle: (joint, axis) of rotations of ball joints that statics holds; point_springs: (bodies, points
    on them, stiffness, damping, free length, preload).
    """

    rotation: np.ndarray
    centre: np.ndarray
    mass: np.ndarray
    inertia: np.ndarray
    joints: list[LinkageJoint]
    elements: list
    gravity: np.ndarray
    driven: int | None
    motion: str
    start: float
    order: tuple[str, ...]
    idle: tuple[tuple[int, int], ...] = ()
    point_springs: tuple = ()


class Settings(NamedTuple):
    """How Exudyn models and integrates.

    spectral_radius of generalised-alpha; nodes: "rotation_vector" (Lie group), "euler_parameters"
    or "angles" (x-y-z with the hinges near z: singular only at 90 deg out of the plane); modified:
    modified Newton; new_jacobian: modified Newton starts every step with a new Jacobian; sparse:
    Eigen's sparse solver; relative, absolute: tolerances of Newton's method; intrinsic: see the
    module's docstring.
    """

    spectral_radius: float = 0.6
    nodes: str = "angles"
    modified: bool = True
    new_jacobian: bool = False
    sparse: bool = True
    relative: float = 1e-8
    absolute: float = 1e-7
    intrinsic: bool = True


NODE_TYPES = {
    "rotation_vector": exu.NodeType.RotationRotationVector,
    "euler_parameters": exu.NodeType.RotationEulerParameters,
    "angles": exu.NodeType.RotationRxyz,
}


def linkage(model: Model, errors: AssemblyErrors) -> Linkage:
    """Plain numbers of a model with its errors, in Exudyn's axes."""
    topology = model.topology
    actual, frames = _actual(model, errors)
    rotation, point = (np.asarray(part) for part in frames)
    rotation, point = np.moveaxis(rotation, 2, 0), point.T
    centre, n = np.asarray(actual.centre).T, topology.n_links

    def side(node, rotations, positions, j):
        """Body, frame and point of a joint's side; the point from the body's centre of mass."""
        at = np.asarray(positions)[:, j] - (0.0 if node == BASE else centre[node])
        return Side(node, _turned(np.asarray(rotations)[:, :, j]), at[TURNED])

    joints = [
        LinkageJoint(
            name,
            topology.kinds[j],
            j >= n,
            side(topology.parents[j], actual.seat_rotation, actual.seat_position, j),
            side(topology.children[j], actual.bore_rotation, actual.bore_position, j),
            *springs_of(model, j),
            laws=laws_of(model, j),
        )
        for j, name in enumerate(topology.joints)
    ]
    elements = []
    stiffness, damping = np.asarray(actual.stiffness), np.asarray(actual.damping)
    for link, (first, stop) in enumerate(topology.ranges):
        for k in range(first, stop):
            left = link if k == first else n + k - 1
            start = float(actual.beam_middle[link]) if k == first else 0.0
            at_left = np.array([start + float(actual.lever_left[k]), 0.0, 0.0]) - centre[left]
            at_right = np.array([float(actual.lever_right[k]), 0.0, 0.0]) - centre[n + k]
            rows = stiffness[:, k].reshape(2, 3)[:, TURNED].ravel()
            elements.append((left, n + k, at_left[TURNED], at_right[TURNED], rows, float(damping[k])))
    inertia = np.moveaxis(np.asarray(actual.inertia), 2, 0)
    return Linkage(
        rotation=np.stack([_turned(r) for r in rotation]),
        centre=(point + np.einsum("nij,nj->ni", rotation, centre))[:, TURNED],
        mass=np.asarray(actual.mass),
        inertia=np.stack([_turned(i) for i in inertia]),
        joints=joints,
        elements=elements,
        gravity=np.asarray(model.gravity)[TURNED],
        order=model.joint_names,
        point_springs=point_springs_of(actual, centre),
        **_driven(model),
    )


def _driven(model: Model) -> dict:
    """The driven joint, its motion and the start of this; and the idle rotations; refuses what is not translated."""
    topology = model.topology
    if len(topology.drives) > 1:
        raise NotImplementedError("Several drives are not translated.")
    if topology.clearances:
        raise NotImplementedError("Joints with a clearance are not translated.")
    idle = []
    for k in topology.idle:
        joint = topology.link_of_freedom[k]
        idle.append((joint, BACK[topology.freedoms[k].axis]))
    if topology.driven is None:
        return {"driven": None, "motion": "R_y", "start": 0.0, "idle": tuple(idle)}
    return {
        "driven": topology.driven,
        "motion": topology.motion_of(topology.drives[0]),
        "start": float(model.start_joints[topology.driven_position]),
        "idle": tuple(idle),
    }


@eqx.filter_jit
def _actual(model: Model, errors: AssemblyErrors):
    """Constants of the equations of motion, and rotations and points of all nodes at the start."""
    actual = apply_errors(model, errors)
    now = motion_of(actual, static_state(model.topology, model.start_coordinates()))
    return actual, all_frames(model.topology, now)


def _turned(matrix: np.ndarray) -> np.ndarray:
    return np.asarray(matrix)[TURNED][:, TURNED]


def _about_hinge(angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


class System(NamedTuple):
    """An assembled Exudyn system; hold: the constraint on the driven motion or None; loads: of the
    drive; sensors: joint -> `JointSensors`; place_sensor: of the tracked joint's position; idle:
    (joint, axis, sensor) of constraints on idle rotations; container keeps the system alive."""

    mbs: object
    container: object
    bodies: list
    hold: object
    hold_sensor: object
    loads: list
    sensors: dict[str, JointSensors]
    rate_sensor: object
    place_sensor: object
    idle: list


def build(
    link: Linkage,
    settings: Settings,
    poses=None,
    velocities=None,
    angle=None,
    moment=None,
    track=None,
    resting=False,
) -> System:
    """An Exudyn system of a linkage.

    **Arguments:** `poses`: rotations (n, 3, 3), centres (n, 3) of the bodies (None: nominal);
    `velocities`: angular and of the centres (n, 3) each (None: rest); `angle`: t -> change of the driven
    motion since its start, prescribed (None: free); `moment`: t -> moment [N m] or force [N] on the driven joint;
    `track`: name of a joint whose position is recorded; `resting`: hold idle rotations, for statics.
    """
    container = exu.SystemContainer()
    mbs = container.AddSystem()
    bodies = _add_bodies(mbs, link, settings, poses, velocities)
    ground = mbs.CreateGround()

    def marker(node, point):
        body = ground if node == BASE else bodies[node]
        return mbs.AddMarker(exut.MarkerBodyRigid(bodyNumber=body, localPosition=list(point)))

    for left, right, at_left, at_right, stiffness, damping in link.elements:
        mbs.AddObject(
            exut.ObjectConnectorRigidBodySpringDamper(
                markerNumbers=[marker(left, at_left), marker(right, at_right)],
                stiffness=np.diag(stiffness),
                damping=np.diag(damping * stiffness),
                intrinsicFormulation=settings.intrinsic,
            )
        )
    add_point_springs(mbs, link.point_springs, marker)
    sensors, loads, idle, hold, hold_sensor, rate_sensor, place = {}, [], [], None, None, None, None
    for j, joint in enumerate(link.joints):
        markers = [marker(side.node, side.point) for side in (joint.parent, joint.child)]
        sensors[joint.name] = constrain(mbs, joint, markers, lambda number, what: _sensor(mbs, number, what))
        if joint.name == track:
            place = _sensor(mbs, sensors[joint.name].number, exu.OutputVariableType.Position)
        if resting:
            for axis in (axis for which, axis in link.idle if which == j):
                number = _hold_turn(mbs, link, joint, markers, axis)
                idle.append((joint.name, axis, _sensor(mbs, number, exu.OutputVariableType.TorqueLocal)))
        if j != link.driven:
            continue
        rotation = link.motion[0] == "R"
        rate_kind = exu.OutputVariableType.AngularVelocityLocal if rotation else exu.OutputVariableType.VelocityLocal
        rate_sensor = _sensor(mbs, sensors[joint.name].number, rate_kind)
        if angle is not None:
            hold = _prescribe(mbs, link, joint, markers, angle)
            kind = exu.OutputVariableType.TorqueLocal if rotation else exu.OutputVariableType.ForceLocal
            hold_sensor = _sensor(mbs, hold, kind)
        if moment is not None:
            loads += _drive_loads(mbs, link.motion, markers, joint, moment)
    mbs.Assemble()
    return System(mbs, container, bodies, hold, hold_sensor, loads, sensors, rate_sensor, place, idle)


def _add_bodies(mbs, link: Linkage, settings: Settings, poses, velocities) -> list:
    rotations, centres = (link.rotation, link.centre) if poses is None else poses
    still = np.zeros((len(link.mass), 3))
    angular, linear = (still, still) if velocities is None else velocities
    return [
        mbs.CreateRigidBody(
            referencePosition=list(centres[i]),
            referenceRotationMatrix=rotations[i],
            initialVelocity=list(linear[i]),
            initialAngularVelocity=list(angular[i]),
            inertia=exut.RigidBodyInertia(float(link.mass[i]), link.inertia[i]),
            gravity=list(link.gravity),
            nodeType=NODE_TYPES[settings.nodes],
        )
        for i in range(len(link.mass))
    ]


def _sensor(mbs, number, kind):
    return mbs.AddSensor(
        exut.SensorObject(objectNumber=number, outputVariableType=kind, storeInternal=True, writeToFile=False)
    )


def _prescribe(mbs, link: Linkage, joint: LinkageJoint, markers, change):
    """A constraint on the driven motion, which is `change(t)` more than at the start."""
    axis, frame = axis_of(link.motion), joint.parent.frame
    at = axis + (3 if link.motion[0] == "R" else 0)
    start = 0.0 if link.motion[0] == "R" else link.start
    if link.motion[0] == "R":
        frame = frame @ _about_hinge(link.start)
    return mbs.AddObject(
        exut.ObjectJointGeneric(
            markerNumbers=markers,
            constrainedAxes=[int(k == at) for k in range(6)],
            rotationMarker0=frame,
            rotationMarker1=joint.child.frame,
            offsetUserFunction=lambda mbs, t, item, _: [start + change(t) if k == at else 0.0 for k in range(6)],
        )
    )


def _hold_turn(mbs, link: Linkage, joint: LinkageJoint, markers, axis: int):
    """Hold the small rotation about an axis of the parent's frame since the nominal start."""
    parent = np.eye(3) if joint.parent.node == BASE else link.rotation[joint.parent.node]
    same = link.rotation[joint.child.node].T @ parent @ joint.parent.frame
    return mbs.AddObject(
        exut.ObjectJointGeneric(
            markerNumbers=markers,
            constrainedAxes=[0, 0, 0, *(int(k == axis) for k in range(3))],
            rotationMarker0=joint.parent.frame,
            rotationMarker1=same,
        )
    )


def _drive_loads(mbs, motion: str, markers, joint: LinkageJoint, moment):
    """The moment on the child about the hinge, and its reaction on a parent other than the base; or the force on the
    child along an axis."""
    axis = joint.parent.frame[:, axis_of(motion)]
    if joint.parent.node == BASE:
        return [_drive_load(mbs, motion, markers[1], axis, moment, turning=False)]
    if motion[0] == "T":
        raise NotImplementedError("A force between two links along a joint's motion is not translated.")
    return [
        _drive_load(mbs, motion, marker, sign * side.frame[:, HINGE], moment, turning=True)
        for marker, side, sign in zip(markers, (joint.parent, joint.child), (-1.0, 1.0), strict=True)
    ]


def _drive_load(mbs, motion: str, marker, axis, moment, turning):
    x, y, z = (float(value) for value in axis)

    def vector(mbs, t, _):
        value = moment(t)
        return (value * x, value * y, value * z)

    kind = exut.LoadTorqueVector if motion[0] == "R" else exut.LoadForceVector
    return mbs.AddLoad(kind(markerNumber=marker, bodyFixed=turning, loadVectorUserFunction=vector))
