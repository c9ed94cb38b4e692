"""Statistics of samples, with confidence intervals that need no distribution.

Place in the pipeline: after the Monte Carlo samples; works on NumPy arrays of good samples only.

    mean           xbar +- t e                                 (large n, any distribution)
    deviation      log s +- t e                                (large n, any distribution)
    quantile       order statistics x_(l), x_(u): P(l <= N_eff(q) < u) >= confidence
    yield          Clopper-Pearson for n_eff samples
    Sobol' indices S_i = E[f_B (f_ABi - f_A)]/V,  T_i = E[(f_A - f_ABi)^2]/(2 V), bootstrap interval
    control        mean(f - b (q - E q)), b from the other folds: unbiased

Independent samples: e = sd(psi)/sqrt(n), where psi is the statistic's influence function (f - xbar for the mean,
((f - xbar)^2/s^2 - 1)/2 for log s); t of n - 1 degrees of freedom, n_eff = n. Intervals of quantiles and yields then
never cover less than their confidence, for any n.

Samples of r independently scrambled nets (`nets`, the net of each sample): samples of one net depend on each other,
and a smooth statistic has a far smaller error than with independent samples. The error follows from the nets' totals,

    e^2 = r/(r - 1) sum_j (sum_(i in j) psi_i)^2 / n^2,        t of r - 1 degrees of freedom

which holds with failed samples too. A fraction p has psi = 1[below] - p and
n_eff = p (1 - p)/e^2 (t_(n-1)/t_(r-1))^2, the number of independent samples with the same error. Where the nets agree
to one sample (so that e may be zero by chance), e is that of one sample, and n_eff is at least n.

Symbols: f (n,) values of a metric, q (n,) quadratic model at the same errors, e standard error, V variance, S_i
first-order and T_i total index of factor i.
Source: theory (10.5) to (10.8); H. A. David, H. N. Nagaraja, Order Statistics, 3rd ed. (2003), section 7.1;
C. J. Clopper, E. S. Pearson, Biometrika 26 (1934) 404-413; E. L. Korn, B. I. Graubard, Survey Methodology 24 (1998)
193-201 (n_eff of a fraction); R. S. Woodruff, J. Amer. Stat. Assoc. 47 (1952) 635-646 (quantile from a fraction);
A. Saltelli et al., Comput. Phys. Commun. 181 (2010) 259-270, table 2 (b) and (f); S. S. Lavenberg, P. D. Welch,
Management Science 27 (1981) 322-335 (control variates); B. L. Nelson, Oper. Res. 38 (1990) 974-992 (splitting).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy import stats

from rfem_jax.description.basics.errors import InputError

FOLDS = 10
RESAMPLES = 500

Samples = Float[np.ndarray, " n"]
Nets = Int[np.ndarray, " n"] | None


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
    """First-order and total indices of one metric, {factor label: Estimate}, and the number of samples used."""

    first_order: dict[str, Estimate]
    total: dict[str, Estimate]
    samples: int


@dataclass(frozen=True)
class ControlledMean:
    """Mean with a control variate, its coefficient, and the factor by which it reduces the variance of a sample."""

    mean: Estimate
    variance_reduction: float
    coefficient: float


def require_confidence(confidence: float) -> float:
    """Return `confidence` if it lies inside (0, 1). Raises InputError."""
    if not (isinstance(confidence, (int, float)) and 0.0 < confidence < 1.0):
        raise InputError(f"Argument `confidence` must lie between 0 and 1, but it is {confidence!r}; 0.95 is usual.")
    return float(confidence)


def _standard_error(influence, nets) -> tuple[float, int]:
    """Standard error of a mean of influences (n,), and its degrees of freedom."""
    n = len(influence)
    if nets is None:
        return float(np.std(influence, ddof=1)) / math.sqrt(n), n - 1
    totals, r = _net_totals(influence, nets)
    if r < 2:
        return math.inf, 1  # one net does not show its own error
    return math.sqrt(r / (r - 1) * float(totals @ totals)) / n, r - 1


def _net_totals(influence, nets) -> tuple[Float[np.ndarray, " r"], int]:
    """Sum of the influences of each net that has samples, and the number of those nets."""
    counts = np.bincount(nets)
    return np.bincount(nets, weights=influence)[counts > 0], int(np.sum(counts > 0))


def _effective_number(below, nets, confidence) -> float:
    """Number n_eff of independent samples that would give the fraction of `below` (n,) the same error."""
    n = len(below)
    if nets is None:
        return float(n)
    p = float(np.mean(below))
    totals, r = _net_totals(below - p, nets)
    if r < 2:
        return 1.0
    agree = float(totals @ totals) <= (r - 1) / r + 1e-9  # as if one net differed by one sample
    error = 1.0 / n if agree else _standard_error(below - p, nets)[0]
    tail = 0.5 + 0.5 * confidence
    factor = (stats.t.ppf(tail, n - 1) / stats.t.ppf(tail, r - 1)) ** 2
    number = float(factor * p * (1.0 - p) / error**2)
    return max(number, float(n)) if agree else max(number, 1.0)


def estimate_mean(samples: Samples, confidence: float = 0.95, nets: Nets = None) -> Estimate:
    """Mean of samples (n,) and its interval by Student's t; NaN without samples.

    Args: nets (n,), the scrambled net that each sample belongs to; None for independent samples.
    """
    n = len(samples)
    if n == 0:
        return Estimate(math.nan, math.nan, math.nan)
    mean = float(np.mean(samples))
    if n == 1:
        return Estimate(mean, -math.inf, math.inf)
    error, freedom = _standard_error(samples - mean, nets)
    half = float(stats.t.ppf(0.5 + 0.5 * confidence, freedom)) * error
    return Estimate(mean, mean - half, mean + half)


def estimate_std(samples: Samples, confidence: float = 0.95, nets: Nets = None) -> Estimate:
    """Standard deviation of samples (n,) and its large-sample interval; nets as `estimate_mean`."""
    n = len(samples)
    if n < 2:
        return Estimate(math.nan, math.nan, math.nan)
    std = float(np.std(samples, ddof=1))
    if std == 0.0:
        return Estimate(0.0, 0.0, 0.0)
    # The error of log(s), whose distribution is nearer to normal than that of s.
    influence = 0.5 * ((samples - np.mean(samples)) ** 2 / np.var(samples) - 1.0)
    error, freedom = _standard_error(influence, nets)
    with np.errstate(over="ignore"):
        factor = float(np.exp(stats.t.ppf(0.5 + 0.5 * confidence, freedom) * error))
    return Estimate(std, std / factor, std * factor)


def estimate_quantile(samples: Samples, fraction: float, confidence: float = 0.95, nets: Nets = None) -> Estimate:
    """Quantile of samples (n,) and a distribution-free interval between two order statistics.

    Args: fraction in (0, 1); nets as `estimate_mean`. An end is infinite where n samples cannot bound it.
    """
    if not 0.0 < fraction < 1.0:
        raise InputError(f"Argument `quantiles` must lie between 0 and 1, but one is {fraction!r}; write 0.95.")
    n = len(samples)
    if n == 0:
        return Estimate(math.nan, math.nan, math.nan)
    ordered = np.sort(samples)
    value = float(np.quantile(ordered, fraction, method="median_unbiased"))
    number = max(int(_effective_number(samples <= value, nets, confidence)), 1)
    tail = 0.5 * (1.0 - confidence)
    # Ranks from 1; lower 0: below all samples, upper n + 1: above all.
    lower = int(stats.binom.ppf(tail, number, fraction)) * n // number
    upper = -(-(int(stats.binom.ppf(1.0 - tail, number, fraction)) + 1) * n // number)
    return Estimate(
        value,
        float(ordered[lower - 1]) if lower >= 1 else -math.inf,
        float(ordered[upper - 1]) if upper <= n else math.inf,
    )


def estimate_yield(passed: Bool[np.ndarray, " n"], confidence: float = 0.95, nets: Nets = None) -> Estimate:
    """Fraction of `passed` (n,) booleans that is True and its Clopper-Pearson interval.

    Args: nets as `estimate_mean`. NaN without samples.
    """
    n = len(passed)
    if n == 0:
        return Estimate(math.nan, 0.0, 1.0)
    passed = np.asarray(passed, dtype=bool)
    fraction, tail = float(np.mean(passed)), 0.5 * (1.0 - confidence)
    number = _effective_number(passed, nets, confidence)
    good, bad = fraction * number, (1.0 - fraction) * number
    low = 0.0 if good == 0.0 else float(stats.beta.ppf(tail, good, bad + 1.0))
    high = 1.0 if bad == 0.0 else float(stats.beta.ppf(1.0 - tail, good + 1.0, bad))
    return Estimate(fraction, low, high)


def sobol_estimates(
    f_a: Samples, f_b: Samples, f_ab: Float[np.ndarray, "k n"]
) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, " k"]]:
    """First-order (k,) and total (k,) indices of f_a (n,), f_b (n,), f_ab (k, n).

    A metric that does not vary has no indices (NaN).
    """
    both = np.concatenate([f_a, f_b])
    centre, variance = both.mean(), both.var()
    # Centring does not change the estimate's mean and lowers its scatter (Saltelli et al. 2010).
    a, b, ab = f_a - centre, f_b - centre, f_ab - centre
    # Variance that is only rounding of the mean counts as none.
    if variance <= (1e-13 * np.abs(centre)) ** 2:
        variance = np.nan
    return np.mean(b * (ab - a), axis=-1) / variance, np.mean((a - ab) ** 2, axis=-1) / (2.0 * variance)


def estimate_sobol_indices(
    f_a: Samples,
    f_b: Samples,
    f_ab: Float[np.ndarray, "k n"],
    labels: Sequence[str],
    confidence: float = 0.95,
    seed: int = 0,
) -> SobolIndices:
    """Sobol' indices of one metric with percentile bootstrap intervals.

    Args: f_a, f_b (n,), f_ab (k, n), values on the design of `sampling.design_points`; labels (k) of the factors; seed
        of the bootstrap. A base sample with a value that is not finite is left out.
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
        {label: Estimate(float(values[j][i]), float(low[j, i]), float(high[j, i])) for i, label in enumerate(labels)}
        for j in (0, 1)
    )
    return SobolIndices(first, total, n)


