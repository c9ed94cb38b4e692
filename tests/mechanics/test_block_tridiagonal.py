"""Factored block-tridiagonal systems against the dense matrix they stand for."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfem_jax.mechanics.algebra import block_tridiagonal


def blocks(m: int):
    """Diagonal and lower blocks of a positive definite system; the first lower block is ignored."""
    rng = np.random.default_rng(m)
    lower = rng.normal(size=(m, 6, 6))
    root = rng.normal(size=(m, 6, 6))
    return root @ root.swapaxes(1, 2) + 30.0 * np.eye(6), lower


def dense(diagonal, lower):
    m = len(diagonal)
    matrix = np.zeros((m, 6, m, 6))
    for k in range(m):
        matrix[k, :, k] = diagonal[k]
        if k > 0:
            matrix[k, :, k - 1] = lower[k]
            matrix[k - 1, :, k] = lower[k].T
    return matrix.reshape(6 * m, 6 * m)


@pytest.mark.slow
@pytest.mark.parametrize("m", [1, 8, 9, 29])
def test_solution_of_a_system(m):
    diagonal, lower = blocks(m)
    loads = np.random.default_rng(7).normal(size=(6, m, 2))
    flat = np.linalg.solve(dense(diagonal, lower), loads.swapaxes(0, 1).reshape(6 * m, 2))
    expected = flat.reshape(m, 6, 2).swapaxes(0, 1)
    factored = block_tridiagonal.factor(jnp.asarray(diagonal), jnp.asarray(lower))
    np.testing.assert_allclose(block_tridiagonal.solve(factored, jnp.asarray(loads)), expected, atol=1e-13)


def test_work_grows_with_the_number_of_rfes():
    """Blocks hold all rfes and fewer of padding than there are blocks; numbers grow in proportion to rfes."""
    for m in (1, 7, 8, 9, 20, 64, 65):
        n, g = block_tridiagonal.partition(m)
        assert g <= block_tridiagonal.BLOCK and m <= n * g < m + n

    def numbers(m):
        shapes = jax.eval_shape(block_tridiagonal.factor, *map(jnp.asarray, blocks(m)))
        return sum(x.size for x in jax.tree.leaves(shapes))

    assert numbers(64) - numbers(32) == numbers(96) - numbers(64)
