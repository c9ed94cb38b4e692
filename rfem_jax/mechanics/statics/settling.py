"""The search for the equilibrium of a mechanism at rest, its derivatives and its stability.

Place in the pipeline: static_equations, search -> **settling** -> assembly, simulation.

The equations are solved by the chord method or Newton's and differentiated by the implicit function theorem.
"""

from collections.abc import Iterable, Mapping
from dataclasses import replace
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.flatten_util import ravel_pytree
from jaxtyping import Bool, Float, Int

from rfem_jax.kernels import kernel
from rfem_jax.mechanics.algebra.derivative_rules import implicit_function
from rfem_jax.mechanics.algebra.vectors import Scalar, solve_equations
from rfem_jax.mechanics.dynamics import loads
from rfem_jax.mechanics.dynamics.loads import JointLoads
from rfem_jax.mechanics.elements import elasticity
from rfem_jax.mechanics.elements.deformed_bodies import spring_forces
from rfem_jax.mechanics.forces.element_loads import element_tangents
from rfem_jax.mechanics.forces.joint_forces import (
    by_coordinate,
    coupling_tangents,
    law_tangent,
)
from rfem_jax.mechanics.implicit.residual import Residual
from rfem_jax.mechanics.kinematics.cut_joints import Closure, closure, spring_row_tangent
from rfem_jax.mechanics.kinematics.motion import motion_of, range_used, relative_motion
from rfem_jax.mechanics.kinematics.slender_links import with_displacements
from rfem_jax.mechanics.model.errors import assembly_errors
from rfem_jax.mechanics.model.model import Coordinates, Model, State
from rfem_jax.mechanics.model.orientations import rates_of
from rfem_jax.mechanics.model.sources import RIGID_CLOSING_TOLERANCE
from rfem_jax.mechanics.model.status import (
    CANNOT_CLOSE,
    DESIGN_OUT_OF_RANGE,
    NO_EQUILIBRIUM,
    NOT_ASSEMBLED,
    OK,
    OUT_OF_RANGE,
    UNSTABLE,
    WRONG_SIDE,
)
from rfem_jax.mechanics.model.topology import Topology
from rfem_jax.mechanics.model.with_errors import ModelWithErrors, apply_errors
from rfem_jax.mechanics.statics.contact import search_contact
from rfem_jax.mechanics.statics.equilibrium_stability import (
    Stability,
    Tangent,
    free_coordinates,
    is_tested,
    stability_of,
    told_by_return,
)
from rfem_jax.mechanics.statics.search import (
    Equations,
    Linear,
    chord,
    load_steps,
    newton,
    shortest_solution,
    solve_dense,
    solve_linear,
)
from rfem_jax.mechanics.statics.static_equations import (
    ScaledUnknowns,
    dependent_places,
    scaled_unknowns,
    start_values,
    static_residual,
)
from rfem_jax.mechanics.statics.tangent import static_increment, static_tangent

OPEN = 1e-9  # of the longest link: a loop that does not close


class Settled(NamedTuple):
    """A static equilibrium: coordinates, multipliers [N], status of the search, and the tangent there, None where
    nothing is tested."""

    position: Coordinates
    multipliers: Float[Array, " constraints"]
    status: Int[Array, ""]
    tangent: Tangent | None


def equilibrium(
    model: Model, actual: ModelWithErrors, held: dict[int, Float[Array, ""]]
) -> tuple[Coordinates, Float[Array, " constraints"], Int[Array, ""]]:
    """Coordinates, multipliers [N] and status of the static equilibrium, stable or not; `held`: as of `settled`."""
    return settled(model, actual, held)[:3]


def stability(
    model: Model,
    actual: ModelWithErrors,
    held: Iterable[int],
    state: State,
    tangent: Tangent | None,
    carried: JointLoads,
) -> Stability | None:
    """Stability of a static equilibrium found by `settled` with the joint coordinates `held`; `carried`: by joints."""
    return None if tangent is None else stability_of(actual, state, tangent, _free(model.topology, held), carried)


