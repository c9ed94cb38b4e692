"""What does not depend on some operands of a jaxpr is carried out once, the rest as often as it is asked for."""

from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfem_jax.kernels import kernel
from rfem_jax.kernels.entries import needed
from rfem_jax.kernels.separation import NotSeparable, separated

X, DX = jnp.array([0.3, -1.2, 2.0]), jnp.array([0.7, 0.1, -0.4])


@jax.jit
def _called(x):
    return jnp.sin(x) * jnp.cos(x)


@jax.custom_jvp
def _ruled(x):
    return x**2


@_ruled.defjvp
def _double(primals, tangents):
    (x,), (dx,) = primals, tangents
    return _ruled(x), 7.0 * jnp.exp(x) * dx  # another derivative than that of what it computes


def _looped(x):
    return jax.lax.scan(lambda total, one: (total * one + jnp.sin(one), total), 1.0, x)


def _branched(x):
    return jax.lax.cond(x[0] > 0, lambda y: jnp.sin(y), lambda y: y**3, x)


FUNCTIONS = {
    "operations": lambda x: jnp.exp(x) / (1 + x**2),
    "call": lambda x: _called(_called(x)) + x,
    "rule": lambda x: _ruled(jnp.sin(x)),
    "turns": lambda x: jax.lax.while_loop(lambda s: s[0] < 3, lambda s: (s[0] + 1, jnp.sin(s[1])), (0, x))[1],
    "constants": lambda x: jnp.array([1.0, 2.0, 3.0]) * x @ np.eye(3),
    "nothing": lambda x: (jnp.sin(x), jnp.zeros(2)),
}


def _tangent(function):
    """The derivative of a function as a jaxpr of a point and a direction."""
    return jax.make_jaxpr(lambda x, dx: jax.tree.leaves(jax.jvp(function, [x], [dx])[1]))(X, DX)


@pytest.mark.parametrize("name", FUNCTIONS)
def test_same_results_as_the_whole(name):
    program = _tangent(FUNCTIONS[name])
    found = separated(program, [X])(DX)
    expected = jax.extend.core.jaxpr_as_fun(program)(X, DX)
    assert len(found) == len(expected)
    for one, other in zip(found, expected):
        np.testing.assert_allclose(one, other, rtol=1e-15, atol=1e-300)  # XLA rounds some sums of products once


@pytest.mark.parametrize("function", [_looped, _branched, jax.checkpoint(_called)])
def test_loops_and_branches_are_not_divided(function):
    """Each has a part that would be repeated for every direction; `jax.linearize` makes two of one."""
    with pytest.raises(NotSeparable):
        separated(_tangent(function), [X])


@pytest.mark.parametrize("function", [_looped, _branched])
def test_kernels_divide_loops_and_branches(function):
    """What does not depend on the directions is no part of the loop over these."""
    along = jax.vmap(lambda dx: jax.jvp(kernel(function), [X], [dx])[1])
    (equation,) = (one for one in jax.make_jaxpr(along)(jnp.eye(3)).eqns if one.primitive.name == "kernel"
                   and one.params["body"].single is not None)  # fmt: skip
    program = equation.params["body"].program
    (each,) = (one for one in program.jaxpr.eqns if one.primitive.name == "kernel")
    assert "sin" not in str(each.params["body"].program)
    assert "sin" in str(program) or "cos" in str(program)


@pytest.mark.parametrize("name", ["operations", "call", "rule"])
def test_what_is_left_is_linear(name):
    """No function of the point is left to be computed: only products and sums, as in what `jax.linearize` leaves."""
    left = jax.make_jaxpr(separated(_tangent(FUNCTIONS[name]), [X]))(DX)
    names = {equation.primitive.name for equation in needed(left.jaxpr)}
    assert names and names <= {"mul", "neg", "add", "add_any", "sub", "div", "copy"}


def test_rules_of_what_is_carried_out_hold():
    """What does not depend on the direction is differentiated by its own rule, where it has one."""

    def derivative(x, dx):
        return separated(_tangent(FUNCTIONS["rule"]), [x])(dx)[0]

    def whole(x, dx):
        return jax.jvp(FUNCTIONS["rule"], [x], [dx])[1]

    along = partial(jax.jvp, tangents=[DX, jnp.zeros(3)])
    found, expected = (along(f, [X, DX])[1] for f in (derivative, whole))
    np.testing.assert_allclose(found, expected, rtol=1e-14)
    assert np.max(np.abs(found)) > 1.0


def test_results_that_depend_on_nothing_else():
    """They are there already; and operands that nothing needs are taken all the same."""
    program = jax.make_jaxpr(lambda x, dx: (jnp.sin(x), dx, 2.0))(X, DX)
    first, second, third = separated(program, [X])(DX)
    np.testing.assert_array_equal(first, jnp.sin(X))
    np.testing.assert_array_equal(second, DX)
    assert third == 2.0
