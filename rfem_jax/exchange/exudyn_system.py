"""A mechanism's numbers as a system of Exudyn.

Place in the pipeline: first part of the program of scripts for Exudyn: **exudyn_system** -> exudyn_loads ->
exudyn_program. `exudyn_writer` writes the texts of the three one after the other, so that scripts need nothing of the
package; with it they are modules, too. The numbers are made by `exudyn_mechanism`.

Every rfe is a rigid body in absolute coordinates; the spring-damping elements between them are connectors with six
stiffnesses; joints are constraints with multipliers between the frames J0 on the parent (seat) and J1 on the child
(bore). Springs and dampers of compliant joints are one connector between the same frames; laws along one motion, and
friction in it, are scalar spring-dampers, with formulas that Exudyn compiles where it can.

Connectors of elements have Exudyn's `intrinsic` form, the logarithm of the relative motion, whose force acts in the
middle: it does not depend on the order of the ends and keeps the balance of moments. Its default form measures
Tait-Bryan angles in the axes of the first end.

All numbers are in Exudyn's axes, whose hinges turn about z: (x, y, z) there = (z, x, y) here, of the globe and of all
bodies. Results are in ours. Units: SI, rad.
"""

# pyright: reportMissingImports=false
import math
from typing import Any, NamedTuple

import exudyn as exu
import exudyn.utilities as exut
import numpy as np

HINGE = 2
# Exudyn's universal constraint is x of J0 . z of J1; ours y . z is there z . x: both frames are turned by 180 deg.
CROSS = np.array([[0.0, 0.0, 1.0], [0.0, -1.0, 0.0], [1.0, 0.0, 0.0]])
NODES = {"euler_parameters": "RotationEulerParameters", "rotation_vector": "RotationRotationVector",
         "angles": "RotationRxyz"}  # fmt: skip
Output = exu.OutputVariableType

exu.config.printToConsole = False  # a solver that fails says so by its exception


class Settings(NamedTuple):
    """How Exudyn models and integrates.

    spectral_radius of generalised-alpha; nodes: "rotation_vector" (Lie group), "euler_parameters" or "angles" (x-y-z
    with hinges near z: singular only at 90 deg out of the plane); modified: modified Newton; new_jacobian: modified
    Newton starts every step with a new Jacobian; sparse: Eigen's sparse solver; relative, absolute: tolerances of
    Newton's method; intrinsic: form of the elements.
    """

    spectral_radius: float = 0.6
    nodes: str = "euler_parameters"
    modified: bool = True
    new_jacobian: bool = False
    sparse: bool = True
    relative: float = 1e-8
    absolute: float = 1e-7
    intrinsic: bool = True


DEFAULT = Settings()


class Start(NamedTuple):
    """Of all bodies rotations (n, 3, 3) and centres of mass (n, 3) [m], angular velocities and velocities (n, 3)."""

    rotation: np.ndarray
    centre: np.ndarray
    angular: np.ndarray
    velocity: np.ndarray

    @property
    def resting(self) -> "Start":
        """Without velocities."""
        return self._replace(angular=0.0 * self.angular, velocity=0.0 * self.velocity)


class System(NamedTuple):
    """An assembled system; container: keeps it alive; sensors: joint -> {what it measures: sensor}; hold, rate: sensors
    of the driven motion's constraint and rate; loads: of the drive; places: point or joint -> sensor; idle: (joint,
    axis, sensor) of constraints on idle rotations."""

    mbs: Any
    container: Any
    bodies: list
    sensors: dict[str, dict]
    hold: Any
    rate: Any
    loads: list
    places: dict
    idle: list


