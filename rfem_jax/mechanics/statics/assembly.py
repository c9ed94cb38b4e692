"""Static assembly: the equilibrium in which the mechanism is put together, and its preload.

Place in the pipeline: model, errors -> **statics** -> start state of a simulation.

With errors the links are deformed when the loops are closed (theory (6.1)): the assembled state is a
stationary point of the potential energy of springs and gravity subject to the closure equations, some joints
held.  It is found from its equilibrium equations: no moment about a free hinge but that of its springs and laws,
zero generalised force of springs, gravity and joints on every free rfe, closed loops.  They are solved by Newton's
method and differentiated by the implicit function theorem; unknowns and residuals are scaled by a length and a force
of the mechanism.
"""

import functools
from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.flatten_util import ravel_pytree
from jaxtyping import ArrayLike, Bool, Float, Int

from rfem_jax.compilation.program import Program
from rfem_jax.description.basics.errors import InputError, require_choice, suggestion
from rfem_jax.description.mechanism.mechanism import AS_GIVEN, EQUILIBRIUM, STARTS
from rfem_jax.kernels import kernel
from rfem_jax.mechanics.algebra.derivative_rules import implicit_function
from rfem_jax.mechanics.algebra.vectors import Scalar, apply_transposed, cross, dot, solve_equations
from rfem_jax.mechanics.dynamics import loads
from rfem_jax.mechanics.dynamics.loads import JointLoads
from rfem_jax.mechanics.elements import elasticity
from rfem_jax.mechanics.elements.deformed_bodies import spring_forces
from rfem_jax.mechanics.elements.linear_validity import linear_error, linear_range
from rfem_jax.mechanics.forces.bush_contacts import ContactState, contact_states
from rfem_jax.mechanics.forces.element_loads import element_tangents, frame_loads
from rfem_jax.mechanics.forces.joint_forces import (
    applied_forces,
    by_coordinate,
    coupling_tangents,
    law_forces,
    law_tangent,
    loads_about_parent_axes,
    with_ideal_couplings,
)
from rfem_jax.mechanics.implicit.residual import Residual
from rfem_jax.mechanics.kinematics.cut_joints import Closure, closure, spring_residual, spring_row_tangent
from rfem_jax.mechanics.kinematics.motion import by_freedom, motion_of, range_used, relative_motion
from rfem_jax.mechanics.kinematics.self_stress import redundancy
from rfem_jax.mechanics.kinematics.slender_links import projected, with_displacements
from rfem_jax.mechanics.model.errors import AssemblyErrors, Errors, assembly_errors, errors_of
from rfem_jax.mechanics.model.inputs import DriveInput
from rfem_jax.mechanics.model.model import Coordinates, Model, State, length_scale
from rfem_jax.mechanics.model.orientations import moved, rates_of
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
from rfem_jax.mechanics.statics.designs import Design, designed, status_of
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
from rfem_jax.mechanics.statics.tangent import static_increment, static_tangent

OPEN = 1e-9  # of the longest link: a loop that does not close


class Load(NamedTuple):
    """Force [N] and moment [N m] of one joint in its hinge frame."""

    force: Float[Array, "*times 3"]
    moment: Float[Array, "*times 3"]


class Assembled(NamedTuple):
    """An assembled mechanism: state at rest, preload of every joint, status code; design_gap [m]: what the loops of a
    design stay open by at the start, None without one; contacts: of the joints with clearance, None without any;
    linear_error: estimated error of linear elements (`linear_validity`); stability: how fast it is left."""

    state: State
    preload: dict[str, Load]
    status: Int[Array, ""]
    design_gap: Float[Array, ""] | None = None
    contacts: dict[str, ContactState] | None = None
    linear_error: Float[Array, ""] | None = None
    stability: Stability | None = None


