"""Sensitivities of closed-form problems: derivatives, symmetry, kinks, principal directions."""

from typing import ClassVar

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfem_jax import FunctionProblem, InputError, Metric, expand, sensitivity
from rfem_jax.tolerancing.problems.linearisation import REVERSE_COST, choose_mode, linearise_points
from rfem_jax.tolerancing.problems.quadratic_model import _signs

jax.config.update("jax_enable_x64", True)

NAMES = ("D.delta_x", "D.delta_z", "coupler.length")
HESSIAN = np.array([[4.0, 1.0, 0.0], [1.0, 3.0, 0.0], [0.0, 0.0, 0.0]])
WIDTHS = {"D.delta_x": 0.5, "D.delta_z": 0.25, "coupler.length": 0.1}


def vector(errors, names=NAMES):
    return jnp.stack([errors[name] for name in names])


def loads(errors):
    """A mean-square moment (zero at the nominal point), its root, and a force with a gradient."""
    e = vector(errors)
    moment = 0.5 * e @ jnp.asarray(HESSIAN) @ e
    force = 2.0 + 3.0 * e[2] + 5.0 * e[0] ** 2 + e[1] ** 2 * e[2]
    return {"moment_squared": moment, "moment": jnp.sqrt(moment), "force": force}


METRICS = (
    Metric("moment_squared", "(N m)^2", "mean-square moment", True),
    Metric("moment", "N m", "RMS moment", True),
    Metric("force", "N", "RMS force"),
)


@pytest.fixture
def problem():
    return FunctionProblem(loads, NAMES, METRICS, error_units={"coupler.length": "m"})


def smooth(errors):
    x = vector(errors, [f"e{i}" for i in range(7)])
    return {"a": jnp.sum(x**3) * jnp.exp(x[0]), "b": jnp.prod(1.0 + x) * jnp.sin(x[1] + x[2])}


@pytest.mark.parametrize("mode", ["forward", "reverse"])
@pytest.mark.parametrize("batch", [32, 3])
def test_expansion_equals_differences_of_values_in_both_modes_and_in_chunks(mode, batch):
    names = tuple(f"e{i}" for i in range(7))
    many = FunctionProblem(smooth, names, ("a", "b"))
    at = {name: 0.1 * i - 0.2 for i, name in enumerate(names)}
    model = expand(many, at, mode=mode, batch=batch)
    x = np.array(list(at.values()))

    def values(y):
        return np.array(list(many(dict(zip(names, y, strict=True)))[0].values()))

    h = 1e-5
    steps = h * np.eye(7)
    gradient = np.stack([(values(x + d) - values(x - d)) / (2 * h) for d in steps], axis=1)
    np.testing.assert_allclose(model.gradient, gradient, rtol=1e-8, atol=1e-9)
    h, steps = 1e-4, 1e-4 * np.eye(7)
    hessian = [
        [(values(x + a + b) - values(x + a - b) - values(x - a + b) + values(x - a - b))
         / (4 * h * h) for b in steps] for a in steps
    ]  # fmt: skip
    np.testing.assert_allclose(model.hessian, np.moveaxis(hessian, 2, 0), atol=2e-6)
    assert np.all(np.asarray(model.asymmetry) < 1e-14)
    np.testing.assert_allclose(model.value, values(x), rtol=1e-14)


def test_mode_follows_the_numbers_and_can_be_set(problem):
    assert choose_mode("auto", 3 * REVERSE_COST, 3) == "forward"
    assert choose_mode("auto", 3 * REVERSE_COST + 1, 3) == "reverse"
    names = tuple(f"e{i}" for i in range(7))
    one = FunctionProblem(lambda e: {"a": sum(e.values())}, names, ("a",))
    assert sensitivity(one, order=1).mode == "reverse"
    assert sensitivity(one, order=1, mode="forward").mode == "forward"
    with pytest.raises(InputError, match="`mode` must be one of"):
        sensitivity(problem, mode="backward")


