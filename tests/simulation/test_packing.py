"""Results of a loop packed into few arrays: no two have one shape, and unpacking restores all."""

import jax
import jax.numpy as jnp
import numpy as np

from rfem_jax.simulation.packing import pack, unpack

TREE = {
    "scalars": (jnp.asarray(1.0), jnp.asarray(2.0), jnp.asarray(3)),
    "vectors": [jnp.arange(2.0), jnp.arange(3.0), jnp.arange(3.0) + 1.0],
    "pair": jnp.arange(4.0).reshape(2, 2), "nothing": None, "empty": jnp.zeros((0,)),
}  # fmt: skip


def test_no_two_packed_arrays_have_one_shape():
    packed = pack(TREE)
    assert len({(part.shape, part.dtype) for part in packed}) == len(packed) < len(jax.tree.leaves(TREE))


def test_results_of_a_loop_are_those_without_packing():
    def iteration(carry, x):
        return carry, jax.tree.map(lambda leaf: (x * leaf).astype(leaf.dtype), TREE)

    xs = jnp.arange(1.0, 4.0)
    expected = jax.lax.scan(iteration, 0.0, xs)[1]
    found = unpack(jax.lax.scan(lambda c, x: (c, pack(iteration(c, x)[1])), 0.0, xs)[1], TREE)
    assert jax.tree.structure(found) == jax.tree.structure(expected)
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
        np.testing.assert_array_equal(one, other)
        assert one.dtype == other.dtype
