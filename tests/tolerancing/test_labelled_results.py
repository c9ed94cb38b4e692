"""Results of tolerance studies as labelled data, of a quadratic whose derivatives and extremes are known; how text and
HTML are made of what any result shows."""

from html import escape

import jax
import numpy as np
import pytest
import xarray

from rfem_jax import (
    FunctionProblem,
    Metric,
    Normal,
    Reciprocal,
    Tolerances,
    Uniform,
    allocate,
    monte_carlo,
    optimise,
    reliability,
    sensitivity,
    sweep,
    worst_case,
)
from rfem_jax.labelled_data import Labelled, LabelledResult, Table

HOSTILE = '<img src=x onerror="alert(1)">'
NAMES = ("a", HOSTILE)
METRICS = (Metric("square", "N^2", "a square"), Metric(HOSTILE, "N", "a sum"))
WIDTHS = {"a": 0.1, HOSTILE: 0.2}
KEY = jax.random.key(1)
KINDS = ("sensitivity", "monte_carlo", "worst_case", "allocation", "optimum", "sweep", "reliability")


def values(errors):
    a, b = errors["a"], errors[HOSTILE]
    return {"square": 3.0 + 2.0 * a**2 + a * b, HOSTILE: 5.0 + a - 2.0 * b}


@pytest.fixture(scope="module")
def problem():
    return FunctionProblem(values, NAMES, METRICS, error_units={HOSTILE: "m"})


@pytest.fixture(scope="module")
def results(problem):
    """{kind: result}"""
    tolerances = Tolerances({name: Uniform(width) for name, width in WIDTHS.items()})
    asked = {"limits": {"square": 3.02}, "sobol_indices": True, "control_variate": True}
    bounds = {name: (0.01 * width, 10.0 * width) for name, width in WIDTHS.items()}
    return {
        "sensitivity": sensitivity(problem, scale=tolerances),
        "monte_carlo": monte_carlo(problem, tolerances, 64, KEY, batch=64, **asked),
        "worst_case": worst_case(problem, tolerances, HOSTILE, key=KEY),
        "allocation": allocate(problem, {HOSTILE: 5.5}, Reciprocal(1.0), bounds, key=KEY),
        "optimum": optimise(
            problem, {"a": (-0.5, 1.0)}, {HOSTILE: (0.01, 2.0)}, {"square": 1.0, "cost": 0.1}, {HOSTILE: 5.5},
            cost=Reciprocal(1.0), key=KEY,
        ),
        "sweep": sweep(problem, {name: (-width, width) for name, width in WIDTHS.items()}, levels=3),
        "reliability": reliability(
            problem, Tolerances({name: Normal(0.3) for name in NAMES}), {HOSTILE: 5.5}, KEY, n=512
        ),
    }  # fmt: skip


@pytest.mark.long
def test_a_dataset_of_sensitivities(results):
    found, result = results["sensitivity"].to_xarray(), results["sensitivity"]
    np.testing.assert_allclose(found.gradient.sel(metric=HOSTILE), [1.0, -2.0], atol=1e-12)
    assert float(found.hessian.sel(metric="square", error="a", error_2=HOSTILE)) == pytest.approx(1.0)
    assert str(found.metric_unit.sel(metric="square").values) == "N^2"
    assert [str(unit) for unit in found.error_unit.values] == ["rad", "m"]
    np.testing.assert_array_equal(found.effect, result.effects)
    np.testing.assert_array_equal(found.principal_direction[0], result.directions[0])
    assert found.attrs["status"] == "ok"


def test_a_dataset_of_samples(results):
    found, result = results["monte_carlo"].to_xarray(), results["monte_carlo"]
    assert dict(found.value.sizes) == {"sample": 64 * 4, "metric": 2}
    a, b = (found.error_value.sel(error=name) for name in NAMES)
    np.testing.assert_allclose(found.value.sel(metric=HOSTILE), 5.0 + a - 2.0 * b)
    mean = found["mean"].sel(metric="square")
    assert [float(one) for one in mean] == [
        getattr(result.statistics["square"].mean, end) for end in ("value", "low", "high")
    ]
    median = found.quantiles.sel(metric=HOSTILE, quantile=0.5, estimate="value")
    assert float(median) == result.statistics[HOSTILE].quantiles[0.5].value
    passed = found.yield_of_all.sel(metric="square", estimate="value")
    assert float(passed) == result.yields["square"].of_all.value
    assert np.isnan(found.yield_of_all.sel(metric=HOSTILE)).all() and float(found.upper_limit[0]) == 3.02
    assert float(found.total_index.sel(metric=HOSTILE, factor="a", estimate="value")) == pytest.approx(1 / 17, abs=0.03)
    assert float(found.controlled_mean.sel(metric="square", estimate="value")) == pytest.approx(3.0 + 2e-2 / 3.0)