def test_root_of_a_mean_square_that_vanishes_has_a_kink_and_the_derivatives_of_the_hessian(problem):
    result = sensitivity(problem, scale=WIDTHS)
    assert result.character == ("kink", "none", "mixed")
    assert list(result.vanishing[0]) == [True, True, False]
    np.testing.assert_allclose(result.hessian[0], HESSIAN, atol=1e-14)
    np.testing.assert_allclose(result.root_derivatives[0], np.sqrt([2.0, 1.5, 0.0]) * [0.5, 0.25, 0.1])
    direction = {"D.delta_x": 0.3, "D.delta_z": -0.4}
    root = problem({name: jnp.asarray(value) for name, value in direction.items()})[0]["moment"]
    assert result.root_derivative("moment_squared", direction) == pytest.approx(float(root), rel=1e-13)
    with pytest.raises(InputError, match="zero at the point"):
        result.root_derivative("force", direction)


def test_rounding_of_an_error_without_effect_hides_no_kink():
    def function(e):
        return {"square": 5e-10 + 4.0 * e["a"] ** 2 + 1e-18 * e["b"] + 1e-22 * e["b"] ** 2}

    result = sensitivity(FunctionProblem(function, ("a", "b"), ("square",)))
    assert result.character == ("kink",) and result.vanishing.tolist() == [[True, False]]
    np.testing.assert_allclose(result.root_derivatives[0], [2.0, 0.0], atol=1e-10)
    assert "= 0; zero and even at this point" in str(result)


def test_one_sided_derivative_is_the_limit_of_the_root_along_a_small_error(problem):
    result = sensitivity(problem, scale=WIDTHS)
    direction = {"D.delta_x": 1.0, "D.delta_z": 2.0}
    small = {name: jnp.asarray(1e-6 * value) for name, value in direction.items()}
    growth = float(problem(small)[0]["moment"]) / 1e-6
    assert result.root_derivative("moment_squared", direction) == pytest.approx(growth, rel=1e-9)


def test_gradient_per_tolerance_effects_and_ranking(problem):
    result = sensitivity(problem, scale=WIDTHS)
    force = result.metrics.index("force")
    np.testing.assert_allclose(result.gradient[force], [0.0, 0.0, 3.0], atol=1e-14)
    np.testing.assert_allclose(result.gradient_scaled[force], [0.0, 0.0, 0.3], atol=1e-14)
    assert [name for name, _ in result.ranking("force")] == [
        "D.delta_x", "coupler.length", "D.delta_z"
    ]  # fmt: skip
    # 5 e^2 at e = 0.5 and 3 e at e = 0.1: changes of the metric itself.
    np.testing.assert_allclose(result.effects[force], [1.25, 0.0, 0.3], atol=1e-14)
    assert len(result.rows()) == 9 and result.rows()[0]["rank"] == 1


def test_principal_directions_are_eigenvectors_of_the_scaled_hessian(problem):
    result = sensitivity(problem, scale=WIDTHS)
    t = np.array(list(WIDTHS.values()))
    scaled = HESSIAN * np.outer(t, t)
    (value, direction), *rest = result.principal_directions("moment_squared")
    v = np.array([direction[name] for name in NAMES])
    np.testing.assert_allclose(scaled @ v, value * v, atol=1e-14)
    assert value >= max(abs(other) for other, _ in rest)
    assert np.all(np.isnan(result.eigenvalues[1]))


def test_away_from_zero_every_gradient_is_honest(problem):
    result = sensitivity(problem, {"D.delta_x": 0.1, "D.delta_z": 0.2}, scale=WIDTHS)
    assert result.character[:2] == ("slope", "slope") and not result.vanishing[:2].any()
    e = np.array([0.1, 0.2, 0.0])
    root = np.sqrt(0.5 * e @ HESSIAN @ e)
    np.testing.assert_allclose(result.gradient[1], HESSIAN @ e / (2 * root), rtol=1e-12)


