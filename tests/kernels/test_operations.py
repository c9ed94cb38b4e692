"""Operations that are made of others beside what JAX makes of them: LAPACK, places that are computed, sums, sorting."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfem_jax.kernels import is_available, kernel, newer_primitives, programs

pytestmark = pytest.mark.skipif(not is_available(), reason="llvmlite is not installed")

RANDOM = np.random.default_rng(5)


def strict(function):
    """A kernel that may not fall back to XLA."""
    made = kernel(function, selection="fast")

    def called(*arguments):
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            return jax.jit(made)(*arguments)

    return called


def solutions(matrix, right, vector):
    return jnp.linalg.solve(matrix, right), jnp.linalg.solve(matrix, vector), jnp.linalg.inv(matrix)


@pytest.mark.slow
@pytest.mark.parametrize("n", [1, 2, 7, 20])
def test_equations_are_solved_with_pivots(n):
    matrix = RANDOM.normal(size=(n, n))
    matrix[0, 0] = 0.0 if n > 1 else 2.0  # without an exchange of rows there is no solution
    arguments = [jnp.asarray(x) for x in (matrix, RANDOM.normal(size=(n, 3)), RANDOM.normal(size=n))]
    for found, wanted in zip(strict(solutions)(*arguments), solutions(*arguments), strict=True):
        np.testing.assert_allclose(found, wanted, rtol=1e-11, atol=1e-13)


@pytest.mark.parametrize("derivative", [jax.jacfwd, jax.jacrev])
def test_derivatives_of_solutions(derivative):
    matrix, vector = jnp.asarray(RANDOM.normal(size=(5, 5))), jnp.asarray(RANDOM.normal(size=5))
    found = derivative(strict(jnp.linalg.solve), argnums=(0, 1))(matrix, vector)
    inverse = np.linalg.inv(matrix)
    solution = inverse @ np.asarray(vector)
    np.testing.assert_allclose(found[1], inverse, rtol=1e-11)
    np.testing.assert_allclose(found[0], -inverse[:, :, None] * solution[None, None], rtol=1e-10, atol=1e-12)


def test_nothing_to_solve():
    empty = strict(lambda matrix, right: jnp.linalg.solve(matrix, right))(jnp.zeros((0, 0)), jnp.zeros((0, 2)))
    assert empty.shape == (0, 2)


def test_a_singular_matrix_has_no_finite_solution():
    found = strict(jnp.linalg.solve)(jnp.ones((2, 2)), jnp.array([1.0, 2.0]))
    assert not np.isfinite(found).all()


def places(x):
    """Rows found by their values, written and read at places that are computed, and sorted."""
    table = jnp.linspace(0.0, 1.0, 40)
    at = jnp.sum(table <= x, dtype=jnp.int32)
    long = jnp.linspace(0.0, 1.0, 5000)[100 * at + jnp.arange(3, dtype=at.dtype)]
    written = table.at[(40.0 * x).astype(jnp.int32)].set(x)
    added = table.at[(40.0 * x).astype(jnp.int32)].add(x)
    rows = jnp.outer(table, table[:3])[jnp.array([3, 9], at.dtype) + at]
    order = jnp.argsort(jnp.sin(9.0 * table[:11] + x))
    bits = (at.astype(jnp.uint32) << jnp.uint32(3)) >> jnp.uint32(1)
    several = jax.vmap(lambda row, place, value: row.at[place].add(value).at[place + 1].set(row[place - 1]))(
        jnp.outer(table[:4], table[:6]), at // 12 + jnp.arange(4, dtype=at.dtype), table[4:8]
    )
    shifts = jnp.int32(-37) >> (at - 3), jnp.int32(5) << at.astype(jnp.int32), -jnp.sign(at - 20)
    return *shifts, long, several, at, written, added, rows, order, jnp.sort(jnp.cos(x * table[:9])), bits


@pytest.mark.slow
def test_places_that_are_computed():
    x = jnp.array([-0.3, 0.0, 0.1, 0.33, 0.5, 0.74])
    for found, wanted in zip(jax.vmap(strict(places))(x), jax.vmap(places)(x), strict=True):
        assert found.dtype == wanted.dtype
        np.testing.assert_allclose(found, wanted, rtol=1e-14, atol=1e-15)


def test_what_is_not_a_number_comes_last():
    values = jnp.array([1.0, jnp.nan, -2.0, 0.5])
    np.testing.assert_array_equal(strict(jnp.sort)(values), jnp.sort(values))


def sums(x):
    table = jnp.outer(jnp.sin(x + jnp.arange(4.0)), jnp.cos(jnp.arange(5.0) * x))
    return (
        jnp.cumsum(table[0]), jnp.cumsum(table, axis=1),
        jnp.cumprod(table, axis=0), jax.lax.cummax(table, axis=1, reverse=True),
        jax.lax.cummin(table), jnp.prod(table, axis=0), jnp.argmax(table, axis=1), jnp.argmin(table),
        jnp.argmax(jnp.where(table[0] > 0.3, jnp.nan, table[0])), jnp.round(9.0 * table),
        jax.lax.round(9.0 * table, jax.lax.RoundingMethod.AWAY_FROM_ZERO), jnp.tile(table[:2], (2, 3)),
    )  # fmt: skip


def test_sums_and_places_along_axes():
    x = jnp.array([-0.3, 0.0, 0.1, 0.33, 0.5, 2.74])
    for found, wanted in zip(jax.vmap(strict(sums))(x), jax.vmap(sums)(x), strict=True):
        assert found.dtype == wanted.dtype
        np.testing.assert_allclose(found, wanted, rtol=1e-14, atol=1e-15)


@pytest.mark.parametrize("function", [jnp.log1p, jnp.expm1, jax.nn.sigmoid, jax.nn.softplus])
def test_functions_that_are_made_of_others(function):
    sizes = np.concatenate([[0.0, np.inf], np.geomspace(1e-300, 700.0, 400)])
    x = jnp.asarray(np.concatenate([-sizes, sizes, [np.nan]]))
    x = x[(x > -1.0) | jnp.isnan(x)] if function is jnp.log1p else x
    np.testing.assert_allclose(jax.vmap(strict(function))(x), function(x), rtol=4e-15)


def test_a_callback_is_called():
    seen = []

    @jax.jit
    @kernel
    def watched(x):
        jax.debug.callback(lambda x: seen.append(float(x)), x)
        return 2.0 * x

    assert watched(jnp.asarray(1.5)) == 3.0
    jax.effects_barrier()
    assert seen == [1.5]


def sums_over_rows(rows):
    """Sums over rows of rows, of arrays whose axes are exchanged, in reverse order, and that are a part of others."""

    def inner(total, row):
        total = total + jnp.sin(row[0]) * row[1]
        return total, total

    def outer(total, block):
        last, all_of_them = jax.lax.scan(inner, total, block)
        return last, (all_of_them, block[::-1])

    swapped = jnp.swapaxes(rows, 0, 1)[:, 1:, :2]
    total, (sums, blocks) = jax.lax.scan(outer, rows[0, 0, 0], swapped)
    backwards, _ = jax.lax.scan(inner, total, rows[3, ::-1, :2], reverse=True)
    partly_known = jnp.concatenate([rows[:, :, :1], jnp.zeros_like(rows[:, :, :1])], axis=2)
    _, constant = jax.lax.scan(outer, total, partly_known)
    same = jax.lax.scan(inner, total, jnp.broadcast_to(rows[0, 0], (70, rows.shape[2])))
    return total, jnp.moveaxis(sums, 0, 1), jnp.swapaxes(blocks, 0, 2), backwards, constant, same


@pytest.mark.slow
@pytest.mark.parametrize("shape", [(70, 80, 3), (5, 80, 3), (80, 4, 2)])
def test_rows_are_read_where_they_lie(shape):
    rows = jnp.asarray(RANDOM.normal(size=(3, *shape)))
    found, wanted = jax.vmap(strict(sums_over_rows))(rows), jax.vmap(sums_over_rows)(rows)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-13)


def test_kernels_of_derivatives_do_not_grow_with_the_number_of_rows():
    def function(numbers, rows):
        def step(state, row):
            state = state + 0.01 * jnp.sin(state * numbers) * row
            return state, state * row

        return jax.lax.scan(step, numbers, rows)

    def along(numbers, rows, directions):
        return jax.vmap(lambda one: jax.jvp(lambda x: function(numbers, x), (rows,), (one,)))(directions)

    def operations(of, *shapes):
        return programs.emit(jax.make_jaxpr(of)(np.ones(2), *map(np.ones, shapes))).operations

    assert operations(along, (400, 2), (3, 400, 2)) == operations(along, (100, 2), (3, 100, 2))
    second = jax.jacfwd(jax.jacfwd(function))
    assert operations(second, (400, 2)) == operations(second, (100, 2))


@pytest.mark.parametrize("shape", [(5, 5), (7, 3), (3, 7), (12, 12), (1, 1)])
@pytest.mark.parametrize("kind", ["any", "a column of zeros", "two equal columns", "sizes far apart"])
def test_singular_values_beside_lapacks(shape, kind):
    matrices = RANDOM.normal(size=(8, *shape))
    if kind == "a column of zeros":
        matrices[:, :, 0] = 0.0
    elif kind == "two equal columns":
        matrices[:, :, -1] = 2.0 * matrices[:, :, 0]
    elif kind == "sizes far apart":
        matrices *= np.logspace(0, -12, shape[1])
    bound, count = 1e-14 * max(shape), min(shape)
    for full in (False, True):
        of_one = strict(lambda x: tuple(jnp.linalg.svd(x, full_matrices=full)))
        left, values, right = jax.vmap(of_one)(jnp.asarray(matrices))
        np.testing.assert_allclose(values, np.linalg.svd(matrices, compute_uv=False), rtol=0, atol=5 * bound)
        product = np.einsum("bij,bj,bjk->bik", left[:, :, :count], values, right[:, :count])
        np.testing.assert_allclose(product, matrices, rtol=0, atol=5 * bound)
        for vectors in (np.asarray(left), np.swapaxes(right, 1, 2)):
            squares = np.einsum("bij,bik->bjk", vectors, vectors)
            np.testing.assert_allclose(squares, np.broadcast_to(np.eye(squares.shape[-1]), squares.shape), atol=bound)


def test_singular_values_alone_and_of_what_is_no_number():
    values = strict(lambda x: jnp.linalg.svd(x, compute_uv=False))
    np.testing.assert_array_equal(values(jnp.zeros((3, 3))), np.zeros(3))
    assert np.isnan(values(jnp.full((3, 3), jnp.nan))).all()
    inverse = strict(lambda x: jnp.linalg.pinv(x, rtol=1e-12))
    assert np.isnan(inverse(jnp.full((3, 3), jnp.nan))).all()
    small_values = np.linalg.svd(np.vander([1.0, 2.0, 3.0]) * [1.0, 1e-7, 1e-13], compute_uv=False)
    np.testing.assert_allclose(
        values(jnp.asarray(np.vander([1.0, 2.0, 3.0]) * [1.0, 1e-7, 1e-13])), small_values, rtol=1e-6
    )


def test_singular_values_of_several_matrices_at_once_and_of_columns_far_apart():
    matrices = jnp.asarray(RANDOM.normal(size=(3, 4, 4)))
    found = strict(lambda x: jnp.linalg.svd(x, compute_uv=False))(matrices)
    np.testing.assert_allclose(found, np.linalg.svd(matrices, compute_uv=False), rtol=1e-13)
    for matrix in (np.ones((6, 9)), np.ones((5, 5)) * 10.0 ** (-14.0 * np.arange(5))):
        values = strict(lambda x: jnp.linalg.svd(x, compute_uv=False))(jnp.asarray(matrix))
        np.testing.assert_allclose(values, np.linalg.svd(matrix, compute_uv=False), rtol=1e-10, atol=1e-14)


def test_a_loop_of_a_batch_ends_for_each_by_itself():
    def function(x):
        def halved(one):
            return jax.lax.while_loop(lambda c: c[0] > 1.0, lambda c: (0.5 * c[0], c[1] + 1, c[2] * 1.5), one)

        return jax.vmap(halved)((x, jnp.zeros(x.shape, jnp.int32), jnp.ones((*x.shape, 3))))

    x = jnp.array([0.5, 3.0, 100.0, 17.0])
    for a, b in zip(strict(function)(x), function(x), strict=True):
        np.testing.assert_array_equal(a, b)


TRIANGLE = np.tri(3, dtype=int)


@pytest.mark.parametrize(
    "function",
    [
        lambda x, n: jax.lax.dot(TRIANGLE, x, preferred_element_type=jnp.float64),
        lambda x, n: jax.lax.dot(n[:, None] * n[None], n, preferred_element_type=jnp.int64),
        lambda x, n: jax.lax.pow(x, n),
        lambda x, n: ~n.astype(jnp.uint32),
        lambda x, n: jax.lax.max(np.nan * x[:1], x[1:2]),
        lambda x, n: jax.lax.max(jnp.array([np.nan, 1.0, -1.0]), x),
        lambda x, n: (1e30 * x).astype(jnp.int32),
        lambda x, n: (jnp.array([np.nan, np.inf, -np.inf]) * x).astype(jnp.int64),
        lambda x, n: (x * 1e10).astype(jnp.uint32),
    ],
)
def test_numbers_of_several_types_and_at_the_ends_of_their_range(function):
    x, n = jnp.array([1.5, -0.7, 2.0]), jnp.array([2, -1, 3], jnp.int32)
    np.testing.assert_array_equal(strict(function)(x, n), jax.jit(function)(x, n))


@pytest.mark.parametrize("function", [jnp.tanh, jnp.arcsin, jnp.arccos, jnp.log2, jnp.sinh])
def test_functions_and_derivatives_have_machine_code_with_every_version_of_jax(function):
    """Which make derivatives of different primitives."""

    def twice(x):
        def once(x):
            return jax.jvp(function, (x,), (jnp.ones_like(x),))

        return jax.jvp(once, (x,), (jnp.ones_like(x),))

    x = jnp.array([0.03, 0.6, 0.95])
    for a, b in zip(jax.tree.leaves(strict(twice)(x)), jax.tree.leaves(twice(x)), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-13)


@pytest.mark.parametrize("method", ["scan", "scan_unrolled", "sort", "compare_all"])
@pytest.mark.parametrize("side", ["left", "right"])
def test_searches_in_sorted_arrays(side, method):
    """A primitive of its own on newer versions of JAX."""
    rows, x = jnp.array([0.0, 1.0, 2.5, 7.0]), jnp.array([-1.0, 0.0, 2.4, 2.5, 9.0])
    found = strict(lambda rows, x: jnp.searchsorted(rows, x, side=side, method=method))(rows, x)
    np.testing.assert_array_equal(found, np.searchsorted(rows, x, side=side))


def test_interpolation_and_its_derivatives():
    rows, values, x = (
        jnp.array([0.0, 1.0, 2.5, 7.0]),
        jnp.array([3.0, -1.0, 4.0, 0.5]),
        jnp.array([-1.0, 0.3, 2.4, 9.0]),
    )

    def function(values, x):
        return jnp.interp(x, rows, values)

    np.testing.assert_allclose(strict(function)(values, x), np.interp(x, rows, values), rtol=1e-14)
    along = (jnp.array([1.0, 0.0, -2.0, 1.0]), jnp.ones_like(x))
    found = strict(lambda *at: jax.jvp(function, at, along)[1])(values, x)
    np.testing.assert_allclose(found, jax.jvp(function, (values, x), along)[1], rtol=1e-13)


def test_polynomials():
    x = jnp.array([0.3, -2.0, 5.0])
    found = strict(lambda x: jax.jvp(lambda x: jnp.polyval(jnp.array([2.0, 0.5, -1.0]), x), (x,), (x,)))(x)
    np.testing.assert_allclose(found, [2.0 * x**2 + 0.5 * x - 1.0, (4.0 * x + 0.5) * x], rtol=1e-14)
    of_arrays = newer_primitives.polynomial(x, jnp.asarray(-1.0), x, jnp.asarray(2.0), unroll=None)
    np.testing.assert_allclose(of_arrays, -1.0 + x * x + 2.0 * x**2, rtol=1e-14)
    np.testing.assert_allclose(newer_primitives.one_minus_square(x), 1.0 - x**2, rtol=1e-15)


def test_single_entry_at_a_known_place():
    """Taken by a gather, not by a slice."""
    sizes = jax.lax.GatherDimensionNumbers(offset_dims=(), collapsed_slice_dims=(0,), start_index_map=(0,))
    found = kernel(lambda x: jax.lax.gather(x, np.array([2]), sizes, slice_sizes=(1,)))(jnp.array([0.5, 0.25, 0.125]))
    assert found == 0.125 and found.shape == ()
