"""Pendulums of rigid links let go from a given state: exact motion and exact joint loads.

The single pendulum's motion is known in elliptic functions; the double pendulum is integrated by
SciPy from Lagrange's equations (planar) and from Newton-Euler equations (spatial) of this file.
"""

from types import SimpleNamespace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.special import ellipj, ellipkinc

from rfem_jax import (
    Coordinates,
    GivenSection,
    Joint,
    Link,
    Mechanism,
    PointMass,
    RungeKutta4,
    Simulation,
    State,
    assembly_errors,
    discretise,
    simulate,
)

DENSITY, ROTARY = 0.8, (3e-4, 1e-4, 2e-4)  # kg/m, kg m
GRAVITY = np.array([0.0, 0.0, -9.81])


def rotation(x=0.0, y=0.0, z=0.0):
    """R_z R_y R_x."""
    (cx, cy, cz), (sx, sy, sz) = np.cos([x, y, z]), np.sin([x, y, z])
    about_x = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    about_y = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    about_z = np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])
    return about_z @ about_y @ about_x


def rigid_section():
    return GivenSection(1e7, 1e6, 1e6, 1e3, 1e3, 1e3, DENSITY, *ROTARY)


def rigid_body(length, point_masses=()):
    """Mass, centre of mass and inertia about the link's origin, link axes."""
    mass, first = DENSITY * length, np.array([DENSITY * length**2 / 2.0, 0.0, 0.0])
    inertia = np.diag([0.0, 1.0, 1.0]) * DENSITY * length**3 / 3.0 + np.diag(ROTARY) * length
    for point in point_masses:
        r = np.array(point.position)
        mass, first = mass + point.mass, first + point.mass * r
        inertia = inertia + point.mass * (r @ r * np.eye(3) - np.outer(r, r))
        inertia = inertia + np.diag(point.inertia)
    return SimpleNamespace(mass=mass, centre=first / mass, inertia=inertia)


def start_state(angles, rates):
    none = jnp.zeros((6, 0))
    return State(Coordinates(jnp.asarray(angles), none), Coordinates(jnp.asarray(rates), none))


def stacked(items):
    return jax.tree.map(lambda *leaves: jnp.stack(leaves), *items)


# A single pendulum with a tilted hinge and masses off its plane.
TILT, YAW = 0.6, 0.35
MASSES = (
    PointMass(0.5, (0.35, 0.04, -0.06), (2e-4, 3e-4, 4e-4)),
    PointMass(0.2, (0.1, -0.02, 0.03)),
)
SINGLE_STARTS = [(2.5, 0.0), (-0.4, 3.0), (0.3, 60.0)]  # from the lowest position; rad, rad/s


@pytest.fixture(scope="module")
def single():
    """Runs from all starts, and the exact motion and reactions at the saved times."""
    link = Link("bob", 0.4, rigid_section(), rigid=True, point_masses=MASSES)
    hinge = Joint("A", "base", "bob", position=(0.2, 0.1, -0.3), orientation=(TILT, 0.0, YAW))
    model = discretise(Mechanism([link], [hinge]))
    body = rigid_body(0.4, MASSES)
    gravity = rotation(TILT, 0.0, YAW).T @ GRAVITY
    radius, pull = np.hypot(*body.centre[[0, 2]]), np.hypot(*gravity[[0, 2]])
    lowest = np.arctan2(-gravity[2], gravity[0]) - np.arctan2(-body.centre[2], body.centre[0])
    slow = np.sqrt(body.mass * radius * pull / body.inertia[1, 1])  # small-swing frequency

    def simulated(start):
        return simulate(
            Simulation(model, drive=None, duration=0.6, method=RungeKutta4(step=1e-4), save_every=0.02, start=start)
        )

    starts = stacked([start_state([lowest + a], [r]) for a, r in SINGLE_STARTS])
    runs = eqx.filter_jit(eqx.filter_vmap(simulated))(starts)
    exact = [exact_pendulum(body, gravity, lowest, slow, *start, np.asarray(runs.times[0])) for start in SINGLE_STARTS]
    return jax.tree.map(np.asarray, runs), exact