def estimate_controlled_mean(
    samples: Samples, model: Samples, model_mean: float, confidence: float = 0.95, nets: Nets = None
) -> ControlledMean:
    """Mean of samples (n,) with the control variate model (n,), whose mean is known.

    The samples are split into folds (their nets, or each sample's index modulo the number of folds). The coefficient
    used in a fold comes from the other folds, so that it is independent of the fold and the mean is unbiased.
    Raises: InputError for fewer than 4 samples.
    """
    n = len(samples)
    if n < 4:
        raise InputError(
            f"Argument `control_variate` must have at least 4 good samples, but there are {n}; "
            "take more samples, or none."
        )
    fold = np.arange(n) % min(FOLDS, n // 2) if nets is None else nets
    folds = int(np.max(fold)) + 1
    coefficients = np.array([_coefficient(samples[fold != k], model[fold != k]) for k in range(folds)])
    residual = samples - coefficients[fold] * (model - model_mean)
    before, after = np.var(samples, ddof=1), np.var(residual, ddof=1)
    reduction = 1.0 if before == 0.0 else math.inf if after == 0.0 else float(before / after)
    mean = estimate_mean(residual, confidence, nets)
    return ControlledMean(mean, reduction, float(np.mean(coefficients)))


def _coefficient(samples, model) -> float:
    """Regression coefficient cov(f, q)/var(q), which gives the least variance; 0 where the model does not vary."""
    deviation = model - np.mean(model)
    square = float(deviation @ deviation)
    return float(deviation @ samples) / square if square > 0.0 else 0.0
