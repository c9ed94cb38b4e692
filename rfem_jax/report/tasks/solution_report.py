"""What reports on allocations and on optimisations have in common: costs, rows before and after, a picture of them.

Place in the pipeline: task_report -> **solution report** -> allocation, optimise.
"""

from collections.abc import Iterable, Mapping
from functools import partial
from typing import Any, TypeVar

import numpy as np

from rfem_jax.description.parameters.deviations import deviation_unit
from rfem_jax.description.tasks.costs import ErrorCost, FoundTolerancesTask
from rfem_jax.description.tolerances.error_catalogue import as_specified
from rfem_jax.report.contents.annotations import Axes, Figure
from rfem_jax.report.contents.overview import format_error
from rfem_jax.report.drawings.style import CASE_COLOURS, MARKERS, add_titles, new_figure
from rfem_jax.report.tasks.task_report import TaskReport
from rfem_jax.tolerancing.robust_design.cost_models import Exponential, Reciprocal, ReciprocalSquared
from rfem_jax.tolerancing.robust_design.result import Solution

GREY = "#A0A0A0"

CostModel = Reciprocal | ReciprocalSquared | Exponential
Asked = TypeVar("Asked", bound=FoundTolerancesTask)
Result = TypeVar("Result")


class SolutionReport(TaskReport[Asked, Result]):
    """What both kinds of reports share."""

    def succeeded(self, result: Any) -> bool:
        return result.answer.status == "ok"

    @property
    def costs(self) -> dict[str, CostModel]:
        """{error or zone: cost of its tolerance}"""
        return {name: build_cost(cost) for name, cost in self.task.costs.items()}

    @property
    def before(self) -> dict[str, float]:
        """{error or zone: size} of the study's own tolerances."""
        specified = self.study.tasks.tolerances
        return {} if specified is None else specified.sizes()

    def rows(self, answer: Solution) -> list[dict[str, Any]]:
        """One row a dimension, then one a tolerance, before and after, with the ends between which it was found."""
        designs: Mapping[str, float] = getattr(answer, "designs", {})
        asked = [(name, "dimension", name, value, self.study.design_bounds[name]) for name, value in designs.items()]
        for name, value in answer.tolerances.items():
            label = f"tolerance of {name}" if name in designs else name
            asked.append((name, "tolerance", label, value, self.task.bounds.get(name, (value, value))))
        before = {"dimension": getattr(answer, "initial", {}), "tolerance": self.before}
        return [
            {"name": name, "kind": kind, "unit": answer.units[name]}
            | {"before": before[kind].get(name, np.nan), "after": after, "lowest": low, "highest": high}
            | {"at_bound": answer.at_bounds.get(label, "") if high > low else ""}
            for name, kind, label, after, (low, high) in asked
        ]

    def bounds_figure(self, rows: list[dict[str, Any]], heading: str, logarithmic: bool = False) -> Figure:
        """Numbers before and after, each between its ends; those of an allocation by their logarithm."""
        figure = new_figure(7.2, 0.55 * len(rows) + 2.0)
        axes = figure.subplots()
        scale = np.log if logarithmic else np.asarray
        for place, row in enumerate(reversed(rows)):
            low, high = scale(row["lowest"]), scale(row["highest"])
            axes.plot([0.0, 1.0], [place, place], "|-", color=GREY, linewidth=1.0)
            specified, factor = as_specified(row["unit"])
            for key, after in (("before", False), ("after", True)):
                if np.isfinite(row[key]):
                    share = float((scale(row[key]) - low) / (high - low)) if high > low else 0.5
                    _mark(axes, share, place, after, f"{factor * row[key]:.4g} {specified}".removesuffix(" 1"))
        axes.plot([], [], MARKERS[0], color=CASE_COLOURS[0], mfc="white", label="before")
        axes.plot([], [], MARKERS[1], color=CASE_COLOURS[1], label="after")
        several = len({row["kind"] for row in rows}) > 1
        labels = [row["name"] + (" (tolerance)" if several and row["kind"] == "tolerance" else "") for row in rows]
        axes.set_yticks(range(len(rows)), labels[::-1])
        axes.set_ylim(-0.6, len(rows) - 0.4)
        axes.set_xlim(-0.15, 1.15)
        axes.set_xticks([0.0, 1.0], ["lowest", "highest"])
        axes.grid(visible=False)
        axes.legend(loc="lower right", bbox_to_anchor=(1.0, 1.0), ncols=2, frameon=False)
        add_titles(figure, heading, self.study)
        return figure

    def setting_text(self, name: str, value: Any) -> str:
        """Bounds and costs too in deg and mm."""
        unit = partial(deviation_unit, self.study.mechanism)
        if name == "bounds":
            return ", ".join(f"{error} {_sizes(pair, unit(error))}" for error, pair in value.items())
        if name == "costs":
            return ", ".join(_cost(error, cost, unit(error)) for error, cost in value.items())
        return super().setting_text(name, value)


def build_cost(cost: ErrorCost) -> CostModel:
    """Callable of one half-width [rad or m] for an `ErrorCost`."""
    if cost.model == "reciprocal":
        return Reciprocal(cost.price * cost.at, cost.fixed)
    if cost.model == "reciprocal_squared":
        return ReciprocalSquared(cost.price * cost.at**2, cost.fixed)
    return Exponential(cost.price, 1.0 / cost.at, cost.fixed)


def _sizes(sizes: Iterable[float], unit: str) -> str:
    return " to ".join(format_error("", size, unit).removeprefix(" = ") for size in sizes)


def _cost(name: str, cost: ErrorCost, unit: str) -> str:
    fixed = f" + {cost.fixed:g}" if cost.fixed else ""
    return f"{name} {cost.model.replace('_', ' ')}, {cost.price:g} at {_sizes([cost.at], unit)}{fixed}"


def _mark(axes: Axes, x: float, place: int, after: bool, text: str) -> None:
    colour, marker = (CASE_COLOURS[1], MARKERS[1]) if after else (CASE_COLOURS[0], MARKERS[0])
    axes.plot([x], [place], marker, color=colour, markerfacecolor=colour if after else "white", zorder=3)
    where = (0, 7) if after else (0, -13)
    axes.annotate(text, (x, place), xytext=where, textcoords="offset points", ha="center", fontsize=8, color=colour)
