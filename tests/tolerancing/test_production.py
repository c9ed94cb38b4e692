"""The distribution of production from machines that were measured: linear theory in data space, coverage, doubts."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from rfem_jax import (
    FunctionProblem,
    GeneralisedAlpha,
    MomentRamp,
    Normal,
    Point,
    Sensor,
    Simulation,
    Tolerances,
    assembly_errors,
    discretise,
    estimate_production,
    identify,
    load_study,
    simulate,
)
from rfem_jax.simulation.outcome.run import Run
from rfem_jax.tolerancing.identification.production import (
    Likelihoods,
    _interval,
    _most_probable,
    likelihoods_of,
    restricted,
)
from tests.mechanisms import arm

TIMES = np.linspace(0.0, 1.0, 51)
NAMES = ("D.delta_x", "D.delta_z", "D.d_y")
SIGMA = np.array([3e-3, 3e-3, 2e-4])
TOLERANCES = Tolerances({name: Normal(3.0 * s) for name, s in zip(NAMES, SIGMA, strict=True)})
NOISE = 0.8
MEAN, DEVIATION = np.array([0.6, -0.2, 0.0]), np.array([0.4, 0.7, 0.3])  # of production, in SIGMA
MACHINES = 110


def measured(errors):
    """A signal that is linear in the errors."""
    t, (a, b, c) = jnp.asarray(TIMES), [errors[name] / s for name, s in zip(NAMES, SIGMA, strict=True)]
    return {"rate_rad_s": a * jnp.sin(6.0 * t) + b * t + c * jnp.cos(3.0 * t)}


COLUMNS = np.stack(
    [np.asarray(measured(dict(zip(NAMES, SIGMA * e, strict=True)))["rate_rad_s"]) for e in np.eye(3)], axis=1
)
PROBLEM = FunctionProblem(measured, NAMES, ("rate_rad_s",), error_units={"D.d_y": "m"})


def identified(y, **more):
    settings = {"starts": 1, "samples": 64} | more
    return identify(
        PROBLEM, {"time_s": TIMES, "rate_rad_s": y}, {"rate_rad_s": Sensor(NOISE)}, TOLERANCES, times=TIMES, **settings
    )


@pytest.fixture(scope="module")
def fleet():
    """(true errors (n, k) in SIGMA, data (n, T), what was identified of each)."""
    rng = np.random.default_rng(3)
    true = MEAN + DEVIATION * rng.normal(size=(MACHINES, 3))
    data = true @ COLUMNS.T + NOISE * rng.normal(size=(MACHINES, len(TIMES)))
    return true, data, [identified(y) for y in data]


@pytest.mark.long
def test_production_is_found_with_the_likelihood_of_the_data_themselves(fleet):
    """Independently, without posteriors: y = C x + noise is normal with the covariance C T C' + noise^2."""
    true, data, found = fleet
    result = estimate_production(found)
    assert result.status == "ok" and len(result.machines) == MACHINES - len(result.left_out), str(result)
    used = [int(name) - 1 for name in result.machines]

    def of_data(sigma):
        covariance = COLUMNS @ np.diag(sigma**2) @ COLUMNS.T + NOISE**2 * np.eye(len(TIMES))
        weighed = np.linalg.solve(covariance, COLUMNS)
        precision = len(used) * COLUMNS.T @ weighed + 0.01 * np.eye(3)
        mean = np.linalg.solve(precision, (data[used] @ weighed).sum(axis=0))
        away = data[used] - COLUMNS @ mean
        log = -0.5 * np.sum(away * np.linalg.solve(covariance, away.T).T) - 0.005 * mean @ mean
        log -= 0.5 * len(used) * np.linalg.slogdet(covariance)[1] + 0.5 * np.linalg.slogdet(precision)[1]
        return log, mean, precision

    # Searches end within a hundredth of a deviation from the most probable errors; the formulas are exact.
    known = likelihoods_of([found[i] for i in used])
    precision = COLUMNS.T @ COLUMNS / NOISE**2
    slopes = data[used] @ COLUMNS / NOISE**2
    np.testing.assert_allclose(known.precision, np.array([precision] * len(used)), rtol=1e-9, atol=1e-9)
    away = np.linalg.solve(precision + np.eye(3), (known.slope - slopes).T)
    assert (np.sqrt(np.sum(away * ((precision + np.eye(3)) @ away), axis=0)) < 0.01).all()
    known = known._replace(slope=slopes)
    first, second = np.array([0.3, 0.8, 0.0]), np.array([1.0, 0.2, 0.5])
    arrays = [jnp.asarray(one) for one in (known.precision, known.slope)]
    logs = [float(restricted(jnp.asarray(one), *arrays).log) for one in (first, second)]
    assert logs[0] - logs[1] == pytest.approx(of_data(first)[0] - of_data(second)[0], rel=1e-9)
    # The estimate is the maximum of that, with the means that belong to it.
    sigma = result.deviation / SIGMA
    best, mean, precision = of_data(sigma)
    for j in range(3):
        for step in (-0.02, 0.02):
            assert of_data(sigma + step * np.eye(3)[j])[0] < best
    assert (np.abs(result.mean - SIGMA * mean) < 0.01 * SIGMA / np.sqrt(np.diag(precision))).all()
    half = stats.t.ppf(0.975, len(used) - 1) * np.sqrt(np.diag(np.linalg.inv(precision)))
    np.testing.assert_allclose(0.5 * (result.mean_high - result.mean_low), SIGMA * half, rtol=1e-4)
    # The true production is within the intervals, and these are narrow.
    assert ((result.mean_low <= SIGMA * MEAN) & (result.mean_high >= SIGMA * MEAN)).all()
    assert ((result.deviation_low <= SIGMA * DEVIATION) & (result.deviation_high >= SIGMA * DEVIATION)).all()
    assert (result.deviation_high - result.deviation_low < 0.7 * result.deviation).all()
    # Machines are known better in the light of the others, and as well as is told.
    own = np.array([found[i].estimate for i in used])
    flat = np.linalg.lstsq(COLUMNS, data[used].T, rcond=None)[0].T * SIGMA
    away = [np.mean(((one - SIGMA * true[used]) / SIGMA) ** 2, axis=0) for one in (result.errors, own, flat)]
    assert (away[0] < away[1]).all() and (away[0] < away[2]).all()
    scores = (result.errors - SIGMA * true[used]) / result.errors_deviation
    assert (np.abs(scores.std(axis=0) - 1.0) < 4.0 / np.sqrt(2 * len(used))).all()
    spread = np.linalg.inv(COLUMNS.T @ COLUMNS / NOISE**2 + np.diag(sigma**-2.0))
    np.testing.assert_allclose(result.shrinkage, np.diag(spread) / sigma**2, rtol=1e-3)


