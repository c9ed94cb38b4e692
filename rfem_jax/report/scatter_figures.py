"""Histograms and scatter matrix of a Monte Carlo study.

Place in the pipeline: called by `task_figures` with a `MonteCarloResult`; failed samples are not
drawn. Errors in deg and mm, metrics in their own units.
"""

import numpy as np
from matplotlib.figure import Figure

from rfem_jax.report.quantities import as_specified
from rfem_jax.report.style import BAR_COLOURS, CASE_COLOURS, LINE_STYLES, add_titles, panel_grid

MOST_PANELS = 12
MOST_EACH = 4  # errors and metrics of a scatter matrix


def good_samples(result) -> tuple[np.ndarray, np.ndarray]:
    """Errors (n, d) [rad, m] and values (n, m) of the random samples that did not fail."""
    good = result.status[: result.samples] == 0
    return result.errors[: result.samples][good], result.values[: result.samples][good]


def histogram_figure(study, result) -> Figure:
    """Histogram of every metric with its mean, its quantiles and its limits."""
    shown = min(len(result.metrics), MOST_PANELS)
    figure = Figure(figsize=(8.4, 2.1 * -(-shown // 2) + 1.6), layout="constrained")
    panels, add_shared_legend = panel_grid(figure, shown)
    _, values = good_samples(result)
    styles = {}
    for index, axes in enumerate(panels):
        metric = result.metrics[index]
        samples = values[:, index]
        if len(samples):
            bins = int(np.clip(2.0 * np.cbrt(len(samples)), 5, 60))
            axes.hist(samples, bins, color=BAR_COLOURS[2], edgecolor="black", linewidth=0.5)
        found = result.statistics[metric]
        marks = [("mean", found.mean.value, CASE_COLOURS[0], "-")]
        marks += [
            (f"{100 * q:g} %", estimate.value, CASE_COLOURS[2], LINE_STYLES[1 + i % 6])
            for i, (q, estimate) in enumerate(found.quantiles.items())
        ]
        ends = result.limits.get(metric, ())
        marks += [("limit", end, CASE_COLOURS[1], "-") for end in ends if np.isfinite(end)]
        for word, place, colour, style in marks:
            if np.isfinite(place):
                wide = 2.2 if word == "limit" else 1.3
                line = axes.axvline(place, color=colour, linestyle=style, linewidth=wide)
                styles.setdefault(word, line)
        title = result.labels[index]
        if metric in result.yields:
            title += f": {100 * result.yields[metric].of_all.value:.3g} % within"
        axes.set_title(title, loc="left")
        axes.set_xlabel(result.metric_units[index] or "1")
        axes.set_ylabel("samples")
    add_shared_legend(list(styles.values()), list(styles))
    failed = result.samples - result.good
    heading = f"Scatter over the tolerances: {result.samples} samples, {failed} failed"
    add_titles(figure, heading, study)
    return figure


def scatter_matrix_figure(study, result) -> Figure:
    """Every pair of errors and metrics (four of each): points below, rank correlations
    above, histograms on the diagonal."""
    names, samples = _columns(result)
    size = len(names)
    figure = Figure(figsize=(1.35 * size + 1.0, 1.35 * size + 1.4), layout="constrained")
    panels = figure.subplots(size, size, squeeze=False)
    ranks = np.argsort(np.argsort(samples, axis=0), axis=0).astype(float)
    point = float(np.clip(80.0 / np.sqrt(len(samples)), 1.0, 2.5))
    for row in range(size):
        for column in range(size):
            axes = panels[row, column]
            axes.grid(visible=False)
            if column > row:
                _write_correlation(axes, ranks[:, row], ranks[:, column])
                continue
            if column == row:
                axes.hist(samples[:, row], 12, color=BAR_COLOURS[2], edgecolor="black", lw=0.4)
                axes.set_yticks([])
            else:
                axes.plot(
                    samples[:, column], samples[:, row], ".", ms=point, mew=0.0,
                    color=CASE_COLOURS[2],
                )  # fmt: skip
            axes.tick_params(labelsize=7, labelbottom=row == size - 1)
            axes.tick_params(labelleft=column == 0 and row > 0)
            if row == size - 1:
                axes.set_xlabel(names[column], fontsize=8)
            if column == 0:
                axes.set_ylabel(names[row], fontsize=8)
            axes.locator_params(nbins=3)
    left_out = len(result.names) + len(result.metrics) - size
    heading = "Errors and metrics of all samples; above the diagonal rank correlations"
    if left_out:
        heading += f" ({left_out} more are in the CSV)"
    add_titles(figure, heading, study)
    return figure


def _columns(result):
    """Labels and samples (n, p) of the errors and metrics that are drawn."""
    errors, values = good_samples(result)
    names, columns = [], []
    for i, (name, unit) in enumerate(zip(result.names, result.error_units, strict=True)):
        if i < MOST_EACH:
            specified, factor = as_specified(unit)
            names.append(f"{name}\n{specified}")
            columns.append(factor * errors[:, i])
    for i in sorted(range(len(result.metrics)), key=lambda i: _order(result, i))[:MOST_EACH]:
        names.append(f"{result.metrics[i]}\n{result.metric_units[i] or '1'}")
        columns.append(values[:, i])
    return names, np.stack(columns, axis=1)


def _order(result, i):
    """Metrics with limits come first, then one of each kind before the second of a kind."""
    kinds = [name.rpartition(".")[2] for name in result.metrics]
    return result.metrics[i] not in result.limits, kinds[:i].count(kinds[i]), i


def _write_correlation(axes, first, second):
    axes.set_axis_off()
    spread = len(first) > 1 and np.std(first) > 0 and np.std(second) > 0
    correlation = np.corrcoef(first, second)[0, 1] if spread else np.nan
    # Adding zero takes the sign off what rounds to zero.
    text = f"{round(correlation, 2) + 0.0:+.2f}" if np.isfinite(correlation) else "-"
    shade = "black" if abs(correlation) > 0.3 else "#808080"
    axes.text(0.5, 0.5, text, ha="center", va="center", color=shade, transform=axes.transAxes)
