"""Static assembly: the equilibrium in which the mechanism is put together, and its preload.

Place in the pipeline: model, errors -> **statics** -> start state of a simulation.

With errors the links are bent to close the loops (MODEL section 5): the stationary point of springs
+ gravity subject to the closure equations, some joints held. Written as equilibrium: no moment
about a free hinge, springs + gravity + joint wrenches balanced on every free rfe, loops closed.
Newton's method, differentiated by the implicit function theorem; unknowns and residuals are scaled
by a length and a force of the mechanism.

When to stop: the residual of a slender beam does not go below EA/Delta times the rounding of
positions, far above any fixed fraction of its bending forces (EI/L^2), while the positions that it
stands for are known to their last digits. So Newton's step is judged, relative to length and
radian, and every residual relative to what a change of that size would make of it (its own row of
the matrix).
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array
from jax.flatten_util import ravel_pytree

from rfem_jax.description.errors import InputError, suggestion
from rfem_jax.mechanics import elasticity, loads
from rfem_jax.mechanics.algebra import apply_transposed, cross, dot
from rfem_jax.mechanics.cut_joints import closure
from rfem_jax.mechanics.inputs import DriveInput
from rfem_jax.mechanics.kinematics import motion, range_used
from rfem_jax.mechanics.model import Coordinates, Model, State
from rfem_jax.mechanics.realisation import AssemblyErrors, Realisation, assembly_errors, realise
from rfem_jax.mechanics.status import NOT_ASSEMBLED, OK, OUT_OF_RANGE, WRONG_SIDE

TOLERANCE = 1e-10
SMALLEST_SINGULAR_VALUE = 1e-9  # of the largest, where equations contradict each other
MAX_ITERATIONS = 50
# With a constant slope a step is no smaller than the next one by much: it must be down to rounding.
CHORD_TOLERANCE, CHORD_ITERATIONS = 1e-14, 30
ITERATIONS_OF_A_STEP = 15
MAX_LOAD_STEPS = 60
SMALLEST_LOAD_STEP = 1e-3
LARGEST_TURN_OF_A_STEP = 0.7


class Load(NamedTuple):
    """Force [N] and moment [N m] (..., 3) of one joint in its hinge frame."""

    force: Array
    moment: Array


class Assembled(NamedTuple):
    """A mechanism put together: state at rest, preload of every joint, status code."""

    state: State
    preload: dict[str, Load]
    status: Array


def assemble(
    model: Model, errors: AssemblyErrors, hold: dict[str, Array] | None = None
) -> Assembled:
    """Put the mechanism together: static equilibrium with some joints held.

    **Arguments:** `hold`: joint name -> angle [rad]; None holds the driven joint at its start angle,
    {} holds nothing.

    **Returns:** state (velocities zero), preload (gravity and holding moment included) and status
    (0 = ok; see `STATUS`). Differentiable with respect to errors and held angles.

    **Raises:** `InputError` if `hold` names a joint that is not a joint of the tree.
    """
    realised = realise(model, errors)
    position, multipliers, status = equilibrium(model, realised, held_angles(model, hold))
    state = loads.static_state(position)
    return Assembled(state, named(model, static_loads(model, realised, state, multipliers)), status)


def held_angles(model: Model, hold: dict[str, Array] | None) -> dict[int, Array]:
    """Link index -> held angle, checked."""
    topology = model.topology
    if hold is None:
        driven = topology.driven
        return {} if driven is None else {driven: model.start_angles[driven]}
    tree = topology.joints[: topology.n_links]
    for name in hold:
        if name not in tree:
            raise InputError(
                f"Argument `hold` must name joints of the tree, but has {name!r}; "
                f"{suggestion(name, tree)}"
            )
    return {tree.index(name): jnp.asarray(angle) for name, angle in hold.items()}


def equilibrium(model: Model, realised: Realisation, held: dict[int, Array]):
    """Coordinates, multipliers (5 cuts,) [N] and status of the static equilibrium.

    Newton's method from the undeformed start: first with the slope of the perfect mechanism, which is
    the same for all samples of a batch, and only where that does not converge with the present one.
    Geometrically exact elements, whose deflections may be large, are brought there by load steps.
    """
    topology = model.topology
    scale = length_scale(model)
    force_scale = _force_scale(model, realised)
    start, unravel = ravel_pytree(model.start_coordinates())
    n_constraints = 5 * topology.n_cuts
    indices = tuple(held)

    # Generalised forces times these units are works.
    units, _ = ravel_pytree(
        Coordinates(
            jnp.ones(topology.n_links), jnp.ones((6, topology.n_rfes)).at[:3].set(scale)
        )
    )

    def coordinates(unknowns) -> Coordinates:
        return unravel(unknowns[: start.size] * units)

    def residual(unknowns, args):
        realised, angles = args
        position = coordinates(unknowns)
        multipliers = unknowns[start.size :].reshape(topology.n_cuts, 5).T * force_scale
        hinge, elastic, closing = _unbalanced(realised, position, multipliers, scale)
        balance, _ = ravel_pytree(Coordinates(hinge, elastic))
        balance = balance * units / (force_scale * scale)
        for index, angle in zip(indices, angles):
            balance = balance.at[index].set(unknowns[index] - angle)
        return jnp.concatenate([balance, closing.T.reshape(-1) / scale])

    guess = undeformed = jnp.concatenate([start / units, jnp.zeros(n_constraints)])
    for index, angle in held.items():
        guess = guess.at[index].set(angle)
    solve = _least_squares if topology.minimum_norm else jnp.linalg.solve
    equations = _Equations(residual, coordinates, start.size, solve)
    args = (realised, tuple(jnp.asarray(angle) for angle in held.values()))
    perfect = (
        eqx.tree_at(lambda r: r.gravity, realise(model, assembly_errors(model)), jnp.zeros(3)),
        tuple(model.start_angles[index] for index in indices),
    )
    perfect, undeformed, guess = jax.lax.stop_gradient((perfect, undeformed, guess))

    # No derivative goes through the search: its result is where the implicit function is taken.
    goal = jax.lax.stop_gradient(args)
    if topology.exact:
        end, found = _load_steps(equations, undeformed, perfect, goal)
    elif topology.minimum_norm:
        end, found = _newton(equations, guess, goal, MAX_ITERATIONS)
    else:
        end, found = _from_the_perfect(equations, undeformed, perfect, guess, goal)

    def solve_linear(slope, value):
        return solve(jax.jacfwd(slope)(jnp.zeros_like(value)), value)

    unknowns = jax.lax.custom_root(
        lambda unknowns: residual(unknowns, args), end, lambda _, found: found, solve_linear
    )
    position = coordinates(unknowns)
    found = found & jnp.all(jnp.isfinite(unknowns))
    in_range = range_used(topology, position) < 1.0
    cuts = closure(realised, motion(realised, loads.static_state(position)), scale)
    right_side = True if cuts is None else jnp.all(cuts.alignment > 0.0)
    status = jnp.where(right_side, jnp.where(in_range, OK, OUT_OF_RANGE), WRONG_SIDE)
    status = jnp.where(found, status, NOT_ASSEMBLED)
    multipliers = unknowns[start.size :].reshape(topology.n_cuts, 5).T * force_scale
    return position, multipliers, status.astype(jnp.int32)


def _least_squares(matrix: Array, value: Array) -> Array:
    """The shortest solution of equations that may contradict each other."""
    return jnp.linalg.pinv(matrix, rtol=SMALLEST_SINGULAR_VALUE) @ value


class _Equations(NamedTuple):
    """Residual of (unknowns, args), coordinates of the unknowns, how many they are (multipliers
    follow), and the solver (matrix, values -> unknowns) of the linearised equations.

    Not lineax's: it ends the whole batch where the cotangent of a failed sample is NaN."""

    residual: Callable
    coordinates: Callable
    n_coordinates: int
    solve: Callable


