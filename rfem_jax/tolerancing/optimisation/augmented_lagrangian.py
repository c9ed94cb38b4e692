"""Augmented Lagrangian: minimise a smooth cost under inequalities, in a box.

Place in the pipeline: the solver under the allocation of tolerances; knows nothing of it.

    min c(x)   subject to   h(x) <= 0,   lower <= x <= upper
    L(x) = c + 1/(2 rho) sum( max(0, mu + rho h)^2 - mu^2 ),     mu <- max(0, mu + rho h)

The inner problem is solved by the spectral projected gradient of `projected_gradient`; the penalty rho grows where the
violation does not shrink. Scale c and h to the order of one.

Symbols: x (k,), h (c,), mu (c,) multipliers (dc/dh at the solution), rho penalty.
Source: theory (10.14); J. Nocedal, S. J. Wright, Numerical Optimization, 2nd ed. (2006), section 17.4; E. G. Birgin,
J. M. Martinez, Practical Augmented Lagrangian Methods (2014), algorithm 4.1 (rule for rho).
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from rfem_jax.tolerancing.optimisation.projected_gradient import Point, Search, climb, project_box

PENALTY_START, PENALTY_GROWTH, PENALTY_MAX = 10.0, 5.0, 1e8

Cost = Callable[[Point], Float[Array, ""]]
Constraints = Callable[[Point], Float[Array, " c"]]


class Solution(NamedTuple):
    """Minimum: point (k,), its cost, multipliers (c,), and how well the conditions hold.

    `violation` is the largest of h and of the complementarity |min(-h, mu/rho)|, `residual` the projected gradient of
    the Lagrangian, |P(x - grad L) - x|_inf.
    """

    point: Float[Array, " k"]
    cost: Float[Array, ""]
    multipliers: Float[Array, " c"]
    violation: Float[Array, ""]
    residual: Float[Array, ""]
    evaluations: Int[Array, ""]
    converged: Bool[Array, ""]


def minimise(
    cost: Cost,
    constraints: Constraints,
    start: Point,
    lower: Point,
    upper: Point,
    *,
    rounds: int = 40,
    evaluations: int = 2000,
    tolerance: float = 1e-8,
    stationarity: float = 1e-7,
) -> Solution:
    """Minimise cost(x) subject to constraints(x) <= 0 in a box; traced.

    Args: cost, x (k,) -> scalar; constraints, x -> (c,); start, lower, upper (k,); rounds of the outer iteration;
        evaluations, the largest number of them in one round; tolerance on the violation; stationarity, the tolerance
        on the residual (rounding of L keeps it above about 1e-8).
    """

    def advance(carry):
        x, multipliers, penalty, before, _, spent, count = carry
        search = _minimise_lagrangian(
            cost, constraints, x, multipliers, penalty, lower, upper, evaluations, stationarity
        )
        h = constraints(search.point)
        violation = jnp.max(jnp.abs(jnp.maximum(h, -multipliers / penalty)), initial=0.0)
        multipliers = jnp.clip(multipliers + penalty * h, 0.0, PENALTY_MAX)
        slow = violation > 0.5 * before
        grown = jnp.minimum(penalty * PENALTY_GROWTH, PENALTY_MAX)
        penalty = jnp.where(slow, grown, penalty)
        spent = spent + search.evaluations
        return search.point, multipliers, penalty, violation, search.residual, spent, count + 1

    def going(carry):
        _, _, _, violation, residual, _, count = carry
        return ((violation > tolerance) | (residual > stationarity)) & (count < rounds)

    start = project_box(start, lower, upper)
    zero = jnp.zeros((), dtype=jnp.int32)
    infinite = jnp.full((), jnp.inf, dtype=start.dtype)
    first = jnp.zeros_like(constraints(start))
    penalty = jnp.full((), PENALTY_START, dtype=start.dtype)
    carry = (start, first, penalty, infinite, infinite, zero, zero)
    x, multipliers, _, violation, residual, spent, _ = jax.lax.while_loop(going, advance, carry)
    converged = (violation <= tolerance) & (residual <= stationarity)
    return Solution(x, cost(x), multipliers, violation, residual, spent, converged)


def _minimise_lagrangian(
    cost, constraints, start, multipliers, penalty, lower, upper, evaluations, stationarity
) -> Search:
    """Minimum of L in the box for given multipliers and penalty; traced."""

    def lagrangian(x):
        shifted = jnp.maximum(0.0, multipliers + penalty * constraints(x))
        return cost(x) + 0.5 / penalty * jnp.sum(shifted**2 - multipliers**2)

    def function(x):
        value, gradient = jax.value_and_grad(lagrangian)(x)
        return -value, -gradient

    return climb(
        function,
        lambda y: project_box(y, lower, upper),
        start,
        evaluations=evaluations,
        tolerance=stationarity,
    )
