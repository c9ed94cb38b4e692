"""Derivatives of implicit functions: x with x^2 = p, and a linear system, whose derivatives are known."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfem_jax.mechanics.algebra.derivative_rules import implicit_function

P = jnp.array([4.0, 9.0])


def roots(p, solved=None):
    """Square roots of p (2,)."""

    def solve(linear, value, inputs, x):
        if solved is not None:
            solved.append(value)
        return jnp.linalg.solve(jax.jacfwd(linear)(jnp.zeros_like(value)), value)

    found = jax.lax.stop_gradient(jnp.sqrt(p))
    return implicit_function(lambda x, inputs: x**2 - inputs["p"], solve, found, {"p": p, "name": "not an array"})


@pytest.mark.slow
@pytest.mark.parametrize("derivative", [jax.jacfwd, jax.jacrev])
def test_first_and_second_derivatives(derivative):
    np.testing.assert_allclose(roots(P), jnp.sqrt(P), rtol=1e-15)
    np.testing.assert_allclose(jax.jit(derivative(roots))(P), jnp.diag(0.5 * P**-0.5), rtol=1e-13)
    second = jax.jit(jax.jacfwd(derivative(roots)))(P)
    np.testing.assert_allclose(second[[0, 1], [0, 1], [0, 1]], -0.25 * P**-1.5, rtol=1e-13)
    np.testing.assert_allclose(second[0, 1], 0.0, atol=1e-15)


def test_a_batch_of_derivatives():
    points = jnp.stack([P, 4.0 * P, 9.0 * P])
    found = jax.jit(jax.vmap(jax.jacfwd(roots)))(points)
    np.testing.assert_allclose(jnp.diagonal(found, axis1=1, axis2=2), 0.5 * points**-0.5, rtol=1e-13)


def test_nothing_is_traced_where_no_derivative_is_taken():
    solved: list = []
    jax.jit(lambda p: roots(p, solved))(P)
    assert not solved
    jax.jit(jax.jacfwd(lambda p: roots(p, solved)))(P)
    assert solved


def test_unknowns_that_depend_on_nothing_differentiated():
    value, tangent = jax.jvp(lambda q: roots(P) + 0.0 * q, (1.0,), (1.0,))
    np.testing.assert_allclose(value, jnp.sqrt(P), rtol=1e-15)
    np.testing.assert_array_equal(tangent, 0.0)
