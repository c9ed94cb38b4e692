"""Subset simulation: the probability of a rare failure as a product of probabilities that are not rare.

Place in the pipeline: problem, tolerances, limits -> **subset** -> design points (starts of searches), importance
(where its samples have to be), failure_study (an independent probability).

    p = P(h > 0) = P(F_1) P(F_2 | F_1) ... P(F_m | F_m-1),      F_i = {h >= b_i},  b_1 < b_2 < ... < b_m = 0

The first level is plain Monte Carlo. Each further one starts Markov chains at the samples that the last level has
beyond b_i, the best tenth. A step of a chain draws w' = sqrt(1 - s^2) w + s x, x standard normal, and stays at w
unless h(w') >= b_i; this keeps the normal distribution in F_i in any number of dimensions, without gradients, and over
edges, plateaus and several regions. The length s follows the share of accepted steps. The chains of all limits take
their steps together, in one batch.

Symbols: w (n, k) samples in standard normal coordinates, h = -G (`LimitState`), positive where the limit is broken and
infinite where a simulation failed; b_i thresholds; s spread of a step; variation: standard deviation of the estimate
of p, divided by p.
Source: theory (10.25); S.-K. Au, J. L. Beck, Prob. Eng. Mech. 16 (2001) 263-277; I. Papaioannou, W. Betz,
K. Zwirglmaier, D. Straub, Prob. Eng. Mech. 41 (2015) 89-103 (conditional sampling, its spread).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy import stats

from rfem_jax.tolerancing.rare_failures.design_points import LimitState, NormalSpace
from rfem_jax.tolerancing.sampling.statistics import Estimate

STEPS = 10  # states of a chain; 1/STEPS of the samples are beyond the next threshold
MOST_LEVELS = 12  # down to probabilities of 1e-12
ACCEPTED = 0.44  # share of accepted steps at which chains forget fastest
DEPENDENCE = 1.5  # of the variance: chains of one level have ancestors in common, which their scatter does not show


@dataclass(frozen=True, eq=False)
class SubsetRun:
    """What subset simulation found for one limit.

    probability, and its `variation`; samples (n, k) that break the limit, dependent on each other (none where it was
    not reached); reached: whether any did; bound: probability of the last level, above which the limit's cannot be
    where it was not reached; simulations that were used for this limit alone.
    """

    probability: float
    variation: float
    samples: Float[np.ndarray, "n k"]
    bound: float

    @property
    def reached(self) -> bool:
        """Whether a sample breaks the limit."""
        return self.probability > 0.0

    @property
    def frequent(self) -> bool:
        """Whether plain Monte Carlo tells most: the first level was enough."""
        return self.probability >= 1.0 / STEPS

    def estimate(self, confidence: float) -> Estimate:
        """The probability with an interval, by a log-normal distribution of the estimate."""
        if not self.reached:
            return Estimate(0.0, 0.0, self.bound)
        spread = math.sqrt(math.log1p(self.variation**2))
        factor = math.exp(float(stats.norm.ppf(0.5 + 0.5 * confidence)) * spread)
        return Estimate(self.probability, self.probability / factor, min(self.probability * factor, 1.0))


class _Chains:
    """The present level of one limit: samples w (steps, chains, k) and h (steps, chains)."""

    def __init__(self, w: Float[np.ndarray, "n k"], h: Float[np.ndarray, " n"]):
        self.w, self.h = w.reshape(STEPS, -1, w.shape[1]), h.reshape(STEPS, -1)
        self.probability, self.variance, self.spread = 1.0, 0.0, 0.6
        self.threshold, self.level = -math.inf, 0
        self.finished = self.counted = False

    def advance(self, generator: np.random.Generator) -> None:
        """Take the next threshold, and its samples as the first states of new chains; or finish.

        The last chains run where the limit is broken: their states are the samples of the result.
        """
        if self.counted:
            self.finished = True
            return
        broken = self.h > 0.0
        beyond = np.sort(self.h, axis=None)[-self.h.shape[1]]
        if np.mean(broken) >= 1.0 / STEPS or beyond <= self.threshold or self.level == MOST_LEVELS:
            self._count(broken)
            self.counted = True
            self.finished = self.level == 0 or not np.any(broken)
            self._start(broken, np.nextafter(0.0, 1.0), generator)
            return
        self._count(self.h >= beyond)
        self.level += 1
        self._start(self.h >= beyond, float(beyond), generator)

    def _start(self, inside: np.ndarray, threshold: float, generator: np.random.Generator) -> None:
        """Start new chains at some of the samples that are inside of a threshold, unless the last ones are done."""
        if self.finished:
            return
        self.threshold = threshold
        rows = np.resize(generator.permutation(np.flatnonzero(inside.ravel())), self.h.shape[1])
        self.w, self.h = self.w.reshape(-1, self.w.shape[2])[rows][None], self.h.ravel()[rows][None]

    def _count(self, inside: np.ndarray) -> None:
        """Multiply by the share of the level's samples that are inside, with its variance by that among the chains."""
        share = float(np.mean(inside))
        if self.level == 0:
            variance = share * (1.0 - share) / inside.size
        else:
            variance = DEPENDENCE * float(np.var(np.mean(inside, axis=0), ddof=1)) / inside.shape[1]
        self.bound = self.probability / STEPS
        self.probability *= share
        self.variance += variance / share**2 if share > 0.0 else 0.0

    def candidates(self, generator: np.random.Generator) -> Float[np.ndarray, "chains k"]:
        """The next states (chains, k) that are tried."""
        s = min(self.spread, 1.0)
        return math.sqrt(1.0 - s * s) * self.w[-1] + s * generator.standard_normal(self.w[-1].shape)

    def take(self, w: Float[np.ndarray, "chains k"], h: Float[np.ndarray, " chains"]) -> None:
        """Append the states that are inside, and the last ones again for the others."""
        accepted = h >= self.threshold
        self.w = np.concatenate([self.w, np.where(accepted[:, None], w, self.w[-1])[None]])
        self.h = np.concatenate([self.h, np.where(accepted, h, self.h[-1])[None]])
        self.spread *= math.exp((float(np.mean(accepted)) - ACCEPTED) / math.sqrt(len(self.h) - 1))

    def result(self) -> SubsetRun:
        broken = self.h > 0.0
        samples = np.swapaxes(self.w, 0, 1)[broken.T]
        return SubsetRun(self.probability, math.sqrt(self.variance), samples, self.bound)


