"""A four-bar with a curved coupler and a tilted hinge: straight pieces in Exudyn, our curved ones, and the limit.

    python benchmarks/exudyn_curved.py [--quick]

The four-bar with a tilted hinge of the validation (Bauchau et al. 2016), whose coupler is an arc. Nothing of ours is
shared with Exudyn's model but lengths and section constants: its links are chains of straight pieces between points of
the arc, each with a connector of six stiffnesses in its middle; rigid bodies reach from middle to middle. Both converge
with the square of the number of pieces to the same beam, though not by the same way.
"""

import argparse
import itertools
import time
from typing import NamedTuple

import jax

jax.config.update("jax_enable_x64", True)

import numpy as np  # noqa: E402
from exudyn_engine import exu, exut  # noqa: E402

from rfem_jax import (  # noqa: E402
    STATUS,
    AxisPoint,
    GeneralisedAlpha,
    GivenSection,
    Joint,
    Link,
    Mechanism,
    PrescribedSpinUp,
    Simulation,
    assembly_errors,
    discretise,
    simulate,
)

CRANK, APART, RISE = 0.12, 0.24, 0.05  # m: lengths of crank and rocker, of the base, and of the arc's middle
TILT = np.radians(5.0)  # of the pin between coupler and rocker
RATE, SPIN_UP, DURATION = 2.0, 0.3, 0.6  # rad/s, s
WINDOW = 0.2  # s, from which on RMS loads are taken
STEP, DISSIPATION = 1e-3, 0.6  # s; spectral radius of both methods at high frequencies
THICK = (52.99e6, 16.88e6, 16.88e6, 733.5, 1131.0, 1131.0, 1.997, 2 * 42.6e-6, 42.6e-6, 42.6e-6)
THIN = (13.25e6, 4.22e6, 4.22e6, 45.84, 70.66, 70.66, 0.4992, 2 * 2.662e-6, 2.662e-6, 2.662e-6)
JOINTS, KINDS = "ABCD", ("force", "moment")
NAMES = [f"{kind} {joint}" for kind in KINDS for joint in JOINTS]


class Found(NamedTuple):
    """RMS loads by the names above [N, N m], and CPU seconds of the integration alone."""

    values: np.ndarray
    seconds: float


def turned(times):
    """Angle [rad] of the crank since the start."""
    x = np.minimum(np.asarray(times) / SPIN_UP, 1.0)
    return RATE * (SPIN_UP * (0.5 * x**2 + (np.cos(2.0 * np.pi * x) - 1.0) / (4.0 * np.pi**2)) +
                   np.maximum(np.asarray(times) - SPIN_UP, 0.0))  # fmt: skip


def root_mean_square(times, loads) -> float:
    inside = times >= WINDOW - 1e-9
    square = np.sum(loads[inside] ** 2, axis=1)
    return float(np.sqrt(np.trapezoid(square, times[inside]) / (DURATION - WINDOW)))


def by_us(pieces: int) -> Found:
    """With geometrically exact elements; the second run, of a program that is compiled."""
    thick, thin = GivenSection(*THICK), GivenSection(*THIN)
    arc = AxisPoint((APART, 0.0, 0.0), through=(0.5 * APART, 0.0, RISE))
    links = [
        Link("crank", CRANK, thick, rfes=pieces + 1),
        Link("coupler", section=thick, axis=[arc], rfes=pieces + 1),
        Link("rocker", CRANK, thin, rfes=pieces + 1),
    ]
    joints = [
        Joint("A", "base", "crank", angle=-0.5 * np.pi),
        Joint("B", "crank", "coupler", angle=0.5 * np.pi),
        Joint("D", "base", "rocker", position=(APART, 0.0, 0.0), angle=-0.5 * np.pi),
        Joint("C", "coupler", "rocker", cut=True),
    ]
    mechanism = Mechanism(links, joints, gravity=(0.0, 0.0, 0.0), driven_joint="A", elements="geometrically_exact")
    model = discretise(mechanism)
    asked = Simulation(model, drive=PrescribedSpinUp("A", RATE, SPIN_UP), duration=DURATION, save_every=STEP,
                       method=GeneralisedAlpha(step=STEP, spectral_radius=DISSIPATION))  # fmt: skip
    errors = assembly_errors(model, {"C.pin_tilt_x": TILT})
    run, seconds = None, np.inf
    for _ in range(3):
        before = time.process_time()
        run = jax.block_until_ready(simulate(asked, errors))
        seconds = min(seconds, time.process_time() - before)
    assert run is not None and STATUS[int(run.status)].name == "ok"
    times = np.asarray(run.times)
    loads = (getattr(run.loads[joint], kind) for kind in KINDS for joint in JOINTS)
    return Found(np.array([root_mean_square(times, np.asarray(one)) for one in loads]), seconds)


