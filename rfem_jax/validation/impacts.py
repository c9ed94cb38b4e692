"""Joints with clearance in motion: one impact of a guided pin, first impacts of a slider-crank at two rates.

Place in the pipeline: lines -> **impacts** -> clearances. Reference values: `references/clearances.json`; those of the
impact with a given damping factor are closed forms.

A pin on a guide hits its bush once. A slider-crank at a constant rate has play at the wrist pin; of its contacts, whose
sequence is chaotic, the first ones are compared.
"""

import dataclasses
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.optimize import brentq

from rfem_jax.description import Clearance, Explicit, GeneralisedAlpha, Joint, Mechanism, Method, PrescribedRate
from rfem_jax.mechanics.model.discretisation import discretise
from rfem_jax.mechanics.model.model import Coordinates, Model, State
from rfem_jax.simulation import Run, Simulation, simulate
from rfem_jax.validation.lines import Curve, Line, Picture, Progress, absolute, relative, same
from rfem_jax.validation.reference_values import read_reference
from rfem_jax.validation.rigid_links import body

REFERENCE = read_reference("clearances")
CLOSED_FORM = "closed form"
MASS, SPEED, RADIAL, STIFFNESS = 0.5, 0.3, 2e-4, 106153846154.0  # kg, m/s, m, N/m^1.5: of the guided pin
DAMPING = 0.475  # s/m, of the contact with a given factor
GUIDED = Clearance(
    radial=RADIAL, length=0.02, stiffness=STIFFNESS / 2.0, axial=1e-3, axial_stiffness=1e7, axial_exponent=1.0
)
DURATION = 8.2e-4  # s, of its run
CRANK, ROD = 0.05, 0.12  # m, of the slider-crank


class CrankCase(NamedTuple):
    """A slider-crank with play: name of its lines; rate [rad/s]; radial clearance [m] and stiffness [N/m^1.5];
    duration [s] that has the impacts of the reference; what its quantities begin with; method, and interval of saved
    times [s]; by how much starts [s] and largest forces (relative) may be off."""

    name: str
    rate: float
    radial: float
    stiffness: float
    duration: float
    quantity: str
    method: Method
    save_every: float
    allowed: tuple[float, float]


# Starts are within 2e-9 s of the reference in the fast case, within 6e-9 s in the slow one.
STEPS = GeneralisedAlpha(step=4e-7, contact_tolerance=2.5e-6)
FAST = CrankCase("5000 rpm", 523.598775598, 5e-4, 66101983979.0, 1.5e-3, "impact", STEPS, 4e-7, (2e-8, 2e-4))
SLOW = CrankCase("600 rpm", 62.8318530718, 1e-4, 150888204748.0, 6.5e-3, "slow_impact", STEPS, 4e-7, (1e-7, 2e-4))


class Impact(NamedTuple):
    """A contact: where the penetration passes zero, between saved times [s]; the saved times within."""

    begin: float
    end: float
    inside: slice


def impacts_of(times: Float[np.ndarray, " times"], depth: Float[np.ndarray, " times"]) -> list[Impact]:
    """Contacts by the penetration [m] at saved times [s]: there is none at the first, the last may go on."""
    before = np.flatnonzero((depth[1:] > 0.0) != (depth[:-1] > 0.0))
    share = depth[before] / (depth[before] - depth[before + 1])
    passed, edges = times[before] + share * (times[before + 1] - times[before]), before + 1
    if len(edges) % 2:
        passed, edges = np.append(passed, times[-1]), np.append(edges, len(times))
    return [
        Impact(float(passed[n]), float(passed[n + 1]), slice(edges[n], edges[n + 1])) for n in range(0, len(edges), 2)
    ]


def depths(run: Run, joint: str) -> Float[np.ndarray, " times"]:
    """Penetration of one end of a pin at the saved times [m], negative without contact."""
    assert run.contacts is not None  # likewise
    return np.asarray(run.contacts[joint].penetration)[:, 0]


