"""Symmetric block-tridiagonal linear systems: the equations of a link's rfes, each coupled to its neighbours.

Place in the pipeline: algebra -> **block_tridiagonal** -> condensation, newton.

The block Thomas algorithm (theory (7.14), (7.15); Golub and Van Loan, Matrix Computations, 2013, section 4.5)
on blocks of up to `BLOCK` rfes: the inverse of a block is a dense matrix, which a processor applies fastest to
many samples at once, and neighbouring blocks are coupled by their adjacent rfes only.  Work and memory
thus grow with the number of rfes, not with its square.

Vectors of a block are flat, component by component: all rfes' first components, all second ones, and so on.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from rfem_jax.mechanics.algebra import vectors
from rfem_jax.mechanics.algebra.vectors import by_component, constant_product

BLOCK = 8  # rfes, at most


class Factored(NamedTuple):
    """A factored system in n blocks of g rfes; the last block is padded with uncoupled rfes. One block may be of any
    size.

    inverse (n, 6 g, 6 g): of each diagonal block after elimination of the blocks before it; from_before,
    from_after (n, 6 g, 6): change of a block's solution per unit solution of the last rfe of the block
    before, of the first rfe of the block after (None where there is one block).
    """

    inverse: Float[Array, "blocks size size"]
    from_before: Float[Array, "blocks size 6"] | None
    from_after: Float[Array, "blocks size 6"] | None


def partition(m: int) -> tuple[int, int]:
    """Number of blocks, and rfes in each, of a system of m rfes."""
    count = -(-m // BLOCK)
    return count, -(-m // count)


def factor(diagonal: Float[Array, "m 6 6"], lower: Float[Array, "m 6 6"]) -> Factored:
    """Factor a positive definite system: `diagonal` couples every rfe with itself, `lower` every rfe (rows)
    with the one before it (columns; the first entry is ignored)."""
    n, g = partition(diagonal.shape[0])
    lower = jnp.concatenate([jnp.zeros((1, 6, 6)), lower[1:]])
    if n == 1:
        return Factored(_inverse(diagonal, lower)[None], None, None)
    padding = n * g - len(diagonal), 6, 6
    diagonal = jnp.concatenate([diagonal, jnp.broadcast_to(jnp.eye(6), padding)]).reshape(n, g, 6, 6)
    lower = jnp.concatenate([lower, jnp.zeros(padding)]).reshape(n, g, 6, 6)
    left = lower[:, 0]
    right = jnp.concatenate([left[1:], jnp.zeros((1, 6, 6))])

    def eliminate(corner, block):
        """`corner`: the last rfe's part of the inverse of the block before."""
        diagonal, lower, left, right = block
        diagonal = jnp.concatenate([diagonal[:1] - (left @ corner @ left.T)[None], diagonal[1:]])
        inverse = _inverse(diagonal, lower)
        first, last = inverse[:, ::g], inverse[:, g - 1 :: g]
        return last[g - 1 :: g], Factored(inverse, first @ left, last @ right.T)

    return jax.lax.scan(eliminate, jnp.zeros((6, 6)), (diagonal, lower, left, right))[1]


def solve(factored: Factored, loads: Float[Array, "6 m *columns"]) -> Float[Array, "6 m *columns"]:
    """Solution for one or more columns of loads."""
    m, n, g = loads.shape[1], factored.inverse.shape[0], factored.inverse.shape[1] // 6
    if n == 1:
        return _split_by_rfe(constant_product(factored.inverse[0], by_component(loads)))
    padding = jnp.zeros((6, n * g - m) + loads.shape[2:])
    loads = jnp.concatenate([loads, padding], axis=1).reshape((6, n, g) + loads.shape[2:])

    def eliminate(before, block):
        inverse, from_before, load = block
        solution = constant_product(inverse, by_component(load)) - constant_product(from_before, before)
        return _split_by_rfe(solution)[:, -1], solution

    def substitute(after, block):
        from_after, solution = block
        solution = _split_by_rfe(solution - constant_product(from_after, after))
        return solution[:, 0], solution

    zero = jnp.zeros_like(loads[:, 0, 0])
    by_block = factored.inverse, factored.from_before, jnp.moveaxis(loads, 1, 0)
    _, eliminated = jax.lax.scan(eliminate, zero, by_block)
    _, solved = jax.lax.scan(substitute, zero, (factored.from_after, eliminated), reverse=True)
    return jnp.moveaxis(solved, 0, 1).reshape((6, n * g) + loads.shape[3:])[:, :m]


def _split_by_rfe(vector: Float[Array, " size *columns"]) -> Float[Array, "6 g *columns"]:
    """A flat vector (6 g, ...) as (6, g, ...)."""
    return vector.reshape((6, vector.shape[0] // 6) + vector.shape[1:])


def _inverse(diagonal: Float[Array, "g 6 6"], lower: Float[Array, "g 6 6"]) -> Float[Array, "size size"]:
    """Inverse (6 g, 6 g) of one block, component by component.

    Without LAPACK, whose batched calls for several links could deadlock on few threads.
    """
    g = diagonal.shape[0]
    columns = jnp.eye(6 * g).reshape(g, 6, 6 * g)

    def eliminate(above, row):
        inverse, eliminated = above
        diagonal, lower, column = row
        factor = lower @ inverse
        inverse = vectors.invert_positive(diagonal - factor @ lower.T)
        row = inverse, column - factor @ eliminated
        return row, row

    def substitute(below, row):
        solved, lower_below = below
        inverse, eliminated, lower = row
        solved = inverse @ (eliminated - lower_below.T @ solved)
        return (solved, lower), solved

    zero = jnp.zeros((6, 6)), jnp.zeros((6, 6 * g))
    _, (inverses, eliminated) = jax.lax.scan(eliminate, zero, (diagonal, lower, columns))
    below = zero[1], zero[0]
    _, rows = jax.lax.scan(substitute, below, (inverses, eliminated, lower), reverse=True)
    rows = by_component(rows.swapaxes(0, 1))
    return rows.reshape(6 * g, g, 6).swapaxes(1, 2).reshape(6 * g, 6 * g)
