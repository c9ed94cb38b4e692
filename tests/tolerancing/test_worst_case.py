"""Worst cases of closed-form problems: corners, interiors, ellipsoids, ties, failures."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfem_jax import CorrelatedNormal, FunctionProblem, InputError, Tolerances, Uniform, worst_case
from rfem_jax.tolerancing.optimisation.projected_gradient import climb, project_ball
from rfem_jax.tolerancing.optimisation.starting_points import distinct, maximise_quadratic, quadratic_bound

jax.config.update("jax_enable_x64", True)

KEY = jax.random.key(7)


def make(function, k):
    """A problem "f" of the vector of k errors e0, e1, ..."""
    names = tuple(f"e{i}" for i in range(k))
    return FunctionProblem(lambda errors: {"f": function(jnp.stack([errors[n] for n in names]))}, names, ("f",))


def widths(values):
    return {f"e{i}": value for i, value in enumerate(values)}


@pytest.mark.long
def test_linear_metric_is_largest_at_the_corner_of_its_gradient():
    gradient = np.array([3.0, -2.0, 0.5])
    t = np.array([0.1, 0.2, 0.4])
    result = worst_case(make(lambda x: 1.0 + jnp.asarray(gradient) @ x, 3), widths(t), "f", key=KEY)
    assert result.value == pytest.approx(1.0 + np.abs(gradient) @ t, rel=1e-14)
    assert result.active == {"e0": "upper", "e1": "lower", "e2": "upper"}
    assert result.status == "ok" and result.kkt_residual == 0.0
    assert result.corners.count == 8 and result.corners.value == pytest.approx(result.value)
    assert result.quadratic_value == pytest.approx(result.value, rel=1e-12)
    assert result.quadratic_bound == pytest.approx(result.value, rel=1e-12)
    np.testing.assert_allclose([result.slopes[f"e{i}"] for i in range(3)], gradient * t, rtol=1e-12)


@pytest.mark.long
def test_even_metric_is_worst_on_two_opposite_corners_and_both_are_reported():
    rng = np.random.default_rng(0)
    root = rng.normal(size=(5, 5))
    hessian, t = root @ root.T, np.array([0.1, 0.2, 0.1, 0.3, 0.1])
    result = worst_case(
        make(lambda x: 0.5 * x @ jnp.asarray(hessian) @ x, 5), widths(t), "f", key=KEY,
        corners=False,
    )  # fmt: skip
    signs = np.array(np.meshgrid(*[[-1.0, 1.0]] * 5)).reshape(5, -1).T * t
    exact = 0.5 * np.einsum("ni,ij,nj->n", signs, hessian, signs).max()
    assert result.value == pytest.approx(exact, rel=1e-13) and result.nominal == 0.0
    assert result.corners is None and len(result.maximisers) == 2
    first, second = ([e[n] for n in result.names] for e in result.maximisers)
    np.testing.assert_allclose(first, -np.array(second), atol=1e-12)


def test_interior_maximum_and_minimum_over_the_same_box():
    centre = jnp.asarray([0.3, -0.2, 2.0])
    problem = make(lambda x: 1.0 - jnp.sum((x - centre) ** 2), 3)
    result = worst_case(problem, widths([1.0, 1.0, 1.0]), "f", key=KEY)
    np.testing.assert_allclose(list(result.errors.values()), [0.3, -0.2, 1.0], atol=1e-7)
    assert result.active == {"e2": "upper"} and result.kkt_residual < 1e-6
    assert result.value == pytest.approx(0.0, abs=1e-12) and result.corners.value < -1.0
    lowest = worst_case(problem, widths([1.0, 1.0, 1.0]), "f", key=KEY, sense="min")
    assert lowest.value == pytest.approx(1.0 - 1.3**2 - 1.2**2 - 3.0**2, rel=1e-13)


@pytest.mark.long
def test_non_convex_metric_of_many_errors_finds_the_global_maximum():
    # One-dimensional waves with several local maxima each; the exact maximum is separable.
    def wave(x):
        return jnp.cos(9.0 * x) + 0.5 * jnp.sin(2.0 * x) - 0.3 * x**2

    grid = np.linspace(-1.0, 1.0, 200001)
    exact = 4 * np.max(np.asarray(wave(jnp.asarray(grid))))
    problem = make(lambda x: jnp.sum(wave(x)), 4)
    starts = {"corners": 4, "random": 28, "sobol": 32}
    result = worst_case(problem, widths([1.0] * 4), "f", key=KEY, starts=starts)
    assert result.value == pytest.approx(exact, rel=1e-8)
    ends = result.end_values
    assert np.min(ends) < exact - 0.1, "the problem must have worse local maxima than the one found"


def test_ellipsoid_of_a_linear_metric_has_the_closed_form_with_and_without_correlation():
    g, t = np.array([1.0, 2.0, -1.0]), np.array([0.1, 0.2, 0.3])
    problem = make(lambda x: jnp.asarray(g) @ x, 3)
    plain = worst_case(problem, widths(t), "f", "ellipsoid", key=KEY)
    assert plain.value == pytest.approx(np.linalg.norm(g * t), rel=1e-10)
    assert plain.active == {"ellipsoid": "surface"} and plain.corners is None
    correlation = np.array([[1.0, 0.6, 0.0], [0.6, 1.0, 0.2], [0.0, 0.2, 1.0]])
    covariance = correlation * np.outer(t, t) / 9.0
    group = CorrelatedNormal(("e0", "e1", "e2"), covariance, deviations=3.0)
    tilted = worst_case(problem, Tolerances(correlated=group), "f", "ellipsoid", key=KEY)
    assert tilted.value == pytest.approx(np.sqrt(9.0 * g @ covariance @ g), rel=1e-10)


def test_root_with_no_derivative_at_the_centre_does_not_stop_the_search():
    result = worst_case(make(lambda x: jnp.sqrt(jnp.sum(x**2)), 2), widths([1.0, 1.0]), "f", key=KEY, corners=False)
    assert result.value == pytest.approx(np.sqrt(2.0), rel=1e-14)
    assert np.isnan(result.quadratic_value) and len(result.maximisers) >= 2


@pytest.mark.slow
def test_failed_samples_are_walked_around_and_counted():
    problem = make(lambda x: jnp.where(x[0] > 0.5, jnp.nan, x[0] + x[1]), 2)
    result = worst_case(problem, widths([1.0, 1.0]), "f", key=KEY)
    assert 1.4 < result.value <= 1.5 and result.errors["e0"] <= 0.5
    assert result.failed > 0 and result.corners.failed == 2
    assert result.status == "not_converged"
    nothing = make(lambda x: jnp.nan * x[0], 1)
    assert worst_case(nothing, widths([1.0]), "f", key=KEY).status == "failed"


def test_interval_that_is_not_symmetric_is_searched_about_its_middle():
    tolerances = Tolerances({"e0": Uniform(interval=(0.0, 0.4)), "e1": Uniform(0.1)})
    result = worst_case(make(lambda x: x[0] - x[1], 2), tolerances, "f", key=KEY)
    assert result.value == pytest.approx(0.5, rel=1e-12)
    lowest = worst_case(make(lambda x: x[0] - x[1], 2), tolerances, "f", key=KEY, sense="min")
    assert lowest.value == pytest.approx(-0.1, rel=1e-12)


def test_quadratic_maximum_on_a_ball_is_the_trust_region_solution():
    rng = np.random.default_rng(3)
    root = rng.normal(size=(6, 6))
    hessian, gradient = root + root.T, rng.normal(size=6)
    values = maximise_quadratic(0.0, gradient, hessian, "ellipsoid", KEY)[1]
    # Secular equation: |(mu - H)^-1 g| = 1 with mu above the largest eigenvalue.
    eigenvalues, vectors = np.linalg.eigh(hessian)
    g = vectors.T @ gradient
    low, high = eigenvalues[-1], eigenvalues[-1] + 100.0
    for _ in range(200):
        middle = 0.5 * (low + high)
        outside = np.sum((g / (middle - eigenvalues)) ** 2) > 1
        low, high = (middle, high) if outside else (low, middle)
    z = g / (high - eigenvalues)
    assert values[0] == pytest.approx(g @ z + 0.5 * np.sum(eigenvalues * z**2), rel=1e-8)


def test_projected_gradient_meets_a_hard_valley_inside_a_ball():
    def rosenbrock(x):
        return -((1 - x[0]) ** 2) - 100 * (x[1] - x[0] ** 2) ** 2

    search = climb(
        jax.value_and_grad(rosenbrock), lambda x: 2 * project_ball(x / 2), jnp.array([-1.0, 1.5]),
        evaluations=2000, tolerance=1e-9,
    )  # fmt: skip
    assert bool(search.converged)
    np.testing.assert_allclose(search.point, [1.0, 1.0], atol=1e-6)


def test_a_search_evaluates_its_start_and_one_that_fails_has_no_value():
    def climbed(start, evaluations=200):
        return climb(lambda x: (-jnp.sum(x**4), -4.0 * x**3), lambda x: x, jnp.asarray(start), evaluations=evaluations)

    for evaluations in (0, 1):
        only = climbed([2.0], evaluations)
        assert only.value == -16.0 and only.evaluations == 1 and not only.converged
    failed = climbed([np.nan])
    assert np.isnan(failed.value) and failed.evaluations == 1 and not failed.converged


def test_new_numbers_do_not_compile_again_and_input_is_checked():
    traces = []

    def function(x):
        traces.append(1)
        return jnp.sum(jnp.asarray([1.0, 2.0]) * x)

    problem = make(function, 2)
    worst_case(problem, widths([1.0, 1.0]), "f", key=KEY)
    count = len(traces)
    second = worst_case(problem, widths([2.0, 3.0]), "f", key=jax.random.key(8))
    assert len(traces) == count and second.value == pytest.approx(8.0)
    with pytest.raises(InputError, match="`region` must be one of"):
        worst_case(problem, widths([1.0, 1.0]), "f", "sphere", key=KEY)
    with pytest.raises(InputError, match="`metric` must name"):
        worst_case(problem, widths([1.0, 1.0]), "g", key=KEY)
    with pytest.raises(InputError, match="at least one start"):
        worst_case(problem, widths([1.0, 1.0]), "f", key=KEY, starts={"random": 0})


@pytest.mark.parametrize("region", ["box", "ellipsoid"])
def test_quadratic_bound_is_above_every_maximum_and_met_by_a_diagonal_model(region):
    rng = np.random.default_rng(1)
    for _ in range(5):
        root = rng.normal(size=(4, 4))
        model = (1.5, rng.normal(size=4), root + root.T)
        value = maximise_quadratic(*model, region, KEY)[1][0]
        assert value <= quadratic_bound(*model, region) + 1e-12
    curvatures = np.array([4.0, 2.0, 1.0])
    exact = 1.5 + 0.5 * (curvatures.sum() if region == "box" else 4.0)
    model = (1.5, np.zeros(3), np.diag(curvatures))
    assert quadratic_bound(*model, region) == pytest.approx(exact, rel=1e-14)
    assert maximise_quadratic(*model, region, KEY)[1][0] == pytest.approx(exact, rel=1e-8)


@pytest.mark.slow
def test_the_mirror_image_of_the_best_point_is_tried():
    one = {"starts": {"sobol": 1}, "corners": False, "model": False, "key": KEY}
    even = worst_case(make(lambda x: (x[0] + 2 * x[1]) ** 2, 2), widths([1.0, 1.0]), "f", **one)
    assert len(even.maximisers) == 2 and even.value == pytest.approx(9.0)
    # A single search climbs the nearer side of a valley; in one of these two it is the lower one.
    found = [worst_case(make(lambda x, s=s: x[0] ** 2 + s * x[0], 1), widths([1.0]), "f", **one) for s in (-0.01, 0.01)]
    assert {result.found_by for result in found} == {"search", "mirror"}
    assert all(result.value == pytest.approx(1.01) for result in found)


@pytest.mark.slow
def test_of_points_that_are_near_each_other_the_best_is_kept():
    points = np.array([[0.0, 0.0], [0.0, 5e-4], [0.0, 2e-3], [1.0, 1.0], [1.0 + 5e-4, 1.0], [2.0, 2.0]])
    values = np.array([1.0, 3.0, 2.0, 4.0, 4.0, np.nan])
    # Largest coordinate of a distance; the first of equals; 1.5e-3 apart is far enough.
    assert distinct(points, values).tolist() == [3, 1, 2]
    assert distinct(points, values, 1e-2).tolist() == [3, 1]
    assert distinct(points[5:], values[5:]).tolist() == distinct(points[:0], values[:0]).tolist() == []
