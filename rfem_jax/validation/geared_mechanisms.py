"""A geared five-bar: two cranks whose angles a gear with the ratio 1 ties together, and two rods that meet.

Place in the pipeline: a benchmark of `catalogue`. Reference values: `references/geared_mechanisms.json`.
"""

import numpy as np

from rfem_jax.description import (
    Coupling,
    Joint,
    Link,
    Material,
    Mechanism,
    MomentTable,
    Rectangle,
    RungeKutta4,
)
from rfem_jax.mechanics.model.discretisation import discretise
from rfem_jax.simulation import Run, Simulation, simulate
from rfem_jax.validation.lines import Line, Outcome, Progress, absolute, relative
from rfem_jax.validation.reference_values import read_reference

REFERENCE = read_reference("geared_mechanisms")
CRANK, ROD, APART, TURN = 0.05, 0.2, 0.15, 0.8  # m, rad: angle of the second crank while the first one is at 0
SIDE, DENSITY, MOMENT = 0.01, 7850.0, 0.5  # m, kg/m^3, N m
GROUP = "Geared five-bar, ideal gears"
SHARE, ANGLE = 5e-7, 1e-7  # of loads; rad


def rod_angles(one: float, two: float) -> tuple[float, float]:
    """Angles [rad] about y of both rods, which meet above the cranks, from those of the cranks."""
    pins = [np.array([x, 0.0]) + CRANK * np.array([np.cos(q), -np.sin(q)]) for x, q in ((0.0, one), (APART, two))]
    half = 0.5 * (pins[1] - pins[0])
    across = np.array([-half[1], half[0]]) / np.linalg.norm(half)
    meeting = pins[0] + half + across * np.sqrt(ROD**2 - half @ half)
    first, second = (float(np.arctan2(-(meeting - pin)[1], (meeting - pin)[0])) for pin in pins)
    return first, second


def five_bar() -> Mechanism:
    """Rigid bars of steel under gravity."""
    steel, section = Material("steel", 2.1e11, poisson_ratio=0.3, density=DENSITY), Rectangle(SIDE, SIDE)
    lengths = {"one": CRANK, "left": ROD, "right": ROD, "two": CRANK}
    links = tuple(Link(name, length, section, steel, rigid=True) for name, length in lengths.items())
    left, right = rod_angles(0.0, TURN)
    joints = (
        Joint("A", "base", "one", angle=0.0),
        Joint("B", "one", "left", angle=left),
        Joint("E", "base", "two", position=(APART, 0.0, 0.0), angle=TURN),
        Joint("D", "two", "right", angle=right - TURN),
        Joint("C", "left", "right", child_position=(ROD, 0.0, 0.0), cut=True),
    )
    return Mechanism(links, joints, driven_joint="A", forces=(Coupling("mesh", ("A", "E"), ratio=1.0),))


def run_five_bar() -> Run:
    """A constant moment on the first crank, from rest."""
    drive = MomentTable("A", [0.0, 1.0], [MOMENT, MOMENT])
    method = RungeKutta4(step=2e-5)
    return simulate(Simulation(discretise(five_bar()), drive=drive, duration=0.2, method=method, save_every=0.1))


def lines(run: Run) -> list[Line]:
    """Angle, mesh moment and forces of all joints in global axes, at the times of the reference."""
    found = []
    for time, known in REFERENCE["at"].items():
        i = int(np.argmin(np.abs(np.asarray(run.times) - float(time))))
        source, loads = REFERENCE.label, run.loads_in("global")
        angle = np.asarray(run.motion.angles["A"])[i]
        found.append(absolute(GROUP, f"angle of A at {time} s", angle, known["angle"], ANGLE, source, "rad"))
        mesh = np.asarray(run.couplings["mesh"].loads)[i, 0]
        found.append(
            relative(GROUP, f"moment of the gears at A at {time} s", mesh, known["mesh"], SHARE, source, "N m")
        )
        for joint, forces in known["force"].items():
            for axis, one in zip((0, 2), forces, strict=True):
                title = f"force {'xyz'[axis]} of {joint} at {time} s"
                ours = np.asarray(loads[joint].force)[i, axis]
                found.append(relative(GROUP, title, ours, one, SHARE, source, "N"))
    return found


def validate(full: bool, progress: Progress) -> Outcome:
    """Motion and loads."""
    del full
    run = run_five_bar()
    progress(1.0)
    return Outcome(lines(run))
