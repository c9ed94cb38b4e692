"""A published experiment: the free swing of a double pendulum, and the parameters that its authors found.

K. Kaheman, U. Fasel, J. J. Bramburger, B. Strom, J. N. Kutz, S. L. Brunton, The Experimental Multi-Arm Pendulum on a
Cart: A Benchmark System for Chaos, Learning, and Control, arXiv:2205.06231 (2022), with measurements and estimates at
github.com/dynamicslab/MultiArm-Pendulum (MIT licence, Copyright (c) 2022 dynamicslab). `measured_double_pendulum.csv`
holds every eighth millisecond of the first 1.2 s of the sixth of their 26 segments, as angles of the hinges A (of the
first arm, 0 where it is level) and B (of the second arm to the first).
"""

from pathlib import Path

import numpy as np
import pytest

from rfem_jax import (
    Joint,
    JointSpring,
    Link,
    Mechanism,
    Normal,
    RigidBody,
    RungeKutta4,
    Sensor,
    Simulation,
    Tolerances,
    discretise,
    identifiability,
    identify,
)

# Their estimates from 26 segments, EstimatedParameters_DoublePendulum.mat, in kg, m, kg m^2, N m s/rad, m/s^2.
MASSES, CENTRES = (0.0938440, 0.1375960), (0.1085652, 0.1167790)
LENGTH, INERTIAS = 0.1727192, (4.375294e-4, 1.2688294e-3)
DAMPINGS, GRAVITY = (2.371428e-4, 1e-5), 9.8085802
# Angles of both arms from above, and their rates, as measured at the start of the segment [rad, rad/s].
START = (3.2132551, 1.9139612, -2.8666588, -0.3547195)
GUESS = {"second.centre.x": 0.125, "first.inertia.y": 6e-4, "second.inertia.y": 1e-3, "k1.damping": 2e-4}
FOUND = {"second.centre.x": CENTRES[1], "first.inertia.y": INERTIAS[0], "second.inertia.y": INERTIAS[1]}


def pendulum():
    """The double pendulum with guesses; masses, length and the first arm's centre, to which free swinging is blind, are
    as theirs."""
    bodies = [
        RigidBody(MASSES[0], (CENTRES[0], 0.0, 0.0), (GUESS["first.inertia.y"],) * 3),
        RigidBody(MASSES[1], (GUESS["second.centre.x"], 0.0, 0.0), (GUESS["second.inertia.y"],) * 3),
    ]
    first, second, rate, other = START
    mechanism = Mechanism(
        [Link("first", LENGTH, rigid=True, body=bodies[0]), Link("second", 0.3, rigid=True, body=bodies[1])],
        [
            Joint("A", "base", "first", angle=first - 0.5 * np.pi, rate=rate),
            Joint("B", "first", "second", angle=second - first, rate=other - rate),
        ],
        forces=[
            JointSpring("k1", "A", 0.0, damping=GUESS["k1.damping"]),
            JointSpring("k2", "B", 0.0, damping=DAMPINGS[1]),
        ],
        gravity=(0.0, 0.0, -GRAVITY),
    )
    method = RungeKutta4(step=2e-3)
    return Simulation(discretise(mechanism), drive=None, duration=1.2, method=method, save_every=4e-3)


@pytest.mark.long
def test_a_double_pendulum_has_the_parameters_that_its_authors_found():
    """From a twentieth of their data, and with zeros of encoders and rates at the start that are not known exactly."""
    unknowns = {
        "second.centre.x": Normal(0.06), "first.inertia.y": Normal(9e-4), "second.inertia.y": Normal(1.5e-3),
        "k1.damping": Normal(6e-4), "A.orientation.y": Normal(0.06), "B.orientation.y": Normal(0.06),
        "A.rate": Normal(0.3), "B.rate": Normal(0.3),
    }  # fmt: skip
    file = Path(__file__).with_name("measured_double_pendulum.csv")
    sensors = {"A_angle_rad": Sensor(offset=0.01), "B_angle_rad": Sensor(offset=0.01)}
    found = identify(pendulum(), file, sensors, Tolerances(unknowns), starts=2, samples=64)
    for name, theirs in FOUND.items():
        assert GUESS[name] + found.errors[name] == pytest.approx(theirs, rel=0.015), name
        before = found.prior_deviation[found.names.index(name)]
        assert abs(GUESS[name] - theirs) > 0.05 * theirs and before > 0.1 * theirs  # it was not known
    assert 0.5 < (GUESS["k1.damping"] + found.errors["k1.damping"]) / DAMPINGS[0] < 1.5
    # The encoders (0.6 mrad a count) are better than a model with viscous friction alone, and it is said.
    assert [one.remainder < size for one, size in zip(found.signals, (5e-4, 3e-3), strict=True)] == [True, True]
    assert all(one.before > 30.0 * one.remainder for one in found.signals)
    assert found.status == "misfit" and all("correlated in time" in one.verdict for one in found.signals)
    assert any("look for an effect that the model lacks" in one for one in found.remarks), found.remarks
    assert not any(one.coarse for one in found.divisions)


@pytest.mark.long
def test_a_swinging_pendulum_is_blind_to_one_combination_of_its_parameters():
    """Theory: without friction its equations have four ratios of A = I_1 + m_1 a_1^2 + m_2 L^2, B = I_2 + m_2 a_2^2,
    C = m_2 a_2 L, (m_1 a_1 + m_2 L) g and m_2 a_2 g, of which the last over C is known: three for four numbers."""
    names = ("first.centre.x", "second.centre.x", "first.inertia.y", "second.inertia.y")
    deviations = np.array([0.02, 0.02, 3e-4, 5e-4])
    tolerances = Tolerances(dict(zip(names, map(Normal, 3.0 * deviations), strict=True)))
    sensors = {"A_angle_rad": Sensor(1e-3), "B_angle_rad": Sensor(1e-3)}
    without = {"k1.damping": -GUESS["k1.damping"], "k2.damping": -DAMPINGS[1]}
    seen = identifiability(pendulum(), sensors, tolerances, at=without, points=1).visibility
    assert (seen.singular[:3] > 10.0).all() and seen.singular[3] < 1e-4 * seen.singular[0]

    def ratios(numbers):
        a1, a2, i1, i2 = numbers
        m1, m2 = MASSES
        c = m2 * a2 * LENGTH
        return np.array([i1 + m1 * a1**2 + m2 * LENGTH**2, i2 + m2 * a2**2, m1 * a1 + m2 * LENGTH]) / c

    at = np.array([CENTRES[0], GUESS["second.centre.x"], GUESS["first.inertia.y"], GUESS["second.inertia.y"]])
    steps = 1e-5 * np.diag(deviations)
    slopes = np.stack([(ratios(at + one) - ratios(at - one)) / 2e-5 for one in steps], axis=1)
    blind = np.linalg.svd(slopes / np.abs(slopes).max(axis=1, keepdims=True))[2][-1]
    assert abs(seen.directions[3] @ blind) == pytest.approx(1.0, abs=1e-5)
