"""Whether a model fits what was measured: chi-square and whiteness of what it leaves over.

Place in the pipeline: residuals at the estimate -> **fit_tests** -> conclusion.

    chi^2 = sum r_i^2 with n - trace(H^-1 J^T J) degrees of freedom                                  (17.11)
    Q = n (n + 2) sum_l rho_l^2 / (n - l) with L degrees of freedom, rho_l the autocorrelation at lag l   (17.12)

Source: G. M. Ljung, G. E. P. Box, On a measure of lack of fit in time series models, Biometrika 65 (1978) 297-303.
"""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.stats import chi2

from rfem_jax.tolerancing.identification.residuals import robust

DOUBT = 1e-3  # probability by chance, of one signal or all, below which a model is doubted
LAGS = 20
MAD_EFFICIENCY = 0.37  # of the median of absolute values beside the standard deviation, of normal numbers


@dataclass(frozen=True)
class SignalFit:
    """How one signal is fitted.

    column, unit; experiment, its number from 1; samples; noise [unit], `estimated` or given; shift [s], offset [unit],
    gain of the sensor, 0 where they are not unknown; remainder [unit]: RMS of what is left over, before: RMS of what
    the prior's mean leaves; chi_square, freedom; chi_square_chance: probability of a chi-square at least as far from
    what is expected, NaN where the noise was estimated; whiteness_chance: the same of the correlation along time;
    interpolation: error of the interpolation between saved times in standard deviations of the noise; verdict.
    """

    column: str
    unit: str
    experiment: int
    samples: int
    noise: float
    estimated: bool
    shift: float
    offset: float
    gain: float
    remainder: float
    before: float
    chi_square: float
    freedom: float
    chi_square_chance: float
    whiteness_chance: float
    interpolation: float
    verdict: str


class Tested(NamedTuple):
    """Chi-square, degrees of freedom, chances and verdict of one signal; see `SignalFit`."""

    chi_square: float
    freedom: float
    chi_square_chance: float
    whiteness_chance: float
    verdict: str


def tested(loss: str, r: Float[np.ndarray, " n"], determined: float, estimated: bool, tests: int) -> Tested:
    """The tests of one signal's residuals; `determined`: how many parameters it determines; `estimated`: whether its
    noise was; `tests`: of how many this is one."""
    freedom, squares = len(r) - determined, float(r @ r)
    if loss != "gaussian":
        freedom = MAD_EFFICIENCY * len(r)
        squares = freedom * (1.4826 * float(np.median(np.abs(r)))) ** 2
    by_chance = np.nan if estimated else chance(squares, freedom)
    white = whiteness(robust(loss, r)[0] * r)
    return Tested(squares, freedom, by_chance, white, verdict_on(squares, freedom, by_chance, white, tests))


def whiteness(r: Float[np.ndarray, " n"]) -> float:
    """Probability that independent noise is as correlated along time as r, by (17.12)."""
    n = len(r)
    lags = min(LAGS, n // 5)
    centred = r - r.mean()
    power = float(centred @ centred)
    if lags < 1 or power == 0.0:
        return 1.0
    correlations = np.array([centred[l:] @ centred[:-l] for l in range(1, lags + 1)]) / power
    q = n * (n + 2.0) * np.sum(correlations**2 / (n - np.arange(1, lags + 1)))
    return float(chi2.sf(q, lags))


def chance(chi_square: float, freedom: float) -> float:
    """Probability of a chi-square at least as far on this side of what is expected, doubled."""
    if freedom <= 0.0:
        return 1.0
    return float(2.0 * min(chi2.sf(chi_square, freedom), chi2.cdf(chi_square, freedom), 0.5))


def verdict_on(chi_square: float, freedom: float, chi_chance: float, white: float, tests: int) -> str:
    """What the tests of a signal say, "fits" or why not; `tests`: of how many signals this is one."""
    limit = DOUBT / tests
    large = chi_chance < limit and chi_square > freedom
    if white < limit:
        found = "larger than the noise and correlated in time" if large else "correlated in time"
        return f"misfit: a remainder that is {found}; an error or an effect is missing, or the noise is not white"
    if large:
        return "misfit: a remainder that is larger than the noise that was given"
    return "misfit: a remainder that is smaller than the noise that was given" if chi_chance < limit else "fits"
