"""Which experiment tells most and how long to measure, against closed forms and against shorter measurements."""

import jax.numpy as jnp
import numpy as np
import pytest

from rfem_jax import FunctionProblem, Normal, Sensor, Tolerances, identifiability

TIMES = np.linspace(0.0, 1.0, 101)
NAMES = ("D.delta_x", "D.d_y")
TOLERANCES = Tolerances({"D.delta_x": Normal(9e-3), "D.d_y": Normal(6e-4)})
SENSORS = {"rate_rad_s": Sensor(0.5), "A_force_x_N": Sensor(0.3, offset=1.0, filter="low_pass", filter_time=0.05)}


def machine(errors):
    """The force tells of the shift as the square of the speed."""
    t, speed = jnp.asarray(TIMES), 1.0 + errors["drive.speed"]
    tilt, shift = errors["D.delta_x"] / 3e-3, errors["D.d_y"] / 2e-4
    return {"rate_rad_s": speed * tilt * jnp.ones_like(t), "A_force_x_N": speed**2 * shift * jnp.sin(4.0 * t)}


PROBLEM = FunctionProblem(machine, (*NAMES, "drive.speed"), tuple(SENSORS), error_units={"D.d_y": "m"})
EXPERIMENTS = {"slower": {"drive.speed": -0.9}, "faster": {"drive.speed": 1.0}}


@pytest.fixture(scope="module")
def found():
    return identifiability(PROBLEM, SENSORS, TOLERANCES, experiments=EXPERIMENTS, times=TIMES)


def test_a_constant_signal_tells_as_much_as_its_samples_are_many(found):
    """Of a tilt that moves a whole signal, n samples leave 1 / sqrt(1 + n (v / sigma)^2) of its deviation."""
    for one, speed in zip(found.experiments, (1.0, 0.1, 2.0), strict=True):
        n = np.round(one.lengths / 0.01) + 1
        np.testing.assert_allclose(one.deviations[:, 0], 1.0 / np.sqrt(1.0 + n * (speed / 0.5) ** 2), rtol=1e-9)
        assert len(one.lengths) == 10 and one.lengths[-1] == pytest.approx(1.0)
        assert (np.diff(one.gain) > 0.0).all() and (np.diff(one.rest) < 0.0).all()


def test_a_part_of_a_measurement_is_a_shorter_one(found):
    given = found.experiments[0]
    assert given.name == "as given"
    np.testing.assert_allclose(given.deviations[-1], found.visibility.deviations, rtol=1e-12)
    n = round(given.lengths[3] / 0.01) + 1
    short = identifiability(PROBLEM, SENSORS, TOLERANCES, times=TIMES, sample_times=TIMES[:n])
    np.testing.assert_allclose(given.deviations[3], short.visibility.deviations, rtol=1e-10)


def test_the_fastest_tells_most_and_all_is_shown(found):
    told = {one.name: one.gain[-1] for one in found.experiments}
    assert told["faster"] > told["as given"] > told["slower"]
    text = str(found)
    assert text.index("faster  ") < text.index("as given  ") < text.index("slower  ")
    assert "How long to measure (faster)" in text
    data = found.to_xarray()
    assert data["experiment_deviation_left"].dims == ("experiment", "length", "error")
    assert float(data["experiment_information"].sel(experiment="faster")[-1]) == told["faster"]


def test_experiments_change_no_unknowns(refused):
    with refused("Experiment `a`", "`D.d_y`"):
        identifiability(PROBLEM, SENSORS, TOLERANCES, experiments={"a": {"D.d_y": 1e-4}}, times=TIMES)
    with refused("Experiment `a`", "`drive.sped`"):
        identifiability(PROBLEM, SENSORS, TOLERANCES, experiments={"a": {"drive.sped": 1e-4}}, times=TIMES)


def test_an_experiment_that_fails_is_told():
    def failing(errors):
        return machine(errors), jnp.where(errors["drive.speed"] > 0.5, 3, 0)

    problem = FunctionProblem(failing, (*NAMES, "drive.speed"), tuple(SENSORS), error_units={"D.d_y": "m"})
    found = identifiability(problem, SENSORS, TOLERANCES, experiments=EXPERIMENTS, times=TIMES, points=2)
    assert found.status == "ok" and found.experiments[2].failed == 2 and np.isnan(found.experiments[2].gain).all()
    assert "No run of the experiment faster succeeded." in str(found) and "How long to measure (as given)" in str(found)
    found.to_xarray()
