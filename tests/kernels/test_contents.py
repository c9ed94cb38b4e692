"""Digests of jaxprs: what is the same has the same one, what is not has not."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfem_jax.kernels import is_available, kernel, programs
from rfem_jax.kernels.contents import digest_of

pytestmark = pytest.mark.skipif(not is_available(), reason="llvmlite is not installed")

X = np.array([0.3, 0.7, 1.9])
TABLE = np.array([1.0, 2.0, 4.0])


def digest(function, *arguments):
    return digest_of(jax.make_jaxpr(function)(*arguments))


def loop(step, length=5, reverse=False):
    return lambda x: jax.lax.scan(
        lambda carry, row: (step(carry), row * carry[0]), x, jnp.arange(1.0 * length), reverse=reverse
    )


FUNCTIONS = {
    "sum": lambda x: x + x[::-1],
    "difference": lambda x: x - x[::-1],
    "another difference": lambda x: x[::-1] - x,
    "number": lambda x: 2.0 * x,
    "another number": lambda x: -2.0 * x,
    "whole number": lambda x: x.astype(jnp.int32) * 2,
    "table": lambda x: x * TABLE,
    "another table": lambda x: x * (TABLE + 1e-16 * np.array([0.0, 0.0, 9.0])),
    "axis": lambda x: jnp.sum(jnp.outer(x, TABLE), axis=0),
    "another axis": lambda x: jnp.sum(jnp.outer(x, TABLE), axis=1),
    "loop": loop(jnp.sin),
    "another step": loop(jnp.cos),
    "longer": loop(jnp.sin, length=6),
    "from the end": loop(jnp.sin, reverse=True),
    "order of results": lambda x: loop(jnp.sin)(x)[::-1],
    "gather": lambda x: x[jnp.array([0, 2])],
    "another place": lambda x: x[jnp.array([0, 1])],
    "branch": lambda x: jax.lax.cond(x[0] > 0.5, jnp.sin, jnp.cos, x),
    "branches exchanged": lambda x: jax.lax.cond(x[0] > 0.5, jnp.cos, jnp.sin, x),
    "while": lambda x: jax.lax.while_loop(lambda y: y[0] < 5.0, lambda y: 1.5 * y, x),
    "another end": lambda x: jax.lax.while_loop(lambda y: y[0] < 6.0, lambda y: 1.5 * y, x),
    "equations": lambda x: jnp.linalg.solve(jnp.outer(x, x) + jnp.eye(3), x),
    "kernel": lambda x: kernel(jnp.sin)(x),
    "another kernel": lambda x: kernel(jnp.cos)(x),
    "kernel in a batch": lambda x: jax.vmap(kernel(jnp.sin))(x),
}  # fmt: skip


def test_what_differs_has_another_digest():
    found = {name: digest(function, X) for name, function in FUNCTIONS.items()}
    assert None not in found.values()
    assert len(set(found.values())) == len(found)
    assert digest(FUNCTIONS["sum"], X[:2]) != found["sum"]
    assert digest(FUNCTIONS["sum"], X.astype(np.int64)) != found["sum"]


@pytest.mark.slow
@pytest.mark.parametrize("name", FUNCTIONS)
def test_what_is_traced_again_has_the_same_digest(name):
    function = FUNCTIONS[name]
    again = digest(lambda x: function(x), X)
    jax.clear_caches()
    assert digest(function, X) == again


def test_names_and_rules_of_derivatives_are_no_content():
    @jax.custom_jvp
    def ruled(x):
        return jnp.sin(x)

    ruled.defjvp(lambda primals, tangents: (ruled(*primals), tangents[0]))

    @jax.jit
    def named(x):
        return jnp.sin(x)

    assert digest(ruled, X) == digest(lambda x: jax.jit(jnp.sin)(x), X) == digest(named, X)


def test_functions_among_settings_have_no_digest():
    assert digest(lambda x: jax.pure_callback(np.sin, jax.ShapeDtypeStruct(x.shape, x.dtype), x), X) is None


def test_what_has_the_same_content_is_emitted_once(monkeypatch):
    emitted, emit = [], programs.emit
    monkeypatch.setattr(programs, "emit", lambda program, short: (emitted.append(program), emit(program, short))[1])
    found = [jax.jit(kernel(lambda x: jnp.sin(x) * 0.71234, name=name))(X) for name in ("first", "second")]
    np.testing.assert_array_equal(*found)
    assert len(emitted) == 1


@pytest.mark.parametrize("most, times", [(programs.MOST_TEXT, 1), (0, 2)])
def test_other_numbers_of_lanes_have_the_program_that_is_remembered(monkeypatch, most, times):
    """Unless there are too many others since: the text of the last one alone stays."""
    emitted, emit = [], programs.emit
    monkeypatch.setattr(programs, "emit", lambda program, short: (emitted.append(program), emit(program, short))[1])
    monkeypatch.setattr(programs, "MOST_TEXT", most)
    own = kernel(lambda x: jnp.cos(x) * (0.41 + most), name="own")
    np.testing.assert_allclose(jax.jit(own)(X), np.cos(X) * (0.41 + most), rtol=1e-15)
    jax.jit(kernel(lambda x: jnp.cos(x) * (0.43 + most), name="another"))(X)
    emitted.clear()
    both = jax.jit(jax.vmap(own))(jnp.stack([X, 2.0 * X]))
    np.testing.assert_allclose(both[1], np.cos(2.0 * X) * (0.41 + most), rtol=1e-15)
    assert len(emitted) == times - 1
