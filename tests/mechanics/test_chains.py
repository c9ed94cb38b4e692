"""Factored chains against the dense matrix they stand for."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfem_jax.mechanics import chains


def blocks(m: int):
    """Diagonal and neighbouring blocks of a positive definite chain; the first neighbour is no one."""
    rng = np.random.default_rng(m)
    beside = rng.normal(size=(m, 6, 6))
    root = rng.normal(size=(m, 6, 6))
    return root @ root.swapaxes(1, 2) + 30.0 * np.eye(6), beside


def dense(diagonal, beside):
    m = len(diagonal)
    matrix = np.zeros((m, 6, m, 6))
    for k in range(m):
        matrix[k, :, k] = diagonal[k]
        if k > 0:
            matrix[k, :, k - 1] = beside[k]
            matrix[k - 1, :, k] = beside[k].T
    return matrix.reshape(6 * m, 6 * m)


@pytest.mark.parametrize("m", [1, 8, 9, 29])
def test_solution_of_a_chain(m):
    diagonal, beside = blocks(m)
    loads = np.random.default_rng(7).normal(size=(6, m, 2))
    flat = np.linalg.solve(dense(diagonal, beside), loads.swapaxes(0, 1).reshape(6 * m, 2))
    expected = flat.reshape(m, 6, 2).swapaxes(0, 1)
    segments = chains.factor(jnp.asarray(diagonal), jnp.asarray(beside))
    np.testing.assert_allclose(chains.solve(segments, jnp.asarray(loads)), expected, atol=1e-13)


def test_segments_grow_in_number_only():
    """Every rfe is in one segment, and the numbers of a factored chain are as many for every rfe."""
    for m in (1, 7, 8, 9, 64, 65):
        ranges = chains.segment_ranges(m)
        assert [k for a, b in ranges for k in range(a, b)] == list(range(m))
        assert max(b - a for a, b in ranges) <= chains.SEGMENT

    def numbers(m):
        shapes = jax.eval_shape(chains.factor, *map(jnp.asarray, blocks(m)))
        return sum(x.size for x in jax.tree.leaves(shapes))

    assert numbers(64) - numbers(32) == numbers(96) - numbers(64)