def status_at_rest(status: Int[Array, ""], leaving: Stability | None) -> Int[Array, ""]:
    """Status of what shall stay at rest: one that is left is none."""
    if leaving is None:
        return status
    return jnp.where((status == OK) & (leaving.growth > 0.0), UNSTABLE, status).astype(jnp.int32)


def _free(topology: Topology, held: Iterable[int]) -> np.ndarray:
    """Places of the coordinates that the equilibrium is sought for."""
    return free_coordinates(topology, np.array([*topology.idle, *held, *dependent_places(topology)], int))


def settled(model: Model, actual: ModelWithErrors, held: dict[int, Float[Array, ""]]) -> Settled:
    """The static equilibrium; `held`: index of a joint coordinate -> its value [rad, m].

    From the undeformed start by the chord method with the tangent of the perfect mechanism, which is the same
    for all samples of a batch, and only where that does not converge by Newton's method.  Geometrically exact
    elements, whose deflections may be large, follow the equilibrium under growing loads.  Idle freedoms, in which
    the equilibrium would not be unique, are held at their start.
    """
    topology = model.topology
    scaled = scaled_unknowns(model, actual)
    if topology.idle:
        held = {**{k: start_values(model).joints[k] for k in topology.idle}, **held}
    given = np.array([*held, *dependent_places(topology)], int)
    undeformed = scaled.unknowns(start_values(model), jnp.zeros(topology.n_constraints))

    def residual(unknowns, scaled, args):
        actual, angles = args
        position, multipliers = scaled.coordinates(unknowns), scaled.multipliers(unknowns)
        hinge, elastic, closing = static_residual(actual, position, multipliers, scaled.length)
        value = scaled.residual(Coordinates(hinge, elastic), closing)
        if topology.minimum_norm:
            value = scaled.with_open_multipliers(value, unknowns, *jax.lax.stop_gradient((actual, position)))
        return jnp.where(is_given, unknowns - angles @ onto, value)

    angles, start = _held_values(model, scaled, held, given)
    onto = (given[:, None] == np.arange(undeformed.size)).astype(float)
    is_given = onto.any(axis=0)
    args = actual, angles
    perfect = _unloaded(model), start
    guess = jnp.where(is_given, angles @ onto, undeformed)
    solve, tested = shortest_solution if topology.minimum_norm else solve_equations, is_tested(topology, held)

    def search(scaled, starts, perfect, loaded):
        equations = Equations(
            kernel(lambda unknowns, args: residual(unknowns, scaled, args), name="static equations"),
            scaled.coordinates,
            n_coordinates=scaled.units.size,
            solve=solve,
        )
        return _search(scaled, equations, given, starts, perfect, loaded, tested)

    # The search is not differentiated: its derivatives are those of the implicit function, taken at its result.
    arrays, static = eqx.partition((scaled, (undeformed, guess), perfect, args), eqx.is_array)
    values = eqx.combine(jax.lax.stop_gradient(arrays), static)
    if _by_structure(topology):  # else it solves for all unknowns at once, which takes kernels longer than LAPACK
        search = kernel(search, name="static search", in_parts=True)
    end, found, jacobian, stable = search(*values)

    def tangent_solve(linear, value, inputs, end):
        scaled, (actual, _) = inputs
        if _by_structure(topology):
            return solve_linear(solve, _preconditioner(scaled, given, actual, end), linear, value)
        return solve_dense(solve, linear, value)

    equations_of = kernel(lambda x, inputs: residual(x, *inputs), name="static equations")
    unknowns = implicit_function(equations_of, tangent_solve, end, (scaled, args))
    position = with_displacements(actual, scaled.coordinates(unknowns))
    found = found & jnp.all(jnp.isfinite(unknowns))
    status = _status_of(actual, position, found, scaled.length)
    return Settled(position, scaled.multipliers(unknowns), status, _tangent(scaled, jacobian, stable, end))