def chain(system, points, constants):
    """Bodies of a link through points (m + 1, 3) [m], and their centres of mass; all axes are global at the start."""
    density, rotary = constants[6], np.diag(constants[7:])
    bodies, centres, m = [], [], len(points) - 1
    middles = 0.5 * (points[1:] + points[:-1])
    for k in range(m + 1):
        ends = [*middles[max(k - 1, 0) : k], points[k], *middles[k : k + 1]]
        mass, first, inertia = 0.0, np.zeros(3), np.zeros((3, 3))
        for a, b in itertools.pairwise(ends):
            length, axes = np.linalg.norm(b - a), frame_along(b - a)
            part = density * length
            mass, first = mass + part, first + part * 0.5 * (a + b)
            inertia += length * axes @ rotary @ axes.T + spread(part, 0.5 * (a + b))
            inertia += part * length**2 / 12.0 * axes @ np.diag([0.0, 1.0, 1.0]) @ axes.T
        centre = first / mass
        body = system.CreateRigidBody(
            referencePosition=list(centre),
            inertia=exut.RigidBodyInertia(mass, inertia - spread(mass, centre)),
            nodeType=exu.NodeType.RotationRxyz,
        )
        bodies.append(body)
        centres.append(centre)
    for k in range(m):
        along = points[k + 1] - points[k]
        stiffness, axes = np.diag(constants[:6]) / np.linalg.norm(along), frame_along(along)
        markers = [marker(system, bodies[j], middles[k] - centres[j], axes) for j in (k, k + 1)]
        system.AddObject(exut.ObjectConnectorRigidBodySpringDamper(
            markerNumbers=markers, stiffness=stiffness, damping=0.0 * stiffness, useIntrinsicFormulation=True,
        ))  # fmt: skip
    return bodies, centres


def frame_along(vector):
    """Axes, columns, of a piece: x along it, y that of the hinges."""
    x = vector / np.linalg.norm(vector)
    y = np.array([0.0, 1.0, 0.0])
    return np.stack([x, y, np.cross(x, y)], axis=1)


def spread(mass, place):
    return mass * (place @ place * np.eye(3) - np.outer(place, place))


def marker(system, body, place, axes):
    frame = exu.HT(rotation=axes, translation=list(place))
    return system.AddMarker(exut.MarkerBodyRigid(bodyNumber=body, localHT=frame))


def arc_points(m: int):
    """Points of the coupler's arc [m], from B to C, above the crank that stands upright."""
    radius = (0.25 * APART**2 + RISE**2) / (2.0 * RISE)
    half = np.arcsin(0.5 * APART / radius)
    angles = np.linspace(-half, half, m + 1)
    x, z = 0.5 * APART + radius * np.sin(angles), radius * (np.cos(angles) - np.cos(half))
    return np.stack([x, 0.0 * x, CRANK + z], axis=1)


