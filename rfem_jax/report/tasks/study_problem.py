"""A study's mechanism in the form of the tolerance studies.

Place in the pipeline: study as loaded -> **study_problem** -> the reports on tasks, which call `rfem_jax.tolerancing`.
"""

from collections.abc import Mapping, Sequence

from jax.typing import ArrayLike

from rfem_jax.description.study_file.study import Study
from rfem_jax.mechanics.model.model import Model
from rfem_jax.mechanics.statics.designs import model_of_study
from rfem_jax.simulation import Simulation
from rfem_jax.tolerancing.problems.problem import Metric
from rfem_jax.tolerancing.problems.simulated_problem import Problem
from rfem_jax.tolerancing.problems.static_problem import StaticProblem


def build_problem(
    study: Study,
    metrics: Sequence[str | Metric],
    model: Model | None = None,
    trials: Mapping[str, ArrayLike] | None = None,
) -> Problem | StaticProblem:
    """The study's mechanism, drive and method as a function of its errors, with a table [statics] its mechanism at
    rest; `trials` as those of `Simulation`."""
    if study.statics is not None:
        model = model_of_study(study, at_rest=True) if model is None else model
        statics = study.statics
        rates, accelerations = (statics.rates, statics.accelerations) if statics.moves else (None, None)
        return StaticProblem(model, metrics, statics.positions, rates=rates, accelerations=accelerations)
    return Problem(Simulation.of(study, model=model, trials=trials), metrics)
