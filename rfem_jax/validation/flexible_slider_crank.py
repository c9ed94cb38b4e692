"""The slider-crank with an elastic connecting rod of the test set for initial value problems.

Place in the pipeline: a benchmark of `catalogue`. Reference values: `references/flexible_slider_crank.json`;
`flexible_rod_theory` for what the published model leaves out.

The published model has two sines across the rod, two functions along it and a linear strain: axial forces neither
stiffen nor soften the rod against bending. The inertia of its functions along the rod lacks a divisor 15, which
changes the deflection by 1e-7 m or less. Its equations are solved here as they are. With the quadratic term of the
strain (three sines across, seven functions along) the undamped vibrations are others, and the deflection at 0.1 s is a
quarter larger, 3 % of the largest one: this is what geometrically exact elements must approach.

As published there is no gravity, and the rod starts straight with given rates; its section has next to no rotary
inertia here, and next to no shear. Compared is the deflection of the rod's middle from the chord, with 8 spring-damping
elements, and in the full validation extrapolated from 4 and 8, whose errors decrease with the square of their length.
"""

import jax.numpy as jnp
import numpy as np

from rfem_jax.description import GeneralisedAlpha, GivenSection, Joint, Link, Mechanism, PointForce, PrescribedRate
from rfem_jax.mechanics.model.discretisation import discretise
from rfem_jax.mechanics.model.model import Coordinates, Model, State
from rfem_jax.mechanics.model.status import STATUS
from rfem_jax.simulation import Run, Simulation, simulate
from rfem_jax.validation.flexible_rod_theory import Rod
from rfem_jax.validation.lines import Curve, Line, Outcome, Picture, Progress, absolute, relative, same
from rfem_jax.validation.reference_values import read_reference
from rfem_jax.validation.rigid_links import body

REFERENCE = read_reference("flexible_slider_crank")
CRANK, LENGTH, RATE, DURATION = 0.15, 0.3, 150.0, 0.1  # m, m, rad/s, s
SIDE, YOUNGS_MODULUS, DENSITY = 0.008, 2e11, 7870.0  # m, Pa, kg/m^3
SLIDER = 0.075552  # kg
AREA = SIDE**2
SAVED, STEPS = 100, 200  # intervals between saved times; steps of Runge-Kutta 4 in one, of the assumed modes
STEP, PARTS = 2e-5, (4, 8)  # s; spring-damping elements of the rod
PUBLISHED_SHARE = 1e-6  # of values that the published equations give
DEFLECTION_SHARE, LIMIT_SHARE = 1e-2, 1e-3  # of the largest deflection: with 8 elements, and extrapolated
ORDER = (4.0, 0.5)  # by which factor the error decreases from 4 to 8 elements
TITLE, THEORY = "Slider-crank with an elastic rod", "assumed modes, quadratic strain"
STIFFENING = "the published strain is linear, so that axial forces do not act on bending (in theory +23 %)"


def rod(along_mass: float = 1.0, stiffening: bool = False, lateral: int = 2, along: str | int = "quadratic") -> Rod:
    """The rod by assumed modes; as published with `along_mass` 15."""
    inertia = DENSITY * AREA * LENGTH * (LENGTH**2 / 3.0 + SIDE**2 / 12.0)
    return Rod(CRANK, LENGTH, RATE, DENSITY * AREA, inertia, YOUNGS_MODULUS * AREA, YOUNGS_MODULUS * SIDE**4 / 12.0,
               SLIDER, lateral, along, along_mass, stiffening)  # fmt: skip


