"""Whether a model is divided finely enough for what was measured: how far the errors found would move on a finer one.

Place in the pipeline: residuals at the estimate, finer models -> **discretisation_check** -> conclusion.

    step = -H^-1 J^T W (r' - r)   of Gauss and Newton, r' the residuals of the finer model at the estimate,
    movement = 2^q / (2^q - 1) step,   what it would be on a model without such an error             (17.27)

once for links of twice as many spring-damping elements (sdes), once for half the step of the method, once for what the
spline between saved times misses. Only values of the finer models are needed, one run each.

Symbols: k unknowns, p parameters, n samples, q order of the error.
Source: theory (17.27), (17.28); C. de Boor, A Practical Guide to Splines, 2nd ed. (2001), 5.
"""

import copy
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from rfem_jax.description.tasks.identification import Sensor
from rfem_jax.tolerancing.identification.levenberg_marquardt import Searches
from rfem_jax.tolerancing.identification.predictions import Predictor, spline
from rfem_jax.tolerancing.identification.residuals import Residuals, robust
from rfem_jax.tolerancing.identification.sensor_filters import filtered
from rfem_jax.tolerancing.layout import show_number
from rfem_jax.tolerancing.refinement import refined, rfes_of

MOST = 0.5  # of a standard deviation that errors may move
FEWEST = 9  # saved times that tell what is between them
RFES, STEP, SAVED = "rfes", "step", "save_every"
ORDERS = {RFES: 2, STEP: 2, SAVED: 4}
FILTERED = 2  # order of a filter between saved times, between which signals are linear


@dataclass(frozen=True, eq=False)
class Division:
    """One way in which a model is divided: rfes of links, "step" of the method, or "save_every", its saved times.

    movement (k,) [rad, m]: of the errors found, were it divided without end, NaN where that is not known; deviations
    (k,): of these in standard deviations of the posterior; now {link: rfes}, or {"": step or interval [s]}; wanted:
    with which no error would move by more than `MOST`; failed: why it is not known.
    """

    what: str
    movement: Float[np.ndarray, " k"]
    deviations: Float[np.ndarray, " k"]
    now: dict[str, float]
    wanted: dict[str, float]
    failed: str = ""

    @property
    def coarse(self) -> bool:
        """Whether an error would move by more than `MOST` standard deviations."""
        return bool(np.any(self.deviations > MOST))


def too_coarse(divisions: Sequence[Division]) -> bool:
    """Whether an error would move by more than `MOST` standard deviations on a model without these divisions, or
    without one of them."""
    return any(one.coarse for one in divisions) or bool(np.any(_together(divisions) > MOST))


def _together(divisions: Sequence[Division]) -> Float[np.ndarray, " k"]:
    """Standard deviations (k,) by which errors would move without all divisions that are known."""
    known = [one for one in divisions if not one.failed]
    if not known:
        return np.zeros(0)
    with np.errstate(divide="ignore", invalid="ignore"):
        signed = [np.nan_to_num(np.sign(one.movement) * one.deviations) for one in known]
    return np.abs(np.sum(signed, axis=0))


def check_discretisation(
    residuals: Residuals, searches: Searches, w: int, deviation: Float[np.ndarray, " k"],
    finer: Sequence[Any] | None,
) -> tuple[Division, ...]:  # fmt: skip
    """Every division of the model at the end of search w; deviation (k,) [rad, m]: of the posterior; finer: problems of
    all experiments with twice as many sdes in their links, None without."""
    predictors, moved = residuals.predictors, _Moved(residuals, searches, w, deviation)
    found = [moved.of(SAVED, _between_saved_times(residuals, searches, w), _interval(predictors))]
    steps = [getattr(one.problem, "refined", None) for one in predictors]
    if all(callable(one) for one in steps):
        change, failed = _change(residuals, searches, w, [one() for one in steps if callable(one)], shared=True)
        found.append(moved.of(STEP, change, {"": _step(predictors)}, failed))
    if finer is not None:
        change, failed = _change(residuals, searches, w, finer, shared=False)
        found.append(moved.of(RFES, change, _rfes(predictors[0].problem), failed))
    return tuple(one for one in found if one is not None)


