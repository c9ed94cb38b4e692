"""What a function and the rule of its derivative share is traced once."""

import jax
import jax.numpy as jnp
import numpy as np

from rfem_jax.compilation.program import Program
from rfem_jax.compilation.tracing_context import same_context

traced = []


@jax.jit
def shared(x):
    traced.append(x)
    return jnp.sin(x)


@jax.custom_jvp
def function(x):
    return shared(x)


@function.defjvp
def _(primals, tangents):
    (x,), (along,) = primals, tangents
    return shared(x), shared(x + 0.5 * np.pi) * along


program = Program(lambda x: jax.lax.scan(lambda carry, _: (function(carry), None), x, length=3)[0])


def test_a_rule_finds_what_was_traced_for_the_function():
    """In a loop, whose body JAX differentiates after it has been traced."""
    jax.clear_caches()
    traced.clear()
    jax.make_jaxpr(jax.jacfwd(program))(0.3)
    assert len(traced) == 1


def test_a_mesh_that_the_user_has_set_stays():
    mesh = jax.sharding.AbstractMesh((1,), ("samples",))
    with jax.sharding.use_abstract_mesh(mesh):
        with same_context():
            assert jax.sharding.get_abstract_mesh() == mesh
        assert jax.sharding.get_abstract_mesh() == mesh
    assert jax.sharding.get_abstract_mesh().empty
