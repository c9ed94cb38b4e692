"""Identification: closed-form machines whose errors are known, theory of what is visible, failures as data."""

import dataclasses
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from rfem_jax import (
    CorrelatedNormal,
    FunctionProblem,
    GeneralisedAlpha,
    InputError,
    Metric,
    MomentRamp,
    Normal,
    Point,
    Sensor,
    Simulation,
    StaticProblem,
    Tolerances,
    assembly_errors,
    discretise,
    identifiability,
    identify,
    load_study,
    simulate,
)
from rfem_jax.tolerancing.identification.fit_tests import chance, whiteness
from rfem_jax.tolerancing.identification.identification_study import _starts
from rfem_jax.tolerancing.identification.levenberg_marquardt import search
from rfem_jax.tolerancing.identification.measurements import read_data, read_signals
from rfem_jax.tolerancing.identification.observability import see, signal_information, without_shift
from rfem_jax.tolerancing.identification.posterior import find_modes, invert, without_saddles
from rfem_jax.tolerancing.identification.predictions import Predictor, interpolation_error, spline
from rfem_jax.tolerancing.identification.prior import read_prior
from rfem_jax.tolerancing.identification.residuals import Residuals, efficiency, robust
from rfem_jax.tolerancing.identification.signals import run_columns
from rfem_jax.tolerancing.problems.kept_evaluations import kept_in
from tests.mechanisms import arm, four_bar

TIMES = np.linspace(0.0, 1.0, 101)
NAMES = ("D.delta_x", "D.delta_z", "D.d_y")
TOLERANCES = Tolerances({"D.delta_x": Normal(9e-3), "D.delta_z": Normal(9e-3), "D.d_y": Normal(6e-4)})
SIGMA = np.array([3e-3, 3e-3, 2e-4])
NOISE = {"rate_rad_s": 0.02, "A_force_x_N": 0.3}
SENSORS = {name: Sensor(noise) for name, noise in NOISE.items()}


def machine(errors):
    """Two signals that are bent functions of three errors in standard deviations."""
    t = jnp.asarray(TIMES)
    a, b, c = (errors[name] / s for name, s in zip(NAMES, SIGMA, strict=True))
    rate = 0.2 * a * jnp.sin(5.0 * t) + 0.1 * b * jnp.exp(-t) + 0.01 * a**2 * t
    force = 5.0 + 2.0 * t + 3.0 * c * t + b * jnp.cos(9.0 * t) + 0.1 * b * c
    return {"rate_rad_s": rate, "A_force_x_N": force}


def problem_of(function=machine, names=NAMES, signals=tuple(NOISE)):
    units = {name: "m" for name in names if ".d_" in name}
    return FunctionProblem(function, names, signals, error_units=units)


PROBLEM = problem_of()


def measure(problem, errors, rng, *, count=60, noise=NOISE, times=None, **faults):
    """{column: (times, values)} of a machine, with noise and the sensors' faults."""
    values, _ = problem(errors)
    data = {}
    for column, sigma in noise.items():
        t = np.sort(rng.uniform(0.05, 0.95, count)) if times is None else times
        shift, offset, gain = (faults.get(column, {}).get(name, 0.0) for name in ("shift", "offset", "gain"))
        curve = spline(TIMES, np.asarray(values[column]))(t - shift)
        data[column] = (t, (1.0 + gain) * curve + offset + sigma * rng.normal(size=count))
    return data


def solve(problem=PROBLEM, errors=None, seed=0, sensors=SENSORS, tolerances=TOLERANCES, data=None, **more):
    errors = dict(zip(NAMES, SIGMA * [1.0, -0.7, 0.5], strict=True)) if errors is None else errors
    data = measure(problem, errors, np.random.default_rng(seed)) if data is None else data
    return identify(problem, data, sensors, tolerances, times=TIMES, **{"starts": 4, "samples": 128} | more)


@pytest.mark.long
def test_intervals_cover_as_they_promise_and_estimates_are_unbiased():
    machines, level = 200, 0.9
    rng = np.random.default_rng(11)
    inside, scores, misfits = np.zeros(3), [], 0
    for _ in range(machines):
        truth = SIGMA * rng.normal(size=3)
        data = measure(PROBLEM, dict(zip(NAMES, truth, strict=True)), rng, count=30)
        found = solve(data=data, starts=2, samples=32, confidence=level)
        inside += (found.low <= truth) & (truth <= found.high)
        scores.append((found.estimate - truth) / found.deviation)
        misfits += found.status == "misfit"
    low, high = stats.binom.ppf((5e-4, 1.0 - 5e-4), machines, level)
    assert ((low <= inside) & (inside <= high)).all(), inside
    assert (np.abs(np.mean(scores, axis=0)) < 4.0 / np.sqrt(machines)).all()
    assert (np.abs(np.std(scores, axis=0) - 1.0) < 4.0 / np.sqrt(2 * machines)).all()
    assert misfits <= 2  # by chance 1 in 1000