def exact_pendulum(body, gravity, lowest, slow, angle, rate, times):
    """Swing: sin(theta/2) = k sn(w t + u0, k); whirl: theta = 2 am(k w t + u0, 1/k)."""
    k = np.hypot(np.sin(angle / 2.0), rate / (2.0 * slow))
    if k < 1.0:
        u = slow * times + ellipkinc(np.arcsin(np.sin(angle / 2.0) / k), k**2)
        sn, cn, _, _ = ellipj(u, k**2)
        theta, rates = 2.0 * np.arcsin(k * sn), 2.0 * k * slow * cn
    else:
        u = k * slow * times + ellipkinc(angle / 2.0, 1.0 / k**2)
        _, _, dn, amplitude = ellipj(u, 1.0 / k**2)
        theta, rates = 2.0 * amplitude, 2.0 * k * slow * dn
    forces, moments = [], []
    for a, r in zip(theta, rates):
        g = rotation(y=lowest + a).T @ gravity
        spin, turn = np.array([0.0, r, 0.0]), np.array([0.0, -(slow**2) * np.sin(a), 0.0])
        c = body.centre
        forces.append(body.mass * (np.cross(turn, c) + np.cross(spin, np.cross(spin, c)) - g))
        rate_of_momentum = body.inertia @ turn + np.cross(spin, body.inertia @ spin)
        moments.append(rate_of_momentum - np.cross(c, body.mass * g))
    return lowest + theta, np.array(forces), np.array(moments)


@pytest.mark.slow
@pytest.mark.parametrize("case", range(len(SINGLE_STARTS)), ids=["wide", "swing", "whirl"])
def test_single_pendulum_moves_by_elliptic_functions(single, case):
    runs, exact = single
    angle = exact[case][0]
    assert runs.status[case] == 0
    np.testing.assert_allclose(runs.motion.angles["A"][case], angle, atol=1e-9)
    assert np.ptp(angle) > 0.5


@pytest.mark.parametrize("case", range(len(SINGLE_STARTS)), ids=["wide", "swing", "whirl"])
def test_single_pendulum_has_the_exact_pivot_reaction(single, case):
    runs, exact = single
    _, force, moment = exact[case]
    loads = runs.loads["A"]
    np.testing.assert_allclose(loads.force[case], force, atol=1e-8 * np.abs(force).max())
    np.testing.assert_allclose(loads.moment[case], moment, atol=1e-8 * np.abs(moment).max())
    assert np.abs(loads.moment[case][:, 1]).max() < 1e-12 * np.abs(moment).max()
    # All other components are there to be seen.
    assert np.abs(force).max(axis=0).min() > 1.0
    assert np.abs(moment[:, [0, 2]]).max(axis=0).min() > 0.1


def test_single_pendulum_keeps_its_energy_and_maxima(single):
    runs, exact = single
    assert runs.checks.energy_balance_error.max() < 1e-9
    for case, (_, force, _) in enumerate(exact):
        np.testing.assert_allclose(
            runs.metrics.max_axial_force["A"][case], np.abs(force[:, 1]).max(), rtol=1e-9
        )  # constant: the component of weight along the hinge
        normal = np.hypot(force[:, 0], force[:, 2])
        assert runs.metrics.max_normal_force["A"][case] >= normal.max() * (1.0 - 1e-9)


# A double pendulum; the second hinge sits between the ends of the first link.
LENGTH_1, LENGTH_2, WHERE = 0.5, 0.3, 0.4
ANGLES, RATES = (0.2, 0.9), (4.0, -25.0)
TWIST, STRETCH = 0.5, 0.06


def double_model(orientation=(0.0, 0.0, 0.0), at_end=False):
    links = [
        Link("upper", LENGTH_1, rigid_section(), rigid=True),
        Link("lower", LENGTH_2, rigid_section(), rigid=True),
    ]
    where = LENGTH_1 if at_end else WHERE
    joints = [
        Joint("A", "base", "upper"),
        Joint("B", "upper", "lower", position=(where, 0.0, 0.0), orientation=orientation),
    ]
    return discretise(Mechanism(links, joints, gravity=GRAVITY))


DOUBLE_CASES = {  # orientation of B, errors
    "planar": ((0.0, 0.0, 0.0), {}),
    "spatial": ((0.5, 0.3, -0.8), {}),
    "longer": ((0.0, 0.0, 0.0), {"upper.length": STRETCH}),
    "seat": ((0.0, 0.0, 0.0), {"B.delta_x": 0.4, "B.delta_z": -0.3, "B.d_y": 0.05, "B.d_z": 0.02}),
    "bore": (
        (0.0, 0.0, 0.0),
        {"B.child.delta_x": 0.4, "B.child.delta_z": -0.3, "B.child.d_x": 0.03, "B.child.d_y": 0.05},
    ),
}


@pytest.fixture(scope="module")
def double():
    models = [double_model(orientation) for orientation, _ in DOUBLE_CASES.values()]
    errors = [assembly_errors(models[0], errors) for _, errors in DOUBLE_CASES.values()]

    def simulated(model, errors):
        return simulate(
            Simulation(
                model,
                drive=None,
                duration=0.4,
                method=RungeKutta4(step=1e-4),
                save_every=0.02,
                start=start_state(ANGLES, RATES),
            ),
            errors,
        )

    runs = eqx.filter_jit(eqx.filter_vmap(simulated))(stacked(models), stacked(errors))
    names = list(DOUBLE_CASES)
    return lambda name: jax.tree.map(lambda x: np.asarray(x)[names.index(name)], runs)


