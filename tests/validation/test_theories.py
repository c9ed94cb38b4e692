"""The independent values of the validation against closed forms."""

import numpy as np
import pytest

from rfem_jax.validation.reference_values import read_reference
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
