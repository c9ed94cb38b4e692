"""Monte Carlo study: the scatter of all metrics that given tolerances cause.

Place in the pipeline: problem + tolerances -> samples (`sampled_studies`) -> statistics. Failed samples are counted by
cause and enter no statistic.

Samples are computed and stored in an order in which a study of n samples is the beginning of every larger one: sample
after sample, and with Sobol' indices all k + 2 points of a sample together (`sampling` and the results have them in
blocks). A stored study can therefore be extended.

Symbols: n samples (of N = n (k + 2) runs with Sobol' indices of k factors), d errors, m metrics; errors (N, d) [rad or
m], values (N, m) [units of the metrics], status (N,) int32 (0 good).
Source: see `statistics` and `sampling`.
"""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from rfem_jax.compilation.program import Program
from rfem_jax.description.basics.errors import InputError, require_flag
from rfem_jax.description.basics.precision import require_float64
from rfem_jax.description.study_file.study import Study
from rfem_jax.description.tasks.settings import whole_number
from rfem_jax.tolerancing.checks import check_known, check_variables, read_limits
from rfem_jax.tolerancing.problems.evaluation import describe_status
from rfem_jax.tolerancing.problems.named_tolerances import Tolerances, distributions_of
from rfem_jax.tolerancing.problems.problem import ToleranceProblem
from rfem_jax.tolerancing.problems.quadratic_model import QuadraticModel, expand_by_differences
from rfem_jax.tolerancing.progress import ProgressOption
from rfem_jax.tolerancing.sampling.monte_carlo_result import MetricStatistics, MonteCarloResult, Yield
from rfem_jax.tolerancing.sampling.sampled_studies import NOT_FINITE, SampleStudy, as_int, sample_study
from rfem_jax.tolerancing.sampling.sequences import RandomKey, design_points, net_of_samples, unit_points
from rfem_jax.tolerancing.sampling.statistics import (
    ControlledMean,
    SobolIndices,
    estimate_controlled_mean,
    estimate_mean,
    estimate_quantile,
    estimate_sobol_indices,
    estimate_std,
    estimate_yield,
    require_confidence,
)

QUANTILES = (0.01, 0.05, 0.5, 0.95, 0.99)


def monte_carlo(
    problem: ToleranceProblem,
    tolerances: Tolerances | Study,
    n: int,
    key: RandomKey,
    *,
    batch: int = 64,
    sampling: str = "sobol",
    limits: Mapping[str, Any] | None = None,
    quantiles: Sequence[float] = QUANTILES,
    confidence: float = 0.95,
    sobol_indices: bool = False,
    control_variate: QuadraticModel | bool | None = None,
    resume: str | Path | None = None,
    progress: ProgressOption = False,
    lanes: int | None = None,
    description: Mapping[str, str] | None = None,
) -> MonteCarloResult:
    """Run `problem` at n random errors and describe its metrics.

    Args:
        problem: see `problem.py`.
        tolerances: of the errors that vary, or a study that specifies them; all other errors are zero.
        n: number of random samples; with Sobol' points best a power of 2, at least 64.
        key: JAX random key; a sample depends on it and on its own index alone.
        batch: samples per chunk, the unit that is stored, and that is lost when a run is killed.
        sampling: "sobol" (scrambled Sobol' points) or "pseudo_random".
        limits: {metric name: largest value, or (low, high) with None for an open end}.
        quantiles: fractions in (0, 1); confidence: of every interval (see `statistics`).
        sobol_indices: also estimate Sobol' indices; n (k + 2) runs for k factors, of which 2n serve the statistics.
            Correlated errors are one factor.
        control_variate: None, a QuadraticModel, or True for the one about the nominal point.
        resume: folder of chunks. An interrupted study continues there, and a larger n extends a finished one; the
            result is bitwise that of a single run.
        progress: True for a bar with rate and remaining time, or a function of (done, total).
        lanes: samples that each device computes at once (None: 16 on a CPU, 4096 elsewhere). Smaller chunks are
            computed together. The last bit of a result may depend on lanes, on nothing else.
        description: of what the problem is made, {name: text}, kept in the folder for `SampleStudy.require_folder`.
    Raises: InputError for unknown names, bad numbers, and a folder of another study; ChunkWriteError (an OSError) when
        the disk is full: finished chunks are kept.
    """
    require_float64()
    tolerances = distributions_of(tolerances)
    _check_tolerances(problem, tolerances)
    assert isinstance(tolerances, Tolerances)
    study = monte_carlo_samples(tolerances, key, batch, lanes, sampling, sobol_indices)
    asked = _read_statistics(problem, limits, quantiles, confidence)
    model = _control_model(control_variate, problem, tolerances)
    design = _design(key, whole_number(as_int(n), "n", 1), tolerances, sampling, sobol_indices)
    started = time.monotonic()
    samples, computed = study.run(
        problem, design.points, {"n": design.n}, resume=resume, progress=progress, description=description
    )
    cost = computed, time.monotonic() - started
    return _report(problem, tolerances, design, asked, model, samples, cost)


