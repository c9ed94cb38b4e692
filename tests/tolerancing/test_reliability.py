"""Rare failures: FORM and importance sampling against exact probabilities of linear and quadratic limit states."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import integrate, stats

from rfem_jax import (
    CorrelatedNormal,
    FunctionProblem,
    InputError,
    Metric,
    Normal,
    Tolerances,
    Uniform,
    Zone,
    monte_carlo,
    reliability,
)
from rfem_jax.tolerancing.rare_failures.importance import Normal as Shifted
from rfem_jax.tolerancing.rare_failures.importance import Shell, Stretched, estimate_probability, mixture_of

jax.config.update("jax_enable_x64", True)

KEY = jax.random.key(11)
SIGMA = {"a": 0.1, "b": 0.2, "c": 0.05}
NORMALS = Tolerances({name: Normal(3.0 * sigma) for name, sigma in SIGMA.items()})


def f(e):
    a, b, c = (e[name] / sigma for name, sigma in SIGMA.items())
    return {
        "linear": 3.0 * a - 2.0 * b + 6.0 * c + 1.0,
        "curved": b + 0.2 * a**2,  # fails by b, sooner at large a
        "even": 4.0 * a**2 + b**2,
        "flat": 0.0 * a,
    }


METRICS = (Metric("linear", "N"), "curved", "even", "flat")
PROBLEM = FunctionProblem(f, tuple(SIGMA), METRICS)


def curved_tail(limit):
    """P(b + 0.2 a^2 > limit) by quadrature over a."""
    return integrate.quad(lambda a: stats.norm.pdf(a) * stats.norm.sf(limit - 0.2 * a**2), -12, 12, points=[0.0])[0]


def even_tail(limit):
    """P(4 a^2 + b^2 > limit) by quadrature over b."""
    edge = np.sqrt(limit)
    inner = integrate.quad(
        lambda b: stats.norm.pdf(b) * 2.0 * stats.norm.sf(0.5 * np.sqrt(max(limit - b**2, 0.0))), 0.0, edge
    )
    return 2.0 * (inner[0] + stats.norm.sf(edge))


LIMITS = {"linear": (None, 1.0 + 7.0 * 5.0), "curved": 5.0, "even": 100.0}
EXACT = {"linear": stats.norm.sf(5.0), "curved": curved_tail(5.0), "even": even_tail(100.0)}


@pytest.fixture(scope="module")
def study():
    return reliability(PROBLEM, NORMALS, LIMITS, KEY, n=4000)


@pytest.mark.long
def test_a_linear_limit_state_has_its_exact_index(study):
    linear = study.limits[0]
    assert (linear.metric, linear.side, linear.unit, linear.status) == ("linear", "upper", "N", "ok")
    assert linear.beta == pytest.approx(5.0, rel=1e-6)  # |(3, -2, 6)| = 7
    assert linear.first_order == pytest.approx(EXACT["linear"], rel=1e-5)
    expected = {"a": 5.0 * 3 / 7 * 0.1, "b": -5.0 * 2 / 7 * 0.2, "c": 5.0 * 6 / 7 * 0.05}
    assert linear.errors == pytest.approx(expected, rel=1e-3)
    assert linear.shares == pytest.approx({"a": 9 / 49, "b": 4 / 49, "c": 36 / 49}, rel=1e-6)
    assert linear.nominal == pytest.approx(1.0)


@pytest.mark.parametrize("index", range(3))
def test_importance_sampling_sees_what_is_rarer_than_a_millionth(study, index):
    found = study.limits[index]
    exact = EXACT[found.metric]
    assert exact < 2e-5
    assert found.probability.low < exact < found.probability.high
    assert found.probability.high - found.probability.low < 0.5 * exact
    assert abs(found.probability.value - exact) < 0.15 * exact


def test_what_an_even_load_has_on_both_sides(study):
    even = study.limits[2]
    assert len(even.points) == 2
    np.testing.assert_allclose(np.abs(even.points[:, 0]), 5.0, rtol=1e-4)
    assert np.prod(even.points[:, 0]) < 0.0
    assert even.first_order == pytest.approx(2.0 * stats.norm.sf(5.0), rel=1e-3)


def test_first_order_is_off_where_the_limit_is_curved(study):
    """The reason for sampling: FORM takes the tangent plane for the limit."""
    curved = study.limits[1]
    nearest = min(
        (np.hypot(a, 5.0 - 0.2 * a**2), a) for a in np.linspace(0.0, 6.0, 60001)
    )  # a point of the limit b = 5 - a^2/5
    assert curved.beta == pytest.approx(nearest[0], rel=1e-6)
    assert abs(curved.first_order - EXACT["curved"]) > 0.2 * EXACT["curved"]


def test_all_limits_together(study):
    total = sum(one.probability.value for one in study.limits)
    assert max(one.probability.value for one in study.limits) <= study.any_limit.value <= total
    text = str(study)
    assert "any limit" in text and "linear <= 36 N" in text and "Yield of all limits: 0.9999" in text
    assert {row["metric"] for row in study.rows()} == {"linear", "curved", "even"} and "a_rad" in study.rows()[0]


def test_intervals_cover():
    """Of 300 intervals of 95 % about as many hold the exact probability."""
    limit = 4.0
    points = np.array([[4.0, 0.0], [0.0, 4.0], [-4.0, 0.0]])  # of x > 4, y > 4 and one that is none
    exact = 1.0 - stats.norm.cdf(limit) ** 2
    mixture = mixture_of([[(Shifted(point), 1.0) for point in points]], 400, 2)
    held = 0
    for seed in range(300):
        w = mixture.samples(np.random.default_rng(seed), 2)
        found = estimate_probability(mixture, mixture.weights(w), np.any(w > limit, axis=1))
        held += found.low <= exact <= found.high
    assert 270 <= held <= 298


def test_weights_are_the_ratio_of_the_densities():
    """By histograms of the samples of each component: a fifth of them and more in every cell that is compared."""
    angle = 0.3
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    components = [
        Shifted(np.array([1.5, 1.0])),
        Shell(turn[:, :1], 1.2),
        Shell(turn, 1.8),
        Stretched(turn, np.array([2.0, 1.3])),
    ]
    edges = np.linspace(-2.5, 2.5, 11)
    middles = np.stack(np.meshgrid(edges[:-1], edges[:-1], indexing="ij"), axis=-1).reshape(-1, 2) + 0.25
    for component in components:
        w = component.place(np.random.default_rng(1).standard_normal((200_000, 2)))
        counts = np.histogram2d(*w.T, bins=[edges, edges])[0].ravel()
        fine = middles[:, None] + np.stack(np.meshgrid(*[(np.arange(20) + 0.5) / 40 - 0.25] * 2), axis=-1).reshape(
            1, -1, 2
        )
        density = (
            np.exp(component.log_ratio(fine.reshape(-1, 2))) * stats.multivariate_normal(np.zeros(2)).pdf(fine).ravel()
        )
        expected = 200_000 * 0.25 * density.reshape(len(middles), -1).mean(axis=1)
        enough = expected > 50.0
        assert np.sum(enough) > 25
        np.testing.assert_allclose(counts[enough], expected[enough], atol=6.0 * np.sqrt(expected[enough].max()))
        assert np.all(np.abs(counts - expected)[enough] < 5.0 * np.sqrt(expected[enough]) + 0.01 * expected[enough])


def test_no_weight_is_large():
    mixture = mixture_of([[(Shifted(np.array([3.0, 1.0])), 1.0)], [], [(Shifted(np.array([-2.0, 0.0])), 1.0)]], 1000, 2)
    w = mixture.samples(np.random.default_rng(0), 2)
    assert np.max(mixture.weights(w)) <= 1.0 / mixture.shares[0] and len(w) == 1000
    assert mixture.shares[0] == pytest.approx(0.4)  # a tenth, and all of the limit that is broken often
    assert np.mean(mixture.weights(w)) == pytest.approx(1.0, abs=0.1)


@pytest.mark.long
def test_plain_monte_carlo_sees_the_same_where_it_can():
    """Uniform errors, correlated ones and a zone, a probability of some per cent."""
    tolerances = Tolerances(
        {"a": Uniform(0.2)},
        correlated=CorrelatedNormal(("b", "c"), [[0.04, 0.006], [0.006, 0.0025]]),
        zones=Zone(("x", "z"), 0.1 * np.eye(2), (2,)),
    )

    def g(e):
        return {"g": e["a"] + e["b"] + 2.0 * e["c"] + jnp.sin(8.0 * e["x"]) + 20.0 * e["z"] ** 2}

    problem = FunctionProblem(g, tolerances.names, "g")
    limits = {"g": (-1.2, 1.0)}
    plain = monte_carlo(problem, tolerances, 16384, KEY, limits=limits)
    found = reliability(problem, tolerances, limits, KEY, n=2000, level_samples=100)
    expected = 1.0 - plain.yields["g"].of_all.value
    assert 0.01 < expected < 0.1
    assert found.any_limit.low < expected < found.any_limit.high
    assert {one.side for one in found.limits} == {"upper", "lower"}
    assert set(found.limits[0].shares) == {"a", "b+c", "x+z"}
    assert sum(found.limits[0].shares.values()) == pytest.approx(1.0)


@pytest.mark.long
def test_a_limit_that_the_tolerances_cannot_reach_is_said_to_be_so():
    tolerances = Tolerances({name: Uniform(0.1) for name in SIGMA})
    found = reliability(PROBLEM, tolerances, {"linear": 1000.0, "flat": 1.0}, KEY, n=500)
    assert [one.status for one in found.limits] == ["not_reached", "not_reached"] and found.status == "ok"
    assert found.any_limit.value == 0.0
    assert found.any_limit.high == pytest.approx(1.0 - 0.025 ** (1.0 / 500), rel=1e-9)
    assert "no errors were found that break the limit" in str(found)


def test_a_mechanism_that_breaks_its_limit_as_drawn_has_a_negative_index():
    found = reliability(PROBLEM, NORMALS, {"linear": -6.0}, KEY, n=4000).limits[0]
    assert found.beta == pytest.approx(-1.0, rel=1e-4)
    assert found.first_order == pytest.approx(stats.norm.cdf(1.0), rel=1e-4)
    assert found.probability.low < stats.norm.cdf(1.0) < found.probability.high


def test_failed_simulations_count_as_broken_limits():
    def g(e):
        return {"g": e["a"]}, jnp.where(e["a"] > 0.3, 7, 0)

    found = reliability(FunctionProblem(g, ("a",), "g"), Tolerances({"a": Normal(0.3)}), {"g": 0.9}, KEY, n=2000)
    assert found.failed > 0
    assert found.any_limit.low <= stats.norm.sf(3.0) <= found.any_limit.high


@pytest.mark.parametrize(
    ("limits", "settings", "word"),
    [
        ({}, {}, "`limits`"),
        ({"linear": (None, None)}, {}, "finite end"),
        ({"linnear": 1.0}, {}, "linear"),
        ({"linear": 1.0}, {"n": 10}, "`n`"),
        ({"linear": 1.0}, {"confidence": 2.0}, "`confidence`"),
    ],
)
def test_bad_requests_are_refused(limits, settings, word):
    with pytest.raises(InputError, match=word):
        reliability(PROBLEM, NORMALS, limits, KEY, **settings)
