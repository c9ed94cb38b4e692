"""A body on a spherical joint: tumbling without moments, and as a heavy top that precesses or nutates.

Place in the pipeline: a benchmark of `catalogue`; references by `rigid_body_theory`. No three angles describe these
motions: their orientations pass the singular ones of any three, and all bodies share one compiled program.
"""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from rfem_jax.description import Joint, Mechanism, RungeKutta4
from rfem_jax.mechanics.model.discretisation import discretise
from rfem_jax.mechanics.model.model import Coordinates, State
from rfem_jax.simulation import Run, Simulation, simulate
from rfem_jax.validation.lines import Curve, Line, Outcome, Picture, Progress, absolute, relative
from rfem_jax.validation.rigid_body_theory import FreeBody, HeavyTop, Rotations
from rfem_jax.validation.rigid_links import Axes, angles_of, body, turn_x, turn_y, turn_z

GRAVITY, MASS, ARM = 9.81, 0.6, 0.08  # m/s^2, kg, m: the top, its mass centre from the fixed point
AXIAL, ACROSS = 3e-3, 2e-3  # kg m^2, about the mass centre
PRECESSION, TILT = 6.0, np.radians(50.0)  # rad/s, of the steady precession
FALL, SPIN = np.radians(12.0), 4.0  # tilt at the start and spin of the nutating top
FREE = FreeBody((1e-3, 2e-3, 3e-3), (9.0, 5.5))
DURATION, STEP = 2.0, 2e-4
TURNED = 1e-7  # rad


def simulated(
    mass: float,
    centre: Sequence[float],
    inertia: Sequence[float],
    gravity: float,
    start: Axes,
    spin: Sequence[float],
) -> Run:
    """A body let go on a spherical joint at the origin; spin: angular velocity in its axes [rad/s]."""
    joint = Joint("O", "base", "top", kind="spherical", start=angles_of(start))
    top = body("top", 0.1, mass, centre, inertia)
    model = discretise(Mechanism((top,), (joint,), gravity=(0.0, 0.0, -gravity)))
    rates = Coordinates(jnp.asarray(start @ np.array(spin)), jnp.zeros((6, 0)))
    released = State(model.start_coordinates(), rates)
    return simulate(
        Simulation(model, drive=None, duration=DURATION, method=RungeKutta4(step=STEP), save_every=0.05, start=released)
    )


def rotations(run: Run) -> Rotations:
    """Of the body at the saved times."""
    return np.stack([turn_z(z) @ turn_y(y) @ turn_x(x) for x, y, z in np.asarray(run.motion.angles["O"])])


def turned(found: Rotations, known: Rotations) -> Float[np.ndarray, " times"]:
    """Angles [rad] by which rotations differ, where these are small."""
    return np.linalg.norm(np.asarray(found) - known, axis=(1, 2)) / np.sqrt(2.0)


def free_body() -> tuple[Run, Rotations]:
    """Run, and the closed form."""
    start = turn_z(0.4) @ turn_y(-0.7) @ turn_x(1.1)
    run = simulated(MASS, (0.0, 0.0, 0.0), FREE.inertia, 0.0, start, (FREE.spin[0], 0.0, FREE.spin[1]))
    return run, FREE.rotations(start, np.asarray(run.times))


def top() -> HeavyTop:
    """The top of this module about its fixed point."""
    return HeavyTop(AXIAL, ACROSS + MASS * ARM**2, MASS * GRAVITY * ARM)


def steady_top() -> tuple[Run, Rotations]:
    """Run, and the closed form."""
    start = HeavyTop.axes(0.0, TILT, 0.0)
    vertical = start.T @ [0.0, 0.0, PRECESSION]
    spin = (top().steady_spin(TILT, PRECESSION), vertical[1], vertical[2])
    run = simulated(MASS, (ARM, 0.0, 0.0), (AXIAL, ACROSS, ACROSS), GRAVITY, start, spin)
    return run, top().steady(TILT, PRECESSION, np.asarray(run.times))


def nutating_top() -> tuple[Run, Rotations, Float[np.ndarray, " times"]]:
    """Run, rotations and tilts [rad] of the reduced equations."""
    start = HeavyTop.axes(0.0, FALL, 0.0)
    run = simulated(MASS, (ARM, 0.0, 0.0), (AXIAL, ACROSS, ACROSS), GRAVITY, start, (SPIN, 0.0, 0.0))
    return run, *top().nutation(FALL, SPIN, np.asarray(run.times))


def validate(full: bool, progress: Progress) -> Outcome:
    """Largest differences of the orientation, range of the nutation, load of the steady top."""
    del full
    group, closed = "Body on a spherical joint", "closed form (Landau, Lifshitz)"
    run, known = free_body()
    lines: list[Line] = []
    error = turned(rotations(run), known).max()
    lines.append(absolute(group, "tumbling freely, turned off the closed form", error, 0.0, TURNED, closed, "rad"))
    progress(0.4)
    run, known = steady_top()
    error = turned(rotations(run), known).max()
    lines.append(absolute(group, "steady precession, turned off the closed form", error, 0.0, TURNED, closed, "rad"))
    across = PRECESSION**2 * ARM * np.sin(TILT)
    force = np.linalg.norm(np.asarray(run.loads["O"].force)[-1])
    lines.append(relative(group, "steady precession, force at the end", force, MASS * np.hypot(GRAVITY, across), 1e-8,
                          closed, "N"))  # fmt: skip
    progress(0.7)
    run, known, tilts = nutating_top()
    found, solved = rotations(run), "reduced equations, solved to 1e-12"
    lines.append(absolute(group, "nutation, turned off the reduced equations", turned(found, known).max(), 0.0, TURNED,
                          solved, "rad"))  # fmt: skip
    ours = np.arccos(found[:, 2, 0])
    lines.append(absolute(group, "nutation, largest tilt", ours.max(), tilts.max(), TURNED, solved, "rad"))
    progress(1.0)
    times = np.asarray(run.times)
    curves = Curve("tilt", times, ours), Curve("reduced equations", times, tilts, True)
    return Outcome(lines, [Picture("spinning_bodies", "Nutating top: tilt of its axis", "t, s", "rad", curves)])
