"""Turns of searches of design points, until further ones find nothing new.

Place in the pipeline: subset, design_points, importance -> **searches** -> failure_study.

The first searches start on a sphere, those of the second turn at samples that break the limit, later ones at both. A
turn brings nothing new if samples about the known points would see its ends too, by the weights that they would have
there. Searches end when twice as many in a row brought nothing new as there are points.

Symbols: w (n, k) points in standard normal coordinates.
"""

from collections.abc import Sequence

import jax
import numpy as np
from jaxtyping import Float
from scipy import stats

from rfem_jax.tolerancing.rare_failures.design_points import (
    DesignPoints,
    LimitState,
    NormalSpace,
    find_design_points,
    sphere_starts,
)
from rfem_jax.tolerancing.rare_failures.importance import components_of, mixture_of
from rfem_jax.tolerancing.sampling.sequences import RandomKey

MOST_TURNS = 16
PATIENCE = 2  # searches in a row without anything new, by the number of points
LATER_ROUNDS = 20  # of searches whose ends are centres of samples, not results
SEEN = 30.0  # times the probability: the weight up to which a point counts as seen
LESS = 0.05  # of the probability of the nearest design point: of no weight


def search_points(
    space: NormalSpace,
    states: Sequence[LimitState],
    failing: Sequence[Float[np.ndarray, "n k"]],
    probabilities: Sequence[float],
    key: RandomKey,
    *,
    starts: int,
    rounds: int,
    known: Sequence[DesignPoints] = (),
) -> tuple[list[DesignPoints], list[float]]:
    """Design points of all limits, and the share of the last searches of each that found something new.

    Args: failing (n, k), samples that break each limit; probabilities of these by subset
        simulation; key of the directions in which searches start; starts of a
        turn, for each limit; rounds, the most evaluations with gradients of the first searches, later ones have fewer;
        known, design points that were found before.
    """
    k = len(space.tolerances.names)
    found = list(known) or find_design_points(
        space, states, [sphere_starts(k, starts, key)] * len(states), rounds=rounds
    )
    new = [0.0] * len(states)
    waiting = [i for i, one in enumerate(found) if len(one.points) or len(failing[i])]
    novel, quiet = [len(one.points) for one in found], [0] * len(states)
    for turn in range(1, MOST_TURNS):
        if not waiting:
            break
        fresh = sphere_starts(k, starts, jax.random.fold_in(key, turn))
        begin = [_starts(failing[i], fresh, turn) for i in waiting]
        ends = find_design_points(space, [states[i] for i in waiting], begin, rounds=min(rounds, LATER_ROUNDS))
        for i, more in zip(waiting, ends, strict=True):
            unseen = _unseen(found[i], more, failing[i], probabilities[i])
            novel[i], quiet[i] = novel[i] + unseen, 0 if unseen else quiet[i] + starts
            new[i], found[i] = unseen / starts, found[i].joined(more)
        waiting = [i for i in waiting if quiet[i] < PATIENCE * novel[i]]
    return found, new


def _starts(
    failing: Float[np.ndarray, "n k"], fresh: Float[np.ndarray, "starts k"], turn: int
) -> Float[np.ndarray, "starts k"]:
    """Starts of a later turn: of the second one at failing samples, of others half of them on the sphere."""
    count = 0 if not len(failing) else len(fresh) if turn == 1 else len(fresh) // 2
    rows = (np.arange(count) + (turn - 1) / MOST_TURNS) / max(count, 1) * len(failing)
    return np.concatenate([failing[rows.astype(int)], fresh[count:]])


def _unseen(found: DesignPoints, more: DesignPoints, failing: Float[np.ndarray, "n k"], probability: float) -> int:
    """Number of further points at which samples of the components about the known ones would be rare."""
    if not len(more.points) or not len(found.points):
        return len(more.points)
    known, further = (stats.norm.sf(np.linalg.norm(one.points, axis=1)) for one in (found, more))
    heavy = further >= LESS * max(np.max(known), np.max(further))
    mixture = mixture_of([components_of(found.points, failing)], 1000, failing.shape[1])
    reference = max(probability, float(np.sum(known)))
    return int(np.sum(heavy & (mixture.weights(more.points) > SEEN * reference)))
