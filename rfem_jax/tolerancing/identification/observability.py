"""What measurements can tell of errors, before any is made: information, invisible combinations, the best signals.

Place in the pipeline: predictions, prior -> **observability** -> conclusion, identification_study.

    I = sum over signals of A_ss - A_sn (A_nn + P_n)^-1 A_ns,   A = J^T J / sigma^2                  (17.13)

J (n, k) derivatives by z, the errors in standard deviations of their prior; A_sn mixes these with offset and gain of
the signal itself, whose prior is P_n. A shift of time is common to all signals, and is eliminated from their sum in the
same way. The square roots of the eigenvalues of I are singular values: the data tell s times as much of a combination
as the prior; s below 1 is "hardly visible", below 0.01 "invisible".

Where slopes vanish by symmetry, information at zero errors is zero though the errors have an effect. The expected
information is therefore its mean over the prior, which has the second order: E[I] = I(0) + sum over errors of
(dJ)^T (dJ) / sigma^2 + ... (17.14).

Symbols: k unknowns, S signals; D: gain in information 1/2 log det(1 + I) [nats]; A: mean variance that is left, of that
of the prior.
Source: F. Pukelsheim, Optimal Design of Experiments (2006), 6 (criteria).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from rfem_jax.description.tasks.identification import Sensor
from rfem_jax.tolerancing.identification.predictions import Prediction, Predictor
from rfem_jax.tolerancing.identification.prior import Prior
from rfem_jax.tolerancing.identification.sensor_filters import sensed

INVISIBLE, WEAK = 1e-2, 1.0  # singular values
ALIKE = 0.99  # cosine of the effects of two errors
VANISHING = 1e-6  # slope below this part of those elsewhere: zero by symmetry


@dataclass(frozen=True)
class Worth:
    """What a signal tells: alone, and beside all that stand before it in the order of the greedy D-optimal choice.

    gain, rest: D and A of it alone; place in the order, from 1; gain_together, rest_together: of it with those before.
    """

    column: str
    gain: float
    rest: float
    place: int
    gain_together: float
    rest_together: float


@dataclass(frozen=True, eq=False)
class Visibility:
    """names (k); singular (k,), largest first, and directions (k, k), a unit vector in standard deviations of the prior
    a row; deviations (k,): standard deviations after the measurement in those of the prior; symmetric: errors whose
    slopes vanish at the prior's mean; worth: of every signal; sentences: what these say."""

    names: tuple[str, ...]
    singular: Float[np.ndarray, " k"]
    directions: Float[np.ndarray, "k k"]
    deviations: Float[np.ndarray, " k"]
    symmetric: tuple[str, ...]
    worth: tuple[Worth, ...]
    sentences: tuple[str, ...]


def signal_information(
    slopes: Float[np.ndarray, "n q"], value: Float[np.ndarray, " n"], noise: float, offset: float, gain: float
) -> Float[np.ndarray, "q q"]:
    """Information (q, q) of one signal about the unknowns and a shift, q = k + 1, in the presence of its own offset and
    gain (17.13).

    Args: slopes by z and by the shift in its standard deviations; offset [unit of the signal], gain: standard
        deviations of their priors, 0 where they are known.
    """
    columns, prior = [], []
    for deviation, own in ((offset, np.ones_like(value)), (gain, value)):
        if deviation:
            unit = deviation if np.isfinite(deviation) else noise
            columns.append(own * unit / noise)
            prior.append(1.0 if np.isfinite(deviation) else 0.0)
    whole = slopes / noise
    found = whole.T @ whole
    if columns:
        own = np.stack(columns, axis=1)
        found = found - whole.T @ own @ np.linalg.pinv(own.T @ own + np.diag(prior)) @ own.T @ whole
    return found


def without_shift(found: Float[np.ndarray, "q q"], shifts: bool) -> Float[np.ndarray, "k k"]:
    """Information (k, k), k = q - 1, about the unknowns alone; `shifts`: whether there is a shift, in deviations."""
    k = len(found) - 1
    if not shifts:
        return found[:k, :k]
    return found[:k, :k] - np.outer(found[:k, k], found[:k, k]) / (1.0 + found[k, k])


def criteria(found: Float[np.ndarray, "k k"]) -> tuple[float, float]:
    """D and A of an information in standard deviations of the prior."""
    values = np.maximum(np.linalg.eigvalsh(found), 0.0)
    return float(0.5 * np.log1p(values).sum()), float(np.mean(1.0 / (1.0 + values)))


def rank_signals(columns: Sequence[str], parts: Sequence[np.ndarray], shifts: bool) -> tuple[Worth, ...]:
    """The worth of signals with information `parts` (k+1, k+1), in the greedy D-optimal order."""
    alone = [criteria(without_shift(one, shifts)) for one in parts]
    left, chosen, found = list(range(len(parts))), np.zeros_like(parts[0]), []
    while left:
        best = max(left, key=lambda i: criteria(without_shift(chosen + parts[i], shifts))[0])
        chosen = chosen + parts[best]
        left.remove(best)
        together = criteria(without_shift(chosen, shifts))
        found.append(Worth(columns[best], *alone[best], len(found) + 1, *together))
    return tuple(found)