def _by_structure(topology: Topology) -> bool:
    """Whether the recursion over the links solves the static equations, all but exactly."""
    return not (topology.exact or topology.minimum_norm or topology.massless or topology.clearances)


def _held_values(
    model: Model, scaled: ScaledUnknowns, held: dict[int, Float[Array, ""]], given: np.ndarray
) -> tuple[Array, Array]:
    """Values of the unknowns that are given, and at the undeformed start."""
    topology = model.topology
    values = jnp.array([*held.values(), *(0.0 for _ in given[len(held) :])], float)
    start = ravel_pytree(start_values(model))[0][given] if topology.slender else start_values(model).joints[given]
    if any(topology.slides[k] for k in held):
        values, start = values / scaled.units[given], start / scaled.units[given]
    return values, start


def _tangent(scaled: ScaledUnknowns, jacobian: Array | None, stable: Bool[Array, ""], end: Array) -> Tangent | None:
    """The tangent at the end of a search, None without a Jacobian."""
    if jacobian is None:
        return None
    rates = scaled.rates(end) if scaled.topology.balls else None
    return jax.lax.stop_gradient(Tangent(jacobian, rates, scaled.units, scaled.length, scaled.force, stable))


@kernel
def _status_of(
    actual: ModelWithErrors, position: Coordinates, converged: Bool[Array, ""], scale: Scalar
) -> Int[Array, ""]:
    """Status of a position, and of the search for it."""
    in_range = range_used(actual.topology, position) < 1.0
    cuts = closure(actual, motion_of(actual, loads.static_state(actual.topology, position)), scale)
    right_side = True if cuts is None else jnp.all(cuts.alignment > 0.0)
    if cuts is not None and actual.topology.minimum_norm:
        # The search does not see directions in which nothing gives way.
        rigid = np.flatnonzero(~np.array(cuts.sprung_rows or (False,) * cuts.residual.shape[0]))
        converged = converged & (jnp.max(jnp.abs(cuts.residual[rigid]), initial=0.0) <= RIGID_CLOSING_TOLERANCE * scale)
    status = jnp.where(right_side, jnp.where(in_range, OK, OUT_OF_RANGE), WRONG_SIDE)
    status = jnp.where(converged, status, _cause_of(actual.topology, cuts, in_range, scale))
    return jnp.where(actual.possible > 0.0, status, DESIGN_OUT_OF_RANGE).astype(jnp.int32)


def _cause_of(topology: Topology, cuts: Closure | None, in_range: Bool[Array, ""], scale: Scalar) -> Int[Array, ""]:
    """Status that tells why no equilibrium was found: contradicting equations mean a loop in which nothing gives; with
    rigid links loads that nothing balances are the cause, otherwise most likely deflections that are too large."""
    gives = topology.n_rfes > 0 or bool(topology.sprung)
    other = jnp.asarray(NOT_ASSEMBLED if gives else NO_EQUILIBRIUM)
    if cuts is None or (gives and not topology.minimum_norm):
        return other
    gap = jnp.max(jnp.abs(cuts.residual), initial=0.0)
    return jnp.where((gap > OPEN * scale) & in_range, CANNOT_CLOSE, other)


def _unloaded(model: Model) -> ModelWithErrors:
    """The perfect mechanism without gravity; where loads are applied in steps also without forces of joints and
    elements, so that the undeformed start is an equilibrium."""
    perfect = eqx.tree_at(lambda r: r.gravity, apply_errors(model, assembly_errors(model)), jnp.zeros(3))
    if model.topology.exact and perfect.forces is not None:
        perfect = eqx.tree_at(lambda r: r.forces.share, perfect, jnp.zeros(()))
    if model.topology.exact and model.frame_forces is not None:
        perfect = eqx.tree_at(lambda r: r.frame_forces.share, perfect, jnp.zeros(()))
    return perfect


