"""The same batch axes in a function with its own rule of differentiation and in that rule.

Place in the pipeline: **batches** -> implicit_step, stepping, integration.

`jax.vmap` of a `jax.custom_jvp` function takes the batch axes of the function's results to be those of its rule
(jax issue 16374).  It derives the two separately: a result that does not depend on the sample may have a batch axis
in one and none in the other.  `with_batch_axes`, applied in both, gives all results the same axes.

JAX transforms a loop again and again until it knows which of the arrays that go around in it have a batch axis, and
which a tangent.  Where all have them from the start, once is enough, also for the loops inside.
"""

from typing import TypeVar

import jax
import jax.numpy as jnp
from jaxtyping import Array

Tree = TypeVar("Tree")


def with_batch_axes(tree: Tree, *sources: Array, differentiated: bool = False) -> Tree:
    """The tree, with the batch axes of any of the sources added to every array.

    Values and derivatives are unchanged: the selection below has a constant condition, which XLA folds away.

    **Arguments:** `tree`: of arrays of any shapes; `sources`: arrays of any shapes, none of them empty;
    `differentiated`: whether the arrays have a tangent, of zeros, where any source has one.
    """
    sources = sources if differentiated else jax.lax.stop_gradient(sources)
    token = jnp.asarray(sum(source.ravel()[0] for source in sources))
    never = jnp.zeros((), bool)

    def chosen(x):
        return jax.lax.select_n(never, x, jnp.broadcast_to(token.astype(x.dtype), x.shape))

    return jax.tree.map(chosen, tree)
