"""Static assembly: the equilibrium in which the mechanism is put together, and its preload.

Place in the pipeline: model, errors -> **statics** -> start state of a simulation.

With errors the links are bent to close the loops (theory (6.1)): the stationary point of springs
+ gravity subject to the closure equations, some joints held. Written as equilibrium: no moment
about a free hinge, springs + gravity + joint wrenches balanced on every free rfe, loops closed.
Newton's method, differentiated by the implicit function theorem; unknowns and residuals are scaled
by a length and a force of the mechanism.
"""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.flatten_util import ravel_pytree

from rfem_jax.compilation.program import Program
from rfem_jax.description.errors import InputError, suggestion
from rfem_jax.mechanics import elasticity, loads
from rfem_jax.mechanics.algebra import apply_transposed, cross, dot
from rfem_jax.mechanics.cut_joints import closure
from rfem_jax.mechanics.inputs import DriveInput
from rfem_jax.mechanics.kinematics import motion, range_used
from rfem_jax.mechanics.model import Coordinates, Model, State, Topology
from rfem_jax.mechanics.newton import Residual
from rfem_jax.mechanics.realisation import AssemblyErrors, Realisation, assembly_errors, realise
from rfem_jax.mechanics.static_matrix import change_at_rest, matrix_at_rest
from rfem_jax.mechanics.static_search import (
    Equations, chord, least_squares, load_steps, newton, solve_dense, solve_linear,
)
from rfem_jax.mechanics.status import NOT_ASSEMBLED, OK, OUT_OF_RANGE, WRONG_SIDE


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
    if hold is not None:
        _require_tree_joints(model, hold)
        hold = {name: jnp.asarray(angle, jnp.float64) for name, angle in hold.items()}
    return _assemble(model, errors, hold)


@Program
def _assemble(model: Model, errors: AssemblyErrors, hold) -> Assembled:
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
    _require_tree_joints(model, hold)
    return {topology.joints.index(name): jnp.asarray(angle) for name, angle in hold.items()}


def _require_tree_joints(model: Model, names) -> None:
    """Raises InputError for the first name that is not a joint of the tree."""
    tree = model.topology.joints[: model.topology.n_links]
    for name in names:
        if name not in tree:
            raise InputError(
                f"Argument `hold` must name joints of the tree, but has {name!r}; "
                f"{suggestion(name, tree)}"
            )


class _Scaled(NamedTuple):
    """Unknowns and residuals as flat arrays, measured by a length [m] and a force [N] of the mechanism.

    units (n,): of the coordinates; generalised forces times these are works.
    """

    topology: Topology
    length: Array
    force: Array
    units: Array
    unravel: Callable

    def unknowns(self, position: Coordinates, multipliers: Array) -> Array:
        """Flat, of coordinates and multipliers (5, C)."""
        return jnp.concatenate(
            [ravel_pytree(position)[0] / self.units, multipliers.T.reshape(-1) / self.force]
        )

    def coordinates(self, unknowns: Array) -> Coordinates:
        return self.unravel(unknowns[: self.units.size] * self.units)

    def multipliers(self, unknowns: Array) -> Array:
        return unknowns[self.units.size :].reshape(self.topology.n_cuts, 5).T * self.force

    def residual(self, forces: Coordinates, closing: Array) -> Array:
        """Flat, of generalised forces and closing (5, C) [m]."""
        works = ravel_pytree(forces)[0] * self.units / (self.force * self.length)
        return jnp.concatenate([works, closing.T.reshape(-1) / self.length])

    def left_over(self, residual: Array) -> tuple[Coordinates, Array]:
        """Generalised forces and closing (5, C) [m]."""
        works, closing = residual[: self.units.size], residual[self.units.size :]
        forces = self.unravel(works * (self.force * self.length) / self.units)
        return forces, closing.reshape(self.topology.n_cuts, 5).T * self.length


def _scaled(model: Model, realised: Realisation) -> _Scaled:
    length, topology = length_scale(model), model.topology
    displacements = jnp.ones((6, topology.n_rfes)).at[:3].set(length)
    units, _ = ravel_pytree(Coordinates(jnp.ones(topology.n_links), displacements))
    unravel = ravel_pytree(model.start_coordinates())[1]
    return _Scaled(topology, length, _force_scale(model, realised), units, unravel)


