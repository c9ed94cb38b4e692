"""Sensitivity studies: derivatives of all metrics, their tables and files, heat map and tornado chart.

Place in the pipeline: `rfem_jax.description.tasks.sensitivity` -> **sensitivity** -> terminal, files and pictures.

Symbols: t tolerances, g gradient and H Hessian per tolerance, all in the unit of the metric.
"""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from rfem_jax.description.metrics.catalogue import kinked, only_at_start
from rfem_jax.description.study_file.study import Study
from rfem_jax.description.tasks.sensitivity import SensitivityTask
from rfem_jax.description.tolerances.error_catalogue import as_specified
from rfem_jax.report.contents.annotations import Figure
from rfem_jax.report.drawings.style import BAR_COLOURS, HATCHES, add_titles, new_figure, panel_grid
from rfem_jax.report.tasks import study_problem
from rfem_jax.report.tasks.task_files import metric_units
from rfem_jax.report.tasks.task_report import GRADIENT, TaskReport, as_stage
from rfem_jax.text_layout import wrap_lines
from rfem_jax.tolerancing.contributions import VarianceShares
from rfem_jax.tolerancing.problems.named_tolerances import Tolerances
from rfem_jax.tolerancing.problems.static_problem import StaticProblem
from rfem_jax.tolerancing.sensitivities import Sensitivities
from rfem_jax.tolerancing.sensitivities import sensitivity as differentiate

UNDAMPED = (
    "No flexible link has damping: derivatives of mean-square and RMS forces are dominated by the "
    "phase of\nundamped 1-20 kHz vibrations and may even have the wrong sign (those of moments "
    "stay smooth).\nGive the material a small damping for a study of derivatives."
)
KINKED = (
    "maxima or ranges over time; their derivatives are those at the instants where they are reached, and jump where "
    "other instants take over: for smooth derivatives ask for mean squares, or for norms such as peak_force."
)
NOTHING = 1e-6
MOST_PANELS = 12


class Derivatives(NamedTuple):
    """Result of a sensitivity study: the derivatives, and whether no flexible link has damping."""

    found: Sensitivities
    undamped: bool


class SensitivityReport(TaskReport[SensitivityTask, Derivatives]):
    """Derivatives of joint loads with respect to assembly errors."""

    @property
    def twice(self) -> bool:
        """Whether a finer step shows how far derivatives can be trusted: where asked, and where pins may strike."""
        if self.study.statics is not None:
            return False
        striking = any(joint.clearance for joint in self.study.mechanism.joints)
        return self.task.half_step or (striking and not only_at_start(self.task.metrics))

    def run(self, folder: Path) -> Derivatives:
        """Derivatives of all metrics of the task."""
        task, study = self.task, self.study
        problem = study_problem.build_problem(study, task.metrics)
        twice = " (twice: with the finer step too)" if self.twice else ""
        progress = as_stage(f"Differentiating {len(task.metrics)} metrics to order {task.order}{twice}")
        refined = problem.refined() if self.twice and not isinstance(problem, StaticProblem) else None
        tolerances = Tolerances.of(self.study)
        found = differentiate(
            problem, task.at, task.order, tolerances, task.mode, batch=task.batch, refined=refined,
            progress=progress,
        )  # fmt: skip
        return Derivatives(found, bool(getattr(problem, "undamped", False)))

    def succeeded(self, result: Derivatives) -> bool:
        return result.found.status == "ok"

    def text(self, result: Derivatives) -> str:
        """The result, and what kinks and missing damping mean for it."""
        undamped = [UNDAMPED] if result.undamped else []
        return "\n\n".join([str(result.found), *map(wrap_lines, kink_notes(result.found)), *undamped])

    def write(self, folder: Path, result: Derivatives) -> list[Path]:
        """Write sensitivity.json and sensitivity.csv (one row per metric and error, ranked)."""
        found = result.found
        content = {
            "status": found.status,
            "derivative_residual": found.derivative_residual,
            "undamped": result.undamped,
            "mode": found.mode,
            "errors": list(found.names),
            "half_widths": dict(zip(found.names, found.scale, strict=True)),
            "remarks": kink_notes(found),
            "metrics": {metric: _metric_content(found, m) for m, metric in enumerate(found.metrics)},
            "units": metric_units(found.metrics, found.metric_units),
        }
        return self.write_both(folder, content, found.rows())

    def simulations(self) -> list[str]:
        twice = ", and another with the finer step" if self.twice else ""
        order = {1: "first", 2: "first and second"}[self.task.order]
        return [f"1 simulation with {order} derivatives by {len(self.tolerances.names)} errors{twice}"]

    def work(self) -> float:
        one = GRADIENT * (1 if self.task.order == 1 else 1 + len(self.tolerances.names))
        return 3 * one if self.twice else one  # the finer step takes twice as long

    def draw(self, result: Derivatives) -> dict[str, Figure]:
        figures = {
            "heat_map": heat_map_figure(self.study, result.found),
            "tornado": tornado_figure(self.study, result.found),
        }
        if result.found.shares is not None:
            figures["contributions"] = contributions_figure(self.study, result.found, result.found.shares)
        return figures


def kink_notes(result: Sensitivities) -> list[str]:
    """A sentence on the metrics whose derivatives jump where another instant is that of the maximum."""
    names = kinked(result.metrics)
    return [f"{', '.join(names)}: {KINKED}"] if names else []


