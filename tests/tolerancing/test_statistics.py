"""Statistics: intervals that cover, Sobol' indices of known functions, the control variate."""

import jax
import numpy as np
import pytest
from scipy import stats

from rfem_jax import InputError
from rfem_jax.tolerancing.sampling import statistics
from rfem_jax.tolerancing.sampling.sequences import design_points

jax.config.update("jax_enable_x64", True)

REPEATS, N = 400, 200
# Log-normal samples f = exp(s x), x standard normal: skewed, all true values known.
S = 0.4
MEAN = np.exp(S**2 / 2)
STD = np.sqrt((np.exp(S**2) - 1) * np.exp(S**2))
Q90 = np.exp(S * stats.norm.ppf(0.9))


def coverage(interval, truth, confidence, n=N):
    generator = np.random.default_rng(20)
    hits = 0
    for _ in range(REPEATS):
        estimate = interval(np.exp(S * generator.normal(size=n)), confidence)
        assert estimate.low <= estimate.value <= estimate.high
        hits += estimate.low <= truth <= estimate.high
    return hits / REPEATS


@pytest.mark.parametrize("confidence", (0.8, 0.95))
@pytest.mark.parametrize(
    ("interval", "truth", "below", "above"),
    [
        (statistics.estimate_mean, MEAN, 0.03, 0.03),
        (statistics.estimate_std, STD, 0.06, 0.03),  # large-n theory: a little short when skewed
        (lambda f, c: statistics.estimate_quantile(f, 0.9, c), Q90, 0.025, 0.1),
        (lambda f, c: statistics.estimate_yield(f < Q90, c), 0.9, 0.025, 0.1),
    ],
    ids=("mean", "std", "quantile", "yield"),
)
def test_intervals_cover(interval, truth, below, above, confidence):
    covered = coverage(interval, truth, confidence)
    assert confidence - below <= covered <= min(1.0, confidence + above)


def test_quantile_interval_covers_exactly_as_the_binomial_says():
    ordered = np.arange(1.0, 101.0)
    estimate = statistics.estimate_quantile(ordered, 0.3, 0.95)
    lower, upper = int(estimate.low), int(estimate.high)
    inside = stats.binom.cdf(upper - 1, 100, 0.3) - stats.binom.cdf(lower - 1, 100, 0.3)
    narrower = stats.binom.cdf(upper - 2, 100, 0.3) - stats.binom.cdf(lower, 100, 0.3)
    assert inside >= 0.95 > narrower
    few = statistics.estimate_quantile(ordered[:10], 0.99, 0.95)
    assert few.high == np.inf and few.low > 1.0


def test_yield_interval_is_clopper_pearsons():
    estimate = statistics.estimate_yield(np.arange(100) < 97, 0.95)
    reference = stats.beta.ppf(0.025, 97, 4), stats.beta.ppf(0.975, 98, 3)
    np.testing.assert_allclose((estimate.low, estimate.high), reference, rtol=1e-8)
    every = statistics.estimate_yield(np.ones(20, dtype=bool))
    assert every.high == 1.0
    np.testing.assert_allclose(every.low, 0.025 ** (1 / 20), rtol=1e-8)


def test_empty_and_single_samples_say_so():
    assert np.isnan(statistics.estimate_mean(np.zeros(0)).value)
    assert statistics.estimate_mean(np.ones(1)).high == np.inf
    assert np.isnan(statistics.estimate_std(np.ones(1)).value)
    assert statistics.estimate_yield(np.zeros(0, dtype=bool)).high == 1.0
    with pytest.raises(InputError, match="`quantiles` must lie between 0 and 1"):
        statistics.estimate_quantile(np.ones(3), 1.0)
    with pytest.raises(InputError, match="`confidence` must"):
        statistics.require_confidence(95.0)


def ishigami(u, a=7.0, b=0.1):
    x = np.pi * (2 * u - 1)
    return np.sin(x[..., 0]) + a * np.sin(x[..., 1]) ** 2 + b * x[..., 2] ** 4 * np.sin(x[..., 0])


def ishigami_indices(a=7.0, b=0.1):
    first = np.array([0.5 * (1 + b * np.pi**4 / 5) ** 2, a**2 / 8, 0.0])
    crossed = b**2 * np.pi**8 * (1 / 18 - 1 / 50)
    variance = first.sum() + crossed
    return first / variance, (first + np.array([crossed, 0.0, crossed])) / variance


COEFFICIENTS = np.array([0.0, 0.5, 3.0, 9.0])


def sobol_g(u):
    return np.prod((np.abs(4 * u - 2) + COEFFICIENTS) / (1 + COEFFICIENTS), axis=-1)


def sobol_g_indices():
    partial = 1 / (3 * (1 + COEFFICIENTS) ** 2)
    variance = np.prod(1 + partial) - 1
    others = np.prod(1 + partial) / (1 + partial)
    return partial / variance, partial * others / variance