def residuals_of(sensors, shift=0.0, loss="gaussian", seed=0, tolerances=TOLERANCES):
    data = measure(PROBLEM, dict(zip(NAMES, SIGMA, strict=True)), np.random.default_rng(seed))
    prior = read_prior(PROBLEM, tolerances, None, "tolerances", None)
    predictors = [Predictor(PROBLEM, list(sensors), prior.names, {}, TIMES)]
    return Residuals(prior, predictors, [read_data(data, sensors)], read_signals(sensors), shift, loss)


FAULTY = {"rate_rad_s": Sensor(0.02, offset=0.01), "A_force_x_N": Sensor(0.3, offset=np.inf, gain=0.05)}
GROUPED = Tolerances(
    {"D.d_y": Normal(6e-4)},
    correlated=CorrelatedNormal({"D.delta_x": 9e-3, "D.delta_z": 9e-3}, SIGMA[0] ** 2 * np.array([[1, 0.6], [0.6, 1]])),
)


@pytest.mark.parametrize("loss", ["gaussian", "huber", "cauchy"])
@pytest.mark.parametrize("tolerances", [TOLERANCES, GROUPED])
def test_jacobian_and_gradient_are_those_of_differences(loss, tolerances):
    residuals = residuals_of(FAULTY, shift=0.005, loss=loss, tolerances=tolerances)
    assert residuals.size == 7
    theta = np.random.default_rng(2).normal(size=(1, 7))
    found = residuals.evaluate(theta)
    step = 1e-5
    for j in range(residuals.size):
        ends = np.concatenate([theta, theta])
        ends[:, j] += [step, -step]
        upper, lower = (residuals.evaluate(one[None], derivatives=False) for one in ends)
        slope = (upper.residual[0] - lower.residual[0]) / (2.0 * step)
        np.testing.assert_allclose(found.jacobian[0, :, j], slope, rtol=1e-6, atol=1e-6 * np.abs(slope).max())
        of_cost = 0.25 * (upper.cost[0] - lower.cost[0]) / step
        assert found.gradient[0, j] == pytest.approx(of_cost, rel=1e-5, abs=1e-5 * np.abs(found.gradient).max())


def test_laplace_covariance_is_that_of_the_information_with_sensor_faults_eliminated():
    """Two ways: the inverse of all parameters' matrix, and Schur complements signal by signal (17.13)."""
    residuals = residuals_of(FAULTY, shift=0.005)
    theta = np.zeros((1, residuals.size))
    theta[0, :3] = [1.0, -0.7, 0.5]
    whole = invert(residuals.evaluate(theta).curvature[0])[:3, :3]
    prediction = residuals.predict(theta)[0]
    total = np.zeros((4, 4))
    for row, one in enumerate(residuals.signals):
        values = np.concatenate(
            [prediction.values[0, row][:, None], prediction.derivatives[0, row] @ residuals.prior.root], axis=1
        )
        through = spline(TIMES, values)
        f = through(one.history.times)
        slopes = np.concatenate([f[:, 1:], -0.005 * through(one.history.times, 1)[:, :1]], axis=1)
        total += signal_information(slopes, f[:, 0], one.noise, one.sensor.offset, one.sensor.gain)
    np.testing.assert_allclose(np.linalg.inv(np.eye(3) + without_shift(total, True)), whole, rtol=1e-7)


def test_faults_of_sensors_and_of_the_clock_are_found_with_the_errors():
    truth = dict(zip(NAMES, SIGMA * [1.0, -0.7, 0.5], strict=True))
    faults = {"rate_rad_s": {"shift": 0.01}, "A_force_x_N": {"shift": 0.01, "offset": 2.0, "gain": 0.04}}
    data = measure(PROBLEM, truth, np.random.default_rng(4), count=400, **faults)
    sensors = {"rate_rad_s": Sensor(0.02), "A_force_x_N": Sensor(0.3, offset="5 N", gain=0.05)}
    found = solve(data=data, sensors=sensors, time_shift="0.01 s")
    assert found.status == "ok"
    assert (np.abs(found.estimate - list(truth.values())) < 4.0 * found.deviation).all()
    force = found.signals[1]
    assert force.shift == pytest.approx(0.01, abs=3e-3) and force.offset == pytest.approx(2.0, abs=1.0)
    assert force.gain == pytest.approx(0.04, abs=0.1) and found.signals[0].shift == force.shift
    # Who does not know of them is misled, and told so.
    blind = solve(data=data)
    assert blind.status == "misfit" and "A_force_x_N (experiment 1): misfit" in str(blind)


