"""What is known before the measurement: a normal prior of the tolerances' means and covariance, or none, and bounds.

Place in the pipeline: tolerances -> **prior** -> residuals.

    x = m + L z,   C = L L^T         z (k,) independent standard normal numbers        (theory (17.2))

An error with a flat prior has the half-width of its tolerance or of its bounds as its unit L.

Symbols: k unknowns; x (k,) [rad, m]; z (k,) in standard deviations of the prior.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from rfem_jax.description.basics.errors import InputError, require_choice
from rfem_jax.description.tasks.identification import PRIORS
from rfem_jax.tolerancing.checks import check_known, check_variables
from rfem_jax.tolerancing.designs.sweep_study import read_bounds
from rfem_jax.tolerancing.problems.named_tolerances import Tolerances, distributions_of
from rfem_jax.tolerancing.problems.problem import ToleranceProblem


@dataclass(frozen=True, eq=False)
class Prior:
    """names, units (k); mean (k,) [rad, m]; root (k, k), L; known (k,): False where the prior is flat; low, high (k,)
    bounds of z, infinite without; tolerances (k, 2) their intervals [rad, m], NaN without."""

    names: tuple[str, ...]
    units: tuple[str, ...]
    mean: Float[np.ndarray, " k"]
    root: Float[np.ndarray, "k k"]
    known: Bool[np.ndarray, " k"]
    low: Float[np.ndarray, " k"]
    high: Float[np.ndarray, " k"]
    tolerances: Float[np.ndarray, "k 2"]

    def errors(self, z: Float[np.ndarray, "*n k"]) -> Float[np.ndarray, "*n k"]:
        """x of z."""
        return self.mean + z @ self.root.T

    @property
    def ends(self) -> tuple[Float[np.ndarray, " k"], Float[np.ndarray, " k"]]:
        """Bounds of x [rad, m], infinite without."""
        return self.mean + self.scale * self.low, self.mean + self.scale * self.high

    @property
    def deviations(self) -> Float[np.ndarray, " k"]:
        """Standard deviations [rad, m]; infinite where the prior is flat."""
        return np.where(self.known, np.sqrt(np.sum(self.root**2, axis=1)), np.inf)

    @property
    def precision(self) -> Float[np.ndarray, "k k"]:
        """Inverse of the covariance; zero where the prior is flat."""
        return np.linalg.inv(self.root @ self.root.T) * np.outer(self.known, self.known)

    @property
    def scale(self) -> Float[np.ndarray, " k"]:
        """Units of z [rad, m]."""
        return np.sqrt(np.sum(self.root**2, axis=1))


def read_prior(
    problem: ToleranceProblem, tolerances: Any, unknowns: Sequence[str] | None, prior: Any, bounds: Any
) -> Prior:
    """The prior of a call of `identify`. Raises: InputError for unknowns about which nothing is known."""
    tolerances = distributions_of(tolerances)
    if isinstance(tolerances, Mapping):
        tolerances = Tolerances(tolerances)
    if tolerances is not None and not isinstance(tolerances, Tolerances):
        raise InputError(
            f"Argument `tolerances` must be a Tolerances collection, a study or None, but was {tolerances!r}; write "
            "Tolerances({...})."
        )
    require_choice(prior, PRIORS, "prior")
    toleranced: list[str] = [] if tolerances is None else list(tolerances.names)
    names: tuple[str, ...] = tuple(unknowns or dict.fromkeys([*toleranced, *(bounds or {})]))
    if not names or len(set(names)) < len(names):
        raise InputError("Argument `unknowns` must name errors, each once; give `tolerances` or names.")
    check_variables(names, problem, "unknowns")
    if tolerances is not None:
        tolerances.require_units(problem)
    check_known(bounds or {}, names, "bounds")
    ends = dict(zip(bounds, read_bounds(problem, bounds)[1], strict=True)) if bounds else {}
    units = tuple(problem.error_unit(name) for name in names)
    mean, covariance = np.zeros(len(names)), np.zeros((len(names),) * 2)
    intervals = np.full((len(names), 2), np.nan)
    known = np.array([prior == "tolerances"] * len(names))
    if tolerances is not None:
        mean, covariance, intervals = _of_tolerances(tolerances, names)
    for i, name in enumerate(names):
        if covariance[i, i] > 0.0 and known[i]:
            continue
        if known[i] or not (name in ends or covariance[i, i] > 0.0):
            raise InputError(
                f'Argument `unknowns` must have tolerances, or bounds and the prior "flat", but `{name}` has not; '
                "add them."
            )
        low, high = ends.get(name, tuple(intervals[i]))
        mean[i] = 0.5 * (low + high)
        covariance[i], covariance[:, i] = 0.0, 0.0
        covariance[i, i] = (0.5 * (high - low)) ** 2
    root = np.linalg.cholesky(covariance)
    low, high = np.full(len(names), -np.inf), np.full(len(names), np.inf)
    for name, (least, most) in ends.items():
        i = names.index(name)
        if np.any(root[i, :i]) or np.any(root[i + 1 :, i]):
            raise InputError(
                f"Argument `bounds` must be of errors that vary alone, but `{name}` varies with others; leave out its "
                "bounds, or the correlation."
            )
        low[i], high[i] = (least - mean[i]) / root[i, i], (most - mean[i]) / root[i, i]
    return Prior(names, units, mean, root, known, low, high, intervals)


def _of_tolerances(tolerances: Tolerances, names: Sequence[str]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Means (k,), covariance (k, k), intervals (k, 2); zero and NaN for names without."""
    means, intervals = tolerances.means(), tolerances.intervals()
    whole = np.asarray(tolerances.covariance())
    covariance = np.zeros((len(names),) * 2)
    for i, name in enumerate(names):
        for j, other in enumerate(names):
            if name in tolerances.names and other in tolerances.names:
                covariance[i, j] = whole[tolerances.names.index(name), tolerances.names.index(other)]
    mean = np.array([float(means.get(name, 0.0)) for name in names])
    return mean, covariance, np.array([[float(end) for end in intervals.get(name, (np.nan, np.nan))] for name in names])
