"""The residual of given accelerations, and Newton increments for implicit steps, against the accelerations
of the recursion and against the Jacobian by automatic differentiation."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.flatten_util import ravel_pytree

from rfem_jax import (
    Coordinates,
    Joint,
    Link,
    Material,
    Mechanism,
    PointMass,
    Rectangle,
    State,
    assembly_errors,
    discretise,
)
from rfem_jax.kernels import kernel
from rfem_jax.mechanics.dynamics.dynamics import accelerations
from rfem_jax.mechanics.elements import elasticity, exact_elements
from rfem_jax.mechanics.implicit.condensation import link_operators, present_operators
from rfem_jax.mechanics.implicit.newton import increment_and_wrenches, iteration_matrix, newton_increment
from rfem_jax.mechanics.implicit.residual import Residual, evaluate_residual, residual_of
from rfem_jax.mechanics.kinematics.motion import relative_motion
from rfem_jax.mechanics.model.inputs import DriveInput, Stabilisation, impose
from rfem_jax.mechanics.model.model import length_scale
from rfem_jax.mechanics.model.with_errors import apply_errors
from rfem_jax.mechanics.statics.settling import equilibrium
from tests.mechanisms import chain_of_kinds, four_bar, twisted_spatial_loop, two_loop_six_bar

PAIRS = [(four_bar, True), (twisted_spatial_loop, False), (two_loop_six_bar, False), (chain_of_kinds, True)]


def loaded_chain():
    """Links with point masses off their axes, one of them on the interface to the next link."""
    steel = Material("steel", youngs_modulus=210e9, density=7850.0, poisson_ratio=0.3, damping=1e-4)
    bar = Rectangle(0.01, 0.02)
    links = [
        Link("one", 0.3, bar, steel, rfes=12, point_masses=[PointMass(0.4, (0.29, 0.03, 0.02))]),
        Link("two", 0.2, bar, steel, rfes=3, point_masses=[PointMass(0.2, (0.1, 0.0, -0.04))]),
    ]
    joints = [Joint("A", "base", "one", angle=0.3), Joint("B", "one", "two", angle=-1.1)]
    return Mechanism(links, joints, driven_joint="A")


@pytest.fixture(
    scope="module", params=PAIRS + [(loaded_chain, False)], ids=lambda pair: pair[0].__name__ + "-prescribed" * pair[1]
)
def mechanism(request):
    """Model, constants, drive and a closed state in motion: links undeformed, all rates at random that
    the closure allows."""
    make, prescribed = request.param
    model = discretise(make())
    actual = apply_errors(model, assembly_errors(model))
    rng = np.random.default_rng(3)
    size = (6, model.topology.n_rfes)
    drive = DriveInput()
    if model.topology.driven is not None:
        given = (model.start_joints[model.topology.driven], jnp.asarray(-2.0), jnp.asarray(11.0))
        k = model.topology.driven_coordinate
        drive = DriveInput(motions={k: given}) if prescribed else DriveInput(forces={k: jnp.asarray(1.7)})
    rates = Coordinates(
        jnp.asarray(rng.normal(size=model.topology.n_freedoms) * 3.0),
        jnp.asarray(rng.normal(size=size) * np.array([0.02] * 3 + [1.0] * 3)[:, None]),
    )
    state = impose(model.topology, State(model.start_coordinates(), rates), drive)
    return model, actual, drive, state, prescribed


def worst(evaluation):
    return max(
        float(jnp.max(jnp.abs(part), initial=0.0))
        for part in (evaluation.hinge, evaluation.force, evaluation.moment, evaluation.closing_acceleration)
    )


def test_solved_accelerations_have_no_residual(mechanism):
    model, actual, drive, state, prescribed = mechanism
    scale = length_scale(model)

    @kernel
    def both(state):
        gains = Stabilisation(jnp.zeros(()), jnp.zeros(()), scale)
        result = accelerations(actual, state, drive, gains)
        evaluation = evaluate_residual(actual, state, result.coordinates, result.multipliers, drive, scale)
        return (
            result,
            evaluation,
            evaluate_residual(
                actual,
                state,
                jax.tree.map(jnp.zeros_like, result.coordinates),
                jnp.zeros_like(result.multipliers),
                drive,
                scale,
            ),
        )

    result, evaluation, unsolved = jax.tree.map(np.array, both(state))
    if prescribed:
        # The residual of the prescribed joint is the moment that enforces its angle.
        evaluation.hinge[model.topology.driven_coordinate] = 0.0
    assert worst(unsolved) > 1.0
    assert worst(evaluation) < 1e-9 * worst(unsolved)
    np.testing.assert_allclose(evaluation.angular, result.angular, atol=1e-9 * np.abs(result.angular).max())
    np.testing.assert_allclose(evaluation.linear, result.linear, atol=1e-9 * np.abs(result.linear).max())


def test_increments_at_a_given_state_find_the_accelerations(mechanism):
    model, actual, drive, state, prescribed = mechanism
    scale, topology = length_scale(model), model.topology

    @kernel
    def solve(state):
        gains = Stabilisation(jnp.zeros(()), jnp.zeros(()), scale)
        result = accelerations(actual, state, drive, gains)
        operators = link_operators(actual, jnp.zeros(()), jnp.zeros(()))
        found = jax.tree.map(jnp.zeros_like, result.coordinates)
        if prescribed:
            driven = np.arange(topology.n_freedoms) == topology.driven_coordinate
            found = Coordinates(jnp.where(driven, drive.motions[topology.driven_coordinate][2], 0.0), found.elastic)
        multipliers = jnp.zeros_like(result.multipliers)

        def improve(carry, _):
            found, multipliers = carry
            evaluation = evaluate_residual(actual, state, found, multipliers, drive, scale)
            matrix = iteration_matrix(
                actual, operators, evaluation.motion, evaluation.closure, (topology.driven_coordinate,) * prescribed
            )
            evaluation = evaluation._replace(closing=evaluation.closing_acceleration)
            increment = newton_increment(topology, matrix, residual_of(evaluation))
            found = jax.tree.map(jnp.add, found, increment.accelerations)
            return (found, multipliers + increment.multipliers), None

        return result, jax.lax.scan(improve, (found, multipliers), length=2)[0]

    result, (found, multipliers) = solve(state)
    pairs = (
        (found.joints, result.coordinates.joints),
        (found.elastic, result.coordinates.elastic),
        (multipliers, result.multipliers),
    )
    for one, other in pairs:
        if other.size:
            scale = np.abs(other).max(axis=tuple(range(1, other.ndim)), keepdims=True)
            np.testing.assert_allclose(one / scale, other / scale, atol=1e-9)


def equations_at(actual, start, scale, drive, factors, prescribed):
    """Residual (unknowns) of an implicit step from `start`, at rest: flat function, wrenches of the tree joints
    likewise, evaluation at zero, unravel."""
    topology = actual.topology
    q_factor, v_factor = factors
    driven = np.arange(topology.n_freedoms) == topology.driven_coordinate
    zero = jax.tree.map(jnp.zeros_like, start)
    unknowns, unravel = ravel_pytree((zero, jnp.zeros(topology.n_constraints)))

    def evaluate(flat):
        found, multipliers = unravel(flat)
        position = jax.tree.map(lambda q, a: q + q_factor * a, start, found)
        velocity = jax.tree.map(lambda a: v_factor * a, found)
        return evaluate_residual(actual, State(position, velocity), found, multipliers, drive, scale)

    def equations(flat):
        evaluation = evaluate(flat)
        hinge = jnp.where(driven, -flat[: topology.n_freedoms], evaluation.hinge) if prescribed else evaluation.hinge
        return ravel_pytree((hinge, evaluation.force, evaluation.moment, evaluation.closing / q_factor))[0]

    def wrenches(flat):
        return jnp.stack(evaluate(flat).wrenches[: topology.n_links])

    return equations, wrenches, evaluate(unknowns), unknowns, unravel


def random_load(topology, free):
    """Residual of random size, zero at the hinges that are not free."""
    rng = np.random.default_rng(5)
    size = (3, topology.n_rfes)
    load = Residual(
        rng.normal(size=topology.n_freedoms) * free, rng.normal(size=size), 0.01 * rng.normal(size=size),
        1e3 * rng.normal(size=topology.n_constraints),
    )  # fmt: skip
    return jax.tree.map(jnp.asarray, load)


def largest_gap(increment, exact):
    """Largest deviation of the angles, elastic coordinates and multipliers, each relative to its largest."""
    (accelerations, multipliers) = exact
    pairs = (
        (increment.accelerations.joints, accelerations.joints),
        (increment.accelerations.elastic, accelerations.elastic),
        (increment.multipliers, multipliers),
    )
    return max(np.abs(a - b).max() / np.abs(b).max() for a, b in pairs if b.size)


@pytest.mark.long
def test_matrix_is_the_tangent_at_rest(mechanism):
    """Undeformed and at rest, without weight, one increment solves the linearised equations."""
    model, actual, _, _, prescribed = mechanism
    topology, scale = model.topology, length_scale(model)
    actual = jax.tree.map(lambda x: x, actual)
    object.__setattr__(actual, "gravity", jnp.zeros(3))
    factors = jnp.asarray(3e-7), jnp.asarray(6e-4)
    drive = DriveInput()
    if prescribed:
        zero = jnp.zeros(())
        drive = DriveInput(motions={topology.driven_coordinate: (model.start_joints[topology.driven], zero, zero)})

    @kernel
    def both(load):
        start = model.start_coordinates()
        equations, wrenches, evaluation, unknowns, unravel = equations_at(
            actual, start, scale, drive, factors, prescribed
        )
        tangent = jax.jacfwd(equations)(unknowns)
        operators = link_operators(actual, *factors)
        matrix = iteration_matrix(
            actual, operators, evaluation.motion, evaluation.closure, (topology.driven_coordinate,) * prescribed
        )
        exact = jnp.linalg.solve(tangent, -ravel_pytree(load)[0])
        by_exact = jax.jvp(wrenches, (unknowns,), (exact,))[1]
        return unravel(exact), by_exact, increment_and_wrenches(topology, matrix, load)

    free = np.arange(topology.n_freedoms) != topology.driven_coordinate if prescribed else 1.0
    exact, by_exact, (increment, by_increment) = both(random_load(topology, free))
    assert largest_gap(increment, exact) < 1e-7
    np.testing.assert_allclose(by_increment, by_exact, atol=1e-7 * np.abs(by_exact).max())


@pytest.mark.long
@pytest.mark.parametrize("elements", ["linear", "geometrically_exact"])
def test_matrix_holds_for_links_that_are_bent_to_fit(elements):
    """Assembled with an error of 1 deg, over a step that makes springs as good as rigid: spectral radii of the
    iteration, and of one with the rfes taken as not rotated."""
    model = discretise(four_bar(3), elements=elements)
    actual = apply_errors(model, assembly_errors(model, {"D.delta_x": np.radians(1.0)}))
    topology, scale = model.topology, length_scale(model)
    factors = jnp.asarray(3e-6), jnp.asarray(2e-3)

    @kernel
    def iterations():
        start = equilibrium(model, actual, {0: model.start_joints[0]})[0]
        equations, _, evaluation, unknowns, _ = equations_at(actual, start, scale, DriveInput(), factors, False)
        tangent = jax.jacfwd(equations)(unknowns)
        _parts, unravel = ravel_pytree(residual_of(evaluation))

        def iteration(motion):
            operators = link_operators(actual, *factors)
            if topology.exact:
                operators = present_operators(actual, motion.relative, *factors)
            matrix = iteration_matrix(actual, operators, motion, evaluation.closure)
            solve = jax.vmap(lambda load: ravel_pytree(newton_increment(topology, matrix, unravel(load)))[0])
            return jnp.eye(len(unknowns)) + solve(tangent.T).T

        identity = jnp.broadcast_to(jnp.eye(3)[:, :, None], evaluation.motion.relative.rate_matrix.shape)
        unrotated = evaluation.motion.relative._replace(rate_matrix=identity)
        return iteration(evaluation.motion), iteration(evaluation.motion._replace(relative=unrotated))

    present, unrotated = (np.abs(np.linalg.eigvals(np.asarray(m))).max() for m in iterations())
    assert present < 0.02 and 10.0 * present < unrotated


@pytest.fixture(scope="module")
def exact_chain():
    model = discretise(loaded_chain(), elements="geometrically_exact")
    return model, apply_errors(model, assembly_errors(model))


@pytest.mark.slow
def test_operators_of_exact_elements_are_the_linear_ones_at_the_undeformed_state(exact_chain):
    model, actual = exact_chain
    factors = jnp.asarray(3e-7), jnp.asarray(6e-4)
    rest = model.start_coordinates()
    relative = relative_motion(actual, rest, jax.tree.map(jnp.zeros_like, rest))
    present = kernel(present_operators)(actual, relative, *factors)
    constant = kernel(lambda r: link_operators(r, *factors))(actual)
    for one, other in zip(jax.tree.leaves(present), jax.tree.leaves(constant)):
        np.testing.assert_allclose(one, other, rtol=0, atol=1e-8 * np.abs(other).max(initial=1e-300))


def test_operators_of_a_batch_leave_lapack_alone(exact_chain):
    """Batched calls of several links run side by side, and can deadlock on few threads."""
    model, _ = exact_chain
    factors = jnp.asarray(3e-7), jnp.asarray(6e-4)
    rest = model.start_coordinates()

    def operators(length):
        actual = apply_errors(model, assembly_errors(model, {"one.length": length}))
        relative = relative_motion(actual, rest, jax.tree.map(jnp.zeros_like, rest))
        return link_operators(actual, *factors), present_operators(actual, relative, *factors)

    program = jax.jit(jax.vmap(operators)).lower(jnp.zeros(4)).as_text()
    assert "lapack" not in program and "stablehlo.multiply" in program


def quadratic_form(springs, x):
    """x K x of vectors (6, N), angular first."""
    left = jnp.roll(x, 1, axis=1)
    diagonal = jnp.einsum("ak,kab,bk->", x, springs.diagonal, x)
    return diagonal + 2.0 * jnp.einsum("ak,kab,bk->", x, springs.lower, left)


def test_stiffness_of_undeformed_links_holds_their_elastic_energy():
    model = discretise(loaded_chain())
    actual = apply_errors(model, assembly_errors(model, {f"{model.link_names[0]}.length": 3e-3}))
    elastic = jnp.asarray(np.random.default_rng(12).normal(size=(6, model.topology.n_rfes)))
    form = quadratic_form(elasticity.stiffness_blocks(actual), jnp.roll(elastic, 3, axis=0))
    energy = elasticity.elastic_energy(actual, Coordinates(model.start_joints, elastic))
    np.testing.assert_allclose(form, 2.0 * energy, rtol=1e-12)


@pytest.mark.long
def test_stiffness_of_exact_elements_holds_the_power_of_the_springs(exact_chain):
    """For random twists of the rfes at a large deflection: v K v = sum of C rate^2."""
    model, actual = exact_chain
    n = model.topology.n_rfes
    rng = np.random.default_rng(11)
    elastic = rng.normal(size=(6, n)) * np.array([0.01] * 3 + [0.5] * 3)[:, None]
    position = Coordinates(model.start_joints, jnp.asarray(elastic))
    relative = relative_motion(actual, position, jax.tree.map(jnp.zeros_like, position))
    twists = jnp.asarray(rng.normal(size=(6, n)))

    @kernel
    def both():
        springs = exact_elements.stiffness_blocks(actual, position.elastic[:3], relative)
        moved = relative._replace(angular=twists[:3], linear=twists[3:])
        rate = exact_elements.deflections(actual, position.elastic[:3], moved).rate
        return quadratic_form(springs, twists), jnp.sum(actual.stiffness * rate**2)

    form, power = both()
    np.testing.assert_allclose(form, power, rtol=1e-11)