def test_noise_is_estimated_where_it_is_not_given():
    data = measure(PROBLEM, dict(zip(NAMES, SIGMA, strict=True)), np.random.default_rng(7), count=400)
    found, known = solve(data=data, sensors=list(NOISE)), solve(data=data)
    for one in found.signals:
        assert one.estimated and one.noise == pytest.approx(NOISE[one.column], rel=0.15)
        assert np.isnan(one.chi_square_chance)
    np.testing.assert_allclose(found.deviation, known.deviation, rtol=0.15)


@pytest.mark.parametrize("factor, words", [(0.5, "larger than the noise"), (2.0, "smaller than the noise")])
def test_wrong_noise_is_flagged(factor, words):
    sensors = {name: Sensor(factor * noise) for name, noise in NOISE.items()}
    found = solve(sensors=sensors)
    assert found.status == "misfit" and all(words in one.verdict for one in found.signals)


def test_an_error_that_is_no_unknown_is_flagged():
    def other(errors):
        missed = 0.05 * jnp.sin(12.0 * jnp.asarray(TIMES))
        values = machine(errors)
        return values | {"rate_rad_s": values["rate_rad_s"] + missed}

    truth = dict(zip(NAMES, SIGMA, strict=True))
    rng = np.random.default_rng(1)
    found = solve(data=measure(problem_of(other), truth, rng, count=200))
    assert found.status == "misfit" and found.signals[0].verdict.startswith("misfit")
    assert found.signals[1].verdict == "fits"
    # With noise to be estimated, which hides its size, it is seen by its correlation.
    assert solve(data=measure(problem_of(other), truth, rng, count=200), sensors=list(NOISE)).status == "misfit"


def test_outliers_do_not_move_a_robust_estimate():
    truth = dict(zip(NAMES, SIGMA * [1.0, -0.7, 0.5], strict=True))
    data = measure(PROBLEM, truth, np.random.default_rng(5), count=300)
    for column, (_, values) in data.items():
        values[::15] += 60.0 * NOISE[column]
    plain = solve(data=data)
    assert plain.status == "misfit"
    for loss in ("huber", "cauchy"):
        found = solve(data=data, loss=loss)
        assert found.status == "ok", str(found)
        assert (np.abs(found.estimate - list(truth.values())) < 4.0 * found.deviation).all()
        assert (found.deviation < 1.5 * plain.deviation).all()
        assert np.linalg.norm((found.estimate - list(truth.values())) / SIGMA) < 0.5 * np.linalg.norm(
            (plain.estimate - list(truth.values())) / SIGMA
        )


def test_robust_losses_have_the_efficiency_that_they_are_known_for():
    r = stats.norm.ppf((np.arange(200_000) + 0.5) / 200_000)
    for loss in ("huber", "cauchy"):
        assert 1.0 / efficiency(loss, r) == pytest.approx(0.95, abs=2e-3)
        weight, rho = robust(loss, r)
        slope = np.gradient(rho, r)[5:-5]
        np.testing.assert_allclose(slope, (2.0 * weight * r)[5:-5], atol=2e-3)


def even(errors):
    """A signal that is even in the first error, as loads of planar mechanisms are in tilts."""
    t = jnp.asarray(TIMES)
    a, b = errors["D.delta_x"] / 3e-3, errors["D.d_y"] / 2e-4
    return {"rate_rad_s": 0.2 * a**2 * t + 0.1 * b * jnp.sin(6.0 * t)}


EVEN = problem_of(even, ("D.delta_x", "D.d_y"), ("rate_rad_s",))
TWO = Tolerances({"D.delta_x": Normal(9e-3), "D.d_y": Normal(6e-4)})


def test_errors_that_are_known_but_for_their_sign_have_two_modes():
    truth = {"D.delta_x": 4e-3, "D.d_y": 1e-4}
    data = measure(EVEN, truth, np.random.default_rng(0), noise={"rate_rad_s": 0.02})
    found = solve(EVEN, data=data, tolerances=TWO, sensors={"rate_rad_s": Sensor(0.02)}, starts=6)
    assert found.status == "ambiguous" and len(found.modes) == 2
    assert [one.probability for one in found.modes] == pytest.approx([0.5, 0.5], abs=1e-6)
    assert found.modes[0].errors == pytest.approx(found.modes[1].errors * [-1.0, 1.0], rel=1e-3)
    assert abs(found.errors["D.delta_x"]) == pytest.approx(4e-3, abs=4.0 * found.deviation[0])
    assert "opposite sign of D.delta_x" in str(found) and "By symmetry" in str(found)
    assert found.visibility.symmetric == ("D.delta_x",)