def see(
    names: Sequence[str], found: Float[np.ndarray, "k k"], symmetric: Sequence[str], worth: tuple[Worth, ...]
) -> Visibility:
    """Singular values, and what they say."""
    values, vectors = np.linalg.eigh(0.5 * (found + found.T))
    singular = np.sqrt(np.maximum(values, 0.0))[::-1]
    directions = vectors.T[::-1]
    left = np.sqrt(np.diag(np.linalg.inv(np.eye(len(found)) + found)))
    sentences = []
    for s, row in zip(singular, directions, strict=True):
        if s < WEAK:
            word = "cannot see" if s < INVISIBLE else "hardly see"
            sentences.append(
                f"The signals {word} {combination(names, row)} (in standard deviations of the prior): they tell "
                f"{s:.2g} times as much of it as the prior."
            )
    size = np.sqrt(np.maximum(np.diag(found), 0.0))
    for i in range(len(names)):
        for j in range(i):
            cosine = found[i, j] / max(size[i] * size[j], 1e-300)
            if abs(cosine) > ALIKE and min(size[i], size[j]) > INVISIBLE:
                sign = "" if cosine > 0 else " with the opposite sign"
                sentences.append(
                    f"{names[j]} and {names[i]}{sign} look the same (cosine {cosine:.4f} of their effects)."
                )
    if symmetric:
        sentences.append(
            f"By symmetry the first effect of {', '.join(symmetric)} vanishes at zero errors: the signals tell their "
            "size by the second, and may leave their signs open."
        )
    return Visibility(tuple(names), singular, directions, left, tuple(symmetric), worth, tuple(sentences))


def information_of(
    prior: Prior, predictor: Predictor, prediction: Prediction, w: int, column: str, sensor: Sensor,
    times: Float[np.ndarray, " n"], shift: float,
) -> Float[np.ndarray, "m m"]:  # fmt: skip
    """Information (k+1, k+1) of a signal, and of the shift of its clock, sampled at `times` [s], of run w."""
    slopes, values = sampled_slopes(prior, predictor, prediction, w, column, sensor, times, shift)
    assert sensor.noise is not None, "asked for, and estimated where not given"
    return signal_information(slopes, values, sensor.noise, sensor.offset, sensor.gain)


def sampled_slopes(
    prior: Prior, predictor: Predictor, prediction: Prediction, w: int, column: str, sensor: Sensor,
    times: Float[np.ndarray, " n"], shift: float,
) -> tuple[Float[np.ndarray, "n m"], Float[np.ndarray, " n"]]:  # fmt: skip
    """Derivatives (n, k+1) of a signal at `times` [s] by z and by the shift of its clock, and its values (n,), of run
    w."""
    row = predictor.columns.index(column)
    assert prediction.derivatives is not None, "asked for"
    values = np.concatenate([prediction.values[w, row][:, None], prediction.derivatives[w, row] @ prior.root], axis=1)
    through = sensed(predictor.times, values, sensor)
    found = through(times)
    return np.concatenate([found[:, 1:], -shift * through(times, 1)[:, :1]], axis=1), found[:, 0]


def visibility_of(prior: Prior, parts: dict[str, np.ndarray], shifts: bool, symmetric: Sequence[str]) -> Visibility:
    """What all signals together tell, and each of them, from their information (k+1, k+1); `shifts`: whether the clock
    may be off."""
    whole = without_shift(np.sum(list(parts.values()), axis=0), shifts)
    return see(prior.names, whole, symmetric, rank_signals(list(parts), list(parts.values()), shifts))


def symmetric_unknowns(names: Sequence[str], size: Float[np.ndarray, "w k"]) -> tuple[str, ...]:
    """Unknowns whose slopes (w, k) vanish at the first point, but not elsewhere."""
    if not np.isfinite(size[0]).all():
        return ()
    largest = np.nanmax(size, axis=0)
    return tuple(name for i, name in enumerate(names) if size[0, i] < VANISHING * largest[i])


def combination(names: Sequence[str], row: Float[np.ndarray, " k"], most: int | None = None) -> str:
    """A direction in words: its parts above a tenth, of which the `most` largest."""
    row = row * (np.sign(row[np.argmax(np.abs(row))]) or 1.0)
    large = [i for i in np.argsort(-np.abs(row), kind="stable") if abs(row[i]) > 0.1]
    shown = sorted(large[:most])
    text = " ".join(f"{row[i]:+.2g} {names[i]}" for i in shown).removeprefix("+")
    return text if len(shown) == len(large) else f"{text} ..."
