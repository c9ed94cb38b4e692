"""What a guess of the errors, and of the sensors' own faults, leaves of the measurement: residuals in units of noise.

Place in the pipeline: predictions, measurements, prior -> **residuals** -> levenberg_marquardt, posterior.

    y_i = (1 + gamma) f(t_i - tau; x) + b + sigma eps_i                             (17.1)
    r_i = ((1 + gamma) f(t_i - tau; x) + b - y_i) / sigma,   Phi = sum rho(r_i) + sum of theta_j^2 with a prior   (17.4)

theta (p,) holds the unknowns in standard deviations of their prior, then for each experiment its shift tau, and the
offset b and gain gamma of its signals as far as they are unknown, in standard deviations too. Phi is -2 log of the
posterior density, but for a constant.

Symbols: w guesses, p parameters, k unknowns, n samples of all signals of all experiments.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from rfem_jax.description.basics.errors import InputError
from rfem_jax.description.tasks.identification import Sensor, Sensors
from rfem_jax.tolerancing.identification.measurements import History, require_within
from rfem_jax.tolerancing.identification.predictions import Prediction, Predictor
from rfem_jax.tolerancing.identification.prior import Prior
from rfem_jax.tolerancing.identification.sensor_filters import sensed

HUBER, CAUCHY = 1.345, 2.385  # 95 % of the efficiency of least squares where the noise is normal
FARTHEST = 4.0  # standard deviations of a shift


class Nuisance(NamedTuple):
    """A number of the measurement that is unknown, too: "shift" [s], "offset" [unit of its column] or "gain"; of signal
    number `signal` of all (of a shift: the experiment's number); deviation: standard deviation of its prior, or its
    unit where there is none (known False)."""

    kind: str
    signal: int
    deviation: float
    known: bool


class Misfit(NamedTuple):
    """Of w guesses: cost (w,) Phi, infinite where a run failed; gradient (w, p) and curvature (w, p, p) of Phi / 2;
    residual (w, n) and jacobian (w, n, p) in units of noise; status (w,) of the runs."""

    cost: Float[np.ndarray, " w"]
    gradient: Float[np.ndarray, "w p"]
    curvature: Float[np.ndarray, "w p p"]
    residual: Float[np.ndarray, "w n"]
    jacobian: Float[np.ndarray, "w n p"]
    status: Int[np.ndarray, " w"]


@dataclass(eq=False)
class Measured:
    """A signal of an experiment: its number, the history, its sensor, the noise [unit of the column] that counts."""

    experiment: int
    history: History
    sensor: Sensor
    noise: float


class Residuals:
    """The misfit of all experiments as a function of theta; noises may be set between calls.

    Args:
        prior: of the unknowns.
        predictors: one for each experiment.
        histories: its signals.
        sensors: {column: Sensor}.
        time_shift: standard deviation of the shift of every experiment [s].
        loss: "gaussian", "huber" or "cauchy".
    """

    def __init__(
        self, prior: Prior, predictors: Sequence[Predictor], histories: Sequence[Sequence[History]],
        sensors: Sensors, time_shift: float, loss: str,
    ):  # fmt: skip
        self.prior, self.predictors, self.loss, self.time_shift = prior, predictors, loss, time_shift
        self.signals = [
            Measured(e, one, sensors[one.column], sensors[one.column].noise or one.rough_noise())
            for e, some in enumerate(histories)
            for one in some
        ]
        self.nuisances = [Nuisance("shift", e, time_shift, True) for e in range(len(predictors)) if time_shift]
        for s, one in enumerate(self.signals):
            offset, gain = one.sensor.offset, one.sensor.gain
            if offset:
                known = np.isfinite(offset)
                self.nuisances.append(Nuisance("offset", s, float(offset) if known else one.noise, bool(known)))
            if gain:
                known = np.isfinite(gain)
                self.nuisances.append(Nuisance("gain", s, float(gain) if known else 1.0, bool(known)))
        k = len(prior.names)
        self.weights = np.array([*prior.known, *(one.known for one in self.nuisances)], dtype=float)
        self.low, self.high = np.full((2, self.size), np.inf) * np.array([[-1.0], [1.0]])
        self.low[:k], self.high[:k] = prior.low, prior.high
        for j, one in enumerate(self.nuisances, start=k):
            if one.kind == "shift":
                self.low[j], self.high[j] = -FARTHEST, FARTHEST
        self._ready = False

    @property
    def size(self) -> int:
        """Number p of parameters."""
        return len(self.prior.names) + len(self.nuisances)

    @property
    def slices(self) -> list[slice]:
        """Where the samples of each signal are among all."""
        ends = np.cumsum([0, *(len(one.history.times) for one in self.signals)])
        return [slice(int(a), int(b)) for a, b in pairwise(ends)]

    def predict(self, theta: Float[np.ndarray, "w p"], derivatives: bool = True) -> list[Prediction]:
        """The runs of all experiments."""
        points = self.prior.errors(theta[:, : len(self.prior.names)])
        return [one.at(points, derivatives) for one in self.predictors]

    def evaluate(self, theta: Float[np.ndarray, "w p"], derivatives: bool = True) -> Misfit:
        """The misfit of guesses (w, p). Raises: InputError for samples outside the simulated times."""
        predictions = self.predict(theta, derivatives)
        status = np.max([one.status for one in predictions], axis=0)
        good = np.all([np.isfinite(one.values).all(axis=(1, 2)) for one in predictions], axis=0)
        if good.any():
            self._prepare()
        n = self.slices[-1].stop
        residual = np.full((len(theta), n), np.nan)
        jacobian = np.zeros((len(theta), n, self.size if derivatives else 0))
        for w in map(int, np.flatnonzero(good)):
            for s, (one, part) in enumerate(zip(self.signals, self.slices, strict=True)):
                curve, slopes = self.curve(predictions[one.experiment], w, s, theta[w], one.history.times)
                residual[w, part] = (curve - one.history.values) / one.noise
                if derivatives:
                    jacobian[w, part] = slopes / one.noise
        return self._misfit(theta, residual, jacobian, np.where(good | (status != 0), status, -1))

    def _misfit(self, theta, residual, jacobian, status) -> Misfit:
        weight, rho = robust(self.loss, residual)
        cost = np.nan_to_num(np.sum(rho, axis=1) + (self.weights * theta**2).sum(axis=1), nan=np.inf)
        weighed = jacobian * np.nan_to_num(weight)[:, :, None]
        p = jacobian.shape[2]
        gradient = np.einsum("wnp,wn->wp", weighed, np.nan_to_num(residual)) + (self.weights * theta)[:, :p]
        curvature = np.einsum("wnp,wnq->wpq", weighed, jacobian) + np.diag(self.weights)[:p, :p]
        return Misfit(cost, gradient, curvature, residual, jacobian, status)

    def curve(
        self, prediction: Prediction, w: int, s: int, theta: Float[np.ndarray, " p"], times: Float[np.ndarray, " n"]
    ) -> tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n p"]]:
        """What sensor number s shows at `times` in run w, with its faults, and the derivatives by theta (by the
        unknowns zero where the prediction has none); without its noise."""
        one, k = self.signals[s], len(self.prior.names)
        predictor = self.predictors[one.experiment]
        row = predictor.columns.index(one.history.column)
        faults = self.faults(theta, s)
        columns = prediction.values[w, row][:, None]
        if prediction.derivatives is not None:
            columns = np.concatenate([columns, prediction.derivatives[w, row] @ self.prior.root], axis=1)
        through = sensed(predictor.times, columns, one.sensor)
        shifted = times - faults["shift"]
        found = through(shifted)
        scale = 1.0 + faults["gain"]
        slopes = np.zeros((len(times), self.size))
        if prediction.derivatives is not None:
            slopes[:, :k] = scale * found[:, 1:]
        for j, nuisance in enumerate(self.nuisances, start=k):
            if nuisance.signal == (one.experiment if nuisance.kind == "shift" else s):
                change = {"offset": 1.0, "gain": found[:, 0]}.get(nuisance.kind)
                change = -scale * through(shifted, 1)[:, 0] if change is None else change
                slopes[:, j] = nuisance.deviation * change
        return scale * found[:, 0] + faults["offset"], slopes

    def faults(self, theta: Float[np.ndarray, " p"], s: int) -> dict[str, float]:
        """Shift [s], offset and gain of signal number s, 0 where they are not unknown."""
        found = {"shift": 0.0, "offset": 0.0, "gain": 0.0}
        for value, one in zip(theta[len(self.prior.names) :], self.nuisances, strict=True):
            if one.signal == (self.signals[s].experiment if one.kind == "shift" else s):
                found[one.kind] = float(value * one.deviation)
        return found

    def _prepare(self) -> None:
        """Once the simulated times are known: leave out samples that a shift may move beyond them."""
        if self._ready:
            return
        self._ready, farthest = True, FARTHEST * self.time_shift
        for e, predictor in enumerate(self.predictors):
            times, mine = predictor.times, [one for one in self.signals if one.experiment == e]
            require_within([one.history for one in mine], times, e + 1)
            for one in mine if farthest else ():
                history = one.history
                kept = (history.times >= times[0] + farthest) & (history.times <= times[-1] - farthest)
                if kept.sum() < 4:
                    raise InputError(
                        f"Argument `time_shift` must be small beside the time that was measured, but {farthest:g} s at "
                        f"either end leave no samples of `{history.column}`; simulate a longer time."
                    )
                one.history = History(history.column, history.times[kept], history.values[kept])


def robust(loss: str, r: Float[np.ndarray, "*n"]) -> tuple[Float[np.ndarray, "*n"], Float[np.ndarray, "*n"]]:
    """Weights and losses rho of residuals in units of noise (theory (17.5)); rho = r^2 of "gaussian"."""
    size = np.abs(r)
    if loss == "huber":
        outside = size > HUBER
        return np.where(outside, HUBER / np.maximum(size, HUBER), 1.0), np.where(
            outside, 2.0 * HUBER * size - HUBER**2, r**2
        )
    if loss == "cauchy":
        return 1.0 / (1.0 + (r / CAUCHY) ** 2), CAUCHY**2 * np.log1p((r / CAUCHY) ** 2)
    return np.where(np.isnan(r), np.nan, 1.0), r**2


def efficiency(loss: str, r: Float[np.ndarray, " n"]) -> float:
    """mean(psi^2) / mean(psi')^2 of residuals: by how much the covariance of a robust estimate exceeds that of least
    squares (Huber; theory (17.7)); 1 of "gaussian"."""
    if loss == "gaussian":
        return 1.0
    weight, _ = robust(loss, r)
    slope = np.abs(r) <= HUBER if loss == "huber" else (1.0 - (r / CAUCHY) ** 2) * weight**2
    mean = float(np.mean(slope))
    return float(np.mean((weight * r) ** 2)) / mean**2 if mean > 0.05 else np.inf