def test_errors_that_are_not_varied_stay_where_they_are(problem):
    result = sensitivity(problem, {"D.delta_x": 0.1}, scale={"D.delta_z": 0.25}, order=1)
    assert result.names == ("D.delta_z",) and result.hessian is None
    np.testing.assert_allclose(result.gradient[0], [0.1], rtol=1e-14)


def test_mean_of_the_quadratic_model_equals_a_quadrature(problem):
    covariance = np.array([[0.04, 0.01, 0.0], [0.01, 0.09, 0.0], [0.0, 0.0, 0.01]])
    model = expand(problem)
    nodes, weights = np.polynomial.hermite_e.hermegauss(4)
    root = np.linalg.cholesky(covariance)
    total = 0.0
    for i, wi in zip(nodes, weights, strict=True):
        for j, wj in zip(nodes, weights, strict=True):
            e = root @ np.array([i, j, 0.0])
            total += wi * wj * 0.5 * e @ HESSIAN @ e / (2 * np.pi)
    assert float(model.mean(jnp.asarray(covariance))[0]) == pytest.approx(total, rel=1e-12)


def test_refined_problem_shows_how_far_derivatives_can_be_trusted(problem):
    def coarse(errors):
        return {**loads(errors), "force": loads(errors)["force"] + 0.03 * errors["coupler.length"]}

    other = FunctionProblem(coarse, NAMES, METRICS, error_units={"coupler.length": "m"})
    result = sensitivity(other, scale=WIDTHS, refined=problem)
    assert result.gradient_change[2, 2] == pytest.approx(0.03 / 3.03, rel=1e-9)
    assert result.gradient_change[2, 0] == 0.0 and result.hessian_change[0] == 0.0


@pytest.mark.parametrize(("slope", "status"), [(0.03, "ok"), (3.0, "derivative_not_reproduced")])
def test_derivatives_through_impacts_that_a_finer_step_does_not_reproduce_are_refused(problem, slope, status):
    def coarse(errors):
        return {**loads(errors), "force": loads(errors)["force"] + slope * errors["coupler.length"]}

    class Striking(FunctionProblem):
        strikes = True

    kinds = Striking, FunctionProblem
    striking, still = (kind(coarse, NAMES, METRICS, error_units={"coupler.length": "m"}) for kind in kinds)
    found = sensitivity(striking, scale=WIDTHS, refined=problem)
    assert found.status == status and ("impacts" in str(found)) == (status != "ok")
    assert sensitivity(still, scale=WIDTHS, refined=problem).status == "ok"


@pytest.mark.parametrize(("share", "status"), [(0.01, "ok"), (1.0, "derivative_not_reproduced")])
def test_second_derivatives_count_where_gradients_vanish(share, status):
    """Of a metric that is even, at the nominal point, beside one with a kink there and one that no error changes."""

    def at_nominal(share):
        def values(errors):
            square = (1.0 + share) * errors["D.delta_x"] ** 2
            return {"square": 2.0 + square, "root": jnp.sqrt(square), "fixed": 3.0 + 0.0 * square}

        return values

    class Striking(FunctionProblem):
        strikes = True

    names = "square", "root", "fixed"
    refined = FunctionProblem(at_nominal(0.0), "D.delta_x", names)
    found = sensitivity(Striking(at_nominal(share), "D.delta_x", names), scale={"D.delta_x": 0.5}, refined=refined)
    assert found.status == status
    others = FunctionProblem(lambda e: {"force": e["D.delta_x"] + jnp.sqrt(0.0 * e["D.delta_x"])}, "D.delta_x", "force")
    striking = Striking(lambda e: {"force": e["D.delta_x"]}, "D.delta_x", "force")
    assert sensitivity(striking, scale={"D.delta_x": 0.5}, refined=others).status == "derivative_not_reproduced"


