"""Augmented Lagrangian: minimise a smooth cost under inequalities, in a box.

Place in the pipeline: the solver under the allocation of tolerances; knows nothing of it.

    min c(x)   subject to   h(x) <= 0,   lower <= x <= upper
    L(x) = c + 1/(2 rho) sum( max(0, mu + rho h)^2 - mu^2 ),     mu <- max(0, mu + rho h)

The inner problem is solved by the spectral projected gradient of `projected_gradient`; the penalty
rho grows where the violation does not shrink. Scale c and h to the order of one.

Symbols: x (k,), h (c,), mu (c,) multipliers (dc/dh at the solution), rho penalty.
Source: theory (10.14); J. Nocedal, S. J. Wright, Numerical Optimization, 2nd ed. (2006), section 17.4; E. G.
Birgin, J. M. Martinez, Practical Augmented Lagrangian Methods (2014), algorithm 4.1 (rule for rho).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from rfem_jax.tolerancing.projected_gradient import climb, project_box

PENALTY_START, PENALTY_GROWTH, PENALTY_MAX = 10.0, 5.0, 1e8


class Solution(NamedTuple):
    """Minimum: point (k,), its cost, multipliers (c,), and how well the conditions hold.

    `violation` is the largest of h and of the complementarity |min(-h, mu/rho)|, `residual` the
    projected gradient of the Lagrangian, |P(x - grad L) - x|_inf.
    """

    point: jax.Array
    cost: jax.Array
    multipliers: jax.Array
    violation: jax.Array
    residual: jax.Array
    evaluations: jax.Array
    converged: jax.Array


def minimise(
    cost,
    constraints,
    start,
    lower,
    upper,
    *,
    rounds=40,
    evaluations=2000,
    tolerance=1e-8,
    stationarity=1e-7,
):
    """Minimise cost(x) subject to constraints(x) <= 0 in a box; traced.

    Args: cost x (k,) -> scalar; constraints x -> (c,); start, lower, upper (k,); rounds of the
        outer iteration; evaluations the most in one round; tolerance on the violation;
        stationarity, the tolerance on the residual (rounding of L keeps it above about 1e-8).
    Returns: Solution.
    """

    def lagrangian(x, multipliers, penalty):
        shifted = jnp.maximum(0.0, multipliers + penalty * constraints(x))
        return cost(x) + 0.5 / penalty * jnp.sum(shifted**2 - multipliers**2)

    def solve(x, multipliers, penalty):
        def function(y):
            value, gradient = jax.value_and_grad(lagrangian)(y, multipliers, penalty)
            return -value, -gradient

        return climb(
            function,
            lambda y: project_box(y, lower, upper),
            x,
            evaluations=evaluations,
            tolerance=stationarity,
        )

    def advance(carry):
        x, multipliers, penalty, before, _, spent, count = carry
        search = solve(x, multipliers, penalty)
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
