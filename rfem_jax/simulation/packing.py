"""Results of a loop stacked into few arrays, no two of them of one shape.

Place in the pipeline: **packing** -> integration.

Where a loop writes several results of one shape, XLA's CPU compiler fuses the writes and then copies the results of
all iterations in every iteration.  A result that no other has the shape of is updated in place.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, PyTree, Shaped


def pack(tree: PyTree) -> list[Shaped[Array, "..."]]:
    """Stack the arrays of a tree that have one shape and type.

    `unpack` undoes it, also after a loop has given every array a first axis.
    """
    leaves = jax.tree.leaves(tree)
    packed: list[Array] = []
    for places in _groups(leaves):
        part = jnp.stack([leaves[i] for i in places])
        while any(part.shape == other.shape and part.dtype == other.dtype for other in packed):
            part = part[None]
        packed.append(part)
    return packed


def unpack(packed: list[Shaped[Array, "iterations ..."]], form: PyTree) -> PyTree:
    """The tree whose iterations were packed, with a first axis of iterations.

    **Arguments:** `form`: the tree of one iteration, of arrays or of `jax.ShapeDtypeStruct`.
    """
    leaves, tree = jax.tree.flatten(form)
    found = {}
    for part, places in zip(packed, _groups(leaves)):
        shape = leaves[places[0]].shape
        part = part.reshape((part.shape[0], len(places), *shape))
        found.update({i: part[:, k] for k, i in enumerate(places)})
    return jax.tree.unflatten(tree, [found[i] for i in range(len(leaves))])


def _groups(leaves) -> list[list[int]]:
    """Indices of the leaves of each shape and type, in order."""
    groups: dict[tuple, list[int]] = {}
    for i, leaf in enumerate(leaves):
        groups.setdefault((leaf.shape, leaf.dtype), []).append(i)
    return list(groups.values())
