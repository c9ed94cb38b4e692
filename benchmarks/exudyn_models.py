"""Any linkage of rfem_jax as a multibody system of Exudyn.

    Model + errors -> Linkage (plain numbers) -> System -> exudyn_runs: statics, motion, loads

Only numbers are shared (`apply_errors`: masses, inertias, joint frames with their errors, stiffnesses);
kinematics, element, constraints, statics and integration are Exudyn's own.  Every rfe is a rigid
body with absolute coordinates, every sde a six-dof connector between its two faces, every joint a
revolute joint with five multipliers.

The connector.  Exudyn's default form measures the rotation by Tait-Bryan angles in the axes of its
first marker and applies the force at both markers: not symmetric, and the pair of forces leaves a
moment.  The `intrinsic` form takes the logarithm of the relative motion in SE(3) and acts in the
mid-frame: it does not depend on the order of the markers and keeps the balance of moments, so it is
the nearest to a geometrically exact element, and the default here.

Axes.  Exudyn's revolute joint turns about z, ours about y: all axes, global and of bodies, are
renamed in a circle, (x, y, z) there = (z, x, y) here.

Units: SI, rad.  Source: J. Gerstmayr, Exudyn - a C++-based Python package for flexible multibody
systems, Multibody Syst. Dyn. 60 (2024) 533-561.
"""

import contextlib
import io
import os
import sys
from typing import NamedTuple

os.environ.setdefault("OMP_NUM_THREADS", "1")
sys.exudynFast = True  # the module without range checks, for fair times

import equinox as eqx  # noqa: E402
import numpy as np  # noqa: E402

try:
    with contextlib.redirect_stdout(io.StringIO()):
        import exudyn as exu
        import exudyn.utilities as exut
except ImportError as missing:
    raise SystemExit(
        "The package exudyn must be there to compare with it, but it cannot be imported; install "
        'it with `pip install "rfem_jax[bench]"`.'
    ) from missing

from rfem_jax.mechanics.kinematics import all_frames, motion_of  # noqa: E402
from rfem_jax.mechanics.loads import static_state  # noqa: E402
from rfem_jax.mechanics.model import BASE, Model  # noqa: E402
from rfem_jax.mechanics.model_with_errors import AssemblyErrors, apply_errors  # noqa: E402

exu.config.printToConsole = False  # a solver that fails says so by its exception

TURNED = [2, 0, 1]  # ours -> Exudyn's axes
BACK = [1, 2, 0]
HINGE = 2


class Linkage(NamedTuple):
    """A discretised mechanism with its errors in Exudyn's axes; bodies are the rfes.

    rotation (n, 3, 3), centre (n, 3): nominal start poses of the bodies, loops still open by the
    errors; mass (n,), inertia (n, 3, 3) about the centre of mass; joints: (name, is a cut joint,
    parent and child: body, frame and point on it); elements: (left body, right body, point on each,
    stiffness (6,), damping time); driven: index of the driven joint; start_angle [rad].
    """

    rotation: np.ndarray
    centre: np.ndarray
    mass: np.ndarray
    inertia: np.ndarray
    joints: list
    elements: list
    gravity: np.ndarray
    driven: int | None
    start_angle: float
    order: tuple[str, ...]


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
        return node, _turned(np.asarray(rotations)[:, :, j]), at[TURNED]

    joints = [
        (
            name,
            j >= n,
            side(topology.parents[j], actual.seat_rotation, actual.seat_position, j),
            side(topology.children[j], actual.bore_rotation, actual.bore_position, j),
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
        driven=topology.driven,
        start_angle=0.0 if topology.driven is None else float(model.start_joints[topology.driven]),
        order=model.joint_names,
    )


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
    """An assembled Exudyn system; hold: the constraint on the driven angle or None; loads: of the
    drive; sensors: joint -> (force, couples, rotation); place_sensor: of the tracked joint's
    position; container keeps the system alive."""

    mbs: object
    container: object
    bodies: list
    hold: object
    hold_sensor: object
    loads: list
    sensors: dict
    rate_sensor: object
    place_sensor: object


def build(
    link: Linkage,
    settings: Settings,
    poses=None,
    velocities=None,
    angle=None,
    moment=None,
    track=None,
) -> System:
    """An Exudyn system of a linkage.

    **Arguments:** `poses`: rotations (n, 3, 3), centres (n, 3) of the bodies (None: nominal);
    `velocities`: angular and of the centres (n, 3) each (None: rest); `angle`: t -> angle turned by
    the driven joint, prescribed (None: free); `moment`: t -> moment on the driven joint [N m];
    `track`: name of a joint whose position is recorded.
    """
    container = exu.SystemContainer()
    mbs = container.AddSystem()
    rotations, centres = (link.rotation, link.centre) if poses is None else poses
    still = np.zeros((len(link.mass), 3))
    angular, linear = (still, still) if velocities is None else velocities
    bodies = [
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
    sensors, loads, hold, hold_sensor, rate_sensor, place = {}, [], None, None, None, None
    for j, (name, _, parent, child) in enumerate(link.joints):
        markers = [marker(parent[0], parent[2]), marker(child[0], child[2])]
        number = mbs.AddObject(
            exut.ObjectJointRevoluteZ(markerNumbers=markers, rotationMarker0=parent[1], rotationMarker1=child[1])
        )
        kinds = (
            exu.OutputVariableType.ForceLocal,
            exu.OutputVariableType.TorqueLocal,
            exu.OutputVariableType.Rotation,
        )
        sensors[name] = [_sensor(mbs, number, kind) for kind in kinds]
        if name == track:
            place = _sensor(mbs, number, exu.OutputVariableType.Position)
        if j != link.driven:
            continue
        rate_sensor = _sensor(mbs, number, exu.OutputVariableType.AngularVelocityLocal)
        if angle is not None:
            hold = mbs.AddObject(
                exut.ObjectJointGeneric(
                    markerNumbers=markers,
                    constrainedAxes=[0, 0, 0, 0, 0, 1],
                    rotationMarker0=parent[1] @ _about_hinge(link.start_angle),
                    rotationMarker1=child[1],
                    offsetUserFunction=lambda mbs, t, item, _: [0, 0, 0, 0, 0, angle(t)],
                )
            )
            hold_sensor = _sensor(mbs, hold, exu.OutputVariableType.TorqueLocal)
        if moment is not None:
            loads += _drive_loads(mbs, markers, parent, child, moment)
    mbs.Assemble()
    return System(mbs, container, bodies, hold, hold_sensor, loads, sensors, rate_sensor, place)


def _sensor(mbs, number, kind):
    return mbs.AddSensor(
        exut.SensorObject(objectNumber=number, outputVariableType=kind, storeInternal=True, writeToFile=False)
    )


def _drive_loads(mbs, markers, parent, child, moment):
    """The moment on the child about the hinge, and its reaction on a parent other than the base."""
    if parent[0] == BASE:
        return [_torque(mbs, markers[1], parent[1][:, HINGE], moment, turning=False)]
    return [
        _torque(mbs, marker, sign * frame[:, HINGE], moment, turning=True)
        for marker, (_, frame, _), sign in zip(markers, (parent, child), (-1.0, 1.0))
    ]


def _torque(mbs, marker, axis, moment, turning):
    x, y, z = (float(value) for value in axis)

    def torque(mbs, t, _):
        value = moment(t)
        return (value * x, value * y, value * z)

    return mbs.AddLoad(exut.LoadTorqueVector(markerNumber=marker, bodyFixed=turning, loadVectorUserFunction=torque))