def test_modes_are_as_probable_as_the_integrals_of_the_density():
    """Two modes of different widths; the integrals by a sum over a fine grid."""

    def bent(errors):
        a = errors["D.delta_x"] / 3e-3
        return {"rate_rad_s": (a**2 + 0.15 * a**3) * jnp.asarray(TIMES)}

    problem, sensors = problem_of(bent, ("D.delta_x",), ("rate_rad_s",)), {"rate_rad_s": Sensor(0.3)}
    data = measure(problem, {"D.delta_x": 3.6e-3}, np.random.default_rng(2), noise={"rate_rad_s": 0.3})
    found = solve(problem, data=data, tolerances={"D.delta_x": Normal(9e-3)}, sensors=sensors, starts=8)
    t, y = data["rate_rad_s"]
    a = np.linspace(-4.0, 4.0, 8001)
    log = -0.5 * np.sum((((a**2 + 0.15 * a**3)[:, None] * t - y) / 0.3) ** 2, axis=1) - 0.5 * a**2
    density = np.exp(log - log.max())
    assert found.status == "ambiguous" and len(found.modes) == 2
    for one in found.modes:
        side = np.sign(a) == np.sign(one.errors[0])
        assert one.probability == pytest.approx(density[side].sum() / density.sum(), abs=0.03)
    heights = np.exp([-0.5 * (one.cost - found.modes[0].cost) for one in found.modes])
    assert abs(found.modes[0].probability - heights[0] / heights.sum()) > 0.08  # not by their heights alone


def test_white_noise_is_white_and_correlated_noise_is_not():
    rng = np.random.default_rng(0)
    white = rng.normal(size=(400, 200))
    assert stats.kstest([whiteness(one) for one in white], "uniform").pvalue > 1e-3
    smooth = white[:, 1:] + 0.6 * white[:, :-1]
    assert np.median([whiteness(one) for one in smooth]) < 1e-4
    assert chance(200.0, 200.0) > 0.9 and chance(300.0, 200.0) < 1e-4 and chance(120.0, 200.0) < 1e-4


def test_a_point_between_two_modes_is_none():
    """The first search starts at zero errors, where derivatives vanish, and stays: a maximum, not a minimum."""
    data = measure(EVEN, {"D.delta_x": 3.5e-3, "D.d_y": 0.0}, np.random.default_rng(1), noise={"rate_rad_s": 0.4})
    prior = read_prior(EVEN, TWO, None, "tolerances", None)
    sensors = {"rate_rad_s": Sensor(0.4)}
    predictors = [Predictor(EVEN, list(sensors), prior.names, {}, TIMES)]
    residuals = Residuals(prior, predictors, [read_data(data, sensors)], read_signals(sensors), 0.0, "gaussian")
    starts = _starts(residuals, jax.random.key(0), 8)
    ends = search(residuals.evaluate, starts, residuals.low, residuals.high, 60)
    modes = find_modes(residuals, ends)
    assert len(modes) == 3 and sum(abs(one.theta[0]) < 1e-9 for one in modes) == 1
    kept = without_saddles(modes, lambda theta: residuals.evaluate(theta, derivatives=False).cost, 2)
    assert len(kept) == 2 and all(abs(one.theta[0]) > 0.5 for one in kept)
    assert sum(one.probability for one in kept) == pytest.approx(1.0)


def test_a_posterior_that_is_not_normal_has_the_intervals_of_its_samples():
    """The sign of an error that is nearly zero: one broad mode with a flat top, whose density is known."""
    rng = np.random.default_rng(3)
    sigma = 0.5
    data = measure(EVEN, {"D.delta_x": 0.0, "D.d_y": 0.0}, rng, noise={"rate_rad_s": sigma})
    found = solve(
        EVEN, data=data, tolerances=TWO, sensors={"rate_rad_s": Sensor(sigma)}, at={"D.d_y": 0.0},
        unknowns=["D.delta_x"], samples=2048,
    )  # fmt: skip
    assert found.method == "importance" and found.departure > 0.3
    t, y = data["rate_rad_s"]
    x = np.linspace(-12e-3, 12e-3, 20001)
    log = np.array(
        [-0.5 * np.sum(((0.2 * (one / 3e-3) ** 2 * t - y) / sigma) ** 2) - 0.5 * (one / 3e-3) ** 2 for one in x]
    )
    density = np.exp(log - log.max())
    reached = np.cumsum(density) / density.sum()
    expected = np.interp((0.025, 0.975), reached, x)
    assert [found.low[0], found.high[0]] == pytest.approx(expected, rel=0.06)
    mean = (density @ x**2 / density.sum()) ** 0.5
    assert found.deviation[0] == pytest.approx(mean, rel=0.05)


def test_experiments_together_tell_what_both_do():
    truth = dict(zip(NAMES, SIGMA, strict=True))
    data = [measure(PROBLEM, truth, np.random.default_rng(1))] * 2
    one, both = solve(data=data[0]), identify([PROBLEM, PROBLEM], data, SENSORS, TOLERANCES, times=TIMES, starts=4)
    assert both.status == "ok" and [fit.experiment for fit in both.signals] == [1, 1, 2, 2]
    precision = [np.linalg.inv(found.covariance) - np.diag(SIGMA**-2.0) for found in (one, both)]
    np.testing.assert_allclose(np.diag(precision[1]) / np.diag(precision[0]), 2.0, rtol=0.02)
    assert (both.deviation < one.deviation).all()