def assemble(
    model: Model,
    errors: Errors | None = None,
    hold: Mapping[str, ArrayLike] | str | None = None,
    *,
    design: Design | None = None,
) -> Assembled:
    """Assemble the mechanism: static equilibrium with some joints held.

    **Arguments:** `errors` from `assembly_errors`, or {name: value} (None: perfect); `hold`: name of a joint with one
    coordinate -> its angle [rad] or displacement [m]; None holds the coordinates that drives act on at their start, {}
    holds nothing; "as_given" holds at their start, besides, the coordinates that stand for the freedoms that no drive
    holds, as a simulation does; `design`: from `rfem_jax.design`.

    **Returns:** state (velocities zero), preload (gravity and holding moment included) and status
    (0 = ok; see `STATUS`). Differentiable with respect to errors, held angles and the numbers of the design.

    **Raises:** `InputError` if `hold` names a joint that is not a joint of the tree or has not one coordinate.
    """
    hold = checked_hold(model, hold)
    made = designed(model, design, errors_of(model, errors))
    found = _assemble(made.model, made.errors, hold)
    return found._replace(status=status_of(found.status, made), design_gap=made.gap)


@functools.partial(Program, nameless=True)
def _assemble(model: Model, errors: AssemblyErrors, hold: dict[str, Array] | str | None) -> Assembled:
    actual, held = apply_errors(model, errors), held_angles(model, hold)
    found = settled(model, actual, held)
    state = loads.static_state(model.topology, found.position)
    carried = static_loads(model, actual, state, found.multipliers)
    leaving = stability(model, actual, held, state, found.tangent, carried)
    contacts = contact_states(actual, motion_of(actual, state)) if model.topology.clearances else None
    error = linear_error(linear_range(actual, found.position))
    status = status_at_rest(found.status, leaving)
    return Assembled(state, named(model, carried), status, contacts=contacts, linear_error=error, stability=leaving)


def checked_hold(model: Model, hold: Mapping[str, ArrayLike] | str | None) -> dict[str, Array] | str | None:
    """The argument `hold` of `assemble` with arrays. Raises `InputError` as `held_angles`."""
    if hold is None or isinstance(hold, str):
        return None if hold is None else require_choice(hold, (AS_GIVEN,), "hold")
    _require_tree_joints(model, hold)
    return {name: jnp.asarray(angle, jnp.float64) for name, angle in hold.items()}


def held_angles(model: Model, hold: Mapping[str, ArrayLike] | str | None) -> dict[int, Float[Array, ""]]:
    """Index of a joint coordinate -> held value [rad, m], by the names of joints; None: those that drives act
    on, at their start; "as_given": besides those for the freedoms that no drive holds (theory (6.9)).

    **Raises:** `InputError` for a name that is not a joint of the tree with one coordinate.
    """
    topology = model.topology
    if hold is None or isinstance(hold, str):
        values = start_values(model).joints
        return {k: values[k] for k in (*topology.held, *(() if hold is None else topology.undriven))}
    _require_tree_joints(model, hold)
    return {
        topology.own_coordinates[topology.joints.index(name)][0]: jnp.asarray(value) for name, value in hold.items()
    }


def with_start(model: Model, start: str | None) -> Model:
    """The model whose simulations start so: "as_given" or "equilibrium"; None leaves it as it is.

    **Raises:** `InputError` for another word, and for an equilibrium where joints have initial rates.
    """
    if start is None:
        return model
    require_choice(start, STARTS, "start")
    if start == EQUILIBRIUM and model.topology.rated:
        raise InputError(
            f'Argument `start` must be "as_given" where joints have initial rates, but was "{start}", which is at '
            "rest; leave it out, or the rates."
        )
    return replace(model, topology=model.topology._replace(settles=start == EQUILIBRIUM))


