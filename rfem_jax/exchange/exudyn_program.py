"""What follows the numbers in a script for Exudyn: build the system, run it, tell the loads.

Place in the pipeline: the text of **exudyn_program** is the second part of what `exudyn_writer` writes; the first one
sets MECHANISM. Nothing of the package is needed there.

Every rfe is a rigid body; the spring-damping elements between them are connectors with six stiffnesses that do not
depend on the order of their ends (Exudyn's `intrinsicFormulation`); joints are constraints with multipliers, from which
the loads come. Frames of joints are turned in the circle, so that Exudyn's z is the axis of a hinge, our y. Units: SI,
rad.
"""

# pyright: reportMissingImports=false, reportUndefinedVariable=false
import sys

import numpy as np

MECHANISM: dict = globals().get("MECHANISM", {})
TO_HINGE = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])  # columns: x, y, z there, in our axes
HELD = {
    "revolute": [1, 1, 1, 1, 1, 0], "prismatic": [1, 0, 1, 1, 1, 1], "cylindrical": [1, 1, 0, 1, 1, 0],
    "spherical": [1, 1, 1, 0, 0, 0], "planar": [0, 0, 1, 1, 1, 0], "fixed": [1, 1, 1, 1, 1, 1],
}  # fmt: skip  # translations, then rotations, along z, x, y of ours


def build(schedule):
    """The container, the system, and sensors by joints; `schedule(t)`: the drive's value at an end of a step."""
    import exudyn as exu
    import exudyn.utilities as exut

    exu.config.printToConsole = False
    container = exu.SystemContainer()
    mbs = container.AddSystem()
    bodies = [
        mbs.CreateRigidBody(
            referencePosition=one["centre"], referenceRotationMatrix=np.array(one["rotation"]),
            initialVelocity=one["velocity"], initialAngularVelocity=one["angular"],
            inertia=exut.RigidBodyInertia(one["mass"], np.array(one["inertia"])), gravity=MECHANISM["gravity"],
            nodeType=exu.NodeType.RotationEulerParameters,
        )
        for one in MECHANISM["bodies"]
    ]  # fmt: skip
    ground = mbs.CreateGround()

    def marker(body, point):
        number = ground if body < 0 else bodies[body]
        return mbs.AddMarker(exut.MarkerBodyRigid(bodyNumber=number, localPosition=point))

    for one in MECHANISM["elements"]:
        mbs.AddObject(
            exut.ObjectConnectorRigidBodySpringDamper(
                markerNumbers=[marker(body, point) for body, point in zip(one["bodies"], one["points"])],
                stiffness=np.diag(one["stiffness"]), damping=np.diag(one["damping"] * np.array(one["stiffness"])),
                intrinsicFormulation=True,
            )
        )  # fmt: skip
    for one in MECHANISM["springs"]:
        mbs.AddObject(
            exut.ObjectConnectorSpringDamper(
                markerNumbers=[marker(body, point) for body, point in zip(one["bodies"], one["points"])],
                stiffness=one["stiffness"], damping=one["damping"], referenceLength=one["length"],
                force=one["preload"],
            )
        )  # fmt: skip
    sensors = {}
    for one in MECHANISM["joints"]:
        markers = [marker(side["body"], side["point"]) for side in (one["seat"], one["bore"])]
        if one["kind"] != "free":
            sensors[one["name"]] = _joint(exu, exut, mbs, one, markers, schedule)
    mbs.Assemble()
    return container, mbs, sensors


def _sensor(exu, exut, mbs, number, what):
    return mbs.AddSensor(
        exut.SensorObject(objectNumber=number, outputVariableType=what, storeInternal=True, writeToFile=False)
    )


