"""What it saves to find dimensions and tolerances together: the study of `[optimise]` against two stages.

    python studies/robust_four_bar/study.py --out results/robust_four_bar [--reserves 1 1.5 2] [--quick]

The limits, bounds, costs and objective of study.toml beside this file are answered in these ways:

    as drawn    the tolerances alone are found, at the sections of the description
    two stages  sections first: least mass, with the perfect mechanism's stress a factor (the reserve) below its limit;
                then the tolerances at these sections
    together    as `rfem-jax optimise study.toml` does

Every answer is verified by fresh mechanisms, drawn uniformly from within its tolerances.  All of them are computed by
one program: what must stay is given bounds that lie next to each other.

Files: `comparison.csv`, `results.json`, a picture.  `--quick` takes a small mechanism, as a trial of the command.
"""

import argparse
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import jax

jax.config.update("jax_enable_x64", True)

import numpy as np  # noqa: E402
from comparison_figure import write_figure  # noqa: E402

from rfem_jax import Problem, Study, load_study, optimise  # noqa: E402
from rfem_jax.report.contents.output import write_csv, write_json  # noqa: E402
from rfem_jax.report.tasks.solution_report import build_cost  # noqa: E402
from rfem_jax.report.tasks.study_problem import build_problem  # noqa: E402
from rfem_jax.tolerancing.problems.evaluation import evaluate_points  # noqa: E402
from rfem_jax.tolerancing.problems.problem import ToleranceProblem  # noqa: E402
from rfem_jax.tolerancing.robust_design.result import DesignOptimum  # noqa: E402

STUDY = Path(__file__).with_name("study.toml")
STAYS = 1e-9  # relative distance of the bounds of what stays
Ends = dict[str, tuple[float, float]]


def smaller(study: Study) -> Study:
    """A short motion of one flexible link of two rfes, whose section is to be found."""
    links = [replace(link, rigid=link.name != "rocker", rfes=2) for link in study.mechanism.links]
    return replace(
        study, mechanism=replace(study.mechanism, links=links), duration=1e-2, save_every=5e-3,
        method=replace(study.method, step=1.25e-3),
        design={name: ends for name, ends in study.design.items() if name.startswith("rocker")},
    )  # fmt: skip


def lighter(task: Any) -> Any:
    """The first of the limits and two of the tolerances alone, and a few steps from two starts."""
    limits, bounds = dict([*task.limits.items()][:1]), dict([*task.bounds.items()][:2])
    costs = {name: task.costs[name] for name in bounds}
    return replace(task, limits=limits, bounds=bounds, costs=costs, starts=2, searches=1, steps=4)


def fixed(values: dict[str, float]) -> Ends:
    """Bounds that leave values where they are."""
    return {name: (value * (1.0 - STAYS), value * (1.0 + STAYS)) for name, value in values.items()}


class Comparison:
    """The questions of a study, asked of one problem."""

    def __init__(self, study: Study, task: Any):
        self.task, self.designs = task, study.design_bounds
        self.problem: Problem = build_problem(study, task.metrics)
        self.mass = next(name for name in task.objective if name != "cost")

    def solve(self, objective: Any, designs: Ends, widths: Any, limits: Any, robust: str) -> DesignOptimum:
        """One optimisation."""
        task = self.task
        return optimise(
            self.problem, designs, widths, objective, limits, robust=robust,
            cost={name: build_cost(cost) for name, cost in task.costs.items()}, key=jax.random.key(task.seed),
            starts=task.starts, searches=task.searches, steps=task.steps, mode="forward", batch=task.batch,
        )  # fmt: skip

    def limits(self, reserve: float = 1.0) -> dict[str, tuple[None, float]]:
        """Upper limits over a reserve."""
        return {name: (None, high / reserve) for name, (_, high) in self.task.limits.items()}

    def sections(self, reserve: float) -> DesignOptimum:
        """Sections of least mass that keep the limits over a reserve at the perfect mechanism."""
        return self.solve(self.mass, self.designs, {**self.task.bounds}, self.limits(reserve), "nominal")

    def tolerances(self, sections: dict[str, float]) -> DesignOptimum:
        """Cheapest tolerances at given sections."""
        return self.solve("cost", fixed(sections), self.task.bounds, self.limits(), "worst_case")

    def together(self) -> DesignOptimum:
        """Sections and tolerances at once."""
        return self.solve(self.task.objective, self.designs, self.task.bounds, self.limits(), "worst_case")

    def row(self, way: str, answer: DesignOptimum, samples: int) -> dict[str, Any]:
        """The answer, its price, and the largest loads of fresh mechanisms."""
        nominal, largest, failed = fresh_loads(self.problem, answer, samples, self.task)
        mass, cost = nominal[self.mass], answer.terms["cost"]
        kept = {name: largest[name] <= high * (1.0 + 1e-3) for name, (_, high) in self.task.limits.items()}
        objective = self.task.objective[self.mass] * mass + self.task.objective["cost"] * cost
        row = {"way": way, "status": answer.status, "objective": objective, "mass_kg": mass, "cost": cost}
        row |= {f"{name}_m": value for name, value in answer.designs.items()}
        row |= {f"{name}_{answer.units[name]}": width for name, width in answer.tolerances.items()}
        row |= {f"largest_{name}": largest[name] for name in kept}
        return row | {"samples": samples, "failed": failed, "all_keep_the_limits": all(kept.values())}


