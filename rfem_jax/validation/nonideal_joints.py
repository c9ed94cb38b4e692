"""Joints that are not ideal: a four-bar on bushings, friction in the hinges of a flywheel and of four-bars.

Place in the pipeline: two benchmarks of `catalogue`. Reference values: `references/nonideal_joints.json`; those of the
flywheel are a closed form.
"""

from collections.abc import Callable, Sequence

import numpy as np

from rfem_jax.description import (
    GeneralisedAlpha,
    Joint,
    JointFriction,
    Link,
    Material,
    Mechanism,
    MomentRamp,
    Rectangle,
    RungeKutta4,
)
from rfem_jax.description.mechanism.compliance import Compliance
from rfem_jax.mechanics.model.discretisation import discretise
from rfem_jax.mechanics.model.errors import assembly_errors
from rfem_jax.simulation import Run, Simulation, simulate
from rfem_jax.validation.joint_cases import Shares, checked
from rfem_jax.validation.lines import Line, Outcome, Progress, absolute, relative
from rfem_jax.validation.reference_values import read_reference
from rfem_jax.validation.rigid_links import body, rate_of, start_at_rate

REFERENCE = read_reference("nonideal_joints")
BUSHING = Compliance(
    radial=5e7, axial=2e7, tilt=2e3, radial_damping=500.0, axial_damping=200.0, tilt_damping=0.02
)  # fmt: skip
TILTED = {"D.delta_x": np.radians(0.5), "D.delta_z": np.radians(0.5), "D.d_y": 5e-4}
JOINTS = "ABCD"
ANGLES = -np.pi / 2.0, -0.62161444632, -1.75896545305  # rad, of the links of the four-bar of bars, closed
VISCOUS = (0.001, 0.0005, 0.0005, 0.002)  # N m s, of the rigid four-bar's hinges
CONSTANT = (0.02, 0.015, 0.01, 0.025)  # N m
RADII = (0.01, 0.008, 0.008, 0.012)  # m
INERTIA, WHEEL_RATE, COULOMB, WHEEL_VISCOUS = 0.012, 30.0, 0.09, 0.002  # kg m^2, rad/s, N m, N m s


def bars(rfes: int | None) -> tuple[Link, ...]:
    """Steel bars of 10 x 10 mm: a rigid crank; coupler and rocker rigid or with a number of rfes."""
    steel = Material("steel", youngs_modulus=210e9, density=7850.0, poisson_ratio=0.3, damping=1e-5)
    bar = Rectangle(0.01, 0.01)
    others = (Link(name, 0.3, bar, steel, rigid=rfes is None, rfes=rfes or 1) for name in ("coupler", "rocker"))
    return Link("crank", 0.12, bar, steel, rigid=True), *others


def _hinges(compliance: Compliance | None = None) -> tuple[Joint, ...]:
    crank, coupler, rocker = ANGLES
    return (
        Joint("A", "base", "crank", angle=crank, compliance=compliance),
        Joint("B", "crank", "coupler", angle=coupler - crank, compliance=compliance),
        Joint("D", "base", "rocker", position=(0.3, 0.0, 0.0), angle=rocker, compliance=compliance),
        Joint("C", "coupler", "rocker", cut=True, compliance=compliance),
    )


def bushings() -> Mechanism:
    """Rigid bars whose joints all give way."""
    return Mechanism(bars(None), _hinges(BUSHING), driven_joint="A")


def flexible() -> Mechanism:
    """Flexible coupler and rocker, friction by the load in all hinges, geometrically exact."""
    radii = zip(JOINTS, (0.008, 0.006, 0.006, 0.008), strict=True)
    forces = (JointFriction(f"at_{joint}", joint, coefficient=0.15, radius=r, sliding_rate=0.5) for joint, r in radii)
    return Mechanism(bars(5), _hinges(), driven_joint="A", forces=tuple(forces), elements="geometrically_exact")


def run_down(by_hinge: Sequence[dict]) -> Mechanism:
    """A rigid four-bar with friction in all its hinges."""
    links = (
        body("crank", 0.08, 0.3, (0.03, 0, 0.002), (5e-5, 3e-4, 2.8e-4)),
        body("coupler", 0.25, 0.4, (0.11, 0, -0.004), (9e-5, 2.2e-3, 2.15e-3)),
        body("rocker", 0.2, 0.35, (0.09, 0, 0.003), (8e-5, 1.3e-3, 1.25e-3)),
    )
    joints = (
        Joint("A", "base", "crank", angle=np.radians(-50.0)),
        Joint("B", "crank", "coupler", angle=0.9),
        Joint("D", "base", "rocker", position=(0.26, 0, 0), angle=-1.57375351781),
        Joint("C", "coupler", "rocker", cut=True),
    )
    forces = (
        JointFriction(f"at_{joint}", joint, viscous=viscous, sliding_rate=0.1, **more)
        for joint, viscous, more in zip(JOINTS, VISCOUS, by_hinge, strict=True)
    )
    return Mechanism(links, joints, redundant_reactions="minimum_norm", driven_joint="A", forces=tuple(forces))


