"""A free body on a spring between two points, and one moved along a guide, against all tables of these by Adams.

Place in the pipeline: a benchmark of `catalogue`. Reference values: `references/force_tables.json`, in global axes.

A spring joins a point of the body to one of the ground; its free length is the distance of both at the start. Its
tension is given by the numbers of a linear spring, or as a function of its length and rate. The actuator keeps a
constant speed; of the joint's load what is along the guide is the actuator's, the rest that of the guide.

Motions of a body that its spring turns are compared with Newton's and Euler's equations, too, solved by SciPy to 1e-11:
one table is not as near to them as it is asked to be.
"""

from dataclasses import dataclass

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.integrate import solve_ivp

from rfem_jax.description import (
    Joint,
    Mechanism,
    PointSpring,
    PointSpringFunction,
    PrescribedDisplacements,
    RungeKutta4,
)
from rfem_jax.mechanics.dynamics.loads import static_state
from rfem_jax.mechanics.model.discretisation import discretise
from rfem_jax.mechanics.model.model import Coordinates
from rfem_jax.simulation import Run, Simulation, simulate
from rfem_jax.validation.joint_tables import ARM, GRAVITY, MASS, NONE, ORIGIN, SLIDING, angular_velocity, table_lines
from rfem_jax.validation.lines import Line, Outcome, Progress, absolute
from rfem_jax.validation.reference_values import read_reference
from rfem_jax.validation.rigid_links import Axes, angles_of, body, turn_x, turn_y, turn_z

REFERENCE = read_reference("force_tables")
DURATION = 5.02  # s: more than the tables have, for differences
INERTIA = (0.04, 0.1, 0.1)
TABLE_OFF = "the table is off by as much from Newton's and Euler's equations, solved independently, which are met"


class Tension(eqx.Module):
    """(stiffness + growth |stretch|) stretch + damping rate [N]; numbers: stiffness [N/m], growth [N/m^2], damping
    [N s/m], free length [m]."""

    numbers: Float[Array, "4"]

    def __call__(self, length: Float[Array, ""], rate: Float[Array, ""]) -> Float[Array, ""]:
        stiffness, growth, damping, free = self.numbers
        stretch = length - free
        return (stiffness + growth * jnp.abs(stretch)) * stretch + damping * rate


@dataclass(frozen=True)
class Sprung:
    """The table; mass centre [m] and axes of the body at the start; the spring's point on the ground [m] and on the
    body's axis [m]; its numbers as of `Tension`."""

    table: str
    centre: tuple[float, float, float]
    axes: Axes
    ground: tuple[float, float, float]
    arm: float
    numbers: tuple[float, float, float, float]


FIRST = Sprung("spring 1", ORIGIN, NONE, ORIGIN, 0.0, (10.0, 0.0, 0.5, 0.0))
SECOND = Sprung("spring 2", (0.0, 2.0, 0.0), NONE, ORIGIN, 0.0, (100.0, 0.0, 5.0, 2.0))
STIFFENING = (50.0, 10.0, 5.0, 2.0)
SPRUNG = {
    "spring 1": FIRST,
    "spring 2": SECOND,
    "function 1": FIRST,
    "function 2": SECOND,
    "function 3": Sprung("spring 3", (-1.0, 4.0, 3.0), NONE, (1.0, 2.0, 3.0), ARM, STIFFENING),
    "function 4": Sprung("spring 4", (0.0, 4.0, 0.0), turn_z(-np.pi / 2.0), ORIGIN, ARM, STIFFENING),
}
GROUPS = {"spring": "Adams, spring between points", "function": "Adams, function of length and rate"}
MOVED = {"actuator 1": (NONE, 1.0), "actuator 2": (turn_y(np.pi / 4.0), 0.5)}  # frame of the guide, speed [m/s]


def spring(name: str) -> PointSpring | PointSpringFunction:
    """The spring of a case."""
    case = SPRUNG[name]
    ends = ("base", "body"), (case.ground, (case.arm, 0.0, 0.0))
    if name.startswith("function"):
        return PointSpringFunction("spring", *ends, Tension(jnp.asarray(case.numbers, jnp.float64)))
    stiffness, _, damping, free = case.numbers
    return PointSpring("spring", *ends, stiffness, damping, free)


def released(name: str) -> Run:
    """The body on a spring, let go at rest; described a metre lower, since the first spring has no direction at the
    start."""
    case = SPRUNG[name]
    x, y, z = case.centre
    joint = Joint("J", "base", "body", kind="free", start=(x, y, z - 1.0, *angles_of(case.axes)))
    free = body("body", 4.0, MASS, ORIGIN, INERTIA)
    model = discretise(Mechanism((free,), (joint,), gravity=GRAVITY, forces=(spring(name),)))
    lower = model.start_coordinates()
    start = static_state(model.topology, Coordinates(lower.joints.at[2].add(1.0), lower.elastic))
    # Saved often: the spring shakes the body at its end ten times a second.
    return simulate(
        Simulation(model, drive=None, duration=DURATION, method=RungeKutta4(step=1e-3), save_every=0.002, start=start)
    )


