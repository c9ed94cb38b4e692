"""Linear equations of a chain of rfes, each coupled to its neighbours: symmetric, block tridiagonal.

The chain is cut into segments.  Within one the inverse is a dense matrix, which a processor applies fastest
to many samples at once; from segment to segment only what the rfes beside the cut do is handed on: forwards
to eliminate, backwards to substitute (theory (7.14), (7.15)).  Work and memory thus grow with the number of
rfes, not with its square.

Vectors of a segment are flat, component by component: all rfes' first components, all second ones, and so on.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from rfem_jax.mechanics import algebra
from rfem_jax.mechanics.algebra import by_component, constant_product

SEGMENT = 8  # rfes, at most


class Chain(NamedTuple):
    """A factored chain in n segments of g rfes; the last one is filled up with rfes that nothing couples.

    inverse (n, 6 g, 6 g) of a segment's equations, with those of the segments before eliminated; from_before,
    from_after (n, 6 g, 6): what the last rfe of the segment before, the first of that after, take from the
    solution (None where there is one segment).
    """

    inverse: Array
    from_before: Array | None
    from_after: Array | None


def segments(m: int) -> tuple[int, int]:
    """Number of segments, and rfes in each, of a chain of m rfes."""
    count = -(-m // SEGMENT)
    return count, -(-m // count)


def factor(diagonal: Array, beside: Array) -> Chain:
    """A positive definite chain of m rfes: diagonal blocks (m, 6, 6), and those on their left, beside (m, 6, 6)
    (the first one counts for nothing)."""
    n, g = segments(diagonal.shape[0])
    beside = jnp.concatenate([jnp.zeros((1, 6, 6)), beside[1:]])
    if n == 1:
        return Chain(_inverse(diagonal, beside)[None], None, None)
    more = n * g - len(diagonal), 6, 6
    diagonal = jnp.concatenate([diagonal, jnp.broadcast_to(jnp.eye(6), more)]).reshape(n, g, 6, 6)
    beside = jnp.concatenate([beside, jnp.zeros(more)]).reshape(n, g, 6, 6)
    left = beside[:, 0]
    right = jnp.concatenate([left[1:], jnp.zeros((1, 6, 6))])

    def eliminate(corner, segment):
        own, beside, left, right = segment
        own = jnp.concatenate([own[:1] - (left @ corner @ left.T)[None], own[1:]])
        inverse = _inverse(own, beside)
        first, last = inverse[:, ::g], inverse[:, g - 1 :: g]
        return last[g - 1 :: g], Chain(inverse, first @ left, last @ right.T)

    return jax.lax.scan(eliminate, jnp.zeros((6, 6)), (diagonal, beside, left, right))[1]


def solve(chain: Chain, loads: Array) -> Array:
    """Solution for loads (6, m, ...)."""
    m = loads.shape[1]
    n, g = segments(m)
    if n == 1:
        return _by_rfe(constant_product(chain.inverse[0], by_component(loads)))
    more = jnp.zeros((6, n * g - m) + loads.shape[2:])
    loads = jnp.concatenate([loads, more], axis=1).reshape((6, n, g) + loads.shape[2:])

    def eliminate(before, segment):
        inverse, from_before, load = segment
        own = constant_product(inverse, by_component(load)) - constant_product(from_before, before)
        return _by_rfe(own)[:, -1], own

    def substitute(after, segment):
        from_after, own = segment
        own = _by_rfe(own - constant_product(from_after, after))
        return own[:, 0], own

    nothing = jnp.zeros_like(loads[:, 0, 0])
    by_segment = chain.inverse, chain.from_before, jnp.moveaxis(loads, 1, 0)
    _, own = jax.lax.scan(eliminate, nothing, by_segment)
    _, solved = jax.lax.scan(substitute, nothing, (chain.from_after, own), reverse=True)
    return jnp.moveaxis(solved, 0, 1).reshape((6, n * g) + loads.shape[3:])[:, :m]


def _by_rfe(vector: Array) -> Array:
    """A flat vector (6 g, ...) as (6, g, ...)."""
    return vector.reshape((6, vector.shape[0] // 6) + vector.shape[1:])


def _inverse(diagonal: Array, beside: Array) -> Array:
    """Inverse (6 g, 6 g), component by component.

    LAPACK's batched calls for several links could wait for each other for ever on few threads.
    """
    g = diagonal.shape[0]
    columns = jnp.eye(6 * g).reshape(g, 6, 6 * g)

    def eliminate(above, row):
        inverse, eliminated = above
        diagonal, beside, column = row
        factor = beside @ inverse
        inverse = algebra.invert_positive(diagonal - factor @ beside.T)
        row = inverse, column - factor @ eliminated
        return row, row

    def substitute(below, row):
        solved, beside_below = below
        inverse, eliminated, beside = row
        solved = inverse @ (eliminated - beside_below.T @ solved)
        return (solved, beside), solved

    zero = jnp.zeros((6, 6)), jnp.zeros((6, 6 * g))
    _, (inverses, eliminated) = jax.lax.scan(eliminate, zero, (diagonal, beside, columns))
    below = zero[1], zero[0]
    _, rows = jax.lax.scan(substitute, below, (inverses, eliminated, beside), reverse=True)
    rows = by_component(rows.swapaxes(0, 1))
    return rows.reshape(6 * g, g, 6).swapaxes(1, 2).reshape(6 * g, 6 * g)
