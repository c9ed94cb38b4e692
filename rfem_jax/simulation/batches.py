"""Batches of functions that have their own rule of differentiation.

Place in the pipeline: **batches** -> implicit_step, stepping.

Under `jax.vmap`, JAX takes the batch axes of the results of a `jax.custom_jvp` function for those of its
rule (jax issue 16374).  The two find them by different ways, so that a result that does not depend on the
sample has an axis in the one and none in the other.  Both functions therefore give all results the same axes.
"""

import jax
import jax.numpy as jnp


def like_batched(tree, *sources):
    """The tree, every array with the batch axes that any of the sources (arrays, not empty) has.

    The choice below is known when the program is compiled, so nothing of it is left.
    """
    token = sum(jax.lax.stop_gradient(source).ravel()[0] for source in sources)
    never = jnp.zeros((), bool)

    def chosen(x):
        return jax.lax.select_n(jnp.broadcast_to(never, x.shape), x, jnp.broadcast_to(token.astype(x.dtype), x.shape))

    return jax.tree.map(chosen, tree)
