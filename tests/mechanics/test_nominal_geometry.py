"""The perfect mechanism in NumPy against the kinematics and the closure of the equations of motion."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfem_jax import Coordinates, InputError, assembly_errors, describe, discretise
from rfem_jax.mechanics.dynamics import loads
from rfem_jax.mechanics.kinematics.cut_joints import closure
from rfem_jax.mechanics.kinematics.motion import motion_of
from rfem_jax.mechanics.model.model import length_scale
from rfem_jax.mechanics.model.nominal_geometry import closure_jacobian, gaps, geometry_of, place, vector_product
from rfem_jax.mechanics.model.with_errors import apply_errors
from rfem_jax.report.contents.overview import count_lines
from tests.mechanisms import link, twisted_spatial_loop, two_loop_six_bar


@eqx.filter_jit
def _traced(model, angles):
    scale = length_scale(model)

    def residual(position):
        actual = apply_errors(model, assembly_errors(model))
        cuts = closure(actual, motion_of(actual, loads.static_state(model.topology, position)), scale)
        out = cuts.residual.T.reshape(-1) / scale
        return out, (out, cuts.alignment, cuts.angle)

    position = Coordinates(angles, jnp.zeros((6, model.topology.n_rfes)))
    jacobian, values = jax.jacfwd(residual, has_aux=True)(position)
    lengths = jnp.array([1.0, 1.0, 1.0, 0.0, 0.0, 0.0]) * (scale - 1.0) + 1.0
    elastic = jnp.moveaxis(jacobian.elastic * lengths[None, :, None], 1, 2)
    return jnp.concatenate([jacobian.joints, elastic.reshape(len(elastic), -1)], axis=1), values


@pytest.mark.long
@pytest.mark.parametrize("mechanism", [two_loop_six_bar, twisted_spatial_loop])
def test_geometry_and_jacobian_are_those_of_the_equations_of_motion(mechanism):
    """Two loops with a joint in the middle of a link, and skew axes; loops open and out of line."""
    model = discretise(mechanism())
    angles = np.asarray(model.start_joints) + np.linspace(-0.3, 0.4, model.topology.n_links)
    geometry = geometry_of(model)
    placed = place(geometry, angles)
    jacobian, values = _traced(model, jnp.asarray(angles))
    np.testing.assert_allclose(closure_jacobian(geometry, placed), jacobian, atol=1e-13)
    for got, expected in zip(gaps(geometry, placed), values, strict=True):
        assert np.abs(expected).max() > 0.01
        np.testing.assert_allclose(got, expected, atol=1e-13)


def test_a_long_open_chain_is_described():
    from rfem_jax import Joint, Mechanism

    names = [f"l{i}" for i in range(30)]
    joints = [Joint(f"J{i}", "base" if i == 0 else names[i - 1], name, angle=0.1) for i, name in enumerate(names)]
    model = discretise(Mechanism([link(name, 0.1, 3) for name in names], joints, driven_joint="J0"))
    structure = describe(model)
    assert (structure.coordinates, structure.rank, structure.rigid_mobility) == (390, 0, 30)


def test_an_overconstrained_loop_closes_as_well_as_its_angles_were_typed():
    """A Bennett linkage with six decimals, as in a study file: flexible links take up the rest, rigid ones cannot."""
    exact = twisted_spatial_loop()
    joints = tuple(
        replace(
            joint,
            orientation=tuple(round(x, 6) for x in joint.orientation),
            child_orientation=tuple(round(x, 6) for x in joint.child_orientation),
        )
        for joint in exact.joints
    )
    typed = replace(exact, joints=joints)
    before, after = (describe(discretise(mechanism)) for mechanism in (exact, typed))
    assert before.gap < 1e-15 and 1e-9 < after.gap < 1e-7
    assert after._replace(gap=before.gap) == before and after.rigid_mobility == 1
    assert "stays open by 4" in " ".join(count_lines(typed, after))
    links = tuple(replace(one, rfes=1) for one in typed.links)
    with pytest.raises(InputError, match="more decimals"):
        discretise(replace(typed, links=links, redundant_reactions="minimum_norm"))


@pytest.mark.parametrize("left, right", [((3,), (3,)), ((3,), (5, 3)), ((4, 3), (2, 4, 3)), ((2, 1, 3), (4, 3))])
def test_vector_products_of_batches(left, right):
    generator = np.random.default_rng(3)
    a, b = generator.normal(size=left), generator.normal(size=right)
    np.testing.assert_array_equal(vector_product(a, b), np.cross(a, b))
