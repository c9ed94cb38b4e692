"""The independent values of the validation against closed forms."""

import numpy as np
import pytest

from rfem_jax.validation import bennett_loop
from rfem_jax.validation.reference_values import read_reference
from rfem_jax.validation.rigid_body_theory import FreeBody, HeavyTop
from rfem_jax.validation.rigid_links import angles_of, turn_x, turn_y, turn_z
from rfem_jax.validation.rod_theory import tip_displacement
from rfem_jax.validation.rotating_beam_theory import tip_lag

LENGTH, STIFFNESSES = 0.7, (3e5, 2e4, 1e4, 40.0, 50.0, 80.0)


def test_rod_under_small_loads_is_a_beam():
    ea, ga_y, ga_z, _, ei_y, ei_z = STIFFNESSES
    tip = tip_displacement(LENGTH, STIFFNESSES, [2e-4, 1e-4, 3e-4])
    expected = [
        2e-4 * LENGTH / ea,
        1e-4 * (LENGTH**3 / (3.0 * ei_z) + LENGTH / ga_y),
        3e-4 * (LENGTH**3 / (3.0 * ei_y) + LENGTH / ga_z),
    ]
    np.testing.assert_allclose(tip, expected, rtol=1e-4, atol=1e-12)


def test_rod_is_the_elastica():
    """P L^2 / E I = 3 in the plane x, y, the other plane stiffer."""
    bending = 80.0
    tip = tip_displacement(1.0, (1e9, 1e9, 1e9, 1e3, 1e3, bending), [0.0, 3.0 * bending, 0.0])
    elastica = read_reference("elastica")
    at = elastica["load"].index(3.0)
    expected = [-elastica["shortening"][at], elastica["deflection"][at], 0.0]
    np.testing.assert_allclose(tip, expected, atol=2e-5)


def test_stiff_beam_lags_by_its_static_deflection():
    """Load -rho A x Omega' at constant Omega': tip deflection 11 rho A Omega' L^5 / (120 E I)."""
    length, bending, density, rise = 2.0, 1e4, 0.5, 0.3

    def rate(t):
        # Reached so slowly that no vibration is excited.
        grown = min(t, 1.0)
        return 0.0, rise * grown**2 * (3.0 - 2.0 * grown)

    lag = tip_lag(length, bending, density, rate, np.array([0.5, 2.0]))
    static = 11.0 * density * rise * length**5 / (120.0 * bending)
    np.testing.assert_allclose(lag, [0.5 * static, static], rtol=2e-3)


def test_rotation_stiffens():
    """With centrifugal force the lag under the same angular acceleration is smaller."""

    def lag(omega):
        rate = lambda t: (omega, 0.1 * min(t / 20.0, 1.0))  # noqa: E731
        return tip_lag(10.0, 1.4e4, 1.2, rate, np.array([40.0]))[0]

    # First frequency: omega_1^2 = 3.516^2 E I / (rho A L^4) + 0.193 omega^2 (Southwell).
    at_rest = 3.5160**2 * 1.4e4 / (1.2 * 1e4)
    assert lag(6.0) / lag(0.0) == pytest.approx(at_rest / (at_rest + 0.193 * 36.0), rel=0.05)


def angular_velocity(rotations, step):
    """In the body's axes at the middle of five rotations."""
    derivative = (8.0 * (rotations[3] - rotations[1]) - (rotations[4] - rotations[0])) / (12.0 * step)
    spin = rotations[2].T @ derivative
    return np.array([spin[2, 1], spin[0, 2], spin[1, 0]])


def test_rotations_of_a_free_body_belong_to_its_angular_velocity():
    body, start, step = FreeBody((1.0, 2.0, 3.5), (2.0, 3.0)), turn_z(0.3) @ turn_x(1.2), 1e-3
    momentum = start @ (np.array(body.inertia) * body.angular_velocity(0.0))
    for t in (0.4, 1.7):
        rotations = body.rotations(start, t + step * np.arange(-2, 3))
        np.testing.assert_allclose(angular_velocity(rotations, step), body.angular_velocity(t), atol=1e-9)
        np.testing.assert_allclose(rotations[2] @ (body.inertia * body.angular_velocity(t)), momentum, atol=1e-11)
    np.testing.assert_allclose(body.rotations(start, np.array([0.0]))[0], start, atol=1e-14)


def test_a_nutating_top_keeps_its_energy_and_its_momenta():
    top, tilt, spin, step = HeavyTop(2e-3, 3e-3, 0.4), 0.3, 8.0, 1e-4
    inertia = np.array([top.axial, top.across, top.across])
    start = HeavyTop.axes(0.0, tilt, 0.0) @ np.array([top.axial * spin, 0.0, 0.0])
    for t in (0.1, 0.4):
        rotations, tilts = top.nutation(tilt, spin, t + step * np.arange(-2, 3))
        assert tilts[2] > tilt + 0.1
        w = angular_velocity(rotations, step)
        fallen = top.weight_moment * (np.cos(tilt) - np.cos(tilts[2]))
        assert 0.5 * inertia @ w**2 == pytest.approx(0.5 * top.axial * spin**2 + fallen, rel=1e-8)
        assert (rotations[2] @ (inertia * w))[2] == pytest.approx(start[2], rel=1e-8)
        assert w[0] == pytest.approx(spin, rel=1e-8)
        assert rotations[2][2, 0] == pytest.approx(np.cos(tilts[2]), abs=1e-14)


def test_steady_precession_is_where_the_tilt_stays():
    """dL/dt is the moment of the weight, which lies across the tilt."""
    top, tilt, precession = HeavyTop(2e-3, 3e-3, 0.4), 0.9, 5.0
    spin = top.steady_spin(tilt, precession)
    across = top.across * precession * np.sin(tilt)
    horizontal = top.axial * spin * np.sin(tilt) - across * np.cos(tilt)
    assert precession * horizontal == pytest.approx(top.weight_moment * np.sin(tilt))


def test_bennett_linkage_closes():
    crank = 0.7
    second = float(bennett_loop.follower(crank))
    place = np.eye(4)
    for angle, length, twist in (
        (crank, bennett_loop.A, bennett_loop.ALPHA), (second, bennett_loop.B, bennett_loop.BETA),
        (-crank, bennett_loop.A, bennett_loop.ALPHA), (-second, bennett_loop.B, bennett_loop.BETA),
    ):  # fmt: skip
        step = np.eye(4)
        step[:3, :3] = turn_y(angle) @ turn_x(twist)
        step[:3, 3] = turn_y(angle) @ [length, 0.0, 0.0]
        place = place @ step
    np.testing.assert_allclose(place, np.eye(4), atol=1e-14)


@pytest.mark.parametrize("angles", [(0.3, -0.4, 1.1), (2.0, 1.5, -3.0), (0.0, np.pi / 2, 0.4), (0.0, -np.pi / 2, 2.0)])
def test_angles_of_axes(angles):
    x, y, z = angles
    axes = turn_z(z) @ turn_y(y) @ turn_x(x)
    x, y, z = angles_of(axes)
    np.testing.assert_allclose(turn_z(z) @ turn_y(y) @ turn_x(x), axes, atol=1e-8)
