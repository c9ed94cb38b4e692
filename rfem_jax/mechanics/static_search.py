"""Newton's method for static equations, and the solution of their linear ones.

Place in the pipeline: static_matrix -> **static_search** -> statics.

When to stop: the residual of a slender beam does not go below EA/Delta times the rounding of
positions, far above any fixed fraction of its bending forces (EI/L^2), while the positions that it
stands for are known to their last digits. So Newton's step is judged, relative to length and
radian, and every residual relative to what a change of that size would make of it (its own row of
the matrix; theory (6.2)).

Where the links' structure gives nearly the inverse of the matrix, that is applied again and again until little is
left over.  Only where it does not lead there is the matrix itself formed, in a loop that is not entered otherwise:
a batch pays for it only if one of its samples needs it.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

TOLERANCE = 1e-10
SMALLEST_SINGULAR_VALUE = 1e-9  # of the largest, where equations contradict each other
MAX_ITERATIONS = 50
# With a constant slope a step is no smaller than the next one by much: it must be down to rounding.
CHORD_TOLERANCE, CHORD_ITERATIONS = 1e-14, 30
# A multiplier's adjoint is as much larger than others as springs are stiff: these need all digits of it.
LINEAR_TOLERANCE, ADJOINT_TOLERANCE, LARGEST_LINEAR_ERROR, LINEAR_ITERATIONS = 1e-12, 1e-16, 1e-11, 40
ITERATIONS_OF_A_STEP = 15
MAX_LOAD_STEPS = 60
SMALLEST_LOAD_STEP = 1e-3
LARGEST_TURN_OF_A_STEP = 0.7


class Equations(NamedTuple):
    """Residual of (unknowns, args), coordinates of the unknowns, how many they are (multipliers
    follow), and the solver (matrix, values -> unknowns) of the linearised equations.

    Not lineax's: it ends the whole batch where the cotangent of a failed sample is NaN."""

    residual: Callable
    coordinates: Callable
    n_coordinates: int
    solve: Callable


def chord(equations: Equations, inverse: Callable, rows: Array, start: Array, args):
    """Unknowns and whether they were found, with nearly the `inverse` of the matrix, whose entries sum to `rows`,
    as far as that leads, then by Newton's method."""
    n = equations.n_coordinates

    def constant(unknowns):
        value = equations.residual(unknowns, args)
        loaded = 1.0 + jnp.max(jnp.abs(unknowns[n:]), initial=0.0)
        return value, inverse(value), rows * loaded

    near, found = _iterate(n, start, CHORD_ITERATIONS, constant, tolerance=CHORD_TOLERANCE)
    return newton(equations, jnp.where(found, near, start), args, found=found)


def solve_dense(equations: Equations, slope: Callable, value: Array) -> Array:
    """Solution of slope(x) = value, a linear function."""
    return equations.solve(_linearised(slope, jnp.zeros_like(value))[1], value)


def solve_linear(equations: Equations, inverse: Callable, slope: Callable, value: Array) -> Array:
    """`solve_dense` with nearly the `inverse` of the function, as far as that leads."""

    def refined(inverse, tolerance):
        def solved(slope, value):
            x, found = _refine(slope, value, inverse, tolerance)

            def instead(_):
                return solve_dense(equations, slope, value), jnp.ones((), bool)

            hopeless = ~jnp.all(jnp.isfinite(value))
            return jax.lax.while_loop(lambda carry: ~carry[1], instead, (x, found | hopeless))[0]

        return solved

    transposed = jax.linear_transpose(inverse, value)
    return jax.lax.custom_linear_solve(
        slope,
        value,
        refined(inverse, LINEAR_TOLERANCE),
        transpose_solve=refined(lambda value: transposed(value)[0], ADJOINT_TOLERANCE),
    )


def _refine(slope: Callable, value: Array, inverse: Callable, tolerance: float):
    """Solution by corrections with nearly the inverse, as long as they become smaller and until the next one would
    be small, and whether it is."""

    def size(x):
        return jnp.max(jnp.abs(x))

    def next_is_small(tolerance, x, moved, before):
        """Corrections become smaller by nearly the same factor every time."""
        return moved * moved <= tolerance * size(x) * before

    def going_on(carry):
        *found, count = carry
        _, moved, before = found
        # Only the second correction moves what follows angles that the first has moved.
        shrinking = (moved < before) | (count < 3)
        return ~next_is_small(tolerance, *found) & shrinking & (count < LINEAR_ITERATIONS)

    def improve(carry):
        x, moved, _, count = carry
        change = inverse(value - slope(x))
        return x + change, size(change), moved, count + 1

    first = inverse(value)
    carry = (first, size(first), size(first), jnp.ones((), jnp.int32))
    *found, _ = jax.lax.while_loop(going_on, improve, carry)
    return found[0], next_is_small(LARGEST_LINEAR_ERROR, *found)


