"""Tasks of a study file: what is read, what is resolved, and every way to get one wrong."""

import math
from pathlib import Path

import numpy as np
import pytest

from rfem_jax import load_study
from rfem_jax.description.tasks import AllocationTask, ErrorCost, MonteCarloTask, SensitivityTask, Tasks, WorstCaseTask
from rfem_jax.description.tolerances.tolerances import CorrelatedTolerances, SpecifiedTolerance

STUDIES = Path(__file__).parents[2] / "studies"
FOUR_BAR = (STUDIES / "four_bar" / "study.toml").read_text(encoding="utf-8")
TASKS = """
[tolerances]
"D.delta_x" = "0.25 deg"
"D.delta_z" = { half_width = "0.5 deg", distribution = "truncated_normal", deviations = 2 }
"D.d_y" = { interval = ["-0.1 mm", "0.3 mm"], distribution = "triangular" }
[[tolerances.correlated]]
half_widths = { "B.d_x" = "0.3 mm", "B.d_z" = "0.6 mm" }
correlation = 0.5
[sensitivity]
metrics = ["*.mean_square_moment", "D.mean_square_moment", "end_energy"]
at = { "D.delta_x" = "0.1 deg" }
half_step = true
[monte_carlo]
n = 64
limits = { "*.rms_moment" = 3.0, "angle_error" = [-1.0, inf] }
[worst_case]
metrics = "D.mean_square_force"
starts = { corners = 2 }
[allocation]
limits = { "D.mean_square_moment" = 10.0 }
scales = [0.5, 2]
[allocation.bounds]
"D.delta_x" = ["0.05 deg", "1 deg"]
"B.d_x" = ["0.05 mm", "1 mm"]
"C.d_x" = [1e-5, 1e-3]
[allocation.cost]
model = "reciprocal"
price = 2
"B.d_x" = { model = "exponential", at = "0.2 mm" }
"""


def load(tmp_path, text):
    path = tmp_path / "study.toml"
    path.write_text(FOUR_BAR + text, encoding="utf-8")
    return load_study(path).tasks


@pytest.fixture
def tasks(tmp_path):
    return load(tmp_path, TASKS)


def test_tolerances_are_read_in_si_units(tasks):
    x, z, y = tasks.tolerances.independent
    assert (x.error, x.distribution, x.deviations) == ("D.delta_x", "uniform", None)
    assert x.interval == pytest.approx((-math.radians(0.25), math.radians(0.25)))
    assert (z.distribution, z.deviations) == ("truncated_normal", 2.0)
    assert z.half_width == pytest.approx(math.radians(0.5))
    assert y.interval == pytest.approx((-1e-4, 3e-4))
    assert y.half_width == pytest.approx(2e-4)
    (group,) = tasks.tolerances.correlated
    # 3 deviations in the half-width: sigma 0.1 and 0.2 mm.
    expected = [[1e-8, 1e-8], [1e-8, 4e-8]]
    np.testing.assert_allclose(group.covariance(), expected, rtol=1e-12)
    names = ("D.delta_x", "D.delta_z", "D.d_y", "B.d_x", "B.d_z")
    assert tasks.tolerances.names == names
    assert tasks.tolerances.half_widths()["B.d_z"] == pytest.approx(6e-4)


def test_tasks_are_read_and_a_star_stands_for_all_joints(tasks):
    assert tasks.declared == ("sensitivity", "monte_carlo", "worst_case", "allocation")
    joints = ("A", "B", "D", "C")
    moments = tuple(f"{joint}.mean_square_moment" for joint in joints)
    assert tasks.sensitivity.metrics == (*moments, "end_energy")
    assert tasks.sensitivity.at == {"D.delta_x": pytest.approx(math.radians(0.1))}
    assert (tasks.sensitivity.order, tasks.sensitivity.half_step) == (2, True)
    limits = {f"{joint}.rms_moment": (-math.inf, 3.0) for joint in joints}
    assert tasks.monte_carlo.limits == {**limits, "angle_error": (-1.0, math.inf)}
    assert tasks.monte_carlo.metrics == tuple(tasks.monte_carlo.limits)
    assert tasks.worst_case.metrics == ("D.mean_square_force",)
    assert tasks.worst_case.starts == {"corners": 2, "random": 0, "sobol": 0}
    assert tasks.allocation.scales == (0.5, 2.0)


