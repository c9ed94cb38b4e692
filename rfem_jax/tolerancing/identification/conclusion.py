"""The result of an identification, from the ends of its searches: modes, intervals, how signals are fitted, remarks.

Place in the pipeline: searches, posterior, fit tests, observability -> **conclusion** -> identification_study.

Symbols: k unknowns, p parameters (with the sensors' faults), w searches.
Source: theory (17.7) to (17.13).
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import jax
import numpy as np
from scipy.stats import norm

from rfem_jax.description.tasks.identification import Sensors
from rfem_jax.tolerancing.identification.discretisation_check import (
    Division,
    check_discretisation,
    discretisation_remarks,
    has_flexible_links,
    too_coarse,
)
from rfem_jax.tolerancing.identification.fit_tests import SignalFit, tested
from rfem_jax.tolerancing.identification.identification_result import Curve, Identification, ModeFound
from rfem_jax.tolerancing.identification.levenberg_marquardt import Searches
from rfem_jax.tolerancing.identification.observability import (
    Visibility,
    information_of,
    symmetric_unknowns,
    visibility_of,
    without_shift,
)
from rfem_jax.tolerancing.identification.posterior import (
    DEPARTURE,
    FEW,
    LEAST_EFFECTIVE,
    Mode,
    Sampled,
    departure,
    draw,
    find_modes,
    without_saddles,
)
from rfem_jax.tolerancing.identification.predictions import Prediction, interpolation_error
from rfem_jax.tolerancing.identification.prior import Prior
from rfem_jax.tolerancing.identification.residuals import Residuals
from rfem_jax.tolerancing.identification.sensor_filters import filtered
from rfem_jax.tolerancing.identification.signals import signal
from rfem_jax.tolerancing.identification.suspects import find_suspects, suspicion
from rfem_jax.tolerancing.sampling.sequences import RandomKey

NOT_CHECKED = (
    "Whether links have enough rfes was not checked: with too few an estimate is off though the data are explained. "
    "Refine them until it stays, or give the same machine on `finer` links."
)
# Numbers in other units, over those in SI units.
UNITS = {
    60.0 / (2.0 * np.pi): "it may be in revolutions per minute",
    180.0 / np.pi: "it may be in degrees",
    1e3: "it may be in a thousandth of the unit, as mm",
    1e-3: "it may be in thousands of the unit, as kN",
    1e6: "it may be in a millionth of the unit, as in micrometers or microstrains",
    1.0 / 9.81: "it may be in multiples of g, or in kgf",
    -1.0: "its sign may be the other one",
}
NEARLY, EXPLAINED = 0.2, 0.1  # of these factors; of what a signal leaves over
COARSE = 0.3  # standard deviations of the noise: an error of interpolation that counts


def conclude(
    residuals: Residuals, searches: Searches, further: Sensors, confidence: float, samples: int, key: RandomKey,
    finer: Sequence[Any] | None = None, checked: bool = True,
) -> Identification:  # fmt: skip
    """From the ends of the searches to the result; `further`: signals that were not measured, whose worth is told;
    `finer`: the problems with finer links, None without; `checked`: whether the discretisation is."""
    finite = np.isfinite(searches.misfit.cost)
    if not finite.any():
        return _without(residuals, searches, confidence, samples)

    def costs(theta):
        return residuals.evaluate(theta, derivatives=False).cost

    k = len(residuals.prior.names)
    modes = without_saddles(find_modes(residuals, searches), costs, k)
    drawn = draw(modes, costs, residuals.low, residuals.high, jax.random.fold_in(key, 1), samples) if modes else None
    best = modes[0].search if modes else int(np.argmin(searches.misfit.cost))
    found = residuals.predict(searches.theta[best : best + 1])
    signals, seen = _fits(residuals, searches, best, found), _seen(residuals, searches, found, further)
    far = departure(modes, drawn, k) if drawn is not None else np.inf
    normal = drawn is not None and far < DEPARTURE and drawn.effective >= max(LEAST_EFFECTIVE * samples, FEW)
    method = "laplace" if normal or drawn is None or drawn.effective < FEW else "importance"
    found = _interval(residuals, modes, drawn, method, confidence, searches.theta[best])
    divisions = check_discretisation(residuals, searches, best, found["deviation"], finer) if checked and modes else ()
    status = _status(searches, modes, signals, normal or method == "importance", divisions)
    suspects, untried = find_suspects(residuals, searches, best, signals)
    behind = suspicion(suspects, untried)
    curves = _curves(residuals, searches, best)
    remarks = [*_unit_remarks(curves, signals), *([behind] if behind else [])]
    remarks += _remarks(residuals, searches, modes, signals)
    remarks += _interval_remarks(method, normal, drawn, far, samples)
    remarks += discretisation_remarks(divisions, residuals.prior.names)
    if modes and finer is None and any(has_flexible_links(one.problem) for one in residuals.predictors):
        remarks.append(NOT_CHECKED)
    return replace(
        _without(residuals, searches, confidence, samples), status=status, method=method,
        modes=tuple(ModeFound(residuals.prior.errors(m.theta[:k]), m.cost, m.probability) for m in modes),
        effective=0.0 if drawn is None else drawn.effective, departure=far, signals=tuple(signals), visibility=seen,
        **_samples(residuals, drawn), curves=tuple(curves), remarks=tuple(remarks),
        suspects=suspects, divisions=divisions, **found,
    )  # fmt: skip


def _without(residuals: Residuals, searches: Searches, confidence: float, samples: int) -> Identification:
    """The result where nothing was found."""
    prior, nan = residuals.prior, np.full(len(residuals.prior.names), np.nan)
    return Identification(
        names=prior.names, error_units=prior.units, estimate=nan, deviation=nan, low=nan, high=nan,
        covariance=np.outer(nan, nan), prior_mean=prior.mean, prior_deviation=prior.deviations,
        tolerances=prior.tolerances, beyond=nan, confidence=confidence, status="failed", method="laplace", modes=(),
        effective=0.0, samples=samples, departure=np.inf, sampled=np.zeros((0, len(nan))), weights=np.zeros(0),
        prior_precision=prior.precision, signals=(), curves=(), visibility=None, remarks=(),
        steps=searches.steps, starts=len(searches.theta), converged=int(searches.converged.sum()),
    )  # fmt: skip


def _samples(residuals: Residuals, drawn: Sampled | None) -> dict[str, Any]:
    """Samples of the posterior that weigh something."""
    if drawn is None:
        return {}
    kept = drawn.weights > 0.0
    return {
        "sampled": residuals.prior.errors(drawn.theta[kept, : len(residuals.prior.names)]),
        "weights": drawn.weights[kept],
    }


def _status(
    searches: Searches, modes: list[Mode], signals: list[SignalFit], sampled: bool, divisions: Sequence[Division]
) -> str:
    if not searches.converged.any():
        return "not_converged"
    if not modes:
        return "undetermined"
    if any(one.verdict != "fits" for one in signals):
        return "misfit"
    if not sampled:
        return "uncertain"
    if too_coarse(divisions):
        return "coarse"
    return "ambiguous" if len(modes) > 1 else "ok"


def _interval(residuals, modes: list[Mode], drawn: Sampled | None, method, confidence, theta) -> dict[str, Any]:
    """Estimate, deviations, interval, covariance and probabilities beyond the tolerances, about the best mode."""
    prior, k = residuals.prior, len(residuals.prior.names)
    estimate, nan = prior.errors(theta[:k]), np.full(k, np.nan)
    if not modes:
        infinite = np.full(k, np.inf)
        return {"estimate": estimate, "deviation": infinite, "low": -infinite, "high": infinite}
    tail = 0.5 * (1.0 - confidence)
    covariance = prior.root @ modes[0].covariance[:k, :k] @ prior.root.T
    deviation = np.sqrt(np.diag(covariance))
    low, high = (estimate + norm.ppf(one) * deviation for one in (tail, 1.0 - tail))
    with np.errstate(invalid="ignore"):
        beyond = sum(
            (
                m.probability
                * _outside(prior.errors(m.theta[:k]), prior.root @ m.covariance[:k, :k] @ prior.root.T, prior)
                for m in modes
            ),
            start=np.zeros(k),
        )
    if method == "importance" and drawn is not None:
        x = prior.errors(drawn.theta[:, :k])
        pairs = [drawn.quantiles(x[:, i], 0, (tail, 1.0 - tail)) for i in range(k)]
        low, high = np.array(pairs).T
        mine = np.where(drawn.nearest == 0, drawn.weights, 0.0)
        mine = mine / mine.sum()
        away = x - mine @ x
        covariance = (mine[:, None] * away).T @ away
        deviation = np.sqrt(np.diag(covariance))
        outside = (x < prior.tolerances[:, 0]) | (x > prior.tolerances[:, 1])
        beyond = np.where(np.isnan(prior.tolerances[:, 0]), nan, drawn.weights @ outside)
    low, high = np.maximum(low, prior.ends[0]), np.minimum(high, prior.ends[1])
    return {
        "estimate": estimate, "deviation": deviation, "low": low, "high": high, "covariance": covariance,
        "beyond": beyond,
    }  # fmt: skip


def _outside(x: np.ndarray, covariance: np.ndarray, prior: Prior) -> np.ndarray:
    deviation = np.sqrt(np.diag(covariance))
    return norm.cdf((prior.tolerances[:, 0] - x) / deviation) + norm.sf((prior.tolerances[:, 1] - x) / deviation)


def _fits(residuals: Residuals, searches: Searches, w: int, predictions: list[Prediction]) -> list[SignalFit]:
    """How every signal is fitted by search w, whose end has these predictions."""
    misfit, tests = searches.misfit, 2 * len(residuals.signals)
    inverse = np.linalg.pinv(misfit.curvature[w], hermitian=True)
    found = []
    for s, (one, part) in enumerate(zip(residuals.signals, residuals.slices, strict=True)):
        r, j = misfit.residual[w, part], misfit.jacobian[w, part]
        estimated = one.sensor.noise is None
        found_by = tested(residuals.loss, r, float(np.sum((j @ inverse) * j)), estimated, tests)
        predictor = residuals.predictors[one.experiment]
        values = predictions[one.experiment].values[0, predictor.columns.index(one.history.column)]
        shown = filtered(predictor.times, values, one.sensor)
        coarse = interpolation_error(predictor.times, shown) / one.noise
        before = searches.first.residual[0, part]
        faults = residuals.faults(searches.theta[w], s)
        found.append(
            SignalFit(
                column=one.history.column, unit=signal(one.history.column).unit, experiment=one.experiment + 1,
                samples=len(r), noise=one.noise, estimated=estimated, shift=faults["shift"], offset=faults["offset"],
                gain=faults["gain"], remainder=one.noise * float(np.sqrt(np.mean(r**2))),
                before=one.noise * float(np.sqrt(np.mean(before**2))), interpolation=coarse, **found_by._asdict(),
            )
        )  # fmt: skip
    return found


def _curves(residuals: Residuals, searches: Searches, w: int) -> list[Curve]:
    found = []
    for one, part in zip(residuals.signals, residuals.slices, strict=True):
        before, after = (one.noise * r[part] for r in (searches.first.residual[0], searches.misfit.residual[w]))
        history = one.history
        y = history.values
        found.append(Curve(history.column, one.experiment + 1, history.times, y, y + before, y + after))
    return found


def _seen(residuals: Residuals, searches: Searches, predictions: list[Prediction], further: Sensors) -> Visibility:
    """What the signals, and further ones, tell at the estimate, of all experiments together."""
    k, prior = len(residuals.prior.names), residuals.prior
    own = {one.history.column: replace(one.sensor, noise=one.noise) for one in residuals.signals}
    parts: dict[str, np.ndarray] = {}
    for e, predictor in enumerate(residuals.predictors):
        mine = {one.history.column: one for one in residuals.signals if one.experiment == e}
        clock = next(iter(mine.values())).history.times
        for column in predictor.columns:
            sensor = replace(own[column], noise=mine[column].noise) if column in mine else further[column]
            times = mine[column].history.times if column in mine else clock
            part = information_of(prior, predictor, predictions[e], 0, column, sensor, times, residuals.time_shift)
            if len(residuals.predictors) > 1:  # each has a shift of its own
                part = np.pad(without_shift(part, bool(residuals.time_shift)), ((0, 1), (0, 1)))
            parts[column] = parts.get(column, 0.0) + part
    size = np.sqrt(np.sum(searches.first.jacobian[:, :, :k] ** 2, axis=1))
    size[~np.isfinite(searches.first.cost)] = np.nan
    return visibility_of(prior, parts, bool(residuals.time_shift), symmetric_unknowns(prior.names, size))


def _remarks(residuals: Residuals, searches: Searches, modes: list[Mode], signals: list[SignalFit]) -> list[str]:
    """Sentences about searches, signals and modes."""
    found, k = [], len(residuals.prior.names)
    failed = int((~np.isfinite(searches.first.cost)).sum())
    if failed:
        found.append(f"{failed} of {len(searches.theta)} starts failed, as their runs did.")
    for one, part in zip(residuals.signals, residuals.slices, strict=True):
        if not np.any(np.abs(searches.first.jacobian[:, part, :k]) > 1e-9):
            found.append(f"`{one.history.column}` does not depend on any unknown: it tells nothing of them.")
    for one in signals:
        if one.interpolation > COARSE:
            found.append(
                f"Between saved times `{one.column}` is interpolated with errors of {one.interpolation:.2g} standard "
                "deviations of its noise; take a smaller `save_every`."
            )
    for one in modes[1:]:
        changed = _mirrored(residuals, modes[0], one)
        if changed:
            found.append(
                f"The same errors with {'the opposite sign' if len(changed) == 1 else 'opposite signs'} of "
                f"{', '.join(changed)} explain the data, too (probability {one.probability:.2g})."
            )
    return found


def _unit_remarks(curves: list[Curve], signals: list[SignalFit]) -> list[str]:
    """Sentences about signals that do not fit as they are in another unit, of the other sign, or of no sensor."""
    found = []
    for curve, one in zip(curves, signals, strict=True):
        y, expected = curve.measured, curve.before
        if np.ptp(y) == 0.0:
            found.append(
                f"All samples of `{one.column}` are {y[0]:g}: a sensor that shows nothing else may not be connected."
            )
        elif one.verdict != "fits" and expected @ expected > 0.0:
            ratio = float(expected @ y / (expected @ expected))
            explained = np.sum((y - ratio * expected) ** 2) < EXPLAINED * np.sum((y - expected) ** 2)
            near = min(UNITS, key=lambda factor: abs(ratio / factor - 1.0))
            if explained and abs(ratio / near - 1.0) < NEARLY:
                found.append(
                    f"`{one.column}` is {ratio:.4g} times what the model shows: {UNITS[near]}; give numbers in "
                    f"{one.unit or '1'}, with the signs of the model."
                )
    return found


def _interval_remarks(method: str, normal: bool, drawn: Sampled | None, far: float, samples: int) -> list[str]:
    if drawn is None:
        return []
    said = f"{drawn.effective:.0f} effective of {samples} samples"
    if normal:
        return [f"The normal approximation of the posterior holds ({said}, departure {far:.2g} standard deviations)."]
    words = "intervals are those of the samples" if method == "importance" else "intervals are rough"
    return [f"The posterior is not normal ({said}, departure {far:.2g} standard deviations): {words}."]


def _mirrored(residuals: Residuals, best: Mode, other: Mode) -> list[str]:
    """Unknowns with another sign in another mode, which is the same but for signs; none where it is not."""
    k, prior = len(residuals.prior.names), residuals.prior
    x, y = prior.errors(best.theta[:k]), prior.errors(other.theta[:k])
    spread = 3.0 * np.sqrt(np.diag(prior.root @ (best.covariance + other.covariance)[:k, :k] @ prior.root.T))
    opposite = (np.abs(x + y) < spread) & (np.abs(x - y) > spread)
    same = np.abs(x - y) < spread
    return [name for name, one in zip(prior.names, opposite, strict=True) if one] if np.all(opposite | same) else []
