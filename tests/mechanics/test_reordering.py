"""Rows exchanged, repeated and summed: values, both modes of derivatives, batches on any axis, no scatter."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfem_jax.kernels import kernel
from rfem_jax.mechanics.algebra.reordering import reorder, repeat, rows, sum_groups

ORDER = (2, 0, 3, 1)
X = np.random.default_rng(1).normal(size=(3, 4, 5))
W = np.random.default_rng(2).normal(size=(3, 4, 5))


def weighed(x):
    return jnp.sin(reorder(x, ORDER, axis=1)) * W


@pytest.mark.parametrize("run", [lambda f: f, jax.jit])
def test_rows_are_taken(run):
    np.testing.assert_array_equal(run(lambda x: reorder(x, ORDER, axis=1))(X), X[:, ORDER])
    np.testing.assert_array_equal(run(lambda x: reorder(x, (1, 2, 0)))(X), X[[1, 2, 0]])
    assert run(lambda x: reorder(x, ()))(np.zeros((0, 4))).shape == (0, 4)


@pytest.mark.parametrize("places", [(3, 1), np.array([0, 2, 3]), ()])
def test_some_rows_are_taken(places):
    found = rows(X, places, axis=1)
    np.testing.assert_array_equal(found, X[:, np.array(places, int)])
    back = jax.grad(lambda x: jnp.sum(rows(x, places, axis=1)))(X)
    np.testing.assert_array_equal(back, np.isin(np.arange(4), places)[None, :, None] * np.ones(X.shape))


@pytest.mark.parametrize("order", [(0, 1, 2), (0, 1, 1, 2), (0, 1, 2, 4)])
def test_every_row_has_one_place(order):
    with pytest.raises(ValueError, match="is not a permutation of 4 rows"):
        reorder(X, order, axis=1)


@pytest.mark.slow
def test_both_modes_are_those_of_numpys_indexing():
    def plain(x):
        return jnp.sin(x[:, np.array(ORDER)]) * W

    def derivatives(function):
        return jax.jacfwd(function)(X), jax.jacrev(function)(X), jax.hessian(lambda x: function(x)[0, 0, 0])(X)

    found, expected = jax.jit(lambda: (derivatives(weighed), derivatives(plain)))()
    assert np.abs(expected[0]).max() > 0.1
    for one, other in zip(found, expected, strict=True):
        np.testing.assert_array_equal(one, other)
    np.testing.assert_array_equal(found[1], expected[0])


@pytest.mark.parametrize("axis", [0, 1, 2, 3])
def test_batches_on_any_axis(axis):
    batch = np.stack([X, 2.0 * X], axis=axis)
    results = jax.jit(jax.vmap(weighed, in_axes=axis, out_axes=axis))(batch)
    np.testing.assert_allclose(results, np.stack([weighed(X), weighed(2.0 * X)], axis=axis), rtol=1e-15)


def test_reverse_mode_scatters_nothing():
    program = jax.jit(jax.grad(lambda x: jnp.sum(weighed(x)))).lower(X).as_text()
    assert "gather" in program and "scatter" not in program


COUNTS = [(1, 2, 0, 3), (0, 0, 4, 0), (1, 1, 1, 1), (0, 0, 0, 0), (2, 1, 1, 1)]


def repeated(counts):
    return lambda x: repeat(x, counts, 1), lambda x: jnp.repeat(x, np.array(counts), axis=1)


def summed(counts):
    def plain(x):
        ends = np.cumsum(counts)
        return jnp.stack([jnp.sum(x[:, end - n : end], axis=1) for end, n in zip(ends, counts)], axis=1)

    return lambda x: sum_groups(x, counts, 1), plain


@pytest.mark.parametrize("counts", COUNTS)
@pytest.mark.parametrize("pair", [repeated, summed])
@pytest.mark.parametrize("run", [lambda f: f, jax.jit, kernel])
def test_groups_of_rows(counts, pair, run):
    found, expected = pair(counts)
    x = np.random.default_rng(3).normal(size=(3, 4 if pair is repeated else sum(counts), 5))
    np.testing.assert_allclose(run(found)(jnp.asarray(x)), expected(x), rtol=1e-15)


@pytest.mark.slow
@pytest.mark.parametrize("counts", COUNTS[:3])
@pytest.mark.parametrize("pair", [repeated, summed])
def test_derivatives_and_batches_of_groups(counts, pair):
    found, expected = (lambda x, f=f: jnp.sum(jnp.sin(f(x * x)), axis=0) for f in pair(counts))
    x = np.random.default_rng(3).normal(size=(3, 4 if pair is repeated else sum(counts), 5))

    def derivatives(function):
        second = jax.jacfwd(jax.grad(lambda x: function(x)[0, 0] + function(x)[-1, -1]))
        return jax.jacfwd(function)(x), jax.jacrev(function)(x), second(x)

    def batches():
        stacked = [jnp.stack([x, 2.0 * x], axis=axis) for axis in (0, 1, 2, 3)]
        return [jax.vmap(found, in_axes=axis)(batch) for axis, batch in enumerate(stacked)]

    ours, theirs, both, single = jax.jit(
        lambda: (derivatives(found), derivatives(expected), batches(), (found(x), found(2.0 * x)))
    )()
    for one, other in zip(ours, theirs, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-14, atol=1e-14)
    for batch in both:
        np.testing.assert_allclose(batch, np.stack(single), rtol=1e-15)


@pytest.mark.slow
def test_counts_that_do_not_fit_are_refused():
    for function, counts in ((repeat, (1, 2)), (sum_groups, (1, 2))):
        with pytest.raises(ValueError, match="the axis has 4"):
            function(X, counts, axis=1)
