"""One context of tracing for functions and for the rules of their derivatives.

Place in the pipeline: `program` and `executable` trace within it.

`jax.jit` traces a function again where JAX's settings differ from those that it was traced with before.  Before JAX
0.12 one of them does for no reason: a rule of `jax.custom_jvp` in the body of a loop is traced with an empty mesh of
devices, and everything else without one.  What a function and its rule share would be traced twice.
"""

from contextlib import AbstractContextManager

import jax


def same_context() -> AbstractContextManager:
    """In which the mesh of devices is the one that rules see: the user's, or the empty one."""
    return jax.sharding.use_abstract_mesh(jax.sharding.get_abstract_mesh())