def equilibrium(model: Model, realised: Realisation, held: dict[int, Array]):
    """Coordinates, multipliers (5 cuts,) [N] and status of the static equilibrium.

    From the undeformed start: with the matrix of the perfect mechanism, which is solved by its structure and
    the same for all samples of a batch, and only where that does not converge by Newton's method.
    Geometrically exact elements, whose deflections may be large, are brought there by load steps.
    """
    topology = model.topology
    scaled = _scaled(model, realised)
    given = np.array(list(held), int)
    undeformed = scaled.unknowns(model.start_coordinates(), jnp.zeros((5, topology.n_cuts)))

    def residual(unknowns, args):
        realised, angles = args
        position, multipliers = scaled.coordinates(unknowns), scaled.multipliers(unknowns)
        hinge, elastic, closing = _unbalanced(realised, position, multipliers, scaled.length)
        value = scaled.residual(Coordinates(hinge, elastic), closing)
        return jnp.where(is_given, unknowns - angles @ onto, value)

    angles = jnp.array([*held.values()], float)
    onto = (given[:, None] == np.arange(undeformed.size)).astype(float)
    is_given = onto.any(axis=0)
    args = realised, angles
    perfect = (
        eqx.tree_at(lambda r: r.gravity, realise(model, assembly_errors(model)), jnp.zeros(3)),
        model.start_angles[given],
    )
    guess = jnp.where(is_given, angles @ onto, undeformed)
    perfect, undeformed, guess = jax.lax.stop_gradient((perfect, undeformed, guess))
    equations = Equations(
        residual,
        scaled.coordinates,
        n_coordinates=scaled.units.size,
        solve=least_squares if topology.minimum_norm else jnp.linalg.solve,
    )

    # No derivative goes through the search: its result is where the implicit function is taken.
    goal = jax.lax.stop_gradient(args)
    if topology.exact:
        end, found = load_steps(equations, undeformed, perfect, goal)
    elif topology.minimum_norm:
        end, found = newton(equations, guess, goal)
    else:
        constant = _nearly_inverse(scaled, given, perfect[0], undeformed)
        end, found = chord(equations, constant, _rows(scaled, perfect[0]), guess, goal)

    def solve_slope(slope, value):
        if topology.exact or topology.minimum_norm:
            return solve_dense(equations, slope, value)
        inverse = _nearly_inverse(scaled, given, goal[0], end)
        return solve_linear(equations, inverse, slope, value)

    unknowns = jax.lax.custom_root(
        lambda unknowns: residual(unknowns, args), end, lambda _, found: found, solve_slope
    )
    position = scaled.coordinates(unknowns)
    found = found & jnp.all(jnp.isfinite(unknowns))
    in_range = range_used(topology, position) < 1.0
    cuts = closure(realised, motion(realised, loads.static_state(position)), scaled.length)
    right_side = True if cuts is None else jnp.all(cuts.alignment > 0.0)
    status = jnp.where(right_side, jnp.where(in_range, OK, OUT_OF_RANGE), WRONG_SIDE)
    status = jnp.where(found, status, NOT_ASSEMBLED)
    return position, scaled.multipliers(unknowns), status.astype(jnp.int32)


def _nearly_inverse(scaled: _Scaled, given, realised: Realisation, unknowns: Array) -> Callable:
    """Nearly the inverse of the equations' matrix where the unknowns are: residual -> unknowns; the angles of the
    links `given` are held."""
    topology = scaled.topology
    held, stiffness = tuple(given.tolist()), scaled.force / scaled.length
    position = scaled.coordinates(unknowns)
    matrix = matrix_at_rest(realised, position, held, scaled.length, stiffness)

    def solve(residual):
        forces, closing = scaled.left_over(residual)
        left = Residual(forces.angles, -forces.elastic[:3], -forces.elastic[3:], -closing)
        change = scaled.unknowns(*change_at_rest(topology, matrix, left))
        return change + jnp.where(np.isin(np.arange(unknowns.size), given), residual, 0.0)

    return solve


def _rows(scaled: _Scaled, realised: Realisation) -> Array:
    """Sums of the sizes of the entries in every row of the equations' matrix."""
    topology = scaled.topology
    springs = jnp.roll(jnp.abs(elasticity.stiffness_blocks(realised).own), (3, 3), axis=(1, 2))
    one = scaled.coordinates(jnp.ones(len(scaled.units))).elastic
    hinges = jnp.full(topology.n_links, scaled.force * scaled.length)
    forces = Coordinates(hinges, jnp.einsum("kij,jk->ik", springs, one))
    return scaled.residual(forces, jnp.full((5, topology.n_cuts), scaled.length))


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
                there = jnp.asarray(np.arange(topology.n_rfes) == k, float)[None]
                force = force + apply_transposed(turn, on_force)[:, None] * there
                moment = moment + apply_transposed(turn, on_moment)[:, None] * there
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