def test_bounds_and_flat_priors():
    truth = dict(zip(NAMES, SIGMA * [1.0, -0.7, 0.5], strict=True))
    data = measure(PROBLEM, truth, np.random.default_rng(0))
    flat, normal = solve(data=data, prior="flat"), solve(data=data)
    assert np.isinf(flat.prior_deviation).all() and (flat.deviation > normal.deviation).all()
    np.testing.assert_allclose(flat.estimate, normal.estimate, atol=2.0 * flat.deviation.max())
    bounded = solve(data=data, bounds={"D.delta_x": (0.0, "0.1 deg")})
    assert bounded.errors["D.delta_x"] == pytest.approx(np.radians(0.1)) and bounded.converged == 4
    assert bounded.low[0] >= 0.0 and bounded.high[0] <= np.radians(0.1) + 1e-12


def failing(errors):
    return machine(errors), 3


def blind(errors):
    t = jnp.asarray(TIMES)
    return {"rate_rad_s": 0.1 * t + 0.0 * errors["D.delta_x"]}


def test_failures_are_statuses():
    data = measure(PROBLEM, dict(zip(NAMES, SIGMA, strict=True)), np.random.default_rng(0))
    found = solve(problem_of(failing), data=data)
    assert found.status == "failed" and np.isnan(found.estimate).all() and "status failed" in str(found)
    assert solve(data=data, iterations=1).status == "not_converged"
    one = problem_of(blind, ("D.delta_x",), ("rate_rad_s",))
    sensors, data = {"rate_rad_s": Sensor(0.02)}, {"rate_rad_s": (TIMES[::5], 0.1 * TIMES[::5])}
    open_ = solve(one, data=data, sensors=sensors, tolerances={"D.delta_x": Normal(9e-3)}, prior="flat")
    assert open_.status == "undetermined" and np.isinf(open_.deviation).all()
    assert "does not depend on any unknown" in str(open_)
    for result in (found, open_):
        result.to_xarray(), result.to_pandas(), result._repr_html_()


def test_the_worth_of_signals_and_what_they_cannot_see():
    found = identifiability(PROBLEM, SENSORS, TOLERANCES, times=TIMES)
    assert found.status == "ok" and found.failed == 0
    # A rate tells nothing of D.d_y: a whole unit of variance of three stays.
    worth = {one.column: one for one in found.visibility.worth}
    assert worth["rate_rad_s"].rest > 1.0 / 3.0 and {one.place for one in worth.values()} == {1, 2}
    alone = identifiability(PROBLEM, {"rate_rad_s": Sensor(0.02)}, TOLERANCES, times=TIMES)
    assert alone.visibility.singular[-1] == 0.0 and "cannot see 1 D.d_y" in str(alone)
    assert alone.rows()[2]["expected_deviation"] == pytest.approx(SIGMA[2])
    found.to_xarray(), found.to_pandas(), found._repr_html_()


def test_greedy_choice_is_that_of_determinants():
    parts = [np.diag([9.0, 0.0, 0.0]), np.diag([0.0, 4.0, 0.0]), np.diag([8.0, 1.0, 0.0])]
    from rfem_jax.tolerancing.identification.observability import rank_signals

    ranked = rank_signals(["a", "b", "c"], [np.pad(one, ((0, 1), (0, 1)))[:3, :3] for one in parts], False)
    assert [one.column for one in ranked] == ["c", "b", "a"]
    assert ranked[0].gain == pytest.approx(0.5 * np.log(9.0 * 2.0)) and ranked[2].gain == pytest.approx(
        0.5 * np.log(10.0)
    )
    assert ranked[1].gain_together == pytest.approx(0.5 * np.log(9.0 * 6.0))
    assert ranked[1].rest_together == pytest.approx(0.5 * (1.0 / 9.0 + 1.0 / 6.0))


def test_errors_that_look_the_same_are_told():
    def alike(errors):
        together = errors["D.delta_x"] / 3e-3 - errors["D.delta_z"] / 3e-3 + 0.01 * errors["D.d_y"] / 2e-4
        return {"rate_rad_s": together * jnp.sin(5.0 * jnp.asarray(TIMES))}

    found = identifiability(
        problem_of(alike, signals=("rate_rad_s",)), {"rate_rad_s": Sensor(0.02)}, TOLERANCES, times=TIMES
    )
    assert "D.delta_x and D.delta_z with the opposite sign look the same" in str(found)
    assert found.visibility.singular[1] < 1e-6 * found.visibility.singular[0]
    assert see(NAMES, np.diag([4.0, 1.0, 9.0]), (), ()).sentences == ()