def _joint(exu, exut, mbs, one, markers, schedule):
    """A joint with its springs and the drive; its sensors: force, multipliers of rotations, angles; of springs and of
    what enforces a motion with (whether a rotation, axis)."""
    seat, bore = (np.array(side["rotation"]) @ TO_HINGE for side in (one["seat"], one["bore"]))
    number = mbs.AddObject(
        exut.ObjectJointGeneric(
            markerNumbers=markers, constrainedAxes=HELD[one["kind"]], rotationMarker0=seat, rotationMarker1=bore
        )
    )
    what = exu.OutputVariableType
    along = [
        (_spring(exu, exut, mbs, spring, markers, (seat, bore)), spring["rotation"], spring["axis"])
        for spring in one["springs"]
    ]
    drive = MECHANISM["drive"]
    if drive is not None and drive["joint"] == one["name"]:
        if drive["prescribed"]:
            along.append(
                (_hold(exu, exut, mbs, drive, markers, (seat, bore), schedule), drive["rotation"], drive["axis"])
            )
        else:
            _push(exut, mbs, drive, markers, (seat, bore), one["seat"]["body"] < 0, schedule)
    return [_sensor(exu, exut, mbs, number, kind) for kind in (what.ForceLocal, what.TorqueLocal, what.Rotation)], along


def _spring(exu, exut, mbs, spring, markers, frames):
    numbers = {"stiffness": spring["stiffness"], "damping": spring["damping"], "offset": spring["rest"]}
    if spring["rotation"]:
        node = mbs.AddNode(exut.NodeGenericData(numberOfDataCoordinates=1, initialCoordinates=[spring["start"]]))
        number = mbs.AddObject(
            exut.ObjectConnectorTorsionalSpringDamper(
                markerNumbers=markers, nodeNumber=node, rotationMarker0=frames[0], rotationMarker1=frames[1],
                torque=-spring["preload"], **numbers,
            )
        )  # fmt: skip
        return _sensor(exu, exut, mbs, number, exu.OutputVariableType.TorqueLocal)
    axis = list(frames[0][:, spring["axis"]])
    number = mbs.AddObject(
        exut.ObjectConnectorLinearSpringDamper(
            markerNumbers=markers, axisMarker0=axis, force=-spring["preload"], **numbers
        )
    )
    return _sensor(exu, exut, mbs, number, exu.OutputVariableType.ForceLocal)


def _hold(exu, exut, mbs, drive, markers, frames, schedule):
    """A constraint on the driven motion, whose change since the start is `schedule(t)`."""
    at = drive["axis"] + (3 if drive["rotation"] else 0)
    c, s = np.cos(drive["start"]), np.sin(drive["start"])
    seat = frames[0] @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) if drive["rotation"] else frames[0]
    start = 0.0 if drive["rotation"] else drive["start"]
    number = mbs.AddObject(
        exut.ObjectJointGeneric(
            markerNumbers=markers, constrainedAxes=[int(k == at) for k in range(6)], rotationMarker0=seat,
            rotationMarker1=frames[1],
            offsetUserFunction=lambda mbs, t, item, _: [start + schedule(t) if k == at else 0.0 for k in range(6)],
        )
    )  # fmt: skip
    kind = exu.OutputVariableType.TorqueLocal if drive["rotation"] else exu.OutputVariableType.ForceLocal
    return _sensor(exu, exut, mbs, number, kind)


def _push(exut, mbs, drive, markers, frames, on_base, schedule):
    """The drive's moment or force on the child, and the opposite one on a parent that moves."""
    kind = exut.LoadTorqueVector if drive["rotation"] else exut.LoadForceVector
    sides = [(markers[1], frames[0][:, drive["axis"]], 1.0, False)]
    if not on_base:
        sides = [(markers[0], frames[0][:, 2], -1.0, True), (markers[1], frames[1][:, 2], 1.0, True)]
    for marker, axis, sign, turning in sides:

        def vector(mbs, t, _, axis=axis, sign=sign):
            return [float(sign * schedule(t) * x) for x in axis]

        mbs.AddLoad(kind(markerNumber=marker, bodyFixed=turning, loadVectorUserFunction=vector))


