"""Bands of paths: between which paths the points of mechanisms go that are made within their tolerances.

Place in the pipeline: samples of a Monte Carlo study -> the same mechanisms, their paths -> **sampled_paths**.

The places of some samples at some saved times are metrics of a problem of their own, so that all that computes metrics
computes them.

Symbols: n samples, k errors, T times.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rfem_jax.description.basics.errors import InputError, suggestion
from rfem_jax.description.tasks.settings import fraction, whole_number
from rfem_jax.labelled_data import COMPONENTS
from rfem_jax.tolerancing.problems.evaluation import evaluate_points
from rfem_jax.tolerancing.problems.problem import Metric
from rfem_jax.tolerancing.problems.simulated_problem import Problem
from rfem_jax.tolerancing.sampling.monte_carlo_result import MonteCarloResult
from rfem_jax.tolerancing.sampling.path_band import PathBand

SAMPLES = 256  # enough for quantiles of 2.5 %, six samples beyond
TIMES = 65


@dataclass(frozen=True)
class _Saved:
    """One number at one of `TIMES` saved times, evenly chosen: a time, or of the place or the velocity of a point.

    A class and no function in a function, so that programs are known by its values.
    """

    number: int
    point: str = ""
    part: str = "position"
    component: int = 0

    def __call__(self, run: Any) -> Float[Array, ""]:
        last = run.times.shape[0] - 1
        k = round(self.number * last / (TIMES - 1))
        return jnp.asarray(
            getattr(run.points[self.point], self.part)[k, self.component] if self.point else run.times[k]
        )


def path_bands(
    problem: Problem,
    result: MonteCarloResult,
    points: Iterable[str] | None = None,
    *,
    samples: int = SAMPLES,
    level: float = 0.95,
) -> dict[str, PathBand]:
    """The bands of paths of a Monte Carlo study.

    Args:
        problem: whose samples `result` has; its mechanism has points.
        result: of `monte_carlo`.
        points: names of points; None for all.
        samples: how many of the good samples are simulated again for their paths, at most.
        level: the fraction of samples within the band.
    Returns: {point: `PathBand`}; none where no sample is good, or the perfect mechanism cannot be simulated.
    Raises: InputError for a point that the mechanism has not, and for bad numbers.
    """
    known = tuple(problem.model.points or {})
    points = known if points is None else tuple(points)
    samples, level = whole_number(samples, "samples", 1), fraction(level, "level")
    for point in points:
        if point not in known:
            raise InputError(
                f"Argument `points` must name points of the mechanism, but it has no point `{point}`; "
                f"{suggestion(point, known)}"
            )
    good = result.errors[: result.samples][result.status[: result.samples] == 0][:samples]
    if not len(good) or not points:
        return {}
    times, places, velocities = _paths(problem, result.names, good, points)
    bands = {}
    for i, point in enumerate(points):
        perfect, others = places[0, :, i], places[1:, :, i]
        kept = np.isfinite(others - perfect).all(axis=(1, 2))
        if kept.any():
            bands[point] = PathBand(
                point, times, perfect, velocities[0, :, i], others[kept] - perfect, level, problem.model.topology.plane
            )
    return bands


def _paths(
    problem: Problem, names: tuple[str, ...], errors: Float[np.ndarray, "n k"], points: tuple[str, ...]
) -> tuple[Float[np.ndarray, " T"], Float[np.ndarray, "n+1 T points 3"], Float[np.ndarray, "n+1 T points 3"]]:
    """Saved times [s], places [m] and velocities [m/s] of the points in the perfect mechanism and in the samples."""
    numbers, axes = range(TIMES), range(len(COMPONENTS))
    metrics = [Metric(f"path_time_{k}", "s", function=_Saved(k)) for k in numbers]
    for part, unit in (("position", "m"), ("velocity", "m/s")):
        metrics += [
            Metric(f"{point}.path_{part}_{k}_{c}", unit, function=_Saved(k, point, part, c))
            for k in numbers
            for point in points
            for c in axes
        ]
    rows = np.concatenate([np.zeros((1, len(names))), errors])
    values, _ = evaluate_points(problem.with_metrics(metrics), names, {}, rows)
    # Runs with fewer saved times have some of them more than once.
    times, kept = np.unique(values[0, :TIMES], return_index=True)
    of_points = values[:, TIMES:].reshape(len(rows), 2, TIMES, len(points), 3)[:, :, kept]
    return times, of_points[:, 0], of_points[:, 1]
