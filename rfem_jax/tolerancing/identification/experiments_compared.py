"""Which experiment tells most of the errors, and how long to measure.

Place in the pipeline: observability, predictions at points of the prior -> **experiments_compared** ->
identification_study.

Information is a sum over samples (theory (17.13)), so that the first part of a measurement is as cheap as all of it.

Symbols: k unknowns, m lengths, S signals.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from rfem_jax.description.tasks.identification import Sensor, Sensors
from rfem_jax.labelled_data import Labelled, Parts, Table
from rfem_jax.tolerancing.identification.observability import (
    criteria,
    sampled_slopes,
    signal_information,
    without_shift,
)
from rfem_jax.tolerancing.identification.predictions import Prediction, Predictor, scaled_base
from rfem_jax.tolerancing.identification.prior import Prior
from rfem_jax.tolerancing.layout import show_number
from rfem_jax.tolerancing.problems.sample_values import Base

LENGTHS = 10
AS_GIVEN = "as given"
FEWEST = 2  # samples of a signal from which its offset and gain can be told


@dataclass(frozen=True, eq=False)
class Experiment:
    """What one experiment tells, by how long is measured: lengths (m,) [s] from its first sample; gain (m,), rest (m,):
    D [nat] and A; deviations (m, k) that are left of those of the prior; failed: points of the prior whose run did."""

    name: str
    lengths: Float[np.ndarray, " m"]
    gain: Float[np.ndarray, " m"]
    rest: Float[np.ndarray, " m"]
    deviations: Float[np.ndarray, "m k"]
    failed: int


def experiment_told(
    name: str, prior: Prior, predictor: Predictor, prediction: Prediction, sensors: Sensors,
    times: Float[np.ndarray, " n"], shift: float,
) -> Experiment:  # fmt: skip
    """What an experiment tells on average over the points of the prior in `prediction`, by its length; NaN where no run
    succeeded, whose `times` do not matter."""
    good = np.flatnonzero(np.isfinite(prediction.values).all(axis=(1, 2))).tolist()
    k, failed = len(prior.names), len(prediction.values) - len(good)
    if not good:
        nan = np.full(LENGTHS, np.nan)
        return Experiment(name, nan, nan, nan, np.full((LENGTHS, k), np.nan), failed)
    ends = np.maximum(np.ceil(len(times) * np.arange(1, LENGTHS + 1) / LENGTHS).astype(int), FEWEST)
    total = np.zeros((len(ends), k + 1, k + 1))
    for column, sensor in sensors.items():
        for w in good:
            slopes, values = sampled_slopes(prior, predictor, prediction, w, column, sensor, times, shift)
            total += _of_prefixes(slopes, values, sensor, ends) / len(good)
    found = [without_shift(one, bool(shift)) for one in total]
    told = np.array([criteria(one) for one in found])
    left = np.array([np.sqrt(np.diag(np.linalg.inv(np.eye(k) + one))) for one in found])
    return Experiment(name, times[ends - 1] - times[0], told[:, 0], told[:, 1], left, failed)


def _of_prefixes(slopes: np.ndarray, values: np.ndarray, sensor: Sensor, ends: np.ndarray) -> np.ndarray:
    """Information (m, q, q) of the samples before each of `ends`."""
    assert sensor.noise is not None, "asked for"
    parts = [signal_information(slopes[:end], values[:end], sensor.noise, sensor.offset, sensor.gain) for end in ends]
    return np.stack(parts)


def shared_bases(fixed: Base, experiments: Mapping[str, Mapping[str, float]]) -> dict[str, Base]:
    """What is held fixed in each experiment, the one as given first; all name the same, so that they share programs."""
    names = list(dict.fromkeys([*fixed, *(name for one in experiments.values() for name in one)]))
    given = {AS_GIVEN: {}, **experiments}
    return {
        title: scaled_base({name: float(one.get(name, fixed.get(name, 0.0))) for name in names})
        for title, one in given.items()
    }


def experiment_parts(experiments: Sequence[Experiment], names: Sequence[str]) -> Parts:
    """Tables: all experiments at their whole length, and how the best one's deviations fall with its length."""
    if not experiments:
        return []
    parts: list[Any] = []
    if len(experiments) > 1:
        order = sorted(experiments, key=lambda one: -np.nan_to_num(one.gain[-1], nan=-1.0))
        rows = [[one.name, *(show_number(x, 3) for x in _numbers(one, -1))] for one in order]
        header = ["experiment", "measured s", "information nat", "variance left %", "largest deviation left"]
        parts += ["", "Which experiment tells most", Table(header, rows)]
    parts += [f"No run of the experiment {one.name} succeeded." for one in experiments if np.isnan(one.gain[-1])]
    best = max(experiments, key=lambda one: np.nan_to_num(one.gain[-1], nan=-1.0))
    if np.isnan(best.gain[-1]):
        return parts
    rows = [[*(show_number(x, 3) for x in _numbers(best, i)), _worst(best, i, names)] for i in range(len(best.lengths))]
    header = ["measured s", "information nat", "variance left %", "largest deviation left", "of"]
    title = "How long to measure" if len(experiments) == 1 else f"How long to measure ({best.name})"
    return [*parts, "", f"{title}; deviations in those of the prior", Table(header, rows, words=(4,))]


def _numbers(one: Experiment, i: int) -> tuple[float, float, float, float]:
    return one.lengths[i], one.gain[i], 100.0 * one.rest[i], one.deviations[i].max()


def _worst(one: Experiment, i: int, names: Sequence[str]) -> str:
    return names[int(np.argmax(one.deviations[i]))]


def experiment_arrays(experiments: Sequence[Experiment]) -> tuple[dict[str, Labelled], dict[str, Any]]:
    """Arrays over `experiment`, `length` and `error`."""
    if not experiments:
        return {}, {}
    over = ("experiment", "length")
    return {
        "measured_length": Labelled(over, np.stack([one.lengths for one in experiments]), "s", "from first sample"),
        "experiment_information": Labelled(over, np.stack([one.gain for one in experiments]), "nat", "up to then"),
        "experiment_variance_left": Labelled(over, np.stack([one.rest for one in experiments]), "1", "after it"),
        "experiment_deviation_left": Labelled(
            (*over, "error"), np.stack([one.deviations for one in experiments]), "1", "of the prior's"
        ),
    }, {"experiment": [one.name for one in experiments]}  # fmt: skip