def mechanism(parts: int) -> Mechanism:
    """The linkage, its rod divided by `parts` spring-damping elements (even: one rfe lies in the middle)."""
    axial, bending, density = YOUNGS_MODULUS * AREA, YOUNGS_MODULUS * SIDE**4 / 12.0, DENSITY * AREA
    shear, rotary = 10.0 * axial, 1e-3 * DENSITY * SIDE**4 / 12.0
    section = GivenSection(axial, shear, shear, bending, bending, bending, density, 2.0 * rotary, rotary, rotary)
    links = (
        body("crank", CRANK, 0.36, (CRANK / 2.0, 0, 0), (1e-4, 1e-3, 1e-3)),
        Link("rod", LENGTH, section, rfes=parts + 1),
        body("slider", 0.05, SLIDER, (0, 0, 0), (1e-5, 1e-5, 1e-5)),
    )
    joints = (
        Joint("A", "base", "crank"),
        Joint("B", "crank", "rod"),
        Joint("G", "base", "slider", kind="prismatic", displacement=CRANK + LENGTH),
        Joint("C", "rod", "slider", cut=True, child_position=(0, 0, 0)),
    )
    # A force of zero, whose place is that of the rod's middle.
    middle = PointForce("middle", "rod", LENGTH / 2.0, (0.0, 0.0, 0.0))
    return Mechanism(links, joints, gravity=(0.0, 0.0, 0.0), driven_joint="A", forces=(middle,))


def start(model: Model, parts: int) -> State:
    """The published start; the y axis of the published plane is here -z, that of the rod -z as well."""
    edge = LENGTH / (4.0 * parts)  # middle of rfe 0, as far from the start as that of the last one from the end
    x = np.append(LENGTH * np.arange(1, parts) / parts, LENGTH - edge)
    turning, one, two = REFERENCE["start_rates"][:3]

    def across(x):
        s = np.pi * x / LENGTH
        return one * np.sin(s) + two * np.sin(2.0 * s)

    def slope(x):
        s = np.pi * x / LENGTH
        return np.pi / LENGTH * (one * np.cos(s) + 2.0 * two * np.cos(2.0 * s))

    first = across(edge) / edge  # of rfe 0, relative to the chord
    zero = np.zeros_like(x)
    turns = slope(x)
    turns[-1] = -across(x[-1]) / edge  # the end stays on the chord
    rates = np.stack([zero, zero, -(across(x) - first * x), zero, turns - first, zero])
    s = x / LENGTH
    inner, outer = REFERENCE["start"]
    along = inner * 4.0 * s * (1.0 - s) + outer * s * (2.0 * s - 1.0)
    places = np.stack([along, *[zero] * 5])
    slider = CRANK + LENGTH + along[-1]
    joints = {"A": (0.0, RATE), "B": (0.0, turning + first - RATE), "G": (slider, 0.0)}
    order = [joints[name] for name in model.topology.joints[: model.topology.n_links]]
    position, velocity = (jnp.asarray(column, jnp.float64) for column in zip(*order, strict=True))
    return State(Coordinates(position, jnp.asarray(places)), Coordinates(velocity, jnp.asarray(rates)))


def run(parts: int, elements: str, step: float) -> Run:
    """Two and a half turns at a constant rate."""
    model = discretise(mechanism(parts), elements=elements)
    method = GeneralisedAlpha(step=step, tolerance=1e-7, spectral_radius=0.9)
    return simulate(
        Simulation(
            model,
            drive=PrescribedRate("A", RATE),
            duration=DURATION,
            method=method,
            save_every=DURATION / SAVED,
            start=start(model, parts),
        )
    )


def deflection(run: Run) -> np.ndarray:
    """Lateral deflection [m] of the rod's middle from its chord at the saved times."""
    crank = np.asarray(run.motion.angles["A"])
    pin = CRANK * np.stack([np.cos(crank), np.sin(crank)], axis=1)
    chord = np.stack([np.asarray(run.motion.displacements["G"]), np.zeros_like(crank)], axis=1) - pin
    chord /= np.linalg.norm(chord, axis=1, keepdims=True)
    place = np.asarray(run.forces["middle"].place)
    middle = np.stack([place[:, 0], -place[:, 2]], axis=1) - pin
    return chord[:, 0] * middle[:, 1] - chord[:, 1] * middle[:, 0]


def published_motion() -> np.ndarray:
    """Coordinates (times, 5) of the published model at the saved times."""
    model = rod(along_mass=15.0)
    along, rates = np.array(REFERENCE["start"]), np.array(REFERENCE["start_rates"])
    return model.motion(np.concatenate([np.zeros(3), along]), rates, DURATION, SAVED, STEPS)


