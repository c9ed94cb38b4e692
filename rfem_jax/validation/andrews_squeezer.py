"""Andrews' squeezing mechanism: seven bodies, three loops, accelerations of 5e5 rad/s^2.

Place in the pipeline: a benchmark of `catalogue`. Reference values: `references/andrews_squeezer.json`.

All loops close in the point P. The mechanism is planar and rigid: motion is unique, loads across its plane are not
(minimum norm). Its spring is fixed to the base and to body K3, which turns about the base: it is a moment on K3's
hinge. The reference's plane (x, y) is here (X, -Z), so that angles have the same sign.

Angles and rates are compared with the table. Its accelerations and multipliers do not solve the equations of motion at
its own angles and rates by more than a share of 1e-7: there they are compared with Lagrange's equations, too.
"""

import jax
import jax.numpy as jnp
import numpy as np

from rfem_jax.description import Joint, JointForceFunction, Mechanism, MomentTable, RungeKutta4
from rfem_jax.mechanics.dynamics.dynamics import accelerations
from rfem_jax.mechanics.dynamics.loads import static_state
from rfem_jax.mechanics.model.discretisation import discretise
from rfem_jax.mechanics.model.errors import assembly_errors
from rfem_jax.mechanics.model.inputs import DriveInput, Stabilisation
from rfem_jax.mechanics.model.model import Coordinates, Model, State
from rfem_jax.mechanics.model.with_errors import apply_errors
from rfem_jax.simulation import Run, Simulation, simulate
from rfem_jax.validation.lines import Line, Outcome, Progress, absolute
from rfem_jax.validation.reference_values import read_reference
from rfem_jax.validation.rigid_links import body, turn_y
from rfem_jax.validation.squeezer_theory import accelerations_and_forces

REFERENCE = read_reference("andrews_squeezer")
SHARE = 1e-8  # of the largest angle, rate, acceleration, force
TABLE_OFF = (
    "the table's accelerations and multipliers do not solve the equations of motion at the table's angles and rates; "
    "ours do (next group)"
)
MOMENT, DURATION, STEP = 0.033, 0.03, 5e-6
A, B, C = (-0.06934, 0.0, 0.00227), (-0.03635, 0.0, -0.03273), (0.014, 0.0, -0.072)  # m, points of the base
STIFFNESS, FREE_LENGTH = 4530.0, 0.07785  # N/m, m
K1, K2, K3, K4, K5, K6, K7 = 0.007, 0.028, 0.035, 0.02, 0.04, 0.02, 0.04  # m, lengths
SPRING_ON_K3 = (0.02, 0.018)  # m, along its x and z axes


def spring_moment(angle, rate):
    """Moment [N m] of the spring about the hinge of K3."""
    del rate
    c, s = jnp.cos(angle), jnp.sin(angle)
    x, z = SPRING_ON_K3
    arm = jnp.stack([x * c + z * s, z * c - x * s])
    pull = jnp.array([C[0] - B[0], C[2] - B[2]]) - arm
    length = jnp.sqrt(pull @ pull)
    force = STIFFNESS * (length - FREE_LENGTH) / length * pull
    return arm[1] * force[0] - arm[0] * force[1]


def _moments() -> dict[str, float]:
    """Moment [N m] of every drive."""
    return {joint: MOMENT if joint == "beta" else 0.0 for joint in REFERENCE["start"]}


def _links():
    """Bodies by mass [kg], mass centre (x, z) [m] and inertia about y [kg m^2]."""
    table = {
        "K1": (K1, 0.04325, (0.00092, 0.0), 2.194e-6),
        "K2": (K2, 0.00365, (-0.0115, 0.0), 4.410e-7),
        "K3": (K3, 0.02373, (0.01043, 0.01874), 5.255e-6),
        "K4": (K4, 0.00706, (0.0, K4 - 0.01421), 5.667e-7),
        "K5": (K5, 0.07050, (0.02308, -0.00916), 1.169e-5),
        "K6": (K6, 0.00706, (K6 - 0.01421, 0.0), 5.667e-7),
        "K7": (K7, 0.05498, (-0.00449, 0.01228), 1.912e-5),
    }
    return tuple(
        body(name, length, mass, (x, 0.0, z), (inertia,) * 3) for name, (length, mass, (x, z), inertia) in table.items()
    )


def mechanism() -> Mechanism:
    """Angles as the reference's beta, theta, gamma, phi, delta, omega, epsilon."""
    start = REFERENCE["start"]
    joints = (
        Joint("beta", "base", "K1", angle=start["beta"]),
        Joint("theta", "K1", "K2", position=(K1, 0, 0), angle=start["theta"]),
        Joint("gamma", "base", "K3", position=B, angle=start["gamma"]),
        Joint("delta", "base", "K5", position=A, angle=start["delta"]),
        Joint("phi", "K5", "K4", position=(K5, 0, 0), angle=start["phi"]),
        Joint("epsilon", "base", "K7", position=A, angle=start["epsilon"]),
        Joint("omega", "K7", "K6", position=(0, 0, K7), angle=start["omega"]),
        *(
            Joint(f"P{child[1]}", "K2", child, kind="spherical", cut=True, position=(-K2, 0, 0), child_position=point)
            for child, point in (("K3", (0, 0, K3)), ("K4", (0, 0, K4)), ("K6", (K6, 0, 0)))
        ),
    )
    spring = JointForceFunction("spring", "gamma", spring_moment)
    return Mechanism(_links(), joints, gravity=(0.0, 0.0, 0.0), driven_joint=tuple(REFERENCE["start"]),
                     forces=(spring,), redundant_reactions="minimum_norm")  # fmt: skip