def lagrange(length_1, distance):
    """(times, start) -> absolute angles and rates (4, times) of the planar double pendulum, and its
    accelerations as a function of these."""
    m1, m2 = DENSITY * length_1, DENSITY * LENGTH_2
    a11 = m1 * length_1**2 / 3.0 + ROTARY[1] * length_1 + m2 * distance**2
    a22 = m2 * LENGTH_2**2 / 3.0 + ROTARY[1] * LENGTH_2
    k = m2 * distance * LENGTH_2 / 2.0

    def accelerations(y):
        a, b, va, vb = y
        g = -GRAVITY[2]
        matrix = np.array([[a11, k * np.cos(a - b)], [k * np.cos(a - b), a22]])
        right = np.array(
            [
                (m1 * length_1 / 2.0 + m2 * distance) * g * np.cos(a) - k * np.sin(a - b) * vb**2,
                m2 * LENGTH_2 / 2.0 * g * np.cos(b) + k * np.sin(a - b) * va**2,
            ]
        )
        return np.linalg.solve(matrix, right)

    def motion(times):
        start = [ANGLES[0], sum(ANGLES), RATES[0], sum(RATES)]
        return solve_ivp(
            lambda t, y: np.concatenate([y[2:], accelerations(y)]),
            (0.0, times[-1]),
            start,
            method="DOP853",
            t_eval=times,
            rtol=1e-12,
            atol=1e-12,
        ).y

    return motion, accelerations


@pytest.mark.long
@pytest.mark.parametrize("name, length_1", [("planar", LENGTH_1), ("longer", LENGTH_1 + STRETCH)])
def test_planar_double_pendulum_by_lagrange(double, name, length_1):
    run = double(name)
    distance = WHERE * length_1 / LENGTH_1
    motion, accelerations = lagrange(length_1, distance)
    y = motion(run.times)
    np.testing.assert_allclose(run.motion.angles["A"], y[0], atol=1e-8)
    np.testing.assert_allclose(run.motion.angles["B"], y[1] - y[0], atol=1e-8)

    def radial(angle):
        return np.array([np.cos(angle), 0.0, -np.sin(angle)])

    def tangential(angle):
        return np.array([-np.sin(angle), 0.0, -np.cos(angle)])

    for i, (a, b, va, vb) in enumerate(y.T):
        wa, wb = accelerations(y[:, i])
        upper = length_1 / 2.0 * (wa * tangential(a) - va**2 * radial(a))
        hinge = distance * (wa * tangential(a) - va**2 * radial(a))
        lower = hinge + LENGTH_2 / 2.0 * (wb * tangential(b) - vb**2 * radial(b))
        on_lower = DENSITY * LENGTH_2 * (lower - GRAVITY)
        on_upper = DENSITY * length_1 * (upper - GRAVITY) + on_lower
        scale = 1e-7 * np.abs(on_upper).max()
        np.testing.assert_allclose(run.loads["B"].force[i], rotation(y=b).T @ on_lower, atol=scale)
        np.testing.assert_allclose(run.loads["A"].force[i], rotation(y=a).T @ on_upper, atol=scale)


def tilt(x, z):
    """Theory (2.3): R_z R_x."""
    return rotation(x, 0.0, z)


