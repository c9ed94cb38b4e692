"""What identifications are for, beside the errors: the correction of a machine, and the distribution of errors that
production has, in files and pictures.

Place in the pipeline: `correct`, `estimate_production` -> **decisions** -> the report on identifications.
"""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from jaxtyping import Float

from rfem_jax.compilation.stages import on_stage
from rfem_jax.description.study_file.study import Study
from rfem_jax.description.tasks.correction import AskedCorrection
from rfem_jax.description.tolerances.error_catalogue import as_specified
from rfem_jax.report.contents.annotations import Figure
from rfem_jax.report.drawings.style import CASE_COLOURS, LINE_STYLES, MARKERS, add_titles, new_figure
from rfem_jax.report.tasks import study_problem
from rfem_jax.report.tasks.monte_carlo import scatter_matrix
from rfem_jax.report.tasks.task_report import as_stage
from rfem_jax.tolerancing.identification.correction import correct
from rfem_jax.tolerancing.identification.correction_result import AS_IT_IS, Correction, Outcome
from rfem_jax.tolerancing.identification.identification_result import Identification
from rfem_jax.tolerancing.identification.measurements import Data
from rfem_jax.tolerancing.identification.production import estimate_production
from rfem_jax.tolerancing.identification.production_result import Production
from rfem_jax.tolerancing.layout import show_error

MOST_PAIRS = 6  # errors in the picture of pairs
SHOWN = 200  # samples of the posterior on the page


def corrected(study: Study, asked: AskedCorrection, at: dict[str, float], found: Identification) -> Correction | None:
    """The correction of a machine that was identified; None where nothing is known of it. Raises: InputError."""
    if not len(found.weights):
        return None
    progress = as_stage(f"Looking for the best of {len(asked.adjustments)} adjustments")
    problem = study_problem.build_problem(study, list(dict.fromkeys((asked.metric, *asked.limits))))
    return correct(
        problem, found, asked.metric, asked.adjustments, multiples_of=asked.multiples_of, limits=asked.limits, at=at,
        quantile=asked.quantile, points=asked.points, steps=asked.steps, progress=progress,
    )  # fmt: skip


def correction_content(correction: Correction | None) -> dict[str, Any] | None:
    """As a JSON file has it; distributions as values with the probability to be below them."""
    if correction is None:
        return None
    return {
        "status": correction.status, "message": correction.message, "metric": correction.metric,
        "unit": correction.unit, "adjustments": list(correction.adjustments),
        "adjustment_units": dict(zip(correction.adjustments, correction.error_units, strict=True)),
        "confidence": correction.confidence, "quantile": correction.quantile, "best": correction.best.name,
        "outcomes": [
            {
                "name": one.name, "amounts": one.amounts, "mean": one.mean, "deviation": one.deviation, "low": one.low,
                "high": one.high, "quantile": one.reached, "less": one.less, "failed": one.failed,
                "broken": one.broken, "beyond": dict(zip(correction.names, map(float, one.beyond), strict=True)),
                "any_beyond": one.any_beyond, "converged": one.converged,
                "distribution": distribution(one.values, correction.weights),
            }
            for one in correction.outcomes
        ],
        "sentences": correction.sentences(),
    }  # fmt: skip


def distribution(values: Float[np.ndarray, " N"], weights: Float[np.ndarray, " N"]) -> dict[str, np.ndarray]:
    """Values in rising order with the probability to be below each, at most `SHOWN`; of runs that succeeded."""
    order = np.argsort(values)[: int(np.isfinite(values).sum())]
    reached = np.cumsum(weights[order]) / weights.sum()
    rows = np.unique(np.linspace(0, max(len(order) - 1, 0), SHOWN).round().astype(int)) if len(order) else []
    return {"values": values[order][rows], "below": reached[rows]}


def posterior_samples(found: Identification) -> Float[np.ndarray, "n k"]:
    """Equally probable samples of the posterior [rad, m], at most `SHOWN`; none where it has no samples."""
    if not len(found.weights):
        return found.sampled
    reached = np.cumsum(found.weights)
    n = min(SHOWN, len(reached))
    return found.sampled[np.searchsorted(reached, (np.arange(n) + 0.5) / n * reached[-1]).clip(max=len(reached) - 1)]