def build(mechanism, settings=DEFAULT, start=None, hold=None, push=None, track=(), resting=False) -> System:
    """The system of a mechanism.

    **Arguments:** `start`: None as the mechanism says; `hold`: t -> change of the driven motion since its start,
    prescribed (None: free); `push`: t -> moment [N m] or force [N] of the drive; `track`: points and joints whose
    places are recorded; `resting`: hold idle rotations, for statics.
    """
    container = exu.SystemContainer()
    mbs = container.AddSystem()
    bodies = _add_bodies(mbs, mechanism, settings, start_of(mechanism) if start is None else start)
    ground = mbs.CreateGround()

    def marker(body, point):
        number = ground if body < 0 else bodies[body]
        return mbs.AddMarker(exut.MarkerBodyRigid(bodyNumber=number, localPosition=list(point)))

    _add_elements(mbs, mechanism, settings, marker)
    sensors, loads, idle, held, rate, driven = {}, [], [], None, None, mechanism["driven"]
    for one in mechanism["joints"]:
        markers = [marker(one[side]["body"], one[side]["point"]) for side in ("seat", "bore")]
        number, sensors[one["name"]] = _add_joint(mbs, one, markers)
        for turn in mechanism["idle"] if resting else ():
            if turn["joint"] == one["name"]:
                held_turn = _constrain(mbs, markers, 3 + turn["axis"], frame_of(one["seat"]), np.array(turn["bore"]))
                idle.append((one["name"], turn["axis"], _sensor(mbs, held_turn, Output.TorqueLocal)))
        if driven is None or driven["joint"] != one["name"]:
            continue
        turning = driven["rotation"]
        rate = _sensor(mbs, number, Output.AngularVelocityLocal if turning else Output.VelocityLocal)
        if hold is not None:
            constraint = _prescribe(mbs, driven, one, markers, hold)
            held = _sensor(mbs, constraint, Output.TorqueLocal if turning else Output.ForceLocal)
        if push is not None:
            loads = _push(mbs, driven, one, markers, push)
    places = {}
    for name in track:
        body, point = mechanism["places"][name]
        kind = {"outputVariableType": Output.Position, "storeInternal": True, "writeToFile": False}
        number = ground if body < 0 else bodies[body]
        places[name] = mbs.AddSensor(exut.SensorBody(bodyNumber=number, localPosition=list(point), **kind))
    mbs.Assemble()
    return System(mbs, container, bodies, sensors, held, rate, loads, places, idle)


def start_of(mechanism) -> Start:
    """The start that a mechanism's numbers say."""
    return Start(*(np.array([one[name] for one in mechanism["bodies"]])
                   for name in ("rotation", "centre", "angular", "velocity")))  # fmt: skip


def _add_bodies(mbs, mechanism, settings, start):
    return [
        mbs.CreateRigidBody(
            referencePosition=list(start.centre[i]),
            referenceRotationMatrix=start.rotation[i],
            initialVelocity=list(start.velocity[i]),
            initialAngularVelocity=list(start.angular[i]),
            inertia=exut.RigidBodyInertia(one["mass"], np.array(one["inertia"])),
            gravity=list(mechanism["gravity"]),
            nodeType=getattr(exu.NodeType, NODES[settings.nodes]),
        )
        for i, one in enumerate(mechanism["bodies"])
    ]


def _add_elements(mbs, mechanism, settings, marker) -> None:
    """The spring-damping elements of the links, springs between points and loads at them."""
    for one in mechanism["elements"]:
        stiffness = np.array(one["stiffness"])
        mbs.AddObject(
            exut.ObjectConnectorRigidBodySpringDamper(
                markerNumbers=[marker(*at) for at in zip(one["bodies"], one["points"])],
                stiffness=np.diag(stiffness),
                damping=np.diag(one["damping"] * stiffness),
                intrinsicFormulation=settings.intrinsic,
            )
        )
    for one in mechanism["springs"]:
        markers = [marker(*at) for at in zip(one["bodies"], one["points"])]
        mbs.AddObject(exut.ObjectConnectorSpringDamper(markerNumbers=markers, **one["numbers"]))
    for one in mechanism["loads"]:
        kind = exut.LoadTorqueVector if one["moment"] else exut.LoadForceVector
        at = marker(one["body"], one["point"])
        mbs.AddLoad(kind(markerNumber=at, bodyFixed=one["turning"], loadVector=list(one["value"])))