def _require_tree_joints(model: Model, names: Iterable[str]) -> None:
    """Raise InputError for the first name that is not a joint of the tree."""
    tree = model.topology.joints[: model.topology.n_links]
    for name in names:
        if name not in tree:
            raise InputError(
                f"Argument `hold` must name joints of the tree, but {name!r} is not one; {suggestion(name, tree)}"
            )
        kind = model.topology.kind(tree.index(name)).nominal
        if len(kind.freedoms) != 1:
            raise InputError(
                f"Argument `hold` must name joints with one coordinate, but {name!r} is {kind.name} and has "
                f"{len(kind.freedoms)}; hold a revolute or prismatic joint."
            )


class _Scaled(NamedTuple):
    """Unknowns and residuals as flat arrays, scaled by a length [m] and a force [N] of the mechanism.

    units (n,) [m, rad]: of the coordinates; generalised forces times these are works; unravel: flat -> coordinates, as
    many as rates; origin: quaternions of the position that rotation vectors among the unknowns start from.
    """

    topology: Topology
    length: Float[Array, ""]
    force: Float[Array, ""]
    units: Float[Array, " n"]
    unravel: Callable[[Array], Coordinates]
    origin: Coordinates

    def unknowns(self, values: Coordinates, multipliers: Array) -> Array:
        """Flat, of coordinates, as many as rates, and multipliers."""
        return jnp.concatenate([ravel_pytree(values)[0] / self.units, multipliers / self.force])

    def coordinates(self, unknowns: Array) -> Coordinates:
        """Position of the unknowns."""
        values = self.unravel(unknowns[: self.units.size] * self.units)
        return moved(self.topology, self.origin, values) if self.topology.balls else values

    def rates(self, unknowns: Array) -> Float[Array, "n n"]:
        """Rates of the coordinates, in units, by those of the unknowns: other than these where joints turn about any
        axis."""

        def rate(along):
            position, change = jax.jvp(self.coordinates, (unknowns[: along.size],), (along,))
            return ravel_pytree(rates_of(self.topology, position, change))[0] / self.units

        return jax.vmap(rate, out_axes=1)(jnp.eye(self.units.size))

    def multipliers(self, unknowns: Array) -> Array:
        return unknowns[self.units.size :] * self.force

    def residual(self, forces: Coordinates, closing: Array) -> Array:
        """Flat, of generalised forces and closing [m] (of springs [N])."""
        works = ravel_pytree(forces)[0] * self.units / (self.force * self.length)
        return jnp.concatenate([works, closing / self._unit_of_closing()])

    def with_open_multipliers(
        self, residual: Array, unknowns: Array, actual: ModelWithErrors, position: Coordinates
    ) -> Array:
        """The residual with multipliers that the motion leaves open in the places of equations that say nothing new."""
        motion = motion_of(actual, loads.static_state(self.topology, position))
        left_open = redundancy(self.topology, motion, closure(actual, motion, self.length))
        if left_open is None:
            return residual
        works, closing = residual[: self.units.size], residual[self.units.size :]
        multipliers = unknowns[self.units.size :]
        return jnp.concatenate([works, closing + left_open.open @ (multipliers - closing)])

    def unscaled(self, residual: Array) -> tuple[Coordinates, Array]:
        """Generalised forces and closing [m] (of springs [N]) of a flat residual."""
        works, closing = residual[: self.units.size], residual[self.units.size :]
        forces = self.unravel(works * (self.force * self.length) / self.units)
        return forces, closing * self._unit_of_closing()

    def _unit_of_closing(self) -> Array:
        sprung = self.topology.sprung_rows
        return jnp.where(np.array(sprung), self.force, self.length) if sprung else self.length


def _scaled(model: Model, actual: ModelWithErrors) -> _Scaled:
    length, topology = length_scale(model), model.topology
    displacements = jnp.ones((6, topology.n_rfes)).at[:3].set(length)
    units, _ = ravel_pytree(Coordinates(_joint_units(topology, length), displacements))
    start = start_values(model)
    origin = moved(topology, model.start_coordinates(), jax.tree.map(jnp.negative, start)) if topology.balls else start
    return _Scaled(topology, length, _force_scale(model, actual), units, ravel_pytree(start)[1], origin)