def test_costs_are_shared_and_refer_to_the_specified_tolerance(tasks):
    costs, bounds = tasks.allocation.costs, tasks.allocation.bounds
    assert bounds["D.delta_x"] == pytest.approx((math.radians(0.05), math.radians(1.0)))
    expected = ErrorCost("reciprocal", 2.0, pytest.approx(math.radians(0.25)))
    assert costs["D.delta_x"] == expected
    assert costs["B.d_x"] == ErrorCost("exponential", 2.0, pytest.approx(2e-4))
    # No tolerance of this error is specified: its largest bound.
    assert costs["C.d_x"].at == pytest.approx(1e-3)


def test_a_study_without_tasks_declares_none(tmp_path):
    assert load(tmp_path, "") == Tasks()
    assert Tasks().declared == ()


@pytest.mark.parametrize(
    ("file", "task"),
    [
        ("tolerance_sensitivity/study.toml", "sensitivity"),
        ("monte_carlo/study.toml", "monte_carlo"),
        ("tolerance_allocation/study.toml", "allocation"),
        ("tolerance_allocation/yield.toml", "allocation"),
        ("tolerance_allocation/all_joints.toml", "allocation"),
    ],
)
def test_the_projects_studies_declare_what_their_names_say(file, task):
    assert task in load_study(STUDIES / file).tasks.declared


def without(*tables):
    """TASKS less some tables (and their subtables)."""
    kept, keep = [], True
    for line in TASKS.splitlines():
        if line.startswith("["):
            keep = line.strip("[]").split(".")[0] not in tables
        kept += [line] if keep else []
    return "\n".join(kept)


def changed(old, new):
    assert old in TASKS
    return TASKS.replace(old, new, 1)