def frame_of(side):
    return np.array(side["rotation"])


def _sensor(mbs, number, what):
    return mbs.AddSensor(
        exut.SensorObject(objectNumber=number, outputVariableType=what, storeInternal=True, writeToFile=False)
    )


def _add_joint(mbs, one, markers):
    """The constraint of a joint, with what acts in it; and its sensors."""
    frames = [frame_of(one[side]) @ (CROSS if one["kind"] == "universal" else np.eye(3)) for side in ("seat", "bore")]
    ends = {"markerNumbers": markers, "rotationMarker0": frames[0], "rotationMarker1": frames[1]}
    plain_hinge = one["kind"] == "revolute" and one["bushing"] is None
    made = exut.ObjectJointRevoluteZ(**ends) if plain_hinge else exut.ObjectJointGeneric(
        constrainedAxes=one["held"], **ends)  # fmt: skip
    number = mbs.AddObject(made)
    kinds = {"force": Output.ForceLocal, "couples": Output.TorqueLocal, "rotation": Output.Rotation}
    if not plain_hinge:  # nothing moves along its axis; fewer sensors cost less time
        kinds["shift"] = Output.DisplacementLocal
    sensors = {name: _sensor(mbs, number, what) for name, what in kinds.items()}
    if one["bushing"] is not None:
        stiffness, damping = (np.array(one["bushing"][name]) for name in ("stiffness", "damping"))
        spring = exut.ObjectConnectorRigidBodySpringDamper(
            markerNumbers=markers, stiffness=stiffness, damping=damping,
            rotationMarker0=np.array(one["bushing"]["seat"]), rotationMarker1=np.array(one["bushing"]["bore"]),
        )  # fmt: skip
        bushing = mbs.AddObject(spring)
        sensors["bushing_force"] = _sensor(mbs, bushing, Output.ForceLocal)
        sensors["bushing_moment"] = _sensor(mbs, bushing, Output.TorqueLocal)
    for k, law in enumerate(one["laws"]):
        acting = _add_law(mbs, one, law, number, markers)
        if law["inside"]:
            sensors[f"law {k}"] = _sensor(mbs, acting, Output.TorqueLocal if law["rotation"] else Output.ForceLocal)
    return number, sensors


def _add_law(mbs, one, law, held, markers):
    """A law along a motion; held: the joint's constraint."""
    seat, numbers = frame_of(one["seat"]), law["numbers"] if law["type"] == "spring" else {}
    if law["rotation"]:
        turns = mbs.AddNode(exut.NodeGenericData(numberOfDataCoordinates=1, initialCoordinates=[law["start"]]))
        made = exut.ObjectConnectorTorsionalSpringDamper(
            markerNumbers=markers, nodeNumber=turns, rotationMarker0=seat, rotationMarker1=frame_of(one["bore"]),
            **numbers,
        )  # fmt: skip
    else:
        axis = list(seat[:, law["axis"]])
        made = exut.ObjectConnectorLinearSpringDamper(markerNumbers=markers, axisMarker0=axis, **numbers)
    number = mbs.AddObject(made)
    if law["type"] == "spring":
        return number
    name = "springTorqueUserFunction" if law["rotation"] else "springForceUserFunction"
    formula = {"table": _table, "friction": _friction, "friction by load": _friction_by_load}[law["type"]]
    function = formula(law["numbers"], held)
    mbs.SetObjectParameter(number, name, function)
    if law["type"] != "friction by load":
        mbs.SetObjectParameter(number, name, exut.CreateSymbolicUserFunction(mbs, function, name, number))
    return number


def _table(numbers, held):
    """Minus the table as a sum of kinks, constant outside."""
    x, f = np.array(numbers["positions"]), np.array(numbers["forces"])
    kinks = 0.5 * np.diff(np.diff(f) / np.diff(x), prepend=0.0, append=0.0)
    constant = float(f[0] - kinks @ np.abs(x[0] - x))
    pairs = [(float(kink), float(at)) for kink, at in zip(kinks, x)]

    def force(mbs, t, item, x, v, stiffness, damping, offset):
        return -constant - sum(kink * exu.symbolic.abs(x - at) for kink, at in pairs)

    return force