def theory() -> np.ndarray:
    """Deflection [m] of the middle with the quadratic strain at the saved times."""
    model = rod(stiffening=True, lateral=3, along=6)
    rates, places = np.zeros(11), np.zeros(11)
    rates[:3], places[-1] = REFERENCE["start_rates"][:3], REFERENCE["start"][1]
    return np.asarray(model.deflection(model.motion(places, rates, DURATION, SAVED, STEPS)[:, 1:4]))


def published_lines(found: np.ndarray) -> list[Line]:
    """The published equations, solved here."""
    values = {
        "deflection": found[-1, 1:3],
        "angle": found[-1, :1],
        "slider": rod().slider_place(np.array([DURATION]), found[-1:, 0], found[-1:, -1]),
    }
    lines = []
    for quantity, computed in values.items():
        known = REFERENCE.quantities[quantity]
        names = [quantity] if len(computed) == 1 else [f"{quantity}, sine {n + 1}" for n in range(len(computed))]
        for name, value, given in zip(names, computed, known.values, strict=True):
            lines.append(relative(f"{TITLE}, published model", f"{name} at 0.1 s", value, given,
                                  PUBLISHED_SHARE, known.label, known.unit))  # fmt: skip
    return lines


def element_lines(run: Run, known: np.ndarray) -> list[Line]:
    """A rod of 8 elements against the deflection of the theory and the published values."""
    found, group = deflection(run), f"{TITLE}, 8 exact elements"
    allowed = DEFLECTION_SHARE * float(np.abs(known).max())
    slider = float(np.asarray(run.motion.displacements["G"])[-1])
    return [
        same(group, "status of the run", STATUS[int(run.status)].name, "ok", "-"),
        _farthest_off(group, found, known, allowed),
        absolute(group, "deflection at 0.1 s", found[-1], REFERENCE["deflection"][0], allowed, REFERENCE.label, "m",
                 STIFFENING),
        absolute(group, "slider at 0.1 s", slider, REFERENCE["slider"][0], 1e-6, REFERENCE.label, "m"),
    ]  # fmt: skip


def limit_lines(coarse: Run, fine: Run, known: np.ndarray) -> list[Line]:
    """Rods of 4 and 8 elements, extrapolated."""
    found, group = [deflection(run) for run in (coarse, fine)], f"{TITLE}, exact elements extrapolated"
    limit, largest = found[1] + (found[1] - found[0]) / 3.0, float(np.abs(known).max())
    errors = [float(np.sqrt(np.mean((values - known) ** 2))) for values in found]
    return [
        _farthest_off(group, limit, known, LIMIT_SHARE * largest),
        absolute(group, "error of 4 elements over that of 8", errors[0] / errors[1], *ORDER, THEORY),
    ]


def _farthest_off(group: str, found: np.ndarray, known: np.ndarray, allowed: float) -> Line:
    at = int(np.argmax(np.abs(found - known)))
    name = f"deflection at {at * DURATION / SAVED:.3g} s, farthest off"
    return absolute(group, name, found[at], known[at], allowed, THEORY, "m")


def validate(full: bool, progress: Progress) -> Outcome:
    """The published equations, then a rod of 8 elements, with `full` one of 4, too."""
    modes = published_motion()
    lines, known = published_lines(modes), theory()
    progress(0.2)
    fine = run(PARTS[1], "geometrically_exact", STEP)
    lines += element_lines(fine, known)
    if full:
        progress(0.6)
        lines += limit_lines(run(PARTS[0], "geometrically_exact", STEP), fine, known)
    progress(1.0)
    times = np.linspace(0.0, DURATION, SAVED + 1)
    curves = (
        Curve("geometrically exact, m = 8", times, deflection(fine)),
        Curve("quadratic strain", times[::2], known[::2], True),
        Curve("published model", times, modes[:, 1]),
    )
    picture = Picture("elastic_rod", "Elastic rod: deflection of its middle", "t, s", "m", curves)
    return Outcome(lines, [picture])
