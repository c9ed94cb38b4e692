"""Operations on long arrays in loops: kernels that are differentiated in parts have them."""

import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfem_jax.kernels import bodies, is_available, kernel, programs, registry

pytestmark = pytest.mark.skipif(not is_available(), reason="llvmlite is not installed")

RANDOM = np.random.default_rng(3)
LONG, WIDE = RANDOM.normal(size=(4, 30, 40)), RANDOM.normal(size=(4, 40, 30))


def strict(function):
    """A kernel with loops over long arrays, that may not fall back to XLA."""
    made = kernel(function, in_parts=True)

    def called(*arguments):
        body = jax.make_jaxpr(made)(*(x[0] for x in arguments)).eqns[-1].params["body"]
        assert not isinstance(body.size(), Exception), body.size()
        return jax.vmap(made)(*map(jnp.asarray, arguments))

    return called


def elementwise(a, b):
    swapped = jnp.sin(a) * b.T + 2.0 * a[::-1] - jnp.flip(b.T, 1)
    return jnp.where(swapped > 0.3, swapped**2, jnp.exp(-jnp.abs(swapped))), (swapped > a[:1]).astype(jnp.int32)


def with_known_numbers(a, b):
    mask, slopes = np.arange(40) % 3 == 0, np.linspace(0.0, 1.0, 1200).reshape(30, 40)
    return jnp.where(mask[None], a, 0.0) * slopes, jnp.maximum(a, slopes) + jnp.asarray(slopes[::-1]), a * 0.0 + 1.0


def sums(a, b):
    one = jnp.sum(a, axis=0), jnp.max(b, axis=1), jnp.min(a), jnp.any(a > 3.0, axis=0), jnp.all(b < 3.0)
    return (*one, jnp.sum(a.reshape(30, 5, 8), axis=(0, 2)), jnp.sum((a > 0.0).astype(jnp.int32)))


def products(a, b):
    return a @ b, a @ b[:, 0], b[:, 1] @ a.T, jnp.einsum("ij,kj->ik", a[:20], a[10:] * 2.0), (a[:5] @ b) @ a


def around_in_loops(a, b):
    def step(carry, row):
        x, y = carry
        return (y, x + row[:, None] * 0.1), x[3]

    def goes_on(carry):
        return carry[1] < 7.0 + a[0, 0]

    def grow(carry):
        return 1.1 * carry[0] + 0.1 * carry[0][::-1], carry[1] + 1.0

    (x, y), rows = jax.lax.scan(step, (a, a * b.T), b)
    grown, count = jax.lax.while_loop(goes_on, grow, (a, 0.0))
    chosen = jax.lax.cond(a[0, 0] > 0.0, lambda x: jnp.cos(x) + x[::-1], lambda x: 2.0 * x, a)
    return x, y, rows, grown, count, chosen


def pieces(a, b):
    joined = jnp.concatenate([a, b.T]) * 2.0
    return joined, jnp.pad(a, ((1, 2), (0, 1))) + 1.0, jnp.stack([a, a[::-1]]).reshape(2, -1) - 1.0


def equations(a, b):
    matrix = a @ b + 10.0 * jnp.eye(30)
    return jnp.linalg.solve(matrix, a[:, 0]), jnp.linalg.solve(matrix, a), jnp.linalg.inv(matrix)


@pytest.mark.slow
@pytest.mark.parametrize(
    "function", [elementwise, with_known_numbers, sums, products, around_in_loops, pieces, equations]
)
def test_values_are_those_of_the_function(function):
    found, wanted = strict(function)(LONG, WIDE), jax.vmap(function)(LONG, WIDE)
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(wanted), strict=True):
        assert a.dtype == b.dtype and a.shape == b.shape
        np.testing.assert_allclose(a, b, rtol=1e-11, atol=1e-12)


