"""Corrections of machines that were measured: theory of linear machines, promises that hold, what is refused."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from rfem_jax import FunctionProblem, Normal, Sensor, Tolerances, correct, identify
from rfem_jax.tolerancing.identification.correction import _read, _representatives

TIMES = np.linspace(0.0, 1.0, 51)
NAMES = ("D.delta_x", "D.delta_z", "D.d_y")
SIGMA = np.array([3e-3, 3e-3, 2e-4])
TOLERANCES = Tolerances({name: Normal(3.0 * s) for name, s in zip(NAMES, SIGMA, strict=True)})
UNITS = {"D.d_y": "m", "C.d_y": "m"}
MEASURED_UNITS = {"D.d_y": "m"}
SENSOR = {"rate_rad_s": Sensor(0.3)}
WEIGHTS = np.array([1.0, 0.6, -0.8])  # of the load, by errors in standard deviations
ADJUSTMENTS = {"D.delta_x": (-0.02, 0.02), "D.d_y": ("-1 mm", "1 mm")}


def standard(errors):
    return [errors[name] / s for name, s in zip(NAMES, SIGMA, strict=True)]


def measured(errors):
    """A signal that is linear in the errors."""
    t, (a, b, c) = jnp.asarray(TIMES), standard(errors)
    return {"rate_rad_s": a * jnp.sin(6.0 * t) + b * t + c * jnp.cos(3.0 * t)}


def loads(errors):
    """The square of a combination of the errors with a shim in C, and what no adjustment changes."""
    a, b, c = standard(errors)
    along = WEIGHTS @ jnp.stack([a, b, c]) + errors["C.d_y"] / 1e-4
    return {"C.square": along**2, "C.tilt": b}


MACHINE = FunctionProblem(measured, NAMES, ("rate_rad_s",), error_units=MEASURED_UNITS)
LOADS = FunctionProblem(loads, (*NAMES, "C.d_y"), ("C.square", "C.tilt"), error_units=UNITS)


def identified(z=(1.0, -0.7, -0.9), seed=0, **more):
    """The result for a machine with the errors z in standard deviations, and the posterior's mean and covariance in
    these by the formulas of linear regression."""
    rng = np.random.default_rng(seed)
    columns = np.stack(
        [np.asarray(measured(dict(zip(NAMES, SIGMA * e, strict=True)))["rate_rad_s"]) for e in np.eye(3)], axis=1
    )
    y = columns @ np.asarray(z) + 0.3 * rng.normal(size=len(TIMES))
    settings = {"starts": 2, "samples": 512} | more
    found = identify(MACHINE, {"time_s": TIMES, "rate_rad_s": y}, SENSOR, TOLERANCES, times=TIMES, **settings)
    covariance = np.linalg.inv(np.eye(3) + columns.T @ columns / 0.09)
    return found, covariance @ columns.T @ y / 0.09, covariance


@pytest.fixture(scope="module")
def machine():
    return identified()


def test_amounts_and_promises_are_those_of_the_linear_theory(machine):
    """E (w x + u)^2 = (w m + u)^2 + w C w is least where u undoes w m; the square of a normal number is left."""
    found, mean, covariance = machine
    result = correct(LOADS, found, "C.square", ADJUSTMENTS, limits={"C.square": 3.0, "C.tilt": (-0.7, None)})
    along, spread = WEIGHTS @ mean, WEIGHTS @ covariance @ WEIGHTS
    assert result.status == "ok", str(result)
    before, tilt, shift, together = result.outcomes
    assert before.mean == pytest.approx(along**2 + spread, rel=0.02)
    moves = np.stack([one.amounts for one in (tilt, shift, together)]) / SIGMA[[0, 2]]
    assert moves[0, 1] == moves[1, 0] == 0.0
    assert moves @ WEIGHTS[[0, 2]] == pytest.approx([-along] * 3, abs=0.1 * np.sqrt(spread))
    of_square = stats.chi2(1, scale=spread)
    for one in result.outcomes[1:]:
        assert one.mean == pytest.approx(spread, rel=0.1) and one.converged and one.less > 0.9
        assert one.reached == pytest.approx(of_square.ppf(0.95), rel=0.1)
        assert one.high == pytest.approx(of_square.ppf(0.975), rel=0.15) and one.low < 0.01 * spread
        assert one.deviation == pytest.approx(of_square.std(), rel=0.2) and one.failed == 0.0
    assert before.broken["C.square"] == pytest.approx(stats.ncx2.sf(3.0 / spread, 1, along**2 / spread), abs=0.03)
    assert before.broken["C.tilt"] == pytest.approx(
        stats.norm.cdf((-0.7 - mean[1]) / np.sqrt(covariance[1, 1])), abs=0.03
    )
    assert tilt.broken["C.square"] < 1e-3 and tilt.broken["C.tilt"] == before.broken["C.tilt"]
    moved = mean[0] + tilt.amounts[0] / SIGMA[0]
    inside = np.diff(stats.norm.cdf((np.array([-3.0, 3.0]) - moved) / np.sqrt(covariance[0, 0])))[0]
    assert tilt.beyond[0] == pytest.approx(1.0 - inside, abs=0.03) and tilt.any_beyond >= tilt.beyond.max()
    assert result.best.mean == min(tilt.mean, shift.mean) and result.together is together


def test_progress_counts_the_steps_of_all_searches(machine):
    """Those that a search does not need are done at its end."""
    told = []
    correct(
        LOADS, machine[0], "C.square", ADJUSTMENTS, steps=20, points=4, progress=lambda *counts: told.append(counts)
    )
    done, totals = np.array(told).T
    assert set(totals) == {60} and done[-1] == 60
    assert (np.diff(done) >= 0).all() and done[0] == 1 and len(set(done)) > 4


def test_tolerances_that_are_violated_after_a_correction(machine):
    found, mean, covariance = machine
    near = dataclasses.replace(found, tolerances=SIGMA[:, None] * np.array([-0.9, 1.05]))
    before, after = correct(LOADS, near, "C.square", {"D.d_y": ("-1 mm", "1 mm")}).outcomes
    for outcome in (before, after):
        z = mean + [0.0, 0.0, outcome.amounts[0] / SIGMA[2]]
        inside = np.diff(stats.norm.cdf((np.array([-0.9, 1.05]) - z[:, None]) / np.sqrt(np.diag(covariance))[:, None]))
        assert outcome.beyond == pytest.approx(1.0 - inside[:, 0], abs=0.03)
        assert outcome.beyond.max() <= outcome.any_beyond <= outcome.beyond.sum()
    assert before.beyond[0] > 0.1 and abs(after.beyond[2] - before.beyond[2]) > 0.1


def test_slopes_are_those_of_differences_and_searches_are_short(machine, monkeypatch):
    found, _, _ = machine
    read = _read(LOADS, found, "C.square", {**ADJUSTMENTS, "C.d_y": ("-1 mm", "1 mm")}, None, None)
    seen, amounts = np.arange(5), np.array([[1e-3, -2e-5, 3e-5]])
    mean, slopes = read.slopes(amounts, seen)
    np.testing.assert_allclose(read.means(amounts, seen), mean, rtol=1e-12)
    steps = np.diag([1e-6, 1e-7, 1e-7])
    differences = (read.means(amounts + steps, seen) - read.means(amounts - steps, seen)) / (2.0 * np.diag(steps))
    np.testing.assert_allclose(slopes[0], differences, rtol=1e-6)
    # A parabola is at its least after a few steps, if its slope belongs to its values.
    calls, of = [], type(read).slopes
    monkeypatch.setattr(type(read), "slopes", lambda self, *given: calls.append(1) or of(self, *given))
    correct(LOADS, found, "C.square", {"C.d_y": ("-1 mm", "1 mm")})
    assert 2 <= len(calls) <= 6


def test_samples_that_searches_see_are_as_frequent_as_probable():
    weights = np.array([0.1, 0.0, 0.5, 0.2, 0.2])
    chosen = _representatives(np.array([3.0, 1.0, np.nan, 2.0, 4.0]), weights, 50)
    assert np.bincount(chosen, minlength=5).tolist() == [10, 0, 0, 20, 20]  # of runs that succeeded


def test_amounts_stay_in_their_bounds(machine):
    found, mean, covariance = machine
    along, spread = WEIGHTS @ mean, WEIGHTS @ covariance @ WEIGHTS
    (_, one), most = correct(LOADS, found, "C.square", {"C.d_y": (-2e-5, 1e-5)}).outcomes, 2e-5
    assert one.amounts == pytest.approx([-most]) and along > 0.2
    assert one.mean == pytest.approx((along - 0.2) ** 2 + spread, rel=0.02)


def test_errors_that_are_held_fixed_count(machine):
    """A shim that is already there is a part of what is undone."""
    found, mean, _ = machine
    result = correct(LOADS, found, "C.square", {"C.d_y": ("-1 mm", "1 mm")}, at={"C.d_y": "0.03 mm"})
    assert result.best.amounts[0] == pytest.approx(-1e-4 * (WEIGHTS @ mean + 0.3), rel=0.05)
    without = correct(LOADS, found, "C.square", {"C.d_y": ("-1 mm", "1 mm")})
    assert without.best.amounts[0] - result.best.amounts[0] == pytest.approx(3e-5, rel=0.05)
    assert result.together is result.best and len(result.sentences()) == 1


@pytest.mark.long
def test_true_machines_keep_what_is_promised():
    """The metric of the true machine after the correction lies in the interval as often as that says."""
    rng, machines, level = np.random.default_rng(5), 120, 0.9
    kept = below = 0
    for seed in range(machines):
        z = rng.normal(size=3)
        found, _, _ = identified(z, seed, samples=128, confidence=level)
        result = correct(LOADS, found, "C.square", ADJUSTMENTS, quantile=0.8)
        assert result.status in ("ok", "no_gain"), str(result)
        errors = dict(zip(NAMES, SIGMA * z, strict=True))
        for name, amount in result.amounts(result.best).items():
            errors[name] += amount
        true = float(loads({**errors, "C.d_y": 0.0})["C.square"])
        kept += result.best.low <= true <= result.best.high
        below += true <= result.best.reached
    for count, part in ((kept, level), (below, 0.8)):
        low, high = stats.binom.ppf((5e-4, 1.0 - 5e-4), machines, part)
        assert low <= count <= high, (kept, below)


def test_what_is_in_doubt_is_no_promise(machine):
    found, _, _ = machine
    # Data that the model does not explain.
    misfit, _, _ = identified()
    wrong = identify(
        MACHINE,
        {"time_s": TIMES, "rate_rad_s": 3.0 * np.sin(40.0 * TIMES)},
        SENSOR,
        TOLERANCES,
        times=TIMES,
        samples=64,
    )
    assert wrong.status == "misfit"
    assert correct(LOADS, wrong, "C.square", ADJUSTMENTS).status == "doubtful"
    # Nothing helps.
    useless = correct(LOADS, found, "C.tilt", {"D.delta_x": (-0.01, 0.01)})
    assert useless.status == "no_gain" and not useless.sentences() and useless.best.mean == useless.before.mean
    assert useless.best.amounts == [0.0]
    assert misfit.status == "ok"

    def stuck(errors):
        values = loads(errors)
        return values, jnp.where(errors["C.d_y"] < errors["limit"], 1, 0)

    def with_limit(limit):
        function = lambda errors: stuck({**errors, "limit": limit})  # noqa: E731
        return FunctionProblem(function, (*NAMES, "C.d_y"), ("C.square", "C.tilt"), error_units=UNITS)

    # A mechanism that jams where the shim would be best: the search stays where it works.
    near = correct(with_limit(-2e-5), found, "C.square", {"C.d_y": ("-1 mm", "1 mm")})
    assert near.best.failed == 0.0 and -2e-5 <= near.best.amounts[0] < 0.0
    # One that works nowhere.
    never = correct(with_limit(1.0), found, "C.square", ADJUSTMENTS)
    assert never.status == "failed" and never.before.failed == pytest.approx(1.0) and "failed" in str(never)
    assert never.best is never.before


def test_results_are_shown_as_tables_and_arrays(machine):
    found, _, _ = machine
    result = correct(LOADS, found, "C.square", ADJUSTMENTS, limits={"C.square": 3.0})
    text = str(result)
    assert "The best single adjustment: " in text and "C.square is expected to be" in text
    assert "all together" in text and "C.square broken" in text
    data = result.to_xarray()
    assert data["amount"].dims == ("correction", "adjustment") and data["value"].shape == (4, len(found.weights))
    table = result.to_pandas()
    assert table.loc["D.d_y", "amount_D.d_y"] == result.outcomes[2].amounts[1]
    assert table.loc["as it is", "mean"] == result.before.mean
    assert result.amounts(result.before) == {} and set(result.amounts(result.together)) <= set(ADJUSTMENTS)


@pytest.mark.parametrize(
    "change, words",
    [
        ({"metric": "C.sqare"}, ("`metric`", "`C.sqare`", "C.square")),
        ({"adjustments": {}}, ("`adjustments`",)),
        ({"adjustments": {"C.d_q": (0, 1)}}, ("`adjustments`", "`C.d_q`")),
        ({"adjustments": {"C.d_y": (1e-4, 2e-4)}}, ("`adjustments`", "0 among them", "`C.d_y`")),
        ({"adjustments": {"C.d_y": (1e-4, 0.0)}}, ("`adjustments`", "rise")),
        ({"limits": {"C.angle": 1.0}}, ("`limits`", "`C.angle`")),
        ({"at": {"C.d_q": 1.0}}, ("`at`", "`C.d_q`")),
        ({"quantile": 1.0}, ("`quantile`",)),
        ({"points": 0}, ("`points`",)),
        ({"steps": 0}, ("`steps`",)),
    ],
)
def test_wrong_arguments_are_refused_in_a_sentence(change, words, machine, refused):
    arguments = {"metric": "C.square", "adjustments": ADJUSTMENTS} | change
    with refused(*words):
        correct(LOADS, machine[0], **arguments)


def test_an_identification_without_a_posterior_is_refused(machine, refused):
    nothing = identify(
        FunctionProblem(lambda errors: (measured(errors), 1), NAMES, ("rate_rad_s",), error_units=MEASURED_UNITS),
        {"time_s": TIMES, "rate_rad_s": TIMES}, SENSOR, TOLERANCES, times=TIMES, starts=1, samples=16,
    )  # fmt: skip
    with refused("`found`", "posterior", "failed"):
        correct(LOADS, nothing, "C.square", ADJUSTMENTS)
    with refused("`found`", "`D.delta_x`"):
        correct(
            FunctionProblem(loads, ("C.d_y",), ("C.square",), error_units={"C.d_y": "m"}),
            machine[0],
            "C.square",
            {"C.d_y": (0, 1)},
        )


def test_shims_come_in_packs(machine, refused):
    """The multiple of the pack that is next to the best amount, on the side where the parabola is lower."""
    found, mean, covariance = machine
    pack = 1.6e-4
    free = correct(LOADS, found, "C.square", ADJUSTMENTS)
    packed = correct(LOADS, found, "C.square", ADJUSTMENTS, multiples_of={"D.d_y": "0.16 mm"})
    (_, tilt, shift, _), (_, same, packs, both) = free.outcomes, packed.outcomes
    assert tilt.amounts == pytest.approx(same.amounts) and packed.status == "ok"
    count = packs.amounts[1] / pack
    assert count == pytest.approx(round(count), abs=1e-9) and count == round(shift.amounts[1] / pack) != 0
    left = WEIGHTS @ mean + WEIGHTS[2] * packs.amounts[1] / SIGMA[2]
    assert packs.mean == pytest.approx(left**2 + WEIGHTS @ covariance @ WEIGHTS, rel=0.03)
    assert packs.mean > shift.mean and both.amounts[1] / pack == pytest.approx(round(both.amounts[1] / pack), abs=1e-9)
    for multiples, words in (
        ({"D.delta_z": 1e-3}, ("`multiples_of`", "`D.delta_z`")), ({"D.d_y": 0.0}, ("`multiples_of`", "positive")),
        ({"D.d_y": "1 deg"}, ("`multiples_of`", "1 deg")),
    ):  # fmt: skip
        with refused(*words):
            correct(LOADS, found, "C.square", ADJUSTMENTS, multiples_of=multiples)
