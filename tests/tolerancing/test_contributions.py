"""Contributions to the variance: closed forms, and Sobol' indices from samples of the same quadratic."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from rfem_jax import (
    CorrelatedNormal,
    FunctionProblem,
    Normal,
    ProcessNormal,
    Tolerances,
    Triangular,
    TruncatedNormal,
    Uniform,
    Zone,
    monte_carlo,
    sensitivity,
)
from rfem_jax.tolerancing.contributions import _moments

jax.config.update("jax_enable_x64", True)

TOLERANCES = Tolerances(
    {"a": Uniform(1.0), "b": ProcessNormal(0.6, cp=1.0, cpk=0.5), "t": Triangular(0.8)},
    correlated=CorrelatedNormal(("p", "q"), [[0.09, 0.03], [0.03, 0.04]]),
    zones=Zone(
        ("x", "z", "u", "v"), [[0.3, 0, 0.3, 0], [0, 0.3, 0, 0.3], [0, 0.4, 0, -0.4], [-0.4, 0, 0.4, 0]], (2, 2)
    ),
)
HESSIAN = np.random.default_rng(8).normal(size=(9, 9))
HESSIAN = HESSIAN + HESSIAN.T
GRADIENT = np.random.default_rng(9).normal(size=9)


def f(e):
    x = jnp.stack([e[name] for name in TOLERANCES.names])
    quadratic = x @ jnp.asarray(GRADIENT) + 0.5 * x @ jnp.asarray(HESSIAN) @ x
    return {"quadratic": quadratic, "linear": 3.0 * x[0] - 2.0 * x[2], "none": 0.0 * x[0]}


PROBLEM = FunctionProblem(f, TOLERANCES.names, ("quadratic", "linear", "none"))


@pytest.fixture(scope="module")
def found():
    return sensitivity(PROBLEM, scale=TOLERANCES)


def test_a_linear_metric_has_its_variances(found):
    first, second = 9.0 / 3.0, 4.0 * 0.64 / 6.0
    expected = np.array([first, 0.0, second, 0.0, 0.0]) / (first + second)
    for parts in (found.shares.linear, found.shares.first_order, found.shares.total):
        np.testing.assert_allclose(parts[1], expected, atol=1e-12)
    assert found.shares.std[1] == pytest.approx(np.sqrt(first + second))
    assert np.all(np.isnan(found.shares.total[2])) and found.shares.std[2] == 0.0


@pytest.mark.long
def test_the_shares_of_a_quadratic_are_its_sobol_indices(found):
    samples = monte_carlo(PROBLEM, TOLERANCES, 4096, jax.random.key(1), sobol_indices=True, batch=4096)
    indices = samples.sobol_indices["quadratic"]
    assert samples.statistics["quadratic"].std.value == pytest.approx(found.shares.std[0], rel=0.02)
    np.testing.assert_allclose([i.value for i in indices.first_order.values()], found.shares.first_order[0], atol=0.02)
    np.testing.assert_allclose([i.value for i in indices.total.values()], found.shares.total[0], atol=0.02)
    total, first = found.shares.total[0], found.shares.first_order[0]
    assert np.all(total >= first) and np.sum(total) > 1.2 and np.sum(first) < 0.9


def test_gradients_of_rounding_are_no_first_order_effect():
    """A metric that is even, but for rounding, and one on which no error has an effect."""

    def even(e):
        x, y = e["x"], e["y"]
        return {"even": 5.0 + 1e-17 * x + 3e-18 * y + 2.0 * x**2 + y**2, "same": 7.0 + 1e-16 * x, "slight": 1e-7 * x}

    problem = FunctionProblem(even, ("x", "y"), ("even", "same", "slight"))
    found = sensitivity(problem, scale=Tolerances({"x": Uniform(1e-2), "y": Uniform(1e-2)}))
    assert np.all(np.isnan(found.shares.linear[:2])) and np.all(np.isnan(found.shares.total[1]))
    np.testing.assert_allclose(found.shares.total[0], [0.8, 0.2], rtol=1e-6)  # squares of 2 and 1
    np.testing.assert_allclose(found.shares.linear[2], [1.0, 0.0])
    assert "No first-order effect on even, same: all gradients vanish." in found.shares_table()


def test_tables_have_percent(found):
    rows = [row for row in found.rows() if row["metric"] == "linear"]
    by_error = {row["error"]: row for row in rows}
    assert by_error["a"]["variance_total_percent"] == pytest.approx(100 * 3.0 / (3.0 + 4.0 * 0.64 / 6.0))
    assert by_error["p"]["factor"] == "p+q" and by_error["v"]["factor"] == "x+z+u+v"
    assert "Contributions to the variance in percent" in found.shares_table()


def test_without_distributions_or_second_derivatives(found):
    assert sensitivity(PROBLEM, order=1, scale=dict.fromkeys(TOLERANCES.names, 1.0)).shares is None
    some = sensitivity(PROBLEM, order=1, scale=TOLERANCES)
    np.testing.assert_allclose(some.shares.linear[1], found.shares.linear[1])
    assert np.all(np.isnan(some.shares.total))


@pytest.mark.parametrize(
    ("tolerance", "kurtosis"),
    [
        (Uniform(0.2), 1.8),
        (Triangular(interval=(0.0, 1.0)), 2.4),
        (Normal(0.1), 3.0),
        (TruncatedNormal(1.0), 3.0 + stats.truncnorm(-3, 3).stats("k")),
    ],
)
def test_fourth_moments(tolerance, kurtosis):
    assert 3.0 * _moments(tolerance)[1] == pytest.approx(kurtosis, rel=2e-5)


@pytest.mark.slow
def test_the_square_of_a_distance_within_a_disc():
    """r^2 is uniform in 0 ... R^2 for a point of a disc, and its deviation R^2/sqrt(12)."""
    problem = FunctionProblem(lambda e: {"f": e["x"] ** 2 + e["z"] ** 2 + e["a"] ** 2}, ("x", "z", "a"), "f")
    tolerances = Tolerances({"a": Uniform(0.3)}, zones=Zone(("x", "z"), 0.5 * np.eye(2), (2,)))
    shares = sensitivity(problem, scale=tolerances).shares
    disc, alone = 0.5**4 / 12.0, 0.3**4 * (1 / 5 - 1 / 9)
    assert shares.std[0] == pytest.approx(np.sqrt(disc + alone), rel=1e-9)
    np.testing.assert_allclose(shares.total[0], np.array([alone, disc]) / (disc + alone), rtol=1e-8)
