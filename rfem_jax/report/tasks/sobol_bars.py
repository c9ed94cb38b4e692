"""Picture of Sobol' indices: which errors and parameters make every metric scatter, alone and with others.

Place in the pipeline: Monte Carlo study with indices -> **sobol_bars** -> pictures of a task.
"""

import numpy as np

from rfem_jax.description.study_file.study import Study
from rfem_jax.report.contents.annotations import Axes, Figure
from rfem_jax.report.drawings.style import BAR_COLOURS, HATCHES, add_titles, new_figure, panel_grid
from rfem_jax.tolerancing.sampling.monte_carlo_result import MonteCarloResult

MOST_PANELS = 8
MOST_FACTORS = 12  # those of the largest total indices
KINDS = (("total", "with others (total)", 0.2), ("first_order", "alone (first order)", -0.2))


def sobol_figure(study: Study, result: MonteCarloResult) -> Figure:
    """Total and first-order indices of every metric with their intervals, the largest total first."""
    assert result.sobol_indices is not None, "drawn only with indices"
    shown = list(result.sobol_indices)[:MOST_PANELS]
    factors = min(len(result.sobol_indices[shown[0]].total), MOST_FACTORS)
    figure = new_figure(9.0, (0.34 * factors + 1.1) * -(-len(shown) // 2) + 1.2)
    panels, add_shared_legend = panel_grid(figure, len(shown))
    for axes, metric in zip(panels, shown, strict=False):
        _draw_metric(axes, result, metric)
    add_shared_legend(*panels[0].get_legend_handles_labels())
    add_titles(figure, "Sobol' indices: parts of the variance of every metric", study)
    return figure


def _draw_metric(axes: Axes, result: MonteCarloResult, metric: str) -> None:
    assert result.sobol_indices is not None, "drawn only with indices"
    indices = result.sobol_indices[metric]
    names = sorted(indices.total, key=lambda name: -np.nan_to_num(indices.total[name].value))[:MOST_FACTORS]
    places = np.arange(len(names))
    for number, (kind, label, beside) in enumerate(KINDS):
        found = [getattr(indices, kind)[name] for name in names]
        values = np.array([one.value for one in found])
        ends = np.abs(np.array([(one.value - one.low, one.high - one.value) for one in found])).T
        axes.barh(
            places - beside, values, 0.38, xerr=ends, color=BAR_COLOURS[number], hatch=HATCHES[number],
            edgecolor="black", linewidth=0.6, capsize=2.0, label=label,
        )  # fmt: skip
    axes.set_yticks(places, names)
    axes.invert_yaxis()
    axes.set_xlim(left=min(0.0, axes.get_xlim()[0]))
    axes.grid(visible=False, axis="y")
    axes.set_title(result.labels[result.metrics.index(metric)], loc="left")
    axes.set_xlabel("part of the variance")