@dataclass(frozen=True, eq=False)
class _Moved:
    """How far a change (n,) of the residuals moves the errors found by search w."""

    residuals: Residuals
    searches: Searches
    w: int
    deviation: Float[np.ndarray, " k"]

    def of(
        self, what: str, change: Float[np.ndarray, " n"] | None, now: Mapping[str, float], failed: str = ""
    ) -> Division | None:
        """None where there is nothing to divide."""
        k = len(self.deviation)
        if change is None:
            nothing = np.full(k, np.nan)
            return Division(what, nothing, nothing, dict(now), {}, failed) if failed else None
        misfit, theta, residuals = self.searches.misfit, self.searches.theta[self.w], self.residuals
        weighed = robust(residuals.loss, misfit.residual[self.w])[0] * change
        free = np.flatnonzero((theta > residuals.low) & (theta < residuals.high))
        slope = misfit.jacobian[self.w].T @ weighed
        inverse = np.linalg.pinv(misfit.curvature[self.w][np.ix_(free, free)], hermitian=True)
        step = np.zeros(len(theta))
        step[free] = -inverse @ slope[free]
        order = ORDERS[what]
        scale = 1.0 if what == SAVED else 2.0**order / (2.0**order - 1.0)
        movement = scale * residuals.prior.root @ step[:k]
        # An error that nothing bounds, or one at a bound, has no deviation to move by.
        known = np.isfinite(self.deviation) & (self.deviation > 0.0)
        deviations = np.where(known, np.abs(movement) / np.where(known, self.deviation, 1.0), 0.0)
        finer = (max(float(deviations.max(initial=0.0)), MOST) / MOST) ** (1.0 / order)
        return Division(what, movement, deviations, dict(now), _divided(what, now, finer), failed)


def _divided(what: str, now: Mapping[str, float], finer: float) -> dict[str, float]:
    """Rfes, step or interval of a division that is finer by a factor."""
    if what == RFES:
        return {link: math.ceil(finer * (n - 1) - 1e-6) + 1 for link, n in now.items()}
    return {name: value / finer for name, value in now.items()}


def _change(
    residuals: Residuals, searches: Searches, w: int, problems: Sequence[Any], shared: bool
) -> tuple[Float[np.ndarray, " n"] | None, str]:
    """Residuals of other problems less those of search w, and why there are none; `shared`: whether their programs are
    those of the searches."""
    other = copy.copy(residuals)
    other.predictors = [
        Predictor(one, known.columns, known.names, known.base, known.given_times, None if shared else 1)
        for one, known in zip(problems, residuals.predictors, strict=True)
    ]
    predictions = other.predict(searches.theta[w][None], derivatives=False)
    for one, predictor in zip(predictions, other.predictors, strict=True):
        if not np.isfinite(one.values).all():
            return None, predictor.problem.describe_status(int(one.status[0]))
    change = np.empty(residuals.slices[-1].stop)
    for s, (one, part) in enumerate(zip(other.signals, other.slices, strict=True)):
        curve, _ = other.curve(predictions[one.experiment], 0, s, searches.theta[w], one.history.times)
        change[part] = (curve - one.history.values) / one.noise
    return change - searches.misfit.residual[w], ""


def _between_saved_times(residuals: Residuals, searches: Searches, w: int) -> Float[np.ndarray, " n"] | None:
    """What signals have at the times of the samples beside what is made of their values at saved times."""
    if any(len(one.times) < FEWEST for one in residuals.predictors):
        return None
    predictions, theta = residuals.predict(searches.theta[w][None], derivatives=False), searches.theta[w]
    change = np.empty(residuals.slices[-1].stop)
    for s, (one, part) in enumerate(zip(residuals.signals, residuals.slices, strict=True)):
        predictor, faults = residuals.predictors[one.experiment], residuals.faults(theta, s)
        values = predictions[one.experiment].values[0, predictor.columns.index(one.history.column)]
        missed = _missed(predictor.times, values, one.sensor, one.history.times - faults["shift"])
        change[part] = (1.0 + faults["gain"]) * missed / one.noise
    return change


