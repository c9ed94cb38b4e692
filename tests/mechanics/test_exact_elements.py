"""Geometrically exact spring-damping elements: their energy, their wrenches, what must not change."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfem_jax import Coordinates, InputError, Mechanism, State, assembly_errors, discretise
from rfem_jax.kernels import kernel
from rfem_jax.mechanics.elements import elasticity
from rfem_jax.mechanics.kinematics.motion import relative_motion
from rfem_jax.mechanics.model.with_errors import apply_errors
from rfem_jax.mechanics.reference.face_deflections import exact_deflections
from rfem_jax.mechanics.reference.node_transforms import transforms
from tests.mechanisms import four_bar, open_chain, random_state, some_errors


def actual_chain(elements, errors=None):
    model = discretise(open_chain(), elements=elements)
    return model, apply_errors(model, assembly_errors(model) if errors is None else errors)


@pytest.fixture(scope="module")
def exact():
    """Model of the open chain with errors, and a state far from equilibrium."""
    model = discretise(open_chain(), elements="geometrically_exact")
    rng = np.random.default_rng(3)
    actual = apply_errors(model, some_errors(model, rng))
    return model, actual, random_state(model, rng)


def generalised(actual, state):
    relative = relative_motion(actual, state.position, state.velocity)
    return elasticity.generalised_forces(actual, state, relative)[0]


def with_elastic(position, elastic):
    return Coordinates(position.joints, elastic)


def at_rest(position):
    return State(position, jax.tree.map(jnp.zeros_like, position))


@kernel
def spring_forces(actual, elastic):
    position = Coordinates(jnp.zeros(actual.topology.n_links), elastic)
    return generalised(actual, at_rest(position))


def energy(actual, elastic):
    position = Coordinates(jnp.zeros(actual.topology.n_links), elastic)
    return elasticity.elastic_energy(actual, position)


def test_spring_forces_are_minus_the_gradient_of_the_energy(exact):
    _, actual, state = exact
    gradient = np.asarray(kernel(jax.grad(energy, argnums=1))(actual, state.position.elastic))
    forces = np.asarray(spring_forces(actual, state.position.elastic))
    scale = np.abs(gradient).max(axis=1, keepdims=True)
    np.testing.assert_allclose(forces / scale, -gradient / scale, rtol=0, atol=1e-11)


def test_dampers_do_the_work_of_the_dissipated_power(exact):
    """Also: their generalised forces are minus half the derivative of the power by the rates."""
    _, actual, state = exact

    @kernel
    def both(actual, state):
        damping = generalised(actual, state) - generalised(actual, at_rest(state.position))

        def power(rates):
            velocity = Coordinates(state.velocity.joints, rates)
            return elasticity.dissipated_power(actual, State(state.position, velocity))

        value, derivative = jax.value_and_grad(power)(state.velocity.elastic)
        return damping, value, derivative

    damping, power, derivative = map(np.asarray, both(actual, state))
    assert power > 1.0
    np.testing.assert_allclose(-np.sum(damping * state.velocity.elastic), power, rtol=1e-9)
    np.testing.assert_allclose(damping, -0.5 * derivative, rtol=0, atol=1e-9 * np.abs(derivative).max())


def test_rates_of_the_deflections_are_their_derivatives(exact):
    _, actual, state = exact

    @kernel
    def both(actual, state):
        def stretch(position):
            return elasticity.deflections(actual, at_rest(position))[0]

        derivative = jax.jvp(stretch, (state.position,), (state.velocity,))[1]
        return derivative, elasticity.deflections(actual, state)[1]

    derivative, rate = map(np.asarray, both(actual, state))
    np.testing.assert_allclose(rate, derivative, rtol=1e-10, atol=1e-12 * np.abs(derivative).max())


@pytest.mark.long
@pytest.mark.parametrize("size", [0.0, 1e-9, 1e-4, 0.04, 0.15, 0.5, 1.0])
def test_deflections_meet_those_of_transforms_at_every_size(exact, size):
    """From angles within the series to rotations beyond 90 deg between neighbours."""
    _, actual, state = exact
    position = with_elastic(state.position, size * state.position.elastic)
    ours, _ = elasticity.deflections(actual, at_rest(position))
    reference = exact_deflections(actual, jnp.stack(transforms(actual, position)))
    # Those of transforms subtract positions of global size.
    np.testing.assert_allclose(ours[:3], reference[:3], rtol=0, atol=1e-15)
    np.testing.assert_allclose(ours[3:], reference[3:], rtol=1e-14, atol=1e-15)
    largest = np.sqrt(np.max(np.sum(np.asarray(reference[3:]) ** 2, axis=0)))
    assert 0.2 * size <= largest <= 2.0 * size


def angles_of(rotation):
    """Angles of R = R_y R_z R_x."""
    return jnp.stack(
        [
            jnp.arctan2(-rotation[1, 2], rotation[1, 1]),
            jnp.arctan2(-rotation[2, 0], rotation[0, 0]),
            jnp.arcsin(rotation[1, 0]),
        ]
    )


@pytest.mark.slow
def test_a_rigid_motion_of_both_faces_changes_nothing(exact):
    """All free rfes of a link rotate and shift together: only its first sde is deflected."""
    _, actual, state = exact
    spin, shift = jnp.array([0.3, -0.5, 0.4]), jnp.array([0.02, 0.01, -0.03])
    skew = jnp.cross(jnp.eye(3), spin)
    relative = relative_motion(actual, state.position, state.velocity)

    def moved(share):
        rotation = jax.scipy.linalg.expm(share * skew)
        place = rotation @ relative.position + share * shift[:, None]
        u = place.at[0].add(-actual.rest)
        rotated = jnp.einsum("ij,jkn->ikn", rotation, relative.rotation)
        return jnp.concatenate([u, jax.vmap(angles_of, 2, 1)(rotated)])

    def stretch(share):
        position = with_elastic(state.position, moved(share))
        return elasticity.deflections(actual, at_rest(position))[0]

    (before, rate), after = kernel(lambda: (jax.jvp(stretch, (0.0,), (1.0,)), stretch(0.8)))()
    first = [a for a, b in actual.topology.ranges if b > a]
    inner = np.setdiff1d(np.arange(actual.topology.n_rfes), first)
    np.testing.assert_allclose(after[:, inner], before[:, inner], rtol=0, atol=1e-14)
    np.testing.assert_allclose(rate[:, inner], 0.0, atol=1e-14)
    assert np.abs(after[:, first] - before[:, first]).min(axis=1).max() > 0.1


@pytest.mark.long
def test_both_forms_have_the_same_stiffness_when_undeformed():
    """The Hessian of the exact energy, by differentiating twice at zero, is the linear stiffness."""
    hessians = []
    for elements in ("linear", "geometrically_exact"):
        _, actual = actual_chain(elements)
        zero = jnp.zeros((6, actual.topology.n_rfes))
        hessian = kernel(jax.hessian(energy, argnums=1))(actual, zero)
        by_force = -kernel(jax.jacfwd(spring_forces, argnums=1))(actual, zero)
        n = zero.size
        hessians += [np.asarray(hessian).reshape(n, n), np.asarray(by_force).reshape(n, n)]
    scale = np.sqrt(np.diag(hessians[0]))
    for other in hessians[1:]:
        gap = (other - hessians[0]) / scale[:, None] / scale[None, :]
        np.testing.assert_allclose(gap, 0.0, atol=1e-12)


@pytest.mark.slow
def test_second_derivatives_of_forces_at_zero_are_those_nearby():
    """No limit of a quotient, root or inverse sine may make them NaN or wrong."""
    _, actual = actual_chain("geometrically_exact")
    zero = jnp.zeros((6, actual.topology.n_rfes))
    curve = kernel(jax.jacfwd(jax.jacrev(spring_forces, argnums=1), argnums=1))
    at_zero = np.asarray(curve(actual, zero))
    nearby = np.asarray(curve(actual, zero + 1e-8))
    assert np.isfinite(at_zero).all() and np.abs(at_zero).max() > 1.0
    np.testing.assert_allclose(at_zero, nearby, rtol=0, atol=1e-6 * np.abs(nearby).max())


def test_both_forms_differ_in_second_order(exact):
    _, _, state = exact
    gaps = []
    for size in (1e-3, 5e-4):
        elastic = size * state.position.elastic
        linear, large = (
            np.asarray(spring_forces(actual_chain(elements)[1], elastic))
            for elements in ("linear", "geometrically_exact")
        )
        gaps.append(np.abs(large - linear).max(axis=1) / np.abs(linear).max(axis=1))
    assert gaps[0].max() < 0.05
    np.testing.assert_allclose(gaps[0] / gaps[1], 2.0, rtol=0.02)


def test_the_choice_of_elements():
    """By the mechanism, or by `discretise`, which has the last word; an unknown one is refused."""
    described = four_bar(elements="geometrically_exact")
    assert discretise(described).topology.exact
    assert not discretise(described, elements="linear").topology.exact
    assert not discretise(four_bar()).topology.exact
    with pytest.raises(InputError, match="`elements` must be one of"):
        discretise(four_bar(), elements="exact")
    with pytest.raises(InputError, match="geometrically_exact"):
        Mechanism(described.links, described.joints, elements="geometricaly_exact")
