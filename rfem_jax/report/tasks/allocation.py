"""Allocations: the cheapest tolerances that keep limits, beside the study's own, and their cost against the limits.

Place in the pipeline: `rfem_jax.description.tasks.allocation` -> **allocation** -> terminal, files and pictures.
Pictures show tolerances in deg and mm, metrics in their own units.
"""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np

from rfem_jax.compilation.stages import on_stage
from rfem_jax.description.study_file.study import Study
from rfem_jax.description.tasks.allocation import AllocationTask
from rfem_jax.description.tolerances.error_catalogue import as_specified
from rfem_jax.report.contents.annotations import Figure
from rfem_jax.report.contents.output import write_csv
from rfem_jax.report.drawings.style import CASE_COLOURS, MARKERS, add_titles, new_figure
from rfem_jax.report.tasks import study_problem
from rfem_jax.report.tasks.solution_report import SolutionReport
from rfem_jax.report.tasks.task_files import write_task_json
from rfem_jax.simulation.outcome.quantities import column_name
from rfem_jax.text_layout import align_columns
from rfem_jax.tolerancing.problems.distributions import DISTRIBUTIONS
from rfem_jax.tolerancing.robust_design.allocation import allocate
from rfem_jax.tolerancing.robust_design.cost_models import total_cost
from rfem_jax.tolerancing.robust_design.request import check_allocation
from rfem_jax.tolerancing.robust_design.result import Allocation, LimitCheck


@dataclass(frozen=True, eq=False)
class AllocationStudy:
    """An allocation and its neighbours: `answer`; `front` {scale of the limits' distance from the
    nominal values: Allocation}, scale 1 the answer itself; `before` {error: half-width} of the
    study's own tolerances (empty without), `cost_before` their cost (NaN without)."""

    answer: Allocation
    front: dict[float, Allocation]
    before: dict[str, float]
    cost_before: float


class AllocationReport(SolutionReport[AllocationTask, AllocationStudy]):
    """The cheapest tolerances that keep limits on loads."""

    def run(self, folder: Path) -> AllocationStudy:
        """The cheapest tolerances, and those of the task's scaled limits."""
        task, limits, costs = self.task, self.task.limits, self.costs
        problem = study_problem.build_problem(self.study, task.metrics)
        keys = jax.random.split(jax.random.key(task.seed), 1 + len(task.scales))
        solve = partial(
            allocate, problem, cost=costs, bounds=task.bounds, criterion=task.criterion,
            target=task.target, coverage=task.coverage, statistic=task.statistic,
            distribution=DISTRIBUTIONS[task.distribution], samples=task.samples,
            verify_samples=task.verify_samples, starts=task.starts, rounds=task.rounds,
            tolerance=task.accuracy, batch=task.batch, zones=task.zones,
        )  # fmt: skip
        on_stage("Expanding to second order")
        request = check_allocation(
            problem, limits, costs, task.bounds, mode=task.mode, batch=task.batch, zones=task.zones,
            together=task.criterion != "worst_case",
        )  # fmt: skip
        solve = partial(solve, model=request.model, mode=request.mode)
        on_stage(f"Allocating {len(task.bounds)} tolerances")
        answer = solve(limits, key=keys[0])
        front = {1.0: answer}
        for scale, key in zip(task.scales, keys[1:], strict=True):
            if scale not in front:
                on_stage(f"Allocating with limits scaled by {scale:g}")
                front[scale] = solve(scaled_limits(answer.limits, scale), key=key)
        before, cost = {name: self.before[name] for name in costs if name in self.before}, math.nan
        if len(before) == len(costs):
            cost = float(total_cost(tuple(costs.values()), jnp.asarray([before[name] for name in costs])))
        return AllocationStudy(answer, dict(sorted(front.items())), before, cost)

    def text(self, result: AllocationStudy) -> str:
        """The answer, its cost beside that of the study's own tolerances, and the scaled limits."""
        parts = [str(result.answer)]
        if np.isfinite(result.cost_before):
            parts.append(f"The study's own tolerances cost {result.cost_before:.6g}.")
        if len(result.front) > 1:
            rows = [
                [f"{scale:g}", one.status, f"{one.cost:.5g}", *(f"{c.limit:.5g}" for c in one.limits)]
                for scale, one in result.front.items()
            ]
            header = ["scale of limits", "status", "cost", *(c.metric for c in result.answer.limits)]
            parts.append(f"Cost against limits\n{align_columns(header, rows)}")
        return "\n\n".join(parts)

    def write(self, folder: Path, result: AllocationStudy) -> list[Path]:
        """Write allocation.json, allocation.csv (tolerances before and after, in `unit`) and, with scaled limits,
        allocation_front.csv (cost, limits and tolerances of each); costs are in the currency of the study."""
        answer = result.answer
        content = {
            **answer.entries(),
            "before": {"tolerances": result.before, "cost": result.cost_before},
            "front": [{"scale": scale, **one.entries()} for scale, one in result.front.items()],
            "units": {**answer.units, **{check.metric: check.unit for check in answer.limits}},
        }
        names = {"name": "error", "lowest": "smallest", "highest": "largest"}
        rows = [
            {names.get(key, key): value for key, value in row.items() if key != "kind"} for row in self.rows(answer)
        ]
        written = [
            write_task_json(folder / "allocation.json", self.study, self.name, content),
            write_csv(folder / "allocation.csv", rows),
        ]
        if len(result.front) > 1:
            rows = []
            for scale, one in result.front.items():
                row = {"scale": scale, "status": one.status, "cost": one.cost}
                for check in one.limits:
                    row[column_name(f"{check.metric}_{check.side}_limit", check.unit)] = check.limit
                    row[column_name(f"{check.metric}_{check.side}_verified", check.unit)] = check.verified
                rows.append(row | {column_name(name, one.units[name]): t for name, t in one.tolerances.items()})
            written.append(write_csv(folder / "allocation_front.csv", rows))
        return written

    def simulations(self) -> list[str]:
        task = self.task
        zones = {zone.name: len(zone.errors) for zone in task.zones}
        errors = sum(zones.get(name, 1) for name in task.bounds)
        told = [f"{1 + 4 * errors} simulations with first derivatives by {errors} errors, for the quadratic model"]
        count = len({1.0, *task.scales})
        each = "" if count == 1 else f"for each of {count} allocations "
        if task.criterion == "worst_case":
            return [*told, f"{each}worst-case searches for every limit, as many as the answer needs"]
        number = "as many" if task.samples is None else str(task.samples)
        number += " as the target needs" if task.samples is None else ""
        return [*told, f"{each}{number} with derivatives in every round, {task.verify_samples} in every verification"]

    def draw(self, result: AllocationStudy) -> dict[str, Figure]:
        answer, before = result.answer, ""
        if np.isfinite(result.cost_before):
            before = f", before {result.cost_before:.4g}"
        heading = f"Tolerances before and after: cost {answer.cost:.4g}{before}"
        heading += f" ({answer.criterion.replace('_', ' ')}, {answer.status})"
        figures = {"tolerances": self.bounds_figure(self.rows(answer), heading, logarithmic=True)}
        if len(result.front) > 1:
            figures["front"] = front_figure(self.study, result)
        return figures


