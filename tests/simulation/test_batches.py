"""Batches of functions with their own rule of differentiation (jax issue 16374); loops that are transformed once."""

import jax
import jax.numpy as jnp
import numpy as np
from jax.custom_derivatives import SymbolicZero

from rfem_jax.simulation.system.batches import with_batch_axes


def made(align):
    """x -> (a value that a loop finds, a constant, an integer): under vmap the loop gives all three a batch axis, and
    the rule only the first."""

    @jax.custom_jvp
    def function(x):
        def iterate(carry):
            return carry[0] + 0.25 * (x - carry[0]), *carry[1:]

        start = jnp.zeros(()), jnp.full((2,), 3.0), jnp.asarray(7)
        found = jax.lax.while_loop(lambda carry: jnp.abs(carry[0] - x) > 1e-9, iterate, start)
        return align(found, found[0])

    @function.defjvp
    def _(primals, tangents):
        (x,), (dx,) = primals, tangents
        ends = x, jnp.full((2,), 3.0), jnp.asarray(7)
        nothing = np.zeros((), jax.dtypes.float0)
        return align(ends, x), (dx, jnp.zeros(2), nothing)

    return function


def derivative(function):
    """Derivative along ones of a function of all results of a batch."""

    def batch(x):
        one, other, count = jax.jit(jax.vmap(function))(x)
        return one + jnp.sum(other, axis=1) * count.astype(float) + x**2

    x = jnp.array([1.0, 2.0, 4.0])
    return jax.jit(lambda x: jax.jvp(batch, (x,), (jnp.ones(3),)))(x)


def test_all_results_of_function_and_rule_have_the_same_batch_axes():
    value, tangent = derivative(made(with_batch_axes))
    x = np.array([1.0, 2.0, 4.0])
    np.testing.assert_allclose(value, x + 42.0 + x**2, rtol=1e-8)
    np.testing.assert_allclose(tangent, 1.0 + 2.0 * x, rtol=1e-12)


def test_an_array_that_depends_on_no_sample_gets_its_axis():
    def function(x, y):
        return with_batch_axes((y, x), x)

    constant, own = jax.eval_shape(jax.vmap(function, (0, None), out_axes=0), jnp.ones(4), jnp.arange(3.0))
    assert constant.shape == (4, 3) and own.shape == (4,)
    # vmap refuses an unbatched result where none may be.
    axes = jax.vmap(lambda x: with_batch_axes(jnp.arange(3.0), x), out_axes=1)(jnp.ones(4))
    assert axes.shape == (3, 4)


def test_the_compiled_program_has_no_trace_of_it():
    program = jax.jit(lambda x, y: with_batch_axes((jnp.sin(y), 2.0 * y), x))
    text = program.lower(1.0, jnp.arange(3.0)).compile().as_text()
    assert " select(" not in text and "sine(" in text


def moving(function, x):
    """Which leaves of what a function returns have a tangent, and value and tangents."""
    seen = []

    @jax.custom_jvp
    def same(tree):
        return tree

    def rule(primals, tangents):
        seen.extend(not isinstance(tangent, SymbolicZero) for tangent in jax.tree.leaves(tangents[0]))
        return primals[0], tangents[0]

    same.defjvp(rule, symbolic_zeros=True)
    return seen, *jax.jvp(lambda x: same(function(x)), (x,), (jnp.ones_like(x),))


def test_tangents_of_zeros_where_a_source_has_one():
    x, constants = jnp.asarray(2.0), (jnp.arange(3.0), jnp.asarray(7.0))
    for source, differentiated, expected in (
        (lambda x: x, True, True),
        (lambda x: x, False, False),
        (jax.lax.stop_gradient, True, False),
    ):
        seen, value, tangent = moving(
            lambda x: with_batch_axes(constants, source(x), differentiated=differentiated),
            x,
        )
        assert seen == [expected] * 2 or (not seen and not expected)
        for one, zero, constant in zip(value, tangent, constants, strict=True):
            np.testing.assert_array_equal(one, constant)
            np.testing.assert_array_equal(zero, jnp.zeros_like(constant))
