"""Factors of matrices and triangular systems by operations of their entries, in loops over rows.

Place in the pipeline: emission -> **linear_algebra**, which says there what LAPACK's primitives of JAX are made of.

For matrices of up to some tens of rows: a turn of a loop has an operation for every entry of the matrix, so that the
code grows with the square of their number.
"""

import jax
import jax.numpy as jnp
from jax import Array

from rfem_jax.kernels.emission import expand_primitive


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


expand_primitive("lu", factors)
expand_primitive("triangular_solve", solved)