def _from_the_perfect(equations: _Equations, undeformed: Array, perfect, start: Array, args):
    """Unknowns and whether they were found, with the perfect mechanism's slope as far as it leads."""
    slope = jax.jacfwd(equations.residual)(undeformed, perfect)
    inverse = jnp.linalg.inv(slope)

    def constant(_, value):
        return inverse @ value, slope

    near, found = _iterate(equations, start, args, CHORD_ITERATIONS, constant, tolerance=CHORD_TOLERANCE)
    start = jnp.where(found, near, start)
    return _newton(equations, start, args, MAX_ITERATIONS, found)


def _newton(equations: _Equations, start: Array, args, iterations: int, found=False):
    """Unknowns after Newton's method and whether it converged; nothing is done if `found`."""

    def present(unknowns, value):
        slope = jax.jacfwd(equations.residual)(unknowns, args)
        return equations.solve(slope, value), slope

    return _iterate(equations, start, args, iterations, present, found)


def _iterate(
    equations: _Equations, start: Array, args, iterations: int, solve, found=False, tolerance=TOLERANCE
):
    """Unknowns after steps that `solve` (unknowns, residual -> step, slope) finds, and whether they
    converged.

    The last step must be small in the coordinates (multipliers follow them: their rounding is that
    of the stiffest spring), and the residual before it small in every row against what such a
    change of the coordinates makes of it; the latter fails where equations contradict each other.
    """
    n = equations.n_coordinates

    def going_on(carry):
        unknowns, converged, count = carry
        return ~converged & jnp.all(jnp.isfinite(unknowns)) & (count < iterations)

    def improve(carry):
        unknowns, _, count = carry
        value = equations.residual(unknowns, args)
        step, slope = solve(unknowns, value)
        size = jnp.concatenate([jnp.ones(n), 1.0 + jnp.abs(unknowns[n:])])
        small = jnp.max(jnp.abs(step[:n])) <= tolerance
        balanced = jnp.all(jnp.abs(value) <= TOLERANCE * (jnp.abs(slope) @ size))
        return unknowns - step, small & balanced, count + 1

    carry = (start, jnp.asarray(found), jnp.zeros((), jnp.int32))
    unknowns, converged, _ = jax.lax.while_loop(going_on, improve, carry)
    return unknowns, converged


