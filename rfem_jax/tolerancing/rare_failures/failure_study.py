"""Reliability: how probable it is that limits are broken, far into the tails (yields of 1 - 1e-6 and more).

Place in the pipeline: problem + tolerances + limits -> design points (FORM) -> importance sampling -> result.

Simulations: searches x rounds with gradients for every limit, then n. Plain Monte Carlo would need 100/p for the same
confidence.

Symbols: see `design_points` and `importance`.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np
from scipy import stats

from rfem_jax.description.errors import InputError
from rfem_jax.description.precision import require_float64
from rfem_jax.description.study import Study
from rfem_jax.description.tasks.settings import whole_number
from rfem_jax.tolerancing.checks import check_known, read_limits
from rfem_jax.tolerancing.problems.linearisation import choose_mode
from rfem_jax.tolerancing.problems.named_tolerances import Tolerances, distributions_of
from rfem_jax.tolerancing.problems.problem import ToleranceProblem
from rfem_jax.tolerancing.progress import ProgressBar, ProgressOption
from rfem_jax.tolerancing.rare_failures.design_points import (
    DesignPoints,
    LimitState,
    NormalSpace,
    find_design_points,
)
from rfem_jax.tolerancing.rare_failures.failure_result import LimitFailure, ReliabilityResult
from rfem_jax.tolerancing.rare_failures.importance import Mixture, estimate_probability, mixture_of
from rfem_jax.tolerancing.sampling.sequences import RandomKey, key_words
from rfem_jax.tolerancing.sampling.statistics import require_confidence

FEWEST = 50  # samples


def reliability(
    problem: ToleranceProblem,
    tolerances: Tolerances | Study,
    limits: Mapping[str, Any],
    key: RandomKey,
    *,
    n: int = 2000,
    starts: int = 16,
    rounds: int = 60,
    confidence: float = 0.95,
    mode: str = "auto",
    batch: int = 256,
    progress: ProgressOption = False,
) -> ReliabilityResult:
    """Probabilities that limits on metrics are broken, by FORM and by importance sampling.

    Args:
        problem: see `problem.py`.
        tolerances: of the errors that vary, or a study that specifies them; all other errors are zero.
        limits: {metric name: largest value, or (low, high) with None for an open end}.
        key: JAX random key of the searches and samples.
        n: samples of the importance sampling, at least 50; the interval narrows by their square root.
        starts: searches for each limit, in pairs of opposite directions; rounds: the most evaluations of each.
        confidence: of the intervals; mode: of differentiation; batch: simulations at once.
        progress: True for a bar of the samples, or a function of (done, total).
    Raises: InputError for unknown names and bad numbers.
    """
    require_float64()
    tolerances = distributions_of(tolerances)
    if not isinstance(tolerances, Tolerances):
        raise InputError(f"Argument `tolerances` must be a Tolerances collection, but it is {tolerances!r}.")
    check_known(tolerances.names, problem.error_names, "tolerances")
    tolerances.require_units(problem)
    states = _limit_states(problem, limits)
    for what, number, least in (("n", n, FEWEST), ("starts", starts, 1), ("rounds", rounds, 1), ("batch", batch, 1)):
        whole_number(number, what, least)
    confidence = require_confidence(confidence)
    k = len(tolerances.names)
    space = NormalSpace(problem, tolerances, choose_mode(mode, k, 1, problem), batch)
    found = find_design_points(space, states, key, starts=starts, rounds=rounds)
    # Where the nominal mechanism breaks a limit, samples about it tell more than those about a design point.
    mixture = mixture_of([one.points for one in found if one.nominal > 0.0], n, k)
    w = mixture.samples(np.random.default_rng([*key_words(key), 1]))
    values = _evaluate(space, w, progress)
    missing = ~np.all(np.isfinite(values), axis=1)
    weights = mixture.weights(w)
    broken = np.stack([(state.of(values) < 0.0) | missing for state in states])
    return ReliabilityResult(
        names=tolerances.names,
        error_units=tuple(problem.error_unit(name) for name in tolerances.names),
        limits=tuple(
            _of_limit(space, state, one, mixture, weights, fails, confidence)
            for state, one, fails in zip(states, found, broken, strict=True)
        ),
        any_limit=estimate_probability(mixture, weights, np.any(broken, axis=0), confidence),
        samples=len(w),
        failed=int(np.sum(missing)),
        confidence=confidence,
        searches=starts,
    )


def _limit_states(problem: ToleranceProblem, limits: Mapping[str, Any]) -> list[LimitState]:
    names = [metric.name for metric in problem.metrics]
    asked = read_limits(limits, names, needed=True)
    ends = [(names.index(name), sign, end) for name, pair in asked.items() for sign, end in zip((-1.0, 1.0), pair)]
    states = [LimitState(index, sign, end) for index, sign, end in ends if np.isfinite(end)]
    if not states:
        raise InputError("Argument `limits` must have at least one finite end, but all are open; give a number.")
    return states


def _evaluate(space: NormalSpace, w: np.ndarray, progress: ProgressOption) -> np.ndarray:
    parts = []
    with ProgressBar(progress, len(w)) as bar:
        for first in range(0, len(w), space.batch):
            parts.append(space.values(w[first : first + space.batch]))
            bar.advance(len(parts[-1]))
    return np.concatenate(parts)


def _of_limit(
    space: NormalSpace,
    state: LimitState,
    found: DesignPoints,
    mixture: Mixture,
    weights: np.ndarray,
    fails: np.ndarray,
    confidence: float,
) -> LimitFailure:
    metric, tolerances = space.problem.metrics[state.index], space.tolerances
    reached = len(found.points) > 0
    beta = float(found.beta[0]) if reached else np.inf
    first = float(min(np.sum(stats.norm.sf(np.abs(found.beta))), 1.0))
    errors = space.errors(found.points[:1])[0] if reached else np.zeros(0)
    shares = found.directions[0] ** 2 if reached else np.zeros(0)
    starts = np.cumsum([0, *(len(factor) for factor in tolerances.factors)])
    labels = ["+".join(factor) for factor in tolerances.factors]
    return LimitFailure(
        metric=metric.name,
        unit=metric.unit,
        side="upper" if state.sign > 0 else "lower",
        limit=state.limit,
        nominal=state.limit - state.sign * found.nominal,
        status="ok" if reached else "not_reached",
        beta=beta,
        first_order=first if beta > 0.0 else 1.0 - first,
        points=found.points,
        probability=estimate_probability(mixture, weights, fails, confidence),
        errors=dict(zip(tolerances.names, map(float, errors), strict=True)) if reached else {},
        shares={
            label: float(np.sum(shares[a:b])) for label, a, b in zip(labels, starts, starts[1:], strict=False)
        } if reached else {},
    )  # fmt: skip
