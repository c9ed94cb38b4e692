"""The static equilibrium found by recursion over the links, against Newton's method with the dense Jacobian."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from rfem_jax import Coordinates, Joint, Mechanism, assembly_errors, discretise
from rfem_jax.kernels import is_available
from rfem_jax.mechanics.model.status import NOT_ASSEMBLED, OK
from rfem_jax.mechanics.model.with_errors import apply_errors
from rfem_jax.mechanics.statics import search, settling, static_equations
from tests.mechanisms import four_bar, link, some_errors, twisted_spatial_loop


def four_bar_of_long_chains():
    return four_bar(10)


def equilibria(make):
    """Function of a share of some errors and of a rotation of the first joint: coordinates and multipliers, status."""
    model = discretise(make())
    errors = some_errors(model, np.random.default_rng(2))

    def at(share, rotation):
        actual = apply_errors(model, jax.tree.map(lambda x: share * x, errors))
        *found, status = settling.equilibrium(model, actual, {0: model.start_joints[0] + rotation})
        return found, status

    return at


def with_derivatives(at):
    """Values, derivatives along both arguments, backward of one number and the same forward, status."""

    @jax.jit
    def evaluate(share, rotation):
        values, jvp, status = jax.linearize(at, share, rotation, has_aux=True)
        forward = jvp(1.0, 0.0), jvp(0.0, 1.0)
        weights = jax.tree.map(lambda x: jnp.cos(jnp.arange(x.size)).reshape(x.shape), values)

        def number(values):
            return sum(map(jnp.vdot, jax.tree.leaves(weights), jax.tree.leaves(values)))

        backward = jax.linear_transpose(jvp, share, rotation)(weights)
        return values, forward, backward, tuple(map(number, forward)), status

    return evaluate(jnp.asarray(0.7), jnp.asarray(0.05))


def without_matrix(function, at, *others):
    """In the place of the Jacobian, where the recursion must do."""
    return function(at, *others), jnp.full((at.size, at.size), jnp.nan)


@pytest.mark.long
@pytest.mark.parametrize("make", [four_bar_of_long_chains, twisted_spatial_loop])
def test_recursion_alone_finds_the_equilibrium_and_its_derivatives(make, monkeypatch):
    with monkeypatch.context() as patch:
        patch.setattr(search, "linearised", without_matrix)
        patch.setattr(search, "solve_dense", lambda equations, linear, value: jnp.full_like(value, jnp.nan))
        *found, status = with_derivatives(equilibria(make))
        assert status == OK
    with monkeypatch.context() as patch:
        patch.setattr(
            settling,
            "chord",
            lambda equations, preconditioner, rows, *place, **options: (*search.newton(equations, *place), False),
        )
        patch.setattr(
            settling,
            "solve_linear",
            lambda equations, preconditioner, *rest: search.solve_dense(equations, *rest),
        )
        *expected, status = with_derivatives(equilibria(make))
        assert status == OK
    for one, other in zip(jax.tree.leaves(found), jax.tree.leaves(expected)):
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-8 * np.abs(other).max())
    *_, backward, ahead = found
    np.testing.assert_allclose(backward, ahead, rtol=1e-9)


@pytest.mark.skipif(not is_available(), reason="llvmlite gives kernels their machine code")
@pytest.mark.parametrize("derivative", [jax.jacfwd, jax.jacrev])
def test_no_loop_around_kernels_is_left_to_xla(derivative):
    """Which takes seconds to compile them, for the search, which has no derivatives, and for the refinement in those of
    the equilibrium."""
    at = equilibria(lambda: four_bar(2))
    text = jax.jit(jax.vmap(derivative(lambda share: at(share, 0.05)[0]))).lower(jnp.ones(3)).as_text()
    assert "kernel_" in text
    assert "stablehlo.while" not in text


@pytest.mark.long
@pytest.mark.parametrize("make, most, rounding", [(four_bar, 1e-3, 1e-12), (twisted_spatial_loop, 1e-2, 1e-3)])
def test_the_preconditioner_is_nearly_exact(make, most, rounding):
    """Of a mechanism at rest, undeformed: spectral radius of the iteration. It is symmetric, but for the signs of rows
    and rounding, which grows as inertia becomes small, and has as many negative eigenvalues as closure equations."""
    model = discretise(make())
    actual = eqx.tree_at(lambda r: r.gravity, apply_errors(model, assembly_errors(model)), jnp.zeros(3))
    scaled = static_equations.scaled_unknowns(model, actual)
    start = scaled.unknowns(model.start_coordinates(), jnp.zeros(model.topology.n_constraints))
    given = np.array([0])

    def residual(unknowns):
        position, multipliers = scaled.coordinates(unknowns), scaled.multipliers(unknowns)
        hinge, *others = static_equations.static_residual(actual, position, multipliers, scaled.length)
        value = scaled.residual(Coordinates(hinge, others[0]), others[1])
        return value.at[given].set(unknowns[given])

    @jax.jit
    def iteration():
        preconditioner = settling._preconditioner(scaled, given, actual, start)
        by_columns = jax.vmap(preconditioner, 1, 1)
        return jnp.eye(start.size) - by_columns(jax.jacfwd(residual)(start)), by_columns(jnp.eye(start.size))

    change, inverse = iteration()
    assert 0.0 < np.abs(np.linalg.eigvals(change)).max() < most
    rows, constraints = np.arange(start.size), model.topology.n_constraints
    signs = np.where(rows < model.topology.n_freedoms, 1.0, -1.0)
    inverse = (np.asarray(inverse) * signs)[len(given) :, len(given) :]
    np.testing.assert_allclose(inverse, inverse.T, rtol=0, atol=rounding * np.abs(inverse).max())
    assert np.sum(np.linalg.eigvalsh(inverse + inverse.T) < 0.0) == constraints


@pytest.mark.slow
def test_where_the_recursion_does_not_converge_the_jacobian_does(monkeypatch):
    """Weight alone holds a pendulum, no spring."""
    model = discretise(Mechanism([link("rod", 0.3, 3)], [Joint("A", "base", "rod", angle=1.4)]))
    actual = apply_errors(model, assembly_errors(model))

    def at(gravity):
        loaded = eqx.tree_at(lambda r: r.gravity, actual, gravity)
        position, _, status = settling.equilibrium(model, loaded, {})
        return position.joints[0], status

    @jax.jit
    def both(gravity):
        angle, jvp, status = jax.linearize(at, gravity, has_aux=True)
        derivatives = jax.vmap(jvp)(jnp.eye(3)), jax.linear_transpose(jvp, gravity)(1.0)[0]
        return (angle, status), derivatives

    gravity = jnp.asarray([0.6, 0.0, -9.8])
    (angle, status), derivatives = both(gravity)
    assert status == OK
    np.testing.assert_allclose(angle, np.pi / 2 - np.arctan(0.6 / 9.8), atol=1e-5)
    np.testing.assert_allclose(derivatives[0][0], -9.8 / (0.6**2 + 9.8**2), rtol=1e-4)
    np.testing.assert_allclose(derivatives[0], derivatives[1], rtol=1e-9)
    monkeypatch.setattr(search, "linearised", without_matrix)
    assert jax.jit(at)(gravity)[1] == NOT_ASSEMBLED


@pytest.mark.slow
def test_rates_of_a_start_that_moves_are_those_of_equilibria():
    """Of the same search: position, multipliers and status are those of rest."""
    model = discretise(four_bar(rfes=2))
    actual = apply_errors(model, assembly_errors(model, {"D.delta_x": 5e-3, "C.child.d_y": 2e-4}))

    @jax.jit
    def moving(angle):
        return settling.moving_equilibrium(model, actual, {0: angle}, {0: jnp.asarray(30.0)})

    def resting(angle):
        return settling.equilibrium(model, actual, {0: angle})

    angle, step = model.start_joints[0], 1e-5
    state, multipliers, status = moving(angle)
    ahead, behind = (moving(angle + sign * step)[0].position for sign in (1.0, -1.0))
    position, same_multipliers, same_status = jax.jit(resting)(angle)
    assert int(status) == int(same_status) == 0
    jax.tree.map(lambda x, y: np.testing.assert_allclose(x, y, rtol=0, atol=1e-13), position, state.position)
    np.testing.assert_allclose(multipliers, same_multipliers, rtol=1e-12)
    for rate, one, other in zip(jax.tree.leaves(state.velocity), jax.tree.leaves(ahead), jax.tree.leaves(behind)):
        difference = 30.0 * (one - other) / (2.0 * step)
        np.testing.assert_allclose(rate, difference, rtol=1e-6, atol=1e-6 * np.abs(difference).max())
    assert float(state.velocity.joints[0]) == 30.0