def _load_steps(equations: _Equations, start: Array, at_rest, loaded):
    """Unknowns of the equilibrium under full load, followed from the one at rest, and whether it was
    reached.

    Errors, gravity and held angles grow together from nothing by a share: all at once first; a step
    on which Newton's method does not converge, or lands more than a moderate turn of an rfe away
    (on another equilibrium), is halved, any other is followed by one twice as long. The constants
    of the mechanism are interpolated, so that on the way its frames are turned to second order in
    the errors only.
    """

    def going_on(carry):
        _, reached, step, count = carry
        return (reached < 1.0) & (step > SMALLEST_LOAD_STEP) & (count < MAX_LOAD_STEPS)

    def advance(carry):
        unknowns, reached, step, count = carry
        share = jnp.minimum(reached + step, 1.0)
        args = jax.tree.map(lambda a, b: a + share * (b - a), at_rest, loaded)
        new, found = _newton(equations, unknowns, args, ITERATIONS_OF_A_STEP)
        turn = equations.coordinates(new - unknowns).elastic[3:]
        found = found & (jnp.max(jnp.abs(turn), initial=0.0) < LARGEST_TURN_OF_A_STEP)
        return (
            jnp.where(found, new, unknowns),
            jnp.where(found, share, reached),
            jnp.where(found, 2.0 * step, 0.5 * step),
            count + 1,
        )

    one = jnp.ones(())
    carry = (start, 0.0 * one, one, jnp.zeros((), jnp.int32))
    unknowns, reached, _, _ = jax.lax.while_loop(going_on, advance, carry)
    return unknowns, reached >= 1.0


