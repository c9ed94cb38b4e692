"""Planar slider-cranks on a guide: rigid, and with a flexible rod whose guide and wrist pin are tilted.

Place in the pipeline: a benchmark of `catalogue`. Reference values: `references/slider_cranks.json`; those of the
rigid one are a closed form.
"""

import jax
import jax.numpy as jnp
import numpy as np

from rfem_jax.description import (
    Joint,
    Link,
    Material,
    Mechanism,
    MomentRamp,
    PrescribedFunction,
    Rectangle,
    RungeKutta4,
)
from rfem_jax.mechanics.model.discretisation import discretise
from rfem_jax.mechanics.model.errors import assembly_errors
from rfem_jax.simulation import Run, Simulation, simulate
from rfem_jax.simulation.system.driving import Drive
from rfem_jax.validation.joint_cases import Shares, checked
from rfem_jax.validation.lines import Line, Outcome, Progress, relative
from rfem_jax.validation.reference_values import read_reference
from rfem_jax.validation.rigid_links import body, one_turn, slider_crank

REFERENCE = read_reference("slider_cranks")
RIGID = Shares(rms=1e-7, instant=1e-7, motion=1e-9)
EXACT = Shares(rms=1e-7, instant=1e-6, motion=1e-7)
DERIVATIVES = 1e-6
RATE = 60.0  # rad/s, of the crank of the rigid one
ERRORS = {
    "G.delta_x": np.radians(0.3), "G.delta_z": np.radians(0.2), "G.d_y": 3e-4,
    "C.delta_x": np.radians(0.2), "C.delta_z": np.radians(-0.15),
}  # fmt: skip
RISE, TURNING = 0.1, 40.0  # s, rad/s, of the prescribed angle


def rigid() -> Mechanism:
    """The crank's axis is 10 mm beside the guide."""
    return slider_crank(Joint("G", "base", "piston", kind="prismatic", position=(0, 0, 0.01), displacement=0.26))


def flexible(elements: str = "geometrically_exact") -> Mechanism:
    """Hinges at both ends of a flexible rod of five rfes."""
    steel = Material("steel", youngs_modulus=210e9, density=7850.0, poisson_ratio=0.3, damping=1e-5)
    bar, crank = Rectangle(0.01, 0.01), -np.pi / 3.0
    rod = float(np.arcsin(-0.06 * np.sin(crank) / 0.25))
    links = (
        Link("crank", 0.06, bar, steel, rigid=True),
        Link("rod", 0.25, bar, steel, rfes=5),
        body("piston", 0.05, 0.3, (0, 0, 0), (1e-4, 1.2e-4, 1.1e-4)),
    )
    joints = (
        Joint("A", "base", "crank", angle=crank),
        Joint("B", "crank", "rod", angle=rod - crank),
        Joint("G", "base", "piston", kind="prismatic", displacement=0.27),
        Joint("C", "rod", "piston", cut=True, child_position=(0, 0, 0)),
    )
    return Mechanism(links, joints, driven_joint="A", elements=elements)


def run_rigid() -> Run:
    """One turn at a constant rate."""
    return one_turn(rigid(), RATE, 1000)


def smooth_turning(t, phase):
    """Angle [rad] whose rate rises by 10 x^3 - 15 x^4 + 6 x^5, x = t / RISE, and stays."""
    x = t / RISE
    rising = RISE * x**4 * (2.5 - 3.0 * x + x**2)
    return TURNING * jnp.where(phase == 0, rising, t - RISE / 2.0)


def drives() -> dict[str, tuple[Drive, float]]:
    """Drive and duration [s] of the cases of the flexible one."""
    ramp, turning = MomentRamp("A", 0.8, RISE), PrescribedFunction("A", smooth_turning, (RISE,))
    return {"moment": (ramp, 0.4), "angle": (turning, 0.3)}


def run_flexible(case: str, step: float = 1e-5) -> Run:
    """From static equilibrium with the errors."""
    model = discretise(flexible())
    drive, duration = drives()[case]
    return simulate(
        Simulation(model, drive=drive, duration=duration, method=RungeKutta4(step=step), save_every=0.05),
        assembly_errors(model, ERRORS),
    )


def run_linear(step: float = 1e-5) -> Run:
    """The flexible one with linear elements, under the moment."""
    model = discretise(flexible("linear"))
    drive, duration = drives()["moment"]
    return simulate(
        Simulation(model, drive=drive, duration=duration, method=RungeKutta4(step=step), save_every=0.05),
        assembly_errors(model, ERRORS),
    )


def derivatives(step: float = 1e-5) -> dict[str, dict[str, dict[str, float]]]:
    """Derivatives of the mean-square loads of the flexible one under the moment, {load: {error: {joint: value}}}."""
    model = discretise(flexible())
    drive, duration = drives()["moment"]

    def mean_squares(values):
        errors = assembly_errors(model, dict(zip(ERRORS, values, strict=True)))
        run = simulate(
            Simulation(model, drive=drive, duration=duration, method=RungeKutta4(step=step), save_every=0.1), errors
        )
        return {"force": run.metrics.mean_square_force, "moment": run.metrics.mean_square_moment}

    found = jax.jacfwd(mean_squares)(jnp.asarray([*ERRORS.values()]))
    return {
        load: {error: {joint: float(row[i]) for joint, row in rows.items()} for i, error in enumerate(ERRORS)}
        for load, rows in found.items()
    }


def derivative_lines(found: dict[str, dict[str, dict[str, float]]]) -> list[Line]:
    """Of every load and error the joint that is farthest off."""
    lines = []
    for load, rows in found.items():
        quantity = REFERENCE.quantities[f"d_mean_square_{load}"]
        for error, known in quantity.values.items():
            unit = f"{quantity.unit}/{'m' if '.d_' in error else 'rad'}"
            of_error = [
                relative("Slider-crank, flexible rod, derivatives", f"mean square {load} of {joint} by {error}",
                         rows[error][joint], value, DERIVATIVES, REFERENCE.label, unit)
                for joint, value in known.items()
            ]  # fmt: skip
            lines.append(max(of_error, key=lambda line: abs(line.difference)))
    return lines


def validate(full: bool, progress: Progress) -> Outcome:
    """The rigid one, then the flexible one under a moment and with prescribed angle, with linear elements, and with
    `full` its derivatives by the errors."""
    lines = checked(REFERENCE, "rigid", "Slider-crank, rigid", run_rigid(), RIGID)
    progress(0.2)
    for number, (case, title) in enumerate((("moment", "moment"), ("angle", "prescribed angle"))):
        group = f"Slider-crank, flexible rod, guide errors, {title}"
        lines += checked(REFERENCE, case, group, run_flexible(case), EXACT)
        progress(0.2 + 0.2 * (number + 1))
    lines += checked(REFERENCE, "linear", "Slider-crank, flexible rod, linear elements", run_linear(), EXACT)
    progress(0.8)
    if full:
        lines += derivative_lines(derivatives())
    progress(1.0)
    return Outcome(lines)
