"""Spectral projected gradient: local maxima over a convex set, many starts in one batch.

Place in the pipeline: the search inside worst cases and inside the augmented Lagrangian.

    d = P(x + a grad f) - x,   x+ = x + l d      a: Barzilai-Borwein step, l: backtracking

Nonmonotone acceptance (against the worst of the last `MEMORY` values), one evaluation of value and gradient per pass
of the loop, so that a batch of searches stays in step under `vmap`. A trial whose value is not finite is refused like
one that is too low: a search walks around samples that fail.

`climb` is traced with its function inside, for models that cost little. `climb_together` runs its loop on the host and
calls a function of many points: an expensive function is then compiled once for all searches and for everything else
that needs values and gradients, and searches that have ended cost nothing more.

Symbols: x (k,) point, f value, s residual |P(x + grad f) - x|_inf (zero exactly at points that satisfy the first-order
conditions).
Source: theory (10.10); E. G. Birgin, J. M. Martinez, M. Raydan, Nonmonotone spectral projected gradient methods on
convex sets, SIAM J. Optim. 10 (2000) 1196-1211, algorithm SPG2.
"""

from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.typing import ArrayLike
from jaxtyping import Array, Bool, Float, Int

MEMORY = 8
SUFFICIENT = 1e-4
STEP_MIN, STEP_MAX = 1e-12, 1e12
SHORTEST = 1e-14

Point = Float[Array, " k"]


class Search(NamedTuple):
    """End of a search: the best point seen, its value, gradient and residual; its cost.

    `evaluations` counts value-and-gradient pairs; `converged`: the residual is at most the tolerance. A start that
    could not be evaluated has a NaN value. With many searches all arrays have a leading axis.
    """

    point: Float[Array, "*searches k"]
    value: Float[Array, "*searches"]
    gradient: Float[Array, "*searches k"]
    residual: Float[Array, "*searches"]
    evaluations: Int[Array, "*searches"]
    converged: Bool[Array, "*searches"]


class _Carry(NamedTuple):
    point: Array
    value: Array
    gradient: Array
    residual: Array
    direction: Array
    length: Array
    step: Array
    history: Array
    evaluations: Array
    best: tuple


def project_box(x: Point, lower: ArrayLike, upper: ArrayLike) -> Point:
    """The nearest point of the box lower <= x <= upper."""
    return jnp.clip(x, lower, upper)


def project_ball(x: Point) -> Point:
    """The nearest point of the unit ball."""
    norm = jnp.sqrt(jnp.maximum(jnp.sum(x * x), 1.0))
    return x / norm


def climb(
    function: Callable[[Point], tuple[Float[Array, ""], Point]],
    project: Callable[[Point], Point],
    start: Point,
    *,
    evaluations: int = 200,
    tolerance: float = 1e-8,
) -> Search:
    """Maximise `function` from one start; traced, made to be vmapped over starts.

    Args: function, x (k,) -> (value, gradient (k,)); project, x -> nearest feasible x; start (k,); evaluations, the
        largest number of them; tolerance on the residual (in units of x, so scale `function`).
    """
    start = project(start)
    # The start is the first trial of the loop, so that the function is compiled once.
    unknown = _begin(project, start, jnp.zeros((), start.dtype), jnp.zeros_like(start))
    unknown = unknown._replace(residual=jnp.full((), jnp.inf, start.dtype), evaluations=jnp.zeros((), jnp.int32))

    def advance(carry):
        trial = _trial(carry)
        found = trial, *function(trial)
        first, next_ = _begin(project, *found), _update(project, carry, *found)
        return jax.tree.map(lambda a, b: jnp.where(carry.evaluations == 0, a, b), first, next_)

    last = jax.lax.while_loop(lambda c: (c.evaluations == 0) | _going(c, evaluations, tolerance), advance, unknown)
    return _end(last, tolerance)