def _unbalanced(realised: Realisation, position: Coordinates, multipliers: Array, scale: Array):
    """Moments about the hinges (L,) [N m], generalised forces left on the free rfes (6, N) and
    closure residuals (5, C) [m] of a mechanism at rest."""
    topology = realised.topology
    n = topology.n_links
    state = loads.static_state(position)
    now = motion(realised, state)
    cuts = closure(realised, now, scale)
    at_rest = jnp.zeros((3, n + topology.n_rfes))
    force, moment = loads.inertial_loads(realised, now, at_rest, at_rest)
    wrenches = loads.chain_wrenches(realised, now, cuts, multipliers, (force, moment))
    hinge = dot(now.axis, jnp.stack(wrenches[:n], axis=1))
    force, moment = -force[:, n:], -moment[:, n:]
    for j, (left, right) in enumerate(zip(topology.parents, topology.children)):
        for node, sign in ((left, -1.0), (right, 1.0)):
            # The joint of a link acts on its rfe 0; only wrenches on free rfes count here.
            if node >= n:
                k = node - n
                turn = now.links.rotation[:, :, topology.link_of(node)]
                where = now.carriers.point[:, topology.carriers.index(k)]
                on_force = sign * wrenches[j][3:]
                on_moment = sign * wrenches[j][:3] - cross(where, on_force)
                force = force.at[:, k].add(apply_transposed(turn, on_force))
                moment = moment.at[:, k].add(apply_transposed(turn, on_moment))
    outside = jnp.concatenate([force, apply_transposed(now.relative.rate_matrix, moment)])
    elastic, _ = elasticity.generalised_forces(realised, state, now.relative)
    return hinge, outside + elastic, jnp.zeros((5, 0)) if cuts is None else cuts.residual


def static_loads(
    model: Model, realised: Realisation, state: State, multipliers: Array
) -> loads.JointLoads:
    """Joint loads at rest, the moment that holds a joint included."""
    now = motion(realised, state)
    at_rest = jnp.zeros((3, realised.mass.shape[0]))
    resting = loads.Resting(now, closure(realised, now, length_scale(model)), multipliers)
    return loads.chain_loads(realised, resting, at_rest, at_rest, DriveInput())[0]


def named(model: Model, joint_loads: loads.JointLoads) -> dict[str, Load]:
    """Loads by the names of the joints, in the order of the description."""
    order = [(name, model.topology.joints.index(name)) for name in model.joint_names]
    return {
        name: Load(joint_loads.force[:, j], joint_loads.moment[:, j]) for name, j in order
    }


def quasi_static_rates(
    model: Model, realised: Realisation, held: dict[int, Array], driven_rate: Array
) -> Coordinates:
    """Rates of the coordinates when the driven joint moves at a rate through equilibria: the
    derivative of the static equilibrium along the driven angle, times the rate."""
    driven = model.topology.driven

    def along(angle):
        return equilibrium(model, realised, {**held, driven: angle})[0]

    angle = jnp.asarray(held[driven])
    return jax.jvp(along, (angle,), (jnp.asarray(driven_rate),))[1]


def length_scale(model: Model) -> Array:
    """The longest nominal link [m]."""
    return jnp.max(model.length)


def _force_scale(model: Model, realised: Realisation) -> Array:
    """A force [N] of the mechanism: its bending stiffness over a length squared, or its weight."""
    bending = [
        model.section[4, l] / model.length[l] ** 2
        for l, n in enumerate(model.topology.elements)
        if n > 1
    ]
    if bending:
        return jax.lax.stop_gradient(jnp.max(jnp.stack(bending)))
    weight = jnp.sum(realised.mass) * jnp.linalg.norm(model.gravity)
    return jax.lax.stop_gradient(weight + jnp.sum(realised.mass))
