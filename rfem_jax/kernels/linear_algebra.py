"""Factors of matrices, triangular systems and singular values by operations of their entries, in loops over rows.

Place in the pipeline: emission -> **linear_algebra**, which says there what LAPACK's primitives of JAX are made of.

For matrices of up to some tens of rows: a turn of a loop has an operation for every entry of the matrix, so that the
code grows with the square of their number.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from rfem_jax.kernels.emission import expand_primitive

ORTHOGONAL = 1e-15  # cosine of the angle between columns below which they are not turned
SMALLEST = 1e-290  # product of columns of entries of at most one, in which rounding is all that is left
MOST_SWEEPS = 40  # over all pairs; some ten are enough


def factors(matrix: Array, **others: object) -> tuple[Array, Array, Array]:
    """LU factors (rows, columns) in one matrix, pivots and permutation of the rows, with partial pivoting; any leading
    axes."""
    if matrix.ndim > 2:
        return jax.vmap(factors)(matrix)
    rows, columns = matrix.shape
    if not matrix.size:
        return matrix, jnp.zeros(0, jnp.int32), jnp.arange(rows, dtype=jnp.int32)
    i, j = jnp.arange(rows, dtype=jnp.int32), jnp.arange(columns, dtype=jnp.int32)
    count = min(rows, columns)

    def eliminate(k, carry):
        a, pivots, order = carry
        column = jax.lax.dynamic_slice(a, (jnp.int32(0), k), (rows, 1))[:, 0]
        size = jnp.where(i >= k, jnp.abs(column), -1.0)
        largest = jnp.min(jnp.where(size == jnp.max(size), i, rows - 1).astype(jnp.float64)).astype(jnp.int32)
        largest = jnp.maximum(largest, k)  # of what is not a number
        a, order = _exchanged(a, k, largest, i), _exchanged(order, k, largest, i)
        row = jax.lax.dynamic_slice(a, (k, jnp.int32(0)), (1, columns))[0]
        column = jax.lax.dynamic_slice(a, (jnp.int32(0), k), (rows, 1))[:, 0]
        pivot = jax.lax.dynamic_slice(row, (k,), (1,))[0]
        below = i > k
        factor = jnp.where(below & (pivot != 0.0), column / jnp.where(pivot == 0.0, 1.0, pivot), 0.0)
        a = jnp.where(below[:, None] & (j > k)[None], a - factor[:, None] * row[None], a)
        a = jnp.where(below[:, None] & (j == k)[None], factor[:, None], a)
        return a, jnp.where(j[:count] == k, largest, pivots), order

    start = matrix, jnp.zeros(count, jnp.int32), i
    carry, _ = jax.lax.scan(lambda carry, k: (eliminate(k, carry), None), start, jnp.arange(count, dtype=jnp.int32))
    return carry


def _exchanged(rows: Array, k: Array, other: Array, i: Array) -> Array:
    """Two rows exchanged."""
    zeros = (jnp.int32(0),) * (rows.ndim - 1)
    first, second = (jax.lax.dynamic_slice(rows, (at, *zeros), (1, *rows.shape[1:])) for at in (k, other))
    at = i.reshape(-1, *(1,) * (rows.ndim - 1))
    return jnp.where(at == k, second, jnp.where(at == other, first, rows))


def solved(
    matrix: Array,
    right: Array,
    *,
    left_side: bool,
    lower: bool,
    transpose_a: bool,
    unit_diagonal: bool,
    **others: object,
) -> Array:
    """Solution of triangular equations; any leading axes."""
    if matrix.ndim > 2:
        settings = {"left_side": left_side, "lower": lower, "transpose_a": transpose_a, "unit_diagonal": unit_diagonal}
        return jax.vmap(lambda a, b: solved(a, b, **settings))(matrix, right)
    if transpose_a:
        matrix, lower = matrix.T, not lower
    if not left_side:
        matrix, right, lower = matrix.T, right.T, not lower
    n = matrix.shape[0]
    if not right.size:
        return right if left_side else right.T
    i = jnp.arange(n, dtype=jnp.int32)

    def substitute(x, k):
        row = jax.lax.dynamic_slice(matrix, (k, jnp.int32(0)), (1, n))[0]
        value = jax.lax.dynamic_slice(right, (k, jnp.int32(0)), (1, right.shape[1]))[0]
        known = jnp.where(i < k if lower else i > k, row, 0.0)
        value = value - jnp.sum(known[:, None] * x, axis=0)
        if not unit_diagonal:
            value = value / jax.lax.dynamic_slice(row, (k,), (1,))
        return jnp.where((i == k)[:, None], value[None], x), None

    x, _ = jax.lax.scan(substitute, jnp.zeros_like(right), i, reverse=not lower)
    return x if left_side else x.T


def singular_values(
    matrix: Array, *, full_matrices: bool, compute_uv: bool, subset_by_index: object, **others: object
) -> list[Array]:
    """Singular values, the largest first, and if wanted singular vectors (columns of U, rows of V^T); any leading axes.

    By Jacobi's rotations of the columns, one pair after the other, until all are orthogonal (Demmel and Veselic, 1992:
    small singular values to as many digits as the matrix has). U is the orthogonal factor of these columns, so that it
    has all of its columns also where singular values are zero.

    **Raises:** NotImplementedError where only some singular values are wanted.
    """
    if subset_by_index is not None:
        raise NotImplementedError("a part of the singular values")
    settings = {"full_matrices": full_matrices, "compute_uv": compute_uv, "subset_by_index": None}
    if matrix.ndim > 2:
        return jax.lax.map(lambda one: singular_values(one, **settings), matrix)
    rows, columns = matrix.shape
    if rows < columns:
        found = singular_values(matrix.T, **settings)
        return [found[0], found[2].T, found[1].T] if compute_uv else found
    scale = jnp.max(jnp.abs(matrix), initial=0.0)
    scale = jnp.where(scale > 0.0, scale, 1.0)
    images, right = _orthogonal_columns(matrix.T / scale)
    sizes = jnp.sqrt(jnp.sum(images**2, axis=1))
    order = jnp.argsort(-sizes)
    images, right, values = images[order], right[order], sizes[order] * scale
    right = jnp.where(jnp.isfinite(scale), right, jnp.nan)
    if not compute_uv:
        return [values]
    left = _orthogonal_factor(images.T)
    return [values, left if full_matrices else left[:, :columns], right]


def _orthogonal_columns(columns: Array) -> tuple[Array, Array]:
    """Columns (as rows) turned until they are orthogonal, and the rotation V^T: matrix = images^T V^T."""
    count = len(columns)
    i = jnp.arange(count, dtype=jnp.int32)[:, None]
    first, second = (jnp.asarray(x, jnp.int32) for x in np.triu_indices(count, 1))

    def row(rows: Array, place: Array) -> Array:
        return jax.lax.dynamic_slice(rows, (place, jnp.int32(0)), (1, rows.shape[1]))[0]

    def turn(carry, pair):
        a, v, worst = carry
        p, q = pair
        x, y = row(a, p), row(a, q)
        xx, yy, xy = jnp.sum(x * x), jnp.sum(y * y), jnp.sum(x * y)
        needed = (jnp.abs(xy) > ORTHOGONAL * jnp.sqrt(xx) * jnp.sqrt(yy)) & (jnp.abs(xy) > SMALLEST)
        zeta = (yy - xx) / (2.0 * jnp.where(needed, xy, 1.0))
        tangent = jnp.where(zeta < 0.0, -1.0, 1.0) / (jnp.abs(zeta) + jnp.sqrt(1.0 + zeta * zeta))
        tangent = jnp.where(needed, tangent, 0.0)
        cosine = 1.0 / jnp.sqrt(1.0 + tangent * tangent)

        def rotated(rows):
            x, y = row(rows, p), row(rows, q)
            at_p, at_q = cosine * (x - tangent * y), cosine * (tangent * x + y)
            return jnp.where(i == p, at_p, jnp.where(i == q, at_q, rows))

        return (rotated(a), rotated(v), worst | needed), None

    def sweep(carry):
        a, v, _, sweeps = carry
        (a, v, turned), _ = jax.lax.scan(turn, (a, v, jnp.zeros((), bool)), (first, second))
        return a, v, turned, sweeps + 1

    start = columns, jnp.eye(count), jnp.ones((), bool), jnp.int32(0)
    return jax.lax.while_loop(lambda carry: carry[2] & (carry[3] < MOST_SWEEPS), sweep, start)[:2]


def _orthogonal_factor(matrix: Array) -> Array:
    """Q (rows, rows) of a matrix = Q R with a diagonal of R that is not negative, by Householder's reflections."""
    rows, columns = matrix.shape
    i = jnp.arange(rows, dtype=jnp.int32)

    def reflect(carry, k):
        r, q = carry
        x = jax.lax.dynamic_slice(r, (jnp.int32(0), k), (rows, 1))[:, 0]
        x = jnp.where(i >= k, x, 0.0)
        head = jnp.sum(jnp.where(i == k, x, 0.0))
        size = jnp.sqrt(jnp.sum(x * x))
        sign = jnp.where(head < 0.0, -1.0, 1.0)
        v = x + jnp.where(i == k, sign * size, 0.0)
        square = jnp.sum(v * v)
        factor = jnp.where(square > 0.0, 2.0 / jnp.where(square > 0.0, square, 1.0), 0.0)
        r = r - factor * v[:, None] * (v @ r)[None]
        q = q - factor * (q @ v)[:, None] * v[None]
        return (r, q), jnp.where(square > 0.0, -sign, 1.0)

    (_, q), signs = jax.lax.scan(reflect, (matrix, jnp.eye(rows)), jnp.arange(columns, dtype=jnp.int32))
    return q * jnp.concatenate([signs, jnp.ones(rows - columns)])[None]


expand_primitive("lu", factors)
expand_primitive("triangular_solve", solved)
expand_primitive("svd", singular_values)