def observed(run: Run) -> dict[str, Float[np.ndarray, "times 3"]]:
    """The tables' quantities at the saved times, the angular velocity by differences of rotations."""
    rotation = np.stack([turn_z(z) @ turn_y(y) @ turn_x(x) for x, y, z in np.asarray(run.motion.angles["J"])])
    return {
        "position": np.asarray(run.motion.displacements["J"]),
        "rate": angular_velocity(rotation, float(run.times[1] - run.times[0])),
        "spring force": -np.asarray(run.forces["spring"].force),
    }


def released_lines(name: str, run: Run) -> list[Line]:
    """Of each table of a spring the value that is farthest off."""
    what, number = name.split()
    reason = TABLE_OFF if name == "function 4" else ""
    return table_lines(REFERENCE, SPRUNG[name].table, GROUPS[what], number, run, observed(run), reason)


def solved(name: str, times: Float[np.ndarray, " times"]) -> dict[str, Float[np.ndarray, "times 3"]]:
    """Position [m] of the mass centre and angular velocity [rad/s] by Newton's and Euler's equations."""
    case = SPRUNG[name]
    stiffness, growth, damping, free = case.numbers
    ground, weight = np.array(case.ground), MASS * np.array(GRAVITY)

    def derivative(_, state):
        place, velocity, rate, rotation = state[:3], state[3:6], state[6:9], state[9:].reshape(3, 3)
        arm, inertia = case.arm * rotation[:, 0], (rotation * INERTIA) @ rotation.T
        apart = place + arm - ground
        length = np.linalg.norm(apart)
        towards = (velocity + np.cross(rate, arm)) @ apart / length
        pull = stiffness * (length - free) + growth * abs(length - free) * (length - free) + damping * towards
        force = -pull * apart / length
        turned = np.linalg.solve(inertia, np.cross(arm, force) - np.cross(rate, inertia @ rate))
        return np.concatenate([velocity, (force + weight) / MASS, turned, np.cross(rate, rotation, axisb=0).T.ravel()])

    start = np.concatenate([case.centre, np.zeros(6), case.axes.ravel()])
    found = solve_ivp(derivative, (0.0, times[-1]), start, "DOP853", t_eval=times, rtol=1e-11, atol=1e-12).y.T
    return {"position": found[:, :3], "rate": found[:, 6:9]}


def solved_lines(name: str, run: Run) -> list[Line]:
    """Of the motion what is farthest off these equations, among a hundred times."""
    lines, every = [], slice(50, -10, 25)
    times, ours = np.asarray(run.times)[every], observed(run)
    known = solved(name, times)
    for key, unit, allowed in (("position", "m", 1e-7), ("rate", "rad/s", 5e-5)):
        found = ours[key][every]
        row, column = np.unravel_index(np.argmax(np.abs(found - known[key])), found.shape)
        title = f"case {name.split()[1]}, {key} {'xyz'[column]} at {times[row]:.4g} s"
        lines.append(absolute("Sprung body, Newton's equations", title, found[row, column], known[key][row, column],
                              allowed, "Newton's and Euler's equations, solved to 1e-11", unit))  # fmt: skip
    return lines


def moved(name: str) -> Run:
    """The body along the guide."""
    frame, speed = MOVED[name]
    joint = Joint("J", "base", "body", kind="prismatic", orientation=angles_of(frame @ SLIDING),
                  child_orientation=angles_of(SLIDING))  # fmt: skip
    plate = body("body", 1.0, MASS, ORIGIN, (1.0, 1.0, 1.0))
    model = discretise(Mechanism((plate,), (joint,), gravity=GRAVITY, driven_joint="J"))
    drive = PrescribedDisplacements("J", (0.0, DURATION), (0.0, DURATION * speed))
    return simulate(Simulation(model, drive=drive, duration=DURATION, method=RungeKutta4(step=1e-2), save_every=0.1))


def moved_lines(name: str, run: Run) -> list[Line]:
    """Of each table of an actuator the value that is farthest off."""
    guide = MOVED[name][0] @ SLIDING
    place = np.asarray(run.motion.displacements["J"])[:, None] * guide[:, 0]
    force, moment = (np.asarray(getattr(run.loads["J"], key)) @ guide.T for key in ("force", "moment"))
    along = (force @ guide[:, :1]) * guide[:, 0]
    torque = -moment - np.cross(place, force)
    found = {"position": place, "actuator force": along, "guide force": along - force, "guide torque": torque}
    return table_lines(REFERENCE, name, "Adams, actuator", name.split()[1], run, found)


def validate(full: bool, progress: Progress) -> Outcome:
    """All cases."""
    del full
    lines: list[Line] = []
    cases = [(name, released, released_lines) for name in SPRUNG] + [(name, moved, moved_lines) for name in MOVED]
    for number, (name, run, compared) in enumerate(cases):
        result = run(name)
        lines += compared(name, result)
        if name in ("function 3", "function 4"):
            lines += solved_lines(name, result)
        progress((number + 1) / len(cases))
    return Outcome(lines)
