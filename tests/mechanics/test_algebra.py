"""Rotations, cross products, small inverses and picked columns against NumPy."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfem_jax.mechanics.algebra import vectors
from tests.processes import in_a_new_process

rng = np.random.default_rng(0)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_a_rotation_turns_about_its_axis_from_the_next_axis_to_the_one_after(axis):
    angles = rng.uniform(-3.0, 3.0, 4)
    found = np.asarray(vectors.rotation_about(axis, jnp.asarray(angles)))
    unit = np.eye(3)
    following, last = unit[(axis + 1) % 3], unit[(axis + 2) % 3]
    for k, angle in enumerate(angles):
        np.testing.assert_array_equal(found[:, :, k] @ unit[axis], unit[axis])
        np.testing.assert_allclose(
            found[:, :, k] @ following, np.cos(angle) * following + np.sin(angle) * last, atol=1e-16
        )
        np.testing.assert_allclose(found[:, :, k] @ found[:, :, k].T, unit, atol=1e-15)
        np.testing.assert_allclose(np.linalg.det(found[:, :, k]), 1.0, rtol=1e-14)


def test_the_outer_product_is_numpys():
    a, b = np.arange(1.0, 4.0), np.array([2.0, -1.0])
    np.testing.assert_array_equal(vectors.outer(a, b), np.outer(a, b))


def test_the_matrix_of_a_cross_product():
    a, b = rng.normal(size=(2, 3, 5))
    found = np.einsum("ijk,jk->ik", np.asarray(vectors.cross_matrix(jnp.asarray(a))), b)
    np.testing.assert_allclose(found, np.cross(a, b, axis=0), rtol=1e-14)


@pytest.mark.parametrize(("factors", "shape"), [((), (3,)), ((5,), (6, 5)), ((5,), (3, 1)), ((2, 1), (3, 2, 5))])
def test_vectors_are_scaled_by_factors_of_their_own(factors, shape):
    factor, vector = rng.normal(size=factors), rng.normal(size=shape)
    found = vectors.scaled(jnp.asarray(factor), jnp.asarray(vector))
    np.testing.assert_array_equal(found, factor[None] * vector)


@pytest.mark.parametrize("n", [1, 2, 3, 5, 8])
def test_inverses_of_positive_matrices(n):
    root = rng.normal(size=(4, n, n))
    matrices = root @ np.swapaxes(root, 1, 2) + np.eye(n)
    found = vectors.invert_positive(jnp.asarray(np.moveaxis(matrices, 0, -1)))
    np.testing.assert_allclose(np.moveaxis(np.asarray(found), -1, 0), np.linalg.inv(matrices), rtol=1e-9, atol=1e-12)


def test_the_inverse_of_a_matrix_that_is_not_symmetric():
    matrix = rng.normal(size=(3, 3))
    np.testing.assert_allclose(vectors.invert_block(jnp.asarray(matrix)), np.linalg.inv(matrix), rtol=1e-11)


@pytest.mark.parametrize("indices", [(), (2,), (0, 1, 2), (1, 3), (0, 3), (3, 1), (1, 1), (0, 1, 3)])
@pytest.mark.parametrize("axis", [-1, 1, 0])
def test_columns_are_those_of_numpy(indices, axis):
    values = rng.normal(size=(4, 4, 4))
    found = vectors.columns(jnp.asarray(values), indices, axis)
    np.testing.assert_array_equal(found, np.take(values, np.array(indices, int), axis=axis))


@pytest.mark.slow
@pytest.mark.parametrize(
    ("shape", "rank"),
    [((1, 1), 1), ((4, 4), 1), ((4, 4), 4), ((7, 3), 2), ((7, 3), 3), ((3, 7), 1), ((3, 7), 3), ((12, 13), 2),
     ((12, 13), 12), ((0, 3), 0), ((3, 0), 0)],
)  # fmt: skip
def test_pseudo_inverse(shape, rank):
    random = np.random.default_rng(3)
    factors = random.normal(size=(shape[0], rank)), random.normal(size=(rank, shape[1]))
    matrix, change = factors[0] @ factors[1], random.normal(size=(rank, shape[1]))
    # Along a change that keeps the rank.
    along = factors[0] @ change
    inverse = functools.partial(vectors.pseudo_inverse, smallest=1e-9)
    found, by_rule = jax.jit(lambda a, along: jax.jvp(inverse, (a,), (along,)))(matrix, along)
    np.testing.assert_allclose(found, np.linalg.pinv(matrix, rcond=1e-9), rtol=1e-9, atol=1e-11)
    if matrix.size:
        ends = [np.linalg.pinv(factors[0] @ (factors[1] + s * change), rcond=1e-9) for s in (1e-5, -1e-5)]
        np.testing.assert_allclose(by_rule, (ends[0] - ends[1]) / 2e-5, rtol=1e-5, atol=1e-6 * np.abs(found).max())


@pytest.mark.slow
def test_pseudo_inverse_of_what_says_nothing():
    """Entries of rounding count as zero, not as each other's largest."""
    np.testing.assert_array_equal(vectors.pseudo_inverse(jnp.full((3, 2), 1e-14), 1e-9), np.zeros((2, 3)))


@pytest.mark.long
@pytest.mark.parametrize("size", [5, 17])  # by a kernel, and one sample after the other
@pytest.mark.parametrize("columns", [(), (2,)])
def test_equations_are_solved_with_derivatives_of_both_orders_in_both_modes(size, columns):
    assert (size <= vectors.LARGEST_KERNEL) == (size == 5)
    matrices = jnp.asarray(rng.normal(size=(3, size, size)))
    values = jnp.asarray(rng.normal(size=(3, size, *columns)))
    along = matrices[1]

    def first(solve):
        return [jax.vmap(mode(solve))(matrices, values) for mode in (lambda function: function, jax.jacfwd, jax.jacrev)]

    def squares(solve, share):
        return jnp.sum(solve(matrices[0] + share * along, values[0]) ** 2)

    def second(solve):
        function = functools.partial(squares, solve)
        return [jax.jacfwd(mode(function))(0.1) for mode in (jax.jacfwd, jax.grad)]

    found, wanted = jax.jit(lambda: [(first(s), second(s)) for s in (vectors.solve_equations, jnp.linalg.solve)])()
    for one, other in zip(found[0], wanted[0], strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-9, atol=1e-11 * np.abs(other).max())
    np.testing.assert_allclose(found[1], wanted[1], rtol=1e-8)


SEVERAL = """
import jax, jax.numpy as jnp
jax.config.update("jax_enable_x64", True)
from rfem_jax.mechanics.algebra.vectors import solve_equations
matrices = jax.random.normal(jax.random.key(0), (64, 10, 32, 32))
solved = jax.jit(jax.vmap(lambda of_one: sum(solve_equations(matrix, jnp.ones(32)) for matrix in of_one)))
for _ in range(20):
    found = jax.block_until_ready(solved(matrices))
print(bool(jnp.isfinite(found).all()))
"""


@pytest.mark.long
def test_several_equations_of_a_batch_do_not_wait_for_each_other():
    """With LAPACK's function for batches the process hangs with JAX 0.10 on two cores."""
    assert in_a_new_process(SEVERAL, timeout=120).split() == ["True"]
