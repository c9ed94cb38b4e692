"""One body on a joint of each kind, let go under gravity, against all tables of these kinds computed with Adams.

Place in the pipeline: a benchmark of `catalogue`. Reference values: `references/joint_tables.json`; positions of the
mass centre, angular velocity, and force and torque of the body on the ground at the joint's point, in global axes.

The tables' joints turn about and slide along z of their frame, the universal one turns about x of the ground and y of
the body. The table of the universal joint loses energy, which nothing in the mechanism takes; its motion is therefore
compared with Lagrange's equations of the two angles, too, derived by JAX and solved by SciPy to 1e-11. So do
tables of the spherical and the universal joint in which the body swings in a plane, as in the first table of the
revolute joint, which keeps its energy.
"""

from collections.abc import Callable
from dataclasses import dataclass, field

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from scipy.integrate import solve_ivp

from rfem_jax.description import Joint, JointForceFunction, JointSpring, Mechanism, RungeKutta4
from rfem_jax.description.mechanism.forces import JointForce
from rfem_jax.mechanics.dynamics.loads import static_state
from rfem_jax.mechanics.model.discretisation import discretise
from rfem_jax.simulation import Run, Simulation, simulate
from rfem_jax.validation.lines import Line, Outcome, Progress, absolute
from rfem_jax.validation.reference_values import Reference, read_reference
from rfem_jax.validation.rigid_links import Axes, angles_of, body, turn_x, turn_y, turn_z

REFERENCE = read_reference("joint_tables")
SHARE = 1e-4  # of the largest value of a table
MASS, ARM, GRAVITY = 1.0, 2.0, (0.0, 0.0, -9.80665)
TABLE_OFF = (
    "the table loses energy in a mechanism that conserves it; our motion agrees with Lagrange's equations, solved "
    "independently (universal joint, case 3), and is that of the table of the revolute joint, case 1 (the others)"
)


@dataclass(frozen=True)
class Case:
    """A kind of joint; its axes on the body and on the ground at the start, relative to the tables' frame; its place
    [m]; this frame; mass centre and inertia of the body in it; what acts in the joint."""

    kind: str
    axes: Axes
    place: tuple[float, float, float] = (1.0, 2.0, 3.0)
    frame: Axes = field(default_factory=lambda: turn_x(-np.pi / 4.0))
    centre: tuple[float, float, float] = (ARM, 0.0, 0.0)
    inertia: tuple[float, float, float] = (0.04, 0.1, 0.1)
    forces: tuple[JointForce, ...] = ()
    law: Callable[..., Array] | None = None  # which of the forces is a function: it is no part of the joint's load


def softer(angle, rate):
    """Moment [N m] of the second spring, whose stiffness grows with the angle, and of its damper."""
    return -(50.0 + 10.0 * jnp.abs(angle)) * angle - 10.0 * rate


ORIGIN = (0.0, 0.0, 0.0)
ALONG_Z = turn_x(np.pi / 2.0)  # y is the tables' z
SLIDING = turn_y(-np.pi / 2.0)  # x is the tables' z
CROSS = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])  # y is the tables' x, z their y
QUARTER, NONE = turn_x(-np.pi / 2.0), np.eye(3)
HANGING = (0.0, 0.0, -ARM)
ASKEW = turn_z(-np.pi / 4.0) @ turn_x(np.pi / 2.0) @ turn_z(np.pi / 4.0)
CONSERVING = ("revolute", "spherical", "universal")  # joints about whose point a body turns without loss
SPRING = JointSpring("spring", "J", stiffness=200.0, damping=10.0)
CASES = {
    "revolute 1": Case("revolute", ALONG_Z, ORIGIN, QUARTER),
    "revolute 2": Case("revolute", ALONG_Z),
    "prismatic 1": Case("prismatic", SLIDING, ORIGIN, NONE),
    "prismatic 2": Case("prismatic", SLIDING),
    "prismatic 3": Case("prismatic", SLIDING, frame=QUARTER),
    "cylindrical 1": Case("cylindrical", ALONG_Z, ORIGIN, NONE),
    "cylindrical 2": Case("cylindrical", ALONG_Z, ORIGIN, QUARTER),
    "cylindrical 3": Case("cylindrical", ALONG_Z),
    "spherical 1": Case("spherical", NONE, ORIGIN, NONE),
    "spherical 2": Case("spherical", NONE),
    "universal 1": Case("universal", CROSS, ORIGIN, turn_x(np.pi / 2.0), HANGING, (0.1, 0.1, 0.04)),
    "universal 2": Case("universal", CROSS, ORIGIN, turn_y(np.pi / 2.0), HANGING, (0.1, 0.1, 0.04)),
    "universal 3": Case("universal", CROSS, ORIGIN, ASKEW, HANGING, (0.1, 0.1, 0.04)),
    "spring 1": Case("revolute", ALONG_Z, ORIGIN, QUARTER, forces=(SPRING,)),
    "spring 2": Case(
        "revolute",
        ALONG_Z,
        ORIGIN,
        QUARTER,
        (ARM, 0.0, 0.0),
        law=softer,
        forces=(JointForceFunction("spring", "J", softer),),
    ),
}


