"""A study's mechanism in the form of the tolerance studies.

Place in the pipeline: study as loaded -> **study_problem** -> the reports on tasks, which call `rfem_jax.tolerancing`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

from jax.typing import ArrayLike

from rfem_jax.description.study_file.study import Study
from rfem_jax.mechanics.model.model import Model
from rfem_jax.mechanics.statics.designs import model_of_study
from rfem_jax.simulation import Simulation
from rfem_jax.simulation.vibrations.stability import largest_stable_step
from rfem_jax.tolerancing.problems.problem import Metric
from rfem_jax.tolerancing.problems.simulated_problem import Problem
from rfem_jax.tolerancing.problems.static_problem import StaticProblem
from rfem_jax.tolerancing.refinement import refined, rfes_of

MARGIN = 0.9  # of the largest stable step


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


def stable_when_refined(study: Study, refinement: float) -> Study:
    """The study with a method of one step for all meshes, stable on that of so many times as many sdes."""
    model = model_of_study(study)
    method = Simulation.of(study, model=model).chosen
    if not method.implicit and method.step is not None:
        finest = model_of_study(study, rfes=refined(rfes_of(model), refinement))
        limit = largest_stable_step(finest, method, study.designed_drive)
        method = replace(method, step=min(method.step, MARGIN * limit))
    return replace(study, method=method)
