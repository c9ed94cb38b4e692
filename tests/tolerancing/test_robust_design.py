"""Dimensions and tolerances found together, against closed forms."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.scipy.stats import norm

from rfem_jax import FunctionProblem, InputError, Metric, Reciprocal, ReciprocalSquared, optimise, pareto_front
from rfem_jax.tolerancing.problems.kept_evaluations import kept_in

KEY = jax.random.key(7)

# A steel cantilever under a load at its tip: width b and height h of the section are to be found.
LENGTH, LOAD, MODULUS, DENSITY = 0.5, 200.0, 210e9, 7850.0
WIDTH, HEIGHT = 0.02, 0.02  # of the description


def cantilever(errors):
    width, height = WIDTH + errors["bar.width"], HEIGHT + errors["bar.height"]
    length = LENGTH + errors["bar.length"]
    return {
        "mass": DENSITY * width * height * length,
        "deflection": LOAD * length**3 / (3.0 * MODULUS * width * height**3 / 12.0),
        "stress": 6.0 * LOAD * length / (width * height**2),
    }


class Beam(FunctionProblem):
    """The cantilever, whose parameters have values."""

    def fingerprint(self):
        return "beam"

    def nominal_value(self, name):
        return {"bar.width": WIDTH, "bar.height": HEIGHT}.get(name, 0.0)


METRICS = (Metric("mass", "kg"), Metric("deflection", "m"), Metric("stress", "N/m^2"))
NAMES = ("bar.width", "bar.height", "bar.length")
UNITS = dict.fromkeys(NAMES, "m")
WIDTHS = {"a": (0.01, 1.0), "b": (0.01, 1.0)}  # of the gap
DESIGNS = {"bar.width": ("5 mm", "40 mm"), "bar.height": (0.005, 0.06)}


@pytest.fixture(scope="module")
def beam():
    return Beam(cantilever, NAMES, METRICS, error_units=UNITS)


def test_least_mass_under_a_limit_of_deflection(beam):
    # The deflection is least for a given area where the section is as high and as narrow as it may be.
    limit = 2e-3
    found = optimise(beam, DESIGNS, None, "mass", {"deflection": limit}, robust="nominal", key=KEY)
    height = (4.0 * LOAD * LENGTH**3 / (MODULUS * 0.005 * limit)) ** (1 / 3)
    assert found.status == "ok" and found.at_bounds == {"bar.width": "smallest"}
    assert found.designs["bar.height"] == pytest.approx(height, rel=1e-6)
    assert found.objective == pytest.approx(DENSITY * 0.005 * height * LENGTH, rel=1e-6)
    assert found.kkt_residual < 1e-6
    (check,) = found.limits
    assert check.verified == pytest.approx(limit, rel=1e-6)
    # d mass / d limit = -mass / (3 limit).
    assert check.shadow_price == pytest.approx(-found.objective / (3.0 * limit), rel=1e-5)


def linear(errors):
    # A gap that a dimension opens and two errors close, the first of them the more the larger the dimension is.
    d = errors["d"]
    return {"gap": 2.0 * d + (1.0 + d) * errors["a"] + 3.0 * errors["b"], "size": 1.0 + d}


@pytest.fixture(scope="module")
def gap():
    return FunctionProblem(linear, ("d", "a", "b"), ("gap", "size"), error_units=dict.fromkeys("dab", "m"))


def test_worst_case_of_a_linear_limit_is_that_of_its_corner(gap):
    # gap >= 0 in the worst case: 2 d = (1 + d) t_a + 3 t_b, at least cost 1/t_a + 1/t_b beside the size.
    found = optimise(
        gap, {"d": (0.05, 1.5)}, WIDTHS, {"size": 1.0, "cost": 0.05}, {"gap": (0.0, None)},
        robust="worst_case", cost=Reciprocal(), key=KEY,
    )  # fmt: skip
    d = np.linspace(0.05, 1.5, 200001)
    # For given d the cheapest tolerances have w_i t_i^2 equal, w the influences: t_i = s / sqrt(w_i).
    roots = np.sqrt(1.0 + d) + np.sqrt(3.0)
    best = np.min(1.0 + d + 0.05 * roots**2 / (2.0 * d))
    at = d[np.argmin(1.0 + d + 0.05 * roots**2 / (2.0 * d))]
    assert found.status == "ok"
    assert found.objective == pytest.approx(best, rel=1e-7)
    assert found.designs["d"] == pytest.approx(at, abs=1e-4)
    scale = 2.0 * at / (np.sqrt(1.0 + at) + np.sqrt(3.0))
    assert found.tolerances["a"] == pytest.approx(scale / np.sqrt(1.0 + at), rel=1e-3)
    assert found.tolerances["b"] == pytest.approx(scale / np.sqrt(3.0), rel=1e-3)
    assert found.limits[0].verified == pytest.approx(0.0, abs=1e-6)


def test_worst_cases_of_two_limits():
    # 0.3 + d + t_a <= 1 and t_b - d <= 1 at least cost 1/t_a + 1/t_b: the same tolerances on both sides.
    def both(errors):
        return {"right": 0.3 + errors["d"] + errors["a"], "left": errors["b"] - errors["d"]}

    pair = FunctionProblem(both, ("d", "a", "b"), ("right", "left"), error_units=dict.fromkeys("dab", "m"))
    found = optimise(
        pair, {"d": (-0.5, 0.5)}, {"a": (0.01, 2.0), "b": (0.01, 2.0)}, "cost", {"right": 1.0, "left": 1.0},
        robust="worst_case", cost=Reciprocal(), key=KEY,
    )  # fmt: skip
    assert found.status == "ok" and found.designs["d"] == pytest.approx(-0.15, abs=1e-5)
    assert list(found.tolerances.values()) == pytest.approx([0.85, 0.85], abs=1e-5)


def test_two_limits_may_be_worst_at_one_corner():
    # 0.3 + d + t <= 1 and t - d <= 1, both worst where a is largest.
    def both(errors):
        return {"right": 0.3 + errors["d"] + errors["a"], "left": errors["a"] - errors["d"]}

    pair = FunctionProblem(both, ("d", "a"), ("right", "left"), error_units=dict.fromkeys("da", "m"))
    found = optimise(
        pair, {"d": (-0.5, 0.5)}, {"a": (0.01, 2.0)}, "cost", {"right": 1.0, "left": 1.0}, robust="worst_case",
        cost=Reciprocal(), key=KEY,
    )  # fmt: skip
    assert found.status == "ok" and found.designs["d"] == pytest.approx(-0.15, abs=1e-5)
    assert found.tolerances["a"] == pytest.approx(0.85, abs=1e-5)


@pytest.mark.long
def test_root_sum_of_squares_of_a_linear_limit(gap):
    # Squared reciprocal costs: mean - c deviations of the sample itself, so the optimum is compared with a fine search
    # over d of the closed form for the sample's own second moments.
    found = optimise(
        gap, {"d": (0.05, 1.5)}, WIDTHS, {"size": 1.0, "cost": 0.02}, {"gap": (0.0, None)},
        robust="rss", coverage=2.0, cost=ReciprocalSquared(), samples=4096, key=KEY,
    )  # fmt: skip
    d = np.linspace(0.05, 1.5, 200001)
    # sum (w_i t_i)^2 = (2 d / c)^2 (Normal: the half-width is 3 deviations), cheapest with w_i t_i^2 equal.
    allowed = (3.0 * 2.0 * d / 2.0) ** 2
    total = 1.0 + d + 0.02 * (1.0 + d + 3.0) ** 2 / allowed
    assert found.status == "ok"
    assert found.objective == pytest.approx(np.min(total), rel=2e-3)
    assert found.designs["d"] == pytest.approx(d[np.argmin(total)], rel=1e-2)
    assert abs(found.limits[0].verified) < 0.02


@pytest.mark.long
def test_yield_of_a_linear_limit(gap):
    # One normal error: the yield is known; d is found such that the fraction 0.95 keeps the limit.
    found = optimise(
        gap, {"d": (0.05, 1.5)}, {"b": 0.3}, "size", {"gap": (0.0, None)}, robust="yield", target=0.95, samples=1024,
        key=KEY,
    )  # fmt: skip
    exact = 1.6448536269514722 * 0.1 * 3.0 / 2.0
    assert found.status == "ok"
    assert found.designs["d"] == pytest.approx(exact, rel=2e-2)
    assert found.yield_interval[0] - 1e-3 <= float(norm.cdf(found.designs["d"] * 2.0 / 0.3)) <= found.yield_interval[1]


def test_an_infeasible_request_names_the_limit_in_the_way(beam):
    limits = {"mass": 0.5, "deflection": 5e-5}
    found = optimise(beam, DESIGNS, None, "mass", limits, robust="nominal", key=KEY)
    assert found.status == "infeasible"
    # The nearest design misses both by the same share, the least that is possible.
    mass, deflection = (check.verified / check.limit for check in found.limits)
    assert mass == pytest.approx(deflection, rel=1e-3) and mass > 1.0
    # Both meet where mass / 0.5 kg = 4 F L^3 / (E b h^3) / 0.05 mm, at the largest height.
    width = np.sqrt(4.0 * LOAD * LENGTH**3 / (MODULUS * 0.06**3) / 5e-5 * 0.5 / (DENSITY * 0.06 * LENGTH))
    assert found.designs["bar.width"] == pytest.approx(width, rel=1e-5)
    assert "on mass" in found.message and "on deflection" in found.message
    reached = re.search(r"reaches (\S+) kg and (\S+) m;", found.message)
    expected = (DENSITY * width * 0.06 * LENGTH, mass * 5e-5)
    assert reached is not None and tuple(map(float, reached.groups())) == pytest.approx(expected, rel=1e-4)


def test_an_infeasible_worst_case_comes_as_near_as_it_can():
    def both(errors):
        return {"right": 0.3 + errors["d"] + errors["a"], "left": 0.6 + errors["b"] - errors["d"]}

    pair = FunctionProblem(both, ("d", "a", "b"), ("right", "left"), error_units=dict.fromkeys("dab", "m"))
    found = optimise(
        pair,
        {"d": (-0.5, 0.5)},
        {"a": 0.6, "b": 0.6},
        "left",
        {"right": 0.5, "left": 0.5},
        robust="worst_case",
        key=KEY,
    )
    # 0.9 + d - 0.5 = 1.2 - d - 0.5 at d = 0.15.
    assert found.status == "infeasible" and found.designs["d"] == pytest.approx(0.15, abs=1e-6)
    assert [check.predicted for check in found.limits] == pytest.approx([1.05, 1.05], abs=1e-6)
    assert "on right" in found.message and "on left" in found.message


def test_a_dimension_may_scatter_too(beam):
    # Thinner than its nominal height in the worst case: the height found is larger by the tolerance.
    without = optimise(beam, DESIGNS, None, "mass", {"deflection": 2e-3}, robust="nominal", key=KEY)
    found = optimise(
        beam, DESIGNS, {"bar.height": "0.2 mm"}, "mass", {"deflection": 2e-3}, robust="worst_case", key=KEY
    )
    assert found.status == "ok"
    assert found.designs["bar.height"] - without.designs["bar.height"] == pytest.approx(2e-4, rel=1e-5)


def test_an_interrupted_search_continues(beam, tmp_path):
    told = []

    def interrupt(count):
        told.append(count)
        if len(told) == 5:
            raise KeyboardInterrupt

    def find(progress=None):
        return optimise(beam, DESIGNS, None, "mass", {"deflection": 2e-3}, robust="nominal", key=KEY, progress=progress)

    whole = find()
    with pytest.raises(KeyboardInterrupt), kept_in(tmp_path / "kept"):
        find(interrupt)
    with kept_in(tmp_path / "kept") as kept:
        again = find()
    assert told == sorted(told) and kept.read == 5 < kept.count
    assert again.designs == whole.designs and again.history == whole.history


@pytest.mark.parametrize(
    ("arguments", "pieces"),
    [
        (({"bar.hight": (0.1, 0.2)}, None, "mass"), ("`designs`", "bar.height")),
        (({"bar.height": (0.2, 0.1)}, None, "mass"), ("`designs`", "bar.height")),
        ((DESIGNS, None, "weight"), ("`objective`", "weight")),
        ((DESIGNS, None, "cost"), ("`objective`", "tolerance")),
        ((DESIGNS, {"bar.length": (1e-4, 1e-3)}, "mass"), ("`cost`", "bar.length")),
        ((DESIGNS, {"bar.length": -1e-4}, "mass"), ("`tolerances`", "positive")),
        ((DESIGNS, None, {"mass": -1.0}), ("`objective`", "negative")),
        (({}, None, "mass"), ("`designs`",)),
    ],
)
def test_what_is_wrong_is_refused_in_one_sentence(beam, arguments, pieces):
    with pytest.raises(InputError) as refused:
        optimise(beam, *arguments, {"deflection": 1e-3}, robust="nominal", key=KEY)
    text = str(refused.value)
    assert all(piece in text for piece in pieces) and text.count("\n") == 0


@pytest.mark.slow
def test_a_failed_sample_is_left_out(gap):
    def failing(errors):
        values = linear(errors)
        return values, jnp.where(errors["b"] > 0.25, 3, 0)

    problem = FunctionProblem(failing, ("d", "a", "b"), ("gap", "size"), error_units=dict.fromkeys("dab", "m"))
    found = optimise(
        problem, {"d": (0.05, 1.5)}, {"b": 0.3}, "size", {"gap": (0.0, None)}, robust="yield", target=0.9, samples=512,
        key=KEY,
    )  # fmt: skip
    assert found.failed > 0 and found.status == "ok"
    # Of the normal error 0.62 % lie beyond 2.5 deviations and fail, which leaves as much less to miss the limit.
    exact = -norm.ppf(0.1 - float(norm.cdf(-2.5))) * 0.1 * 3.0 / 2.0
    assert found.designs["d"] == pytest.approx(float(exact), rel=3e-2)


def test_front_of_two_objectives():
    # f = (x - 1)^2 + 1, g = (x + 1)^2 + 1: with weights w the best x is where (1 - w)/f0 (x - 1) + w/g0 (x + 1) = 0.
    def function(errors):
        return {"f": (errors["x"] - 1.0) ** 2 + 1.0, "g": (errors["x"] + 1.0) ** 2 + 1.0}

    problem = FunctionProblem(function, ("x",), ("f", "g"), error_units={"x": "m"})

    def solve(weights):
        return optimise(problem, {"x": (-2.0, 2.0)}, None, weights, robust="nominal", starts=1, key=KEY)

    front = pareto_front(solve, ("f", "g"), (0.0, 0.3, 1.0))
    for weight, answer in front.items():  # the terms are equal at x = 0, with even weights
        assert answer.designs["x"] == pytest.approx(1.0 - 2.0 * weight, abs=1e-6)
    assert [one.terms["f"] for one in front.values()] == sorted(one.terms["f"] for one in front.values())
    with pytest.raises(InputError, match="two different terms"):
        pareto_front(solve, ("f", "f"))


@pytest.mark.parametrize("robust", ["nominal", "worst_case", "rss", "yield"])
def test_an_objective_without_limits(robust):
    """Nothing holds the tolerance back, and the dimension is where the metric is least."""
    problem = FunctionProblem(lambda errors: {"square": 3.0 + 2.0 * (errors["a"] - 0.1) ** 2}, ("a", "b"), "square")
    found = optimise(
        problem, {"a": (-0.5, 1.0)}, {"b": (0.01, 2.0)}, {"square": 1.0, "cost": 0.1}, robust=robust,
        cost=Reciprocal(1.0), key=jax.random.key(1),
    )  # fmt: skip
    assert found.status == "ok" and found.designs["a"] == pytest.approx(0.1, abs=1e-6)
    assert found.tolerances["b"] == pytest.approx(2.0)
