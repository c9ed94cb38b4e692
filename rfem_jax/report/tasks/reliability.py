"""Reliability studies: probabilities that limits are broken, the errors at which they most probably are, a picture.

Place in the pipeline: `rfem_jax.description.tasks.reliability` -> **reliability** -> terminal, files and pictures.
"""

from dataclasses import asdict
from pathlib import Path

import jax
import numpy as np

from rfem_jax.compilation.stages import on_stage
from rfem_jax.description.study_file.study import Study
from rfem_jax.description.tasks.reliability import ReliabilityTask
from rfem_jax.report.contents.annotations import Figure
from rfem_jax.report.drawings.style import BAR_COLOURS, HATCHES, add_titles, new_figure
from rfem_jax.report.tasks import study_problem
from rfem_jax.report.tasks.task_files import metric_units
from rfem_jax.report.tasks.task_report import GRADIENT, TaskReport
from rfem_jax.tolerancing.problems.named_tolerances import Tolerances
from rfem_jax.tolerancing.rare_failures.failure_result import ReliabilityResult
from rfem_jax.tolerancing.rare_failures.failure_study import reliability as find_failures

LEVELS = 6  # of a subset simulation down to a probability of 1e-6


class ReliabilityReport(TaskReport[ReliabilityTask, ReliabilityResult]):
    """Probabilities that limits are broken."""

    def run(self, folder: Path) -> ReliabilityResult:
        """Subset simulation, FORM and importance sampling for all limits of the task."""
        task = self.task
        on_stage(f"Searching failures of {len(task.limits)} limits")
        problem = study_problem.build_problem(self.study, task.metrics)
        return find_failures(
            problem, Tolerances.of(self.study), task.limits, jax.random.key(task.seed), n=task.n,
            level_samples=task.level_samples, starts=task.starts, rounds=task.rounds, confidence=task.confidence,
            mode=task.mode, batch=task.batch,
            progress=lambda done, total: on_stage(f"Sampling {total} mechanisms where limits fail", done / total),
        )  # fmt: skip

    def write(self, folder: Path, result: ReliabilityResult) -> list[Path]:
        """Write reliability.json and reliability.csv (one row per end of a limit; `unit` is that of `limit` and
        `nominal`, errors at the most probable failure have theirs in the names of the columns)."""
        limits = [asdict(one) | {"points": len(one.points)} for one in result.limits]
        content = {
            "status": result.status,
            "limits": limits,
            "any_limit": asdict(result.any_limit),
            "yield": 1.0 - result.any_limit.value,
            "samples": result.samples,
            "simulations": result.simulations,
            "failed": result.failed,
            "confidence": result.confidence,
            "units": metric_units([one.metric for one in result.limits], [one.unit for one in result.limits]),
        }
        return self.write_both(folder, content, result.rows())

    def simulations(self) -> list[str]:
        task, ends = self.task, self._ends()
        return [
            f"{task.level_samples} in a subset simulation, and about as many for every factor 10 of the probability of "
            f"each of {ends} limits",
            f"at most {ends} x {task.starts} x {task.rounds} with derivatives, in searches of the most probable "
            "failures, and short ones while these find new ones",
            f"{task.n} where limits fail, and up to {6 * task.n} more where these cannot be trusted",
        ]

    def work(self) -> float:
        task, ends = self.task, self._ends()
        return GRADIENT * ends * task.starts * task.rounds + (1 + LEVELS * ends) * task.level_samples + task.n

    def _ends(self) -> int:
        """Number of the ends of limits."""
        return sum(int(np.isfinite(end)) for pair in self.task.limits.values() for end in pair)

    def draw(self, result: ReliabilityResult) -> dict[str, Figure]:
        reached = any(one.shares for one in result.limits)
        return {"shares": shares_figure(self.study, result)} if reached else {}


def shares_figure(study: Study, result: ReliabilityResult) -> Figure:
    """Which errors make each limit fail: their parts of the squared distance to the most probable failure."""
    shown = [one for one in result.limits if one.shares]
    factors = list(shown[0].shares)
    figure = new_figure(7.2, 0.6 * len(shown) + 2.2)
    axes = figure.subplots()
    left = np.zeros(len(shown))
    for index, factor in enumerate(factors):
        parts = np.array([100.0 * one.shares[factor] for one in shown])
        axes.barh(
            np.arange(len(shown)), parts, 0.6, left=left, color=BAR_COLOURS[index % len(BAR_COLOURS)],
            hatch=HATCHES[index % len(HATCHES)], edgecolor="black", linewidth=0.6, label=factor.replace("+", "\n"),
        )  # fmt: skip
        left += parts
    signs = {"upper": "\u2264", "lower": "\u2265"}
    labels = [
        f"{one.metric} {signs[one.side]} {one.limit:.4g} {one.unit}\nbeta {one.beta:.3g}, {one.probability.value:.2g}"
        + (" (uncertain)" if one.status == "uncertain" else "")
        for one in shown
    ]
    axes.set_yticks(range(len(shown)), labels)
    axes.invert_yaxis()
    axes.grid(visible=False, axis="y")
    axes.set_xlim(0.0, 100.0)
    axes.set_xlabel("part of the squared distance to the most probable failure, %")
    axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=min(len(factors), 4), frameon=False)
    heading = f"Which errors break the limits; any limit: {result.any_limit.value:.2g}"
    add_titles(figure, heading, study)
    return figure