def monte_carlo_samples(
    tolerances: Tolerances, key: RandomKey, batch: int, lanes: int | None, sampling: str, sobol_indices: bool
) -> SampleStudy:
    """The samples of a Monte Carlo study, and its folder; arguments and errors as of `monte_carlo`."""
    return sample_study(
        "monte_carlo", tolerances, key, batch=batch, lanes=lanes, sampling=sampling, sobol_indices=sobol_indices
    )


def first_samples(
    tolerances: Tolerances | Study, key: RandomKey, n: int = 8, sampling: str = "sobol"
) -> dict[str, Float[Array, " n"]]:
    """{error name: its values (n,)} [rad, m] of the first samples that `monte_carlo` takes with this key, without
    Sobol' indices: `trials` of a `Problem` whose step is to be accurate for them. Raises InputError as `monte_carlo`.
    """
    require_float64()
    tolerances = distributions_of(tolerances)
    assert isinstance(tolerances, Tolerances)
    points = unit_points(key, whole_number(as_int(n), "n", 1), len(tolerances.names), sampling)
    return _errors_at(tolerances, jnp.asarray(points))


@Program
def _errors_at(tolerances, points):
    return jax.vmap(tolerances.errors)(points)


@dataclass(frozen=True, eq=False)
class _Design:
    """Points of the unit cube in the order of storage; `blocks` of n samples each (A, B, ...), else one."""

    points: Float[np.ndarray, "N d"]
    n: int
    blocks: int
    sampling: str

    @property
    def samples(self) -> int:
        """Samples that statistics use: A and B of a design."""
        return self.n * min(self.blocks, 2)

    @property
    def nets(self) -> Int[np.ndarray, " samples"] | None:
        """Net of each of these samples, None where samples are independent."""
        return net_of_samples(self.n, self.sampling, min(self.blocks, 2))

    def in_blocks(self, stored: np.ndarray) -> np.ndarray:
        """Rows in the order of storage -> rows in blocks."""
        rows = stored.reshape(self.n, self.blocks, *stored.shape[1:])
        return np.swapaxes(rows, 0, 1).reshape(stored.shape)


@dataclass(frozen=True)
class _Statistics:
    """Which statistics are asked for; limits {metric: (low, high)}."""

    limits: dict[str, tuple[float, float]]
    quantiles: tuple[float, ...]
    confidence: float


def _design(key, n, tolerances, sampling, sobol_indices) -> _Design:
    if not require_flag(sobol_indices, "sobol_indices"):
        return _Design(unit_points(key, n, len(tolerances.names), sampling), n, 1, sampling)
    points = design_points(key, n, tolerances.factors, sampling)
    blocks = len(points) // n
    stored = np.swapaxes(points.reshape(blocks, n, -1), 0, 1).reshape(points.shape)
    return _Design(stored, n, blocks, sampling)