def simulate(refine=1):
    """Times, and forces (T,) [N] and moments (T,) [N m] of all joints by their names; `refine`: steps for each."""
    import exudyn as exu

    state = {"start": 0.0, "step": 1.0, "values": [0.0]}

    def schedule(t):
        return state["values"][round((t - state["start"]) / state["step"])]

    container, mbs, sensors = build(schedule)
    settings = exu.SimulationSettings()
    settings.solution.file.write = False
    settings.parallel.numberOfThreads = 1
    settings.linearSolver.solverType = exu.LinearSolverType.EigenSparse
    settings.timeIntegration.verboseMode = 0
    settings.timeIntegration.generalizedAlpha.spectralRadius = 0.6
    settings.timeIntegration.generalizedAlpha.computeInitialAccelerations = MECHANISM["known"]
    settings.timeIntegration.newton.useModifiedNewton = True
    settings.timeIntegration.newton.relativeTolerance = 1e-8
    settings.timeIntegration.newton.absoluteTolerance = MECHANISM["tolerance"]
    settings.timeIntegration.adaptiveStep = False
    times, parts = [], []
    for piece in MECHANISM["pieces"]:
        count = refine * (len(piece["values"]) - 1)
        coarse = np.linspace(piece["begin"], piece["end"], len(piece["values"]))
        fine = np.linspace(piece["begin"], piece["end"], count + 1)
        step = (piece["end"] - piece["begin"]) / count
        state.update(start=piece["begin"], step=step, values=list(np.interp(fine, coarse, piece["values"])))
        settings.timeIntegration.startTime, settings.timeIntegration.endTime = piece["begin"], piece["end"]
        settings.timeIntegration.numberOfSteps = count
        settings.solution.sensors.writePeriod = 0.999 * step
        mbs.SolveDynamic(settings, updateInitialValues=True)
        found = {name: _loads(mbs, name, *of) for name, of in sensors.items()}
        times.append(np.array(mbs.GetSensorStoredData(next(iter(sensors.values()))[0][0]))[:, 0])
        parts.append(found)
    del container
    loads = {name: [np.concatenate([part[name][k] for part in parts]) for k in range(2)] for name in sensors}
    return np.concatenate(times), {n: one[0] for n, one in loads.items()}, {n: one[1] for n, one in loads.items()}


def _loads(mbs, name, of_constraint, along):
    """Resultant force and moment of a joint, (T,) each, about the child's point."""
    kind = next(one["kind"] for one in MECHANISM["joints"] if one["name"] == name)
    force, couples, angles = (np.array(mbs.GetSensorStoredData(one))[:, 1:] for one in of_constraint)
    force, moment = -force, _moment(kind, couples, angles)
    for sensor, rotation, axis in along:
        values = np.array(mbs.GetSensorStoredData(sensor))[:, 1:]
        value = values[:, 0] if values.shape[1] == 1 else values[:, axis] * (-1.0 if rotation else 1.0)
        (moment if rotation else force)[:, axis] -= value
    if not MECHANISM["known"]:
        force[0], moment[0] = force[1], moment[1]
    return np.linalg.norm(force, axis=1), np.linalg.norm(moment, axis=1)


def _moment(kind, couples, angles):
    """Moment (T, 3) on the child by the multipliers of its rotations, in the parent's axes."""
    held = sum(HELD[kind][3:])
    zero = np.zeros(len(couples))
    if held == 3:
        return np.stack([-couples[:, 0], couples[:, 1], couples[:, 2]], axis=1)
    if held == 0:
        return np.zeros((len(couples), 3))
    in_child = np.stack([-couples[:, 1], couples[:, 0], zero], axis=1)
    c, s = np.cos(angles[:, 2]), np.sin(angles[:, 2])  # both axes of a hinge are one: only it turns
    return np.stack([c * in_child[:, 0] - s * in_child[:, 1], s * in_child[:, 0] + c * in_child[:, 1], zero], axis=1)


def rms_loads(refine=1):
    """RMS force [N] and moment [N m] of all joints over the whole time, by their names."""
    times, forces, moments = simulate(refine)
    span = times[-1] - times[0]
    root = dict.fromkeys(forces, 0.0), dict.fromkeys(forces, 0.0)
    for found, values in zip(root, (forces, moments)):
        for name, one in values.items():
            square = one**2
            found[name] = float(np.sqrt(np.sum(0.5 * (square[1:] + square[:-1]) * np.diff(times)) / span))
    return root


def main():
    """Print the RMS loads; the first argument: how many steps for each."""
    force, moment = rms_loads(int(sys.argv[1]) if len(sys.argv) > 1 else 1)
    print(f"{'joint':12}{'RMS force, N':>18}{'RMS moment, N m':>18}")
    for name, value in force.items():
        print(f"{name:12}{value:18.9g}{moment[name]:18.9g}")


if __name__ == "__main__":
    main()
