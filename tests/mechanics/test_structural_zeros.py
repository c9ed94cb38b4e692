"""Entries that are said to be zero for all numbers are: with all errors at once, and no others where no
point mass breaks the symmetry of a segment."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfem_jax import discretise
from rfem_jax.mechanics import condensation, realisation
from tests.mechanisms import four_bar, six_link_loop, some_errors, three_link_loop


def four_bar_of_long_chains():
    return four_bar(12)


@pytest.mark.parametrize("make", [four_bar, four_bar_of_long_chains, three_link_loop, six_link_loop])
def test_structural_zeros(make):
    model = discretise(make())
    topology = model.topology
    realised = realisation.realise(model, some_errors(model, np.random.default_rng(1)))
    operators = condensation.link_operators(realised, jnp.asarray(1e-6), jnp.asarray(1e-3))
    values = realised, operators
    zeros = realisation.structural_zeros(topology), condensation.structural_zeros(topology)
    assert jax.tree.structure(values) == jax.tree.structure(zeros)
    some = 0
    for value, zero in zip(jax.tree.leaves(values), jax.tree.leaves(zeros)):
        zero = np.broadcast_to(zero, value.shape)
        assert not np.asarray(value)[zero].any()
        some += zero.sum()
    assert some > 50
    if not topology.masses and make is not four_bar_of_long_chains:
        operator, zero = next((a, b) for a, b in zip(*(values[1], zeros[1])) if a is not None)
        jax.tree.map(
            lambda value, known: np.testing.assert_array_equal(np.asarray(value) == 0.0, known), operator, zero
        )
        for name in ("inertia", "inverse_inertia"):
            np.testing.assert_array_equal(np.asarray(getattr(realised, name)) == 0.0, getattr(zeros[0], name))