def fresh_loads(
    problem: ToleranceProblem, answer: DesignOptimum, samples: int, task: Any
) -> tuple[dict[str, float], dict[str, float], int]:
    """Every metric of the perfect mechanism, its largest value over mechanisms drawn uniformly from within the
    tolerances, and how many of these failed."""
    names = (*answer.designs, *answer.tolerances)
    dimensions = [value - problem.nominal_value(name) for name, value in answer.designs.items()]
    draws = np.random.default_rng(task.seed + 1).uniform(-1.0, 1.0, (samples, len(answer.tolerances)))
    draws = np.vstack([np.zeros(len(answer.tolerances)), draws])
    points = np.hstack([np.tile(dimensions, (samples + 1, 1)), draws * list(answer.tolerances.values())])
    values = evaluate_points(problem, names, {}, points, task.batch)[0]
    named = [metric.name for metric in problem.metrics]
    perfect, largest = (dict(zip(named, map(float, row))) for row in (values[0], np.nanmax(values[1:], axis=0)))
    return perfect, largest, int(np.isnan(values[1:]).any(axis=1).sum())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, required=True, help="folder of the results")
    parser.add_argument("--reserves", nargs="+", type=float, default=[1.0, 1.5, 2.0], help="of the stress, first stage")
    parser.add_argument("--samples", type=int, default=1024, help="fresh mechanisms that verify an answer")
    parser.add_argument("--quick", action="store_true", help="a small mechanism, for a trial")
    options = parser.parse_args()
    started = time.perf_counter(), time.process_time()
    study = load_study(STUDY)
    task = study.tasks.asked["optimise"]
    if options.quick:
        study, task = smaller(study), lighter(task)
    compared = Comparison(study, task)
    samples = 8 if options.quick else options.samples
    rows = []

    def note(way: str, answer: DesignOptimum) -> None:
        rows.append(compared.row(way, answer, samples))
        print(f"\n{way}\n{answer}\n{time.perf_counter() - started[0]:.0f} s", flush=True)

    note("together", compared.together())
    known = {name: compared.problem.nominal_value(name) for name in compared.designs}
    note("as drawn", compared.tolerances(known))
    for reserve in options.reserves:
        first = compared.sections(reserve)
        print(f"\nsections for a reserve of {reserve:g}\n{first}", flush=True)
        note(f"two stages, reserve {reserve:g}", compared.tolerances(first.designs))
    options.out.mkdir(parents=True, exist_ok=True)
    seconds = {"wall_s": time.perf_counter() - started[0], "processor_s": time.process_time() - started[1]}
    write_csv(options.out / "comparison.csv", rows)
    trial = {"note": "A trial with a small mechanism: these numbers mean nothing."} if options.quick else {}
    write_json(options.out / "results.json", {**trial, **seconds, "ways": rows})
    write_figure(options.out, study, rows)
    print(f"\nTables and a picture are in {options.out}; {seconds['processor_s']:.0f} s of the processor.")


if __name__ == "__main__":
    sys.exit(main())
