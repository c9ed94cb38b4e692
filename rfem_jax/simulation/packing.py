"""Results of a loop as few arrays, none with the shape of another.

Place in the pipeline: **packing** -> integration.

XLA fuses the writing of several results of one shape, and then goes through the results of all turns in every
turn of the loop.  A result that is alone with its shape is written in its place.
"""

import jax
import jax.numpy as jnp
from jaxtyping import PyTree


def pack(tree: PyTree) -> list[jax.Array]:
    """The arrays of a tree stacked where they are of one shape and type; `unpack` with the tree's form undoes it,
    also after a loop has given every array a first axis."""
    leaves = jax.tree.leaves(tree)
    packed: list[jax.Array] = []
    for places in _groups(leaves):
        part = jnp.stack([leaves[i] for i in places])
        while any(part.shape == other.shape and part.dtype == other.dtype for other in packed):
            part = part[None]
        packed.append(part)
    return packed


def unpack(packed: list[jax.Array], form: PyTree) -> PyTree:
    """The tree whose turns of a loop were packed; `form`: arrays or shapes of one turn."""
    leaves, tree = jax.tree.flatten(form)
    found = {}
    for part, places in zip(packed, _groups(leaves)):
        shape = leaves[places[0]].shape
        part = part.reshape((part.shape[0], len(places), *shape))
        found.update({i: part[:, k] for k, i in enumerate(places)})
    return jax.tree.unflatten(tree, [found[i] for i in range(len(leaves))])


def _groups(leaves) -> list[list[int]]:
    """Places of the leaves of each shape and type, in order."""
    groups: dict[tuple, list[int]] = {}
    for i, leaf in enumerate(leaves):
        groups.setdefault((leaf.shape, leaf.dtype), []).append(i)
    return list(groups.values())