@pytest.mark.slow
def test_what_a_machine_says_does_not_depend_on_what_was_known_before(fleet):
    """With another prior the same data have the same likelihood."""
    _, data, found = fleet
    shifted = Tolerances({name: Normal(interval=(-s, 3.0 * s)) for name, s in zip(NAMES, SIGMA, strict=True)})
    other = identify(
        PROBLEM, {"time_s": TIMES, "rate_rad_s": data[0]}, {"rate_rad_s": Sensor(NOISE)}, shifted, times=TIMES,
        starts=1, samples=64,
    )  # fmt: skip
    known = likelihoods_of([found[0], other])
    np.testing.assert_allclose(known.precision[1], known.precision[0], rtol=1e-9, atol=1e-9)
    near = np.linalg.solve(known.precision[0], (known.slope[1] - known.slope[0]))
    assert near @ known.precision[0] @ near < 0.03**2 and np.abs(other.estimate - found[0].estimate).max() > 1e-5


@pytest.mark.slow
def test_lines_are_tolerances_of_a_study(fleet, tmp_path):
    from tests.report.conftest import STUDY

    result = estimate_production(fleet[2][:12])
    path = tmp_path / "study.toml"
    path.write_text(STUDY + result.lines(), encoding="utf-8")
    made = Tolerances.of(load_study(path).tasks.tolerances)
    for i, name in enumerate(NAMES):
        if result.deviation[i] > 0.0:
            assert float(made.means()[name]) == pytest.approx(result.mean[i], rel=1e-4)
            assert np.sqrt(made.covariance()[i, i]) == pytest.approx(result.deviation[i], rel=1e-4)
    assert "12 machines: mean" in result.lines() and 'distribution = "normal"' in str(result)
    data = result.to_xarray()
    assert data["machine_error"].shape == (len(result.machines), 3)
    assert result.to_pandas().loc["D.d_y", "deviation"] == result.deviation[2]
    assert {row["machine"] for row in result.machine_rows()} == {*result.machines, *result.left_out}


