"""Response surfaces: quadratic polynomials through values on a design, by least squares, with cross-validated errors.

Place in the pipeline: errors and values of a sweep -> **response_surface** -> tables, pictures; its `model` may serve
as the quadratic model of a worst case or as a control variate.

    f ~ b_0 + sum b_i z_i + sum_(i<=j) b_ij z_i z_j,      error of sample s left out: r_s/(1 - h_s)

Unlike the expansion of `quadratic_model`, which has the derivatives at one point, it is the best fit over the whole
range, and needs no derivatives.

Symbols: n samples, k errors, m metrics; z (n, k) errors scaled to -1 ... 1 over the range, r residuals, h_s = |q_s|^2
leverages, q rows of Q in the QR decomposition of the design matrix.
Source: theory (10.27), (10.28); D. M. Allen, Technometrics 16 (1974) 125-127 (error of samples left out).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from rfem_jax.description.basics.errors import InputError
from rfem_jax.tolerancing.problems.quadratic_model import QuadraticModel


@dataclass(frozen=True, eq=False)
class ResponseSurface:
    """A quadratic model of m metrics fitted over a range of k errors.

    model, about the middle of the range; half_range (k,) [rad or m]; residual (m,), root mean square at the samples;
    cross_validated (m,), the same of each sample by the surface of all others, both in the metrics' units; explained
    (m,), 1 - the latter squared over the variance: near 1 for a surface that predicts, 0 or less for one that does not;
    samples: number used.
    """

    model: QuadraticModel
    half_range: Float[np.ndarray, " k"]
    residual: Float[np.ndarray, " m"]
    cross_validated: Float[np.ndarray, " m"]
    explained: Float[np.ndarray, " m"]
    samples: int

    def __call__(self, errors: Float[np.ndarray, "n k"]) -> Float[np.ndarray, "n m"]:
        """Values (n, m) at errors (n, k) [rad or m]."""
        model = self.model
        away = np.asarray(errors) - np.asarray(model.point)
        linear = np.asarray(model.value) + away @ np.asarray(model.gradient).T
        return linear + 0.5 * np.einsum("mij,ni,nj->nm", np.asarray(model.hessian), away, away)

    def effects(self) -> Float[np.ndarray, "m k"]:
        """Largest change (m, k) by each error alone, from the middle to an end of its range [metric unit]."""
        scaled = self.model.scaled(self.half_range)
        curved = np.diagonal(np.asarray(scaled.hessian), axis1=1, axis2=2)
        return np.abs(np.asarray(scaled.gradient)) + 0.5 * np.abs(curved)


def fit_response_surface(
    names: Sequence[str],
    metrics: Sequence[str],
    errors: Float[np.ndarray, "n k"],
    values: Float[np.ndarray, "n m"],
) -> ResponseSurface:
    """Fit a quadratic polynomial to each metric.

    Args: names (k) of the errors and metrics (m); errors (n, k) [rad or m]; values (n, m), where a sample with a value
        that is not finite is left out.
    Raises: InputError for fewer samples than a polynomial has coefficients and one more, and for a design that does not
        determine them.
    """
    good = np.all(np.isfinite(values), axis=1)
    errors, values = np.asarray(errors, float)[good], np.asarray(values, float)[good]
    n, k = errors.shape
    pairs = np.triu_indices(k)
    count = 1 + k + len(pairs[0])
    if n <= count:
        raise InputError(
            f"Argument `errors` must hold more than {count} good samples for a quadratic surface of {k} errors, but it "
            f"holds {n}; take a larger design."
        )
    low, high = errors.min(axis=0), errors.max(axis=0)
    half = np.where(high > low, 0.5 * (high - low), 1.0)
    centre = 0.5 * (low + high)
    z = (errors - centre) / half
    matrix = np.concatenate([np.ones((n, 1)), z, z[:, pairs[0]] * z[:, pairs[1]]], axis=1)
    q, r = np.linalg.qr(matrix)
    if np.min(np.abs(np.diagonal(r))) < 1e-10 * np.max(np.abs(np.diagonal(r))):
        raise InputError(
            "Argument `errors` must determine a quadratic surface, but its points do not; take at least three "
            "levels of every error."
        )
    coefficients = np.linalg.solve(r, q.T @ values)  # (count, m)
    residual = values - matrix @ coefficients
    left_out = residual / (1.0 - np.sum(q**2, axis=1))[:, None]
    validated = np.mean(left_out**2, axis=0)
    variance = np.var(values, axis=0)
    model = _model(names, metrics, centre, half, coefficients, pairs)
    with np.errstate(divide="ignore", invalid="ignore"):
        explained = np.where(variance > 0.0, 1.0 - validated / variance, np.nan)
    return ResponseSurface(
        model, half, np.sqrt(np.mean(residual**2, axis=0)), np.sqrt(validated), explained, n
    )  # fmt: skip


def _model(names, metrics, centre, half, coefficients, pairs) -> QuadraticModel:
    """The polynomial as an expansion about the middle of the range."""
    k, m = len(names), len(metrics)
    hessian = np.zeros((m, k, k))
    hessian[:, pairs[0], pairs[1]] = coefficients[1 + k :].T
    hessian = (hessian + np.swapaxes(hessian, 1, 2)) / np.outer(half, half)
    arrays = (centre, coefficients[0], coefficients[1 : 1 + k].T / half, hessian, np.zeros(m), np.zeros((), np.int32))
    return QuadraticModel(tuple(names), tuple(metrics), "fitted", *map(jnp.asarray, arrays))
