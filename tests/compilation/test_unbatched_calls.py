"""Within `jax.vmap` a body is traced again only where something that goes into it has a batch, or may ask for it."""

from contextlib import nullcontext

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.interpreters import batching

from rfem_jax.compilation import options
from rfem_jax.compilation.unbatched_calls import WITH_BODIES, keep_unbatched_calls


def by_branch(x):
    return jax.lax.cond(x > 0.0, lambda x: jnp.sin(x), lambda x: 2.0 * x, x)


def by_loop(x):
    return jax.lax.while_loop(lambda x: x < 3.0, lambda x: 1.5 * jnp.cosh(x), x)


def by_scan(x):
    return jax.lax.scan(lambda c, _: (jnp.sin(c) + 1.0, None), x, length=3)[0]


BODIES = {
    "jit": jax.jit(lambda x: jnp.sin(x) * 3.0),
    "checkpoint": jax.checkpoint(lambda x: jnp.cos(x) + 1.0),
    **{body.__name__: body for body in (by_branch, by_loop, by_scan)},
}


@pytest.fixture(autouse=True)
def _kept():
    keep_unbatched_calls()


def bodies_of(closed) -> list:
    return [
        part
        for equation in closed.jaxpr.eqns
        for value in equation.params.values()
        for part in (value if isinstance(value, tuple) else (value,))
        if hasattr(part, "eqns")
    ]


@pytest.mark.parametrize("name", BODIES)
def test_jax_batches_only_what_has_a_batch(name, monkeypatch):
    body, other, given = BODIES[name], np.float64(0.7), np.linspace(0.1, 1.0, 4)

    def mixed(x):
        return body(jnp.asarray(other)) + body(x)

    with options.own_program():
        (primitive,) = (e.primitive for e in jax.make_jaxpr(body)(given[0]).eqns if e.primitive.name in WITH_BODIES)
        rule, asked = batching.fancy_primitive_batchers[primitive], []
        monkeypatch.setattr(
            rule, "rule", lambda *args, jaxs=rule.rule, **kw: asked.append(args[2]) or jaxs(*args, **kw)
        )
        program = jax.make_jaxpr(jax.vmap(mixed))(given)
    assert asked and all(any(place is not None for place in places) for places in asked)
    np.testing.assert_allclose(jax.core.eval_jaxpr(program.jaxpr, program.consts, given)[0], [mixed(x) for x in given])


def test_a_body_may_ask_for_an_axis_by_its_name():
    inner = jax.jit(lambda x: jax.lax.psum(x, "samples"))
    with options.own_program():
        found = jax.vmap(lambda _: inner(2.0), axis_name="samples")(jnp.zeros(5))
    np.testing.assert_array_equal(found, 10.0)


def test_other_programs_are_left_to_jax(monkeypatch):
    traced = []
    monkeypatch.setattr(options, "in_own_program", lambda: traced.append(1) or False)
    inner = jax.jit(lambda x: jnp.sin(x))
    assert jax.vmap(lambda x: inner(1.0) + x)(jnp.zeros(2)).shape == (2,) and traced


@pytest.mark.parametrize("own", [True, False])
def test_what_derivatives_do_not_depend_on_is_not_traced_again(own):
    body = jax.jit(lambda x: jnp.sin(x) * jnp.cos(x))

    def traced(function, argument):
        with options.own_program() if own else nullcontext():
            return bodies_of(jax.make_jaxpr(function)(argument))

    (alone,) = traced(lambda x: body(x), jnp.ones(3))
    within = traced(jax.jacfwd(lambda x: body(jnp.ones(3)) * x), jnp.ones(3))
    assert any(one is alone for one in within) == own
