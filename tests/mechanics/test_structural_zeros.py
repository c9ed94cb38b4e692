"""Entries that are said to be zero for all numbers are: with all errors at once, and no others where no
point mass breaks the symmetry of a segment."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfem_jax import discretise
from rfem_jax.mechanics.model import with_errors as model_with_errors
from rfem_jax.mechanics.model.with_errors import with_structural_zeros
from tests.mechanisms import four_bar, six_link_loop, some_errors, three_link_loop


def four_bar_of_long_chains():
    return four_bar(12)


@pytest.mark.parametrize("make", [four_bar, four_bar_of_long_chains, three_link_loop, six_link_loop])
def test_structural_zeros(make):
    model = discretise(make())
    topology = model.topology
    actual = model_with_errors.apply_errors(model, some_errors(model, np.random.default_rng(1)))
    for value, same in zip(jax.tree.leaves(actual), jax.tree.leaves(with_structural_zeros(actual)), strict=True):
        np.testing.assert_array_equal(value, same)
    unknown = jax.tree.map(lambda x: jnp.full(x.shape, jnp.nan), actual)
    known = with_structural_zeros(unknown)
    assert sum((np.asarray(x) == 0.0).sum() for x in jax.tree.leaves(known)) > 50
    if not topology.masses and make is not four_bar_of_long_chains:
        for name in ("inertia", "inverse_inertia"):
            zeros = np.asarray(getattr(known, name)) == 0.0
            np.testing.assert_array_equal(np.asarray(getattr(actual, name)) == 0.0, zeros)