def _read_statistics(problem, limits, quantiles, confidence) -> _Statistics:
    """Raises InputError."""
    limits = read_limits(limits, tuple(metric.name for metric in problem.metrics))
    confidence = require_confidence(confidence)
    for fraction in quantiles:
        estimate_quantile(np.zeros(1), fraction, confidence)  # refuses before the runs, not after
    return _Statistics(limits, tuple(quantiles), confidence)


def _report(problem, tolerances, design, asked, model, samples, cost) -> MonteCarloResult:
    """`cost`: chunks computed, seconds."""
    samples = {name: design.in_blocks(array) for name, array in samples.items()}
    metrics, base = tuple(metric.name for metric in problem.metrics), design.samples
    values, status = samples["values"], samples["status"]
    indices, controlled, note = None, None, None
    if design.blocks > 1:
        indices = _estimate_indices(values, metrics, tolerances.factors, design.n, asked.confidence)
    if model is not None:
        controlled, note = _control(
            model, tolerances, samples["errors"][:base], values[:base], metrics, asked.confidence, design.nets
        )
    return MonteCarloResult(
        names=tolerances.names,
        error_units=tuple(problem.error_unit(name) for name in tolerances.names),
        metrics=metrics,
        metric_units=tuple(metric.unit for metric in problem.metrics),
        labels=tuple(metric.label for metric in problem.metrics),
        errors=samples["errors"],
        values=values,
        status=status,
        samples=base,
        **_summarise(problem, values[:base], status[:base], design.nets, asked),
        limits=asked.limits,
        sobol_indices=indices,
        controlled_means=controlled,
        control_note=note,
        confidence=asked.confidence,
        sampling=design.sampling,
        linear_errors=samples.get("linear_error"),
        chunks_computed=cost[0],
        seconds=cost[1],
    )


def _summarise(problem, values, status, nets, asked) -> dict[str, Any]:
    """Failures by cause, statistics and yields of the random samples: fields of the result."""
    metrics = [metric.name for metric in problem.metrics]
    codes, counts = np.unique(status[status != 0], return_counts=True)
    good = status == 0
    yields, joint = _estimate_yields(values, good, metrics, asked, nets)
    kept = None if nets is None else nets[good]
    return {
        "failures": {_cause(problem, c): int(k) for c, k in zip(codes, counts, strict=True)},
        "statistics": {name: _describe(values[good, i], asked, kept) for i, name in enumerate(metrics)},
        "yields": yields,
        "joint_yield": joint,
    }


def _describe(samples, asked, nets) -> MetricStatistics:
    """Statistics of the good samples (n,) of one metric."""
    confidence = asked.confidence
    return MetricStatistics(
        mean=estimate_mean(samples, confidence, nets),
        std=estimate_std(samples, confidence, nets),
        quantiles={float(q): estimate_quantile(samples, q, confidence, nets) for q in asked.quantiles},
        smallest=float(np.min(samples, initial=np.inf)) if len(samples) else float("nan"),
        largest=float(np.max(samples, initial=-np.inf)) if len(samples) else float("nan"),
    )


def _estimate_yields(values, good, metrics, asked, nets) -> tuple[dict[str, Yield], Yield | None]:
    """Yield of each limited metric and of all together; `values` (n, m), NaN where not `good`."""
    limits = asked.limits
    if not limits:
        return {}, None
    passes = {
        name: good & (values[:, i] >= limits[name][0]) & (values[:, i] <= limits[name][1])
        for i, name in enumerate(metrics)
        if name in limits
    }
    kept = None if nets is None else nets[good]

    def count(passed: Bool[np.ndarray, " n"]) -> Yield:
        return Yield(
            of_good=estimate_yield(passed[good], asked.confidence, kept),
            of_all=estimate_yield(passed, asked.confidence, nets),
        )

    together = np.all(np.stack(list(passes.values())), axis=0)
    return {name: count(passed) for name, passed in passes.items()}, count(together)