def chain_loads(seat, bore, q, qd, qdd):
    """Newton-Euler of the two links at given accelerations; (force, moment) of A and B in their
    hinge frames. seat, bore: rotation and position of hinge B in the upper and the lower link."""
    bodies = rigid_body(LENGTH_1), rigid_body(LENGTH_2)
    turn_1 = rotation(y=q[0])
    hinge_2 = turn_1 @ seat[0] @ rotation(y=q[1])
    turn_2 = hinge_2 @ bore[0].T
    axis_1, axis_2 = turn_1[:, 1], hinge_2[:, 1]
    spin_1, rate_1 = axis_1 * qd[0], axis_1 * qdd[0]
    spin_2 = spin_1 + axis_2 * qd[1]
    rate_2 = rate_1 + axis_2 * qdd[1] + np.cross(spin_1, axis_2 * qd[1])
    arm = turn_1 @ seat[1]
    of_hinge = np.cross(rate_1, arm) + np.cross(spin_1, np.cross(spin_1, arm))
    to_origin = -turn_2 @ bore[1]
    of_origin = of_hinge + np.cross(rate_2, to_origin)
    of_origin = of_origin + np.cross(spin_2, np.cross(spin_2, to_origin))

    def required(body, turn, spin, rate, origin_acceleration):
        """Force, and moment about the link's origin."""
        c = turn @ body.centre
        inertia = turn @ body.inertia @ turn.T
        a = origin_acceleration + np.cross(rate, c) + np.cross(spin, np.cross(spin, c))
        moment = inertia @ rate + np.cross(spin, inertia @ spin)
        return (
            body.mass * (a - GRAVITY),
            moment + body.mass * np.cross(c, origin_acceleration - GRAVITY),
        )

    force_2, moment_2 = required(bodies[1], turn_2, spin_2, rate_2, of_origin)
    moment_2 = moment_2 + np.cross(to_origin, force_2)
    force_1, moment_1 = required(bodies[0], turn_1, spin_1, rate_1, np.zeros(3))
    moment_1 = moment_1 + moment_2 + np.cross(arm, force_2)
    force_1 = force_1 + force_2
    return {
        "A": (turn_1.T @ force_1, turn_1.T @ moment_1),
        "B": (hinge_2.T @ force_2, hinge_2.T @ moment_2),
    }


def chain_accelerations(seat, bore, y):
    def hinge_moments(qdd):
        loads = chain_loads(seat, bore, y[:2], y[2:], qdd)
        return np.array([loads["A"][1][1], loads["B"][1][1]])

    bias = hinge_moments(np.zeros(2))
    matrix = np.stack([hinge_moments(unit) - bias for unit in np.eye(2)], axis=1)
    return -np.linalg.solve(matrix, bias)


NOMINAL = (np.eye(3), np.array([WHERE, 0.0, 0.0])), (np.eye(3), np.zeros(3))
SPATIAL_CASES = {
    "planar": NOMINAL,
    "spatial": ((rotation(0.5, 0.3, -0.8), NOMINAL[0][1]), NOMINAL[1]),
    "seat": ((tilt(0.4, -0.3), np.array([WHERE, 0.05, 0.02])), NOMINAL[1]),
    "bore": (NOMINAL[0], (tilt(0.4, -0.3), np.array([0.03, 0.05, 0.0]))),
}


@pytest.mark.long
@pytest.mark.parametrize("name", SPATIAL_CASES)
def test_spatial_double_pendulum_by_newton_euler(double, name):
    run, (seat, bore) = double(name), SPATIAL_CASES[name]
    y = solve_ivp(
        lambda t, y: np.concatenate([y[2:], chain_accelerations(seat, bore, y)]),
        (0.0, run.times[-1]),
        [*ANGLES, *RATES],
        method="DOP853",
        t_eval=run.times,
        rtol=1e-10,
        atol=1e-10,
    ).y
    np.testing.assert_allclose(run.motion.angles["A"], y[0], atol=1e-7)
    np.testing.assert_allclose(run.motion.angles["B"], y[1], atol=1e-7)
    for i, state in enumerate(y.T):
        expected = chain_loads(seat, bore, state[:2], state[2:], chain_accelerations(seat, bore, state))
        for joint, (force, moment) in expected.items():
            np.testing.assert_allclose(run.loads[joint].force[i], force, atol=2e-5)
            np.testing.assert_allclose(run.loads[joint].moment[i], moment, atol=1e-5)
    largest = np.abs(run.loads["A"].force).max()
    assert largest > 20.0  # so the tolerances above are 1e-6 of it at most
    assert run.checks.momentum_balance_error < 1e-12 and run.checks.energy_balance_error < 1e-8


def test_twist_of_a_link_turns_the_frame_at_its_end_and_nothing_else():
    """A hinge at the end of a twisted link is a hinge whose seat is turned about x; one between the
    ends does not notice."""
    models = [double_model(at_end=True)] * 2 + [double_model((TWIST, 0.0, 0.0), at_end=True)]
    models += [double_model()] * 2
    errors = [{"upper.twist": TWIST}, {}, {}, {"upper.twist": TWIST}, {}]
    loads = []
    for model, error in zip(models, errors):
        run = simulate(
            Simulation(
                model,
                drive=None,
                duration=0.02,
                method=RungeKutta4(step=1e-3),
                save_every=0.01,
                start=start_state(ANGLES, RATES),
            ),
            assembly_errors(model, error),
        )
        loads.append(np.concatenate([*run.loads["A"], *run.loads["B"]], axis=1))
    twisted, straight, turned, middle_twisted, middle = loads
    np.testing.assert_allclose(twisted, turned, atol=1e-10)
    assert np.abs(twisted - straight).max() > 1.0
    np.testing.assert_allclose(middle_twisted, middle, atol=1e-10)
