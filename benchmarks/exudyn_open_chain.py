"""An open chain with everything in it: nothing in the comparison is made for four-bars.

A hinged flexible link, a second one driven against it from the middle of the first (its joint in a
rotated frame), a rigid one at its end, point masses off the axis, and every error of the mechanism
at once (tilts to 3 deg, lengths to 3 mm, from a random generator with a fixed seed).  It starts undeformed at rest, so
that vibrations of all elements are excited; the differences between the two codes must then decrease with the square
of Exudyn's step (ours is Runge-Kutta 4 at 5e-6 s).
"""

import numpy as np
from exudyn_engine import drive_pieces, exudyn_numbers

from rfem_jax import (
    Joint,
    Link,
    Material,
    Mechanism,
    MomentRamp,
    PointMass,
    Rectangle,
    RungeKutta4,
    Simulation,
    assembly_errors,
    discretise,
    simulate,
)
from rfem_jax.description.tolerances.error_catalogue import error_dimension
from rfem_jax.exchange.exudyn_program import Settings, move, start_of
from rfem_jax.mechanics.dynamics.loads import static_state

DURATION, SAVE_EVERY = 0.05, 1e-3
STEPS = (2e-5, 1e-5)


def open_chain() -> Mechanism:
    """Three links from the base; the joint in the middle of the first is driven."""
    bar = Rectangle("10 mm", "10 mm")
    steel = Material("steel", youngs_modulus="210 GPa", poisson_ratio=0.3, density=7850.0, damping=1e-5)
    return Mechanism(
        links=(
            Link("a", 0.3, bar, steel, rfes=5, point_masses=(PointMass(0.2, (0.15, 0.0, 0.01)),)),
            Link("b", 0.2, bar, steel, rfes=4),
            Link("c", 0.25, bar, steel, rigid=True, point_masses=(PointMass(0.3, (0.25, 0.02, 0.0)),)),
        ),
        joints=(
            Joint("P", "base", "a", angle=0.3),
            Joint("Q", "a", "b", position=(0.17, 0.0, 0.0), orientation=(0.2, 0.1, 0.3), angle=-0.7),
            Joint("R", "b", "c", angle=0.5),
        ),
        gravity=(0.0, 0.0, -9.81),
        driven_joint="Q",
    )


def all_errors(model, scale: float = 1.0) -> dict:
    """Every error of a model, random with a fixed seed: up to 0.05 rad and 3 mm, times `scale`."""
    draw = np.random.default_rng(0)
    size = {"angle": 0.05 * scale, "length": 3e-3 * scale}
    names = model.topology.error_names
    return {name: draw.uniform(-1.0, 1.0) * size[error_dimension(name)] for name in names}


def compare_open_chain(report, trial: bool = False) -> None:
    """Largest differences of the histories at two steps of Exudyn; their ratio must be near 4.  A trial is short."""
    duration = 0.1 * DURATION if trial else DURATION
    model = discretise(open_chain(), elements="geometrically_exact")
    errors = assembly_errors(model, all_errors(model))
    drive = MomentRamp("Q", 0.3, 0.02)
    ours = simulate(
        Simulation(
            model,
            drive=drive,
            duration=duration,
            method=RungeKutta4(step=5e-6),
            save_every=SAVE_EVERY,
            start=static_state(model.topology, model.start_coordinates()),
        ),
        errors,
    )
    mechanism = exudyn_numbers(model, errors) | drive_pieces(drive, duration)
    columns = []
    for step in STEPS:
        settings = Settings(nodes="rotation_vector")
        h = move(mechanism, step, settings, start_of(mechanism)).histories
        at = np.searchsorted(h.times, np.asarray(ours.times) - 0.1 * step)
        values = {"angle of Q, rad": np.abs(h.angle[at] - np.asarray(ours.motion.angle)).max()}
        for joint in "PQR":
            for kind in ("force", "moment"):
                mine = np.asarray(getattr(ours.loads[joint], kind))
                away = np.abs(getattr(h, kind)[joint][at] - mine).max() / np.abs(mine).max()
                values[f"{kind} {joint}, over the largest"] = away
        columns.append(values)
    rows = []
    for name in columns[0]:
        coarse, fine = (float(values[name]) for values in columns)
        rows.append([name, float(f"{coarse:.1e}"), float(f"{fine:.1e}"), round(coarse / fine, 2)])
        report.check(f"open chain, {name}: ratio away from 4", abs(coarse / fine - 4.0), 0.6)
    report.table(
        "Open chain with all errors: differences of the histories, ours exact - Exudyn",
        ["value", *(f"step {step:g} s" for step in STEPS), "ratio"],
        rows,
    )
