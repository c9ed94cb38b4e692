"""Tolerances: distributions against SciPy, moments, derivatives in the widths, refusals."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import stats

from rfem_jax import (
    CorrelatedNormal,
    FunctionProblem,
    InputError,
    Metric,
    Normal,
    Reciprocal,
    Tolerances,
    Triangular,
    TruncatedNormal,
    Uniform,
    monte_carlo,
    sensitivity,
    worst_case,
)
from rfem_jax.tolerancing.robust_design.request import check_allocation
from tests.derivatives import check_derivatives

jax.config.update("jax_enable_x64", True)

U = np.array([1e-9, 0.01, 0.2, 0.5, 0.77, 0.999, 1 - 1e-9])
LOW, HIGH = -0.1, 0.3
WIDTH, CENTRE = 0.2, 0.1
KINDS = {
    "uniform": (Uniform(interval=(LOW, HIGH)), stats.uniform(LOW, HIGH - LOW)),
    "triangular": (Triangular(interval=(LOW, HIGH)), stats.triang(0.5, LOW, HIGH - LOW)),
    "normal": (Normal(interval=(LOW, HIGH), deviations=2.5), stats.norm(CENTRE, WIDTH / 2.5)),
    "truncated": (
        TruncatedNormal(interval=(LOW, HIGH), deviations=1.5),
        stats.truncnorm(-1.5, 1.5, CENTRE, WIDTH / 1.5),
    ),
}


@pytest.mark.parametrize("kind", KINDS)
def test_quantiles_and_variances_are_scipys(kind):
    tolerance, reference = KINDS[kind]
    np.testing.assert_allclose(tolerance.quantile(jnp.asarray(U)), reference.ppf(U), rtol=1e-9)
    np.testing.assert_allclose(tolerance.variance(), reference.var(), rtol=1e-9)
    np.testing.assert_allclose(tolerance.centre, reference.mean(), atol=1e-12)
    np.testing.assert_allclose(tolerance.interval, (LOW, HIGH), rtol=1e-15)


@pytest.mark.parametrize("kind", (Uniform, Triangular, Normal, TruncatedNormal))
def test_errors_are_differentiable_in_the_width(kind):
    def error(width):
        return kind(width).quantile(jnp.asarray(0.83))

    assert check_derivatives(error, 0.01, 1e-6, reverse=1e-12, differences=1e-7).forward > 0.1


@pytest.mark.wrong_types
@pytest.mark.parametrize("ends", [(None, 1.0), (1j, 2.0), ([0.1], [0.2]), (np.zeros(2), 1.0), (object(), 1.0)])
def test_ends_of_intervals_are_numbers(ends):
    with pytest.raises(InputError, match="must be a pair of numbers"):
        Uniform(interval=ends)


@pytest.mark.parametrize("numbers", [np.float64, jnp.asarray, float])
def test_intervals_are_the_same_whatever_gives_their_ends(numbers):
    """Traced or known, of NumPy or of JAX; and wide ones do not overflow."""
    made = Uniform(interval=(numbers(-0.1), numbers(0.3)))
    traced = jax.jit(lambda low, high: Uniform(interval=(low, high)).interval)(-0.1, 0.3)
    np.testing.assert_array_equal(made.interval, traced)
    assert jax.jacfwd(lambda high: Uniform(interval=(numbers(-0.1), high)).tolerance)(0.3) == 0.5
    wide = Uniform(interval=(numbers(-1.7e308), numbers(1.7e308)))
    assert wide.tolerance == 1.7e308 and wide.centre == 0.0


@pytest.mark.parametrize("kind", (Uniform, Triangular, Normal, TruncatedNormal))
def test_widths_and_intervals_may_be_strings_with_a_unit(kind):
    angle, length = kind("0.25 deg"), kind(interval=("-0.1 mm", "0.3 mm"))
    assert float(angle.tolerance) == pytest.approx(np.radians(0.25), rel=1e-15) and angle.centre == 0.0
    np.testing.assert_allclose(length.interval, (-1e-4, 3e-4), rtol=1e-12)
    assert (angle.unit, length.unit, kind(0.1).unit) == ("rad", "m", None)
    problem = FunctionProblem(lambda e: {"y": e["a"] + e["b"]}, ("a", "b"), ("y",), error_units={"b": "m"})
    key = jax.random.key(0)
    given = monte_carlo(problem, Tolerances({"a": kind("0.25 deg"), "b": kind("0.1 mm")}), 8, key)
    numbers = monte_carlo(problem, Tolerances({"a": kind(np.radians(0.25)), "b": kind(1e-4)}), 8, key)
    np.testing.assert_allclose(given.errors, numbers.errors, rtol=1e-15)
    wrong = Tolerances({"a": kind("0.1 mm")})
    for study in (
        lambda: monte_carlo(problem, wrong, 8, key),
        lambda: sensitivity(problem, scale=wrong),
        lambda: worst_case(problem, wrong, "y", key=key),
    ):
        with pytest.raises(InputError, match=r"`a` is an angle \[rad\] and its tolerance is in m"):
            study()


@pytest.mark.long
def test_points_half_widths_and_bounds_may_be_strings_with_a_unit():
    problem = FunctionProblem(lambda e: {"y": e["a"] ** 2 + e["b"]}, ("a", "b"), ("y",), error_units={"b": "m"})
    found = sensitivity(problem, {"a": "0.1 rad"}, scale={"a": "0.5 deg", "b": "2 mm"})
    assert found.at == {"a": 0.1} and found.gradient[0, 0] == pytest.approx(0.2)
    np.testing.assert_allclose(found.scale, [np.radians(0.5), 2e-3], rtol=1e-15)
    worst = worst_case(problem, {"b": "2 mm"}, "y", key=jax.random.key(0), at={"a": "0.1 rad"})
    assert worst.value == pytest.approx(0.012)
    bounds = {"a": ("0.1 deg", "1 deg"), "b": (1e-4, "1 mm")}
    found = check_allocation(problem, {"y": 1.0}, Reciprocal(), bounds).variables
    np.testing.assert_allclose(found.width_lower, [np.radians(0.1), 1e-4], rtol=1e-15)
    np.testing.assert_allclose(found.width_upper, [np.radians(1.0), 1e-3], rtol=1e-15)
    for wrong in ({"a": "0.1 mm"}, {"b": "0.1"}):
        with pytest.raises(InputError, match="of `scale` must"):
            sensitivity(problem, scale=wrong)


def test_truncated_normal_stays_inside():
    drawn = TruncatedNormal(0.5, deviations=3.0).quantile(jnp.asarray([2.0**-60, 1 - 2.0**-53]))
    np.testing.assert_allclose(drawn, [-0.5, 0.5], rtol=1e-9)
    assert jnp.all(jnp.abs(drawn) <= 0.5)


def test_correlated_normal_has_its_mean_and_covariance():
    covariance = np.array([[0.04, 0.018, 0.0], [0.018, 0.01, 0.001], [0.0, 0.001, 0.09]])
    group = CorrelatedNormal("xyz", covariance, mean=[1.0, 2.0, 3.0])
    points = stats.qmc.Sobol(3, rng=np.random.default_rng(5)).random_base2(14) + 2.0**-34
    drawn = np.asarray(jax.vmap(group.quantile)(points))
    np.testing.assert_allclose(drawn.mean(axis=0), [1.0, 2.0, 3.0], atol=1e-3)
    np.testing.assert_allclose(np.cov(drawn.T), covariance, atol=1e-3)
    np.testing.assert_allclose(group.half_widths(), 3 * np.sqrt(np.diag(covariance)), rtol=1e-12)


def collection():
    group = CorrelatedNormal(("b", "d"), [[0.04, 0.01], [0.01, 0.01]])
    return Tolerances({"z": Uniform(0.3), "a": Normal(interval=(0.0, 0.6))}, correlated=group)


def test_collection_keeps_the_order_of_the_user():
    tolerances = collection()
    assert tolerances.names == ("z", "a", "b", "d")
    assert tolerances.factors == (("z",), ("a",), ("b", "d"))
    assert list(tolerances.half_widths()) == list(tolerances.names)
    np.testing.assert_allclose(list(tolerances.half_widths().values()), [0.3, 0.3, 0.6, 0.3])
    np.testing.assert_allclose(list(tolerances.means().values()), [0.0, 0.3, 0.0, 0.0])
    covariance = np.diag([0.03, 0.01, 0.04, 0.01])
    covariance[2, 3] = covariance[3, 2] = 0.01
    np.testing.assert_allclose(tolerances.covariance(), covariance, rtol=1e-12)
    low, high = tolerances.intervals()["a"]
    np.testing.assert_allclose([low, high], [0.0, 0.6], atol=1e-15)


def test_collection_maps_each_coordinate_to_its_error():
    tolerances = collection()
    point = jnp.asarray([0.75, 0.5, 0.9, 0.5])
    for errors in (tolerances.errors(point), jax.jit(lambda t, p: t.errors(p))(tolerances, point)):
        assert set(errors) == set(tolerances.names)
        np.testing.assert_allclose(errors["z"], 0.15, rtol=1e-12)
        np.testing.assert_allclose(errors["a"], 0.3, rtol=1e-12)
        quantile = stats.norm.ppf(0.9)
        np.testing.assert_allclose(errors["b"], 0.2 * quantile, rtol=1e-12)
        np.testing.assert_allclose(errors["d"], 0.05 * quantile, rtol=1e-12)


def test_new_half_widths_keep_centre_and_correlation():
    tolerances = collection()

    def spread(width):
        changed = tolerances.with_half_widths({"a": width, "d": 2.0 * width})
        return changed.covariance()

    covariance = spread(0.3)
    np.testing.assert_allclose(covariance[1, 1], 0.01, rtol=1e-12)
    np.testing.assert_allclose(covariance[3, 3], 0.04, rtol=1e-12)
    np.testing.assert_allclose(covariance[2, 3], 0.02, rtol=1e-12)
    np.testing.assert_allclose(jax.jacfwd(spread)(0.3)[1, 1], 2 * 0.3 / 9, rtol=1e-12)
    assert tolerances.with_half_widths({}).means()["a"] == tolerances.means()["a"]


@pytest.mark.parametrize(
    ("build", "words"),
    [
        (lambda: Uniform(-0.1), "`tolerance` must be zero or positive"),
        (lambda: Uniform(float("nan")), "`tolerance`"),
        (lambda: Uniform("0.5 dg"), "an angle, a length or another quantity with a unit"),
        (lambda: Uniform("-0.5 deg"), "`tolerance` must be zero or positive"),
        pytest.param(lambda: Uniform([0.1, 0.2]), "must be one number", marks=pytest.mark.wrong_types),
        (lambda: Normal(interval=("-0.1 mm", "0.1 deg")), "two ends of one unit"),
        (lambda: Uniform(), "neither is"),
        (lambda: Uniform(0.1, interval=(0, 1)), "both are"),
        (lambda: Triangular(interval=(1.0, -1.0)), "rise from low to high"),
        (lambda: Normal(0.1, deviations=0.0), "`deviations` must be positive"),
        (lambda: CorrelatedNormal("ab", [[1.0, 2.0], [2.0, 1.0]]), "positive definite"),
        (lambda: CorrelatedNormal("ab", [[1.0, 0.5], [0.0, 1.0]]), "not symmetric"),
        (lambda: CorrelatedNormal("ab", np.eye(3)), "shape"),
        (lambda: CorrelatedNormal("aa", np.eye(2)), "repeat"),
        pytest.param(lambda: Tolerances({"a": 0.1}), "Uniform(0.1)", marks=pytest.mark.wrong_types),
        (lambda: Tolerances({}), "names none"),
        (lambda: Tolerances({"a": Uniform(1)}, correlated=CorrelatedNormal("a", [[1]])), "twice"),
        (lambda: collection().with_half_widths({"aa": 0.1}), "did you mean `a`?"),
    ],
)
def test_bad_tolerances_are_refused(build, words):
    with pytest.raises(InputError, match="Argument `.*must") as caught:
        build()
    assert words in str(caught.value)


def test_function_problem_completes_names_and_reports_status():
    def function(errors):
        status = jnp.where(errors["b"] > 1.0, 3, 0)
        return {"y": errors["a"] + 2.0 * errors["b"], "unused": errors["a"]}, status

    problem = FunctionProblem(
        function,
        ("a", "b"),
        (Metric("y", "N", even=False),),
        error_units={"b": "m"},
        statuses={3: "does not assemble"},
    )
    values, status = jax.jit(problem)({"b": jnp.asarray(1.5)})
    assert values == {"y": 3.0} and status == 3 and status.dtype == jnp.int32
    assert problem.describe_status(3) == "does not assemble"
    assert problem.describe_status(0) == "ok" and problem.describe_status(8) == "status 8"
    assert (problem.error_unit("a"), problem.error_unit("b")) == ("rad", "m")
    assert problem.metrics[0].label == "y"
    gradient = jax.jacrev(lambda e: problem(e)[0])({"a": 0.0, "b": 0.0})["y"]
    assert (gradient["a"], gradient["b"]) == (1.0, 2.0)


def test_function_problem_refuses_unknown_names():
    problem = FunctionProblem(lambda e: {"y": e["a"]}, ("a",), ("y",))
    with pytest.raises(InputError, match="did you mean `a`"):
        problem({"aa": jnp.asarray(1.0)})
    with pytest.raises(InputError, match="`metrics` must name"):
        FunctionProblem(lambda e: {"x": e["a"]}, ("a",), ("y",))({})
    with pytest.raises(InputError, match="repeat"):
        FunctionProblem(lambda e: e, ("a", "a"), ("y",))
    with pytest.raises(InputError, match="SI units"):
        FunctionProblem(lambda e: e, ("a",), ("y",), error_units={"a": "deg"})


def test_single_precision_is_refused():
    with jax.enable_x64(False), pytest.raises(InputError, match="jax_enable_x64"):
        Uniform(0.1)