def test_rounding_where_derivatives_vanish_is_no_impact():
    """At the nominal point, to first order."""

    def at_nominal(slope):
        def values(errors):
            return {"force": 5.0 + slope * errors["D.delta_x"] + errors["D.delta_x"] ** 2}

        return values

    class Striking(FunctionProblem):
        strikes = True

    metric, fine = Metric("force", "N", "RMS force", True), at_nominal(-1e-14)
    for slope, status in ((1e-14, "ok"), (1e-3, "derivative_not_reproduced")):
        striking = Striking(at_nominal(slope), "D.delta_x", metric)
        refined = FunctionProblem(fine, "D.delta_x", metric)
        assert sensitivity(striking, order=1, scale={"D.delta_x": 0.5}, refined=refined).status == status


def test_table_names_what_symmetry_says_and_a_failed_point_has_its_status(problem):
    text = str(sensitivity(problem, scale=WIDTHS))
    assert "0 (symmetry)" in text and "its square root has a kink" in text
    assert "take its mean square" in text
    broken = FunctionProblem(lambda e: ({"a": e["x"]}, jnp.asarray(3)), ("x",), ("a",), statuses={3: "diverged"})
    assert sensitivity(broken, order=1).status == "diverged"


def test_bad_input_is_refused_with_the_nearest_name(problem):
    with pytest.raises(InputError, match="did you mean `coupler.length`"):
        sensitivity(problem, scale={"coupler.lenght": 0.1})
    with pytest.raises(InputError, match="positive half-widths"):
        sensitivity(problem, scale={"D.delta_x": 0.0})
    with pytest.raises(InputError, match="`order` must be 1 or 2"):
        sensitivity(problem, order=3)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("mode", "order", "batch", "told"),
    [
        ("forward", 2, 16, [2, 4, 6, 7]),  # 7 tangents within each of 2 directions
        ("reverse", 2, 7, [3, 6, 7]),  # 2 cotangents within each of 3
        ("forward", 1, 4, [4, 7]),
        ("reverse", 1, 4, [7]),
        ("forward", 2, 64, [7]),
    ],
)
def test_progress_counts_directions_and_changes_no_number(mode, order, batch, told):
    names = tuple(f"e{i}" for i in range(7))
    many = FunctionProblem(smooth, names, ("a", "b"))
    at = {name: 0.1 * i - 0.2 for i, name in enumerate(names)}
    seen = []
    found = sensitivity(many, at, order, mode=mode, batch=batch, progress=lambda *pair: seen.append(pair))
    assert seen == [(count, 7) for count in told]
    whole = sensitivity(many, at, order, mode=mode, batch=1000)
    np.testing.assert_allclose(found.gradient, whole.gradient, rtol=1e-13)
    if order == 2:
        np.testing.assert_allclose(found.hessian, whole.hessian, rtol=1e-12, atol=1e-13)
    seen.clear()
    sensitivity(many, at, order, mode=mode, batch=batch, refined=many, progress=lambda *pair: seen.append(pair))
    assert seen == [(first + count, 14) for first in (0, 7) for count in told]


def test_progress_is_shown_in_directions(problem, capfd):
    sensitivity(problem, order=1, mode="forward", batch=2, progress=True)
    lines = [line for line in capfd.readouterr().err.splitlines() if "%" in line]
    assert [line.partition(" %")[0] for line in lines] == ["3 directions:  66", "3 directions: 100"]
    sensitivity(problem, order=1)
    assert capfd.readouterr().err == ""


def test_linearisation_of_many_points_marks_failed_ones():
    def function(errors):
        return {"a": errors["x"] ** 2}, jnp.where(errors["x"] > 1.0, 1, 0)

    values, jacobian, status = linearise_points(
        FunctionProblem(function, ("x",), ("a",)), ("x",), {}, [[0.5], [1.5], [-2.0]], batch=2
    )
    np.testing.assert_allclose(values[[0, 2], 0], [0.25, 4.0])
    np.testing.assert_allclose(jacobian[[0, 2], 0, 0], [1.0, -4.0])
    assert np.isnan(values[1, 0]) and list(status) == [0, 1, 0]


