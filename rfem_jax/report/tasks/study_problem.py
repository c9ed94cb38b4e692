"""A study's mechanism and tolerances in the form of the tolerance studies.

Place in the pipeline: study as loaded -> **study_problem** -> the reports on tasks, which call `rfem_jax.tolerancing`.

Symbols: half-widths of tolerances in rad and m.
"""

from collections.abc import Sequence

from rfem_jax.description.study import Study
from rfem_jax.description.tolerances import SpecifiedTolerances
from rfem_jax.mechanics import discretise
from rfem_jax.mechanics.model import Model
from rfem_jax.tolerancing import (
    CorrelatedNormal,
    Normal,
    Problem,
    Tolerances,
    Triangular,
    TruncatedNormal,
    Uniform,
)

DISTRIBUTIONS = {
    "uniform": Uniform,
    "triangular": Triangular,
    "normal": Normal,
    "truncated_normal": TruncatedNormal,
}


def build_problem(study: Study, metrics: Sequence[str], model: Model | None = None) -> Problem:
    """The study's mechanism, drive and method as a function of its errors."""
    model = discretise(study.mechanism) if model is None else model
    return Problem(model, study.drive, study.duration, metrics, study.method, save_every=study.save_every)


def build_tolerances(specified: SpecifiedTolerances) -> Tolerances:
    """Distributions of the errors as `rfem_jax.description.tolerances` has them."""
    independent = {}
    for one in specified.independent:
        settings = {} if one.deviations is None else {"deviations": one.deviations}
        independent[one.error] = DISTRIBUTIONS[one.distribution](interval=one.interval, **settings)
    groups = [
        CorrelatedNormal(group.half_widths, group.covariance(), deviations=group.deviations)
        for group in specified.correlated
    ]
    return Tolerances(independent, correlated=groups)