def guided(**losses: float) -> Model:
    """A pin on a guide through the middle of a fixed bush; `losses`: of the contact, as `Clearance` has them."""
    joints = [
        Joint("G", "base", "pin", kind="prismatic"),
        Joint("P", "base", "pin", position=(0, 0, 0), child_position=(0, 0, 0), cut=True,
              clearance=dataclasses.replace(GUIDED, **losses)),
    ]  # fmt: skip
    pin = body("pin", 0.1, MASS, (0, 0, 0), (1e-4, 2.5e-4, 2.5e-4))
    return discretise(Mechanism((pin,), tuple(joints), gravity=(0.0, 0.0, 0.0), driven_joint="G"))


def thrown(model: Model, speed: float = SPEED) -> State:
    """The start of the guided pin, in the middle of its bush at a speed [m/s]."""
    return State(model.start_coordinates(), Coordinates(jnp.asarray(speed)[None], jnp.zeros((6, 0))))


def rebound_of(damping: float, speed: float = SPEED) -> float:
    """Speed after an impact [m/s] with the damping factor chi [s/m] of Hunt and Crossley's law (theory (15.5))."""

    def balance(v: float) -> float:
        return damping * (speed + v) - np.log((1.0 + damping * speed) / (1.0 - damping * v))

    found: float = brentq(balance, 1e-6, speed)  # pyright: ignore[reportAssignmentType] # no full output
    return found


def deepest_of(damping: float, speed: float = SPEED) -> float:
    """Deepest penetration of that impact [m]."""
    energy = MASS / damping * (speed - np.log(1.0 + damping * speed) / damping)
    return (2.5 * energy / STIFFNESS) ** 0.4


def speed_at_the_end(run: Run) -> float:
    """Speed of the guided pin at the end [m/s]."""
    return float(np.sqrt(2.0 * float(run.energy.kinetic[-1]) / MASS))


def run_impact(**losses: float) -> Run:
    """The pin hits its bush once: with `restitution` by the implicit method, with `damping` by an explicit one."""
    implicit = GeneralisedAlpha(step=4e-7)
    method = implicit if "restitution" in losses else Explicit("dopri8", rtol=1e-10, atol=1e-12)
    model = guided(**losses)
    return simulate(
        Simulation(model, drive=None, duration=DURATION, method=method, save_every=2e-6, start=thrown(model))
    )


def _lost_line(group: str, run: Run, allowed: float) -> Line:
    lost = float(run.energy.kinetic[0] - run.energy.kinetic[-1])
    return relative(group, "energy lost", run.energy.dissipation[-1], lost, allowed, "kinetic energy", "J")


def restitution_lines(run: Run) -> list[Line]:
    """One impact with a coefficient of restitution."""
    group, label = "Single impact, restitution", REFERENCE.quantities["rebound_speed"].label
    depth = depths(run, "P")
    found = impacts_of(np.asarray(run.times), depth)
    begin, end = found[0][:2] if found else (np.nan, np.nan)
    speed, peak = speed_at_the_end(run), run.metrics.max_normal_force["P"]
    return [
        same(group, "contacts", str(len(found)), "1", label),
        absolute(group, "start", begin, REFERENCE["contact_start"], 1e-7, label, "s"),
        absolute(group, "how long", end - begin, REFERENCE["contact_duration"], 4e-7, label, "s"),
        relative(group, "rebound speed", speed, REFERENCE["rebound_speed"], 1e-5, label, "m/s"),
        relative(group, "deepest penetration", depth.max(), REFERENCE["deepest_penetration"], 2e-3, label, "m"),
        relative(group, "peak force", peak, REFERENCE["impact_peak_force"], 5e-5, label, "N"),
        _lost_line(group, run, 3e-5),
    ]


def damping_lines(run: Run) -> list[Line]:
    """One impact with a given damping factor."""
    group, deepest = "Single impact, damping factor", depths(run, "P").max()
    return [
        relative(group, "rebound speed", speed_at_the_end(run), rebound_of(DAMPING), 1e-8, CLOSED_FORM, "m/s"),
        relative(group, "deepest penetration", deepest, deepest_of(DAMPING), 2e-3, CLOSED_FORM, "m"),
        _lost_line(group, run, 1e-6),
    ]