def climb_together(
    function: Callable[[Float[np.ndarray, "n k"]], tuple[Float[np.ndarray, " n"], Float[np.ndarray, "n k"]]],
    project: Callable[[Point], Point],
    starts: Float[np.ndarray, "s k"],
    *,
    evaluations: int = 200,
    tolerance: float = 1e-8,
) -> Search:
    """Maximise from many starts, with a loop on the host; not traced.

    Args: function, points (n, k) -> (values (n,), gradients (n, k)), for any n; project, x -> nearest feasible x,
        traced, the same object at every call (it keys the compiled updates); starts (s, k); evaluations and tolerance
        of each search, as for `climb`.
    Returns: Search with a leading axis of s.
    """
    starts = np.asarray(jax.vmap(project)(jnp.asarray(starts)))
    carry = _begin_all(project, starts, *function(starts))
    while np.any(going := np.asarray(_going(carry, evaluations, tolerance))):
        trials = np.asarray(_trials(carry))
        values, gradients = np.full(len(trials), np.nan), np.full(trials.shape, np.nan)
        values[going], gradients[going] = function(trials[going])
        carry = _update_all(project, carry, trials, values, gradients, going)
    return _end(carry, tolerance)


def _begin(project, start, value, gradient):
    residual = _residual(project, start, gradient)
    step = jnp.clip(1.0 / jnp.where(residual > 0, residual, 1.0), STEP_MIN, STEP_MAX)
    history = jnp.full((MEMORY,), jnp.inf, dtype=value.dtype).at[0].set(value)
    return _Carry(
        start, value, gradient, residual, project(start + step * gradient) - start,
        jnp.ones_like(value), step, history, jnp.ones((), dtype=jnp.int32),
        (start, value, gradient, residual),
    )  # fmt: skip


def _going(c, evaluations, tolerance):
    alive = (c.residual > tolerance) & (c.length > SHORTEST) & jnp.isfinite(c.value)
    return alive & (c.evaluations < evaluations)


def _trial(c):
    return c.point + c.length * c.direction


def _end(c, tolerance):
    point, value, gradient, residual = c.best
    return Search(point, value, gradient, residual, c.evaluations, residual <= tolerance)


@partial(jax.jit, static_argnums=0)
def _begin_all(project, starts, values, gradients):
    return jax.vmap(partial(_begin, project))(starts, values, gradients)


@jax.jit
def _trials(carry):
    return jax.vmap(_trial)(carry)


@partial(jax.jit, static_argnums=0)
def _update_all(project, carry, trials, values, gradients, going):
    def update(carry, trial, value, gradient, going):
        new = _update(project, carry, trial, value, gradient)
        return jax.tree.map(lambda a, b: jnp.where(going, a, b), new, carry)

    return jax.vmap(update)(carry, trials, values, gradients, going)


def _residual(project, x, gradient):
    return jnp.max(jnp.abs(project(x + gradient) - x))


def _update(project, c, trial, value, gradient):
    """After a trial: accept it and take a new direction, or shorten the step along the old one."""
    ascent = jnp.dot(c.gradient, c.direction)  # derivative of f along the direction
    reference = jnp.min(c.history)
    rounding = 4 * jnp.finfo(value.dtype).eps * jnp.abs(reference)
    finite = jnp.isfinite(value) & jnp.all(jnp.isfinite(gradient))
    accepted = finite & (value >= reference + SUFFICIENT * c.length * ascent - rounding)

    # Rejected: the maximum of the parabola through both values and the derivative, kept in [0.1, 0.5].
    sag = 2 * (c.value + c.length * ascent - value)
    parabola = jnp.where(finite & (sag > 0), c.length * ascent / jnp.where(sag > 0, sag, 1.0), 0.25)
    shorter = c.length * jnp.clip(parabola, 0.1, 0.5)

    moved, lost = trial - c.point, c.gradient - gradient
    curvature = jnp.dot(moved, lost)
    curved = curvature > 0
    spectral = jnp.where(curved, jnp.dot(moved, moved) / jnp.where(curved, curvature, 1.0), STEP_MAX)
    step = jnp.where(accepted, jnp.clip(spectral, STEP_MIN, STEP_MAX), c.step)

    point = jnp.where(accepted, trial, c.point)
    gradient = jnp.where(accepted, gradient, c.gradient)
    residual = jnp.where(accepted, _residual(project, point, gradient), c.residual)
    level = (value >= c.best[1] - rounding) & (residual < c.best[3])
    better = accepted & ((value > c.best[1] + rounding) | level)
    new = (point, value, gradient, residual)
    return _Carry(
        point,
        jnp.where(accepted, value, c.value),
        gradient,
        residual,
        jnp.where(accepted, project(point + step * gradient) - point, c.direction),
        jnp.where(accepted, 1.0, shorter),
        step,
        jnp.where(accepted, jnp.roll(c.history, 1).at[0].set(value), c.history),
        c.evaluations + 1,
        tuple(jnp.where(better, a, b) for a, b in zip(new, c.best, strict=True)),
    )