@pytest.mark.parametrize(("function", "exact"), [(ishigami, ishigami_indices()), (sobol_g, sobol_g_indices())])
def test_sobol_indices_of_known_functions(function, exact):
    k, n = len(exact[0]), 4096  # 8 nets of 512 points
    labels = [f"x{i}" for i in range(k)]
    points = design_points(jax.random.key(2), n, [(label,) for label in labels], "sobol")
    values = function(points).reshape(k + 2, n)
    found = statistics.estimate_sobol_indices(values[0], values[1], values[2:], labels)
    assert found.samples == n
    for estimates, truth in ((found.first_order, exact[0]), (found.total, exact[1])):
        for label, value in zip(labels, truth, strict=True):
            assert abs(estimates[label].value - value) < 0.015
            assert estimates[label].low - 1e-12 <= value <= estimates[label].high + 1e-12
    # An independent implementation of the same estimators; it does not centre the values.
    given = {"f_A": values[:1], "f_B": values[1:2], "f_AB": values[2:, None, :]}
    reference = stats.sobol_indices(func=given, n=n)
    np.testing.assert_allclose([e.value for e in found.first_order.values()], reference.first_order.ravel(), atol=0.02)
    np.testing.assert_allclose([e.value for e in found.total.values()], reference.total_order.ravel(), rtol=1e-10)


def test_sobol_indices_leave_out_failed_samples_and_constants():
    points = design_points(jax.random.key(2), 512, [("a",), ("b",), ("c",)], "pseudo_random")
    values = ishigami(points).reshape(5, 512)
    damaged = values.copy()
    damaged[3, 7] = np.nan
    kept = np.delete(values, 7, axis=1)
    found = statistics.estimate_sobol_indices(damaged[0], damaged[1], damaged[2:], "abc")
    same = statistics.estimate_sobol_indices(kept[0], kept[1], kept[2:], "abc")
    assert found == same and found.samples == 511
    flat = statistics.estimate_sobol_indices(*np.full((2, 64), 0.1), np.full((3, 64), 0.1), "abc")
    assert all(np.isnan(estimate.value) for estimate in flat.total.values())


@pytest.mark.long
def test_sobol_index_intervals_cover():
    hits, repeats = 0, 60
    first, total = ishigami_indices()
    for seed in range(repeats):
        factors = [("a",), ("b",), ("c",)]
        points = design_points(jax.random.key(seed), 256, factors, "pseudo_random")
        values = ishigami(points).reshape(5, 256)
        found = statistics.estimate_sobol_indices(values[0], values[1], values[2:], "abc", 0.9)
        hits += found.first_order["a"].low <= first[0] <= found.first_order["a"].high
        hits += found.total["c"].low <= total[2] <= found.total["c"].high
    assert 0.82 <= hits / (2 * repeats) <= 0.98


def controlled(x):
    model = 1 + S * x + 0.5 * S**2 * x**2
    return statistics.estimate_controlled_mean(np.exp(S * x), model, 1 + 0.5 * S**2, 0.9)


def test_controlled_mean_is_unbiased_and_covers():
    generator = np.random.default_rng(3)
    estimates = [controlled(generator.normal(size=24)) for _ in range(4000)]
    means = np.array([estimate.mean.value for estimate in estimates])
    # With the coefficient of the same samples the bias at n = 24 is several standard errors.
    error = means.std() / np.sqrt(len(means))
    assert abs(means.mean() - MEAN) < 2.5 * error
    assert error < 0.002
    large = [controlled(generator.normal(size=N)) for _ in range(400)]
    covered = np.mean([e.mean.low <= MEAN <= e.mean.high for e in large])
    assert 0.86 <= covered <= 0.94


def test_reported_variance_reduction_is_the_real_one():
    generator = np.random.default_rng(4)
    draws = [generator.normal(size=N) for _ in range(400)]
    plain = np.var([np.exp(S * x).mean() for x in draws])
    estimates = [controlled(x) for x in draws]
    real = plain / np.var([estimate.mean.value for estimate in estimates])
    reported = np.median([estimate.variance_reduction for estimate in estimates])
    assert real > 20
    assert 0.6 < reported / real < 1.7


def test_useless_model_does_no_harm():
    generator = np.random.default_rng(5)
    samples, unrelated = generator.normal(size=(2, 1000))
    found = statistics.estimate_controlled_mean(samples, unrelated, 0.0)
    assert 0.97 < found.variance_reduction < 1.03 and abs(found.coefficient) < 0.1
    constant = statistics.estimate_controlled_mean(samples, np.ones(1000), 1.0)
    np.testing.assert_allclose(constant.mean.value, samples.mean(), rtol=1e-12)
    with pytest.raises(InputError, match="at least 4 good samples"):
        statistics.estimate_controlled_mean(samples[:3], unrelated[:3], 0.0)