def _metric_content(result: Sensitivities, m: int) -> dict[str, Any]:
    """The part of sensitivity.json about metric number `m`."""
    metric = result.metrics[m]
    rows = [row for row in result.rows() if row["metric"] == metric]
    one = {
        "value": result.value[m],
        "character": result.character[m],
        "gradient": dict(zip(result.names, result.gradient[m], strict=True)),
        "effects": {row["error"]: row["effect"] for row in rows},
    }
    if result.shares is not None:
        labels = ["+".join(factor) for factor in result.shares.factors]
        one["standard_deviation"] = result.shares.std[m]
        for word in ("linear", "first_order", "total"):
            parts = getattr(result.shares, word)[m]
            one[f"variance_{word}_percent"] = dict(zip(labels, 100.0 * parts, strict=True))
    if result.hessian is not None:
        pairs = result.principal_directions(metric)
        one["hessian"] = result.hessian[m]
        one["principal_directions"] = [{"eigenvalue": v, "direction": d} for v, d in pairs]
    if result.gradient_change is not None:
        change = dict(zip(result.names, result.gradient_change[m], strict=True))
        one["gradient_change_at_finer_step"] = change
        if result.hessian_change is not None:
            one["hessian_change_at_finer_step"] = result.hessian_change[m]
    return one


def group_metrics(result: Sensitivities) -> dict[tuple[str, str], list[tuple[str, int]]]:
    """{(kind, unit): [(joint, position)]} of the metrics; one of no joint is its own kind."""
    groups: dict[tuple[str, str], list[tuple[str, int]]] = {}
    for position, (name, unit) in enumerate(zip(result.metrics, result.metric_units, strict=True)):
        joint, _, kind = name.rpartition(".")
        groups.setdefault((kind, unit), []).append((joint or "-", position))
    return groups


def error_labels(result: Sensitivities) -> list[str]:
    """Names of the errors with their tolerances, "D.delta_x\\n+-0.5 deg"."""
    labels = []
    for name, unit, width in zip(result.names, result.error_units, result.scale, strict=True):
        specified, factor = as_specified(unit)
        labels.append(f"{name}\n\u00b1{factor * width:.3g} {specified}")
    return labels


def heat_map_figure(study: Study, result: Sensitivities) -> Figure:
    """Largest change of every metric by each error alone within its tolerance: joint x error."""
    groups, labels = group_metrics(result), error_labels(result)
    rows = sum(len(group) for group in groups.values())
    wide = min(max(7.2, 0.95 * len(labels) + 2.5), 24.0)
    height = 0.42 * rows + 1.1 * len(groups) + 1.4
    figure = new_figure(wide, height)
    panels = figure.subplots(len(groups), 1, squeeze=False, height_ratios=[len(group) for group in groups.values()])[
        :, 0
    ]
    for axes, ((kind, unit), group) in zip(panels, groups.items(), strict=True):
        effects = np.array([result.effects[position] for _, position in group])
        image = axes.imshow(np.ma.masked_invalid(effects), aspect="auto", cmap="YlOrRd", vmin=0.0)
        figure.colorbar(image, ax=axes, label=unit or "1", pad=0.02)
        middle = 0.55 * np.nanmax(effects, initial=0.0)
        for (row, column), value in np.ndenumerate(effects):
            # Plain digits, three of them, and 0 for what is nothing beside the others.
            shown = 0.0 if value < NOTHING * np.nanmax(effects, initial=0.0) else float(f"{value:.3g}")
            text = f"{shown:g}" if np.isfinite(value) else "n/a"
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


def tornado_figure(study: Study, result: Sensitivities) -> Figure:
    """Change of each metric at both ends of every error's tolerance, by the quadratic model."""
    shown = min(len(result.metrics), MOST_PANELS)
    height = -(-shown // 2) * (0.26 * len(result.names) + 1.25) + 1.6
    figure = new_figure(8.4, height)
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


def contributions_figure(study: Study, result: Sensitivities, shares: VarianceShares) -> Figure:
    """Part of every error in the variance of each metric: by gradients alone, alone, and with all others."""
    shown = min(len(result.metrics), MOST_PANELS)
    labels = ["\n".join(factor) for factor in shares.factors]
    lines = sum(0.3 + 0.12 * len(factor) for factor in shares.factors)
    figure = new_figure(8.4, -(-shown // 2) * (lines + 1.25) + 1.6)
    panels, add_shared_legend = panel_grid(figure, shown)
    kinds = ((shares.linear, "by gradients alone"), (shares.first_order, "first order"), (shares.total, "total"))
    for metric, axes in enumerate(panels):
        order = np.argsort(np.nan_to_num(shares.total[metric]), kind="stable")
        places = np.arange(len(order))
        for index, (parts, word) in enumerate(kinds):
            axes.barh(
                places + 0.26 * (1 - index), 100.0 * parts[metric][order], 0.26, color=BAR_COLOURS[index],
                hatch=HATCHES[index], edgecolor="black", linewidth=0.6, label=word,
            )  # fmt: skip
        axes.set_yticks(places, [labels[i] for i in order])
        axes.tick_params(axis="y", length=0)
        axes.grid(visible=False, axis="y")
        axes.set_xlim(0.0, 100.0)
        axes.set_title(result.labels[metric], loc="left")
        axes.set_xlabel("part of the variance, %")
    add_shared_legend(*panels[0].get_legend_handles_labels())
    left_out = len(result.metrics) - shown
    heading = "What each error contributes to the variance within the tolerances (quadratic model)"
    heading += f"; {left_out} more metrics are in the tables" if left_out else ""
    add_titles(figure, heading, study)
    return figure


def end_changes(
    result: Sensitivities, metric: int
) -> tuple[Float[np.ndarray, " errors"], Float[np.ndarray, " errors"]]:
    """Changes (k,) of metric number `metric` at the lower and the upper ends of the tolerances."""
    gradient = result.gradient_scaled[metric]
    curved = np.zeros_like(gradient)
    if result.hessian_scaled is not None:
        curved = 0.5 * np.diagonal(result.hessian_scaled[metric])
    return curved - gradient, curved + gradient