def _search(
    scaled: ScaledUnknowns,
    equations: Equations,
    given: np.ndarray,
    starts: tuple[Array, Array],
    perfect: tuple[ModelWithErrors, Array],
    loaded: tuple[ModelWithErrors, Array],
    tested: bool,
) -> tuple[Array, Array, Array | None, Bool[Array, ""]]:
    """Unknowns under load, whether the search converged, the Jacobian there if stability is `tested`, and whether that
    is known, so that no Jacobian is formed; from the undeformed start, first without and then with the held angles;
    `perfect` and `loaded`: args of the equations."""
    topology, (undeformed, guess) = scaled.topology, starts
    unknown = jnp.zeros((), bool)
    if topology.clearances:
        end, found = search_contact(equations, starts, perfect, loaded, (scaled.length, scaled.force))
        # That of the search has springs in the places of contacts.
        jacobian = newton(equations, end, loaded, converged=True, with_jacobian=True)[2] if tested else None
        return end, found, jacobian, unknown
    if topology.exact:
        return *load_steps(equations, undeformed, perfect, loaded, with_jacobian=tested), unknown
    if topology.minimum_norm or topology.massless:
        return *newton(equations, guess, loaded, with_jacobian=tested), unknown
    disturbed = None
    if tested and told_by_return(loaded[0]):
        disturbed = ~np.isin(np.arange(guess.size), given) & (np.arange(guess.size) < scaled.units.size)
    constant = _preconditioner(scaled, given, perfect[0], undeformed)
    rows = _rows(scaled, perfect[0])
    return chord(equations, constant, rows, guess, loaded, with_jacobian=tested, disturbed=disturbed)


def _preconditioner(scaled: ScaledUnknowns, given: np.ndarray, actual: ModelWithErrors, unknowns: Array) -> Linear:
    """Preconditioner of the equations' Jacobian, residual -> unknowns, at given unknowns; the joint coordinates
    `given` are held."""
    topology = scaled.topology
    held, stiffness = tuple(given.tolist()), scaled.force / scaled.length
    position = scaled.coordinates(unknowns)
    tangent_at = kernel(
        lambda actual, position: static_tangent(actual, position, held, scaled.length, stiffness), name="static tangent"
    )
    tangent = tangent_at(actual, position)
    dependent = np.isin(np.arange(unknowns.size), dependent_places(topology))

    def solve(residual):
        forces, closing = scaled.unscaled(residual)
        by_part = Residual(forces.joints, -forces.elastic[:3], -forces.elastic[3:], -closing)
        increment = scaled.unknowns(*static_increment(topology, tangent, by_part))
        if topology.slender:
            increment = jnp.where(dependent, 0.0, increment)
        return increment + jnp.where(np.isin(np.arange(unknowns.size), given), residual, 0.0)

    return kernel(solve, name="static increment")


