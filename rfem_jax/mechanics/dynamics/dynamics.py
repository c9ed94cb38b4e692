"""Accelerations at one instant, in a time proportional to the number of rfes.

Place in the pipeline: kinematics, elasticity, cut_joints, joint_forces -> **dynamics** -> loads, simulation.

A free rfe is held by elastic forces alone: its absolute acceleration is wrench over inertia, and the
articulated inertia that it passes to its link frame is zero (docs/theory/4_recursion.md).  What remains is the
reduced tree of *interface bodies*: the rfes 0 of the links, joined by hinges, and the free rfes with links
outboard.  It falls into islands (`model`), each solved by the articulated-body algorithm (theory (4.4) to
(4.9); Featherstone 2008, ch. 7) for the applied loads and for unit multipliers of the cut joints at once; the
multipliers follow from theory (5.6), the elastic accelerations from the absolute ones.  Cost and memory are
linear in the number of rfes; no mechanism-wide mass matrix is formed.

Wrenches and accelerations of rfes are in the axes of their link; those of the reduced tree are spatial
vectors in global axes at one point of their island, the place of its root at this instant: a common point
needs no transforms, and a near one loses no digits of small inertias.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from rfem_jax.mechanics.algebra import vectors
from rfem_jax.mechanics.algebra.vectors import Scalar, apply, apply_transposed, cross, dot, product
from rfem_jax.mechanics.dynamics.slender_chains import (
    Chain,
    Eliminated,
    chain_of,
    chain_wrench,
    classical,
    inboard,
    on_interface,
    outboard,
    spatial_bodies,
)
from rfem_jax.mechanics.elements.elasticity import elastic_loads
from rfem_jax.mechanics.forces.element_loads import FrameLoads, frame_loads
from rfem_jax.mechanics.forces.friction import cut_friction, node_wrenches, tree_friction, with_friction
from rfem_jax.mechanics.forces.joint_forces import LawForces, applied_forces, law_forces, with_ideal_couplings
from rfem_jax.mechanics.kinematics.cut_joints import Closure, closure, unit_columns
from rfem_jax.mechanics.kinematics.motion import Motion, by_freedom, motion_of, node_frames, spread, total
from rfem_jax.mechanics.kinematics.self_stress import Redundancy, inverse_closure, redundancy
from rfem_jax.mechanics.model.inputs import DriveInput, Stabilisation
from rfem_jax.mechanics.model.model import Coordinates, State
from rfem_jax.mechanics.model.topology import BASE, Topology
from rfem_jax.mechanics.model.with_errors import ModelWithErrors


class InterfaceTree(NamedTuple):
    """The reduced tree: links (rfes 0) first, then the free rfes with links outboard; n bodies.

    point (3, n): of their islands; velocity (6, n), inertia (6, 6, n) and load (6, n) (applied minus
    gyroscopic wrench) at that point; axis, bias (6, F): axes of the joint coordinates, and accelerations due to
    their rates (Featherstone's c).
    """

    point: Float[Array, "3 n"]
    velocity: Float[Array, "6 n"]
    inertia: Float[Array, "6 6 n"]
    load: Float[Array, "6 n"]
    axis: Float[Array, "6 freedoms"]
    bias: Float[Array, "6 freedoms"]


class Accelerations(NamedTuple):
    """The solution of one instant.

    coordinates: second derivatives of the coordinates; multipliers [N] of the closure equations; stabilising [N]:
    their part due to Baumgarte's terms; angular, linear (3, nodes): absolute accelerations of all nodes'
    reference points in link axes; spatial (6, L): accelerations of the links at their islands' points;
    motion, closure, interface_tree: what they were computed from; dissipated [W]: power that the dampers
    dissipate; laws: forces of springs and laws along joint coordinates, None without any; frame_loads: what force
    elements exert, likewise; chain_wrenches: by slender link what its rfe 0 exerts on the next rfe, at its point.
    """

    coordinates: Coordinates
    multipliers: Float[Array, " constraints"]
    stabilising: Float[Array, " constraints"]
    angular: Float[Array, "3 nodes"]
    linear: Float[Array, "3 nodes"]
    spatial: Float[Array, "6 links"]
    motion: Motion
    closure: Closure | None
    interface_tree: InterfaceTree
    dissipated: Float[Array, ""]
    laws: LawForces | None
    frame_loads: FrameLoads | None = None
    chain_wrenches: dict[int, Float[Array, "6"]] = {}  # noqa: RUF012 - never changed


@jax.jit  # traced once for all its places
def accelerations(
    actual: ModelWithErrors, state: State, drive: DriveInput, stabilisation: Stabilisation
) -> Accelerations:
    """Accelerations of all coordinates and bodies, and the multipliers of the cut joints.

    `state` is taken with prescribed values already imposed (`impose`).
    """
    topology = actual.topology
    motion = motion_of(actual, state)
    cuts = closure(actual, motion, stabilisation.scale)
    inverse_rate = vectors.invert_block(motion.relative.rate_matrix)
    force, moment, dissipated = elastic_loads(actual, state, motion.relative, inverse_rate)
    spin, gravity = link_axes(actual, motion)
    at_nodes = frame_loads(actual, motion, drive.time)
    free = (force, moment) if at_nodes is None else _with_elements(topology, at_nodes, force, moment)
    angular, linear = _free_accelerations(actual, motion, spin, gravity, *free)
    tree = _interface_tree(actual, state, motion, (force, moment), at_nodes)
    chains = {l: chain_of(actual, motion, l, tree.point[:, l], free) for l in topology.slender}
    laws = law_forces(actual, state)
    if actual.friction is not None:
        found = tree_friction(actual, state, motion, None) | cut_friction(actual, motion, cuts, None)
        laws = with_friction(actual, laws, found)
        tree = _with_cut_forces(topology, cuts, tree, laws)
    in_cuts = node_wrenches(topology, cuts, None if laws is None else laws.cuts) if chains else {}
    forces = applied_forces(topology, state.position, drive, laws)
    columns, along = _load_columns(topology, cuts, tree, in_cuts), _along_joints(topology, cuts)
    responses, rates, swept = _articulated_bodies(topology, tree, chains, columns, drive, forces, along)
    responses |= _cut_rfe_responses(actual, motion, cuts, angular, linear, laws)
    of_joints = sum((along[k][1:, None] * rates[k][None] for k in along), start=0.0)
    multipliers, stabilising = _multipliers(topology, cuts, motion, tree, responses, of_joints, stabilisation)
    laws = with_ideal_couplings(actual, laws, motion, multipliers, stabilisation.scale)
    weights = jnp.concatenate([jnp.ones((1,)), multipliers])
    solved = {node: _combine(columns, weights) for node, columns in responses.items()}
    angular, linear = _with_interfaces(topology, motion, solved, angular, linear)
    for l, chain in chains.items():
        (a, b), spatial = topology.ranges[l], _combine(jnp.moveaxis(swept[l][1], 0, 2), weights[:, None])
        found = classical(motion, chain, l, spatial)
        angular, linear = (
            jnp.concatenate([one[:, :a], new, one[:, b:]], axis=1) for one, new in zip((angular, linear), found)
        )
    spatial = jnp.stack([solved[l] for l in range(topology.n_links)], axis=1)
    root_angular, root_linear = _link_accelerations(topology, motion, tree, spatial)
    elastic = _elastic_accelerations(topology, motion, inverse_rate, spin, root_angular, root_linear, angular, linear)
    joints = jnp.stack([_combine(rate[None], weights)[0] for rate in rates]) if rates else jnp.zeros((0,))
    return Accelerations(
        coordinates=Coordinates(joints, elastic),
        multipliers=multipliers,
        stabilising=stabilising,
        angular=jnp.concatenate([root_angular, angular], axis=1),
        linear=jnp.concatenate([root_linear, linear], axis=1),
        spatial=spatial,
        motion=motion,
        closure=cuts,
        interface_tree=tree,
        dissipated=total_dissipated(dissipated, laws, at_nodes, cuts),
        laws=laws,
        frame_loads=at_nodes,
        chain_wrenches={l: chain_wrench(chains[l], swept[l][0], spatial[:, l], weights) for l in chains},
    )


def total_dissipated(
    of_links: Float[Array, ""], laws: LawForces | None, at_nodes: FrameLoads | None, cuts: Closure | None
) -> Array:
    """Power [W] that the dampers of links, joints, force elements and compliant cut joints dissipate."""
    dissipated = of_links
    for forces in (laws, at_nodes, None if cuts is None else cuts.springs):
        dissipated = dissipated if forces is None else dissipated + forces.dissipated
    return dissipated


def _with_elements(topology: Topology, at_nodes: FrameLoads, force: Array, moment: Array) -> tuple[Array, Array]:
    """Forces and moments (3, N) on the free rfes together with those of force elements."""
    n = topology.n_links
    return force + at_nodes.force[:, n:], moment + at_nodes.moment[:, n:]


def link_axes(actual: ModelWithErrors, motion: Motion) -> tuple[Float[Array, "3 links"], Float[Array, "3 links"]]:
    """Angular velocities [rad/s] of the links and gravity [m/s^2], in the axes of each link."""
    spin = apply_transposed(motion.links.rotation, motion.links.velocity[:3])
    gravity = actual.gravity[:, None]
    return spin, apply_transposed(motion.links.rotation, jnp.broadcast_to(gravity, spin.shape))


def _free_accelerations(
    actual: ModelWithErrors, motion: Motion, spin: Array, gravity: Array, force: Array, moment: Array
) -> tuple[Array, Array]:
    """Absolute angular and linear accelerations (3, N), in link axes, of the rfes as free bodies under the given
    wrenches and gravity."""
    with jax.named_scope("free_rfes"):
        topology, relative = actual.topology, motion.relative
        n = topology.n_links
        spin = spread(topology, spin) + relative.angular
        body_spin = apply_transposed(relative.rotation, spin)
        body_centre = actual.centre[:, n:]
        centre = apply(relative.rotation, jnp.broadcast_to(body_centre, spin.shape))
        body_moment = apply_transposed(relative.rotation, moment - cross(centre, force))
        gyroscopic = cross(body_spin, apply(actual.inertia[:, :, n:], body_spin))
        angular = apply(relative.rotation, apply(actual.inverse_inertia, body_moment - gyroscopic))
        of_centre = force / actual.mass[n:][None] + spread(topology, gravity)
        return angular, of_centre - cross(angular, centre) - cross(spin, cross(spin, centre))


def _branching(topology: Topology) -> tuple[int, ...]:
    """Nodes of the free rfes with links outboard, but in slender links."""
    parents = {node for node in topology.parents[: topology.n_links] if node >= topology.n_links}
    return tuple(sorted(node for node in parents if not topology.is_slender(node)))


def _cut_rfes(topology: Topology) -> tuple[int, ...]:
    """Nodes of the free rfes that carry cut joints only, but in slender links."""
    sides = topology.parents[topology.n_links :] + topology.children[topology.n_links :]
    nodes = {node for node in sides if node >= topology.n_links and not topology.is_slender(node)}
    return tuple(sorted(nodes - set(_branching(topology))))


def _interface_tree(
    actual: ModelWithErrors,
    state: State,
    motion: Motion,
    elastic: tuple[Array, Array],
    at_nodes: FrameLoads | None,
) -> InterfaceTree:
    """The reduced tree under the elastic forces and moments (3, N) on the free rfes and those of force elements."""
    with jax.named_scope("interface_tree"):
        topology, (force, moment) = actual.topology, elastic
        n = topology.n_links
        branching = _branching(topology)
        nodes = (*range(n), *branching)
        rotation, where, velocity = node_frames(topology, motion, nodes)
        points = jnp.concatenate([motion.hinges.point, where[:, n:]], axis=1)
        rows = {node: i for i, node in enumerate(nodes)}
        point = jnp.stack([points[:, rows[topology.island_of(node)]] for node in rows], axis=1)
        velocity = _shifted(velocity, point)

        # Elastic wrenches act on a branching rfe, and minus their sum on rfe 0 of the link.
        arms = cross(motion.relative.position, force)
        applied_force = -total(topology, force)
        applied_moment = -total(topology, moment + arms)
        if at_nodes is not None:
            applied_force = applied_force + at_nodes.force[:, :n]
            applied_moment = applied_moment + at_nodes.moment[:, :n]
            force, moment = _with_elements(topology, at_nodes, force, moment)
        owners = [*range(n), *(topology.link_of(node) for node in branching)]
        link_rotation = jnp.stack([motion.links.rotation[:, :, l] for l in owners], axis=2)
        for node in branching:
            k = node - n
            applied_force = jnp.concatenate([applied_force, force[:, k : k + 1]], axis=1)
            applied_moment = jnp.concatenate([applied_moment, moment[:, k : k + 1]], axis=1)
        applied = vectors.wrench_at_origin(
            apply(link_rotation, applied_moment), apply(link_rotation, applied_force), where - point
        )

        inertia, weight, gyroscopic = spatial_bodies(actual, np.array(nodes), rotation, where - point, velocity)
        at_joints = by_freedom(topology, point[:, :n])
        axis, axis_velocity = _shifted(motion.axis, at_joints), _shifted(motion.axis_velocity, at_joints)
        return InterfaceTree(
            point=point,
            velocity=velocity,
            inertia=inertia,
            load=applied + weight - gyroscopic,
            axis=axis,
            bias=vectors.motion_cross(axis_velocity, axis * state.velocity.joints[None]),
        )


def _with_cut_forces(
    topology: Topology, cuts: Closure | None, tree: InterfaceTree, laws: LawForces | None
) -> InterfaceTree:
    """The reduced tree under the forces in cut joints, too."""
    load = tree.load
    wrenches = node_wrenches(topology, cuts, None if laws is None else laws.cuts)
    for i, node in enumerate((*range(topology.n_links), *_branching(topology))):
        if node in wrenches:
            wrench = _wrench_at(wrenches[node], tree.point[:, i])
            load = jnp.where(np.arange(load.shape[1]) == i, load + wrench[:, None], load)
    return tree._replace(load=load)


def _wrench_at(wrench: Array, point: Array) -> Array:
    """Wrench (6,) given at the global origin, at `point`."""
    return vectors.spatial(wrench[:3] - cross(point, wrench[3:]), wrench[3:])


def _shifted(motion: Array, point: Array) -> Array:
    """Spatial motion (6, ...) given at the global origin, at `point`."""
    return vectors.spatial(motion[:3], motion[3:] + cross(motion[:3], point))


def _load_columns(
    topology: Topology, cuts: Closure | None, tree: InterfaceTree, in_cuts: dict[int, Array]
) -> dict[int, Array]:
    """Columns (6, K) of loads on the bodies of the reduced tree: the applied loads, then, in islands that a
    cut joint acts on, unit multipliers; on interfaces of slender links those of cut joints alone, with `in_cuts`."""
    sides = topology.parents[topology.n_links :] + topology.children[topology.n_links :]
    closed = {topology.island_of(node) for node in sides if node != BASE}
    closed |= {topology.island_of(topology.link_of_freedom[k]) for k in _along_joints(topology, cuts)}
    loads = {}
    for i, node in enumerate((*range(topology.n_links), *_branching(topology))):
        loads[node] = tree.load[:, None, i]
        if cuts is not None and topology.island_of(node) in closed:
            unit = unit_columns(topology, cuts, node, tree.point[:, i])
            loads[node] = jnp.concatenate([loads[node], unit], axis=1)
    for node in (topology.n_links + k for k in topology.interfaces if topology.is_slender(topology.n_links + k)):
        point = tree.point[:, topology.link_of(node)]
        load = _wrench_at(in_cuts[node], point) if node in in_cuts else jnp.zeros(6)
        loads[node] = load[:, None]
        if cuts is not None and topology.island_of(node) in closed:
            loads[node] = jnp.concatenate([loads[node], unit_columns(topology, cuts, node, point)], axis=1)
    return loads


def _along_joints(topology: Topology, cuts: Closure | None) -> dict[int, Float[Array, " columns"]]:
    """By joint coordinate that an ideal coupling acts along: its load of every column, which are the applied loads and
    unit multipliers."""
    if cuts is None or cuts.couplings is None:
        return {}
    along = cuts.couplings.along
    before = jnp.zeros(1 + topology.n_constraints - along.shape[1])
    return {k: jnp.concatenate([before, along[k]]) for k in topology.coupled}


def _articulated_bodies(
    topology: Topology,
    tree: InterfaceTree,
    chains: dict[int, Chain],
    loads: dict[int, Array],
    drive: DriveInput,
    forces: dict[int, Array],
    along: dict[int, Array],
) -> tuple[dict[int, Array], list[Array], dict[int, tuple[Eliminated, Array]]]:
    """Featherstone's articulated-body algorithm for K columns of loads at once: accelerations (6, K) of the
    bodies and (K,) of the joint coordinates, and of chains what remains of them with accelerations (m, 6, K) of their
    rfes; `forces`: along joint coordinates; `along`: as of `_along_joints`.

    The coordinates of a joint are eliminated one after another, as if bodies without mass were between them, which
    is the Cholesky factorisation of the joint's own matrix (theory (4.10)).
    """
    with jax.named_scope("articulated_bodies"):
        columns = tree.inertia.shape[2]
        inertias = {node: tree.inertia[:, :, i] for i, node in enumerate(loads) if i < columns}
        loads, steps, accelerations, remaining = dict(loads), {}, {}, {}
        for l in reversed(range(topology.n_links)):
            node, inertia, load = topology.parents[l], inertias[l], loads[l]
            # Bias accelerations and drives belong to the applied loads, not to the unit multipliers.
            first = jnp.asarray(np.eye(1, load.shape[1])[0])
            if l in chains:
                remaining[l], more, passed = inboard(chains[l], inertias, loads, first)
                inertia, load = inertia + more, load + passed
            for k in reversed(topology.coordinates[l]):
                axis, bias = tree.axis[:, k], tree.bias[:, k]
                if k in drive.motions:
                    acceleration = drive.motions[k][2]
                    given = vectors.scaled(acceleration, axis) + bias
                    steps[k] = (axis, given[:, None] * first[None], acceleration[None] * first, None)
                    load = load - apply(inertia, given)[:, None] * first[None]
                    continue
                u = apply(inertia, axis)
                by_inertia = u / dot(axis, u)[None]
                torque = dot(axis[:, None], load)
                force = forces.get(k)
                if force is not None:
                    torque = torque + force[None] * first
                if k in along:
                    torque = torque + along[k]
                steps[k] = (axis, bias[:, None] * first[None], torque / dot(axis, u)[None], by_inertia)
                inertia = inertia - u[:, None] * by_inertia[None]
                load = load - apply(inertia, bias)[:, None] * first[None] - by_inertia[:, None] * torque[None]
            if node != BASE:
                inertias[node] = inertias[node] + inertia if node in inertias else inertia
                loads[node] = loads[node] + load
        for node in _branching(topology):
            inverse = vectors.invert_positive(inertias[node])
            accelerations[node] = product(inverse, loads[node])
        return _outward(topology, chains, remaining, loads, steps, accelerations)


def _outward(
    topology: Topology,
    chains: dict[int, Chain],
    remaining: dict[int, Eliminated],
    loads: dict[int, Array],
    steps: dict[int, tuple[Array, Array, Array, Array | None]],
    accelerations: dict[int, Array],
) -> tuple[dict[int, Array], list[Array], dict[int, tuple[Eliminated, Array]]]:
    """The results of `_articulated_bodies` from the base to the tips, from what the sweep to the base left;
    `accelerations`: of bodies that nothing holds."""
    rates, swept = [], {}
    for l in range(topology.n_links):
        acceleration = accelerations.get(topology.parents[l])
        for k in topology.coordinates[l]:
            axis, given, rate, by_inertia = steps[k]
            acceleration = given if acceleration is None else given + acceleration
            if by_inertia is not None:
                rate = rate - dot(by_inertia[:, None], acceleration)
                acceleration = acceleration + axis[:, None] * rate[None]
            rates.append(rate)
        accelerations[l] = jnp.zeros_like(loads[l]) if acceleration is None else acceleration
        if l in chains:
            first = jnp.asarray(np.eye(1, loads[l].shape[1])[0])
            swept[l] = remaining[l], outboard(chains[l], remaining[l], accelerations[l], first)
            for node, place in chains[l].interfaces.items():
                accelerations[node] = on_interface(chains[l], place, swept[l][1])
    return accelerations, rates, swept


def _cut_rfe_responses(
    actual: ModelWithErrors,
    motion: Motion,
    cuts: Closure | None,
    angular: Array,
    linear: Array,
    laws: LawForces | None,
) -> dict[int, Array]:
    """Accelerations (6, 1 + constraints) at their middles of the free rfes that carry cut joints only: under the
    applied loads, and for unit multipliers."""
    topology = actual.topology
    nodes = _cut_rfes(topology)
    if cuts is None or not nodes:
        return {}
    with jax.named_scope("cut_rfes"):
        rotation, where, velocity = node_frames(topology, motion, nodes)
        indices = np.array(nodes)
        inverse = vectors.product_transposed(
            product(rotation, actual.inverse_inertia[:, :, indices - topology.n_links]), rotation
        )
        centre = apply(rotation, actual.centre[:, indices])
        mobility = vectors.spatial_mobility(jnp.broadcast_to(actual.mass[indices], where.shape[1:]), centre, inverse)
        spin = velocity[:3]
        centripetal = cross(spin, velocity[3:] + cross(spin, where))
        responses = {}
        in_cuts = node_wrenches(topology, cuts, None if laws is None else laws.cuts)
        for i, node in enumerate(nodes):
            k = node - topology.n_links
            of_link = motion.links.rotation[:, :, topology.link_of(node)]
            applied = vectors.spatial(apply(of_link, angular[:, k]), apply(of_link, linear[:, k]) - centripetal[:, i])
            if node in in_cuts:
                applied = applied + apply(mobility[:, :, i], _wrench_at(in_cuts[node], where[:, i]))
            unit = unit_columns(topology, cuts, node, where[:, i])
            response = product(mobility[:, :, i], unit)
            responses[node] = jnp.concatenate([applied[:, None], response], axis=1)
        return responses


def _multipliers(
    topology: Topology,
    cuts: Closure | None,
    motion: Motion,
    tree: InterfaceTree,
    responses: dict[int, Array],
    of_joints: Scalar,
    stabilisation: Stabilisation,
) -> tuple[Array, Array]:
    """Multipliers of theory (5.6), cut by cut, and their part due to stabilisation; `of_joints`: second derivatives of
    the equations of ideal couplings by all columns of loads."""
    if cuts is None:
        zeros = jnp.zeros((0,))
        return zeros, zeros
    with jax.named_scope("multipliers"):
        points = _points_of(topology, motion, tree)
        sides = set(topology.parents[topology.n_links :]) | set(topology.children[topology.n_links :])
        units = ((node, unit_columns(topology, cuts, node, points[node])) for node in sorted(sides) if node != BASE)
        rows = sum((vectors.transposed_product(unit, responses[node]) for node, unit in units), start=of_joints)
        rows = jnp.asarray(rows)

        baumgarte = -stabilisation.velocity_gain * cuts.rate - stabilisation.position_gain * cuts.residual
        left_open = redundancy(topology, motion, cuts)
        if cuts.springs is not None:
            return _multipliers_given_springs(topology, cuts.springs.multipliers, rows, cuts.bias, baumgarte, left_open)
        inverse = inverse_closure(rows[:, 1:], left_open)
        stabilising = apply(inverse, baumgarte)
        return stabilising - apply(inverse, cuts.bias + rows[:, 0]), stabilising


def _multipliers_given_springs(
    topology: Topology, springs: Array, rows: Array, bias: Array, baumgarte: Array, left_open: Redundancy | None
) -> tuple[Array, Array]:
    """`_multipliers` where those of springs are given: the others hold what these leave (theory (13.8))."""
    sprung = np.array(topology.sprung_rows)
    if sprung.all():
        return springs, jnp.zeros_like(springs)
    rigid = np.flatnonzero(~sprung)
    onto = jnp.asarray(np.eye(len(sprung))[rigid])
    loaded = bias + rows[:, 0] + apply(rows[:, 1:], springs)
    matrix = jnp.stack([jnp.stack([rows[i, 1 + j] for j in rigid]) for i in rigid])
    inverse = inverse_closure(matrix, None if left_open is None else left_open.among(rigid))
    stabilising = apply(onto.T, apply(inverse, apply(onto, baumgarte)))
    return springs + stabilising - apply(onto.T, apply(inverse, apply(onto, loaded))), stabilising


def _points_of(topology: Topology, motion: Motion, tree: InterfaceTree) -> dict[int, Array]:
    """The point at which each node's response is given."""
    nodes = (*range(topology.n_links), *_branching(topology))
    points = {node: tree.point[:, i] for i, node in enumerate(nodes)}
    for node in (topology.n_links + k for k in topology.interfaces if topology.is_slender(topology.n_links + k)):
        points[node] = tree.point[:, topology.link_of(node)]
    for i, k in enumerate(topology.interfaces):
        points.setdefault(topology.n_links + k, motion.interfaces.point[:, i])
    return points


def _combine(columns: Array, weights: Array) -> Array:
    """Sum of columns (6, K): the response to the applied loads, and those to the multipliers."""
    return columns[:, 0] if columns.shape[1] == 1 else apply(columns, weights)


def _with_interfaces(
    topology: Topology, motion: Motion, solved: dict[int, Array], angular: Array, linear: Array
) -> tuple[Array, Array]:
    """Accelerations (3, N) of the free rfes in link axes, those of the interfaces put in."""
    n = topology.n_links
    for i, k in enumerate(topology.interfaces):
        if n + k not in solved or topology.is_slender(n + k):  # it carries no joint, or is of a chain
            continue
        velocity, where = motion.interfaces.velocity[:, i], motion.interfaces.point[:, i]
        of_link = motion.links.rotation[:, :, topology.link_of(n + k)]
        spin = velocity[:3]
        classical = solved[n + k][3:] + cross(spin, velocity[3:] + cross(spin, where))
        column = (np.arange(topology.n_rfes) == k)[None]
        angular = jnp.where(column, apply_transposed(of_link, solved[n + k][:3])[:, None], angular)
        linear = jnp.where(column, apply_transposed(of_link, classical)[:, None], linear)
    return angular, linear


def _link_accelerations(topology: Topology, motion: Motion, tree: InterfaceTree, spatial: Array) -> tuple[Array, Array]:
    """Angular and linear accelerations (3, L) of the links' origins in link axes, from the spatial ones."""
    n = topology.n_links
    spin, velocity = tree.velocity[:3, :n], tree.velocity[3:, :n]
    arm = motion.links.point - tree.point[:, :n]
    classical = spatial[3:] + cross(spatial[:3], arm) + cross(spin, velocity + cross(spin, arm))
    rotation = motion.links.rotation
    return apply_transposed(rotation, spatial[:3]), apply_transposed(rotation, classical)


def _elastic_accelerations(
    topology: Topology,
    motion: Motion,
    inverse_rate: Array,
    spin: Array,
    root_angular: Array,
    root_linear: Array,
    angular: Array,
    linear: Array,
) -> Array:
    """Second derivatives (6, N) of the elastic coordinates from the absolute accelerations of links and rfes."""
    with jax.named_scope("elastic_accelerations"):
        relative = motion.relative
        spin, of_link = spread(topology, spin), spread(topology, root_angular)
        u = (
            linear
            - spread(topology, root_linear)
            - cross(of_link, relative.position)
            - cross(spin, cross(spin, relative.position) + 2.0 * relative.linear)
        )
        rotation = angular - of_link - cross(spin, relative.angular) - relative.rate_bias
        return jnp.concatenate([u, apply(inverse_rate, rotation)])