def test_a_dataset_of_a_worst_case(results):
    found = results["worst_case"].to_xarray()
    assert float(found.value) == pytest.approx(5.5) and found.value.attrs["units"] == "N"
    np.testing.assert_allclose(found.worst_error, [0.1, -0.2])
    np.testing.assert_allclose(np.sort(found.corner_value), [4.5, 4.7, 5.3, 5.5])


def test_a_dataset_of_an_allocation(results):
    found = results["allocation"].to_xarray()
    # min 1/t1 + 1/t2 with t1 + 2 t2 = 1/2: t1 = sqrt(2) t2
    second = 0.5 / (2.0 + np.sqrt(2.0))
    np.testing.assert_allclose(found.tolerance, [np.sqrt(2.0) * second, second], rtol=2e-3)
    assert float(found.limit[0]) == 5.5 and str(found.side.values[0]) == "upper"
    assert str(found.limit_unit.values[0]) == "N" and found.attrs["status"] == "ok"


def test_a_dataset_of_an_optimum(results):
    found, result = results["optimum"].to_xarray(), results["optimum"]
    # min 3 + 2 a^2 + 0.1 / t with a + 2 t = 1/2 in the worst case: 4 a + 0.2 / (1/2 - a)^2 = 0.
    (a,) = (root.real for root in np.roots([1.0, -1.0, 0.25, 0.05]) if root.real < 0.0)
    assert float(found.design_value.sel(design="a")) == pytest.approx(a, rel=1e-4)
    assert float(found.tolerance.sel(error=HOSTILE)) == pytest.approx((0.5 - a) / 2.0, rel=1e-4)
    assert float(found.initial_value[0]) == 0.0 and str(found.design_unit[0].values) == "rad"
    assert float(found.term_value.sel(term="cost")) == pytest.approx(2.0 / (0.5 - a), rel=1e-4)
    assert float(found.weight.sel(term="cost")) == 0.1 and float(found.objective) == result.objective
    assert float(found.limit[0]) == 5.5 and str(found.limit_unit.values[0]) == "N" and found.attrs["status"] == "ok"
    assert float(found.verified[0]) == pytest.approx(5.5) and np.isnan(float(found.verified_yield))
    np.testing.assert_array_equal(found.objective_of_solution, [one for one, _ in result.history])


def test_a_dataset_of_a_sweep(results):
    found = results["sweep"].to_xarray()
    a, b = (found.error_value.sel(error=name) for name in NAMES)
    np.testing.assert_allclose(found.value.sel(metric=HOSTILE), 5.0 + a - 2.0 * b)
    np.testing.assert_allclose(found.surface, found.value, rtol=1e-12)  # which is quadratic
    np.testing.assert_allclose(found.effect.sel(metric=HOSTILE), [0.1, 0.4])
    np.testing.assert_allclose(found.bounds.sel(error=HOSTILE), [-0.2, 0.2])


def test_a_dataset_of_a_reliability_study(results):
    found, result = results["reliability"].to_xarray(), results["reliability"]
    # a - 2 b > 1/2: both have a standard deviation of 0.1, a - 2 b one of sqrt(5) / 10; (1, -2) is the way there.
    assert float(found.beta[0]) == pytest.approx(np.sqrt(5.0), rel=1e-4)
    np.testing.assert_allclose(found.error_value[0], [0.1, -0.2], rtol=1e-3)
    assert str(found.metric.values[0]) == HOSTILE and str(found.limit_unit.values[0]) == "N"
    low, high = (float(found.probability[0].sel(estimate=end)) for end in ("low", "high"))
    assert low < 0.0126736 < high and float(found.any_limit[0]) == result.any_limit.value


