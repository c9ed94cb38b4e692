"""Reliability: how probable it is that limits are broken, far into the tails (yields of 1 - 1e-6 and more).

Place in the pipeline: problem + tolerances + limits -> subset simulation -> design points (FORM) -> importance
sampling -> result.

Simulations: some thousands for every limit in the subset simulation, searches x rounds with gradients for every limit,
then n, up to three times. Plain Monte Carlo would need 100/p for the same confidence.

Symbols: see `subset`, `design_points` and `importance`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import numpy as np
from scipy import stats

from rfem_jax.description.basics.errors import InputError
from rfem_jax.description.basics.precision import require_float64
from rfem_jax.description.study_file.study import Study
from rfem_jax.description.tasks.settings import whole_number
from rfem_jax.tolerancing.checks import check_variables, read_limits
from rfem_jax.tolerancing.problems.linearisation import choose_mode
from rfem_jax.tolerancing.problems.named_tolerances import Tolerances, distributions_of
from rfem_jax.tolerancing.problems.problem import ToleranceProblem
from rfem_jax.tolerancing.progress import ProgressOption
from rfem_jax.tolerancing.rare_failures.design_points import (
    DesignPoints,
    LimitState,
    NormalSpace,
)
from rfem_jax.tolerancing.rare_failures.failure_result import LimitFailure, ReliabilityResult
from rfem_jax.tolerancing.rare_failures.importance import components_of, mixture_of
from rfem_jax.tolerancing.rare_failures.limit_sampling import (
    ROUNDS,
    Finding,
    Samples,
    draw_samples,
    find_any,
    find_probability,
)
from rfem_jax.tolerancing.rare_failures.searches import search_points
from rfem_jax.tolerancing.rare_failures.subset import run_subsets
from rfem_jax.tolerancing.sampling.sequences import RandomKey, key_words
from rfem_jax.tolerancing.sampling.statistics import Estimate, require_confidence

FEWEST = 50  # samples


def reliability(
    problem: ToleranceProblem,
    tolerances: Tolerances | Study,
    limits: Mapping[str, Any],
    key: RandomKey,
    *,
    n: int = 2000,
    level_samples: int = 500,
    starts: int = 16,
    rounds: int = 60,
    confidence: float = 0.95,
    mode: str = "auto",
    batch: int = 256,
    progress: ProgressOption = False,
) -> ReliabilityResult:
    """Probabilities that limits on metrics are broken, by FORM, importance sampling and subset simulation.

    Args:
        problem: see `problem.py`.
        tolerances: of the errors that vary, or a study that specifies them; all other errors are zero.
        limits: {metric name: largest value, or (low, high) with None for an open end}.
        key: JAX random key of the searches and samples.
        n: samples of the importance sampling, at least 50; twice and four times as many are drawn after them where
            what they say cannot be trusted. level_samples: of each level of subset simulation, at least 50.
        starts: searches of a turn for each limit; rounds: the most evaluations of each.
        confidence: of the intervals; mode: of differentiation; batch: simulations at once.
        progress: True for a bar of the samples, or a function of (done, total).
    Raises: InputError for unknown names and bad numbers.
    """
    require_float64()
    tolerances = distributions_of(tolerances)
    if not isinstance(tolerances, Tolerances):
        raise InputError(f"Argument `tolerances` must be a Tolerances collection, but it is {tolerances!r}.")
    check_variables(tolerances.names, problem, "tolerances")
    tolerances.require_units(problem)
    states = _limit_states(problem, limits)
    whole_number(n, "n", FEWEST)
    whole_number(level_samples, "level_samples", FEWEST)
    for what, number in (("starts", starts), ("rounds", rounds), ("batch", batch)):
        whole_number(number, what, 1)
    confidence = require_confidence(confidence)
    space = NormalSpace(problem, tolerances, choose_mode(mode, len(tolerances.names), 1, problem), batch)
    study = sample_limits(
        space, states, key, n=n, level_samples=level_samples, starts=starts, rounds=rounds, confidence=confidence,
        progress=progress,
    )  # fmt: skip
    return ReliabilityResult(
        names=tolerances.names,
        error_units=tuple(problem.error_unit(name) for name in tolerances.names),
        limits=tuple(
            _of_limit(space, state, points, finding)
            for state, points, finding in zip(states, study.points, study.findings, strict=True)
        ),
        any_limit=study.any_limit,
        samples=len(study.samples.w),
        failed=study.samples.failed,
        confidence=confidence,
        searches=starts,
        simulations=study.simulations,
    )


@dataclass(frozen=True, eq=False)
class LimitSampling:
    """Design points and probabilities of all limits, the samples that gave them, and the number of simulations without
    derivatives."""

    points: list[DesignPoints]
    findings: list[Finding]
    any_limit: Estimate
    samples: Samples
    simulations: int


def sample_limits(
    space: NormalSpace,
    states: Sequence[LimitState],
    key: RandomKey,
    *,
    n: int,
    level_samples: int,
    starts: int,
    rounds: int,
    confidence: float,
    progress: ProgressOption,
) -> LimitSampling:
    """Subset simulation, searches and importance sampling of all limits; arguments as those of `reliability`."""
    k, words = len(space.tolerances.names), key_words(key)
    subsets, used = run_subsets(space, states, level_samples, np.random.default_rng([*words, 2]))
    failing = [one.samples for one in subsets]
    space.require_reproduced()
    points, new = search_points(
        space, states, failing, [one.probability for one in subsets], key, starts=starts, rounds=rounds
    )
    for turn in range(ROUNDS):
        generator = np.random.default_rng([*words, 1, turn])
        groups = [
            [] if one.frequent else components_of(at.points, rows)
            for one, at, rows in zip(subsets, points, failing, strict=True)
        ]
        samples = draw_samples(
            mixture_of(groups, n * 2**turn, k), states, lambda w: space.values(w, progress), generator, k
        )
        used += len(samples.w)
        findings = [
            find_probability(samples, i, subset, len(points[i].points), new[i], confidence)
            for i, subset in enumerate(subsets)
        ]
        doubtful = [i for i, one in enumerate(findings) if one.status == "uncertain"]
        if not doubtful or turn == ROUNDS - 1:
            return LimitSampling(points, findings, find_any(samples, findings, confidence), samples, used)
        for i in doubtful:
            # Either half, of which one makes components and the other judges them, has of both kinds.
            parts = (np.array_split(rows, 2) for rows in (samples.resampled(i, generator), subsets[i].samples))
            failing[i] = np.concatenate([part for pair in zip(*parts, strict=True) for part in pair])
        found, more = search_points(
            space, [states[i] for i in doubtful], [failing[i] for i in doubtful],
            [subsets[i].probability for i in doubtful], jax.random.fold_in(key, 100 + turn),
            starts=starts, rounds=rounds, known=[points[i] for i in doubtful],
        )  # fmt: skip
        for i, one, share in zip(doubtful, found, more, strict=True):
            points[i], new[i] = one, share
    raise AssertionError("the last round returns")


def _limit_states(problem: ToleranceProblem, limits: Mapping[str, Any]) -> list[LimitState]:
    names = [metric.name for metric in problem.metrics]
    asked = read_limits(limits, names, needed=True)
    ends = [(names.index(name), sign, end) for name, pair in asked.items() for sign, end in zip((-1.0, 1.0), pair)]
    states = [LimitState(index, sign, end) for index, sign, end in ends if np.isfinite(end)]
    if not states:
        raise InputError("Argument `limits` must have at least one finite end, but all are open; give a number.")
    return states


def _of_limit(space: NormalSpace, state: LimitState, found: DesignPoints, finding: Finding) -> LimitFailure:
    metric, tolerances = space.problem.metrics[state.index], space.tolerances
    known = len(found.points) > 0
    without = np.inf if finding.status == "not_reached" else np.nan
    beta = float(found.beta[0]) if known else without
    converged = found.beta[found.converged]
    first = float(min(np.sum(stats.norm.sf(np.abs(converged if len(converged) else found.beta))), 1.0))
    errors = space.errors(found.points[:1])[0] if known else np.zeros(0)
    shares = found.directions[0] ** 2 if known else np.zeros(0)
    starts = np.cumsum([0, *(len(factor) for factor in tolerances.factors)])
    labels = ["+".join(factor) for factor in tolerances.factors]
    return LimitFailure(
        metric=metric.name,
        unit=metric.unit,
        side="upper" if state.sign > 0 else "lower",
        limit=state.limit,
        nominal=state.limit - state.sign * found.nominal,
        status=finding.status,
        reason=finding.reason,
        beta=beta,
        design_point=("converged" if found.converged[0] else "not_converged") if known else "none",
        first_order=first if not beta <= 0.0 else 1.0 - first,
        points=found.points,
        probability=finding.probability,
        method=finding.method,
        effective_samples=finding.weighing.effective,
        largest_weight=finding.weighing.largest,
        subset_simulation=finding.check,
        errors=dict(zip(tolerances.names, map(float, errors), strict=True)) if known else {},
        shares={
            label: float(np.sum(shares[a:b])) for label, a, b in zip(labels, starts, starts[1:], strict=False)
        } if known else {},
    )  # fmt: skip