def _linearised(function: Callable, at: Array, *others) -> tuple[Array, Array]:
    """Value and matrix of a function at one place; formed where that stands: much of the matrix is constant, and
    XLA would take it out of a loop that is seldom entered."""
    rows, at, others = jax.lax.optimization_barrier((jnp.arange(at.size), at, others))
    units = (rows[:, None] == rows[None]).astype(at.dtype)
    value, push = jax.linearize(lambda x: function(x, *others), at)
    return value, jax.vmap(push, out_axes=1)(units)


def newton(equations: Equations, start: Array, args, iterations=MAX_ITERATIONS, found=False):
    """Unknowns after Newton's method and whether it converged; nothing is done if `found`."""

    n = equations.n_coordinates

    def present(unknowns):
        value, slope = _linearised(equations.residual, unknowns, args)
        size = jnp.concatenate([jnp.ones(n), 1.0 + jnp.abs(unknowns[n:])])
        return value, equations.solve(slope, value), jnp.abs(slope) @ size

    return _iterate(n, start, iterations, present, found)


def _iterate(n: int, start: Array, iterations: int, step_from, found=False, tolerance=TOLERANCE):
    """Unknowns, `n` of them coordinates, after steps from `step_from` (unknowns -> residual, step, and what a
    step of size one makes of the residual), and whether they converged.

    The last step must be small in the coordinates (multipliers follow them: their rounding is that
    of the stiffest spring), and the residual before it small in every row against what such a
    change of the coordinates makes of it; the latter fails where equations contradict each other.
    """

    def going_on(carry):
        unknowns, converged, count = carry
        return ~converged & jnp.all(jnp.isfinite(unknowns)) & (count < iterations)

    def improve(carry):
        unknowns, _, count = carry
        value, step, rows = step_from(unknowns)
        small = jnp.max(jnp.abs(step[:n])) <= tolerance
        balanced = jnp.all(jnp.abs(value) <= TOLERANCE * rows)
        return unknowns - step, small & balanced, count + 1

    carry = (start, jnp.asarray(found), jnp.zeros((), jnp.int32))
    unknowns, converged, _ = jax.lax.while_loop(going_on, improve, carry)
    return unknowns, converged


def load_steps(equations: Equations, start: Array, at_rest, loaded):
    """Unknowns of the equilibrium under full load, followed from the one at rest, and whether it was
    reached.

    Errors, gravity and held angles grow together from nothing by a share: all at once first; a step
    on which Newton's method does not converge, or lands more than a moderate turn of an rfe away
    (on another equilibrium), is halved, any other is followed by one twice as long. The constants
    of the mechanism are interpolated, so that on the way its frames are turned to second order in
    the errors only.
    """

    def going_on(carry):
        _, reached, step, count = carry
        return (reached < 1.0) & (step > SMALLEST_LOAD_STEP) & (count < MAX_LOAD_STEPS)

    def advance(carry):
        unknowns, reached, step, count = carry
        share = jnp.minimum(reached + step, 1.0)
        args = jax.tree.map(lambda a, b: a + share * (b - a), at_rest, loaded)
        new, found = newton(equations, unknowns, args, ITERATIONS_OF_A_STEP)
        turn = equations.coordinates(new - unknowns).elastic[3:]
        found = found & (jnp.max(jnp.abs(turn), initial=0.0) < LARGEST_TURN_OF_A_STEP)
        return (
            jnp.where(found, new, unknowns),
            jnp.where(found, share, reached),
            jnp.where(found, 2.0 * step, 0.5 * step),
            count + 1,
        )

    one = jnp.ones(())
    carry = (start, 0.0 * one, one, jnp.zeros((), jnp.int32))
    unknowns, reached, _, _ = jax.lax.while_loop(going_on, advance, carry)
    return unknowns, reached >= 1.0


def least_squares(matrix: Array, value: Array) -> Array:
    """The shortest solution of equations that may contradict each other."""
    return jnp.linalg.pinv(matrix, rtol=SMALLEST_SINGULAR_VALUE) @ value
