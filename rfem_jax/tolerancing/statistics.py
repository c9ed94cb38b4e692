"""Statistics of samples, with confidence intervals that need no distribution.

Place in the pipeline: after the Monte Carlo samples; works on NumPy arrays of good samples only.

    mean           xbar +- t s/sqrt(n)                         (large n, any distribution)
    deviation      log s +- t sqrt((m4/s^4 - 1)/n) / 2         (large n, any distribution)
    quantile       order statistics x_(l), x_(u): P(l <= Bin(n, q) < u) >= confidence   (any n)
    yield          Clopper-Pearson: never below the confidence (any n)
    Sobol' indices S_i = E[f_B (f_ABi - f_A)]/V,  T_i = E[(f_A - f_ABi)^2]/(2 V), bootstrap interval
    control        mean(f - b (q - E q)), b from the other folds: unbiased

All intervals take the samples as independent. Scrambled Sobol' points are better than that: their
intervals for means are then too wide, rarely too narrow.

Symbols: f (n,) values of a metric, q (n,) quadratic model at the same errors, m4 fourth central
moment, V variance, S_i first-order and T_i total index of factor i.
Source: H. A. David, H. N. Nagaraja, Order Statistics, 3rd ed. (2003), section 7.1; C. J. Clopper,
E. S. Pearson, Biometrika 26 (1934) 404-413; A. Saltelli et al., Comput. Phys. Commun. 181 (2010)
259-270, table 2 (b) and (f); S. S. Lavenberg, P. D. Welch, Management Science 27 (1981) 322-335
(control variates); A. N. Avramidis, J. R. Wilson, Oper. Res. 41 (1993) 833-846 (splitting).
"""

import math
from dataclasses import dataclass

import numpy as np
from scipy import stats

from rfem_jax.description.errors import InputError

FOLDS = 10
RESAMPLES = 500


@dataclass(frozen=True)
class Estimate:
    """A value and its confidence interval low ... high (infinite where samples are too few)."""

    value: float
    low: float
    high: float

    def __str__(self):
        return f"{self.value:.5g} [{self.low:.5g}, {self.high:.5g}]"


@dataclass(frozen=True)
class SobolIndices:
    """First-order and total indices of one metric: {factor label: Estimate}; samples used."""

    first_order: dict[str, Estimate]
    total: dict[str, Estimate]
    samples: int


@dataclass(frozen=True)
class ControlledMean:
    """Mean with a control variate; variance without it divided by variance with it."""

    mean: Estimate
    variance_reduction: float
    coefficient: float


def require_confidence(confidence):
    """Return `confidence` if it lies inside (0, 1). Raises InputError."""
    if not (isinstance(confidence, (int, float)) and 0.0 < confidence < 1.0):
        raise InputError(
            f"Argument `confidence` must lie between 0 and 1, but it is {confidence!r}; "
            "0.95 is usual."
        )
    return float(confidence)


def estimate_mean(samples, confidence=0.95):
    """Mean of samples (n,) and its interval by Student's t; NaN of an empty set."""
    n = len(samples)
    if n == 0:
        return Estimate(math.nan, math.nan, math.nan)
    mean = float(np.mean(samples))
    if n == 1:
        return Estimate(mean, -math.inf, math.inf)
    half = stats.t.ppf(0.5 + 0.5 * confidence, n - 1) * np.std(samples, ddof=1) / math.sqrt(n)
    return Estimate(mean, mean - float(half), mean + float(half))


def estimate_std(samples, confidence=0.95):
    """Standard deviation of samples (n,) and its large-sample interval from the fourth moment."""
    n = len(samples)
    if n < 2:
        return Estimate(math.nan, math.nan, math.nan)
    std = float(np.std(samples, ddof=1))
    if std == 0.0:
        return Estimate(0.0, 0.0, 0.0)
    fourth = float(np.mean((samples - np.mean(samples)) ** 4))
    # The error of log(s), whose distribution is nearer to normal than that of s.
    error = math.sqrt(max(fourth / std**4 - 1.0, 0.0) / n) / 2.0
    factor = math.exp(float(stats.t.ppf(0.5 + 0.5 * confidence, n - 1)) * error)
    return Estimate(std, std / factor, std * factor)


def estimate_quantile(samples, fraction, confidence=0.95):
    """Quantile of samples (n,) and a distribution-free interval between two order statistics.

    Args: fraction in (0, 1). An end is infinite where n samples cannot bound it.
    """
    if not 0.0 < fraction < 1.0:
        raise InputError(
            f"Argument `quantiles` must lie between 0 and 1, but one is {fraction!r}; write 0.95."
        )
    n = len(samples)
    if n == 0:
        return Estimate(math.nan, math.nan, math.nan)
    ordered = np.sort(samples)
    tail = 0.5 * (1.0 - confidence)
    lower = int(stats.binom.ppf(tail, n, fraction))  # rank from 1; 0: below all samples
    upper = int(stats.binom.ppf(1.0 - tail, n, fraction)) + 1
    return Estimate(
        float(np.quantile(ordered, fraction, method="median_unbiased")),
        float(ordered[lower - 1]) if lower >= 1 else -math.inf,
        float(ordered[upper - 1]) if upper <= n else math.inf,
    )


