"""Andrews' squeezing mechanism: seven bodies, three loops, accelerations of 5e5 rad/s^2.

Place in the pipeline: a benchmark of `catalogue`. Reference values: `references/andrews_squeezer.json`.

All loops close in the point P. The mechanism is planar and rigid: motion is unique, loads across its plane are not
(minimum norm). Its spring is fixed to the base and to body K3, which turns about the base: it is a moment on K3's
hinge. The reference's plane (x, y) is here (X, -Z), so that angles have the same sign.
"""

import jax.numpy as jnp
import numpy as np

from rfem_jax.description import Joint, JointForceFunction, Mechanism, Method, MomentTable
from rfem_jax.mechanics.discretisation import discretise
from rfem_jax.mechanics.loads import static_state
from rfem_jax.simulation import Run, simulate
from rfem_jax.validation.lines import Line, Outcome, Progress, absolute
from rfem_jax.validation.reference_values import read_reference
from rfem_jax.validation.rigid_links import body

REFERENCE = read_reference("andrews_squeezer")
SHARE = 1e-8  # of the largest angle and of the largest rate
MOMENT, DURATION, STEP = 0.033, 0.03, 1e-5
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


def _links():
    """Bodies by mass [kg], mass centre (x, z) [m] and inertia about y [kg m^2]."""
    table = {
        "K1": (K1, 0.04325, (0.00092, 0.0), 2.194e-6),
        "K2": (K2, 0.00365, (-0.0115, 0.0), 4.410e-7),
        "K3": (K3, 0.02373, (0.01874, 0.01043), 5.255e-6),
        "K4": (K4, 0.00706, (0.0, K4 - 0.01421), 5.667e-7),
        "K5": (K5, 0.07050, (0.02308, 0.00916), 1.169e-5),
        "K6": (K6, 0.00706, (K6 - 0.01421, 0.0), 5.667e-7),
        "K7": (K7, 0.05498, (0.01228, 0.00449), 1.912e-5),
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
    return Mechanism(_links(), joints, gravity=(0.0, 0.0, 0.0), driven_joint="beta", forces=(spring,),
                     redundant_reactions="minimum_norm")  # fmt: skip


def simulated() -> Run:
    """From rest under a constant moment."""
    model = discretise(mechanism())
    drive = MomentTable("beta", [0.0, 1.0], [MOMENT, MOMENT])
    start = static_state(model.topology, model.start_coordinates())
    return simulate(model, drive=drive, duration=DURATION, method=Method("rk4", step=STEP), save_every=0.001,
                    start=start)  # fmt: skip


def checked(run: Run) -> list[Line]:
    """The seven angles and the crank's rate at the end."""
    group, known = "Andrews' squeezer", REFERENCE["angle"]
    allowed = SHARE * max(abs(value) for value in known.values())
    lines = [
        absolute(group, f"{joint} at 0.03 s", np.asarray(run.angles[joint])[-1], value, allowed, REFERENCE.label, "rad")
        for joint, value in known.items()
    ]
    rate = REFERENCE["rate"]["beta"]
    last = np.asarray(run.rate)[-1]
    return [
        *lines,
        absolute(group, "rate of beta at 0.03 s", last, rate, SHARE * abs(rate), REFERENCE.label, "rad/s"),
    ]


def validate(full: bool, progress: Progress) -> Outcome:
    """30 ms."""
    del full
    lines = checked(simulated())
    progress(1.0)
    return Outcome(lines)