def _missed(
    times: Float[np.ndarray, " T"], values: Float[np.ndarray, " T"], sensor: Sensor, at: Float[np.ndarray, " n"]
) -> Float[np.ndarray, " n"]:
    """By every second saved value (theory (17.28)): what the spline through all misses between them, and a filter
    everywhere."""
    rows = np.unique([*range(0, len(times), 2), len(times) - 1])
    if sensor.filter:
        fine, coarse = (
            spline(t, filtered(t, x, sensor))(at) for t, x in ((times, values), (times[rows], values[rows]))
        )
        return (fine - coarse) / (2.0**FILTERED - 1.0)
    between = np.arange(1, len(times) - 1, 2)
    misses = values[between] - spline(times[rows], values[rows])(times[between])
    before = np.clip(np.searchsorted(times, at, side="right") - 1, 0, len(times) - 2)
    u = (at - times[before]) / np.diff(times)[before]
    return np.interp(at, times[between], misses) * (u * (1.0 - u)) ** 2


def _interval(predictors: Sequence[Predictor]) -> dict[str, float]:
    return {"": max(float(np.diff(one.times).max()) for one in predictors)}


def _step(predictors: Sequence[Predictor]) -> float:
    """The longest step [s]; NaN of a method that chooses its steps."""
    steps = [getattr(getattr(one.problem, "method", None), "step", None) for one in predictors]
    return max((np.nan if one is None else float(one) for one in steps), default=np.nan)


def _rfes(problem: Any) -> dict[str, float]:
    model = getattr(problem, "model", None)
    return {} if model is None else dict(rfes_of(model))


def has_flexible_links(problem: Any) -> bool:
    """Whether a problem is of a mechanism with links of rigid finite elements."""
    return bool(_rfes(problem))


def is_refined(problem: Any, other: Any) -> bool:
    """Whether another problem has twice as many sdes in every link; also where either has no links."""
    return not _rfes(problem) or not _rfes(other) or _rfes(other) == refined(rfes_of(problem.model), 2.0)


def discretisation_remarks(divisions: Sequence[Division], names: Sequence[str]) -> list[str]:
    """In sentences whether the model is divided finely enough, or what would do."""
    found = [_coarse(one, names) for one in divisions if one.coarse]
    found += [
        f"Whether the model is fine enough ({_WORDS[one.what]}) is not known: the finer one failed ({one.failed})."
        for one in divisions
        if one.failed
    ]
    told = [one for one in divisions if not one.failed]
    if not told or any(one.coarse for one in told):
        return found
    said, together = ", ".join(_WORDS[one.what] for one in told), _together(divisions)
    if too_coarse(divisions):
        worst = max(told, key=lambda one: float(one.deviations.max()))
        return [
            *found,
            f"The model is too coarse for these data, as all its divisions together ({said}) are, most of all "
            f"{_WORDS[worst.what]}: refine that. On a fine one would move {_moved(together, names)}.",
        ]
    i = int(np.argmax(together))
    return [
        *found,
        f"The model is fine enough for these data ({said}): on an infinitely fine one {names[i]} would move most, by "
        f"{show_number(float(together[i]), 2)} standard deviations.",
    ]


_WORDS = {RFES: "rfes of links", STEP: "the method's step", SAVED: "saved times"}


def _moved(deviations: Float[np.ndarray, " k"], names: Sequence[str]) -> str:
    large = [i for i in np.argsort(-deviations, kind="stable") if deviations[i] > MOST]
    return ", ".join(f"{names[i]} by {show_number(float(deviations[i]), 2)} standard deviations" for i in large)


def _coarse(one: Division, names: Sequence[str]) -> str:
    """Why a division is too coarse, what would do, and how far errors would move."""
    moved = _moved(one.deviations, names)
    if one.what == RFES:
        why = f"links have too few rfes ({_numbers(one.now)})"
        what = f"take {_numbers(one.wanted)}"
    else:
        what = "a smaller `save_every`" if one.what == SAVED else "a shorter `step`"
        known = np.isfinite(list(one.wanted.values())).all()
        why = "saved times are too far apart" if one.what == SAVED else "the method's steps are too long"
        what = f"take {what}, of {show_number(one.wanted[''], 2)} s" if known else "take smaller tolerances"
    return f"The model is too coarse for these data, as {why}: {what}. On a fine one would move {moved}."


def _numbers(rfes: Mapping[str, float]) -> str:
    return ", ".join(f"{n:g} in {link}" for link, n in rfes.items())