@pytest.mark.parametrize(
    ("text", "pieces"),
    [
        (changed("half_step", "half_steps"), ("[sensitivity]", "`half_steps`", "`half_step`?")),
        (changed("n = 64", "n = 6.4"), ("[monte_carlo]", "`n`", "6.4")),
        (changed("n = 64", ""), ("[monte_carlo]", "`n`", "missing")),
        (changed("n = 64", "n = 64\nsampling = 'sobl'"), ("`sampling`", "did you mean `sobol`?")),
        (changed("n = 64", "n = 64\nquantiles = [1.5]"), ("`quantiles`", "1.5")),
        (changed("n = 64", "n = 64\nseed = -1"), ("`seed`", "-1")),
        (changed("*.mean_square_moment", "*.mean_square_momen"), ("did you mean",)),
        (changed("*.mean_square_moment", "E.mean_square_moment"), ("`sensitivity`", "`E`")),
        (changed('rms_moment" = 3.0', "rms_moment\" = 'x'"), ("`limits`", "'x'")),
        (changed("[-1.0, inf]", "[1.0, 1.0]"), ("`limits`", "angle_error")),
        (changed('"D.delta_x" = "0.25 deg"', '"D.delta_q" = 1'), ("[tolerances]", "delta_q")),
        (changed('"D.delta_x" = "0.25 deg"', '"Q.delta_x" = 1'), ("`tolerances`", "`Q.delta_x`")),
        (changed('"0.25 deg"', '"0.25 mm"'), ("[tolerances]", "half_width", "0.25 mm")),
        (changed('"0.25 deg"', "-1"), ("half_width", "-1")),
        (changed("truncated_normal", "normall"), ("distribution", "did you mean `normal`?")),
        (changed('triangular"', 'triangular", deviations = 2'), ("`deviations`", "triangular")),
        (changed('["-0.1 mm", "0.3 mm"]', '["0.3 mm", "0.1 mm"]'), ("`interval`", "rise")),
        (changed("correlation = 0.5", "correlation = 1.0"), ("`correlation`", "definite")),
        (changed('"B.d_x" = "0.3 mm"', '"D.d_y" = "0.3 mm"'), ("`D.d_y` occurs twice",)),
        (changed("starts = { corners = 2 }", "starts = { corner = 2 }"), ("did you mean",)),
        (changed("starts = { corners = 2 }", "starts = { corners = 0 }"), ("`starts`", "none")),
        (changed("starts = { corners = 2 }", "region = 'sphere'"), ("`region`", "sphere")),
        (changed('["0.05 deg", "1 deg"]', '["1 deg", "0.05 deg"]'), ("`bounds`", "D.delta_x")),
        (changed('"B.d_x" = { model', '"A.d_x" = { model'), ("[allocation.cost]", "`A.d_x`")),
        (changed("price = 2", "price = 0"), ("[allocation.cost]", "`price`")),
        (changed('at = "0.2 mm"', 'at = "0.2 deg"'), ("`at`", "0.2 deg")),
        (changed('limits = { "D.mean_square_moment" = 10.0 }', "limits = {}"), ("`limits`",)),
        (changed("[allocation]", "[allocation]\ncriterion = 'rss'\ntarget = 0.99"), ("`target`", "yield")),
        (changed("[allocation]", "[allocation]\ncriterion = 'yield'\ncoverage = 2"), ("`coverage`", "rss")),
        (changed("[allocation]", "[allocation]\nsamples = 64"), ("`samples`", "worst_case")),
        (without("tolerances", "monte_carlo", "worst_case"), ("`sensitivity`", "[tolerances]")),
        ("[sensitivity]\nmetrics = []\n[tolerances]\n'D.d_y' = 1e-3", ("`metrics`", "[]")),
    ],
)
def test_what_is_wrong_is_refused_in_one_sentence(tmp_path, refused, text, pieces):
    with refused(*pieces):
        load(tmp_path, text)


@pytest.mark.parametrize(
    ("make", "pieces"),
    [
        (lambda: SensitivityTask(("D.rms_force",), order=3), ("`order`", "3")),
        (lambda: SensitivityTask(("D.rms_force",), half_step="yes"), ("`half_step`", "'yes'")),
        (lambda: MonteCarloTask(4), ("`metrics`",)),
        (lambda: WorstCaseTask(("D.rms_force",), sense="up"), ("`sense`", "'up'")),
        (lambda: AllocationTask({"D.rms_force": 1.0}, {"D.d_y": (1e-4, 1e-3)}, {}), ("`costs`",)),
        (lambda: SpecifiedTolerance("D.d_y"), ("`half_width`", "neither")),
        (lambda: SpecifiedTolerance("D.d_y", 1e-3, interval=(0, 1)), ("`half_width`", "both")),
        (lambda: CorrelatedTolerances({"D.d_y": 1e-3}, 0.5), ("two errors or more",)),
        (lambda: CorrelatedTolerances({"D.d_y": 1.0, "D.d_x": 1.0}, [[1, 0]]), ("matrix of 2",)),
    ],
)
def test_what_is_wrong_in_python_is_refused_too(refused, make, pieces):
    with refused(*pieces):
        make()


def test_a_cost_without_a_scale_refers_to_the_largest_bound():
    bounds = {"D.d_y": ("0.1 mm", "1 mm"), "D.d_x": (1e-4, 2e-3)}
    task = AllocationTask({"D.rms_force": 1.0}, bounds, {"D.d_y": ErrorCost(price=3.0), "D.d_x": ErrorCost(at=5e-4)})
    assert (task.costs["D.d_y"].price, task.costs["D.d_y"].at, task.costs["D.d_x"].at) == (3.0, 1e-3, 5e-4)