def simulated(name: str) -> Run:
    """Five seconds, and two saved times for differences, from rest; the body's axes are those of the tables' frame."""
    case = CASES[name]
    pendulum = body("body", 4.0, MASS, case.centre, case.inertia)
    joint = Joint("J", "base", "body", kind=case.kind, position=case.place,
                  orientation=angles_of(case.frame @ case.axes), child_orientation=angles_of(case.axes))  # fmt: skip
    model = discretise(Mechanism((pendulum,), (joint,), gravity=GRAVITY, forces=case.forces))
    start = static_state(model.topology, model.start_coordinates())
    return simulate(
        Simulation(model, drive=None, duration=5.02, method=RungeKutta4(step=1e-3), save_every=0.01, start=start)
    )


def motions(kind: str, run: Run) -> tuple[Float[np.ndarray, "times 3 3"], Float[np.ndarray, "times 3"]]:
    """Rotations of the joint's frame on the body relative to that on the ground, and its displacement there [m]."""
    times = len(np.asarray(run.times))
    displacement = np.zeros((times, 3))
    if kind in ("prismatic", "cylindrical"):
        displacement[:, 0 if kind == "prismatic" else 1] = np.asarray(run.motion.displacements["J"])
    angles = np.asarray(run.motion.angles["J"]).reshape(times, -1) if "J" in run.motion.angles else np.zeros((times, 0))
    turns = {
        "prismatic": lambda: np.eye(3),
        "universal": lambda first, second: turn_y(first) @ turn_z(second),
        "spherical": lambda x, y, z: turn_z(z) @ turn_y(y) @ turn_x(x),
    }
    turn = turns.get(kind, turn_y)
    return np.stack([turn(*values) for values in angles]), displacement


def angular_velocity(rotation: Float[np.ndarray, "times 3 3"], step: float) -> Float[np.ndarray, "times 3"]:
    """In global axes [rad/s], by differences of rotations at equal steps [s]; the two times at either end are none."""
    derivative = (
        8.0 * (np.roll(rotation, -1, 0) - np.roll(rotation, 1, 0)) - np.roll(rotation, -2, 0) + np.roll(rotation, 2, 0)
    ) / (12.0 * step)
    spin = derivative @ np.swapaxes(rotation, 1, 2)
    return np.stack([spin[:, 2, 1], spin[:, 0, 2], spin[:, 1, 0]], axis=1)


def observed(name: str, run: Run) -> dict[str, Float[np.ndarray, "times 3"]]:
    """The tables' quantities at the saved times; the angular velocity by differences of rotations."""
    case = CASES[name]
    relative, displacement = motions(case.kind, run)
    seat = case.frame @ case.axes
    rotation = seat @ relative @ case.axes.T
    moved = displacement @ seat.T
    position = np.array(case.place) + moved + rotation @ np.array(case.centre)
    rate = angular_velocity(rotation, float(run.times[1] - run.times[0]))
    load = {key: np.asarray(getattr(run.loads["J"], key)) for key in ("force", "moment")}
    to_global = seat @ relative
    force = -np.einsum("tij,tj->ti", to_global, load["force"])
    torque = -np.einsum("tij,tj->ti", to_global, load["moment"]) + np.cross(moved, force)
    if case.law is not None:
        axis = seat[:, 1]
        law = np.asarray(case.law(jnp.asarray(run.motion.angles["J"]), jnp.asarray(rate @ axis)))
        torque = torque - law[:, None] * axis
    return {"position": position, "rate": rate, "force": force, "torque": torque}


def energy_loss(name: str) -> float:
    """Change of a table's energy from rest to its last row, as a share of its largest kinetic energy, for a body that
    is symmetric about the line from the joint's point to its mass centre."""
    case, (axial, across) = CASES[name], sorted(CASES[name].inertia)[:2]
    place, rate = (np.array(list(REFERENCE[key][name].values())) for key in ("position", "rate"))
    arm = place - np.array(case.place)
    start = np.array(case.place) + case.frame @ np.array(case.centre)
    turning = across * np.sum(rate**2, 1) + (axial - across) * np.sum(rate * arm, 1) ** 2 / ARM**2
    kinetic = 0.5 * (MASS * np.sum(np.cross(rate, arm) ** 2, 1) + turning)
    return float(kinetic[-1] - MASS * (place[-1] - start) @ np.array(GRAVITY)) / float(kinetic.max())