def start_values(model: Model) -> Coordinates:
    """Start as coordinates, as many as rates: quaternions are replaced by zero rotation vectors."""
    topology, start = model.topology, model.start_coordinates()
    if not topology.balls:
        return start
    parts = []
    for l, at in enumerate(topology.positions):
        parts.append(model.start_joints[at.start : at.start + topology.plain(l)])
        parts.append(jnp.zeros(3 * topology.kind(l).ball))
    return Coordinates(jnp.concatenate(parts), start.elastic)


def _dependent(topology: Topology) -> list[int]:
    """Places among the unknowns of displacements that follow from rotations, in slender links; they stay zero."""
    places = topology.n_freedoms + np.arange(3)[:, None] * topology.n_rfes + np.flatnonzero(topology.slender_rfes)
    return places.reshape(-1).tolist()


def _joint_units(topology: Topology, length: Array) -> Float[Array, " freedoms"]:
    """1 rad, or a length [m], of every joint coordinate."""
    slides, ones = np.array(topology.slides, dtype=bool), jnp.ones(topology.n_freedoms)
    return jnp.where(slides, length, ones) if slides.any() else ones


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
    return free_coordinates(topology, np.array([*topology.idle, *held, *_dependent(topology)], int))


def settled(model: Model, actual: ModelWithErrors, held: dict[int, Float[Array, ""]]) -> Settled:
    """The static equilibrium; `held`: index of a joint coordinate -> its value [rad, m].

    From the undeformed start by the chord method with the tangent of the perfect mechanism, which is the same
    for all samples of a batch, and only where that does not converge by Newton's method.  Geometrically exact
    elements, whose deflections may be large, follow the equilibrium under growing loads.  Idle freedoms, in which
    the equilibrium would not be unique, are held at their start.
    """
    topology = model.topology
    scaled = _scaled(model, actual)
    if topology.idle:
        held = {**{k: start_values(model).joints[k] for k in topology.idle}, **held}
    given = np.array([*held, *_dependent(topology)], int)
    undeformed = scaled.unknowns(start_values(model), jnp.zeros(topology.n_constraints))

    def residual(unknowns, scaled, args):
        actual, angles = args
        position, multipliers = scaled.coordinates(unknowns), scaled.multipliers(unknowns)
        hinge, elastic, closing = _static_residual(actual, position, multipliers, scaled.length)
        value = scaled.residual(Coordinates(hinge, elastic), closing)
        if topology.minimum_norm:
            value = scaled.with_open_multipliers(value, unknowns, *jax.lax.stop_gradient((actual, position)))
        return jnp.where(is_given, unknowns - angles @ onto, value)

    angles = jnp.array([*held.values(), *(0.0 for _ in given[len(held) :])], float)
    start = ravel_pytree(start_values(model))[0][given] if topology.slender else start_values(model).joints[given]
    if any(topology.slides[k] for k in held):
        angles, start = angles / scaled.units[given], start / scaled.units[given]
    onto = (given[:, None] == np.arange(undeformed.size)).astype(float)
    is_given = onto.any(axis=0)
    args = actual, angles
    perfect = _unloaded(model), start
    guess = jnp.where(is_given, angles @ onto, undeformed)
    perfect, undeformed, guess = jax.lax.stop_gradient((perfect, undeformed, guess))
    equations = Equations(
        kernel(lambda unknowns, args: residual(unknowns, scaled, args), name="static equations"),
        scaled.coordinates,
        n_coordinates=scaled.units.size,
        solve=shortest_solution if topology.minimum_norm else solve_equations,
    )

    # The search is not differentiated: its derivatives are those of the implicit function, taken at its result.
    loaded = jax.lax.stop_gradient(args)
    tested = is_tested(topology, held)
    end, found, jacobian, stable = _search(scaled, equations, given, (undeformed, guess), perfect, loaded, tested)

    def tangent_solve(linear, value, inputs, end):
        scaled, (actual, _) = inputs
        if topology.exact or topology.minimum_norm or topology.massless or topology.clearances:
            return solve_dense(equations, linear, value)
        preconditioner = _preconditioner(scaled, given, actual, end)
        return solve_linear(equations, preconditioner, linear, value)

    equations_of = kernel(lambda x, inputs: residual(x, *inputs), name="static equations")
    unknowns = implicit_function(equations_of, tangent_solve, end, (scaled, args))
    position = with_displacements(actual, scaled.coordinates(unknowns))
    found = found & jnp.all(jnp.isfinite(unknowns))
    status = _status_of(actual, position, found, scaled.length)
    return Settled(position, scaled.multipliers(unknowns), status, _tangent(scaled, jacobian, stable, end))