def run_bushings() -> Run:
    """From rest with the errors of D under a moment that grows and ends."""
    model = discretise(bushings())
    return simulate(
        Simulation(
            model, drive=MomentRamp("A", 1.5, 0.1), duration=0.4, method=RungeKutta4(step=1e-5), save_every=0.05
        ),
        assembly_errors(model, TILTED),
    )


def run_constant() -> Run:
    """Let go at 18 rad/s, friction that does not depend on the loads."""
    model = discretise(run_down([{"constant": moment} for moment in CONSTANT]))
    return simulate(
        Simulation(
            model,
            drive=None,
            duration=0.5,
            method=RungeKutta4(step=1e-4),
            save_every=0.05,
            start=start_at_rate(model, rate_of(18.0)),
        )
    )


def run_by_load() -> Run:
    """Likewise, friction by the loads."""
    model = discretise(run_down([{"coefficient": 0.2, "radius": radius} for radius in RADII]))
    return simulate(
        Simulation(
            model,
            drive=None,
            duration=0.5,
            method=GeneralisedAlpha(step=1e-4),
            save_every=0.05,
            start=start_at_rate(model, rate_of(18.0)),
        )
    )


def run_flexible(step: float = 2e-5) -> Run:
    """As `run_bushings`, flexible and with friction."""
    model = discretise(flexible())
    return simulate(
        Simulation(
            model, drive=MomentRamp("A", 1.5, 0.1), duration=0.4, method=GeneralisedAlpha(step=step), save_every=0.1
        ),
        assembly_errors(model, TILTED),
    )


CASES: dict[str, tuple[str, Callable[[], Run], Shares]] = {
    "bushings": ("Four-bar on bushings", run_bushings, Shares(rms=2e-6, instant=1e-5, motion=1e-8)),
    "constant": ("Friction, rigid four-bar, constant", run_constant, Shares(rms=1e-6, instant=1e-5, motion=1e-6)),
    "by load": ("Friction, rigid four-bar, by the load", run_by_load, Shares(rms=1e-5, instant=1e-4, motion=1e-5)),
    "flexible": ("Friction, flexible four-bar with errors", run_flexible, Shares(rms=1e-5, instant=1e-3, motion=1e-5)),
}  # of the reference: heading, what runs it, what is allowed


def wheel_lines() -> list[Line]:
    """A flywheel runs down: rate and angle until it nearly stops, and the angle where it stands."""
    wheel = body("wheel", 0.1, 1.0, (0, 0, 0), (INERTIA, INERTIA, INERTIA))
    friction = JointFriction("bearing", "G", constant=COULOMB, viscous=WHEEL_VISCOUS, sliding_rate=0.02)
    joint = Joint("G", "base", "wheel")
    mechanism = Mechanism((wheel,), (joint,), driven_joint="G", forces=(friction,), gravity=(0.0, 0.0, 0.0))
    model = discretise(mechanism)
    run = simulate(
        Simulation(
            model,
            drive=None,
            duration=4.0,
            method=RungeKutta4(step=1e-3),
            save_every=0.5,
            start=start_at_rate(model, rate_of(WHEEL_RATE)),
        )
    )
    times, decay = np.asarray(run.times), WHEEL_VISCOUS / INERTIA
    sliding = times < REFERENCE["stop_time"][0]
    limit, left = COULOMB / WHEEL_VISCOUS, np.exp(-decay * times)
    rates = (WHEEL_RATE + limit) * left - limit
    angles = (WHEEL_RATE + limit) * (1.0 - left) / decay - limit * times
    group, lines = "Friction, flywheel", []
    for name, found, known in (("rate", run.motion.rate, rates), ("angle", run.motion.angle, angles)):
        at = int(np.flatnonzero(sliding)[-1])
        unit = "rad/s" if name == "rate" else "rad"
        title = f"{name} at {times[at]:g} s"
        lines.append(relative(group, title, np.asarray(found)[at], known[at], 1e-8, "closed form", unit))
    label, stood = REFERENCE.label, REFERENCE["angle_at_4_s"][0]
    lines += [
        relative(group, "angle at 4 s, at rest", run.motion.angle[-1], stood, 1e-8, label, "rad"),
        absolute(group, "rate at 4 s", run.motion.rate[-1], 0.0, 1e-6, "closed form", "rad/s"),
        relative(group, "RMS moment", run.metrics.rms_moment["G"], REFERENCE["wheel_moment"][0], 1e-4, label, "N m"),
    ]
    return lines


def _lines_of(case: str) -> list[Line]:
    group, run, allowed = CASES[case]
    return checked(REFERENCE, case, group, run(), allowed)


def bushed(full: bool, progress: Progress) -> Outcome:
    """The four-bar on bushings."""
    del full
    lines = _lines_of("bushings")
    progress(1.0)
    return Outcome(lines)


def friction(full: bool, progress: Progress) -> Outcome:
    """The flywheel and the rigid four-bars, with `full` the flexible one, too."""
    lines = wheel_lines()
    progress(0.1)
    cases = ("constant", "by load", *(("flexible",) if full else ()))
    for number, case in enumerate(cases):
        lines += _lines_of(case)
        progress(0.1 + 0.9 * (number + 1) / len(cases))
    return Outcome(lines)