def slider_crank(case: CrankCase, **losses: float) -> tuple[Model, PrescribedRate, State]:
    """Rigid, with play at the wrist pin: pin and bush concentric at the start, rates of the ideal one; `losses` of the
    contact, as `Clearance` has them (none: a coefficient of restitution of 0.9)."""
    play = Clearance(radial=case.radial, length=0.02, stiffness=case.stiffness / 2.0, axial=1e-3, axial_stiffness=1e7,
                     axial_exponent=1.0, pin="parent", **(losses or {"restitution": 0.9}))  # fmt: skip
    inertia = (1e-4, 2.5e-4, 2.5e-4)
    links = [
        body("crank", CRANK, 0.1, (0, 0, 0), inertia),
        body("rod", ROD, 0.21, (0.06, 0, 0), inertia),
        body("slider", 0.05, 0.14, (0, 0, 0), inertia),
    ]
    joints = [
        Joint("A", "base", "crank"),
        Joint("B", "crank", "rod"),
        Joint("G", "base", "slider", kind="prismatic", displacement=CRANK + ROD),
        Joint("C", "rod", "slider", child_position=(0, 0, 0), cut=True, clearance=play),
    ]
    model = discretise(Mechanism(tuple(links), tuple(joints), driven_joint="A"))
    rates = {"A": case.rate, "B": -case.rate * CRANK / ROD - case.rate, "G": 0.0}
    order = model.topology.joints[: model.topology.n_links]
    start = State(model.start_coordinates(), Coordinates(jnp.array([rates[j] for j in order]), jnp.zeros((6, 0))))
    return model, PrescribedRate("A", case.rate), start


def run_slider_crank(case: CrankCase) -> Run:
    """The first impacts."""
    model, drive, start = slider_crank(case)
    return simulate(
        Simulation(
            model, drive=drive, duration=case.duration, method=case.method, save_every=case.save_every, start=start
        )
    )


def contact_forces(run: Run, joint: str) -> Float[np.ndarray, " times"]:
    """Resultant force of a joint at the saved times [N]."""
    return np.linalg.norm(run.loads[joint].force, axis=1)


def slider_crank_lines(case: CrankCase, run: Run) -> list[Line]:
    """Starts and largest forces of the first impacts."""
    starts, peaks = (REFERENCE[f"{case.quantity}_{what}"] for what in ("start", "peak"))
    group, label = f"Slider-crank with play at {case.name}", REFERENCE.quantities[f"{case.quantity}_start"].label
    force, found = contact_forces(run, "C"), impacts_of(np.asarray(run.times), depths(run, "C"))
    at_time, of_force = case.allowed
    lines = [same(group, f"impacts until {case.duration} s", str(len(found)), str(len(starts)), label)]
    for n, (impact, begin, peak) in enumerate(zip(found, starts, peaks), start=1):
        lines += [
            absolute(group, f"start of impact {n}", impact.begin, begin, at_time, label, "s"),
            relative(group, f"peak force of impact {n}", force[impact.inside].max(), peak, of_force, label, "N"),
        ]
    return lines


def _picture(case: CrankCase, run: Run) -> Picture:
    times, peaks = (np.array(REFERENCE[f"{case.quantity}_{what}"]) for what in ("peak_time", "peak"))
    curves = (Curve("generalised alpha", 1e3 * np.asarray(run.times), contact_forces(run, "C")),
              Curve("DOP853 and RK45, largest forces", 1e3 * times, peaks, True))  # fmt: skip
    rpm = case.name.replace(" ", "_")
    title = f"Wrist pin with play at {case.name}: force of the first impacts"
    return Picture(f"wrist_pin_with_play_{rpm}", title, "t, ms", "N", curves)


def validate(progress: Progress) -> tuple[list[Line], list[Picture]]:
    """All that moves."""
    lines, pictures = restitution_lines(run_impact(restitution=0.9)), []
    lines += damping_lines(run_impact(damping=DAMPING))
    for share, case in ((0.4, FAST), (0.7, SLOW)):
        progress(share)
        run = run_slider_crank(case)
        lines += slider_crank_lines(case, run)
        pictures.append(_picture(case, run))
    progress(1.0)
    return lines, pictures
