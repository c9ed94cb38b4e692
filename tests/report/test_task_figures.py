"""Pictures of tasks: all are there, none is blank, and they show the numbers of the results."""

import math
from dataclasses import replace
from itertools import pairwise

import jax
import numpy as np
import pytest

pytest.importorskip("matplotlib", reason="pictures need the extra `plots`")

import matplotlib
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.image import imread
from scipy.stats import spearmanr

from rfem_jax import Tolerances, Uniform, load_study, monte_carlo, sensitivity
from rfem_jax.report.drawings.pictures import write_pictures
from rfem_jax.report.tasks import study_problem
from rfem_jax.report.tasks.catalogue import report_on
from rfem_jax.report.tasks.monte_carlo import _most_felt, scatter_matrix
from rfem_jax.report.tasks.sensitivity import Derivatives

from . import closed_form
from .conftest import STUDY
from .test_tasks import FORCE, MOMENT, TASKS

WIDTHS = dict(zip(closed_form.NAMES, closed_form.WIDTHS, strict=True))


@pytest.fixture
def study(tmp_path, monkeypatch):
    monkeypatch.setattr(study_problem, "build_problem", closed_form.build_problem)
    path = tmp_path / "tasks.toml"
    path.write_text(STUDY + TASKS, encoding="utf-8")
    return load_study(path)


@pytest.fixture
def problem():
    return closed_form.build([MOMENT, FORCE])


def scatter(problem, n=64):
    tolerances = Tolerances({name: Uniform(width) for name, width in WIDTHS.items()})
    return monte_carlo(problem, tolerances, n, jax.random.key(0), limits={MOMENT: 7.0})


def words_of(figure):
    return " ".join(item.get_text() for item in figure.findobj(matplotlib.text.Text))


def draw(study, name, result):
    return report_on(study, name).pictures(result)


@pytest.mark.long
def test_no_picture_is_blank(study, problem, tmp_path):
    figures = draw(study, "monte_carlo", scatter(problem))
    figures |= draw(study, "sensitivity", Derivatives(sensitivity(problem, scale=WIDTHS), False))
    for name in ("worst_case", "allocation"):
        figures |= draw(study, name, report_on(study, name).run(tmp_path))
    written = write_pictures(tmp_path, figures)
    names = {path.name for path in written}
    assert len(names) == 7
    for path in written:
        picture = imread(path)[..., :3]
        assert picture.shape[1] >= 1000, path
        assert 0.01 < (picture < 0.9).any(axis=2).mean() < 0.8, path
    assert not list(tmp_path.glob("*.part"))


def test_heat_map_and_tornado_show_the_effects(study, problem):
    figures = draw(study, "sensitivity", Derivatives(sensitivity(problem, scale=WIDTHS), False))
    heat = figures["sensitivity_heat_map"]
    panels = {axes.get_title(loc="left"): axes for axes in heat.axes if axes.images}
    moments = panels["Change of mean square moment, (N m)^2"]
    np.testing.assert_allclose(moments.images[0].get_array(), [[16.0, 4.0, 1.0]], rtol=1e-9)
    forces = panels["Change of mean square force, N^2"]
    np.testing.assert_allclose(forces.images[0].get_array(), [[30.0, 5.0, 0.0]], atol=1e-9)
    assert "\u00b10.25 deg" in words_of(heat) and "\u00b10.25 mm" in words_of(heat)

    tornado = figures["sensitivity_tornado"]
    axes = next(a for a in tornado.axes if "force" in a.get_title(loc="left"))
    lower, upper = ([bar.get_width() for bar in bars] for bars in axes.containers)
    # Sorted by size, the largest on top.
    np.testing.assert_allclose(lower, [0.0, 5.0, -30.0], atol=1e-9)
    np.testing.assert_allclose(upper, [0.0, 5.0, 30.0], atol=1e-9)
    assert [label.get_text() for label in axes.get_yticklabels()][-1] == "D.delta_x"
    assert "mean square moment in D = 0" in words_of(tornado)


def test_histograms_show_mean_quantiles_and_limits(study, problem):
    result = scatter(problem)
    figures = draw(study, "monte_carlo", result)
    axes = figures["monte_carlo_histograms"].axes[0]
    assert sum(bar.get_height() for bar in axes.patches) == 64
    places = [line.get_xdata()[0] for line in axes.lines]
    found = result.statistics[MOMENT]
    expected = [found.mean.value, *(one.value for one in found.quantiles.values()), 7.0]
    np.testing.assert_allclose(places, expected)
    share = 100.0 * np.mean(result.values[:, 0] <= 7.0)
    assert axes.get_title(loc="left") == f"mean square moment in D: {share:.3g} % within"


def test_the_scatter_matrix_shows_every_sample(study, problem):
    result = scatter(problem)
    figure = draw(study, "monte_carlo", result)["monte_carlo_scatter_matrix"]
    assert len(figure.axes) == 15
    panel = figure.axes[6]  # fourth row, first column: the moment over delta_x
    x, y = panel.lines[0].get_data()
    np.testing.assert_allclose(x, np.degrees(result.errors[:, 0]))
    np.testing.assert_allclose(y, result.values[:, 0])
    assert figure.axes[10].get_xlabel() == "D.delta_x\ndeg"