def _friction(numbers, held):
    """Coulomb friction, smooth by tanh or by Brown and McPhee with a larger one before it slides, and viscous one."""
    sliding, more, viscous, rate = (numbers[name] for name in ("sliding", "more", "viscous", "rate"))
    steep = 4.0 if numbers["static"] else 1.0

    def force(mbs, t, item, x, v, stiffness, damping, offset):
        u = v / rate
        dry = sliding * exu.symbolic.tanh(steep * u)
        if more:
            bump = 0.25 * u * u + 0.75
            dry = dry + more * u / (bump * bump)
        return dry + viscous * v

    return force


def _friction_by_load(numbers, held):
    """The same with a share by the resultant force across the axis, that of the constraint at the present iterate."""
    sliding, more, viscous, rate = (numbers[name] for name in ("sliding", "more", "viscous", "rate"))
    arm, more_arm, scale, across = (numbers[name] for name in ("arm", "more_arm", "scale", "across"))
    steep = 4.0 if numbers["static"] else 1.0

    def force(mbs, t, item, x, v, stiffness, damping, offset):
        by_constraint = mbs.GetObjectOutput(held, Output.ForceLocal)
        square = by_constraint[across[0]] ** 2 + by_constraint[across[1]] ** 2
        normal, u = square / math.sqrt(square + scale**2), v / rate
        before = (more + more_arm * normal) * u / (0.25 * u**2 + 0.75) ** 2
        return (sliding + arm * normal) * math.tanh(steep * u) + before + viscous * v

    return force


def _constrain(mbs, markers, at, seat, bore, offset=None):
    """A constraint on one of three translations and three rotations between two frames."""
    held = {"constrainedAxes": [int(k == at) for k in range(6)], "rotationMarker0": seat, "rotationMarker1": bore}
    if offset is not None:
        held["offsetUserFunction"] = lambda mbs, t, item, _: [offset(t) if k == at else 0.0 for k in range(6)]
    return mbs.AddObject(exut.ObjectJointGeneric(markerNumbers=markers, **held))


def _prescribe(mbs, driven, one, markers, change):
    """A constraint on the driven motion, which is `change(t)` more than at the start."""
    seat, bore, start = frame_of(one["seat"]), frame_of(one["bore"]), driven["start"]
    if not driven["rotation"]:
        return _constrain(mbs, markers, driven["axis"], seat, bore, lambda t: start + change(t))
    c, s = math.cos(start), math.sin(start)
    about_hinge = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    return _constrain(mbs, markers, 3 + driven["axis"], seat @ about_hinge, bore, change)


def _push(mbs, driven, one, markers, push):
    """The drive's moment or force on the child, and the opposite one on a parent that moves."""
    seat, bore = frame_of(one["seat"]), frame_of(one["bore"])
    if one["seat"]["body"] >= 0 and not driven["rotation"]:
        axis = list(seat[:, driven["axis"]])
        made = exut.ObjectConnectorLinearSpringDamper(
            markerNumbers=markers, axisMarker0=axis, springForceUserFunction=lambda mbs, t, *_: -push(t)
        )
        mbs.AddObject(made)
        return []
    kind = exut.LoadTorqueVector if driven["rotation"] else exut.LoadForceVector
    sides = [(markers[1], seat[:, driven["axis"]], False)]
    if one["seat"]["body"] >= 0:
        sides = [(markers[0], -seat[:, HINGE], True), (markers[1], bore[:, HINGE], True)]
    loads = []
    for marker, axis, turning in sides:
        x, y, z = axis.tolist()

        def vector(mbs, t, _, x=x, y=y, z=z):
            value = push(t)
            return (value * x, value * y, value * z)

        loads.append(mbs.AddLoad(kind(markerNumber=marker, bodyFixed=turning, loadVectorUserFunction=vector)))
    return loads
