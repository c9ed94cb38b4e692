"""The geared five-bar of the validation: Exudyn in absolute planar coordinates against ours, and its limit.

    python benchmarks/exudyn_couplings.py

The limit of its steps, extrapolated by their square, is what `references/geared_mechanisms.json` has. Exudyn's plane is
x, y with angles from x to y: ours are about y, from x to -z.
"""

import jax
import numpy as np
from exudyn_engine import exu, exut

from rfem_jax.validation.geared_mechanisms import (
    APART,
    CRANK,
    DENSITY,
    GROUP,
    MOMENT,
    REFERENCE,
    ROD,
    SIDE,
    TURN,
    lines,
    rod_angles,
    run_five_bar,
)  # fmt: skip

JOINTS = "ABEDC"
STEPS = (5e-5, 2.5e-5)
GRAVITY, DISSIPATION = 9.81, 0.9  # m/s^2; spectral radius of the method at high frequencies


def by_exudyn(step: float, duration: float) -> np.ndarray:
    """Angle of A [rad], moment of the gears at A [N m], and forces (x, z) [N] of all joints at the end."""
    system = exu.SystemContainer().AddSystem()
    left, right = rod_angles(0.0, TURN)

    def along(start, angle, length):
        return np.array(start) + length * np.array([np.cos(angle), -np.sin(angle)])

    def bar(start, angle, length):
        """Node, and markers at both ends."""
        mass = DENSITY * SIDE**2 * length
        inertia = mass * (length**2 + SIDE**2) / 12.0
        place = along(start, angle, 0.5 * length)
        node = system.AddNode(exut.NodeRigidBody2D(referenceCoordinates=[*place, -angle]))
        body = system.AddObject(exut.ObjectRigidBody2D(mass=mass, inertia=inertia, nodeNumber=node))
        marks = [
            system.AddMarker(exut.MarkerBodyPosition(bodyNumber=body, localPosition=[x * length, 0, 0]))
            for x in (0.0, -0.5, 0.5)
        ]
        system.AddLoad(exut.Force(markerNumber=marks[0], loadVector=[0, -GRAVITY * mass, 0]))
        return node, *marks[1:]

    one, two = bar([0, 0], 0.0, CRANK), bar([APART, 0], TURN, CRANK)
    rods = bar(along([0, 0], 0.0, CRANK), left, ROD), bar(along([APART, 0], TURN, CRANK), right, ROD)
    ground = system.AddObject(exut.ObjectGround())
    feet = [system.AddMarker(exut.MarkerBodyPosition(bodyNumber=ground, localPosition=[x, 0, 0])) for x in (0.0, APART)]
    pairs = (feet[0], one[1]), (one[2], rods[0][1]), (feet[1], two[1]), (two[2], rods[1][1]), (rods[0][2], rods[1][2])
    for pair in pairs:
        system.AddObject(exut.RevoluteJoint2D(markerNumbers=list(pair)))
    angles = [system.AddMarker(exut.MarkerNodeCoordinate(nodeNumber=of[0], coordinate=2)) for of in (one, two)]
    system.AddObject(exut.CoordinateConstraint(markerNumbers=angles))
    system.AddLoad(exut.LoadCoordinate(markerNumber=angles[0], load=-MOMENT))
    system.Assemble()
    settings = exu.SimulationSettings()
    settings.timeIntegration.numberOfSteps = round(duration / step)
    settings.timeIntegration.endTime = duration
    settings.timeIntegration.newton.relativeTolerance = 1e-10
    settings.timeIntegration.generalizedAlpha.spectralRadius = DISSIPATION
    settings.timeIntegration.generalizedAlpha.computeInitialAccelerations = True
    settings.solution.file.write = False
    system.SolveDynamic(settings)
    multipliers = np.array(system.systemData.GetAECoordinates())
    turned = system.systemData.GetODE2Coordinates()[2]
    return np.array([-turned, -multipliers[-1], *-multipliers[:-1]])


def main() -> None:
    jax.config.update("jax_enable_x64", True)
    ours = {line.name: line.value for line in lines(run_five_bar())}
    print(f"{GROUP}: {'':14}{'Exudyn, limit':>16}{'rfem_jax':>16}{'difference':>12}")
    for time in REFERENCE["at"]:
        coarse, fine = (by_exudyn(step, float(time)) for step in STEPS)
        limit = fine + (fine - coarse) / ((STEPS[0] / STEPS[1]) ** 2 - 1.0)
        names = [f"angle of A at {time} s", f"moment of the gears at A at {time} s"]
        names += [f"force {axis} of {joint} at {time} s" for joint in JOINTS for axis in "xz"]
        for name, value in zip(names, limit, strict=True):
            print(f"{name:40}{value:16.9g}{ours[name]:16.9g}{ours[name] / value - 1.0:12.1e}")


if __name__ == "__main__":
    main()
