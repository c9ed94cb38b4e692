"""Whether a matrix is positive among the vectors that linear constraints leave, and its lowest direction if not.

Place in the pipeline: **definiteness** -> equilibrium_stability.

Of elimination and products alone, in loops of known length, so that it is part of a kernel: an eigenvalue solver is
not. What stiffness there is suffices to say that a matrix is positive; its lowest direction is sought, at the price of
some tens of products of matrices, only where it is not.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float

NEW = 1e-9  # part of a row of length one that is not in those before it, below which it says nothing new
SQUARINGS = 36  # separate directions whose values differ by 1e-10 of the largest


def orthonormal_rows(rows: Float[Array, "c n"]) -> Float[Array, "c n"]:
    """Orthonormal rows with the span of the given ones, zeros in the places of those that say nothing new."""
    c = rows.shape[0]
    if c == 0:
        return rows
    sizes = jnp.sqrt(jnp.sum(rows**2, axis=1))
    least = NEW * jnp.max(sizes)
    rows = rows / jnp.where(sizes > least, sizes, 1.0)[:, None] * jnp.where(sizes > least, 1.0, 0.0)[:, None]

    def one_more(rows, k):
        new = jax.lax.dynamic_index_in_dim(rows, k, keepdims=False)
        size = jnp.sqrt(jnp.sum(new**2))
        new = jnp.where(size > NEW, new / jnp.where(size > NEW, size, 1.0), 0.0)
        along = jnp.where(jnp.arange(c) == k, 0.0, rows @ new)
        others = rows - along[:, None] * new[None]
        return jnp.where((jnp.arange(c) == k)[:, None], new[None], others), None

    # A second time, since rounding is over the small part of a row that is new.
    return jax.lax.scan(one_more, rows, np.tile(np.arange(c), 2))[0]


def constrained(matrix: Float[Array, "n n"], rows: Float[Array, "c n"]) -> Float[Array, "n n"]:
    """The matrix on the null space of orthonormal (or zero) rows, and the identity across it."""
    if rows.shape[0] == 0:
        return matrix
    across, along = matrix @ rows.T, rows @ matrix
    return matrix - across @ rows - rows.T @ along + rows.T @ (rows @ across) @ rows + rows.T @ rows


def positive(matrix: Float[Array, "n n"], more: float | Float[Array, ""] = 0.0) -> Bool[Array, ""]:
    """Whether a symmetric matrix with `more` on its diagonal is positive definite: whether all pivots are."""
    n = matrix.shape[0]

    def eliminate(k, carry):
        rest, least = carry
        row = jax.lax.dynamic_index_in_dim(rest, k, keepdims=False)
        row = row + jnp.where(jnp.arange(n) == k, more, 0.0)
        pivot = jnp.sum(jnp.where(jnp.arange(n) == k, row, 0.0))
        least = jnp.minimum(least, pivot)
        row = row / jnp.sqrt(jnp.where(pivot > 0.0, pivot, 1.0))
        return rest - row[:, None] * row[None], least

    return jax.lax.fori_loop(0, n, eliminate, (matrix, jnp.full((), jnp.inf)))[1] > 0.0


def lowest_direction(matrix: Float[Array, "n n"]) -> tuple[Float[Array, ""], Float[Array, " n"], Float[Array, ""]]:
    """The eigenvalue with the smallest real part of a matrix of norm one at most, its eigenvector of length one, and
    what is left of (matrix - value) vector, which is not small where the eigenvalue is complex.

    By squaring the power method's matrix, normalised, again and again.
    """
    n = matrix.shape[0]

    def squared(_, power):
        power = power @ power
        return power / jnp.max(jnp.abs(power))

    by_rows = jnp.arange(n), matrix
    power = jax.lax.map(lambda own: jnp.where(jnp.arange(n) == own[0], 1.0, 0.0) - own[1], by_rows)
    power = jax.lax.fori_loop(0, SQUARINGS, squared, power)
    # The largest column, of which all others are nearly multiples; the last one of those that are as large.
    sizes = jnp.sum(power**2, axis=0) * (1.0 + 1e-9 * jnp.arange(n, dtype=float))
    vector = power @ jnp.where(sizes == jnp.max(sizes), 1.0, 0.0)
    vector = vector / jnp.sqrt(jnp.sum(vector**2))
    image = matrix @ vector
    value = vector @ image
    return value, vector, jnp.sqrt(jnp.sum((image - value * vector) ** 2))
