"""Compiled programs: a study traces its problem twice, whatever its rounds, starts and corners.

Compiling a simulation takes minutes and running one milliseconds, so the number of programs is the
cost of a study. A trace of the problem is counted where its function runs as Python.
"""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfem_jax import FunctionProblem, InputError, Reciprocal, Tolerances, Uniform, allocate, expand, metric, worst_case
from rfem_jax.tolerancing.optimisation.projected_gradient import climb, climb_together, project_ball
from rfem_jax.tolerancing.optimisation.starting_points import projection
from rfem_jax.tolerancing.problems.evaluation import evaluate_points
from rfem_jax.tolerancing.problems.linearisation import linearise_points
from rfem_jax.tolerancing.problems.quadratic_model import expand_by_differences

jax.config.update("jax_enable_x64", True)

KEY = jax.random.key(11)
PROGRAMS = 2  # of the problem: values, and values with derivatives


def counted(k, m=2):
    """A problem of k errors and m metrics, and the list that its traces are noted in."""
    traces, names = [], tuple(f"e{i}" for i in range(k))
    weights = np.random.default_rng(k).uniform(0.5, 2.0, (m, k))

    def function(errors):
        traces.append(1)
        x = jnp.stack([errors[name] for name in names])
        values = {}
        for i in range(m):
            square = jnp.sum((jnp.asarray(weights[i]) * x) ** 2)
            values[f"f{i}"] = 1.0 + square + 0.3 * square**2 + 0.1 * x[i] * square
        return values

    return FunctionProblem(function, names, [f"f{i}" for i in range(m)]), traces


@pytest.mark.long
@pytest.mark.parametrize(
    ("k", "criterion", "mode"),
    [
        (3, "worst_case", "auto"),
        (8, "worst_case", "auto"),  # reverse mode: one gradient per point, not one per metric
        (8, "worst_case", "forward"),
        (3, "yield", "auto"),
        (8, "rss", "reverse"),
    ],
)
def test_an_allocation_compiles_its_problem_twice_and_its_neighbours_not_at_all(k, criterion, mode):
    problem, traces = counted(k)
    few = {"corners": 2, "random": 1, "sobol": 2}
    bounds = dict.fromkeys(problem.error_names, (0.001, 2.0))
    options = {"key": KEY, "starts": few, "samples": 64, "verify_samples": 256, "target": 0.9, "mode": mode}

    def solve(limit):
        return allocate(problem, {"f0": limit}, Reciprocal(), bounds, criterion, **options)

    assert solve(3.0).status == "ok"
    assert len(traces) <= PROGRAMS
    assert solve(2.0).cost > solve(3.0).cost
    # A worst case of the same errors shares them, of the other metric and with other numbers too.
    widths = dict.fromkeys(problem.error_names, 0.5)
    if criterion == "worst_case":
        worst_case(problem, widths, "f1", key=KEY, mode=mode, starts={"sobol": 5})
    assert len(traces) <= PROGRAMS


@pytest.mark.slow
def test_a_failed_sample_with_a_large_value_is_never_the_worst():
    def function(errors):
        x = errors["a"]
        return {"f": jnp.where(x > 0.5, 1e6, x)}, jnp.where(x > 0.5, 4, 0)

    problem = FunctionProblem(function, ("a",), ("f",))
    points = [[0.25], [0.75]]
    values, status = evaluate_points(problem, ("a",), {}, points)
    np.testing.assert_array_equal(values, [[0.25], [np.nan]])
    np.testing.assert_array_equal(status, [0, 4])
    found = worst_case(problem, {"a": 1.0}, "f", key=KEY)
    assert found.value <= 0.5 and found.corners.failed == 1 and found.failed > 1


def test_equal_names_give_equal_metrics():
    assert metric("A.rms_force") is metric("A.rms_force")
    assert metric("A.rms_force") != metric("B.rms_force")
    with pytest.raises(InputError, match="metrics"):
        metric("A.rms_farce")


@pytest.mark.long
@pytest.mark.parametrize("mode", ["forward", "reverse"])
@pytest.mark.parametrize("k", [3, 40])
def test_derivatives_at_many_points_are_those_at_single_ones_in_both_modes(mode, k):
    problem, _ = counted(k)
    points = np.random.default_rng(1).normal(size=(21, k))

    def single(x):
        values = problem(dict(zip(problem.error_names, x, strict=True)))[0]
        return jnp.stack(list(values.values()))

    exact = jax.jit(jax.vmap(jax.jacrev(single)))(points[::10])
    names = problem.error_names
    values, jacobians, status = linearise_points(problem, names, {}, points, mode=mode)
    np.testing.assert_allclose(jacobians[::10], exact, rtol=1e-12)
    np.testing.assert_allclose(values, evaluate_points(problem, names, {}, points)[0], rtol=1e-12)
    assert values.shape == (21, 2) and jacobians.shape == (21, 2, k) and not status.any()
    which = np.arange(21) % 2
    values, one, _ = linearise_points(problem, names, {}, points, metric=which, mode=mode)
    np.testing.assert_allclose(one, jacobians[np.arange(21), which], rtol=1e-12)
    few, one, _ = linearise_points(problem, names, {}, points, metric=1, mode=mode, batch=4)
    np.testing.assert_allclose(one, jacobians[:, 1], rtol=1e-12)
    np.testing.assert_allclose(few, values, rtol=1e-12)