def test_the_scatter_matrix_has_correlations_above_the_diagonal(study):
    """Each in the row of one number and in the column of the other."""
    samples = np.random.default_rng(1).normal(size=(400, 3)) @ [[1.0, 0.5, -2.0], [0.0, 1.0, 0.1], [0.0, 0.0, 0.4]]
    figure = scatter_matrix(study, ["a", "b", "c"], samples, "heading")
    FigureCanvasAgg(figure).draw()
    diagonal = [figure.axes[i].get_window_extent() for i in (0, 2, 5)]
    pairs = ((0, 1), (0, 2), (1, 2))
    expected = {f"{spearmanr(samples[:, i], samples[:, j]).statistic:+.2f}": (i, j) for i, j in pairs}
    found = {text.get_text(): text.get_window_extent() for text in figure.texts if text.get_text() in expected}
    assert len(found) == 3
    for text, (row, column) in expected.items():
        extent = found[text]
        assert (extent.x0 + extent.x1) / 2 == pytest.approx((diagonal[column].x0 + diagonal[column].x1) / 2, abs=2.0)
        assert diagonal[row].y0 < extent.y0 < extent.y1 < diagonal[row].y1


@pytest.mark.long
def test_sobol_indices_are_bars_with_their_intervals(study, problem):
    tolerances = Tolerances({name: Uniform(width) for name, width in WIDTHS.items()})
    result = monte_carlo(problem, tolerances, 64, jax.random.key(0), sobol_indices=True)
    figure = draw(study, "monte_carlo", result)["monte_carlo_sobol"]
    axes = figure.axes[0]
    indices = result.sobol_indices[MOMENT]
    order = sorted(indices.total, key=lambda name: -indices.total[name].value)
    assert [one.get_text() for one in axes.get_yticklabels()] == order and order[0] == "D.delta_x"
    widths = [bar.get_width() for bar in axes.patches]
    expected = [getattr(indices, kind)[name].value for kind in ("total", "first_order") for name in order]
    np.testing.assert_allclose(widths, expected)
    low, high = axes.collections[0].get_segments()[0][:, 0]
    assert (low, high) == pytest.approx((indices.total[order[0]].low, indices.total[order[0]].high))


def test_worst_cases_and_allocations_show_their_answers(study, tmp_path):
    results = report_on(study, "worst_case").run(tmp_path)
    axes = draw(study, "worst_case", results)["worst_case_corners"].axes[1]
    curves = {line.get_label(): line for line in axes.lines}
    corners = curves["corners of the box"].get_ydata()
    np.testing.assert_allclose(corners, [875.0] * 4 + [935.0] * 4)
    assert curves["worst found: 935"].get_ydata()[0] == pytest.approx(935.0)

    found = report_on(study, "allocation").run(tmp_path)
    figures = draw(study, "allocation", found)
    above, below = figures["allocation_front"].axes
    costs = next(line for line in above.lines if line.get_label() == "limits verified")
    np.testing.assert_allclose(costs.get_xdata(), [10.5, 21.0, 42.0])
    np.testing.assert_allclose(costs.get_ydata(), [one.cost for one in found.front.values()])
    widths = {line.get_label(): line.get_ydata() for line in below.lines}
    expected = [1e3 * one.tolerances["D.d_y"] for one in found.front.values()]
    np.testing.assert_allclose(widths["D.d_y, mm"], expected)
    words = words_of(figures["allocation_tolerances"])
    after = math.degrees(found.answer.tolerances["D.delta_x"])
    assert f"{after:.4g} deg" in words and "0.25 deg" in words and "before 3" in words


def test_the_scatter_matrix_shows_the_errors_that_matter_most():
    """Of six errors the two that act by their squares, the one that acts by its sign, and the next by its square."""
    errors = np.random.default_rng(2).uniform(-1.0, 1.0, size=(400, 6))
    values = np.stack([errors[:, 4] ** 2 + 0.7 * errors[:, 1] ** 2 + 0.4 * errors[:, 5] ** 2, errors[:, 2]], axis=1)
    assert _most_felt(errors, values) == [1, 2, 4, 5]
    assert _most_felt(errors[:, :3], values) == [0, 1, 2]


def test_numbers_below_a_histogram_do_not_overlap(study):
    """Of a metric that scatters little about a number that is not zero."""
    result = scatter(closed_form.build([MOMENT, FORCE]))
    values = 0.58 + 1e-4 * result.values
    object.__setattr__(result, "values", values)
    found = {
        metric: replace(one, mean=replace(one.mean, value=float("nan")), quantiles={})
        for metric, one in result.statistics.items()
    }
    object.__setattr__(result, "statistics", found)
    object.__setattr__(result, "limits", {})
    figure = draw(study, "monte_carlo", result)["monte_carlo_histograms"]
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    for axes in figure.axes[:2]:
        low, high = axes.get_xlim()
        shown = [text for text in axes.get_xticklabels() if low <= text.get_position()[0] <= high]
        boxes = [text.get_window_extent() for text in shown]
        assert len(boxes) > 2 and all(one.x1 < other.x0 for one, other in pairwise(boxes))
