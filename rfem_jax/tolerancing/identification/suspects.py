"""Which error is behind a misfit: every one that is no unknown, tried by its score (theory (17.18), (17.19)).

Place in the pipeline: residuals at the estimate, fit tests -> **suspects** -> conclusion.

With s the derivative of the residuals by a suspect, and J by all parameters, with the weights W and H of (17.6),

    u = s - J H^-1 J^T W s,   d = s^T W u,   a = -u^T W r / d,   the chi-square falls by (u^T W r)^2 / d

if the suspect became an unknown of which nothing is known; the other parameters follow. A sensor's offset and gain and
the delay of a clock are suspects, too, where they were no unknowns.

Symbols: n samples of all signals, p parameters, m suspects.
Source: C. R. Rao, Proc. Camb. Phil. Soc. 44 (1948) 50-57 (score test).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float
from scipy.stats import chi2

from rfem_jax.description.tasks.identification import unit_of_column
from rfem_jax.tolerancing.identification.fit_tests import DOUBT, SignalFit, tested
from rfem_jax.tolerancing.identification.levenberg_marquardt import Searches
from rfem_jax.tolerancing.identification.predictions import Predictor, scaled_base
from rfem_jax.tolerancing.identification.residuals import Residuals, robust
from rfem_jax.tolerancing.identification.sensor_filters import sensed
from rfem_jax.tolerancing.layout import show_error, show_number

SHOWN = 8  # suspects in the result
FEW = 6  # names in a sentence
SHARE = 0.8  # of the misfit, from which it is explained
ALIKE = 0.9  # of the best one's fall: nearly as good an explanation
INDEPENDENT = 1e-8  # part of an effect that no unknown has, below which nothing can be said
VANISHING = 1e-6  # of the largest first effect of a suspect of this unit, below which it is rounding


@dataclass(frozen=True)
class Suspect:
    """An error that is no unknown, and what it would explain: name, unit; value that fits best, its standard deviation
    [unit]; fall of the chi-square, and its share of what is in excess (of all of it where a noise was estimated);
    fits: whether all signals would fit then; named: whether it explains the misfit."""

    name: str
    unit: str
    value: float
    deviation: float
    fall: float
    share: float
    fits: bool
    named: bool


def find_suspects(
    residuals: Residuals, searches: Searches, w: int, fits: Sequence[SignalFit]
) -> tuple[tuple[Suspect, ...], tuple[str, ...]]:
    """The suspects that would lower the chi-square most, at the end of search w, and the names of those that cannot be
    tried, as their first effect vanishes; none where all signals fit, or leave less than their noise."""
    excess = sum(one.chi_square - (0.0 if one.estimated else one.freedom) for one in fits)
    if all(one.verdict == "fits" for one in fits) or excess <= 0.0:
        return (), ()
    names, units, columns = _of_errors(residuals, searches.theta[w])
    faults = _of_sensors(residuals, searches.theta[w])
    columns = np.concatenate([columns, *(one[:, None] for _, _, one in faults)], axis=1)
    names, units = [*names, *(name for name, _, _ in faults)], [*units, *(unit for _, unit, _ in faults)]
    r, jacobian = searches.misfit.residual[w], searches.misfit.jacobian[w]
    weight = robust(residuals.loss, r)[0][:, None]
    inverse = np.linalg.pinv(searches.misfit.curvature[w], hermitian=True)
    size = np.sum(weight * columns**2, axis=0)
    alone = columns - jacobian @ (inverse @ (jacobian.T @ (weight * columns)))
    own = np.sum(weight * columns * alone, axis=0)
    shown = np.sqrt(np.nan_to_num(size))
    largest = np.array([shown[[one == unit for one in units]].max() for unit in units])
    vanishing = tuple(name for name, one, most in zip(names, shown, largest, strict=True) if one <= VANISHING * most)
    told = np.isfinite(own) & (shown > VANISHING * largest) & (own > INDEPENDENT * size)
    if not told.any():
        return (), vanishing
    score = np.sum(weight * alone * r[:, None], axis=0)
    fall = np.where(told, score**2 / np.where(told, own, 1.0), 0.0)
    found, limit = [], chi2.isf(DOUBT / int(told.sum()), 1)
    for i in np.argsort(-fall, kind="stable")[: min(SHOWN, int(told.sum()))]:
        value, share = -score[i] / own[i], min(float(fall[i] / excess), 1.0)
        would_fit = _fits_with(residuals, fits, r + alone[:, i] * value)
        named = bool(fall[i] > limit and (would_fit or share > SHARE))
        deviation = float(1.0 / np.sqrt(own[i]))
        found.append(Suspect(names[i], units[i], float(value), deviation, float(fall[i]), share, would_fit, named))
    return tuple(found), vanishing


def suspicion(suspects: Sequence[Suspect], vanishing: Sequence[str]) -> str | None:
    """In a sentence what is behind the misfit, or that nothing that could be tried is."""
    untried = ""
    if vanishing:
        few = f"{', '.join(vanishing[:FEW])}{' ...' if len(vanishing) > FEW else ''}"
        untried = f"; {len(vanishing)} could not be tried, as their first effect vanishes at the estimate ({few})"
    if not any(one.named for one in suspects):
        if not (suspects or vanishing):
            return None
        text = "No other error, parameter or fault of a sensor explains the misfit"
        if suspects:
            best = suspects[0]
            text += f": the best, {best.name}, would explain {100.0 * best.share:.2g} % of it"
        return f"{text}{untried}; look for an effect that the model lacks, a disturbance or wrong noise."
    best = next(one for one in suspects if one.named)
    alike = [one.name for one in suspects if one is not best and one.named and one.fall > ALIKE * best.fall]
    text = (
        f"{best.name}, which is no unknown, explains {100.0 * best.share:.3g} % of the misfit with "
        f"{_shown(best.value, best.unit, 3)} +- {_shown(best.deviation, best.unit, 2)} to first order"
    )
    text += ", and all signals would fit" if best.fits else f", and something would still be left over{untried}"
    return f"{text}; nearly as well would {', '.join(alike)}." if alike else f"{text}. Make it an unknown."


def _shown(value: float, unit: str, digits: int) -> str:
    return show_error(value, unit, digits) if unit in ("rad", "m") else f"{show_number(value, digits)} {unit}".strip()


def _of_errors(residuals: Residuals, theta: np.ndarray) -> tuple[list[str], list[str], Float[np.ndarray, "n m"]]:
    """Errors and parameters that are no unknowns: names, units, derivatives of the residuals at the estimate."""
    problem, prior, k = residuals.predictors[0].problem, residuals.prior, len(residuals.prior.names)
    names = [one for one in problem.error_names if one not in prior.names]
    columns = np.full((residuals.slices[-1].stop, len(names)), np.nan)
    estimate = dict(zip(prior.names, map(float, prior.errors(theta[:k])), strict=True))
    for e, known in enumerate(residuals.predictors) if names else ():
        fixed: dict[str, Any] = {**known.base, **estimate}
        point = np.array([[float(fixed.get(name, 0.0)) for name in names]])
        rest = scaled_base({name: float(value) for name, value in fixed.items() if name not in names})
        found = Predictor(known.problem, known.columns, names, rest, known.given_times).at(point, derivatives=True)
        assert found.derivatives is not None, "asked for"
        for s, (one, part) in enumerate(zip(residuals.signals, residuals.slices, strict=True)):
            if one.experiment != e:
                continue
            slopes = found.derivatives[0, known.columns.index(one.history.column)]
            through, faults = sensed(known.times, slopes, one.sensor), residuals.faults(theta, s)
            columns[part] = (1.0 + faults["gain"]) * through(one.history.times - faults["shift"]) / one.noise
    return names, [problem.error_unit(name) for name in names], columns


def _of_sensors(residuals: Residuals, theta: np.ndarray) -> list[tuple[str, str, Float[np.ndarray, " n"]]]:
    """Faults of sensors that are no unknowns: name, unit, derivative (n,) of the residuals."""
    found, predictions = [], residuals.predict(theta[None], derivatives=False)
    delays = [np.zeros(residuals.slices[-1].stop) for _ in residuals.predictors]
    for s, (one, part) in enumerate(zip(residuals.signals, residuals.slices, strict=True)):
        predictor, faults, column = residuals.predictors[one.experiment], residuals.faults(theta, s), one.history.column
        values = predictions[one.experiment].values[0, predictor.columns.index(column)]
        curve, times = sensed(predictor.times, values, one.sensor), one.history.times - faults["shift"]
        of = f"{column} (experiment {one.experiment + 1})" if len(residuals.predictors) > 1 else column
        delays[one.experiment][part] = -(1.0 + faults["gain"]) * curve(times, 1) / one.noise
        for what, asked, unit, slope in (
            ("offset", one.sensor.offset, unit_of_column(column), np.ones_like(times)),
            ("gain", one.sensor.gain, "", curve(times)),
        ):
            whole = np.zeros(residuals.slices[-1].stop)
            whole[part] = slope / one.noise
            if not asked:
                found.append((f"{what} of {of}", unit, whole))
    if not residuals.time_shift:
        found += [(f"delay of the clock of experiment {e + 1}", "s", whole) for e, whole in enumerate(delays)]
    return found


def _fits_with(residuals: Residuals, fits: Sequence[SignalFit], r: Float[np.ndarray, " n"]) -> bool:
    """Whether these residuals pass the tests of all signals."""
    for one, part in zip(fits, residuals.slices, strict=True):
        determined = one.samples - one.freedom if residuals.loss == "gaussian" else 0.0
        if tested(residuals.loss, r[part], determined, one.estimated, 2 * len(fits)).verdict != "fits":
            return False
    return True