def test_what_is_not_a_number_stays_where_it_is():
    broken = LONG.copy()
    broken[1, 2, 3] = np.nan
    found, wanted = strict(elementwise)(broken, WIDE), jax.vmap(elementwise)(broken, WIDE)
    for a, b in zip(found, wanted, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-12)
    (largest, least), (a, b) = (
        strict(lambda a: (jnp.max(a), jnp.min(a)))(broken),
        (broken.max((1, 2)), broken.min((1, 2))),
    )
    np.testing.assert_array_equal(largest, a)
    np.testing.assert_array_equal(least, b)


@pytest.mark.slow
@pytest.mark.parametrize("function", [elementwise, sums, products, equations])
def test_code_does_not_grow_with_the_entries(function):
    def operations(short):
        return programs.emit(jax.make_jaxpr(function)(LONG[0], WIDE[0]), short).operations

    assert operations(True) < operations(False) / 3


def in_parts(x, y):
    """Kernels with a loop between them."""
    inner = kernel(lambda x: jnp.sin(x) * x[::-1], name="inner")

    def grow(carry):
        return inner(carry[0]) + y, carry[1] + 1

    end, count = jax.lax.while_loop(lambda carry: carry[1] < 3, grow, (x, jnp.int32(0)))
    return {"end": inner(end), "count": count}, jnp.sum(x)


X, Y = jnp.array([0.3, 0.7, 1.9]), jnp.array([1.0, 0.2, -0.4])


@pytest.mark.parametrize("batched", [False, True])
def test_derivatives_are_those_of_the_parts(batched):
    made = kernel(in_parts, in_parts=True)

    def along(function):
        def value(x, y):
            return jax.jvp(lambda x: function(x, y), (x,), (x**2,))

        return jax.vmap(value, (0, None))(jnp.stack([X, 2.0 * X]), Y) if batched else value(X, Y)

    for a, b in zip(jax.tree.leaves(along(made)), jax.tree.leaves(along(in_parts)), strict=True):
        assert a.dtype == b.dtype
        if a.dtype != jax.dtypes.float0:
            np.testing.assert_allclose(a, b, rtol=1e-13)


@pytest.mark.slow
def test_second_derivatives_and_reverse_mode_of_a_kernel_in_parts():
    def function(x):
        return jnp.sum(kernel(lambda x: jnp.sin(x) * jnp.cumsum(x), name="inner")(x) ** 2)

    made = kernel(function, in_parts=True)
    for derivative in (jax.grad, jax.jacfwd, jax.hessian):
        np.testing.assert_allclose(derivative(made)(X), derivative(function)(X), rtol=1e-13)


def test_a_kernel_in_parts_is_one_kernel_for_values_and_several_for_derivatives():
    made = kernel(lambda x: jnp.sum(kernel(jnp.sin)(x)) + jnp.sum(kernel(jnp.cos)(x)), in_parts=True)
    assert str(jax.make_jaxpr(made)(X)).count("kernel[") == 1
    assert str(jax.make_jaxpr(lambda x: jax.jvp(made, (x,), (x,)))(X)).count("kernel[") == 4  # values and tangents


def test_a_kernel_in_parts_leaves_what_has_no_machine_code_to_xla_in_silence():
    def function(x):
        return jnp.sum(jax.scipy.special.bessel_jn(x, v=1)) + jnp.sum(kernel(jnp.sin)(x))

    with warnings.catch_warnings():
        warnings.simplefilter("error")
        np.testing.assert_allclose(jax.jit(kernel(function, in_parts=True))(X), function(X), rtol=1e-12)


def test_a_kernel_in_parts_that_is_too_large_is_its_parts(monkeypatch):
    monkeypatch.setattr(bodies, "LARGEST_IN_PARTS", 20)

    def function(x):
        return jnp.sum(jnp.outer(kernel(jnp.sin, name="inner")(x), x) ** 2)

    with registry.noting() as names:
        np.testing.assert_allclose(jax.jit(kernel(function, in_parts=True))(X), function(X), rtol=1e-13)
    assert len(names) == 1  # that of the inner kernel
