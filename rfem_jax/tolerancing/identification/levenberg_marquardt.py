"""Least squares by Levenberg-Marquardt, of several searches in step: each takes its next step in the same batch of
runs.

Place in the pipeline: residuals -> **levenberg_marquardt** -> identification_study.

    (H + lambda diag(H)) step = -g      over the parameters that are not held by a bound                (17.6)

A trial whose run fails has an infinite cost and is not taken: the next is shorter. The loop runs on the host, as runs
that fail are data here, searches share the program of all runs with derivatives, and an interrupted study goes on.

Symbols: w searches, p parameters, g (p,) gradient and H (p, p) curvature of half the cost.
Source: J. J. More, The Levenberg-Marquardt algorithm, Lect. Notes Math. 630 (1978) 105-116; J. Nocedal, S. J. Wright,
Numerical Optimization, 2nd ed. (2006), 10.3, 16.7 (projection on bounds).
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from rfem_jax.tolerancing.identification.residuals import Misfit

LEAST, MOST = 1e-9, 1e9  # of lambda
CLOSE = 1e-2  # distance to the minimum, in standard deviations of the posterior
HOPELESS = 30.0  # of the cost above the best minimum, e^15 times less probable


class Searches(NamedTuple):
    """Ends of w searches: theta (w, p), their misfits, whether each converged, the number of steps of the longest, and
    the misfits at the starts."""

    theta: Float[np.ndarray, "w p"]
    misfit: Misfit
    converged: Bool[np.ndarray, " w"]
    steps: int
    first: Misfit


def search(
    evaluate: Callable[[Float[np.ndarray, "w p"]], Misfit],
    starts: Float[np.ndarray, "w p"],
    low: Float[np.ndarray, " p"],
    high: Float[np.ndarray, " p"],
    iterations: int,
    advance: Callable[[int], object] = lambda count: None,
) -> Searches:
    """Minimise the cost from every start, within bounds.

    A search has converged when a Newton step is shorter than `CLOSE` standard deviations of the posterior. Once one
    has, another ends that stays far above it even if it falls four times as much as a Newton step promises.
    """
    theta = np.clip(starts, low, high)
    misfit = first = evaluate(theta)
    damping, converged, steps = np.full(len(theta), 1e-3), np.zeros(len(theta), dtype=bool), 0
    for steps in range(iterations + 1):
        tried, promised = theta.copy(), np.zeros(len(theta))
        for w in np.flatnonzero(np.isfinite(misfit.cost)):
            step, distance = _step(theta[w], misfit.gradient[w], misfit.curvature[w], low, high, damping[w])
            converged[w], promised[w] = distance < CLOSE, misfit.cost[w] - 4.0 * distance**2
            if not converged[w] and damping[w] < MOST:
                tried[w] = np.clip(theta[w] + step, low, high)
        if converged.any():
            lost = promised > misfit.cost[converged].min() + HOPELESS
            tried[lost] = theta[lost]
        moving = np.any(tried != theta, axis=1)
        if not moving.any() or steps == iterations:
            break
        found = evaluate(tried)
        advance(1)
        better = moving & (found.cost < misfit.cost)
        damping = np.where(better, np.maximum(damping / 10.0, LEAST), np.where(moving, damping * 8.0, damping))
        theta[better] = tried[better]
        misfit = Misfit(*(_where(better, new, old) for new, old in zip(found, misfit, strict=True)))
    return Searches(theta, misfit, converged, steps, first)


def _where(chosen, new, old):
    return np.where(chosen.reshape(-1, *[1] * (new.ndim - 1)), new, old)


def _step(theta, gradient, curvature, low, high, damping):
    """The step of one search, and the length of a Newton step in standard deviations."""
    held = ((theta <= low) & (gradient > 0.0)) | ((theta >= high) & (gradient < 0.0))
    free = np.flatnonzero(~held)
    step = np.zeros_like(theta)
    if not len(free):
        return step, 0.0
    g, h = gradient[free], curvature[np.ix_(free, free)]
    # What no sample and no prior says anything about stays where it is.
    diagonal = np.maximum(np.diag(h), max(1e-12 * float(np.diag(h).max()), 1e-30))
    step[free] = -np.linalg.solve(h + np.diag(damping * diagonal + 1e-14 * diagonal), g)
    newton = np.linalg.solve(h + np.diag(1e-12 * diagonal), g)
    return step, float(np.sqrt(max(g @ newton, 0.0)))
