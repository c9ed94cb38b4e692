"""The same batch axes in a function with its own rule of differentiation and in that rule.

Place in the pipeline: **batches** -> implicit_step, stepping.

`jax.vmap` of a `jax.custom_jvp` function takes the batch axes of the function's results to be those of its rule
(jax issue 16374).  It derives the two separately: a result that does not depend on the sample may have a batch axis
in one and none in the other.  `like_batched`, applied in both, gives all results the same axes.
"""

from typing import TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array

Tree = TypeVar("Tree")


def like_batched(tree: Tree, *sources: Array) -> Tree:
    """The tree, with the batch axes of any of the sources added to every array.

    Values and derivatives are unchanged: the selection below has a constant condition, which XLA folds away.

    **Arguments:** `tree`: of arrays of any shapes; `sources`: arrays of any shapes, none of them empty.
    """
    token = jnp.asarray(sum(jax.lax.stop_gradient(source).ravel()[0] for source in sources))
    never = jnp.zeros((), bool)

    def chosen(x):
        return jax.lax.select_n(jnp.broadcast_to(never, x.shape), x, jnp.broadcast_to(token.astype(x.dtype), x.shape))

    return jax.tree.map(chosen, tree)
