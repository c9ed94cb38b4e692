"""Symmetric block-tridiagonal systems of which only some motions are free: links that neither stretch nor shear.

Place in the pipeline: block_tridiagonal -> **constrained_chain** -> condensation, articulated_links.

With the free motions N (6 m, 3 m) of m rfes the solution of a system S is N (N^T S N)^-1 N^T (theory (7.23)).  N^T S N
is dense: work grows with the cube of the number of rfes of such a link, which is small.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from rfem_jax.mechanics.algebra import block_tridiagonal, vectors
from rfem_jax.mechanics.algebra.block_tridiagonal import Factored
from rfem_jax.mechanics.algebra.vectors import by_component, constant_product


class ConstrainedChain(NamedTuple):
    """A factored system of m rfes: motions (6 m, d), component by component; matrix (d, d) of these motions, and its
    inverse."""

    motions: Float[Array, "elastic free"]
    matrix: Float[Array, "free free"]
    inverse: Float[Array, "free free"]


def factor_constrained(
    diagonal: Float[Array, "m 6 6"], lower: Float[Array, "m 6 6"], motions: Float[Array, "elastic free"]
) -> ConstrainedChain:
    """Factor a system as of `block_tridiagonal.factor`, positive definite on its motions."""
    m = len(diagonal)
    eye, below = np.eye(m), np.eye(m, k=-1)
    coupled = below[:, None, :, None] * lower[:, :, None]
    system = eye[:, None, :, None] * diagonal[:, :, None] + coupled + coupled.transpose(2, 3, 0, 1)
    system = system.transpose(1, 0, 3, 2).reshape(6 * m, 6 * m)
    matrix = motions.T @ system @ motions
    return ConstrainedChain(motions, matrix, positive_inverse(matrix))


def solve(factored: Factored | ConstrainedChain, loads: Float[Array, "6 m *columns"]) -> Float[Array, "6 m *columns"]:
    """Solution for one or more columns of loads."""
    if isinstance(factored, Factored):
        return block_tridiagonal.solve(factored, loads)
    along = constant_product(factored.motions.T, by_component(loads))
    return constant_product(factored.motions, constant_product(factored.inverse, along)).reshape(loads.shape)


def positive_inverse(matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """Inverse of a symmetric positive definite matrix whose size is a multiple of three, in a program of one size.

    By Gauss and Jordan's elimination of three rows at a time, without LAPACK (as in `block_tridiagonal`).
    """
    m = matrix.shape[0] // 3
    chosen = np.eye(m)[:, None, :, None] * np.eye(3)[None, :, None]  # (m, 3, m, 3): rows k, m + k, 2 m + k

    def eliminate(matrix, rows):
        eliminated, there = rows @ matrix, jnp.sum(rows, axis=0) > 0.0
        pivot = vectors.invert_block(eliminated @ rows.T)
        across = pivot @ eliminated
        others = matrix - eliminated.T @ across
        # What was eliminated stands with the opposite sign in its rows and columns, so that all remains symmetric.
        swept = jnp.where(there[:, None], rows.T @ across, jnp.where(there[None], across.T @ rows, others))
        return jnp.where(there[:, None] & there[None], -(rows.T @ pivot @ rows), swept), None

    rows = jnp.asarray(chosen.transpose(0, 1, 3, 2).reshape(m, 3, 3 * m))
    return -jax.lax.scan(eliminate, matrix, rows)[0]