def _tangent(scaled: _Scaled, jacobian: Array | None, stable: Bool[Array, ""], end: Array) -> Tangent | None:
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
    scaled: _Scaled,
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


def _preconditioner(scaled: _Scaled, given: np.ndarray, actual: ModelWithErrors, unknowns: Array) -> Linear:
    """Preconditioner of the equations' Jacobian, residual -> unknowns, at given unknowns; the joint coordinates
    `given` are held."""
    topology = scaled.topology
    held, stiffness = tuple(given.tolist()), scaled.force / scaled.length
    position = scaled.coordinates(unknowns)
    tangent_at = kernel(
        lambda actual, position: static_tangent(actual, position, held, scaled.length, stiffness), name="static tangent"
    )
    tangent = tangent_at(actual, position)
    dependent = np.isin(np.arange(unknowns.size), _dependent(topology))

    def solve(residual):
        forces, closing = scaled.unscaled(residual)
        by_part = Residual(forces.joints, -forces.elastic[:3], -forces.elastic[3:], -closing)
        increment = scaled.unknowns(*static_increment(topology, tangent, by_part))
        if topology.slender:
            increment = jnp.where(dependent, 0.0, increment)
        return increment + jnp.where(np.isin(np.arange(unknowns.size), given), residual, 0.0)

    return kernel(solve, name="static increment")


@kernel
def _rows(scaled: _Scaled, actual: ModelWithErrors) -> Array:
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
    scaled: _Scaled, actual: ModelWithErrors, of_joints: Array, of_rfes: Array
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


def _static_residual(
    actual: ModelWithErrors, position: Coordinates, multipliers: Array, scale: Array
) -> tuple[Float[Array, " freedoms"], Float[Array, "6 rfes"], Float[Array, " constraints"]]:
    """Loads along the joint coordinates [N m, N], generalised forces on the free rfes [N, N m] and closure residuals
    [m] (of springs [N]) of a mechanism at rest."""
    topology = actual.topology
    n = topology.n_links
    state = loads.static_state(topology, position)
    motion = motion_of(actual, state)
    cuts = closure(actual, motion, scale)
    at_rest = jnp.zeros((3, n + topology.n_rfes))
    inertial = loads.inertial_loads(actual, motion, at_rest, at_rest)
    force, moment = loads.loads_beyond_elements(inertial, frame_loads(actual, motion, None))
    wrenches = loads.chain_wrenches(actual, motion, cuts, multipliers, (force, moment))
    hinge = dot(motion.axis, by_freedom(topology, jnp.stack(wrenches[:n], axis=1)))
    laws = with_ideal_couplings(actual, law_forces(actual, state), motion, multipliers, scale)
    applied = applied_forces(topology, position, DriveInput(), laws)
    if applied:
        hinge = loads_about_parent_axes(topology, position, hinge - by_coordinate(topology, applied))
    force, moment = -force[:, n:], -moment[:, n:]
    for j, (left, right) in enumerate(zip(topology.parents, topology.children)):
        for node, sign in ((left, -1.0), (right, 1.0)):
            # A tree joint acts on rfe 0 of its child, which has no equation here.
            if node >= n:
                k = node - n
                rotation = motion.links.rotation[:, :, topology.link_of(node)]
                where = motion.interfaces.point[:, topology.interfaces.index(k)]
                on_force = sign * wrenches[j][3:]
                on_moment = sign * wrenches[j][:3] - cross(where, on_force)
                there = jnp.asarray(np.arange(topology.n_rfes) == k, float)[None]
                force = force + apply_transposed(rotation, on_force)[:, None] * there
                moment = moment + apply_transposed(rotation, on_moment)[:, None] * there
    external = jnp.concatenate([force, apply_transposed(motion.relative.rate_matrix, moment)])
    elastic, _ = elasticity.generalised_forces(actual, state, motion.relative)
    if actual.superelements is not None:
        elastic = elastic - loads.superelement_loads(actual, motion, at_rest, at_rest).generalised
    if topology.slender:
        external = jnp.concatenate(projected(actual, motion.relative, external[:3], external[3:]))
    closing = jnp.zeros((0,)) if cuts is None else spring_residual(topology, cuts, multipliers, cuts.residual)
    return hinge, external + elastic, closing


