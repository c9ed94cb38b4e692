"""From measurements to errors: the estimate, how sure it is, whether the model fits, what could be known beforehand.

Place in the pipeline: problem, measurements, tolerances -> **identification_study** -> Identification.

Symbols: k unknowns, p parameters (with the sensors' faults), w searches.
Source: theory (17.1) to (17.14).
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import jax
import numpy as np
from jaxtyping import Float
from scipy.stats import norm

from rfem_jax.description.basics.errors import InputError, require_choice
from rfem_jax.description.basics.precision import require_float64
from rfem_jax.description.basics.units import quantity
from rfem_jax.description.tasks.identification import LOSSES, Sensors, require_noise
from rfem_jax.description.tasks.settings import fraction, whole_number
from rfem_jax.simulation.specification import Simulation
from rfem_jax.tolerancing.checks import ErrorValues
from rfem_jax.tolerancing.designs.sweep_study import Bounds, read_fixed
from rfem_jax.tolerancing.identification.fit_tests import SignalFit, chance, verdict_on, whiteness
from rfem_jax.tolerancing.identification.identification_result import Curve, Identifiability, Identification, ModeFound
from rfem_jax.tolerancing.identification.levenberg_marquardt import Searches, search
from rfem_jax.tolerancing.identification.measurements import Data, History, read_data, read_signals
from rfem_jax.tolerancing.identification.observability import (
    VANISHING,
    Visibility,
    rank_signals,
    see,
    signal_information,
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
from rfem_jax.tolerancing.identification.predictions import (
    Prediction,
    Predictor,
    interpolation_error,
    scaled_base,
    spline,
)
from rfem_jax.tolerancing.identification.prior import Prior, read_prior
from rfem_jax.tolerancing.identification.residuals import Residuals, robust
from rfem_jax.tolerancing.identification.signals import signal
from rfem_jax.tolerancing.problems.problem import ToleranceProblem
from rfem_jax.tolerancing.problems.simulated_problem import Problem
from rfem_jax.tolerancing.progress import ProgressBar, ProgressOption
from rfem_jax.tolerancing.sampling.sequences import RandomKey, unit_points

ROUNDS = 6  # of estimates of the noise
SETTLED = 0.02  # relative change of an estimated noise
COARSE = 0.3  # standard deviations of the noise: an error of interpolation that counts
MAD_EFFICIENCY = 0.37  # of the median of absolute values beside the standard deviation, of normal numbers
SEARCH = "search"

Problems = ToleranceProblem | Simulation | Sequence[ToleranceProblem | Simulation]


def identify(
    problem: Problems,
    data: Data | Sequence[Data],
    signals: Mapping[str, Any] | Sequence[str] | str,
    tolerances: Any = None,
    *,
    unknowns: Sequence[str] | None = None,
    prior: str = "tolerances",
    bounds: Bounds | None = None,
    at: ErrorValues | None = None,
    candidates: Mapping[str, Any] | None = None,
    time_shift: float | str = 0.0,
    loss: str = "gaussian",
    confidence: float = 0.95,
    starts: int = 8,
    iterations: int = 60,
    samples: int = 256,
    times: Any = None,
    key: RandomKey | None = None,
    progress: ProgressOption = False,
) -> Identification:
    """Find the errors of a machine from what was measured of it.

    Args:
        problem: a `Simulation` or `Problem` (whose metrics do not matter), or another problem whose metrics are the
            signals, each with values (T,) at `times`; a list of them for several experiments with the same machine.
        data: a CSV file or {column: values, or (times, values)} with `time_s`; a list as long as that of the problems.
        signals: {column of a run's CSV file: Sensor(noise, offset, gain)}, or names, whose noise is estimated.
        tolerances: a `Tolerances` collection, or a study that has them.
        unknowns: names of errors, parameters and numbers of drives; None for all that have tolerances or bounds.
        prior: "tolerances": normal, with their means, standard deviations and correlations; or "flat".
        bounds: {error: (low, high)} in rad or m, or strings with a unit, which estimates do not leave.
        at: {error: value} of errors that are known; all others are zero.
        candidates: {column: Sensor(noise)} of further signals, whose worth at the estimate is told.
        time_shift: standard deviation [s], or a string with a unit, of the unknown delay of the clock of `data`.
        loss: "gaussian", or with outliers "huber" or "cauchy".
        confidence: of the intervals.
        starts: searches; the first starts from the prior's mean, at which first derivatives may vanish by symmetry.
        iterations: the most steps of a search.
        samples: runs of the importance sampling that checks the intervals.
        times: (T,) [s], where the values of a problem are that is not simulated.
        key: JAX random key of starts and samples; None for jax.random.key(0).
        progress: True, or a function of (done, total), steps of the searches.
    Returns: the result, whose status says what failed, if anything did.
    Raises: InputError for data that cannot be used, and for unknown names and bad numbers.
    """
    require_float64()
    require_choice(loss, LOSSES, "loss")
    for what, number, least in (("starts", starts, 1), ("iterations", iterations, 1), ("samples", samples, 16)):
        whole_number(number, what, least)
    level, key = fraction(confidence, "confidence"), jax.random.key(0) if key is None else key
    problems, sensors, further = _as_list(problem), read_signals(signals), _further(candidates)
    known, fixed = _read_prior(problems[0], sensors, tolerances, unknowns, prior, bounds, at)
    columns = list(dict.fromkeys((*sensors, *further)))
    predictors = [Predictor(one, columns, known.names, fixed, times) for one in problems]
    histories = _histories(_as_list(data), sensors, len(problems))
    residuals = Residuals(known, predictors, histories, sensors, _shift(time_shift), loss)
    with ProgressBar(progress, iterations, unit=SEARCH) as bar:
        searches = _settle(residuals, _starts(residuals, key, starts), iterations, bar.advance)
    return _conclude(residuals, searches, further, level, samples, key)


def _histories(data: list[Data], sensors: Sensors, experiments: int) -> list[list[History]]:
    if len(data) != experiments:
        raise InputError(
            f"Arguments `problem` and `data` must be as many, but are {experiments} and {len(data)}; give the data of "
            "every experiment."
        )
    return [read_data(one, sensors) for one in data]


def identifiability(
    problem: ToleranceProblem | Simulation,
    signals: Mapping[str, Any],
    tolerances: Any = None,
    *,
    unknowns: Sequence[str] | None = None,
    prior: str = "tolerances",
    bounds: Bounds | None = None,
    at: ErrorValues | None = None,
    sample_times: Any = None,
    time_shift: float | str = 0.0,
    points: int = 16,
    times: Any = None,
    key: RandomKey | None = None,
) -> Identifiability:
    """What signals can tell of errors, before any is measured: visible combinations, the best choice of signals.

    Args:
        signals: {column: Sensor(noise, ...)}, all candidates.
        sample_times: (n,) [s] at which all would be sampled; None: the times that a run saves.
        points: of the prior, over which the information is averaged; the first one is its mean.
        problem, tolerances, unknowns, prior, bounds, at, time_shift, times, key: as of `identify`.
    Raises: InputError as `identify`, and for signals without noise.
    """
    require_float64()
    sensors, shift = read_signals(signals), _shift(time_shift)
    for column, sensor in sensors.items():
        require_noise(column, sensor, "signals")
    known, fixed = _read_prior(problem, sensors, tolerances, unknowns, prior, bounds, at)
    predictor = Predictor(problem, list(sensors), known.names, fixed, times)
    key = jax.random.key(0) if key is None else key
    z = _prior_points(known, key, whole_number(points, "points", 1))
    prediction = predictor.at(known.errors(z), derivatives=True)
    good = np.flatnonzero(np.isfinite(prediction.values).all(axis=(1, 2)))
    seen = None
    if len(good):
        at_times = predictor.times if sample_times is None else np.asarray(sample_times, dtype=float)
        parts = {
            column: np.mean(
                [_part(known, predictor, prediction, w, column, sensors, at_times, shift) for w in good], axis=0
            )
            for column in sensors
        }
        slopes = prediction.derivatives @ known.root
        noise = np.array([sensors[column].noise for column in sensors])
        size = np.sqrt(np.sum((slopes / noise[None, :, None, None]) ** 2, axis=(1, 2)))
        seen = _visibility(known, parts, bool(shift), _symmetric(known.names, size))
    return Identifiability(known.names, known.units, known.scale, seen, len(z), len(z) - len(good))


def _as_list(one: Any) -> list[Any]:
    return list(one) if isinstance(one, (list, tuple)) else [one]


def _further(candidates: Any) -> Sensors:
    found = read_signals(candidates) if candidates else {}
    for column, sensor in found.items():
        require_noise(column, sensor, "candidates")
    return found


def _shift(time_shift: float | str) -> float:
    shift = quantity(time_shift, "time", "time_shift")
    if shift < 0.0:
        raise InputError(
            f"Argument `time_shift` must not be negative, but was {time_shift!r}; give a standard deviation."
        )
    return shift


def _read_prior(problem, sensors, tolerances, unknowns, prior, bounds, at) -> tuple[Prior, dict]:
    """The prior, and the errors held fixed."""
    if isinstance(problem, Simulation):
        problem = Problem(problem, [signal(one) for one in sensors])
    found = read_prior(problem, tolerances, unknowns, prior, bounds)
    return found, scaled_base(read_fixed(problem, at, found.names))


def _prior_points(prior: Prior, key: RandomKey, n: int) -> Float[np.ndarray, "n k"]:
    """The mean and Sobol' points of the prior, in its standard deviations, within bounds."""
    k = len(prior.names)
    u = unit_points(key, n, k, "sobol")
    z = np.where(prior.known, norm.ppf(u), 2.0 * u - 1.0)
    z[0] = 0.0
    return np.clip(z, prior.low, prior.high)


def _starts(residuals: Residuals, key: RandomKey, n: int) -> Float[np.ndarray, "n p"]:
    z = _prior_points(residuals.prior, key, n)
    return np.concatenate([z, np.zeros((n, len(residuals.nuisances)))], axis=1)


def _settle(residuals: Residuals, theta: np.ndarray, iterations: int, advance: Any) -> Searches:
    """Search, estimate the noises that were not given, and again until they settle."""
    found = search(residuals.evaluate, theta, residuals.low, residuals.high, iterations, advance)
    first = found.first
    for _ in range(ROUNDS if any(one.sensor.noise is None for one in residuals.signals) else 0):
        best = int(np.argmin(found.misfit.cost))
        if not np.isfinite(found.misfit.cost[best]):
            break
        new = _noises(residuals, found, best)
        factors = [noise / one.noise for noise, one in zip(new, residuals.signals, strict=True)]
        if max(abs(np.log(factors))) < SETTLED:
            break
        first = _rescaled(residuals, first, factors)
        for noise, one in zip(new, residuals.signals, strict=True):
            one.noise = noise
        found = search(residuals.evaluate, found.theta, residuals.low, residuals.high, iterations)
    return found._replace(first=first)


def _rescaled(residuals, first, factors):
    """The misfit of the starts in units of other noises (its residuals and derivatives, which are read later)."""
    residual, jacobian = first.residual.copy(), first.jacobian.copy()
    for part, factor in zip(residuals.slices, factors, strict=True):
        residual[:, part] /= factor
        jacobian[:, part] /= factor
    return first._replace(residual=residual, jacobian=jacobian)


def _noises(residuals: Residuals, found: Searches, w: int) -> list[float]:
    """Standard deviations of the noise: those given, others by what search w leaves over and the parameters that the
    signal determines."""
    inverse = np.linalg.pinv(found.misfit.curvature[w], hermitian=True)
    noises = []
    for one, part in zip(residuals.signals, residuals.slices, strict=True):
        r, j = found.misfit.residual[w, part], found.misfit.jacobian[w, part]
        if one.sensor.noise is not None:
            noises.append(one.noise)
            continue
        if residuals.loss == "gaussian":
            freedom = max(len(r) - float(np.sum((j @ inverse) * j)), 1.0)
            factor = np.sqrt(float(r @ r) / freedom)
        else:
            factor = 1.4826 * float(np.median(np.abs(r)))
        noises.append(one.noise * max(factor, 1e-9))
    return noises


def _conclude(residuals, searches, further, confidence, samples, key) -> Identification:
    """From the ends of the searches to the result."""
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
    status = _status(searches, modes, signals, normal or method == "importance")
    remarks = [*_remarks(residuals, searches, modes, signals), *_interval_remarks(method, normal, drawn, far, samples)]
    return replace(
        _without(residuals, searches, confidence, samples), status=status, method=method,
        modes=tuple(ModeFound(residuals.prior.errors(m.theta[:k]), m.cost, m.probability) for m in modes),
        effective=0.0 if drawn is None else drawn.effective, departure=far, signals=tuple(signals), visibility=seen,
        curves=tuple(_curves(residuals, searches, best)), remarks=tuple(remarks), **found,
    )  # fmt: skip


def _without(residuals: Residuals, searches: Searches, confidence: float, samples: int) -> Identification:
    """The result where nothing was found."""
    prior, nan = residuals.prior, np.full(len(residuals.prior.names), np.nan)
    return Identification(
        names=prior.names, error_units=prior.units, estimate=nan, deviation=nan, low=nan, high=nan,
        covariance=np.outer(nan, nan), prior_mean=prior.mean, prior_deviation=prior.deviations,
        tolerances=prior.tolerances, beyond=nan, confidence=confidence, status="failed", method="laplace", modes=(),
        effective=0.0, samples=samples, departure=np.inf, signals=(), curves=(), visibility=None, remarks=(),
        steps=searches.steps, starts=len(searches.theta), converged=int(searches.converged.sum()),
    )  # fmt: skip


def _status(searches: Searches, modes: list[Mode], signals: list[SignalFit], sampled: bool) -> str:
    if not searches.converged.any():
        return "not_converged"
    if not modes:
        return "undetermined"
    if any(one.verdict != "fits" for one in signals):
        return "misfit"
    if not sampled:
        return "uncertain"
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
        freedom, squares = len(r) - float(np.sum((j @ inverse) * j)), float(r @ r)
        if residuals.loss != "gaussian":
            freedom = MAD_EFFICIENCY * len(r)
            squares = freedom * (1.4826 * float(np.median(np.abs(r)))) ** 2
        estimated = one.sensor.noise is None
        by_chance = np.nan if estimated else chance(squares, freedom)
        white = whiteness(robust(residuals.loss, r)[0] * r)
        predictor = residuals.predictors[one.experiment]
        values = predictions[one.experiment].values[0, predictor.columns.index(one.history.column)]
        coarse = interpolation_error(predictor.times, values) / one.noise
        verdict = verdict_on(squares, freedom, by_chance, white, tests)
        before = searches.first.residual[0, part]
        faults = residuals.faults(searches.theta[w], s)
        found.append(
            SignalFit(
                column=one.history.column, unit=signal(one.history.column).unit, experiment=one.experiment + 1,
                samples=len(r), noise=one.noise, estimated=estimated, shift=faults["shift"], offset=faults["offset"],
                gain=faults["gain"], remainder=one.noise * float(np.sqrt(np.mean(r**2))),
                before=one.noise * float(np.sqrt(np.mean(before**2))), chi_square=squares, freedom=freedom,
                chi_square_chance=by_chance, whiteness_chance=white, interpolation=coarse, verdict=verdict,
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


def _part(prior, predictor, prediction, w, column, sensors, times, shift) -> np.ndarray:
    """Information (k+1, k+1) of a signal at one point."""
    row, sensor = predictor.columns.index(column), sensors[column]
    values = np.concatenate([prediction.values[w, row][:, None], prediction.derivatives[w, row] @ prior.root], axis=1)
    through = spline(predictor.times, values)
    found = through(times)
    slopes = np.concatenate([found[:, 1:], -shift * through(times, 1)[:, :1]], axis=1)
    return signal_information(slopes, found[:, 0], sensor.noise, sensor.offset, sensor.gain)


def _visibility(prior: Prior, parts: dict[str, np.ndarray], shifts: bool, symmetric: Sequence[str]) -> Visibility:
    whole = without_shift(np.sum(list(parts.values()), axis=0), shifts)
    columns = list(parts)
    return see(prior.names, whole, symmetric, rank_signals(columns, list(parts.values()), shifts))


def _symmetric(names: Sequence[str], size: Float[np.ndarray, "w k"]) -> tuple[str, ...]:
    """Unknowns whose slopes (w, k) vanish at the first point, but not elsewhere."""
    if not np.isfinite(size[0]).all():
        return ()
    largest = np.nanmax(size, axis=0)
    return tuple(name for i, name in enumerate(names) if size[0, i] < VANISHING * largest[i])


def _seen(residuals: Residuals, searches: Searches, predictions: list[Prediction], further: Sensors) -> Visibility:
    """What the signals, and further ones, tell at the estimate, of all experiments together."""
    k, prior = len(residuals.prior.names), residuals.prior
    own = {one.history.column: replace(one.sensor, noise=one.noise) for one in residuals.signals}
    parts: dict[str, np.ndarray] = {}
    for e, predictor in enumerate(residuals.predictors):
        mine = {one.history.column: one for one in residuals.signals if one.experiment == e}
        clock = next(iter(mine.values())).history.times
        for column in predictor.columns:
            sensor = {column: replace(own[column], noise=mine[column].noise) if column in mine else further[column]}
            times = mine[column].history.times if column in mine else clock
            part = _part(prior, predictor, predictions[e], 0, column, sensor, times, residuals.time_shift)
            if len(residuals.predictors) > 1:  # each has a shift of its own
                part = np.pad(without_shift(part, bool(residuals.time_shift)), ((0, 1), (0, 1)))
            parts[column] = parts.get(column, 0.0) + part
    size = np.sqrt(np.sum(searches.first.jacobian[:, :, :k] ** 2, axis=1))
    size[~np.isfinite(searches.first.cost)] = np.nan
    return _visibility(prior, parts, bool(residuals.time_shift), _symmetric(prior.names, size))


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
