"""Products as primitives against JAX's own operations: values, derivatives of both modes and of second order, batches
on any axis; and each is one equation under every transformation."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfem_jax.kernels import kernel
from rfem_jax.mechanics.algebra import products, vectors

rng = np.random.default_rng(0)

# Name: function, the same by JAX's operations, shapes of its arguments.
CASES = {
    "dot": (vectors.dot, lambda a, b: jnp.sum(a * b, axis=0), (3, 4), (3, 4)),
    "apply": (vectors.apply, lambda a, b: jnp.einsum("mnk,nk->mk", a, b), (2, 3, 4), (3, 4)),
    "apply_transposed": (vectors.apply_transposed, lambda a, b: jnp.einsum("nmk,nk->mk", a, b), (3, 2, 4), (3, 4)),
    "product": (vectors.product, lambda a, b: jnp.einsum("mnk,npk->mpk", a, b), (2, 3, 4), (3, 5, 4)),
    "product_transposed": (
        vectors.product_transposed, lambda a, b: jnp.einsum("mnk,pnk->mpk", a, b), (2, 3, 4), (5, 3, 4),
    ),
    "transposed_product": (
        vectors.transposed_product, lambda a, b: jnp.einsum("nmk,npk->mpk", a, b), (3, 2, 4), (3, 5, 4),
    ),
    "without later axes": (vectors.product, lambda a, b: a @ b, (2, 3), (3, 5)),
    "broadcast": (vectors.apply, lambda a, b: jnp.einsum("mnkl,nl->mkl", a, b[:, 0]), (2, 3, 4, 5), (3, 1, 5)),
    "broadcast both": (vectors.dot, lambda a, b: jnp.sum(a * b, axis=0), (3, 1, 5), (3, 4, 1)),
    "cross": (vectors.cross, lambda a, b: jnp.cross(a, b, axis=0), (3, 4), (3, 4)),
    "cross, broadcast": (vectors.cross, lambda a, b: jnp.cross(a, b, axis=0), (3, 1, 4), (3, 5, 4)),
    "cross, both broadcast": (vectors.cross, lambda a, b: jnp.cross(a, b, axis=0), (3, 1, 4), (3, 5, 1)),
}  # fmt: skip


@pytest.fixture(params=list(CASES))
def case(request):
    function, plain, *shapes = CASES[request.param]
    return function, plain, tuple(jnp.asarray(rng.normal(size=shape)) for shape in shapes)


def weighed(function, shape):
    """A scalar function that depends on every entry of a product, and not linearly."""
    weights = np.random.default_rng(1).normal(size=shape)
    return lambda a, b: jnp.sum(jnp.sin(function(a, b)) * weights)


def pairs(results, function, plain):
    """Pairs of the results with the function and with the plain one, from one program."""
    found = jax.jit(lambda: (results(function), results(plain)))()
    return zip(*map(jax.tree.leaves, found), strict=True)


def names(program):
    return [equation.primitive.name for equation in program.jaxpr.eqns]


@pytest.mark.parametrize("run", [lambda f: f, jax.jit, kernel])
def test_values(case, run):
    function, plain, given = case
    np.testing.assert_allclose(run(function)(*given), plain(*given), rtol=1e-14, atol=1e-15)


@pytest.mark.long
def test_derivatives_of_both_modes_and_of_second_order(case):
    function, plain, given = case
    shape = plain(*given).shape

    def derivatives(function):
        """By one of the arguments, the other being constant, and by both."""
        modes, places = (jax.jacfwd, jax.jacrev, jax.hessian), (0, 1, (0, 1))
        return [derivative(weighed(function, shape), place)(*given) for derivative in modes for place in places]

    for a, b in pairs(derivatives, function, plain):
        np.testing.assert_allclose(a, b, rtol=1e-12, atol=1e-14)


def test_a_tangent_of_one_argument_and_of_none(case):
    function, plain, (a, b) = case
    tangent = rng.normal(size=b.shape)
    found = jax.jit(lambda a, b: jax.jvp(lambda b: function(a, b), (b,), (tangent,)))(a, b)
    for x, y in zip(found, jax.jvp(lambda b: plain(a, b), (b,), (tangent,)), strict=True):
        np.testing.assert_allclose(x, y, rtol=1e-14, atol=1e-15)
    through_constants = jax.jvp(lambda c: c + jnp.sum(function(a, b)), (1.0,), (2.0,))[1]
    assert through_constants == 2.0


AXES = ((0, 0), (-1, -1), (0, None), (None, 0), (1, 0), (-1, None), (0, -1))


@pytest.mark.long
def test_batches_on_any_axis(case):
    function, plain, given = case
    shape = plain(*given).shape

    def stacked(axes):
        return [x if axis is None else jnp.stack([x, 2.0 * x, -x], axis=axis) for x, axis in zip(given, axes)]

    def batches(function):
        """Values, and gradients by both arguments."""
        both = function, jax.grad(weighed(function, shape), (0, 1))
        return [jax.vmap(one, in_axes=axes)(*stacked(axes)) for axes in AXES for one in both]

    for a, b in pairs(batches, function, plain):
        np.testing.assert_allclose(a, b, rtol=1e-13, atol=1e-14)


@pytest.mark.parametrize("name", ["apply", "product", "cross"])
def test_a_product_is_one_operation_and_so_is_its_derivative(name):
    function, _, *shapes = CASES[name]
    given = tuple(jnp.ones(shape) for shape in shapes)
    kind = "cross_product" if name == "cross" else "sum_of_products"
    assert names(jax.make_jaxpr(function)(*given)) == [kind]
    assert names(jax.make_jaxpr(lambda a, b: jax.jvp(function, (a, b), (a, b)))(*given)) == [kind, kind]
    batch = tuple(jnp.ones((7, *shape)) for shape in shapes)
    assert names(jax.make_jaxpr(jax.vmap(function))(*batch)) == [kind]
    assert names(jax.make_jaxpr(lambda a, b: jax.vjp(function, a, b)[1](function(a, b)))(*given)).count(kind) <= 4


@pytest.mark.parametrize("run", [lambda f: f, kernel])
def test_a_sum_of_constant_matrices(run):
    first, second, weights = rng.normal(size=(3, 3)), rng.normal(size=(3, 3)), rng.normal(size=(2, 5))

    def summed(w):
        return products.combine((jnp.sin(w[0]), w[1]), (first, second))

    expected = np.einsum("k,mn->mnk", np.sin(weights[0]), first) + np.einsum("k,mn->mnk", weights[1], second)
    np.testing.assert_allclose(run(summed)(jnp.asarray(weights)), expected, rtol=1e-14, atol=1e-15)


@pytest.mark.wrong_types
def test_arrays_that_do_not_fit_are_refused():
    with pytest.raises(ValueError, match="must have equally many axes"):
        vectors.apply(np.ones((3, 3, 2)), np.ones(3))
    with pytest.raises(ValueError, match="must be of one length, but have 3 and 2 entries"):
        vectors.apply(np.ones((3, 3)), np.ones(2))
