"""Derivatives of a steady cycle: those of the closed form of a driven oscillator, and differences of cycles."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfem_jax import (
    Joint,
    JointSpring,
    Link,
    Mechanism,
    PrescribedRate,
    RigidBody,
    RungeKutta4,
    Simulation,
    cycle_run,
    deviations,
    discretise,
    steady_cycle,
)
from tests.evaluation import evaluated

MASS, STIFFNESS, DAMPING, RATE, GRAVITY = 0.5, 200.0, 4.0, 9.0, 9.81
NAMES = ("slide.stiffness", "slide.damping", "block.mass", "gravity.z")
POINT = np.array([STIFFNESS, DAMPING, MASS, -GRAVITY])
SETTINGS = {
    "drive": PrescribedRate("A", RATE),
    "method": RungeKutta4(step=2 * np.pi / RATE / 72),
    "save_every": 2 * np.pi / RATE / 24,
}


@pytest.fixture(scope="module")
def model():
    """A block that slides along a turning arm, on a spring."""
    arm, block = (Link(name, 0.2, body=RigidBody(MASS, (0.0, 0.0, 0.0), [1e-3] * 3)) for name in ("arm", "block"))
    joints = [Joint("A", "base", "arm"), Joint("P", "arm", "block", kind="prismatic", position=(0.0, 0.0, 0.0))]
    spring = JointSpring("slide", "P", stiffness=STIFFNESS, damping=DAMPING)
    return discretise(Mechanism([arm, block], joints, driven_joint="A", forces=[spring]))


def mean_square(numbers):
    """Of the place of the block: m s'' + c s' + (k - m w^2) s = m g sin(w t) along the arm."""
    stiffness, damping, mass, gravity = numbers
    dynamic = stiffness - 2.0 * mass * RATE**2
    return 0.5 * (mass * gravity) ** 2 / (dynamic**2 + (damping * RATE) ** 2)


@pytest.mark.long
def test_derivatives_of_a_cycle_are_those_of_a_driven_oscillator(model):
    def place(cycle, numbers):
        away = dict(zip(NAMES, numbers - POINT, strict=True))
        run = cycle_run(cycle, Simulation(model, **SETTINGS), deviations(model, away))
        return jnp.mean(run.motion.displacements["P"][:-1] ** 2)

    cycle = steady_cycle(Simulation(model, **SETTINGS), tolerance=1e-11)
    assert cycle.converged
    point = jnp.asarray(POINT)
    value, forward = evaluated(lambda x: (place(cycle, x), jax.jacfwd(lambda y: place(cycle, y))(x)))(point)
    assert float(value) == pytest.approx(mean_square(POINT), rel=1e-5)
    # Of a simple closed form by complex steps, exact.
    exact = [np.imag(mean_square(POINT + 1e-30j * axis)) / 1e-30 for axis in np.eye(4)]
    np.testing.assert_allclose(forward * POINT, np.array(exact) * POINT, rtol=1e-4)
    backward = evaluated(jax.grad(lambda x: place(cycle, x)))(point)
    np.testing.assert_allclose(backward, forward, rtol=1e-8)

    def of_new_cycle(stiffness):
        errors = deviations(model, {"slide.stiffness": stiffness})
        return np.mean(
            np.asarray(
                steady_cycle(Simulation(model, **SETTINGS), errors, tolerance=1e-12).run.motion.displacements["P"][:-1]
            )
            ** 2
        )

    ends = [of_new_cycle(step) for step in (-2.0, -1.0, 1.0, 2.0)]
    difference = (ends[0] - 8.0 * ends[1] + 8.0 * ends[2] - ends[3]) / 12.0
    assert float(forward[0]) == pytest.approx(difference, rel=1e-6)
