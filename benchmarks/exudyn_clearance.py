"""The rigid slider-crank with play at its wrist pin in Exudyn: a ball, the pin, in a hollow sphere, the bush.

    Crank, Contact (numbers of `clearance_reference`) -> simulate -> ContactHistory

The mechanism has as few coordinates as it can have there and no constraint, so that explicit methods apply: crank and
rod are a kinematic tree, the crank's inertia so large that its rate does not change by 1e-10 of itself; the slider is a
mass on a line. The x-y plane has y down.

The contact is Exudyn's `ContactSphereSphere` with the impact model 1, whose force is

    K delta^n (1 + 3/2 (1 - e) delta' / v),   v = max(v0, v_min),

v0 the speed at the end of the step in which the contact begins; steps are shortened to end near there. With
e = 1 - (1 - r^2) / 2 this is Lankarani and Nikravesh's law for the coefficient r, and with v_min above all speeds Hunt
and Crossley's: chi = 3/2 (1 - e) / v_min. It does not bound the force from below at zero; nothing here separates so
fast that this would count.

Units: SI, rad.  Source: J. Gerstmayr, Exudyn - a C++-based Python package for flexible multibody systems, Multibody
Syst. Dyn. 60 (2024) 533-561.
"""

import time
from typing import NamedTuple

import numpy as np
from clearance_reference import GRAVITY, Contact, Crank
from exudyn_engine import exu, exut

BEARING = 0.01  # m, radius of the hollow sphere; only the clearance counts
HEAVY = 1e7  # kg m^2, of the crank
Output, Solver = exu.OutputVariableType, exu.DynamicSolverType


class ContactHistory(NamedTuple):
    """At the ends of steps: times [s], penetration [m], force [N]; processor time of the integration [s]."""

    times: np.ndarray
    depth: np.ndarray
    force: np.ndarray
    cpu: float


class SolverSettings(NamedTuple):
    """How Exudyn integrates: by "dopri5" with a tolerance and a longest step, or by "generalised_alpha" with Newton's
    tolerance and a step; this: modified Newton, with a new Jacobian in every step or only when it converges slowly."""

    method: str
    step: float
    tolerance: float
    modified: bool = True
    new_jacobian: bool = False
    spectral_radius: float = 0.6

    @property
    def name(self) -> str:
        """For tables."""
        size = f"{1e6 * self.step:g} us"
        if self.method == "dopri5":
            return f"DOPRI5, tolerance {self.tolerance:g}, at most {size}"
        return f"generalised alpha, {size}, tolerance {self.tolerance:g}"


def build(crank: Crank, contact: Contact):
    """The assembled system: container, system, sensors of the gap and of the force."""
    container = exu.SystemContainer()
    mbs = container.AddSystem()
    turning = mbs.AddNode(
        exut.NodeGenericODE2(
            referenceCoordinates=[0.0, 0.0],
            initialCoordinates=[0.0, 0.0],
            initialCoordinates_t=[crank.rate, crank.start()[2] - crank.rate],
            numberOfODE2Coordinates=2,
        )
    )
    tree = mbs.AddObject(
        exut.ObjectKinematicTree(
            nodeNumber=turning,
            jointTypes=[exu.JointType.RevoluteZ] * 2,
            linkParents=[-1, 0],
            jointTransformations=exu.Matrix3DList([np.eye(3)] * 2),
            jointOffsets=exu.Vector3DList([[0.0, 0.0, 0.0], [crank.crank, 0.0, 0.0]]),
            linkInertiasCOM=exu.Matrix3DList([np.diag([0.0, 0.0, HEAVY]), np.diag([0.0, 0.0, crank.inertia])]),
            linkCOMs=exu.Vector3DList([[0.0, 0.0, 0.0], [crank.centre, 0.0, 0.0]]),
            linkMasses=[0.0, crank.mass],
            gravity=[0.0, GRAVITY, 0.0],
        )
    )
    place = mbs.AddNode(exut.Node1D(referenceCoordinates=[0.0]))
    slider = mbs.AddObject(
        exut.ObjectMass1D(mass=crank.slider, nodeNumber=place, referencePosition=[crank.crank + crank.rod, 0.0, 0.0])
    )
    pin = exut.MarkerKinematicTreeRigid(objectNumber=tree, linkNumber=1, localPosition=[crank.rod, 0.0, 0.0])
    bush = exut.MarkerBodyRigid(bodyNumber=slider)
    radial = float(contact.radial)
    memory = exut.NodeGenericData(numberOfDataCoordinates=4, initialCoordinates=[radial, 0.0, 0.0, 0.0])
    touching = mbs.AddObject(
        exut.ObjectContactSphereSphere(
            markerNumbers=[mbs.AddMarker(pin), mbs.AddMarker(bush)],
            nodeNumber=mbs.AddNode(memory),
            spheresRadii=[BEARING - radial, BEARING],
            isHollowSphere1=True,
            contactStiffness=contact.stiffness,
            contactStiffnessExponent=1.5,
            impactModel=1,
            **_losses(contact),
        )
    )
    sensors = [
        mbs.AddSensor(
            exut.SensorObject(objectNumber=touching, outputVariableType=what, storeInternal=True, writeToFile=False)
        )
        for what in (Output.DisplacementLocal, Output.Force)
    ]
    mbs.Assemble()
    return container, mbs, *sensors


def _losses(contact: Contact) -> dict:
    if contact.restitution is not None:
        return {"restitutionCoefficient": 1.0 - 0.5 * (1.0 - contact.restitution**2), "minimumImpactVelocity": 0.0}
    fast = 1.0 / contact.damping if contact.damping else 1.0  # m/s, above all speeds of impacts
    return {"restitutionCoefficient": 1.0 - fast * contact.damping / 1.5, "minimumImpactVelocity": fast}


def simulate(crank: Crank, contact: Contact, duration: float, settings: SolverSettings) -> ContactHistory:
    """The motion from the start, with the ends of all steps recorded.

    **Raises:** exudyn's `SolverError` where it fails.
    """
    container, mbs, gap, force = build(crank, contact)
    s = exu.SimulationSettings()
    s.solution.file.write = False
    s.solution.sensors.writePeriod = 0.0
    s.parallel.numberOfThreads = 1
    t = s.timeIntegration
    t.verboseMode = 0
    t.minimumStepSize = 1e-13
    t.endTime, t.numberOfSteps = duration, max(1, round(duration / settings.step))
    if settings.method == "dopri5":
        t.automaticStepSize = True
        t.relativeTolerance, t.absoluteTolerance = settings.tolerance, 0.1 * settings.tolerance
    else:
        t.generalizedAlpha.spectralRadius = settings.spectral_radius
        t.newton.useModifiedNewton = settings.modified
        t.newton.modifiedNewtonJacUpdatePerStep = settings.new_jacobian
        t.newton.relativeTolerance = settings.tolerance
        t.newton.absoluteTolerance = 1e-10
    before = time.thread_time()
    mbs.SolveDynamic(s, solverType=Solver.DOPRI5 if settings.method == "dopri5" else Solver.GeneralizedAlpha)
    cpu = time.thread_time() - before
    gaps, forces = (np.array(mbs.GetSensorStoredData(sensor)) for sensor in (gap, force))
    del container  # holds the system until here
    return ContactHistory(gaps[:, 0], -gaps[:, 1], np.linalg.norm(forces[:, 1:], axis=1), cpu)
