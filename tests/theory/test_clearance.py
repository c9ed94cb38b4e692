"""Joints with clearance at rest: derivatives, and batches in different states of contact.

`validation.clearances` has the mechanisms, closed forms and values of independent programs, which the tests of
validation check.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfem_jax import assemble, assembly_errors, design, discretise
from rfem_jax.validation.clearances import HARD, HERTZ, PLAY, TILT, depth_at_rest, flexible_four_bar, hung


@pytest.fixture(scope="module")
def four_bar():
    return discretise(flexible_four_bar())


def test_derivatives_by_clearance_stiffness_and_mass():
    """Of the place of a pin pressed at rest."""
    hanging = hung(HARD)

    def place(values):
        names = ("D.clearance.radial", "D.clearance.stiffness", "body.mass")
        found = assemble(hanging, assembly_errors(hanging), design=design(hanging, dict(zip(names, values))))
        return found.contacts["D"].eccentricity[0, 1]

    at, depth = jnp.array([PLAY, HERTZ, 2.0]), depth_at_rest()
    expected = [-1.0, 2 / 3 * depth / HERTZ, -2 / 3 * depth / 2.0]
    np.testing.assert_allclose(jax.jacfwd(place)(at), expected, rtol=1e-6)
    np.testing.assert_allclose(jax.grad(place)(at), expected, rtol=1e-6)


class TestFourBar:
    def test_derivatives_by_clearance_and_misalignment(self, four_bar):
        names = ["D.clearance.radial", "D.clearance.length"]

        def loads(values):
            errors = assembly_errors(four_bar, {"D.delta_z": values[0], "D.d_x": values[3]})
            made = assemble(four_bar, errors, design=design(four_bar, dict(zip(names, values[1:3]))))
            return jnp.stack([jnp.sum(made.preload["D"].moment ** 2), jnp.sum(made.preload["B"].force ** 2)])

        at = jnp.array([TILT, 5e-5, 0.02, 1e-5])
        forward, backward = jax.jacfwd(loads)(at), jax.jacrev(loads)(at)
        np.testing.assert_allclose(backward, forward, rtol=1e-8)
        for n, size in enumerate((1e-6, 2e-9, 1e-6, 1e-8)):
            step = size * np.eye(4)[n]
            difference = (loads(at + step) - loads(at - step)) / (2 * size)
            np.testing.assert_allclose(forward[:, n], difference, rtol=1e-5)

    def test_samples_of_a_batch_are_in_different_contact_states(self, four_bar):
        def contact(tilt):
            errors = assembly_errors(four_bar, {"D.delta_x": tilt})
            made = assemble(four_bar, errors, design=design(four_bar, {"D.clearance.radial": 1.3e-4}))
            return made.status, made.contacts["D"].normal_force, made.preload["D"].moment

        tilts = jnp.array([0.0, 0.3 * TILT, 2.0 * TILT, 4.0 * TILT])
        together = jax.vmap(contact)(tilts)
        assert not np.asarray(together[0]).any()
        assert {tuple(row[:2] > 1e-6) for row in np.asarray(together[1])} == {(True, True), (False, True)}
        for n in (0, 3):
            for one, row in zip(contact(tilts[n]), together, strict=True):
                np.testing.assert_allclose(row[n], one, rtol=1e-6, atol=1e-8)