@pytest.fixture(scope="module")
def pendulum():
    """A driven arm in gravity, whose hinge may be turned, tilted and shifted."""
    model = discretise(arm(points=[Point("P", "arm", (0.3, 0.0, 0.0))]))
    return Simulation(
        model, drive=MomentRamp("A", 0.5, 0.1), duration=0.5, method=GeneralisedAlpha(step=2e-3), save_every=4e-3
    )


@pytest.mark.long
def test_a_shift_along_the_only_axis_is_invisible_but_to_places(pendulum):
    """Theory: gravity and inertia do not depend on where the mechanism is, so that no load sees it move along y."""
    tolerances = Tolerances({"A.d_y": Normal("1 mm"), "A.delta_x": Normal("2 deg"), "A.d_z": Normal("1 mm")})
    sensors = {"rate_rad_s": Sensor(0.01), "A_force_x_N": Sensor(0.01), "A_moment_z_Nm": Sensor(0.01)}
    found = identifiability(pendulum, sensors, tolerances)
    singular, directions = found.visibility.singular, found.visibility.directions
    assert singular[0] > 1.0 and (singular[1:] < 1e-6 * singular[0]).all()
    assert abs(directions[0][1]) == pytest.approx(1.0)  # the tilt alone is seen
    assert "cannot see" in str(found)
    place = identifiability(pendulum, {"P_y_m": Sensor(1e-5), "P_z_m": Sensor(1e-5)}, tolerances)
    assert (place.visibility.singular > 10.0).all()


@pytest.mark.long
def test_a_shift_of_the_whole_mechanism_is_invisible():
    """Theory: loads do not see where the mechanism is along its axes; turns about these are no errors at all."""
    model = discretise(four_bar(rfes=2))
    simulation = Simulation(
        model, drive=MomentRamp("A", 1.0, 0.05), duration=0.05, method=GeneralisedAlpha(step=2.5e-3, tolerance=1e-9),
        save_every=5e-3,
    )  # fmt: skip
    names = ("A.d_y", "D.d_y", "D.delta_x")
    tolerances = Tolerances({name: Normal("1 mm" if ".d_" in name else "0.5 deg") for name in names})
    sensors = {"rate_rad_s": Sensor(0.1), "D_moment_x_Nm": Sensor(0.1), "D_moment_z_Nm": Sensor(0.1)}
    found = identifiability(simulation, sensors, tolerances, points=4).visibility
    assert (found.singular[:2] > 1.0).all() and found.singular[2] < 1e-5 * found.singular[0]
    together = np.array([1.0, 1.0, 0.0]) / np.sqrt(2.0)
    assert abs(found.directions[2] @ together) == pytest.approx(1.0, abs=1e-6)
    assert found.deviations == pytest.approx([np.sqrt(0.5)] * 2 + [0.0], abs=0.1)


@pytest.mark.long
def test_a_simulated_arm_is_identified_from_another_model(pendulum, refused, tmp_path):
    truth = {"A.delta_x": np.radians(1.5), "A.d_z": 3e-4}
    fine = dataclasses.replace(pendulum, method=GeneralisedAlpha(step=5e-4), save_every=1e-3)
    run = simulate(fine, assembly_errors(pendulum.model, truth))
    rng, columns = np.random.default_rng(0), dict(run_columns(run))
    noise = {"P_z_m": 1e-4, "A_moment_z_Nm": 2e-3}  # with less the model's steps are too long
    data = {"time_s": np.asarray(run.times)[7::10]}
    for column, sigma in noise.items():
        values = np.asarray(columns[column]())[7::10]
        data[column] = values + sigma * rng.normal(size=values.shape)
    tolerances = Tolerances({"A.delta_x": Normal("3 deg"), "A.d_z": Normal("1 mm")})
    found = identify(pendulum, data, {name: Sensor(sigma) for name, sigma in noise.items()}, tolerances)
    assert found.status in ("ok", "ambiguous"), str(found)
    away = np.abs(np.abs(found.estimate) - list(truth.values()))
    assert (away < 4.0 * found.deviation).all() and (found.deviation < 0.1 * found.prior_deviation).all()
    # An interrupted identification goes on from what it has computed, to the same numbers.
    sensors = {name: Sensor(sigma) for name, sigma in noise.items()}
    with pytest.raises(KeyboardInterrupt), kept_in(tmp_path / "kept"):
        identify(pendulum, data, sensors, tolerances)
        raise KeyboardInterrupt
    with kept_in(tmp_path / "kept") as kept:
        again = identify(pendulum, data, sensors, tolerances)
    assert kept.read > 3 and kept.read == kept.count
    np.testing.assert_array_equal(again.estimate, found.estimate)
    with refused("no `A_force_q_N`", "`A_force_"):
        identify(pendulum, {"time_s": [0, 0.1, 0.2, 0.3], "A_force_q_N": [0] * 4}, "A_force_q_N", tolerances)


