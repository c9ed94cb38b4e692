"""Allocations of closed-form problems: cheapest tolerances, verified, feasible or not."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from rfem_jax import Exponential, FunctionProblem, InputError, Reciprocal, ReciprocalSquared, Uniform, allocate
from rfem_jax.tolerancing.optimisation.augmented_lagrangian import minimise
from rfem_jax.tolerancing.robust_design.cost_models import assign_costs, total_cost
from rfem_jax.tolerancing.robust_design.models import Moments, Quadratic, quantile_weights
from rfem_jax.tolerancing.robust_design.optimisation import _price

jax.config.update("jax_enable_x64", True)

KEY = jax.random.key(5)
GRADIENT = np.array([1.0, 4.0, 0.5])
FACTORS = np.array([1.0, 0.3, 2.0])
COSTS = {f"e{i}": Reciprocal(factor) for i, factor in enumerate(FACTORS)}


def make(functions, k):
    """A problem of metrics {name: function of the vector of k errors}."""
    names = tuple(f"e{i}" for i in range(k))

    def evaluate(errors):
        x = jnp.stack([errors[n] for n in names])
        return {name: function(x) for name, function in functions.items()}

    return FunctionProblem(evaluate, names, tuple(functions))


def linear(k=3, gradient=GRADIENT):
    return make({"f": lambda x: 1.0 + jnp.asarray(gradient) @ x}, k)


def bounds(k, low=1e-3, high=10.0):
    return {f"e{i}": (low, high) for i in range(k)}


def found(result):
    return np.array(list(result.tolerances.values()))


LINEAR = linear()
SQUARE = make({"f": lambda x: x[0] ** 2}, 1)
UNIFORM = {"distribution": Uniform, "samples": 256}


@pytest.mark.long
def test_rss_of_a_linear_metric_is_the_closed_form():
    result = allocate(LINEAR, {"f": 2.0}, COSTS, bounds(3), "rss", key=KEY, samples=128)
    exact = (FACTORS / GRADIENT**2) ** (1 / 3)
    exact /= np.linalg.norm(GRADIENT * exact)
    np.testing.assert_allclose(found(result), exact, rtol=1e-6)
    assert result.status == "ok" and result.cost == pytest.approx(np.sum(FACTORS / exact), rel=1e-6)
    check = result.limits[0]
    assert 0 <= check.predicted_margin < 1e-6
    # Three standard deviations of a normal: the fresh run's interval holds the limit.
    assert check.verified_interval[0] < 2.0 < check.verified_interval[1]
    assert result.yield_interval[0] < stats.norm.cdf(3.0) < result.yield_interval[1]
    # Relaxing the limit by dL scales every tolerance: dC/dL = -C / headroom.
    assert check.shadow_price == pytest.approx(-result.cost, rel=1e-5)


@pytest.mark.long
def test_worst_case_of_a_linear_metric_is_the_closed_form_with_bounds_active():
    result = allocate(LINEAR, {"f": 2.0}, COSTS, bounds(3), key=KEY)
    exact = np.sqrt(FACTORS / GRADIENT)
    exact /= GRADIENT @ exact
    np.testing.assert_allclose(found(result), exact, rtol=1e-6)
    assert result.limits[0].verified == pytest.approx(2.0, abs=1e-6)
    tight = {**bounds(3), "e1": (1e-3, 0.02)}
    result = allocate(LINEAR, {"f": 2.0}, COSTS, tight, key=KEY)
    free = [0, 2]
    exact = np.sqrt(FACTORS[free] / GRADIENT[free])
    exact *= (1 - 4.0 * 0.02) / (GRADIENT[free] @ exact)
    np.testing.assert_allclose(found(result)[free], exact, rtol=1e-6)
    assert result.at_bounds == {"e1": "largest"} and result.status == "ok"


def test_even_metric_beyond_its_quadratic_model_is_corrected_on_the_full_problem():
    # f = 1 + r^2 + r^4 with r^2 = sum (a_i e_i)^2, worst on every corner: sum (a_i t_i)^2 <= r^2.
    a = np.array([1.0, 3.0, 0.5])

    def function(x):
        square = jnp.sum((jnp.asarray(a) * x) ** 2)
        return 1.0 + square + square**2

    result = allocate(make({"f": function}, 3), {"f": 3.0}, COSTS, bounds(3), key=KEY)
    exact = (FACTORS / a**2) ** (1 / 3)
    exact /= np.linalg.norm(a * exact)  # r = 1: 1 + 1 + 1 = 3
    np.testing.assert_allclose(found(result), exact, rtol=1e-5)
    check = result.limits[0]
    assert result.status == "ok" and check.quadratic == pytest.approx(2.0, rel=1e-5)
    assert check.predicted == pytest.approx(3.0, abs=1e-5)
    assert check.verified == pytest.approx(3.0, abs=1e-5)
    assert len(result.history) >= 3


@pytest.mark.long
def test_two_limits_of_24_errors_hold_in_the_worst_case_and_cannot_all_be_relaxed():
    k = 24
    rng = np.random.default_rng(2)
    root = rng.normal(size=(k, k)) / np.sqrt(k)
    g = rng.uniform(0.2, 2.0, k)
    functions = {
        "force": lambda x: 10.0 + jnp.asarray(g) @ x,
        "moment": lambda x: jnp.sum((jnp.asarray(root) @ x) ** 2),
    }
    limits = {"force": (8.5, 11.0), "moment": 1.5}
    few = {"corners": 2, "random": 1, "sobol": 2}
    problem = make(functions, k)
    result = allocate(problem, limits, ReciprocalSquared(), bounds(k), key=KEY, starts=few)
    assert result.status == "ok"
    t = found(result)
    assert g @ t <= 1.0 + 1e-6
    signs = np.sign(np.random.default_rng(0).normal(size=(20000, k)))
    corners = np.sum((signs * t @ root.T) ** 2, axis=1)
    assert corners.max() <= 1.5 + 1e-6
    sides = {(c.metric, c.side): c for c in result.limits}
    assert sides["force", "lower"].verified == pytest.approx(10.0 - g @ t, rel=1e-9)
    # The cost must be stationary: a larger tolerance breaks a limit that has a price.
    priced = [c for c in result.limits if abs(c.shadow_price) > 1e-3]
    assert priced and all(abs(c.verified_margin) < 1e-4 for c in priced)


@pytest.mark.long
def test_yield_of_a_uniform_error_is_its_closed_form_and_a_fresh_run_agrees():
    # P((t u)^2 <= 1) with u uniform on -1..1 is 1/t = 0.9, so t = 1/0.9.
    result = allocate(SQUARE, {"f": 1.0}, Reciprocal(), bounds(1), "yield", key=KEY, target=0.9, **UNIFORM)
    assert result.status == "ok" and found(result)[0] == pytest.approx(1 / 0.9, rel=1e-2)
    assert result.predicted_yield == pytest.approx(0.9, abs=1e-2)
    assert result.yield_interval[0] < 0.9 < result.yield_interval[1]
    assert result.cost == pytest.approx(0.9, rel=1e-2)


@pytest.mark.slow
def test_rss_moments_of_an_even_metric_against_a_large_sample():
    rng = np.random.default_rng(4)
    root = rng.normal(size=(3, 3))
    hessian, gradient = root @ root.T, np.array([0.2, 0.0, -0.1])
    quadratic = Quadratic(jnp.zeros(1), jnp.asarray(gradient)[None], jnp.asarray(hessian)[None])
    sigma = np.array([0.5, 1.0, 0.2])
    e = rng.normal(size=(2_000_000, 3)) * sigma
    f = e @ gradient + 0.5 * np.einsum("ni,ij,nj->n", e, hessian, e)

    def statistic(kind, c):
        model = Moments(quadratic, jnp.asarray(sigma), jnp.asarray(c), jnp.zeros(1), None, jnp.zeros(1), kind)
        return float(model(jnp.ones(3))[0])

    assert statistic("mean", 3.0) == pytest.approx(f.mean(), rel=3e-3)
    # k1 + c sqrt(k2) + (c^2 - 1)/6 k3/k2 of the sample's own cumulants.
    second, third = f.var(), np.mean((f - f.mean()) ** 3)
    expected = f.mean() + 2.0 * np.sqrt(second) + 0.5 * third / second
    assert statistic("quantile", 2.0) == pytest.approx(expected, rel=1e-2)
    exact = np.quantile(f, stats.norm.cdf(2.0))
    assert exact < statistic("quantile", 2.0) < 1.15 * exact  # on the safe side of a skewed metric


@pytest.mark.long
def test_mean_of_an_even_metric_is_held_at_its_limit():
    # E f = sum a_i^2 t_i^2 / 9: the closed form of RSS with a_i^2/9 for g_i^2.
    a = np.array([1.0, 2.0, 0.5])
    problem = make({"f": lambda x: jnp.sum((jnp.asarray(a) * x) ** 2)}, 3)
    result = allocate(problem, {"f": 1.0}, COSTS, bounds(3), "rss", key=KEY, statistic="mean", samples=128)
    exact = (FACTORS / a**2) ** (1 / 3)
    exact *= 3 / np.linalg.norm(a * exact)
    np.testing.assert_allclose(found(result), exact, rtol=1e-5)
    low, high = result.limits[0].verified_interval
    assert result.status == "ok" and low < 1.0 < high


@pytest.mark.long
def test_infeasible_request_names_the_limit_and_the_best_value():
    problem = make({"f": lambda x: 1.0 + jnp.asarray(GRADIENT) @ x, "g": lambda x: x[0]}, 3)
    request = {"g": 100.0, "f": 1.5}
    result = allocate(problem, request, COSTS, bounds(3, low=0.2), key=KEY)
    assert result.status == "infeasible"
    assert "1.5" in result.message and "on f cannot be met" in result.message
    assert "2.1" in result.message  # 1 + 0.2 (1 + 4 + 0.5)
    assert result.limits[1].verified > 1.5 and "infeasible" in str(result)
    nominal = allocate(linear(), {"f": 0.5}, COSTS, bounds(3), "yield", key=KEY, samples=256, target=0.9)
    assert nominal.status == "infeasible" and "on f cannot be met" in nominal.message


@pytest.mark.long
def test_failed_samples_count_against_the_yield():
    # Fails for e > 0.5: with t = 1 a quarter of all samples; at 95 % yield t (1 - 0.1) <= 0.5.
    def function(errors):
        x = errors["e0"]
        return {"f": jnp.where(x > 0.5, jnp.nan, x**2)}, jnp.where(x > 0.5, 4, 0)

    problem = FunctionProblem(function, ("e0",), ("f",), statuses={4: "did not assemble"})
    result = allocate(
        problem, {"f": 100.0}, Reciprocal(), {"e0": (1.0, 3.0)}, "yield", key=KEY, target=0.95,
        **UNIFORM,
    )  # fmt: skip
    assert result.status == "infeasible" and result.failed > 0
    assert result.verified_yield < 0.76
    result = allocate(
        problem, {"f": 0.16}, Reciprocal(), {"e0": (0.1, 0.5)}, "yield", key=KEY, target=0.9,
        **UNIFORM,
    )  # fmt: skip
    assert result.status == "ok"
    assert found(result)[0] == pytest.approx(0.4 / 0.9, rel=0.02)


def test_augmented_lagrangian_meets_a_known_problem_with_its_multipliers():
    # Hock and Schittkowski 35: minimum 1/9 at (4/3, 7/9, 4/9), multiplier 2/9.
    def cost(x):
        quadratic = 2 * x[0] ** 2 + 2 * x[1] ** 2 + x[2] ** 2 + 2 * x[0] * x[1] + 2 * x[0] * x[2]
        return 9 - 8 * x[0] - 6 * x[1] - 4 * x[2] + quadratic

    def constraints(x):
        return jnp.stack([x[0] + x[1] + 2 * x[2] - 3.0, x[0] - 100.0])

    solution = minimise(cost, constraints, jnp.full(3, 0.5), jnp.zeros(3), jnp.full(3, 10.0))
    assert bool(solution.converged)
    np.testing.assert_allclose(solution.point, [4 / 3, 7 / 9, 4 / 9], rtol=1e-6)
    np.testing.assert_allclose(solution.multipliers, [2 / 9, 0.0], atol=1e-6)


def test_cost_models_add_up_and_their_input_is_checked():
    models = assign_costs({"a": Reciprocal(2.0, 1.0), "b": Exponential(3.0, 0.5), "c": lambda t: -t}, ("a", "b", "c"))
    t = jnp.array([4.0, 2.0, 1.0])
    assert float(total_cost(models, t)) == pytest.approx(1.5 + 3 * np.exp(-1.0) - 1.0)
    assert float(ReciprocalSquared(8.0)(jnp.asarray(2.0))) == 2.0
    with pytest.raises(InputError, match="`c` has none"):
        assign_costs({"a": Reciprocal()}, ("a", "c"))
    with pytest.raises(InputError, match="`factor` of Reciprocal must be positive"):
        Reciprocal(-1.0)


def test_a_cost_model_may_be_an_object_without_a_hash():
    class Own:
        __hash__ = None

        def __call__(self, t):
            return 1.0 / t

    models = assign_costs({"a": Own()}, ("a",))
    price, slope = _price(models, jnp.array([0.5]))
    assert float(price) == pytest.approx(2.0) and np.asarray(slope) == pytest.approx([-4.0])


def test_a_metric_with_a_kink_at_the_centre_is_refused():
    kink = make({"f": lambda x: jnp.sqrt(jnp.sum(x**2))}, 2)
    with pytest.raises(InputError, match="limit its mean square"):
        allocate(kink, {"f": 1.0}, Reciprocal(), bounds(2), key=KEY)


@pytest.mark.long
def test_quantile_weights_recover_quantiles():
    weights = quantile_weights(4096, 0.95)
    uniform = (np.arange(4096) + 0.5) / 4096
    assert weights.sum() == pytest.approx(1.0)
    assert weights @ uniform == pytest.approx(0.95, abs=1e-4)