@pytest.mark.parametrize("mode", ["forward", "reverse"])
def test_hessian_by_differences_is_the_exact_one_within_its_error(mode):
    def function(errors):
        a, b, c = errors["a"], 1e3 * errors["b"], errors["c"]
        return {"f": jnp.exp(a + 2 * b) * jnp.cos(3 * c + a), "g": a * b + b**2}

    problem = FunctionProblem(function, ("a", "b", "c"), ("f", "g"), error_units={"b": "m"})
    at, widths = {"a": 0.1, "b": 2e-4, "c": 0.3}, {"c": 0.5, "a": 0.2, "b": 1e-4}
    found = expand_by_differences(problem, at, widths, mode=mode)
    exact = expand(problem, at, ("c", "a", "b"))
    assert found.names == exact.names and found.metrics == exact.metrics and int(found.status) == 0
    np.testing.assert_allclose(found.value, exact.value, rtol=1e-13)
    np.testing.assert_allclose(found.gradient, exact.gradient, rtol=1e-12)
    t = np.array(list(widths.values()))
    scaled, true = (np.asarray(h.hessian) * np.outer(t, t) for h in (found, exact))
    largest = np.max(np.abs(true), axis=(1, 2))
    gap = np.max(np.abs(scaled - true), axis=(1, 2)) / largest
    assert np.all(gap <= np.asarray(found.hessian_error)) and np.all(gap < 1e-7)
    assert np.asarray(found.hessian_error)[0] < 1e-3  # and it is no empty statement
    assert np.asarray(found.hessian_error)[1] < 1e-10  # a quadratic has no higher derivatives
    assert np.all(np.asarray(found.asymmetry) < 1e-8)
    assert exact.hessian_error is None
    with pytest.raises(InputError, match="`half_widths` must have positive"):
        expand_by_differences(problem, at, {"a": 0.0})


@pytest.mark.long
def test_hessian_by_differences_does_not_exist_at_kinks_and_failures():
    def function(errors):
        x = jnp.stack([errors["a"], errors["b"]])
        values = {"square": x @ x, "root": jnp.sqrt(x @ x)}
        return values, jnp.where(errors["b"] > 0.05, 3, 0)

    problem = FunctionProblem(function, ("a", "b"), ("square", "root"))
    model = expand_by_differences(problem, None, {"a": 1.0, "b": 1.0})
    np.testing.assert_allclose(model.hessian[0], 2 * np.eye(2), atol=1e-12)
    assert np.all(np.isnan(model.hessian[1])) and np.all(np.isnan(model.gradient[1]))
    failed = expand_by_differences(problem, {"b": 0.06}, {"a": 1.0, "b": 1.0})
    assert int(failed.status) == 3 and np.all(np.isnan(failed.value))
    result = worst_case(problem, Tolerances({"a": Uniform(0.04)}), "root", key=KEY)
    assert result.value == pytest.approx(0.04) and np.isnan(result.quadratic_value)


@pytest.mark.long
def test_searches_of_the_host_are_those_of_the_traced_loop():
    def wave(x):
        return jnp.sum(jnp.cos(5 * x) - 0.1 * (x - 1) ** 2) + x[0] * x[1]

    function = jax.value_and_grad(wave)
    starts = np.random.default_rng(2).uniform(-1.5, 1.5, (7, 2))
    calls = []

    def together(points):
        calls.append(len(points))
        return tuple(map(np.asarray, jax.vmap(function)(jnp.asarray(points))))

    for project in (projection("box"), project_ball):
        calls.clear()
        found = climb_together(together, project, starts, evaluations=60, tolerance=1e-7)
        search = partial(climb, function, project, evaluations=60, tolerance=1e-7)
        expected = jax.vmap(search)(jnp.asarray(starts))
        for name in ("point", "value", "gradient"):
            one = getattr(expected, name)
            np.testing.assert_allclose(getattr(found, name), one, rtol=1e-6, atol=1e-6)
        assert np.all(np.asarray(found.converged))
        # Ended searches are not evaluated again.
        assert sum(calls) == int(np.sum(np.asarray(found.evaluations)))
        assert calls[-1] < len(starts)
