"""From measurements to errors: the estimate, how sure it is, whether the model fits, what could be known beforehand.

Place in the pipeline: problem, measurements, tolerances -> **identification_study**, conclusion -> Identification.

Symbols: k unknowns, p parameters (with the sensors' faults), w searches.
Source: theory (17.1) to (17.14).
"""

from collections.abc import Mapping, Sequence
from typing import Any

import jax
import numpy as np
from jaxtyping import Float
from scipy.stats import norm

from rfem_jax.description.basics.errors import InputError, located, require_choice
from rfem_jax.description.basics.precision import require_float64
from rfem_jax.description.basics.units import quantity
from rfem_jax.description.tasks.identification import LOSSES, Sensors, require_noise
from rfem_jax.description.tasks.settings import fraction, whole_number
from rfem_jax.simulation.specification import Simulation
from rfem_jax.tolerancing.checks import ErrorValues
from rfem_jax.tolerancing.designs.sweep_study import Bounds, read_fixed
from rfem_jax.tolerancing.identification.conclusion import conclude
from rfem_jax.tolerancing.identification.discretisation_check import is_refined
from rfem_jax.tolerancing.identification.experiments_compared import AS_GIVEN, experiment_told, shared_bases
from rfem_jax.tolerancing.identification.identification_result import Identifiability, Identification
from rfem_jax.tolerancing.identification.levenberg_marquardt import Searches, search
from rfem_jax.tolerancing.identification.measurements import Data, History, read_data, read_signals
from rfem_jax.tolerancing.identification.observability import (
    Visibility,
    information_of,
    symmetric_unknowns,
    visibility_of,
)
from rfem_jax.tolerancing.identification.predictions import Prediction, Predictor, scaled_base
from rfem_jax.tolerancing.identification.prior import Prior, read_prior
from rfem_jax.tolerancing.identification.residuals import Residuals
from rfem_jax.tolerancing.identification.signals import signal
from rfem_jax.tolerancing.problems.problem import ToleranceProblem
from rfem_jax.tolerancing.problems.sample_values import Base
from rfem_jax.tolerancing.problems.simulated_problem import Problem
from rfem_jax.tolerancing.progress import ProgressBar, ProgressOption
from rfem_jax.tolerancing.sampling.sequences import RandomKey, unit_points