def simulated() -> tuple[Model, Run]:
    """From rest under a constant moment; the other drives are there to know the rates, their moments are zero."""
    model = discretise(mechanism())
    drives = [MomentTable(joint, [0.0, 1.0], [moment, moment]) for joint, moment in _moments().items()]
    start = static_state(model.topology, model.start_coordinates())
    return model, simulate(
        Simulation(model, drive=drives, duration=DURATION, method=RungeKutta4(step=STEP), save_every=0.001, start=start)
    )


def accelerations_at_end(model: Model, run: Run) -> dict[str, float]:
    """Accelerations of the angles [rad/s^2] in the last state."""
    topology = model.topology
    position = jax.tree.map(lambda x: x[-1], run.motion.positions)
    rates = np.zeros(topology.n_freedoms)
    rates[list(topology.drives)] = [float(run.motion.drives[label].rate[-1]) for label in topology.drive_labels]
    state = State(position, Coordinates(jnp.asarray(rates), jnp.zeros_like(position.elastic)))
    forces = {k: jnp.asarray(_moments()[label]) for label, k in zip(topology.drive_labels, topology.drives)}
    actual = apply_errors(model, assembly_errors(model))
    without = Stabilisation(0.0, 0.0, 1.0)
    found = accelerations(actual, state, DriveInput(forces), without).coordinates.joints
    return {label: float(found[k]) for label, k in zip(topology.drive_labels, topology.drives)}


def forces_at_end(run: Run) -> dict[str, tuple[float, float]]:
    """Forces on K3, K4 and K6 in the point P along the reference's x and y [N], in the last state."""
    angle = {joint: float(values[-1]) for joint, values in run.motion.angles.items()}
    turned = turn_y(angle["beta"] + angle["theta"])
    found = {}
    for joint in REFERENCE["force"]:
        x, _, z = turned @ np.asarray(run.loads[joint].force)[-1]
        found[joint] = float(x), -float(z)
    return found


def by_lagrange() -> dict[str, dict[str, np.ndarray]]:
    """Accelerations [rad/s^2] and forces [N] of Lagrange's equations at the table's angles and rates."""
    names = list(REFERENCE["start"])
    angles, rates = (np.array([REFERENCE[key][name] for name in names]) for key in ("angle", "rate"))
    found, forces = accelerations_and_forces(angles, rates)
    return {
        "acceleration": dict(zip(names, found, strict=True)),
        "force": dict(zip(REFERENCE["force"], forces, strict=True)),
    }


def checked(model: Model, run: Run) -> list[Line]:
    """Seven angles, rates and accelerations and six forces at the end, within a share of the largest of their kind."""
    ours = {
        "angle": {joint: float(values[-1]) for joint, values in run.motion.angles.items()},
        "rate": {joint: float(history.rate[-1]) for joint, history in run.motion.drives.items()},
        "acceleration": accelerations_at_end(model, run),
        "force": forces_at_end(run),
    }
    theory, group = by_lagrange(), "Andrews' squeezer"
    lines = []
    for key, found in ours.items():
        quantity = REFERENCE.quantities[key]
        table, label = quantity.values, quantity.label
        if key not in theory:
            lines += _lines(group, key, found, table, label)
            continue
        off = max(float(np.abs(theory[key][joint] - np.asarray(known)).max()) for joint, known in table.items())
        reason = TABLE_OFF if off > SHARE * _largest(table) else ""
        lines += _lines(group, key, found, table, label, reason)
        lines += _lines(f"{group}, Lagrange's equations", key, found, theory[key], "Lagrange's equations")
    return lines


def _largest(values) -> float:
    return max(float(np.abs(value).max()) for value in values.values())


def _lines(group: str, key: str, found, known, label: str, reason: str = "") -> list[Line]:
    """A line for each joint, or for each component."""
    allowed, unit = SHARE * _largest(known), REFERENCE.quantities[key].unit
    axes = (" x", " y") if key == "force" else ("",)
    return [
        absolute(group, f"{key}{axis} of {joint} at 0.03 s", float(ours), float(value), allowed, label, unit, reason)
        for joint, values in known.items()
        for ours, value, axis in zip(np.atleast_1d(found[joint]), np.atleast_1d(values), axes, strict=True)
    ]


def validate(full: bool, progress: Progress) -> Outcome:
    """30 ms."""
    del full
    lines = checked(*simulated())
    progress(1.0)
    return Outcome(lines)
