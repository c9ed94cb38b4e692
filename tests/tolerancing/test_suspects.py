"""What is behind a misfit: unmodelled errors are named, strange ones are not; the score is what adding them yields."""

import jax.numpy as jnp
import numpy as np
import pytest

from rfem_jax import FunctionProblem, Normal, Sensor, Tolerances, identify

TIMES = np.linspace(0.0, 1.0, 101)
SIZE = {"D.delta_x": 3e-3, "D.delta_z": 3e-3, "D.d_y": 2e-4, "A.d_x": 2e-4, "B.d_z": 2e-4}
UNKNOWN = ("D.delta_x", "D.d_y")
TOLERANCES = Tolerances({name: Normal(3.0 * SIZE[name]) for name in UNKNOWN})
NOISE = {"rate_rad_s": 0.02, "A_force_x_N": 0.3}
SENSORS = {name: Sensor(noise) for name, noise in NOISE.items()}


def machine(errors):
    t = jnp.asarray(TIMES)
    a, b, c, d, e = (errors[name] / size for name, size in SIZE.items())
    rate = 0.2 * a * jnp.sin(5.0 * t) + 0.1 * b * jnp.exp(-3.0 * t) + 0.06 * d * jnp.cos(14.0 * t) + 0.02 * e * t
    force = 5.0 + 2.0 * t + 3.0 * c * t + b * jnp.cos(9.0 * t) + 0.5 * d * t**2 + 0.1 * b * c + e * jnp.sin(20.0 * t)
    return {"rate_rad_s": rate, "A_force_x_N": force}


PROBLEM = FunctionProblem(machine, tuple(SIZE), tuple(NOISE), error_units={n: "m" for n in SIZE if ".d_" in n})
USUAL = {"D.delta_x": 2e-3, "D.d_y": -1e-4}


def solve(truth, *, disturb=lambda t: 0.0, sensors=SENSORS, shift=0.0, **more):
    rng, values = np.random.default_rng(3), PROBLEM(truth)[0]
    data = {}
    for column, sigma in NOISE.items():
        t = np.sort(rng.uniform(0.05, 0.95, 150))
        curve = np.interp(t - shift, TIMES, np.asarray(values[column]))
        data[column] = t, curve + disturb(t) * sigma + sigma * rng.normal(size=150)
    settings = {"starts": 2, "samples": 32, "times": TIMES} | more
    return identify(PROBLEM, data, sensors, TOLERANCES, **settings)


@pytest.mark.long
@pytest.mark.parametrize("hidden", ["D.delta_z", "A.d_x", "B.d_z"])
@pytest.mark.parametrize("sensors", [SENSORS, list(NOISE)])
@pytest.mark.parametrize("loss", ["gaussian", "huber"])
def test_an_error_that_is_no_unknown_is_named(hidden, sensors, loss):
    truth = USUAL | {hidden: 1.5 * SIZE[hidden]}
    found = solve(truth, sensors=sensors, loss=loss)
    assert found.status == "misfit"
    best = found.suspects[0]
    assert best.name == hidden and best.named and best.fits, found.suspects
    if loss == "gaussian" and sensors is SENSORS:
        assert abs(best.value - truth[hidden]) < 4.0 * best.deviation
    assert f"{hidden}, which is no unknown, explains" in str(found)
    assert found.remarks[0].startswith(hidden)


def test_the_fall_is_what_another_unknown_yields():
    """The same machine with the suspect as an unknown of which nearly nothing is known before."""
    truth = USUAL | {"B.d_z": 1e-4}
    found = solve(truth)
    wide = Tolerances({name: Normal(3.0 * SIZE[name]) for name in UNKNOWN} | {"B.d_z": Normal(3.0)})
    rng, values = np.random.default_rng(3), PROBLEM(truth)[0]
    data = {}
    for column, sigma in NOISE.items():
        t = np.sort(rng.uniform(0.05, 0.95, 150))
        data[column] = t, np.interp(t, TIMES, np.asarray(values[column])) + sigma * rng.normal(size=150)
    whole = identify(PROBLEM, data, SENSORS, wide, starts=2, samples=32, times=TIMES)
    best = found.suspects[0]
    assert best.name == "B.d_z"
    assert best.fall == pytest.approx(found.modes[0].cost - whole.modes[0].cost, rel=1e-3)
    assert best.value == pytest.approx(whole.errors["B.d_z"], rel=1e-3)
    assert best.deviation == pytest.approx(whole.deviation[whole.names.index("B.d_z")], rel=1e-3)


def test_what_is_foreign_is_named_by_no_error():
    found = solve(USUAL, disturb=lambda t: 3.0 * np.sin(50.0 * t))
    assert found.status == "misfit" and found.suspects and not any(one.named for one in found.suspects)
    assert "No other error, parameter or fault of a sensor explains the misfit" in found.remarks[0]
    assert not solve(USUAL, disturb=lambda t: 3.0 * np.sin(50.0 * t), sensors=list(NOISE)).suspects[0].named


def test_faults_of_sensors_are_named():
    assert solve(USUAL, shift=0.1).suspects[0].name == "delay of the clock of experiment 1"
    found = solve(USUAL, disturb=lambda t: 4.0)
    (first, second) = found.suspects[:2]
    assert {first.name, second.name} == {"offset of rate_rad_s", "offset of A_force_x_N"}
    assert first.unit in ("rad/s", "N")


def test_a_model_that_fits_has_no_suspects():
    assert solve(USUAL).suspects == ()
    quiet = {name: Sensor(3.0 * noise) for name, noise in NOISE.items()}
    found = solve(USUAL, sensors=quiet)
    assert found.status == "misfit" and found.suspects == ()  # a remainder smaller than its noise has no cause


def test_what_cannot_be_tried_is_told():
    """An error that acts by its square has no slope at zero; one of rounding must not be taken for it."""

    def even(errors):
        tiny = 1e-14 * errors["B.d_z"] / SIZE["B.d_z"] * jnp.sin(7.0 * jnp.asarray(TIMES))
        bent = 0.1 * (errors["D.delta_z"] / SIZE["D.delta_z"]) ** 2 * jnp.sin(7.0 * jnp.asarray(TIMES))
        values = machine(errors | {"D.delta_z": 0.0, "B.d_z": 0.0})
        return values | {"rate_rad_s": values["rate_rad_s"] + bent + tiny}

    problem = FunctionProblem(even, tuple(SIZE), tuple(NOISE), error_units={n: "m" for n in SIZE if ".d_" in n})
    values, rng = problem(USUAL | {"D.delta_z": 6e-3})[0], np.random.default_rng(0)
    data = {"time_s": TIMES} | {name: np.asarray(values[name]) + s * rng.normal(size=101) for name, s in NOISE.items()}
    found = identify(problem, data, SENSORS, TOLERANCES, starts=2, samples=32, times=TIMES)
    assert found.status == "misfit" and not {"D.delta_z", "B.d_z"} & {one.name for one in found.suspects}
    assert "2 could not be tried, as their first effect vanishes at the estimate (D.delta_z, B.d_z)" in found.remarks[0]