@kernel
def static_loads(
    model: Model, actual: ModelWithErrors, state: State, multipliers: Float[Array, " constraints"]
) -> loads.JointLoads:
    """Joint loads at rest, the moment that holds a joint included."""
    at_rest = jnp.zeros((3, actual.mass.shape[0]))
    resting = closed_at_rest(model, actual, state, multipliers)
    return loads.chain_loads(actual, resting, at_rest, at_rest, DriveInput())[0]


def closed_at_rest(
    model: Model, actual: ModelWithErrors, state: State, multipliers: Float[Array, " constraints"]
) -> loads.Resting:
    """Motion and closure of a mechanism at rest, from which its loads follow."""
    motion, scale = motion_of(actual, state), length_scale(model)
    cuts, at_nodes = closure(actual, motion, scale), frame_loads(actual, motion, None)
    laws = with_ideal_couplings(actual, law_forces(actual, state), motion, multipliers, scale)
    return loads.Resting(motion, cuts, multipliers, laws, at_nodes)


def named(model: Model, joint_loads: loads.JointLoads) -> dict[str, Load]:
    """Loads by the names of the joints, in the order of the description."""
    order = [(name, model.topology.joints.index(name)) for name in model.joint_names]
    return {name: Load(joint_loads.force[:, j], joint_loads.moment[:, j]) for name, j in order}


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


def _force_scale(model: Model, actual: ModelWithErrors) -> Array:
    """A force [N] of the mechanism: its bending stiffness over a length squared, or its weight and what
    acts on its joints."""
    stiffness, bodies = model.section.bending, [one.link for one in model.topology.reduced]
    flexible = [l for l, n in enumerate(model.topology.elements) if n > 1 and l not in bodies]
    bending = [stiffness[l] / model.length[l] ** 2 for l in flexible]
    for l, one in zip(bodies, model.superelements or (), strict=True):
        bending.append(jnp.min(jnp.diag(one.stiffness)[: len(one.stiffness) // 2]) * model.length[l])
    if bending:
        return jax.lax.stop_gradient(jnp.max(jnp.stack(bending)))
    force = jnp.sum(actual.mass) * jnp.linalg.norm(model.gravity) + jnp.sum(actual.mass)
    if model.topology.minimum_norm:
        force = force + _applied(model, actual)
    return jax.lax.stop_gradient(jnp.where(force > 0.0, force, 1.0))


def _applied(model: Model, actual: ModelWithErrors) -> Float[Array, ""]:
    """The largest force [N], or moment over the longest link, along a joint coordinate at the start."""
    length, none = length_scale(model), jnp.zeros(model.topology.n_constraints)
    along, *_ = _static_residual(actual, model.start_coordinates(), none, length)
    return jnp.max(jnp.abs(along) * _joint_units(model.topology, length) / length, initial=0.0)