def run_subsets(
    space: NormalSpace, states: Sequence[LimitState], samples: int, generator: np.random.Generator
) -> tuple[list[SubsetRun], int]:
    """Subset simulation of every limit state, and the number of simulations of all.

    Args: samples of a level, rounded to tens.
    """
    chains = max(2, samples // STEPS)
    w = generator.standard_normal((chains * STEPS, len(space.tolerances.names)))
    values = space.values(w)
    levels = [_Chains(w, _beyond(state, values)) for state in states]
    used = len(w)
    while True:
        for one in levels:
            if not one.finished:
                one.advance(generator)
        active = [i for i, one in enumerate(levels) if not one.finished]
        if not active:
            return [one.result() for one in levels], used
        for _ in range(STEPS - 1):
            tried = [levels[i].candidates(generator) for i in active]
            values = space.values(np.concatenate(tried))
            used += len(values)
            for i, w, part in zip(active, tried, np.split(values, len(active)), strict=True):
                levels[i].take(w, _beyond(states[i], part))


def _beyond(state: LimitState, values: Float[np.ndarray, "n m"]) -> Float[np.ndarray, " n"]:
    """h (n,), infinite for a simulation that failed in any metric."""
    return np.where(np.all(np.isfinite(values), axis=1), -state.of(values), np.inf)