@pytest.mark.long
def test_intervals_cover_as_they_promise():
    """Small fleets of machines, one error of which does not scatter at all."""
    rng, fleets, n, level = np.random.default_rng(8), 40, 12, 0.9
    deviation = np.array([0.5, 0.0])
    columns = COLUMNS[:, :2]
    precision = columns.T @ columns / NOISE**2
    inside = np.zeros(2)
    for _ in range(fleets):
        x = np.array([0.3, -0.2]) + deviation * rng.normal(size=(n, 2))
        y = x @ columns.T + NOISE * rng.normal(size=(n, len(TIMES)))
        known = Likelihoods(np.array([precision] * n), y @ columns / NOISE**2, np.zeros(2), np.ones(2))
        sigma, _ = _most_probable(known)
        for j in range(2):
            low, high = _interval(known, sigma, j, level)
            inside[j] += low <= deviation[j] <= high
    low, high = stats.binom.ppf((5e-4, 1.0 - 5e-4), fleets, level)
    assert low <= inside[0] <= high and inside[1] >= low, inside  # at the bound, intervals cover more


@pytest.mark.long
def test_what_is_in_doubt_is_told(fleet, refused):
    true, data, found = fleet
    few = found[:12]
    # A machine from another production.
    stranger = identified(data[0] + COLUMNS @ [9.0, 0.0, 0.0])
    strange = estimate_production([*few[:11], stranger])
    assert strange.status == "unlike" and strange.unlike == ("12",) and "Unlike the others: 12" in str(strange)
    # Machines that were not identified.
    wrong = dataclasses.replace(found[12], status="misfit")
    some = estimate_production({**{f"m{i}": one for i, one in enumerate(few)}, "x": wrong, "y": wrong})
    assert some.status == "selected" and some.left_out == {"x": "misfit", "y": "misfit"}
    np.testing.assert_array_equal(some.deviation, estimate_production(few).deviation)
    none = estimate_production([wrong] * 3)
    assert none.status == "failed" and np.isnan(none.deviation).all() and "status failed" in str(none)
    # An error that no data see.
    blind = FunctionProblem(
        lambda errors: measured({**errors, "D.d_y": 0.0 * errors["D.d_y"]}), NAMES, ("rate_rad_s",),
        error_units={"D.d_y": "m"},
    )  # fmt: skip
    unseen = [
        identify(blind, {"time_s": TIMES, "rate_rad_s": y}, {"rate_rad_s": Sensor(NOISE)}, TOLERANCES, times=TIMES,
                 starts=1, samples=64)
        for y in (true[:12] * [1.0, 1.0, 0.0]) @ COLUMNS.T + (data - true @ COLUMNS.T)[:12]
    ]  # fmt: skip
    open_ = estimate_production(unseen)
    assert open_.status == "undetermined" and np.isinf(open_.deviation_high[2])
    assert "# D.d_y: 12 machines" in open_.lines() and "too little is known" in open_.lines()
    with refused("`machines`", "at least 3"):
        estimate_production(found[:2])
    other = dataclasses.replace(found[0], names=("D.delta_x", "D.delta_z", "D.d_x"))
    with refused("`machines`", "same unknowns", "D.d_x"):
        estimate_production([*found[:3], other])


@pytest.mark.long
def test_the_production_of_simulated_machines():
    """A hundred driven arms, measured on a finer model."""
    model = discretise(arm(points=[Point("P", "arm", (0.3, 0.0, 0.0))]))
    simulation = Simulation(
        model, drive=MomentRamp("A", 0.5, 0.1), duration=0.2, method=GeneralisedAlpha(step=2e-3), save_every=4e-3
    )
    fine = dataclasses.replace(simulation, method=GeneralisedAlpha(step=5e-4), save_every=2e-3)
    names, mean, deviation = (
        ("A.delta_x", "A.d_z"),
        np.array([np.radians(0.5), 2e-4]),
        np.array([np.radians(0.3), 1e-4]),
    )
    tolerances = Tolerances({"A.delta_x": Normal("3 deg"), "A.d_z": Normal("1 mm")})
    noise, rng, found = {"P_z_m": 1e-4, "P_y_m": 1e-4}, np.random.default_rng(1), []
    for true in mean + deviation * rng.normal(size=(100, 2)):
        run: Run = simulate(fine, assembly_errors(model, dict(zip(names, true, strict=True))))
        data = {"time_s": np.asarray(run.times)[3::4]}
        for column, axis in (("P_z_m", 2), ("P_y_m", 1)):
            place = np.asarray(run.points["P"].position)[3::4, axis]
            data[column] = place + noise[column] * rng.normal(size=place.shape)
        sensors = {column: Sensor(sigma) for column, sigma in noise.items()}
        found.append(identify(simulation, data, sensors, tolerances, starts=2, samples=64))
    result = estimate_production(found, confidence=0.99)
    assert result.status == "ok", str(result)
    assert ((result.mean_low <= mean) & (mean <= result.mean_high)).all(), str(result)
    assert ((result.deviation_low <= deviation) & (deviation <= result.deviation_high)).all(), str(result)
    assert (result.deviation_high < 1.3 * result.deviation).all()
