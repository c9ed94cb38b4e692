"""Linear equations of a chain of rfes, each coupled to its neighbours: symmetric, block tridiagonal.

The chain is cut into segments.  Within one the inverse is a dense matrix, which a processor applies fastest
to many samples at once; from segment to segment only what the rfes beside the cut do is handed on: forwards
to eliminate, backwards to substitute.  Work and memory thus grow with the number of rfes, not with its
square.

Vectors of a segment are flat, component by component: all rfes' first components, all second ones, and so on.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from rfem_jax.mechanics import algebra

SEGMENT = 8  # rfes, at most


class Segment(NamedTuple):
    """g rfes of a chain: inverse (6 g, 6 g) of their equations, with those of the segments before eliminated;
    from_before, from_after (6 g, 6): what the last rfe of the segment before, the first of that after, take
    from the solution (None at the chain's ends)."""

    inverse: Array
    from_before: Array | None
    from_after: Array | None


def segment_ranges(m: int) -> tuple[tuple[int, int], ...]:
    """First rfe of every segment and the one behind its last, in a chain of m: equally long as far as possible."""
    bounds = np.linspace(0, m, -(-m // SEGMENT) + 1).round().astype(int).tolist()
    return tuple(zip(bounds[:-1], bounds[1:]))


def factor(diagonal: Array, beside: Array) -> tuple[Segment, ...]:
    """Segments of a positive definite chain of m rfes: diagonal blocks (m, 6, 6), and those on their left,
    beside (m, 6, 6) (the first one counts for nothing)."""
    m = diagonal.shape[0]
    segments = []
    corner = None
    for a, b in segment_ranges(m):
        g = b - a
        own, left = diagonal[a:b], beside[a]
        if corner is not None:
            own = own.at[0].add(-left @ corner @ left.T)
        inverse = _inverse(own, beside[a:b])
        first, last = inverse[:, ::g], inverse[:, g - 1 :: g]
        segments.append(
            Segment(
                inverse,
                from_before=None if a == 0 else first @ left,
                from_after=None if b == m else last @ beside[b].T,
            )
        )
        corner = last[g - 1 :: g]
    return tuple(segments)


def solve(segments: tuple[Segment, ...], loads: Array) -> Array:
    """Solution for loads (6, m, ...)."""
    solved: list[Array] = []
    for segment, (a, b) in zip(segments, segment_ranges(loads.shape[1])):
        own = _times(segment.inverse, _flat(loads[:, a:b]))
        if solved:
            own = own - _times(segment.from_before, _by_rfe(solved[-1])[:, -1])
        solved.append(own)
    for i in reversed(range(len(segments) - 1)):
        solved[i] = solved[i] - _times(segments[i].from_after, _by_rfe(solved[i + 1])[:, 0])
    return jnp.concatenate([_by_rfe(x) for x in solved], axis=1)


def _by_rfe(vector: Array) -> Array:
    """A flat vector (6 g, ...) as (6, g, ...)."""
    return vector.reshape((6, vector.shape[0] // 6) + vector.shape[1:])


def _flat(values: Array) -> Array:
    return values.reshape((6 * values.shape[1],) + values.shape[2:])


def _times(matrix: Array, vector: Array) -> Array:
    return jnp.tensordot(matrix, vector, axes=1)


def _inverse(diagonal: Array, beside: Array) -> Array:
    """Inverse (6 g, 6 g), component by component.

    LAPACK's batched calls for several links could wait for each other for ever on few threads.
    """
    g = diagonal.shape[0]
    beside = beside.at[0].set(0.0)
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
    rows = _flat(rows.swapaxes(0, 1))
    return rows.reshape(6 * g, g, 6).swapaxes(1, 2).reshape(6 * g, 6 * g)
