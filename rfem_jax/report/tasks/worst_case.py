"""Worst cases: the largest value of each metric within the tolerances, against all corners and the quadratic model.

Place in the pipeline: `rfem_jax.description.tasks.worst_case` -> **worst_case** -> terminal, files and pictures.
"""

from functools import partial
from pathlib import Path
from typing import Any

import jax
import numpy as np

from rfem_jax.compilation.stages import on_stage
from rfem_jax.description.study_file.study import Study
from rfem_jax.description.tasks.worst_case import WorstCaseTask
from rfem_jax.report.contents.annotations import Figure
from rfem_jax.report.drawings.style import CASE_COLOURS, MARKERS, add_titles, new_figure
from rfem_jax.report.tasks import study_problem
from rfem_jax.report.tasks.task_report import GRADIENT, TaskReport
from rfem_jax.tolerancing.layout import show_number
from rfem_jax.tolerancing.optimisation.starting_points import EXHAUSTIVE
from rfem_jax.tolerancing.problems.linearisation import choose_mode
from rfem_jax.tolerancing.problems.named_tolerances import Tolerances
from rfem_jax.tolerancing.problems.quadratic_model import expand_by_differences
from rfem_jax.tolerancing.worst_cases import WorstCase
from rfem_jax.tolerancing.worst_cases import worst_case as search_worst_case

MOST_PANELS = 8


class WorstCaseReport(TaskReport[WorstCaseTask, dict[str, WorstCase]]):
    """Largest (or smallest) value of each metric over the tolerances, {metric: WorstCase}."""

    def run(self, folder: Path) -> dict[str, WorstCase]:
        """The worst cases of all metrics, with one quadratic model for all of them."""
        task = self.task
        problem = study_problem.build_problem(self.study, task.metrics)
        tolerances = Tolerances.of(self.study)
        keys = jax.random.split(jax.random.key(task.seed), len(task.metrics))
        on_stage("Expanding to second order")
        centre = {name: float(mean) for name, mean in tolerances.centres().items()}
        mode = choose_mode(task.mode, len(tolerances.names), 1, problem)  # that of the searches: one program
        model = expand_by_differences(problem, centre, tolerances, mode=mode, batch=task.batch)
        corners: Any = "auto" if task.corners is None else task.corners
        search = partial(
            search_worst_case, problem, tolerances, model=model, region=task.region, starts=task.starts,
            sense=task.sense, corners=corners, mode=mode,
            evaluations=task.evaluations, batch=task.batch,
        )  # fmt: skip
        found = {}
        for name, key in zip(task.metrics, keys, strict=True):
            on_stage(f"Searching the worst case of {name}")
            found[name] = search(name, key=key)
        return found

    def succeeded(self, result: dict[str, WorstCase]) -> bool:
        return all(one.status == "ok" for one in result.values())

    def text(self, result: dict[str, WorstCase]) -> str:
        return "\n\n".join(str(one) for one in result.values())

    def write(self, folder: Path, result: dict[str, WorstCase]) -> list[Path]:
        """Write worst_case.json and worst_case.csv (per metric: found, corners, quadratic, nominal; `unit` is
        that of `value`)."""
        metrics, rows = {}, []
        for name, one in result.items():
            corners = None
            if one.corners is not None:
                corners = {key: getattr(one.corners, key) for key in ("count", "failed", "value")}
                corners |= {"errors": one.corners.errors, "values": one.corners.values}
            metrics[name] = {
                key: getattr(one, key)
                for key in (
                    *("status", "value", "errors", "found_by", "maximisers", "nominal", "slopes"),
                    *("kkt_residual", "active", "evaluations", "failed", "quadratic_value"),
                    *("quadratic_errors", "quadratic_bound", "hessian_error", "region", "sense"),
                )
            } | {"corners": corners}
            rows += one.rows()
        units = {name: one.unit or "1" for name, one in result.items()}
        content = {"metrics": metrics, "units": units}
        return self.write_both(folder, content, rows)

    def simulations(self) -> list[str]:
        task, errors = self.task, len(self.tolerances.names)
        starts = sum(task.starts.values())
        corners = f" and {self._corners()} corners" if self._corners() else ""
        return [
            f"{1 + 4 * errors} simulations with first derivatives by {errors} errors, for the quadratic model",
            f"for each metric ({len(task.metrics)}) one at the centre, at {starts} starts{corners}, and at most "
            f"{starts} x {task.evaluations} with derivatives",
        ]

    def work(self) -> float:
        task, starts = self.task, sum(self.task.starts.values())
        each = 1 + starts + self._corners() + GRADIENT * starts * task.evaluations
        return GRADIENT * (1 + 4 * len(self.tolerances.names)) + len(task.metrics) * each

    def _corners(self) -> int:
        """Number of corners of the box that are computed."""
        task, errors = self.task, len(self.tolerances.names)
        every = (
            task.region == "box"
            and not self.tolerances.zones
            and (errors <= EXHAUSTIVE if task.corners is None else task.corners)
        )
        return 2**errors if every else 0

    def draw(self, result: dict[str, WorstCase]) -> dict[str, Figure]:
        return {"corners": worst_case_figure(self.study, result)}


def worst_case_figure(study: Study, results: dict[str, WorstCase]) -> Figure:
    """Values at all corners (sorted) and at the ends of all searches, against the worst found."""
    shown = list(results.values())[:MOST_PANELS]
    figure = new_figure(7.2, 2.5 * len(shown) + 1.5)
    panels = figure.subplots(len(shown), 1, squeeze=False)[:, 0]
    for axes, one in zip(panels, shown, strict=True):
        total = 1
        if one.corners is not None:
            corners = np.sort(one.corners.values)
            total = len(corners)
            axes.plot(
                np.arange(1, total + 1), corners, MARKERS[1], color=CASE_COLOURS[2],
                markersize=6.0 if total <= 64 else 2.0, label="corners of the box",
            )  # fmt: skip
        ends = np.sort(one.end_values)
        axes.plot(
            np.linspace(1, max(total, 2), len(ends)), ends, MARKERS[0], color=CASE_COLOURS[1],
            markerfacecolor="none", label="ends of searches",
        )  # fmt: skip
        lines = (
            ("worst found", one.value, "-", CASE_COLOURS[1]),
            ("quadratic model", one.quadratic_value, "--", CASE_COLOURS[0]),
            ("nominal", one.nominal, ":", CASE_COLOURS[0]),
        )
        for word, height, style, colour in lines:
            if np.isfinite(height):
                axes.axhline(
                    height, color=colour, linestyle=style, linewidth=1.2,
                    label=f"{word}: {show_number(height, scale=one.scale)}",
                )  # fmt: skip
        axes.set_title(f"{one.metric} over the {one.region}: {one.status}", loc="left")
        axes.set_ylabel(one.unit or "1")
        axes.set_xticks([])
        axes.legend(loc="center left", bbox_to_anchor=(1.01, 0.5), frameon=False)
    panels[-1].set_xlabel("corners and searches, each sorted by value")
    left_out = len(results) - len(shown)
    heading = "Worst case found against every corner of the tolerance box"
    heading += f" ({left_out} more metrics are in the tables)" if left_out else ""
    add_titles(figure, heading, study)
    return figure