def scaled_limits(checks: Iterable[LimitCheck], scale: float) -> dict[str, tuple[float, float]]:
    """Limits {metric: (low, high)} with their distances from the nominal values times `scale`.

    Arguments: checks, the `LimitCheck`s of an allocation with the limits as specified.
    """
    limits: dict[str, tuple[float, float]] = {}
    for check in checks:
        low, high = limits.get(check.metric, (-math.inf, math.inf))
        moved = check.nominal + scale * (check.limit - check.nominal)
        limits[check.metric] = (low, moved) if check.side == "upper" else (moved, high)
    return limits


def front_figure(study: Study, found: AllocationStudy) -> Figure:
    """Cost against the limits (all distances from the nominal values scaled together), and the
    tolerances that belong to each."""
    scales = np.array(list(found.front))
    answers = list(found.front.values())
    good = np.array([one.status == "ok" for one in answers])
    costs = np.array([one.cost for one in answers])
    single = len(found.answer.limits) == 1
    check = found.answer.limits[0]
    x = np.array([one.limits[0].limit for one in answers]) if single else scales
    label = f"limit on {check.metric}, {check.unit or '1'}" if single else "scale of all limits"
    figure = new_figure(7.2, 6.4)
    above, below = figure.subplots(2, 1, sharex=True)
    above.plot(x, np.where(good, costs, np.nan), "-", color=CASE_COLOURS[0], linewidth=1.2)
    above.plot(x[good], costs[good], MARKERS[0], color=CASE_COLOURS[0], label="limits verified")
    if not good.all():
        above.plot(x[~good], costs[~good], "x", color=CASE_COLOURS[1], label="limits not met")
    here = list(found.front).index(1.0)
    above.plot(
        x[here], costs[here], MARKERS[0], ms=12, mfc="none", color=CASE_COLOURS[1],
        label="asked for",
    )  # fmt: skip
    if np.isfinite(found.cost_before):
        above.axhline(
            found.cost_before, color="#808080", linestyle="--", linewidth=1.0,
            label="cost of the tolerances before",
        )  # fmt: skip
    above.set_ylabel("cost")
    above.legend(frameon=False)
    for i, name in enumerate(found.answer.tolerances):
        specified, factor = as_specified(found.answer.units[name])
        widths = [factor * one.tolerances[name] for one in answers]
        below.plot(
            x, widths, marker=MARKERS[i % len(MARKERS)], label=f"{name}, {specified}",
            color=CASE_COLOURS[i % len(CASE_COLOURS)], linewidth=1.2,
        )  # fmt: skip
    below.set_yscale("log")
    scaled = [below.yaxis]
    if x.min() > 0.0:
        below.set_xscale("log")
        scaled.append(below.xaxis)
    for axis in scaled:
        axis.set_major_formatter("{x:g}")
        axis.set_minor_formatter("{x:g}")
        axis.set_tick_params(which="both", labelsize=8)
    below.set_ylabel("tolerance (half-width or diameter)")
    below.set_xlabel(label)
    below.legend(frameon=False)
    add_titles(figure, "Cheapest tolerances against the limit that they keep", study)
    return figure