def table_lines(
    reference: Reference,
    table: str,
    group: str,
    number: str,
    run: Run,
    found: dict[str, Float[np.ndarray, "times 3"]],
    reason: str = "",
) -> list[Line]:
    """Of each quantity's table the value that is farthest off, as a share of its largest; number: of the case."""
    lines, times = [], np.asarray(run.times)
    for key, values in found.items():
        quantity = reference.quantities[key]
        named, rows = zip(*quantity.values[table].items())
        known = np.array(rows)
        ours = values[[int(np.argmin(np.abs(times - float(time)))) for time in named]]
        largest = np.abs(known).max()
        row, column = np.unravel_index(np.argmax(np.abs(ours - known)), known.shape)
        title = f"case {number}, {key} {'xyz'[column]} at {named[row]} s"
        allowed = SHARE * largest if largest > 0.0 else 1e-9
        lines.append(absolute(group, title, ours[row, column], known[row, column], allowed,
                              quantity.label, quantity.unit, reason))  # fmt: skip
    return lines


def lines_of(name: str, run: Run) -> list[Line]:
    """Of each table the value that is farthest off."""
    what, number = name.split()
    group = "Adams, hinge with a spring" if what == "spring" else f"Adams, {what} joint"
    reason = TABLE_OFF if what in CONSERVING and abs(energy_loss(name)) > SHARE else ""
    return table_lines(REFERENCE, name, group, number, run, observed(name, run), reason)


def lagrange_angles(times: Float[np.ndarray, " times"]) -> Float[np.ndarray, "times 2"]:
    """The two angles [rad] of the universal joint by Lagrange's equations."""
    case = CASES["universal 3"]
    seat, of_body = jnp.asarray(case.frame @ case.axes), jnp.asarray(case.axes)
    centre, inertia = jnp.asarray(case.centre), jnp.asarray(case.inertia)

    def rotation(q):
        (ca, cb), (sa, sb) = jnp.cos(q), jnp.sin(q)
        one, none = jnp.ones_like(ca), jnp.zeros_like(ca)
        first = jnp.array([[ca, none, sa], [none, one, none], [-sa, none, ca]])
        second = jnp.array([[cb, -sb, none], [sb, cb, none], [none, none, one]])
        return seat @ first @ second @ of_body.T

    def lagrangian(q, rate):
        turned, derivative = jax.jvp(rotation, (q,), (rate,))
        spin = turned.T @ derivative
        w = jnp.stack([spin[2, 1], spin[0, 2], spin[1, 0]])
        velocity = derivative @ centre
        return 0.5 * (MASS * velocity @ velocity + w @ (inertia * w)) + MASS * (turned @ centre) @ jnp.array(GRAVITY)

    @jax.jit
    def derivative(y):
        q, rate = y[:2], y[2:]
        by_rate = jax.grad(lagrangian, 1)
        mass = jax.jacfwd(by_rate, 1)(q, rate)
        force = jax.grad(lagrangian, 0)(q, rate) - jax.jvp(lambda p: by_rate(p, rate), (q,), (rate,))[1]
        return jnp.concatenate([rate, jnp.linalg.solve(mass, force)])

    solved = solve_ivp(lambda _, y: np.asarray(derivative(jnp.asarray(y))), (0.0, times[-1]), np.zeros(4),
                       method="DOP853", t_eval=times, rtol=1e-11, atol=1e-12)  # fmt: skip
    return solved.y[:2].T


def lagrange_lines(run: Run) -> list[Line]:
    """Angles of the universal joint."""
    every = slice(0, None, 50)
    ours = np.asarray(run.motion.angles["J"])[every]
    known = lagrange_angles(np.asarray(run.times)[every])
    row, column = np.unravel_index(np.argmax(np.abs(ours - known)), known.shape)
    name = f"angle {column + 1} at {float(run.times[50 * row]):.2g} s"
    return [
        absolute("Universal joint, Lagrange's equations", name, ours[row, column], known[row, column], 1e-7,
                 "Lagrange's equations, solved to 1e-11", "rad")
    ]  # fmt: skip


def validate(full: bool, progress: Progress) -> Outcome:
    """All cases."""
    del full
    lines: list[Line] = []
    for number, name in enumerate(CASES):
        run = simulated(name)
        lines += lines_of(name, run)
        if name == "universal 3":
            lines += lagrange_lines(run)
        progress((number + 1) / len(CASES))
    return Outcome(lines)
