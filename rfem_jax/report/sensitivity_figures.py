"""Heat map and tornado chart of a sensitivity study.

Place in the pipeline: called by `task_figures` with a `Sensitivities`; symbols: t tolerances, g
gradient and H Hessian per tolerance, all in the unit of the metric.
"""

import numpy as np
from matplotlib.figure import Figure

from rfem_jax.report.quantities import as_specified
from rfem_jax.report.style import BAR_COLOURS, HATCHES, add_titles, panel_grid

MOST_PANELS = 12


def group_metrics(result) -> dict:
    """{(kind, unit): [(joint, position)]} of the metrics; one of no joint is its own kind."""
    groups = {}
    for position, (name, unit) in enumerate(zip(result.metrics, result.metric_units, strict=True)):
        joint, _, kind = name.rpartition(".")
        groups.setdefault((kind, unit), []).append((joint or "-", position))
    return groups


def error_labels(result) -> list[str]:
    """Names of the errors with their tolerances, "D.delta_x\\n+-0.5 deg"."""
    labels = []
    for name, unit, width in zip(result.names, result.error_units, result.scale, strict=True):
        specified, factor = as_specified(unit)
        labels.append(f"{name}\n\u00b1{factor * width:.3g} {specified}")
    return labels


def heat_map_figure(study, result) -> Figure:
    """Largest change of every metric by each error alone within its tolerance: joint x error."""
    groups, labels = group_metrics(result), error_labels(result)
    rows = sum(len(group) for group in groups.values())
    wide = min(max(7.2, 0.95 * len(labels) + 2.5), 24.0)
    height = 0.42 * rows + 1.1 * len(groups) + 1.4
    figure = Figure(figsize=(wide, height), layout="constrained")
    panels = figure.subplots(len(groups), 1, squeeze=False, height_ratios=[len(group) for group in groups.values()])[
        :, 0
    ]
    for axes, ((kind, unit), group) in zip(panels, groups.items(), strict=True):
        effects = np.array([result.effects[position] for _, position in group])
        image = axes.imshow(np.ma.masked_invalid(effects), aspect="auto", cmap="YlOrRd", vmin=0.0)
        figure.colorbar(image, ax=axes, label=unit or "1", pad=0.02)
        middle = 0.55 * np.nanmax(effects, initial=0.0)
        for (row, column), value in np.ndenumerate(effects):
            text = f"{value:.3g}" if np.isfinite(value) else "n/a"
            colour = "white" if value > middle else "black"
            axes.text(column, row, text, ha="center", va="center", fontsize=8.5, color=colour)
        axes.set_yticks(range(len(group)), [joint for joint, _ in group])
        axes.set_xticks(range(len(labels)), labels)
        axes.set_ylabel("joint")
        axes.set_title(f"Change of {kind.replace('_', ' ')}, {unit or '1'}", loc="left")
        axes.grid(visible=False)
        axes.tick_params(length=0)
    add_titles(figure, "Effect of each error alone, anywhere within its tolerance", study)
    return figure


def tornado_figure(study, result) -> Figure:
    """Change of each metric at both ends of every error's tolerance, by the quadratic model."""
    shown = min(len(result.metrics), MOST_PANELS)
    height = -(-shown // 2) * (0.26 * len(result.names) + 1.25) + 1.6
    figure = Figure(figsize=(8.4, height), layout="constrained")
    panels, add_shared_legend = panel_grid(figure, shown)
    labels = [label.split("\n")[0] for label in error_labels(result)]
    for metric, axes in enumerate(panels):
        low, high = end_changes(result, metric)
        order = np.argsort(np.fmax(np.abs(low), np.abs(high)), kind="stable")
        places = np.arange(len(order))
        for shift, changes, index, word in ((-0.2, low, 2, "lower"), (0.2, high, 1, "upper")):
            axes.barh(
                places - shift, changes[order], 0.38, color=BAR_COLOURS[index],
                hatch=HATCHES[index], edgecolor="black", linewidth=0.6,
                label=f"{word} end of the tolerance",
            )  # fmt: skip
        axes.axvline(0.0, color="black", linewidth=0.8)
        axes.set_yticks(places, [labels[i] for i in order])
        axes.tick_params(axis="y", length=0)
        axes.grid(visible=False, axis="y")
        zero = result.character[metric] == "kink"  # what is left of it is rounding
        value = 0.0 if zero else result.value[metric]
        axes.set_title(f"{result.labels[metric]} = {value:.4g}", loc="left")
        axes.set_xlabel(f"change, {result.metric_units[metric] or '1'}")
    add_shared_legend(*panels[0].get_legend_handles_labels())
    left_out = len(result.metrics) - shown
    heading = "Change by each error alone at the ends of its tolerance (quadratic model)"
    if left_out > 0:
        heading += f"; {left_out} more metrics are in the tables"
    add_titles(figure, heading, study)
    return figure


def end_changes(result, metric) -> tuple[np.ndarray, np.ndarray]:
    """Changes (k,) of metric number `metric` at the lower and the upper ends of the tolerances."""
    gradient = result.gradient_scaled[metric]
    curved = np.zeros_like(gradient)
    if result.hessian_scaled is not None:
        curved = 0.5 * np.diagonal(result.hessian_scaled[metric])
    return curved - gradient, curved + gradient
