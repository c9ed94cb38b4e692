"""What sensors show: strain gauges by beam theory, filters by closed forms and by scipy, forces of all kinds."""

import jax.numpy as jnp
import numpy as np
import pytest
from scipy import signal as peer

from rfem_jax import (
    FunctionProblem,
    GeneralisedAlpha,
    MomentRamp,
    Normal,
    Sensor,
    Simulation,
    Tolerances,
    assembly_errors,
    discretise,
    identifiability,
    identify,
    simulate,
)
from rfem_jax.tolerancing.identification.predictions import Predictor
from rfem_jax.tolerancing.identification.sensor_filters import filtered
from tests.mechanisms import arm, four_bar

TIMES = np.linspace(0.0, 1.0, 2001)
T, OMEGA = 0.02, 40.0
RESPONSES = {  # of the filters to exp(i w t)
    "low_pass": 1.0 / (1.0 + 1j * OMEGA * T),
    "butterworth": 1.0 / (1.0 + 1j * np.sqrt(2.0) * OMEGA * T - (OMEGA * T) ** 2),
    "high_pass": 1j * OMEGA * T / (1.0 + 1j * OMEGA * T),
    "average": (1.0 - np.exp(-1j * OMEGA * T)) / (1j * OMEGA * T),
}


@pytest.mark.parametrize("kind", RESPONSES)
def test_a_filter_answers_a_sine_with_its_frequency_response(kind):
    found = filtered(TIMES, np.sin(OMEGA * TIMES), Sensor(1.0, filter=kind, filter_time=T))
    expected = np.imag(RESPONSES[kind] * np.exp(1j * OMEGA * TIMES))
    settled = TIMES > 0.6  # e^-21 of the transient is left
    np.testing.assert_allclose(found[settled], expected[settled], atol=5e-5)


def test_a_filter_answers_a_ramp_exactly_and_starts_steady():
    """A ramp is linear between any times, so that uneven, long intervals do no harm; the value before it is 3."""
    times = np.sort(np.random.default_rng(0).uniform(0.0, 0.2, 12))
    t = times - times[0]
    decay = np.exp(-t / T)
    low = t - T * (1.0 - decay)
    early = np.maximum(T - t, 0.0)
    slow = t / np.sqrt(2.0) / T
    expected = {
        "low_pass": 3.0 + low,
        "high_pass": T * (1.0 - decay),
        "average": 3.0 + (0.5 * t**2 - 0.5 * (t - T + early) ** 2) / T,
        "butterworth": 3.0 + t - T * np.sqrt(2.0) * (1.0 - np.exp(-slow) * np.cos(slow)),
    }
    for kind, values in expected.items():
        found = filtered(times, 3.0 + t, Sensor(1.0, filter=kind, filter_time=T))
        np.testing.assert_allclose(found, values, atol=1e-12, err_msg=kind)


SYSTEMS = {
    "low_pass": ([1.0], [T, 1.0]),
    "butterworth": peer.butter(2, 1.0 / T, analog=True),
    "high_pass": ([T, 0.0], [T, 1.0]),
}


@pytest.mark.parametrize("kind, system", SYSTEMS.items())
def test_filters_are_those_of_scipy(kind, system):
    u = np.random.default_rng(1).normal(size=(400, 2)).cumsum(axis=0)
    u -= u[0]
    found = filtered(TIMES[:400], u, Sensor(1.0, filter=kind, filter_time=T))
    for mine, given in zip(found.T, u.T, strict=True):
        np.testing.assert_allclose(mine, peer.lsim(system, given, TIMES[:400])[1], atol=1e-9 * np.abs(u).max())


def test_a_sensor_without_a_filter_and_wrong_ones(refused):
    values = np.sin(OMEGA * TIMES[::20])
    np.testing.assert_array_equal(filtered(TIMES[::20], values, Sensor(1.0)), values)
    with refused("`filter`", "'comb'"):
        Sensor(1.0, filter="comb", filter_time=1.0)
    for wrong in ({"filter": "low_pass"}, {"filter_time": "1 ms"}):
        with refused("`filter_time`", "both, or none"):
            Sensor(1.0, **wrong)


def shaken(errors):
    """A shift that jerks: fast beside the filters."""
    t = jnp.asarray(TIMES[::2])
    return {"P_acceleration_x_m_s2": errors["D.d_y"] / 2e-4 * jnp.sin(60.0 * t) + errors["D.delta_x"] / 3e-3 * t}