@pytest.mark.long
def test_errors_are_found_in_what_another_engine_has_measured():
    """A four-bar by Exudyn with three times as many elements, and the error that is missed where it is no unknown; the
    file and the errors, of which the estimate knows nothing: `benchmarks/exudyn_measured.py`."""
    study = load_study(Path(__file__).parents[2] / "studies" / "identify_misassembly" / "study.toml")
    simulation = Simulation.of(study, method=GeneralisedAlpha(step=1e-3), save_every=2e-3, duration=0.3)
    file, truth = Path(__file__).with_name("measured_by_exudyn.csv"), np.array([*np.radians([0.25, -0.15]), 4e-4])
    sensors = {
        "rate_rad_s": Sensor(0.1), "D_moment_x_Nm": Sensor(0.4, offset=0.1), "D_moment_z_Nm": Sensor(0.4)
    }  # fmt: skip
    tolerances = {name: Normal("0.5 mm" if ".d_" in name else "0.5 deg") for name in NAMES}
    found = identify(simulation, file, sensors, tolerances, starts=4, samples=64)
    assert found.status == "ok" and found.suspects == (), str(found)
    assert ((found.low <= truth) & (truth <= found.high)).all()
    assert (found.deviation < [2.5e-4, 2.5e-4, 8e-5]).all()
    assert found.signals[1].offset == pytest.approx(0.05, abs=0.12)
    blind = identify(
        simulation, file, sensors, {name: tolerances[name] for name in ("D.delta_x", "D.d_y")}, starts=4, samples=64
    )
    assert blind.status == "misfit"
    # A turn of the other base joint about z does nearly the same.
    named = {one.name: one for one in blind.suspects if one.named}
    assert named["D.delta_z"].fits and abs(named["D.delta_z"].value - truth[1]) < 4.0 * named["D.delta_z"].deviation
    assert named["A.delta_z"].value == pytest.approx(-named["D.delta_z"].value, rel=0.15)


def test_a_mechanism_at_rest_is_weighed():
    """A static problem whose metrics have an axis of positions: the length of an arm from its holding moment."""
    model = discretise(arm())
    angles = np.linspace(-1.0, 1.0, 9)
    moment = Metric("drive_moment_Nm", "N m", function=lambda loads: jnp.asarray(loads.holding["A"]))
    problem = StaticProblem(model, [moment], {"A": angles})
    values, status = problem({"A.delta_x": np.radians(2.0)})
    assert int(status) == 0 and values["drive_moment_Nm"].shape == (9,)
    found = identifiability(
        problem, {"drive_moment_Nm": Sensor(1e-3)}, {"arm.length": Normal("1 mm")}, times=np.arange(9.0)
    )
    # m g = rho A g L, moment rho A g L^2 / 2 cos(angle): slope rho A g L cos(angle).
    slope = 7850.0 * 1e-4 * 9.81 * 0.3 * np.cos(angles) * (1e-3 / 3.0)
    assert found.visibility.singular[0] == pytest.approx(np.linalg.norm(slope) / 1e-3, rel=1e-3)


def test_interpolation_between_saved_times_has_the_error_that_is_told():
    t, fine = np.linspace(0.0, 1.0, 41), np.linspace(0.0, 1.0, 1001)
    told = interpolation_error(t, np.sin(12.0 * t))
    true = np.abs(spline(t, np.sin(12.0 * t))(fine) - np.sin(12.0 * fine)).max()
    assert 0.3 * true < told < 3.0 * true


GOOD = {"time_s": [0.1, 0.2, 0.3, 0.4, 0.5], "rate_rad_s": [0.0] * 5, "A_force_x_N": [5.0] * 5}


@pytest.mark.parametrize(
    "change, words",
    [
        ({"time_s": None}, ("`time_s`", "none")),
        ({"A_force_x_N": None}, ("`A_force_x_N`", "none")),
        ({"rate_rad_s": [0.0, np.nan, 0.0, 0.0, 0.0]}, ("finite numbers", "sample 1", "nan")),
        ({"rate_rad_s": ["a"] * 5}, ("must hold numbers", "`rate_rad_s`")),
        ({"time_s": [0.1, 0.3, 0.2, 0.4, 0.5]}, ("increase", "0.3 s to 0.2 s")),
        ({"time_s": [0.1, 0.2, 0.2, 0.4, 0.5]}, ("increase", "0.2 s to 0.2 s")),
        ({"rate_rad_s": [0.0] * 4}, ("a value for every time", "(4,)")),
        ({"rate_rad_s": ([0.1, 0.2], [0.0, 0.0])}, ("at least 4 samples",)),
        ({"time_s": [0.1, 0.2, 0.3, 0.4, 1.5]}, ("within the simulated time", "1.5 s", "experiment 1")),
    ],
)
def test_bad_data_is_refused_in_a_sentence(change, words, refused):
    data = {name: value for name, value in (GOOD | change).items() if value is not None}
    with refused(*words):
        solve(data=data)