def by_exudyn(m: int, step: float) -> Found:
    system = exu.SystemContainer().AddSystem()
    up, right = np.linspace(0.0, CRANK, m + 1)[:, None] * np.array([0.0, 0.0, 1.0]), np.array([APART, 0.0, 0.0])
    crank, coupler, rocker = (
        chain(system, points, constants)
        for points, constants in ((up, THICK), (arc_points(m), THICK), (up + right, THIN))
    )
    ground = system.CreateGround()
    hinge = np.array([0.0, 1.0, 0.0])
    tilted = np.array([0.0, np.cos(TILT), np.sin(TILT)])
    top = np.array([0.0, 0.0, CRANK])
    pairs = {
        "A": (None, (crank, 0), np.zeros(3), hinge),
        "B": ((crank, -1), (coupler, 0), top, hinge),
        "C": ((coupler, -1), (rocker, -1), top + right, tilted),
        "D": (None, (rocker, 0), right, hinge),
    }
    sensors, hold = {}, None
    for name, (*sides, place, axis) in pairs.items():
        x = np.array([1.0, 0.0, 0.0])
        axes = np.stack([x, np.cross(axis, x), axis], axis=1)
        ends = [(ground, place) if one is None else (one[0][0][one[1]], place - one[0][1][one[1]]) for one in sides]
        markers = [marker(system, body, point, axes) for body, point in ends]
        number = system.AddObject(exut.ObjectJointGeneric(markerNumbers=markers, constrainedAxes=[1, 1, 1, 1, 1, 0]))
        sensors[name] = [sensed(system, number, what) for what in ("ForceLocal", "TorqueLocal")]
        if name == "A":
            number = system.AddObject(exut.ObjectJointGeneric(
                markerNumbers=markers, constrainedAxes=[0, 0, 0, 0, 0, 1],
                offsetUserFunction=lambda mbs, t, item, _: [0.0] * 5 + [float(turned(t))],
            ))  # fmt: skip
            hold = sensed(system, number, "TorqueLocal")
    system.Assemble()
    settings = exu.SimulationSettings()
    settings.solution.file.write = False
    settings.parallel.numberOfThreads = 1
    settings.linearSolver.solverType = exu.LinearSolverType.EigenSparse
    integration = settings.timeIntegration
    integration.numberOfSteps, integration.endTime = round(DURATION / step), DURATION
    integration.generalizedAlpha.spectralRadius = DISSIPATION
    integration.generalizedAlpha.computeInitialAccelerations = True
    integration.newton.useModifiedNewton = True
    # No residual is smaller than what rounding of a metre makes in the stiffest connector.
    noise = 4e-16 * THICK[0] * m / CRANK
    integration.newton.relativeTolerance, integration.newton.absoluteTolerance = 1e-8, max(1e-7, noise)
    integration.verboseMode = 0
    settings.solution.sensors.writePeriod = 0.999 * step
    before = time.thread_time()
    system.SolveDynamic(settings)
    seconds = time.thread_time() - before
    history = {name: [np.array(system.GetSensorStoredData(one)) for one in both] for name, both in sensors.items()}
    history["A"][1][:, 3] += np.array(system.GetSensorStoredData(hold))[:, 3]
    values = [root_mean_square(history[joint][k][:, 0], history[joint][k][:, 1:]) for k in (0, 1) for joint in JOINTS]
    return Found(np.array(values), seconds)


def sensed(system, number, what):
    kind = getattr(exu.OutputVariableType, what)
    return system.AddSensor(
        exut.SensorObject(objectNumber=number, outputVariableType=kind, storeInternal=True, writeToFile=False)
    )


def main() -> None:
    parser = argparse.ArgumentParser(description="A four-bar with a curved coupler, beside Exudyn.")
    parser.add_argument("--quick", action="store_true", help="few pieces, no halved step")
    quick = parser.parse_args().quick
    pieces = (4, 8) if quick else (4, 8, 16)
    theirs, ours = ({m: make(m) for m in pieces} for make in (lambda m: by_exudyn(m, STEP), by_us))
    coarse, fine = (theirs[m].values for m in pieces[-2:])
    limit = fine + (fine - coarse) / 3.0
    own = ours[pieces[-1]].values + (ours[pieces[-1]].values - ours[pieces[-2]].values) / 3.0
    columns = [(f"Exudyn {m}", theirs[m]) for m in pieces] + [(f"rfem_jax {m}", ours[m]) for m in pieces]
    print(f"{'RMS load':12}{'limit':>12}" + "".join(f"{name:>14}" for name, _ in columns) + f"{'our limit':>14}")
    for k, name in enumerate(NAMES):
        cells = [*(found.values[k] / limit[k] - 1.0 for _, found in columns), own[k] / limit[k] - 1.0]
        print(f"{name:12}{limit[k]:12.6g}" + "".join(f"{100.0 * one:13.3f}%" for one in cells))
    print(f"{'CPU, ms':24}" + "".join(f"{1e3 * found.seconds:14.1f}" for _, found in columns))
    if not quick:
        change = np.abs(by_exudyn(8, 0.5 * STEP).values / theirs[8].values - 1.0).max()
        print(f"Exudyn 8, half of the step: loads change by at most {100.0 * change:.4f} %")
    print(f"limits differ by at most {100.0 * np.abs(own / limit - 1.0).max():.4f} %")


if __name__ == "__main__":
    main()
