"""Optimisation of dimensions and tolerances: the answer beside the study's own numbers, and a Pareto front.

Place in the pipeline: `rfem_jax.description.tasks.optimise` -> **optimise** -> terminal, files and pictures.
"""

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import jax

from rfem_jax.compilation.stages import on_stage
from rfem_jax.description.basics.errors import InputError
from rfem_jax.description.tasks.optimise import OptimiseTask
from rfem_jax.report.contents.annotations import Figure
from rfem_jax.report.contents.output import write_csv
from rfem_jax.report.drawings.style import CASE_COLOURS, MARKERS, add_titles, new_figure
from rfem_jax.report.tasks import study_problem
from rfem_jax.report.tasks.solution_report import SolutionReport
from rfem_jax.report.tasks.task_files import write_task_json
from rfem_jax.simulation.outcome.quantities import column_name
from rfem_jax.text_layout import align_columns
from rfem_jax.tolerancing.layout import show_number
from rfem_jax.tolerancing.problems.distributions import DISTRIBUTIONS
from rfem_jax.tolerancing.robust_design.front import pareto_front
from rfem_jax.tolerancing.robust_design.optimisation import optimise
from rfem_jax.tolerancing.robust_design.result import DesignOptimum


@dataclass(frozen=True, eq=False)
class Optimised:
    """The answer, and answers for other weights of the objective's two terms, {weight of the second: answer}."""

    answer: DesignOptimum
    front: dict[float, DesignOptimum]


class OptimiseReport(SolutionReport[OptimiseTask, Optimised]):
    """The best dimensions and tolerances that keep limits."""

    def run(self, folder: Path) -> Optimised:
        """The answer, and the Pareto front if it is asked for."""
        task, designs = self.task, self.study.design_bounds
        specified = self.study.tasks.tolerances
        widths: dict[str, Any] = dict(self.before)
        for zone in () if specified is None else specified.zones:  # one size in the place of its errors
            for error in zone.errors:
                widths.pop(error, None)
        widths |= task.bounds
        if not designs and not task.bounds:
            raise InputError(
                "Task `optimise` must have something to change, but [design] gives no bounds and there is no table "
                '[optimise.bounds]; write for example "bar.height" = ["6 mm", "14 mm"] in [design].'
            )
        problem = study_problem.build_problem(self.study, task.metrics)
        solve = partial(
            optimise, problem, designs, None if task.robust == "nominal" and not task.bounds else widths,
            limits=task.limits, robust=task.robust, cost=self.costs or None, key=jax.random.key(task.seed),
            target=task.target, coverage=task.coverage, distribution=DISTRIBUTIONS[task.distribution],
            samples=task.samples, verify_samples=task.verify_samples,
            starts=task.starts, searches=task.searches, steps=task.steps, mode=task.mode, batch=task.batch,
            zones=[*task.zones, *(() if specified is None else specified.zones)],
            progress=lambda count: on_stage(f"Optimising: {count} simulations"),
        )  # fmt: skip
        answer = solve(objective=task.objective)
        front = {}
        if task.front:
            front = pareto_front(lambda weights: solve(objective=weights), tuple(task.objective), task.front)
        return Optimised(answer, front)

    def text(self, result: Optimised) -> str:
        """The answer, and the front as a table."""
        parts = [str(result.answer)]
        if result.front:
            terms = list(next(iter(result.front.values())).terms)
            rows = [
                [f"{weight:g}", one.status, *(show_number(one.terms[term]) for term in terms)]
                for weight, one in result.front.items()
            ]
            parts.append(f"Pareto front\n{align_columns(['weight', 'status', *terms], rows)}")
        return "\n\n".join(parts)

    def write(self, folder: Path, result: Optimised) -> list[Path]:
        """Write optimise.json, optimise.csv (dimensions and tolerances before and after), optimise_limits.csv and, with
        a front, optimise_front.csv."""
        answer = result.answer
        written = [
            write_task_json(
                folder / "optimise.json",
                self.study,
                self.name,
                {
                    **answer.entries(),
                    "bounds": {name: list(self.study.design_bounds[name]) for name in answer.designs},
                    "tolerances_before": {name: self.before.get(name) for name in answer.tolerances},
                    "tolerance_bounds": {name: list(pair) for name, pair in self.task.bounds.items()},
                    "front": [{"weight": weight, **one.entries()} for weight, one in result.front.items()],
                    "units": answer.units | answer.term_units | {check.metric: check.unit for check in answer.limits},
                },
            ),
            write_csv(folder / "optimise.csv", self.rows(answer)),
        ]
        if answer.limits:
            written.append(write_csv(folder / "optimise_limits.csv", _limit_rows(answer)))
        if result.front:
            rows = [
                {"weight": weight, "status": one.status, **one.terms}
                | {column_name(name, one.units[name]): value for name, value in one.designs.items()}
                | {column_name(f"{name}_tolerance", one.units[name]): t for name, t in one.tolerances.items()}
                for weight, one in result.front.items()
            ]
            written.append(write_csv(folder / "optimise_front.csv", rows))
        return written

    def simulations(self) -> list[str]:
        task, count = self.task, len(self.study.design_bounds) + len(self.task.bounds)
        points = {"nominal": "1", "worst_case": "the worst points found so far"}.get(task.robust, str(task.samples))
        told = [f"{task.starts} starts, then up to {task.steps} steps with first derivatives by {count} numbers each"]
        return [*told, f"in every step simulations at {points}; a fresh run verifies the answer"]

    def draw(self, result: Optimised) -> dict[str, Figure]:
        answer, units = result.answer, result.answer.term_units
        terms = ", ".join(f"{name} {value:.4g} {units[name]}".rstrip() for name, value in answer.terms.items())
        heading = f"Optimum, {answer.criterion.replace('_', ' ')} ({answer.status}): {terms}"
        figures = {"answer": self.bounds_figure(self.rows(answer), heading)}
        if result.front:
            figures["front"] = self._front_figure(result)
        return figures

    def _front_figure(self, result: Optimised) -> Figure:
        """The second term of the objective against the first."""
        first, second = self.task.objective
        good = {weight: one for weight, one in result.front.items() if one.status == "ok"}
        figure = new_figure(6.4, 4.8)
        axes = figure.subplots()
        x = [one.terms[first] for one in good.values()]
        y = [one.terms[second] for one in good.values()]
        axes.plot(x, y, marker=MARKERS[0], color=CASE_COLOURS[0], linewidth=1.2)
        for weight, at in zip(good, zip(x, y, strict=True), strict=True):
            axes.annotate(f"{weight:g}", at, xytext=(5, 5), textcoords="offset points", fontsize=8)
        axes.set_xlabel(self._term_label(first, result.answer))
        axes.set_ylabel(self._term_label(second, result.answer))
        add_titles(figure, f"What {first} costs of {second}; numbers are weights of {second}", self.study)
        return figure

    @staticmethod
    def _term_label(name: str, answer: DesignOptimum) -> str:
        unit = answer.term_units[name]
        return f"{name}, {unit}" if unit else name

    def setting_text(self, name: str, value: Any) -> str:
        """The objective as a sum."""
        if name == "objective":
            return " + ".join(f"{weight:g} {term}" for term, weight in value.items())
        return super().setting_text(name, value)


def _limit_rows(answer: DesignOptimum) -> list[dict[str, Any]]:
    units = [{"metric": check.metric, "unit": check.unit} for check in answer.limits]
    return [unit | row | unit for unit, row in zip(units, answer.limit_rows(), strict=True)]