@kernel
def _rows(scaled: ScaledUnknowns, actual: ModelWithErrors) -> Array:
    """Sums of the absolute entries in every row of the equations' Jacobian, undeformed."""
    topology = scaled.topology
    springs = jnp.roll(jnp.abs(elasticity.stiffness_blocks(actual).diagonal), (3, 3), axis=(1, 2))
    one = scaled.coordinates(jnp.ones(len(scaled.units))).elastic
    of_joints = jnp.full(topology.n_freedoms, scaled.force * scaled.length)
    if any(topology.slides):
        of_joints = of_joints / scaled.units[: topology.n_freedoms]
    closing = jnp.full(topology.n_constraints, scaled.length)
    if actual.forces is not None or topology.sprung:
        at_rest = loads.static_state(topology, scaled.coordinates(jnp.zeros(len(scaled.units))))
        if of_laws := law_tangent(actual, at_rest, 1.0, 0.0):
            of_joints = of_joints + by_coordinate(topology, of_laws) * scaled.units[: topology.n_freedoms]
        if (meshes := coupling_tangents(actual, at_rest, 1.0, 0.0)) is not None:
            directions, stiffness = meshes
            stretches = jnp.abs(directions).T @ scaled.units[: topology.n_freedoms]
            of_joints = of_joints + jnp.abs(directions) @ (stiffness * stretches)
        cuts = closure(actual, motion_of(actual, at_rest), scaled.length) if topology.sprung_rows else None
        stiffness = spring_row_tangent(actual, cuts, scaled.length, 1.0, 0.0)
        if stiffness is not None:
            closing = jnp.where(np.array(topology.sprung_rows), stiffness * scaled.length + scaled.force, closing)
    of_rfes = jnp.einsum("kij,jk->ik", springs, one)
    if actual.superelements is not None:
        of_rfes = of_rfes + _superelement_rows(actual, one)
    if topology.slender:
        of_rfes = of_rfes.at[:3].set(jnp.where(topology.slender_rfes, scaled.force, of_rfes[:3]))
    if actual.frame_forces is not None:
        of_joints, of_rfes = _with_element_rows(scaled, actual, of_joints, of_rfes)
    forces = Coordinates(of_joints, of_rfes)
    return scaled.residual(forces, closing)


def _superelement_rows(actual: ModelWithErrors, units: Float[Array, "6 rfes"]) -> Float[Array, "6 rfes"]:
    """Sums of the rows of superelements, by units of the coordinates."""
    size = tuple(replace(one, stiffness=-jnp.abs(one.stiffness)) for one in actual.superelements or ())
    at_rest = relative_motion(actual, Coordinates(jnp.zeros(0), units), Coordinates(jnp.zeros(0), 0.0 * units))
    return spring_forces(replace(actual, superelements=size), at_rest)[0]


def _with_element_rows(
    scaled: ScaledUnknowns, actual: ModelWithErrors, of_joints: Array, of_rfes: Array
) -> tuple[Array, Array]:
    """Sums of the rows with the stiffness of force elements, which are between any two bodies."""
    topology, n = scaled.topology, len(scaled.units)
    at_rest = loads.static_state(topology, scaled.coordinates(jnp.zeros(n)))
    tangents = element_tangents(actual, motion_of(actual, at_rest), None, 1.0, 0.0)
    if tangents is None:
        return of_joints, of_rfes
    work = jnp.sum(jnp.abs(tangents.stiffness)) * scaled.length**2
    held = np.isin(np.arange(topology.n_rfes) + topology.n_links, topology.holders).astype(float)
    units = scaled.unravel(scaled.units)
    return of_joints + work / units.joints, of_rfes + work / units.elastic * held[None]


def moving_equilibrium(
    model: Model, actual: ModelWithErrors, held: dict[int, Float[Array, ""]], rates: Mapping[int, Scalar]
) -> tuple[State, Float[Array, " constraints"], Int[Array, ""]]:
    """`equilibrium`, and the rates of all coordinates when held ones move at `rates` [rad/s, m/s] through equilibria:
    the derivative of the static equilibrium along these, in one search."""
    state, found = settled_in_motion(model, actual, held, rates)
    return state, found.multipliers, found.status


def settled_in_motion(
    model: Model, actual: ModelWithErrors, held: dict[int, Float[Array, ""]], rates: Mapping[int, Scalar]
) -> tuple[State, Settled]:
    """`moving_equilibrium` with the tangent of the equilibrium."""
    if not rates:
        found = settled(model, actual, held)
        return loads.static_state(model.topology, found.position), found

    def at_values(values):
        found = settled(model, actual, {**held, **values})
        return found.position, found

    values = {k: jnp.asarray(held[k]) for k in rates}
    tangents = {k: jnp.asarray(rate) for k, rate in rates.items()}
    position, derivative, found = jax.jvp(at_values, (values,), (tangents,), has_aux=True)
    return State(position, rates_of(model.topology, position, derivative)), found._replace(position=position)