def estimate_yield(passes, n, confidence=0.95):
    """Fraction that passes and its Clopper-Pearson interval; NaN of an empty set."""
    if n == 0:
        return Estimate(math.nan, 0.0, 1.0)
    interval = stats.binomtest(int(passes), int(n)).proportion_ci(confidence, method="exact")
    return Estimate(passes / n, float(interval.low), float(interval.high))


def sobol_estimates(f_a, f_b, f_ab):
    """First-order (k,) and total (k,) indices of f_a (n,), f_b (n,), f_ab (k, n).

    A metric that does not vary has no indices (NaN).
    """
    both = np.concatenate([f_a, f_b], axis=-1)
    centre = both.mean(axis=-1, keepdims=True)
    variance = both.var(axis=-1)[..., None]
    # Centring leaves the estimate's mean as it is and lowers its scatter (Saltelli et al. 2010).
    a, b = (f_a - centre)[..., None, :], (f_b - centre)[..., None, :]
    ab = f_ab - centre[..., None, :]
    # A variance that is only rounding of the mean is no variance.
    negligible = variance <= (1e-13 * np.abs(centre)) ** 2
    variance = np.where(negligible, np.nan, variance)
    first = np.mean(b * (ab - a), axis=-1) / variance
    return first, np.mean((a - ab) ** 2, axis=-1) / (2.0 * variance)


def estimate_sobol_indices(f_a, f_b, f_ab, labels, confidence=0.95, seed=0):
    """Sobol' indices of one metric with percentile bootstrap intervals.

    Args: f_a, f_b (n,), f_ab (k, n) values on the design of `sampling.design_points`; labels (k) of
        the factors; seed of the bootstrap. A base sample with a value that is not finite is left
        out.
    """
    good = np.isfinite(f_a) & np.isfinite(f_b) & np.all(np.isfinite(f_ab), axis=0)
    f_a, f_b, f_ab = f_a[good], f_b[good], f_ab[:, good]
    n = len(f_a)
    if n < 2:
        missing = {label: Estimate(math.nan, math.nan, math.nan) for label in labels}
        return SobolIndices(missing, dict(missing), n)
    values = sobol_estimates(f_a, f_b, f_ab)
    generator = np.random.default_rng(seed)
    tails = [0.5 * (1.0 - confidence), 0.5 * (1.0 + confidence)]
    resampled = []
    for _ in range(RESAMPLES):  # one at a time: memory stays that of the samples
        drawn = generator.integers(0, n, n)
        resampled.append(sobol_estimates(f_a[drawn], f_b[drawn], f_ab[:, drawn]))
    low, high = np.quantile(np.array(resampled), tails, axis=0)
    first, total = (
        {
            label: Estimate(float(values[j][i]), float(low[j, i]), float(high[j, i]))
            for i, label in enumerate(labels)
        }
        for j in (0, 1)
    )
    return SobolIndices(first, total, n)


def estimate_controlled_mean(samples, model, model_mean, confidence=0.95):
    """Mean of samples (n,) with the control variate model (n,), whose mean is known.

    The samples are split in folds (each sample's index modulo their number); the coefficient used
    in a fold comes from the other folds, so that it is independent of the fold and the mean is
    unbiased.
    """
    n = len(samples)
    if n < 4:
        raise InputError(
            f"Argument `control_variate` must have at least 4 good samples, but there are {n}; "
            "take more samples, or none."
        )
    folds = min(FOLDS, n // 2)
    fold = np.arange(n) % folds
    coefficients = np.array([_slope(samples[fold != k], model[fold != k]) for k in range(folds)])
    residual = samples - coefficients[fold] * (model - model_mean)
    before, after = np.var(samples, ddof=1), np.var(residual, ddof=1)
    if before == 0.0:
        reduction = 1.0
    else:
        reduction = math.inf if after == 0.0 else float(before / after)
    mean = estimate_mean(residual, confidence)
    return ControlledMean(mean, reduction, float(np.mean(coefficients)))


def _slope(samples, model):
    """Coefficient of least variance, cov(f, q)/var(q); 0 where the model does not vary."""
    deviation = model - np.mean(model)
    square = float(deviation @ deviation)
    return float(deviation @ samples) / square if square > 0.0 else 0.0