def correction_figure(study: Study, correction: Correction) -> Figure:
    """The metric as it is, after the best adjustment, and after all: the probability to be below a value."""
    figure = new_figure(7.6, 4.2)
    axes = figure.subplots()
    shown = {id(one): one for one in (correction.before, correction.best, correction.together)}
    for i, one in enumerate(shown.values()):
        curve = distribution(one.values, correction.weights)
        axes.step(
            curve["values"], 100.0 * curve["below"], where="post", color=CASE_COLOURS[i], linestyle=LINE_STYLES[i],
            label=outcome_text(correction, one),
        )  # fmt: skip
    axes.set_xlabel(f"{correction.metric}, {correction.unit or '1'}")
    axes.set_ylabel("probability to be below, %")
    axes.legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), frameon=False)
    add_titles(figure, "What a correction would do", study)
    return figure


def outcome_text(correction: Correction, one: Outcome) -> str:
    """An outcome with its amounts."""
    amounts = (
        f"{name} by {show_error(amount, unit, 3)}"
        for name, amount, unit in zip(correction.adjustments, one.amounts, correction.error_units, strict=True)
        if amount
    )
    return ", ".join(amounts) or AS_IT_IS


def posterior_figure(study: Study, found: Identification) -> Figure:
    """Pairs of errors: equally probable samples of what is known of them after the measurement."""
    samples, names = posterior_samples(found)[:, :MOST_PAIRS], []
    scales = []
    for name, unit in zip(found.names[:MOST_PAIRS], found.error_units, strict=False):
        specified, factor = as_specified(unit)
        names.append(f"{name}\n{specified}")
        scales.append(factor)
    heading = "What is known of the errors after the measurement; above the diagonal rank correlations"
    return scatter_matrix(study, names, samples * scales, heading)


def production_of(
    machines: Mapping[str, Data], find: Callable[[Data], Identification], confidence: float
) -> Production:
    """The distribution of the errors of several machines, each identified by `find`. Raises: InputError."""
    found = {}
    for number, (name, data) in enumerate(machines.items()):
        on_stage(f"Identifying {len(machines)} machines", number / len(machines))
        found[name] = find(data)
    return estimate_production(found, confidence=confidence)


def production_content(result: Production) -> dict[str, Any]:
    """As a JSON file has it."""
    return {
        "status": result.status, "message": result.message, "confidence": result.confidence, "errors": result.rows(),
        "machines": result.machine_rows(), "tolerances": result.lines(),
        "units": dict(zip(result.names, result.error_units, strict=True)),
    }  # fmt: skip


def production_figure(study: Study, result: Production) -> Figure:
    """Every error, in its unit: the machines, mean and three deviations of production, and the tolerance."""
    k = len(result.names)
    figure = new_figure(7.6, 0.9 * k + 1.6)
    panels = figure.subplots(k, 1, squeeze=False)[:, 0]
    for i, (axes, name, unit) in enumerate(zip(panels, result.names, result.error_units, strict=True)):
        word, factor = as_specified(unit)
        low, high = factor * result.tolerances[i]
        if np.isfinite(low):
            axes.barh(0.0, high - low, 0.9, left=low, color="#E4E4E4", label="tolerance")
        axes.errorbar(
            factor * result.mean[i], 0.0, xerr=3.0 * factor * result.deviation[i], fmt=MARKERS[1], capsize=4,
            color=CASE_COLOURS[1], label="production, mean and three deviations",
        )  # fmt: skip
        x = factor * result.errors[:, i]
        places = np.linspace(-0.3, 0.3, len(x)) if len(x) > 1 else np.zeros(len(x))
        axes.plot(x, places, MARKERS[0], ms=2.5, color=CASE_COLOURS[2], markeredgewidth=0.0, label="machines")
        axes.set_yticks([0.0], [name])
        axes.set_ylim(-0.5, 0.5)
        axes.grid(visible=False, axis="y")
        axes.set_xlabel(word)
    panels[0].legend(loc="lower left", bbox_to_anchor=(0.0, 1.0), ncols=3, frameon=False)
    add_titles(figure, f"Errors of production, from {len(result.machines)} machines", study)
    return figure
