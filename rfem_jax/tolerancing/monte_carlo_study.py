"""Monte Carlo study: the scatter of all metrics that given tolerances cause.

Place in the pipeline: problem + tolerances -> samples (`execution`) -> statistics. Failed samples
are counted by cause and enter no statistic.

Symbols: n samples (of N = n (k + 2) runs with Sobol' indices of k factors), d errors, m metrics;
errors (N, d) [rad or m], values (N, m) [units of the metrics], status (N,) int32 (0 good).
Source: the statistics and the sampling name theirs.
"""

import time
from collections.abc import Mapping
from importlib import metadata

import jax
import jaxlib
import numpy as np
import scipy

from rfem_jax.description.errors import InputError, require_flag
from rfem_jax.tolerancing.evaluation import check_known, describe_status, require_float64
from rfem_jax.tolerancing.execution import default_lanes, fingerprint_problem, run_chunks
from rfem_jax.tolerancing.monte_carlo_result import (
    NOT_FINITE,
    MetricStatistics,
    MonteCarloResult,
    Yield,
)
from rfem_jax.tolerancing.quadratic_model import QuadraticModel, expand_by_differences
from rfem_jax.tolerancing.results_store import ResultsStore
from rfem_jax.tolerancing.sampling import design_points, key_words, net_of_samples, unit_points
from rfem_jax.tolerancing.statistics import (
    estimate_controlled_mean,
    estimate_mean,
    estimate_quantile,
    estimate_sobol_indices,
    estimate_std,
    estimate_yield,
    require_confidence,
)
from rfem_jax.tolerancing.tolerances import Tolerances, distributions_of

QUANTILES = (0.01, 0.05, 0.5, 0.95, 0.99)
FORMAT = 2  # of what is in a chunk, and of how points are drawn