def solved_up_to(share):
    """The closed-form loads, as if of equations whose differentiated residual is a share of the forces."""

    class Solved(FunctionProblem):
        derivative_limit: ClassVar[float] = 0.05

        def with_residual(self, errors):
            values, status = self(errors)
            forces = jnp.sin(jnp.arange(180.0) ** 2).reshape(60, 3) * vector(errors)[None]
            return values, status, share * jnp.concatenate([forces, forces]) / np.sqrt(2.0), forces

    return Solved(loads, NAMES, METRICS)


def test_signs_of_the_sums_of_residuals_have_no_pattern():
    """The mean of the squared sums is the sum of the squares, within what independent signs would give."""
    count, size = 8, 3000
    signs = np.asarray(_signs(count, size))
    assert np.all(np.abs(signs) == 1.0)
    products = [signs[:, k:] * signs[:, : size - k] for k in (1, 2, 3, 7, 60)]  # of neighbours, and of saved times
    products += [signs[i] * signs[j] for i in range(count) for j in range(i)] + [signs]
    assert all(abs(one.mean()) < 4.0 / np.sqrt(one.size) for one in products)


def test_an_error_without_effect_has_no_residual():
    """Its forces and residuals change by rounding, of any ratio."""

    class Rounded(FunctionProblem):
        derivative_limit: ClassVar[float] = 0.05

        def with_residual(self, errors):
            values, status = self(errors)
            signs = jnp.sign(jnp.sin(jnp.arange(180.0) ** 2)).reshape(60, 3)
            return values, status, 3e-16 * errors["x"] * signs, (90.0 + 1e-16 * errors["x"]) * signs

    rounded = Rounded(lambda e: {"f": 2.0 + 0.0 * e["x"]}, ("x",), "f")
    for mode in ("forward", "reverse"):
        found = sensitivity(rounded, None, 1, {"x": 1e-3}, mode)
        assert found.status == "ok" and found.derivative_residual < 1e-6


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("mode", ["forward", "reverse"])
def test_the_residual_of_the_differentiated_equations_is_reported(problem, mode, order):
    at = {"D.delta_x": 0.1, "coupler.length": 0.2}
    plain = sensitivity(problem, at, order, WIDTHS, mode)
    assert plain.derivative_residual is None and "residual" not in str(plain)
    for share, status in ((1e-3, "ok"), (0.5, "derivative_not_converged")):
        found = sensitivity(solved_up_to(share), at, order, WIDTHS, mode)
        assert found.status == status and "residual of the differentiated equations" in str(found)
        # An estimate, from few sums in reverse mode.
        assert 0.3 * share < found.derivative_residual < 3.0 * share
        np.testing.assert_allclose(found.gradient, plain.gradient, rtol=1e-12)
        if order == 2:
            np.testing.assert_allclose(found.hessian, plain.hessian, rtol=1e-12, atol=1e-12)


@pytest.mark.parametrize("order", [1, 2])
def test_a_metric_without_a_value_has_no_derivatives(order):
    """Its branch with a number has some, which would be those of another point."""
    problem = FunctionProblem(
        lambda errors: {"none": jnp.where(errors["a"] > 1.0, errors["a"], jnp.nan), "some": errors["a"] ** 2},
        "a", ("none", "some"),
    )  # fmt: skip
    found = sensitivity(problem, {"a": 0.5}, order=order)
    assert found.status == "no_value" and "no value of none:" in str(found)
    assert np.isnan(found.gradient[0]).all() and found.gradient[1, 0] == pytest.approx(1.0)
    if order == 2:
        assert np.isnan(found.hessian[0]).all() and found.hessian[1, 0, 0] == pytest.approx(2.0)
