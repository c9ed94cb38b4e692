"""The project's main study against an independent implementation, linear and geometrically exact.

Place in the pipeline: a benchmark of `catalogue`.

Reference (`references/four_bar_study.json`): exact rotations, the same discretisation, converged in time. The linear
form of the elements may differ from it, since its stiffness is constant relative to the link frame; the geometrically
exact form must not. The data set is a substitute: the dimensions of the paper's mechanism are lost.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from rfem_jax.description import Case, Joint, Link, Material, Mechanism, MomentRamp, Rectangle, RungeKutta4, Study
from rfem_jax.mechanics.model.discretisation import discretise
from rfem_jax.simulation import Run, run_cases
from rfem_jax.validation.lines import Curve, Line, Outcome, Picture, Progress, absolute, relative
from rfem_jax.validation.reference_values import read_reference

REFERENCE = read_reference("four_bar_study")
SOURCE = REFERENCE.label


@dataclass(frozen=True)
class AllowedDifferences:
    """Allowed differences: `angle` [rad], `rate` [rad/s], all others relative."""

    rms_force: float
    rms_moment: float
    preload: float
    axial: float
    normal: float
    angle: float
    rate: float
    energy: float = 2e-5


# Of the linear form the differences between linear elements and exact rotations; the reference sampled its maxima
# every 20 microseconds.
ALLOWED = {
    "linear": AllowedDifferences(5e-4, 1e-3, 5e-4, 3e-3, 8e-3, 3e-4, 5e-3),
    "geometrically_exact": AllowedDifferences(1e-4, 1e-4, 1e-5, 1e-4, 1e-4, 1e-5, 1e-4),
}


def study() -> Study:
    """Cases P1 (perfect) and P2 (joint D tilted by 0.5 deg) of the main study."""
    steel = Material("steel", youngs_modulus=210e9, poisson_ratio=0.3, density=7850.0, damping=1e-5)
    bar = Rectangle(0.01, 0.01)
    links = (
        Link("crank", 0.12, bar, steel, rigid=True),
        Link("coupler", 0.30, bar, steel, rfes=5),
        Link("rocker", 0.30, bar, steel, rfes=5),
    )
    joints = (
        Joint("A", "base", "crank", position=(0.0, 0.0, 0.0), angle=np.radians(-90.0)),
        Joint("B", "crank", "coupler", angle=np.radians(54.4)),
        Joint("D", "base", "rocker", position=(0.3, 0.0, 0.0), angle=np.radians(-100.8)),
        Joint("C", "coupler", "rocker", cut=True),
    )
    return Study(
        title="Steel four-bar with assembly errors at joint D",
        mechanism=Mechanism(links, joints),
        drive=MomentRamp("A", 1.5, 0.1),
        duration=0.5,
        method=RungeKutta4(step=1e-5),
        save_every=1e-3,
        cases=(Case("P1"), Case("P2", {"D.delta_x": np.radians(0.5)})),
    )


def validate(full: bool, progress: Progress) -> Outcome:
    """Both forms of the spring-damping elements."""
    del full
    specified = study()
    lines, curves = [], []
    for number, elements in enumerate(ALLOWED):
        model = discretise(specified.mechanism, elements=elements)
        _, runs = run_cases(specified, model=model, progress=lambda done: progress((number + done) / len(ALLOWED)))
        lines += checked(elements, runs)
        run = runs["P2"]
        force = np.linalg.norm(run.loads["A"].force, axis=1)
        curves.append(Curve(elements.replace("_", " "), run.times, force))
    picture = Picture("main_study", "Main study, P2: resultant force in A", "t, s", "N", tuple(curves))
    return Outcome(lines, [picture])


def checked(elements: str, runs: Mapping[str, Run]) -> list[Line]:
    """Lines of one form of the elements from its runs {"P1": run, "P2": run} (NumPy arrays)."""
    allowed = ALLOWED[elements]
    prefix = f"Main study, {elements.replace('_', ' ')}"
    lines: list[Line] = []
    for case, run in runs.items():
        got, preload = run.metrics, run.preload
        force = {name: np.linalg.norm(load.force) for name, load in preload.items()}
        # The reference's moment is across the hinge: without the one that holds the crank.
        moment = {name: np.hypot(load.moment[0], load.moment[2]) for name, load in preload.items()}
        for quantity, values, key, share in (
            ("RMS force", got.rms_force, "rms_force", allowed.rms_force),
            ("RMS moment", got.rms_moment, "rms_moment", allowed.rms_moment),
            ("largest axial force", got.max_axial_force, "max_axial_force", allowed.axial),
            ("largest normal force", got.max_normal_force, "max_normal_force", allowed.normal),
            ("preload force", force, "preload_force", allowed.preload),
            ("preload moment across the hinge", moment, "preload_moment", allowed.preload),
        ):
            group, unit = f"{prefix}: {quantity}", REFERENCE.quantities[key].unit
            for joint, known in REFERENCE[key].get(case, {}).items():
                name = f"{case} {quantity} {joint}"
                lines.append(relative(group, name, values[joint], known, share, SOURCE, unit))
        group, name = f"{prefix}: holding moment", f"{case} moment that holds the crank"
        known = REFERENCE["holding_moment"][case]
        lines.append(relative(group, name, preload["A"].moment[1], known, 1e-5, SOURCE, "N m"))
        lines += motion_lines(prefix, allowed, case, run)
    return lines


def motion_lines(prefix: str, allowed: AllowedDifferences, case: str, run: Run) -> list[Line]:
    """Angle, rate and energy at the times of the reference."""
    lines = []
    angles, rates, energies = (REFERENCE[name][case] for name in ("crank_angle", "crank_rate", "energy"))
    for time in angles:
        at = int(np.argmin(np.abs(run.times - float(time))))
        lines += [
            absolute(f"{prefix}: crank rotation", f"{case} crank rotation at {time} s",
                     run.motion.angle[at] - run.motion.angle[0], angles[time], allowed.angle, SOURCE, "rad"),
            absolute(f"{prefix}: crank rate", f"{case} crank rate at {time} s", run.motion.rate[at],
                     rates[time], allowed.rate, SOURCE, "rad/s"),
            relative(f"{prefix}: energy", f"{case} energy at {time} s", run.energy.total[at],
                     energies[time], allowed.energy, SOURCE, "J"),
        ]  # fmt: skip
    return lines