def monte_carlo(
    problem,
    tolerances,
    n,
    key,
    *,
    batch=64,
    sampling="sobol",
    limits=None,
    quantiles=QUANTILES,
    confidence=0.95,
    sobol_indices=False,
    control_variate=None,
    resume=None,
    progress=False,
    lanes=None,
):
    """Run `problem` at n random errors and describe its metrics.

    Args:
        problem: as `problem.py` says.
        tolerances: Tolerances, or a study that specifies them; their names are the errors that vary, all others
            are zero.
        n: number of random samples; with Sobol' points best a power of 2, at least 64.
        key: JAX random key; the samples depend on it and on their own index alone.
        batch: samples per chunk, the unit that is stored and lost when a run is killed.
        sampling: "sobol" (scrambled Sobol' points) or "pseudo_random".
        limits: {metric name: largest value, or (low, high) with None for an open end}.
        quantiles: fractions in (0, 1).
        confidence: of every interval; with Sobol' points they come from the spread of
            independently scrambled nets (see `sampling`, `statistics`).
        sobol_indices: also estimate Sobol' indices; n (k + 2) runs for k factors, of which 2n serve
            the statistics. Correlated errors are one factor.
        control_variate: None, a QuadraticModel, or True for the one about the nominal point.
        resume: folder of chunks; an interrupted study continues there and ends bitwise the same.
        progress: True for a bar with rate and remaining time, or a function of (done, total).
        lanes: samples that each device computes at once (None: a constant for the kind of device).
            A chunk of batch samples takes ceil(batch / (lanes x devices)) launches. The last bit of
            a result may depend on lanes, on nothing else.
    Returns: MonteCarloResult.
    Raises: InputError for unknown names, bad numbers, and a folder of another study;
        ChunkWriteError (an OSError) when the disk is full: finished chunks are kept.
    """
    require_float64()
    tolerances = distributions_of(tolerances)
    _check_tolerances(problem, tolerances)
    metrics = tuple(metric.name for metric in problem.metrics)
    n, batch = _count(n, "n", 1), _count(batch, "batch", 1)
    lanes = default_lanes() if lanes is None else _count(lanes, "lanes", 1)
    limits = _check_limits(limits, metrics)
    confidence = require_confidence(confidence)
    for fraction in quantiles:
        estimate_quantile(np.zeros(1), fraction, confidence)  # refuses before the runs, not after
    model = _control_model(control_variate, problem, tolerances, metrics)
    if require_flag(sobol_indices, "sobol_indices"):
        points, base = design_points(key, n, tolerances.factors, sampling), 2 * n
    else:
        points, base = unit_points(key, n, len(tolerances.names), sampling), n
    nets = net_of_samples(n, sampling, base // n)
    store = None
    if resume is not None:
        study = {"n": n, "batch": batch, "lanes": lanes, "sampling": sampling}
        study |= {"sobol_indices": sobol_indices, **_identify(problem, tolerances, key)}
        store = ResultsStore(resume, study)

    started = time.monotonic()
    samples, computed = run_chunks(
        problem, tolerances, points, batch=batch, lanes=lanes, store=store, progress=progress
    )
    seconds = time.monotonic() - started

    status = _complete_status(samples)
    values = np.where((status == 0)[:, None], samples["values"], np.nan)
    indices, controlled, note = None, None, None
    if sobol_indices:
        indices = _estimate_indices(values, metrics, tolerances.factors, n, confidence)
    if model is not None:
        controlled, note = _control(
            model, tolerances, samples["errors"][:base], values[:base], metrics, confidence, nets
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
        **_summarise(problem, values[:base], status[:base], nets, limits, quantiles, confidence),
        limits=limits,
        sobol_indices=indices,
        controlled_means=controlled,
        control_note=note,
        confidence=confidence,
        sampling=sampling,
        chunks_computed=computed,
        seconds=seconds,
    )


def _summarise(problem, values, status, nets, limits, quantiles, confidence):
    """Failures by cause, statistics and yields of the random samples: fields of the result."""
    metrics = [metric.name for metric in problem.metrics]
    codes, counts = np.unique(status[status != 0], return_counts=True)
    good = status == 0
    yields, joint = _estimate_yields(values, good, metrics, limits, confidence, nets)
    kept = None if nets is None else nets[good]
    return {
        "failures": {_cause(problem, c): int(k) for c, k in zip(codes, counts, strict=True)},
        "statistics": {name: _describe(values[good, i], quantiles, confidence, kept) for i, name in enumerate(metrics)},
        "yields": yields,
        "joint_yield": joint,
    }


def _describe(samples, quantiles, confidence, nets):
    """MetricStatistics of the good samples (n,) of one metric."""
    return MetricStatistics(
        mean=estimate_mean(samples, confidence, nets),
        std=estimate_std(samples, confidence, nets),
        quantiles={float(q): estimate_quantile(samples, q, confidence, nets) for q in quantiles},
        smallest=float(np.min(samples, initial=np.inf)) if len(samples) else float("nan"),
        largest=float(np.max(samples, initial=-np.inf)) if len(samples) else float("nan"),
    )


def _estimate_yields(values, good, metrics, limits, confidence, nets):
    """Yield of each limited metric and of all together; `values` (n, m), NaN where not `good`."""
    if not limits:
        return {}, None
    passes = {
        name: good & (values[:, i] >= limits[name][0]) & (values[:, i] <= limits[name][1])
        for i, name in enumerate(metrics)
        if name in limits
    }
    kept = None if nets is None else nets[good]

    def count(passed):
        return Yield(
            of_good=estimate_yield(passed[good], confidence, kept),
            of_all=estimate_yield(passed, confidence, nets),
        )

    together = np.all(np.stack(list(passes.values())), axis=0)
    return {name: count(passed) for name, passed in passes.items()}, count(together)


def _estimate_indices(values, metrics, factors, n, confidence):
    labels = [" + ".join(factor) for factor in factors]
    blocks = values.reshape(len(factors) + 2, n, len(metrics))
    return {
        name: estimate_sobol_indices(blocks[0, :, i], blocks[1, :, i], blocks[2:, :, i], labels, confidence)
        for i, name in enumerate(metrics)
    }


def _control(model, tolerances, errors, values, metrics, confidence, nets):
    """Controlled means {metric: ControlledMean} and a note where some cannot be had."""
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
            values[:, metrics.index(name)], predicted, expected, confidence, nets
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


def _control_model(control_variate, problem, tolerances, metrics):
    """The QuadraticModel that serves as control variate, or None. Raises InputError."""
    if control_variate is None or control_variate is False:
        return None
    if control_variate is True:
        return expand_by_differences(problem, None, tolerances)
    if not isinstance(control_variate, QuadraticModel):
        raise InputError(
            "Argument `control_variate` must be None, True or a QuadraticModel, but it is "
            f"{type(control_variate).__name__}; write True for the model about the nominal point."
        )
    check_known(control_variate.metrics, metrics, "control_variate")
    return control_variate


def _complete_status(samples):
    """Status (N,) with NOT_FINITE where a sample called itself good and is not."""
    finite = np.all(np.isfinite(samples["values"]), axis=1)
    return np.where((samples["status"] == 0) & ~finite, NOT_FINITE, samples["status"])


def _cause(problem, code):
    return "values not finite" if code == NOT_FINITE else describe_status(problem, code)


def _identify(problem, tolerances, key):
    """What makes a study this one and no other, apart from the numbers of its call."""
    versions = {
        "jax": jax.__version__,
        "jaxlib": jaxlib.__version__,
        "numpy": np.__version__,
        "scipy": scipy.__version__,
    }
    try:
        versions["rfem-jax"] = metadata.version("rfem-jax")
    except metadata.PackageNotFoundError:
        versions["rfem-jax"] = None
    return {
        "study": "monte_carlo",
        "format": FORMAT,
        "problem": fingerprint_problem(problem),
        "metrics": [metric.name for metric in problem.metrics],
        "tolerances": _tolerance_table(tolerances),
        "key": key_words(key),
        "device": jax.default_backend(),
        "versions": versions,
    }


def _tolerance_table(tolerances):
    """Kind and numbers of every tolerance; JSON keeps every bit of a float."""
    single = [
        [name, type(tol).__name__, [float(leaf) for leaf in jax.tree.leaves(tol)]]
        for name, tol in ((name, tolerances.independent.get(name)) for name in tolerances.names)
        if tol is not None
    ]
    groups = [
        [list(group.names), np.asarray(group.covariance).tolist(), np.asarray(group.mean).tolist()]
        for group in tolerances.correlated
    ]
    return {"independent": single, "correlated": groups}


def _check_tolerances(problem, tolerances):
    if not isinstance(tolerances, Tolerances):
        raise InputError(
            f"Argument `tolerances` must be a Tolerances collection, but it is {tolerances!r}; "
            'write Tolerances({"D.delta_x": Uniform(0.01)}).'
        )
    check_known(tolerances.names, problem.error_names, "tolerances")


def _check_limits(limits, metrics):
    """{metric: (low, high)} with infinite open ends. Raises InputError."""
    if limits is not None and not isinstance(limits, Mapping):
        raise InputError(
            f"Argument `limits` must map metrics to limits, but it is {limits!r}; "
            'write {"metric": largest} or {"metric": (low, high)}.'
        )
    limits = dict(limits or {})
    check_known(limits, metrics, "limits")
    complete = {}
    for name, limit in limits.items():
        low, high = limit if isinstance(limit, (tuple, list)) and len(limit) == 2 else (None, limit)
        try:
            low = -np.inf if low is None else float(low)
            high = np.inf if high is None else float(high)
        except (TypeError, ValueError):
            low = high = np.nan
        if not low <= high:
            raise InputError(
                f"Argument `limits` must be a largest value or a pair (low, high), but "
                f"`{name}` has {limit!r}; correct it."
            )
        complete[name] = (low, high)
    return complete


def _count(value, what, least):
    """`value` as an int of at least `least`. Raises InputError."""
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)) or value < least:
        raise InputError(f"Argument `{what}` must be a whole number of at least {least}, but it is {value!r}.")
    return int(value)
