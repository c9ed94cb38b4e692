"""The statistical criteria of an allocation: root sum of squares (RSS) and yield.

Place in the pipeline: corrected model -> **corrected statistics** -> allocation.

rss     for each limit alone: mean + c deviations (third-order Cornish-Fisher quantile of the quadratic model; the
        classical root sum of squares for linear metrics, and with the skewness of even metrics such as mean squares up
        to about a tenth above the true quantile where one principal direction dominates, on the safe side), or the
        mean alone.
yield   at least the fraction `level` of all samples holds all limits together.

Each observation takes values and derivatives of the full problem at the fixed standard points, and so corrects the
model to first order. Failed samples are left out of statistics, and count as bad: the quantile of the others is raised
for them. A fresh run that falls short beyond its confidence interval (by chance the standard points gave too high a
yield) raises the aim by the shortfall, and the next answer is verified by another run.

Symbols: t (v,) sizes [rad, m], of which each of k coordinates has one (`sizes`), x = log t, h (l,) normalised limits
(<= 0 holds), u (n, k) standard points (coordinates for t = 1).
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.stats import norm

from rfem_jax.tolerancing.robust_design.corrected_model import Answer, CorrectedModel, HalfWidths, Normalised
from rfem_jax.tolerancing.robust_design.models import Moments, Sample, Sampled, quantile_weights, sample_quantile
from rfem_jax.tolerancing.robust_design.observations import Observer
from rfem_jax.tolerancing.robust_design.verification import ErrorSample, Verified, sampled_limits, within
from rfem_jax.tolerancing.sampling.sequences import RandomKey
from rfem_jax.tolerancing.sampling.statistics import estimate_mean, estimate_quantile

FEWEST = 256  # samples kept per limit for the solves between observations
BEYOND = 1e300  # value of a failed sample where an order is needed


class CorrectedStatistics(CorrectedModel):
    """RSS or yield over a distribution of the errors; see the module's docstring.

    Args: observer; key of the standard points; sample of errors; statistic "quantile" or "mean" of "rss".
    """

    def __init__(self, observer: Observer, key: RandomKey, sample: ErrorSample, statistic: str):
        super().__init__(observer)
        self.sample, self.joint = sample, sample.joint
        # The cost of a yield has a sampling error of percents: digits beyond are not worth a round.
        self.settling = 10.0 if self.joint else 1.0
        self.statistic = "quantile" if self.joint else statistic
        self.level = sample.level if self.joint else float(norm.cdf(sample.coverage))
        self.aim, self.extra = self.level, np.zeros(len(self.request.limits))
        self.units = sample.points(self.sizes, key)
        self.good = np.ones(sample.samples, dtype=bool)
        self.sampled: Sampled | None = None
        self.observed: HalfWidths | None = None

    def _spread(self, t) -> jax.Array:
        """The size (k,) of every coordinate."""
        return jnp.asarray(self.sizes.spread(t))

    def _nominal(self) -> Sampled:
        """The quadratic model itself as expansions, all of them about the centre."""
        q, n = self.quadratic, len(self.units)
        values = jnp.broadcast_to(q.offset, (n, *q.offset.shape))
        gradients = jnp.broadcast_to(q.gradient, (n, *q.gradient.shape))
        units = jnp.asarray(self.units)
        return Sampled(q, units, jnp.zeros_like(units), values, gradients)

    def model(self) -> Moments | Sample:
        """Moments (RSS) or a sample (yield), as they are corrected so far."""
        sampled, weights = self._tail()
        if self.joint:
            return Sample(sampled, weights)
        return self._moments(None if self.sampled is None else sampled, weights)

    def _moments(self, sampled: Sampled | None = None, weights: jax.Array | None = None) -> Moments:
        """Those of the quadratic model alone where there are no samples."""
        deviation = jnp.asarray(self.sizes.deviations(self.sample.of_width_one))
        coverage, extra = jnp.asarray(float(self.sample.coverage)), jnp.asarray(self.extra)
        weights = jnp.zeros(0) if weights is None else weights
        return Moments(self.quadratic, deviation, coverage, extra, sampled, weights, self.statistic)

    def _tail(self) -> tuple[Sampled, jax.Array]:
        """The good samples that can matter to the statistic, and the weights of their order.

        Samples far below the quantile, of the full and of the quadratic problem at the tolerances last observed, are
        left out: they only cost time (the next observation looks at all of them).
        """
        sampled = self._nominal() if self.sampled is None else self.sampled
        count = len(sampled.units)
        if self.statistic == "mean":
            return sampled, jnp.full(count, 1.0 / count)
        weights = quantile_weights(count, self.aim * len(self.good) / count)
        if self.observed is None:
            return sampled, jnp.asarray(weights)
        t = self._spread(self.observed)
        kept = max(FEWEST, 8 * int(np.sum(weights > 1e-12))) * len(self.request.limits)
        nominal = np.asarray(self._nominal()(t))[self.good]
        h = np.concatenate([np.asarray(sampled(t)), nominal], axis=1)
        if self.joint:
            h = np.max(h, axis=1, keepdims=True)
        rank = np.max(np.argsort(np.argsort(h, axis=0, kind="stable"), axis=0), axis=1)
        rows = np.argsort(rank, kind="stable")[-kept:]
        fewer = (a[rows] for a in (sampled.units, sampled.anchors, sampled.values, sampled.gradients))
        return Sampled(sampled.quadratic, *fewer), jnp.asarray(weights[-kept:])

    def _quantiles(self, sampled, t) -> Normalised:
        """The quantile (l,) of each limit alone, failed samples counted as bad."""
        h = np.asarray(sampled(self._spread(t)))
        bad = np.full((len(self.units) - len(h), h.shape[1]), np.nan)
        return np.array([sample_quantile(c, self.level) for c in np.concatenate([h, bad]).T])

    def quadratic_worst(self, t: HalfWidths) -> Normalised:
        """h (l,) of the quadratic model alone."""
        if self.joint:
            return self._quantiles(self._nominal(), t)
        return np.asarray(self._moments().moments(self._spread(t)))

    def predicted_yield(self, t: HalfWidths) -> float:
        """Fraction of the standard points within all limits, by the corrected model; NaN but for a yield."""
        if not self.joint:
            return np.nan
        sampled = self._nominal() if self.sampled is None else self.sampled
        h = np.asarray(sampled(self._spread(t)))
        return float(np.sum(np.all(h <= 0, axis=1)) / len(self.units))

    def solve(self, x: HalfWidths, lower: HalfWidths, upper: HalfWidths) -> Answer:
        """Cheapest x = log t on the model."""
        rounds, evaluations = (15, 300) if self.joint else (25, 1000)
        x, cost, h, price = self._cheapest(self.model(), x, lower, upper, rounds=rounds, evaluations=evaluations)
        predicted = h
        if self.joint:
            # One multiplier for all limits: shared by how often each is worst near the quantile.
            price = price * self._shares(np.exp(x))
            predicted = self._quantiles(self.sampled or self._nominal(), np.exp(x))
        return Answer(x, cost, predicted, float(h.max()), price)

    def _shares(self, t) -> Normalised:
        """Share of each limit in the weights of the samples in which it is the worst one."""
        sampled, weights = self._tail()
        h = np.asarray(sampled(self._spread(t)))
        order = np.argsort(np.max(h, axis=1), kind="stable")
        owner = np.argmax(h[order], axis=1)
        weights = np.asarray(weights)
        return np.array([weights[owner == i].sum() for i in range(h.shape[1])])

    def observe(self, t: HalfWidths, key: RandomKey) -> Float[np.ndarray, " constraints"]:
        """h of the full problem's statistic on the standard points (yield: of all limits together); its values and
        derivatives there become the model."""
        request, errors = self.request, self.units * self.sizes.spread(t)
        values, jacobians = self.observer.linearise(self.variables.scattered(t, self.units))
        h = request.normalise(values)
        gradients = request.normalise_slopes(self.variables.by_coordinates(jacobians))
        self.good = np.all(np.isfinite(h), axis=1) & np.all(np.isfinite(gradients), axis=(1, 2))
        self.failed += int(np.sum(~self.good))
        if not np.any(self.good):
            return np.array([np.inf])
        self.observed = t
        arrays = (a[self.good] for a in (self.units, errors, h, gradients))
        self.sampled = Sampled(self.quadratic, *map(jnp.asarray, arrays))
        if np.mean(self.good) < self.aim:
            return np.array([np.inf])
        return np.asarray(self.model()(self._spread(t)))

    def verify(self, t: HalfWidths, key: RandomKey) -> Verified:
        """A fresh Monte Carlo run at t."""
        return self.sample.verify(self.observer, lambda z: self.variables.scattered(t, z), key, self._estimate)

    def _estimate(self, h) -> tuple[float, float, float]:
        """Value, low and high end of the statistic of samples h (n,)."""
        good = h[np.isfinite(h)]
        if self.statistic == "mean":
            mean = estimate_mean(good)
            return mean.value, mean.low, mean.high
        quantile = estimate_quantile(np.where(np.isfinite(h), h, BEYOND), self.level)
        low, high = (np.inf if end == BEYOND else end for end in (quantile.low, quantile.high))
        return sample_quantile(h, self.level), low, high

    def learn(self, t: HalfWidths, fresh: Verified) -> None:
        """Raise the aim by the shortfall of a fresh run."""
        if self.joint:
            short = max(self.level - fresh.fraction, 0.0)
            self.aim = self.aim + min(short, 0.5 * (1 - self.aim))
        else:
            self.extra = self.extra + np.maximum(np.where(np.isfinite(fresh.h), fresh.h, 0.0), 0.0)

    def best(self, key: RandomKey) -> Normalised:
        """The statistic h (l,) of the full problem at the smallest tolerances."""
        t = self.variables.width_lower
        full = np.array([self._estimate(column)[0] for column in self._smallest().T])
        if self.joint:
            return full
        # As for the answer: few samples estimate the difference to the quadratic model's statistic well, the
        # statistic itself (three deviations away) badly.
        nominal = np.asarray(self._nominal()(self._spread(t)))
        quadratic = np.array([self._estimate(column)[0] for column in nominal.T])
        return full - quadratic + np.asarray(self._moments().moments(self._spread(t)))

    def best_yield(self) -> float:
        """Fraction of the standard points within all limits at the smallest tolerances; NaN but for a yield."""
        return float(np.mean(within(self._smallest()))) if self.joint else np.nan

    def _smallest(self) -> Float[np.ndarray, "n l"]:
        """h (n, l) of the full problem on the standard points, at the smallest tolerances."""
        return sampled_limits(self.observer, self.variables.scattered(self.variables.width_lower, self.units))[0]