@pytest.mark.parametrize("kind", KINDS)
def test_netcdf_keeps_everything(results, tmp_path, kind):
    found = results[kind].to_xarray()
    found.to_netcdf(tmp_path / "result.nc", engine="scipy")
    with xarray.open_dataset(tmp_path / "result.nc", engine="scipy") as read:
        assert set(read.variables) == set(found.variables)
        for name, variable in found.variables.items():
            expected = variable.values
            if expected.dtype.kind == "U":
                assert [str(one) for one in read[name].values] == expected.tolist()
            else:
                np.testing.assert_array_equal(read[name].values, expected, err_msg=name)


def test_tables(results):
    ranked = results["sensitivity"].to_pandas()
    assert ranked.loc[(HOSTILE, HOSTILE), "gradient"] == pytest.approx(-2.0)
    samples = results["monte_carlo"].to_pandas()
    assert list(samples.columns) == ["status", "a_rad", f"{HOSTILE}_m", "square_N2", f"{HOSTILE}_N"]
    assert len(samples) == results["monte_carlo"].samples
    points = results["worst_case"].to_pandas()
    assert points.loc[(HOSTILE, "nominal"), "value"] == pytest.approx(5.0)
    assert points.loc[(HOSTILE, "best_corner"), "a_rad"] == pytest.approx(0.1)
    answer = results["allocation"]
    assert answer.to_pandas().loc["a", "tolerance"] == answer.tolerances["a"]
    assert answer.to_pandas(limits=True).loc[(HOSTILE, "upper"), "verified"] == answer.limits[0].verified
    optimum = results["optimum"]
    table = optimum.to_pandas()
    assert table.loc[("a", "dimension"), "value"] == optimum.designs["a"]
    assert table.loc[(HOSTILE, "tolerance"), "value"] == optimum.tolerances[HOSTILE]
    assert optimum.to_pandas(limits=True).loc[(HOSTILE, "upper"), "verified"] == optimum.limits[0].verified


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_html_is_escaped(results, kind):
    text = results[kind]._repr_html_()
    assert "<img" not in text and "&lt;img src=x onerror=&quot;" in text and text.count("<table>") >= 1


@pytest.mark.parametrize("kind", KINDS)
def test_terminal_and_notebook_show_the_same(results, kind):
    text, shown = str(results[kind]), results[kind]._repr_html_()
    tables = [one for one in results[kind].parts() if isinstance(one, Table)]
    assert tables
    for table in tables:
        for cell in (cell for row in (table.header, *table.rows) for cell in row):
            assert cell in text and f">{escape(cell)}</" in shown


class Small(LabelledResult):
    """A result with everything that a kind gives."""

    index = ("name",)

    def arrays(self):
        variables = {"length": Labelled(("name",), [1.5, 2.0], "m", "of the bar"), "left_out": Labelled((), None)}
        return variables, {"name": ("a", "<b>")}, {"title": "Small", "absent": None}

    def rows(self):
        return [{"name": "a", "length_m": 1.5}, {"name": "<b>", "length_m": 2.0}]

    def parts(self):
        return ["Small: " + "word " * 30, "", Table(("name", "length"), (("a", "1.5"), ("<b>", "2"))), "1 < 2"]


def test_all_forms_of_any_result():
    found = Small().to_xarray()
    assert float(found.length.sel(name="<b>")) == 2.0 and found.length.attrs == {
        "units": "m",
        "long_name": "of the bar",
    }
    assert list(found.data_vars) == ["length"] and found.attrs == {"title": "Small"}
    assert Small().to_pandas().loc["a", "length_m"] == 1.5
    first, second, *rest = str(Small()).splitlines()
    assert len(first) <= 120 and second.startswith("  word")
    assert rest == ["", "name  length", "------------", "a        1.5", "<b>        2", "1 < 2"]
    shown = Small()._repr_html_()
    assert (
        shown.startswith("<div><b>Small: word") and shown.endswith("<p>1 &lt; 2</p></div>") and "<p></p>" not in shown
    )
    assert [shown.count(one) for one in ("<table>", ">&lt;b&gt;</td>", "text-align:left", "text-align:right")] == [
        1,
        1,
        3,
        3,
    ]