def _estimate_indices(values, metrics, factors, n, confidence) -> dict[str, SobolIndices]:
    labels = [" + ".join(factor) for factor in factors]
    blocks = values.reshape(len(factors) + 2, n, len(metrics))
    return {
        name: estimate_sobol_indices(blocks[0, :, i], blocks[1, :, i], blocks[2:, :, i], labels, confidence)
        for i, name in enumerate(metrics)
    }


def _control(
    model, tolerances, errors, values, metrics, confidence, nets
) -> tuple[dict[str, ControlledMean] | None, str | None]:
    """Controlled means by metric, and a note on why some do not exist."""
    failed = int(np.sum(np.isnan(values).any(axis=1)))
    if failed:
        # The model's mean is known over all errors, not over those whose samples are good.
        return None, f"no control variate: {failed} samples failed, and it would bias the mean"
    deviation, mean, covariance = _moments(model, tolerances, errors)
    controlled, missing = {}, []
    for i, name in enumerate(model.metrics):
        value, gradient = float(model.value[i]), np.asarray(model.gradient[i])
        hessian = np.zeros_like(covariance)
        if model.hessian is not None:
            hessian = np.asarray(model.hessian[i])
        if not (np.all(np.isfinite(gradient)) and np.all(np.isfinite(hessian))):
            missing.append(name)
            continue
        quadratic = 0.5 * np.einsum("ni,ij,nj->n", deviation, hessian, deviation)
        expected = value + gradient @ mean
        expected += 0.5 * (np.sum(hessian * covariance) + mean @ hessian @ mean)
        predicted = value + deviation @ gradient + quadratic
        controlled[name] = estimate_controlled_mean(
            values[:, metrics.index(name)], predicted, float(expected), confidence, nets
        )
    note = f"no derivatives at the nominal point: {', '.join(missing)}" if missing else None
    return controlled, note


def _moments(model, tolerances, errors):
    """Deviations (N, k) from the model's point, their mean (k,) and covariance (k, k).

    Errors of the model that have no tolerance stay at zero.
    """
    k = len(model.names)
    deviation, mean, covariance = np.zeros((len(errors), k)), np.zeros(k), np.zeros((k, k))
    varying = [i for i, name in enumerate(model.names) if name in tolerances.names]
    columns = [tolerances.names.index(model.names[i]) for i in varying]
    deviation[:, varying] = errors[:, columns]
    means = tolerances.means()
    mean[varying] = [float(means[model.names[i]]) for i in varying]
    given = np.asarray(tolerances.covariance())
    covariance[np.ix_(varying, varying)] = given[np.ix_(columns, columns)]
    point = np.asarray(model.point)
    return deviation - point, mean - point, covariance


def _control_model(control_variate, problem, tolerances) -> QuadraticModel | None:
    """The model that serves as control variate. Raises InputError."""
    if control_variate is None or control_variate is False:
        return None
    if control_variate is True:
        return expand_by_differences(problem, None, tolerances)
    if not isinstance(control_variate, QuadraticModel):
        raise InputError(
            "Argument `control_variate` must be None, True or a QuadraticModel, but it is "
            f"{type(control_variate).__name__}; write True for the model about the nominal point."
        )
    check_known(control_variate.metrics, tuple(metric.name for metric in problem.metrics), "control_variate")
    return control_variate


def _cause(problem, code) -> str:
    return "values not finite" if code == NOT_FINITE else describe_status(problem, code)


def _check_tolerances(problem, tolerances) -> None:
    if not isinstance(tolerances, Tolerances):
        raise InputError(
            f"Argument `tolerances` must be a Tolerances collection, but it is {tolerances!r}; "
            'write Tolerances({"D.delta_x": Uniform(0.01)}).'
        )
    check_variables(tolerances.names, problem, "tolerances")
    tolerances.require_units(problem)
