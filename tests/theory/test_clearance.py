"""Joints with clearance at rest: derivatives, and batches in different states of contact.

`validation.clearances` has the mechanisms, closed forms and values of independent programs, which the tests of
validation check.
"""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfem_jax import assemble, assembly_errors, design, designed, discretise
from rfem_jax.mechanics.model.with_errors import apply_errors
from rfem_jax.mechanics.statics import contact
from rfem_jax.mechanics.statics.assembly import held_angles
from rfem_jax.mechanics.statics.settling import equilibrium
from rfem_jax.validation.clearances import HARD, HERTZ, PLAY, TILT, depth_at_rest, flexible_four_bar, hung
from tests.derivatives import check_derivatives


@pytest.fixture(scope="module")
def four_bar():
    return discretise(flexible_four_bar())


@pytest.mark.long
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
    @pytest.mark.long
    def test_derivatives_by_clearance_and_misalignment(self, four_bar):
        names = ["D.clearance.radial", "D.clearance.length"]

        def loads(values):
            errors = assembly_errors(four_bar, {"D.delta_z": values[0], "D.d_x": values[3]})
            made = assemble(four_bar, errors, design=design(four_bar, dict(zip(names, values[1:3]))))
            return jnp.stack([jnp.sum(made.preload["D"].moment ** 2), jnp.sum(made.preload["B"].force ** 2)])

        at, steps = [TILT, 5e-5, 0.02, 1e-5], [1e-6, 2e-9, 1e-6, 1e-8]
        check_derivatives(loads, at, steps, reverse=1e-8, differences=1e-5)

    @pytest.mark.long
    def test_samples_of_a_batch_are_in_different_contact_states(self, four_bar):
        def loads(tilt):
            errors = assembly_errors(four_bar, {"D.delta_x": tilt})
            made = assemble(four_bar, errors, design=design(four_bar, {"D.clearance.radial": 1.3e-4}))
            return made.status, made.contacts["D"].normal_force, made.preload["D"].moment

        tilts = jnp.array([0.0, 0.3 * TILT, 2.0 * TILT, 4.0 * TILT])
        together = jax.vmap(loads)(tilts)
        assert not np.asarray(together[0]).any()
        assert {tuple(row[:2] > 1e-6) for row in np.asarray(together[1])} == {(True, True), (False, True)}
        for n in (0, 3):
            for one, row in zip(loads(tilts[n]), together, strict=True):
                np.testing.assert_allclose(row[n], one, rtol=1e-6, atol=1e-8)

    @pytest.mark.long
    def test_little_clearance_of_stiff_contacts_is_the_ideal_hinge(self, four_bar):
        """Of first order in the clearance, and for a linear law in the compliance."""
        ideal = discretise(flexible_four_bar(None))
        errors = {"D.delta_x": TILT, "D.delta_z": -0.5 * TILT, "D.d_y": 2e-4}
        names = [f"D.clearance.{name}" for name in ("radial", "axial", "stiffness", "axial_stiffness")]

        def loads(model, values=None):
            wanted = None if values is None else design(model, dict(zip(names, values)))
            made = assemble(model, assembly_errors(model, errors), design=wanted)
            return jnp.stack([jnp.concatenate(made.preload[name]) for name in "ABCD"]), made.status

        # Rows with little clearance first, those of stiff contacts after them.
        rows = [(c, c, 1e13, 1e13) for c in (4e-6, 2e-6, 1e-6)] + [(1e-10, 1e-10, k, k) for k in (1e9, 1e10)]
        limit = loads(ideal)[0]
        found, status = jax.vmap(lambda values: loads(four_bar, values))(jnp.array(rows))
        assert not np.asarray(status).any()
        off = np.abs(np.asarray(found - limit[None])).max(axis=1) / np.abs(np.asarray(limit)).max(axis=0)
        np.testing.assert_allclose(off[:2] / off[1:3], 2.0, rtol=0.02)
        np.testing.assert_allclose(off[3] / off[4], 10.0, rtol=0.03)
        assert (off[2] < 0.025).all() and (off[4] < 1e-3).all()

    @pytest.mark.long
    def test_the_present_matrix_finds_what_that_of_the_perfect_mechanism_does(self, four_bar, monkeypatch):
        """The latter is not iterated, so that only Newton's method under loads is left."""
        held, wanted = held_angles(four_bar, None), design(four_bar, {"D.clearance.radial": 1.3e-4})

        def found(tilt):
            made = designed(four_bar, wanted, assembly_errors(four_bar, {"D.delta_x": tilt}))
            assert made.errors is not None
            return equilibrium(made.model, apply_errors(made.model, made.errors), held)

        monkeypatch.setattr(contact, "CHORD_ITERATIONS", 0)
        alone = jax.jit(found)
        for tilt in (0.0, TILT, 4.0 * TILT):
            position, _, status = alone(tilt)
            expected = assemble(four_bar, assembly_errors(four_bar, {"D.delta_x": tilt}), design=wanted)
            assert status == expected.status == 0
            np.testing.assert_allclose(position.joints, expected.state.position.joints, rtol=1e-7, atol=1e-10)
            np.testing.assert_allclose(position.elastic, expected.state.position.elastic, rtol=1e-7, atol=1e-10)