@pytest.mark.parametrize("kind", RESPONSES)
def test_errors_are_found_behind_filters(kind):
    """What another program has filtered, finely, is explained with the filter, and not without it."""
    truth, column = {"D.d_y": 3e-4, "D.delta_x": -4e-3}, "P_acceleration_x_m_s2"
    u = 1.5 * np.sin(60.0 * TIMES) - 4.0 / 3.0 * TIMES
    if kind == "average":
        past = np.concatenate([np.zeros(40), u])  # 40 intervals of 0.5 ms are T
        shown = np.array([np.trapezoid(past[k : k + 41], dx=5e-4) / T for k in range(len(u))])
    else:
        shown = peer.lsim(SYSTEMS[kind], u, TIMES)[1]
    problem = FunctionProblem(shaken, tuple(truth), (column,), error_units={"D.d_y": "m"})
    tolerances = Tolerances({"D.d_y": Normal(6e-4), "D.delta_x": Normal(9e-3)})
    data = {"time_s": TIMES[7::10], column: shown[7::10] + 0.02 * np.random.default_rng(0).normal(size=len(u[7::10]))}
    settings = {"times": TIMES[::2], "starts": 2, "samples": 64}
    found = identify(problem, data, {column: Sensor(0.02, filter=kind, filter_time=T)}, tolerances, **settings)
    assert found.status == "ok", str(found)
    assert (np.abs(found.estimate - list(truth.values())) < 4.0 * found.deviation).all()
    assert identify(problem, data, {column: Sensor(0.02)}, tolerances, **settings).status == "misfit"
    told = identifiability(problem, {column: Sensor(0.02, filter=kind, filter_time=T)}, tolerances, times=TIMES[::2])
    none = dict.fromkeys(truth, 0.0)  # signals are linear in errors: of one deviation they are slopes
    whole = [np.asarray(shaken(none | one)[column]) for one in ({"D.d_y": 2e-4}, {"D.delta_x": 3e-3})]
    slopes = [filtered(TIMES[::2], one, Sensor(1.0, filter=kind, filter_time=T)) for one in whole]
    expected = np.linalg.svd(np.stack(slopes, axis=1) / 0.02, compute_uv=False)
    np.testing.assert_allclose(told.visibility.singular, expected, rtol=1e-6)


LENGTH, SIDE, DENSITY, MODULUS = 0.3, 0.01, 7850.0, 210e9
GAUGES = ("arm@0.25_strain_z_m_m", "arm@0.25_strain_-z_m_m", "arm@0.25_stress_z_Pa", "arm@0.25_strain_y_m_m")
PULL = 0.8  # N m


@pytest.fixture(scope="module")
def swinging():
    model = discretise(arm())
    return Simulation(
        model, drive=MomentRamp("A", PULL, 0.05), duration=0.1, method=GeneralisedAlpha(step=1e-3), save_every=5e-3
    )


@pytest.mark.long
def test_a_strain_gauge_feels_what_beam_theory_says(swinging):
    """A turning bar: its inertia and weight beyond the gauge bend and pull it."""
    predictor = Predictor(swinging, GAUGES, ("steel.youngs_modulus",), {})
    found = predictor.at(np.array([[0.0], [0.0]]), derivatives=True)
    run = simulate(swinging)
    angle, rate = (np.asarray(one) for one in (run.motion.angle, run.motion.rate))
    line, x, rotary = DENSITY * SIDE**2, 0.25 * LENGTH, SIDE**2 / 12.0
    moment = np.asarray(run.motion.drives["A"].force)
    # A turn about y takes x to -z: weight across the bar is -g cos(angle) along its z, along the bar g sin(angle).
    turns = (moment + line * 9.81 * np.cos(angle) * LENGTH**2 / 2.0) / (line * (LENGTH**3 / 3.0 + rotary * LENGTH))
    arm_of = LENGTH**3 / 3.0 - x * LENGTH**2 / 2.0 + x**3 / 6.0 + rotary * (LENGTH - x)
    # d'Alembert's forces along z, that tension at +z needs to be down: inertia turns * s, weight -g cos.
    hogging = -line * (turns * arm_of - 9.81 * np.cos(angle) * (LENGTH - x) ** 2 / 2.0)
    pull = line * (rate**2 * (LENGTH**2 - x**2) / 2.0 + 9.81 * np.sin(angle) * (LENGTH - x))
    axial, bending = pull / (MODULUS * SIDE**2), hogging * 0.5 * SIDE / (MODULUS * SIDE**4 / 12.0)
    scale = np.abs(bending).max()
    np.testing.assert_allclose(found.values[0, 0], axial + bending, atol=1e-6 * scale)
    np.testing.assert_allclose(found.values[0, 1], axial - bending, atol=1e-6 * scale)
    np.testing.assert_allclose(found.values[0, 2], MODULUS * (axial + bending), atol=1e-6 * scale * MODULUS)
    np.testing.assert_allclose(found.values[0, 3], axial, atol=1e-6 * scale)
    # The strain of a rigid bar is inversely proportional to its modulus, its stress does not depend on it.
    slopes = found.derivatives[0, :, :, 0]
    np.testing.assert_allclose(slopes[:2], -found.values[0, :2] / MODULUS, atol=1e-8 * scale / MODULUS)
    assert np.abs(slopes[2]).max() < 1e-9 * scale


@pytest.mark.slow
def test_gauges_on_both_sides_of_an_elastic_element_agree():
    """On its left loads follow from equilibrium up to the end of the link, on its right from the element."""
    model = discretise(four_bar(rfes=3))
    simulation = Simulation(
        model, drive=MomentRamp("A", 1.0, 0.05), duration=0.02, method=GeneralisedAlpha(step=2e-3), save_every=4e-3
    )
    names = [f"coupler@{place}.sections" for place in (0.2499999, 0.25, 0.5, 0.75)]
    run = simulate(simulation, assembly_errors(model, {"D.delta_x": "0.5 deg"}), record=names)
    left, right, middle, last = (np.asarray(run.recorded[name].resultants[:, :, 0]) for name in names)
    scale = np.abs(left).max(axis=0)
    assert (np.abs(left - right).max(axis=0) < 1e-2 * np.repeat([scale[:3].max(), scale[3:].max()], 3)).all()
    assert (np.abs(right[:, 5] - last[:, 5]) > 0.1 * scale[5]).any()
    np.testing.assert_allclose(middle[:, 5], 0.5 * (right + last)[:, 5], atol=1e-3 * scale[5])