@pytest.mark.parametrize(
    "text, words",
    [
        ("", ("`time_s`", "none")),
        ("time_s,rate_rad_s\n0.1,0\n", ("`A_force_x_N`", "none")),
        ("time_s;rate_rad_s;A_force_x_N\n0,1;0;1\n", ("commas between its columns", "points")),
        ("time_s,rate_rad_s,A_force_x_N\n0.1,0,x\n", ("'x'", "row 2", "`A_force_x_N`")),
        ("time_s,rate_rad_s,A_force_x_N\n0,1,0,5,1,2\n", ("row 2", "6 cells", "the first row 3", "points")),
        ("time_s,rate_rad_s,rate_rad_s,A_force_x_N\n0.1,0,0,1\n", ("`rate_rad_s` 2 times", "one column")),
        ("time_s,rate_rad_s,A_force_x_N\n0.1,0,nan\n0.2,0,1\n0.3,0,1\n0.4,0,1\n", ("finite numbers", "nan")),
    ],
)
def test_bad_files_are_refused_in_a_sentence(text, words, tmp_path, refused):
    path = tmp_path / "measured.csv"
    path.write_text(text, encoding="utf-8")
    with refused(*words):
        solve(data=path)
    with refused("cannot be read"):
        solve(data=tmp_path / "none.csv")


@pytest.mark.parametrize(
    "arguments, words",
    [
        ({"sensors": {"rate_deg_s": Sensor(0.1)}}, ("SI units", "`rate_deg_s`")),
        ({"sensors": {"rate_rad_s": Sensor("2 N")}}, ("`noise` of `rate_rad_s`", "2 N")),
        ({"sensors": {"rate_rad_s": 0.1}}, ("`rate_rad_s` has 0.1", "Sensor(noise=...)")),
        ({"sensors": {}}, ("at least one column",)),
        ({"sensors": {"rate_rad_s": Sensor(0.0)}}, ("`noise` of `rate_rad_s`", "positive")),
        ({"sensors": {"drive_moment_Nm": Sensor(0.1)}}, ("`signals`", "`drive_moment_Nm`")),
        ({"unknowns": ["D.delta_y"]}, ("`unknowns`", "`D.delta_y`")),
        ({"unknowns": ["D.delta_x"], "at": {"D.delta_x": 0.1}}, ("`at`", "`D.delta_x`")),
        ({"bounds": {"D.delta_x": (1.0, 0.0)}}, ("`bounds`", "rise")),
        ({"tolerances": GROUPED, "bounds": {"D.delta_x": (-1.0, 1.0)}}, ("`bounds`", "varies with others")),
        ({"tolerances": TWO, "unknowns": NAMES}, ("must have tolerances", "`D.delta_z`")),
        ({"tolerances": 3.0}, ("`tolerances`", "3.0")),
        ({"prior": "normal"}, ("`prior`",)),
        ({"loss": "l1"}, ("`loss`",)),
        ({"time_shift": -1.0}, ("`time_shift`", "negative")),
        ({"time_shift": 0.2}, ("`time_shift`", "no samples")),
        ({"candidates": {"rate_rad_s": Sensor()}}, ("`candidates`", "`rate_rad_s`", "noise")),
        ({"starts": 0}, ("`starts`",)),
        ({"data": [GOOD, GOOD]}, ("1 and 2",)),
    ],
)
def test_wrong_arguments_are_refused_in_a_sentence(arguments, words, refused):
    with refused(*words):
        solve(**{"data": GOOD} | arguments)


@pytest.mark.parametrize(
    "factor, words",
    [
        (60.0 / (2.0 * np.pi), "revolutions per minute"), (180.0 / np.pi, "degrees"), (1e3, "thousandth"),
        (-1.0, "sign"), (0.0, "are 0: a sensor"), (1.0, None), (1.6, None),
    ],
)  # fmt: skip
def test_other_units_and_dead_sensors_are_told(factor, words):
    truth = dict(zip(NAMES, SIGMA * [1.0, -0.7, 0.5], strict=True))
    data = measure(PROBLEM, truth, np.random.default_rng(0))
    t, y = data["A_force_x_N"]
    found = solve(data=data | {"A_force_x_N": (t, factor * y)})
    told = [one for one in found.remarks if one.startswith(("`A_force_x_N` is", "All samples of `A_force_x_N`"))]
    assert (found.status == "ok") == (factor == 1.0) and len(told) == (words is not None)
    assert words is None or words in told[0]


def test_searches_start_at_the_mean_and_all_over_the_prior():
    starts = _starts(residuals_of(SENSORS), jax.random.key(0), 64)
    assert (starts[0] == 0.0).all() and np.std(starts, axis=0) == pytest.approx(np.ones(3), abs=0.25)


def test_a_problem_without_times_is_refused():
    with pytest.raises(InputError, match="`times`"):
        identify(PROBLEM, GOOD, SENSORS, TOLERANCES)