ROUNDS = 6  # of estimates of the noise
SETTLED = 0.02  # relative change of an estimated noise
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
    at: ErrorValues | Sequence[ErrorValues] | None = None,
    candidates: Mapping[str, Any] | None = None,
    time_shift: float | str = 0.0,
    loss: str = "gaussian",
    confidence: float = 0.95,
    starts: int = 8,
    iterations: int = 60,
    samples: int = 256,
    times: Any = None,
    finer: Problems | None = None,
    check_model: bool = True,
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
        at: {error: value} of errors that are known, others are zero; or a list of them, one for each experiment.
        candidates: {column: Sensor(noise)} of further signals, whose worth at the estimate is told.
        time_shift: standard deviation [s], or a string with a unit, of the unknown delay of the clock of `data`.
        loss: "gaussian", or with outliers "huber" or "cauchy".
        confidence: of the intervals.
        starts: searches, the first from the prior's mean, at which first derivatives may vanish by symmetry.
        iterations: the most steps of a search.
        samples: runs of the importance sampling that checks the intervals.
        times: (T,) [s], where the values of a problem are that is not simulated.
        finer: the same problems with 2 n - 1 rfes for n of each flexible link, to check that these are enough; or None.
        check_model: whether it is checked that steps, saved times and rfes are fine enough for the data.
        key: JAX random key of starts and samples; None for jax.random.key(0).
        progress: True, or a function of (done, total), steps of the searches.
    Returns: the result, whose status says what failed. Raises: InputError for data and arguments that cannot be used.
    """
    _require_settings(loss, starts, iterations, samples)
    level, key = fraction(confidence, "confidence"), jax.random.key(0) if key is None else key
    problems, sensors, further = _as_list(problem), read_signals(signals), _further(candidates)
    known, bases = _read_bases(problems, sensors, tolerances, unknowns, prior, bounds, at)
    args = [*{**sensors, **further}], known.names
    predictors = [Predictor(one, *args, base, times) for one, base in zip(problems, bases, strict=True)]
    histories, refined = _histories(_as_list(data), sensors, len(problems)), _read_finer(finer, problems)
    residuals = Residuals(known, predictors, histories, sensors, _shift(time_shift), loss)
    with ProgressBar(progress, iterations, unit=SEARCH) as bar:
        searches = _settle(residuals, _starts(residuals, key, starts), iterations, bar.advance)
    return conclude(residuals, searches, further, level, samples, key, refined, check_model)


def _require_settings(loss: str, starts: int, iterations: int, samples: int) -> None:
    """Raises: InputError."""
    require_float64()
    require_choice(loss, LOSSES, "loss")
    for what, number, least in (("starts", starts, 1), ("iterations", iterations, 1), ("samples", samples, 16)):
        whole_number(number, what, least)


def _read_finer(finer: Problems | None, problems: list[Any]) -> list[Any] | None:
    """Raises: InputError for problems that do not fit those of the experiments."""
    if finer is None:
        return None
    found = _as_list(finer)
    if len(found) != len(problems) or not all(map(is_refined, problems, found)):
        raise InputError(
            "Argument `finer` must be the same problems with twice as many spring-damping elements in every flexible "
            f"link, one for each experiment, but is {found!r}; make their models by "
            "`discretise(mechanism, {link: 2 * n - 1})`, with n the rfes of a link."
        )
    return found


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
    experiments: Mapping[str, ErrorValues] | None = None,
    time_shift: float | str = 0.0,
    points: int = 16,
    times: Any = None,
    key: RandomKey | None = None,
) -> Identifiability:
    """What signals can tell of errors, before any is measured: visible combinations, the best choice of signals.

    Args:
        signals: {column: Sensor(noise, ...)}, all candidates.
        sample_times: (n,) [s] at which all would be sampled; None: the times that a run saves.
        experiments: {name: {parameter, number of a drive, or error: deviation}} of other experiments with the same
            machine, as {"slower": {"drive.speed": "-2 rad/s"}}; what each tells is compared.
        points: of the prior, over which the information is averaged; the first one is its mean.
        problem, tolerances, unknowns, prior, bounds, at, time_shift, times, key: as of `identify`.
    Raises: InputError as `identify`, and for signals without noise.
    """
    require_float64()
    sensors, shift = read_signals(signals), _shift(time_shift)
    for column, sensor in sensors.items():
        require_noise(column, sensor, "signals")
    known, fixed = _read_prior(problem, sensors, tolerances, unknowns, prior, bounds, at)
    bases = shared_bases(fixed, _read_experiments(problem, experiments, known, sensors))
    z = _prior_points(known, jax.random.key(0) if key is None else key, whole_number(points, "points", 1))
    compared, seen, bad = [], None, 0
    for title, base in bases.items():
        predictor = Predictor(problem, list(sensors), known.names, base, times)
        prediction = predictor.at(known.errors(z), derivatives=True)
        good = np.flatnonzero(np.isfinite(prediction.values).all(axis=(1, 2))).tolist()
        at_times = predictor.times if good and sample_times is None else np.asarray(sample_times, dtype=float)
        compared.append(experiment_told(title, known, predictor, prediction, sensors, at_times, shift))
        if title == AS_GIVEN:
            bad = len(z) - len(good)
            seen = _seen_before(known, predictor, prediction, good, sensors, at_times, shift) if good else None
    return Identifiability(known.names, known.units, known.scale, seen, len(z), bad, tuple(compared))


def _read_experiments(problem, experiments, prior: Prior, sensors: Sensors) -> dict[str, dict[str, float]]:
    """Raises: InputError for what does not deviate, and for unknowns."""
    if isinstance(problem, Simulation):
        problem = Problem(problem, [signal(one) for one in sensors])
    found = {}
    for title, values in (experiments or {}).items():
        with located(f"Experiment `{title}`"):
            found[title] = read_fixed(problem, values, prior.names)
    return found


def _seen_before(
    prior: Prior, predictor: Predictor, prediction: Prediction, good: list[int], sensors: Sensors,
    times: Float[np.ndarray, " n"], shift: float,
) -> Visibility:  # fmt: skip
    """What signals tell on average over the good points of the prior."""

    def mean_information(column: str) -> np.ndarray:
        of_points = [
            information_of(prior, predictor, prediction, w, column, sensors[column], times, shift) for w in good
        ]
        return np.mean(of_points, axis=0)

    assert prediction.derivatives is not None, "asked for"
    slopes = prediction.derivatives @ prior.root
    noise = np.array([sensors[column].noise for column in sensors])
    size = np.sqrt(np.sum((slopes / noise[None, :, None, None]) ** 2, axis=(1, 2)))
    parts = {column: mean_information(column) for column in sensors}
    return visibility_of(prior, parts, bool(shift), symmetric_unknowns(prior.names, size))


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


def _read_bases(problems: list[Any], sensors, tolerances, unknowns, prior, bounds, at) -> tuple[Prior, list[Base]]:
    """The prior, and the errors held fixed in each experiment; all name the same, so that they share programs."""
    several = at if isinstance(at, (list, tuple)) else [at] * len(problems)
    if len(several) != len(problems):
        raise InputError(
            f"Argument `at` must be as many as the experiments, but are {len(several)} for {len(problems)}; give one "
            "of each, or one for all."
        )
    found = [
        _read_prior(one, sensors, tolerances, unknowns, prior, bounds, own)
        for one, own in zip(problems, several, strict=True)
    ]
    names = dict.fromkeys(name for _, fixed in found for name in fixed)
    return found[0][0], [scaled_base({name: float(fixed.get(name, 0.0)) for name in names}) for _, fixed in found]


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
