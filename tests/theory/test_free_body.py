"""A free body that tumbles without moments, against the closed form of an axisymmetric body, by every method.

Its axis of symmetry moves on a cone about the constant angular momentum L with the rate |L| / J_t, and it spins about
this axis at a constant rate: R(t) = exp(t L / J_t) R(0) exp(t s e_x), s = (1 - J_a / J_t) w_x. Its mass centre moves
on a straight line.
"""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rfem_jax import (
    Coordinates,
    Explicit,
    GeneralisedAlpha,
    GivenSection,
    Joint,
    Leapfrog,
    Link,
    Mechanism,
    PointMass,
    RungeKutta4,
    Simulation,
    State,
    discretise,
    simulate,
)

AXIAL, ACROSS, MASS, CENTRE = 2e-4, 5e-4, 0.4, np.array([0.03, 0.0, 0.0])
START, SPIN, VELOCITY = Rotation.from_euler("xyz", [0.3, -0.4, 1.1]), np.array([9.0, 14.0, -5.0]), [0.2, -0.1, 0.3]
DURATION = 1.0


@pytest.fixture(scope="module")
def tumbling():
    """Function: method -> run of the body let go at the origin, with angular velocity SPIN in its axes."""
    section = GivenSection(1e6, 1e6, 1e6, 1e2, 1e2, 1e2, 1e-9, 1e-15, 1e-15, 1e-15)
    point = PointMass(MASS, tuple(CENTRE), (AXIAL, ACROSS, ACROSS))
    top = Link("top", 0.1, section, rigid=True, point_masses=[point])
    angles = tuple(START.as_euler("xyz"))
    joint = Joint("O", "base", "top", kind="free", start=(0.0, 0.0, 0.0, *angles))
    model = discretise(Mechanism([top], [joint], gravity=(0.0, 0.0, 0.0)))
    omega = START.apply(SPIN)
    # VELOCITY is that of the mass centre.
    of_origin = VELOCITY - np.cross(omega, START.apply(CENTRE))
    none = jnp.zeros((6, 0))
    rates = Coordinates(jnp.asarray(np.concatenate([of_origin, omega])), none)
    start = State(model.start_coordinates(), rates)

    def run(method):
        return simulate(Simulation(model, drive=None, duration=DURATION, method=method, save_every=0.05, start=start))

    return run


def closed_form(times):
    """Rotations, and places of the link's origin (times, 3)."""
    momentum = START.apply(np.array([AXIAL, ACROSS, ACROSS]) * SPIN)
    cone = Rotation.from_rotvec(np.outer(times, momentum / ACROSS))
    about_axis = Rotation.from_rotvec(np.outer(times, [(1.0 - AXIAL / ACROSS) * SPIN[0], 0.0, 0.0]))
    rotation = cone * START * about_axis
    centre = START.apply(CENTRE) + np.outer(times, VELOCITY)
    return rotation, centre - rotation.apply(CENTRE)


def errors(run):
    """Largest errors of the orientation [rad] and of the place [m], and the range of the second angle [rad]."""
    assert int(run.status) == 0
    times = np.asarray(run.times)
    rotation, place = closed_form(times)
    angles = np.asarray(run.motion.angles["O"])
    found = Rotation.from_euler("xyz", angles)
    return (found * rotation.inv()).magnitude().max(), np.abs(run.motion.displacements["O"] - place).max(), angles[:, 1]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "turned", "moved"),
    [
        (RungeKutta4(step=1e-3), 1e-7, 1e-8),
        (Explicit("tsit5", rtol=1e-10, atol=1e-12), 1e-7, 1e-8),
        (Leapfrog(step=1e-4), 1e-4, 1e-5),
        (GeneralisedAlpha(step=2e-4, tolerance=1e-11), 5e-4, 5e-5),
    ],
    ids=lambda value: getattr(value, "name", ""),
)
def test_every_method_follows_the_closed_form(tumbling, method, turned, moved):
    run = tumbling(method)
    angle, place, second = errors(run)
    assert angle < turned and place < moved
    # It passes orientations that no three angles would let it pass.
    assert np.abs(second).max() > 1.2
    assert np.abs(run.loads["O"].force).max() < 1e-9 and np.abs(run.loads["O"].moment).max() < 1e-9


def test_the_implicit_method_has_order_two_on_the_rotations(tumbling):
    coarse, fine = (errors(tumbling(GeneralisedAlpha(step=h, tolerance=1e-11)))[0] for h in (1e-3, 5e-4))
    assert 3.5 < coarse / fine < 4.5
