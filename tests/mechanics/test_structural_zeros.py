"""Entries that are said to be zero for all numbers are: with all errors at once, and no others where no
point mass breaks the symmetry of a segment."""

import jax
import numpy as np
import pytest

from rfem_jax import discretise
from rfem_jax.mechanics import model_with_errors
from tests.mechanisms import four_bar, six_link_loop, some_errors, three_link_loop


def four_bar_of_long_chains():
    return four_bar(12)


@pytest.mark.parametrize("make", [four_bar, four_bar_of_long_chains, three_link_loop, six_link_loop])
def test_structural_zeros(make):
    model = discretise(make())
    topology = model.topology
    actual = model_with_errors.apply_errors(model, some_errors(model, np.random.default_rng(1)))
    zeros = model_with_errors.structural_zeros(actual)
    assert jax.tree.structure(actual) == jax.tree.structure(zeros)
    some = 0
    for value, zero in zip(jax.tree.leaves(actual), jax.tree.leaves(zeros)):
        zero = np.broadcast_to(zero, value.shape)
        assert not np.asarray(value)[zero].any()
        some += zero.sum()
    assert some > 50
    if not topology.masses and make is not four_bar_of_long_chains:
        for name in ("inertia", "inverse_inertia"):
            np.testing.assert_array_equal(np.asarray(getattr(actual, name)) == 0.0, getattr(zeros, name))
