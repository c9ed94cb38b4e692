"""Accelerations at one instant, by the structure of the rigid finite element method.

Place in the pipeline: kinematics, elasticity, cut_joints -> **dynamics** -> loads, simulation.

A free rfe is held by elastic forces alone: its absolute acceleration is wrench over inertia, and its
articulated inertia seen from the link frame is zero (docs/theory/4_recursion.md).  What remains is the
*skeleton*: rfes 0, joined by hinges, and the free rfes that another link hangs on.  Each island of
the skeleton is solved by Featherstone's articulated-body recursion (theory (4.4) to (4.9); 2008,
ch. 7) for the applied loads and for unit multipliers of the cut joints at once; the multipliers
follow from theory (5.6), the elastic accelerations from the absolute ones.  Cost and memory are
linear in the number of rfes; no mechanism-wide mass matrix is formed.

Wrenches and accelerations of rfes are in the axes of their link; those of the skeleton are spatial
vectors in global axes at one point of their island, where its root is at this instant (a common
point needs no transforms, a near one keeps the small inertias' digits).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from rfem_jax.mechanics import algebra
from rfem_jax.mechanics.algebra import apply, apply_transposed, cross, dot, product
from rfem_jax.mechanics.cut_joints import Closure, closure, invert_closure, unit_columns
from rfem_jax.mechanics.elasticity import elastic_loads
from rfem_jax.mechanics.inputs import DriveInput, Stabilisation
from rfem_jax.mechanics.kinematics import Motion, motion, node_frames, spread, total
from rfem_jax.mechanics.model import BASE, Coordinates, State, Topology
from rfem_jax.mechanics.realisation import Realisation


class Skeleton(NamedTuple):
    """Links (rfes 0) first, then the free rfes that a link hangs on; n columns.

    point (3, n) of the island; velocity (6, n), inertia (6, 6, n) and load (6, n) (applied minus
    gyroscopic wrench) at that point; axis, bias (6, L): hinge axes and the accelerations due to the
    hinge rates.
    """

    point: Array
    velocity: Array
    inertia: Array
    load: Array
    axis: Array
    bias: Array


class Accelerations(NamedTuple):
    """Result of one instant.

    coordinates: second derivatives of the coordinates; multipliers (5, C); stabilising (5, C) their
    part due to Baumgarte's terms; angular, linear (3, nodes): absolute accelerations of all nodes'
    reference points in link axes; spatial (6, L): accelerations of the links at their islands'
    points; motion, closure and skeleton are passed on; dissipated: power [W] that the dampers take
    out.
    """

    coordinates: Coordinates
    multipliers: Array
    stabilising: Array
    angular: Array
    linear: Array
    spatial: Array
    motion: Motion
    closure: Closure | None
    skeleton: Skeleton
    dissipated: Array


def accelerations(
    realised: Realisation, state: State, drive: DriveInput, stabilisation: Stabilisation
) -> Accelerations:
    """Accelerations of all coordinates and bodies, and the multipliers of the cut joints.

    `state` is taken with prescribed values already imposed (`impose`).
    """
    topology = realised.topology
    now = motion(realised, state)
    cuts = closure(realised, now, stabilisation.scale)
    inverse_rate = algebra.invert_block(now.relative.rate_matrix)
    force, moment, dissipated = elastic_loads(realised, state, now.relative, inverse_rate)
    spin, gravity = link_axes(realised, now)
    angular, linear = _free_accelerations(realised, now, spin, gravity, force, moment)
    skeleton = _skeleton(realised, state, now, force, moment)
    response, hinges = _recursion(topology, skeleton, _load_columns(topology, cuts, skeleton), drive)
    response |= _free_responses(realised, now, cuts, angular, linear)
    multipliers, stabilising = _multipliers(topology, cuts, now, skeleton, response, stabilisation)
    weights = jnp.concatenate([jnp.ones((1,) + multipliers.shape[1:]), multipliers])
    root = {node: _combine(columns, weights) for node, columns in response.items()}
    angular, linear = _loaded(topology, now, root, angular, linear)
    spatial = jnp.stack([root[l] for l in range(topology.n_links)], axis=1)
    root_angular, root_linear = _classical(topology, now, skeleton, spatial)
    elastic = _relative_accelerations(
        topology, now, inverse_rate, spin, root_angular, root_linear, angular, linear
    )
    by_cut = (topology.n_cuts, 5) + multipliers.shape[1:]
    return Accelerations(
        coordinates=Coordinates(jnp.stack([_combine(h[None], weights)[0] for h in hinges]), elastic),
        multipliers=jnp.swapaxes(multipliers.reshape(by_cut), 0, 1),
        stabilising=jnp.swapaxes(stabilising.reshape(by_cut), 0, 1),
        angular=jnp.concatenate([root_angular, angular], axis=1),
        linear=jnp.concatenate([root_linear, linear], axis=1),
        spatial=spatial,
        motion=now,
        closure=cuts,
        skeleton=skeleton,
        dissipated=dissipated,
    )


def link_axes(realised: Realisation, now: Motion) -> tuple[Array, Array]:
    """Angular velocities of the links and gravity (3, L), in link axes."""
    spin = apply_transposed(now.links.rotation, now.links.velocity[:3])
    gravity = _like(realised.gravity[:, None], spin)
    return spin, apply_transposed(now.links.rotation, jnp.broadcast_to(gravity, spin.shape))


def _like(values: Array, example: Array) -> Array:
    """Trailing axes of length one for a constant that later axes of `example` broadcast over."""
    return values.reshape(values.shape + (1,) * (example.ndim - 2)) if example.ndim > 2 else values


def _free_accelerations(realised, now: Motion, spin, gravity, force, moment):
    """Absolute accelerations (3, N) of free bodies under the given wrenches and gravity."""
    with jax.named_scope("free_rfes"):
        topology, relative = realised.topology, now.relative
        n = topology.n_links
        spin = spread(topology, spin) + relative.angular
        body_spin = apply_transposed(relative.rotation, spin)
        body_centre = _like(realised.centre[:, n:], spin)
        centre = apply(relative.rotation, jnp.broadcast_to(body_centre, spin.shape))
        body_moment = apply_transposed(relative.rotation, moment - cross(centre, force))
        gyroscopic = cross(body_spin, apply(_like(realised.inertia[:, :, n:], spin), body_spin))
        angular = apply(
            relative.rotation,
            apply(_like(realised.inverse_inertia, spin), body_moment - gyroscopic),
        )
        of_centre = force / _like(realised.mass[n:], spin)[None] + spread(topology, gravity)
        return angular, of_centre - cross(angular, centre) - cross(spin, cross(spin, centre))


def _branching(topology: Topology) -> tuple[int, ...]:
    """Nodes of the free rfes that a link hangs on."""
    hung = {node for node in topology.parents[: topology.n_links] if node >= topology.n_links}
    return tuple(sorted(hung))


def _loaded_free(topology: Topology) -> tuple[int, ...]:
    """Nodes of the free rfes that carry cut joints only."""
    nodes = {topology.n_links + k for k in topology.carriers}
    return tuple(sorted(nodes - set(_branching(topology))))


def _skeleton(realised, state: State, now: Motion, force: Array, moment: Array) -> Skeleton:
    with jax.named_scope("skeleton"):
        topology = realised.topology
        n = topology.n_links
        branching = _branching(topology)
        rotation, where, velocity = node_frames(topology, now, (*range(n), *branching))
        points = jnp.concatenate([now.hinges.point, where[:, n:]], axis=1)
        rows = {node: i for i, node in enumerate((*range(n), *branching))}
        point = jnp.stack(
            [points[:, rows[topology.island_of(node)]] for node in rows], axis=1
        )
        velocity = _shifted(velocity, point)

        # Elastic wrenches act on a branching rfe, and minus their sum on rfe 0 of the link.
        arms = cross(now.relative.position, force)
        applied_force = -total(topology, force)
        applied_moment = -total(topology, moment + arms)
        owners = [*range(n), *(topology.link_of(node) for node in branching)]
        turns = jnp.stack([now.links.rotation[:, :, l] for l in owners], axis=2)
        for node in branching:
            k = node - n
            applied_force = jnp.concatenate([applied_force, force[:, k : k + 1]], axis=1)
            applied_moment = jnp.concatenate([applied_moment, moment[:, k : k + 1]], axis=1)
        applied = algebra.wrench_at_origin(
            apply(turns, applied_moment), apply(turns, applied_force), where - point
        )

        pick = np.array((*range(n), *branching))
        centre = where - point + apply(rotation, _like(realised.centre[:, pick], where))
        own = _like(realised.inertia[:, :, pick], where)
        central = algebra.product_transposed(product(rotation, own), rotation)
        mass = jnp.broadcast_to(_like(realised.mass[pick], where), central.shape[2:])
        inertia = algebra.spatial_inertia(mass, centre, central)
        gravity = mass[None] * _like(realised.gravity[:, None], centre)
        weight = algebra.wrench_at_origin(jnp.zeros_like(gravity), gravity, centre)
        gyroscopic = algebra.force_cross(velocity, apply(inertia, velocity))
        axis = _shifted(now.axis, point[:, :n])
        carrying = _shifted(now.hinges.velocity, point[:, :n])
        return Skeleton(
            point=point,
            velocity=velocity,
            inertia=inertia,
            load=applied + weight - gyroscopic,
            axis=axis,
            bias=algebra.motion_cross(carrying, axis * state.velocity.angles[None]),
        )


def _shifted(motion: Array, point: Array) -> Array:
    """Spatial motion (6, ...) given at the global origin, at `point`."""
    return algebra.spatial(motion[:3], motion[3:] + cross(motion[:3], point))


def _load_columns(topology, cuts, skeleton: Skeleton) -> dict[int, Array]:
    """Columns of loads on the skeleton's nodes: applied ones, then, in islands that a cut joint
    loads, unit multipliers."""
    sides = topology.parents[topology.n_links :] + topology.children[topology.n_links :]
    loaded = {topology.island_of(node) for node in sides if node != BASE}
    loads = {}
    for i, node in enumerate((*range(topology.n_links), *_branching(topology))):
        loads[node] = skeleton.load[:, None, i]
        if topology.island_of(node) in loaded:
            unit = unit_columns(topology, cuts, node, skeleton.point[:, i])
            loads[node] = jnp.concatenate([loads[node], unit], axis=1)
    return loads


def _recursion(topology, skeleton: Skeleton, loads, drive: DriveInput):
    """Articulated-body recursion: accelerations (6, K) of the nodes and (K,) of the hinges for K
    load columns at once."""
    with jax.named_scope("articulated_bodies"):
        inertias = {node: skeleton.inertia[:, :, i] for i, node in enumerate(loads)}
        loads, record, accelerations, hinges = dict(loads), {}, {}, []
        for l in reversed(range(topology.n_links)):
            node, inertia, load = topology.parents[l], inertias[l], loads[l]
            axis, bias = skeleton.axis[:, l], skeleton.bias[:, l]
            first = np.eye(1, load.shape[1])[0].reshape((-1,) + (1,) * (load.ndim - 2))
            first = jnp.asarray(first)
            driven = l == topology.driven
            if driven and drive.turn is not None:
                given = axis * drive.turn[2][None] + bias
                record[l] = (axis, given[:, None] * first[None], drive.turn[2][None] * first, None)
                passed = load - apply(inertia, given)[:, None] * first[None]
            else:
                u = apply(inertia, axis)
                scaled = u / dot(axis, u)[None]
                push = dot(axis[:, None], load)
                if driven and drive.moment is not None:
                    push = push + drive.moment[None] * first
                record[l] = (axis, bias[:, None] * first[None], push / dot(axis, u)[None], scaled)
                inertia = inertia - u[:, None] * scaled[None]
                passed = (
                    load
                    - apply(inertia, bias)[:, None] * first[None]
                    - scaled[:, None] * push[None]
                )
            if node != BASE:
                inertias[node] = inertias[node] + inertia
                loads[node] = loads[node] + passed
        for node in _branching(topology):
            inverse = algebra.invert_positive(inertias[node])
            accelerations[node] = product(inverse, loads[node])
        for l in range(topology.n_links):
            node = topology.parents[l]
            axis, carried, rate, scaled = record[l]
            carried = carried if node == BASE else carried + accelerations[node]
            if scaled is not None:
                rate = rate - dot(scaled[:, None], carried)
                carried = carried + axis[:, None] * rate[None]
            accelerations[l] = carried
            hinges.append(rate)
        return accelerations, hinges


def _free_responses(realised, now: Motion, cuts, angular, linear) -> dict[int, Array]:
    """Accelerations (6, 1 + 5 C) at their middles of the free rfes that carry cut joints only: under
    their applied loads, and for unit multipliers."""
    topology = realised.topology
    nodes = _loaded_free(topology)
    if not nodes:
        return {}
    with jax.named_scope("loaded_rfes"):
        rotation, where, velocity = node_frames(topology, now, nodes)
        pick = np.array(nodes)
        inverse = algebra.product_transposed(
            product(rotation, _like(realised.inverse_inertia[:, :, pick - topology.n_links], where)),
            rotation,
        )
        centre = apply(rotation, _like(realised.centre[:, pick], where))
        mobility = algebra.spatial_mobility(
            jnp.broadcast_to(_like(realised.mass[pick], where), where.shape[1:]), centre, inverse
        )
        spin = velocity[:3]
        centripetal = cross(spin, velocity[3:] + cross(spin, where))
        responses = {}
        for i, node in enumerate(nodes):
            k = node - topology.n_links
            turn = now.links.rotation[:, :, topology.link_of(node)]
            applied = algebra.spatial(
                apply(turn, angular[:, k]), apply(turn, linear[:, k]) - centripetal[:, i]
            )
            unit = unit_columns(topology, cuts, node, where[:, i])
            response = product(mobility[:, :, i], unit)
            responses[node] = jnp.concatenate([applied[:, None], response], axis=1)
        return responses


def _multipliers(topology, cuts, now, skeleton: Skeleton, response, stabilisation: Stabilisation):
    """Multipliers (5 C,) of theory (5.6), cut by cut, and their part due to stabilisation."""
    if cuts is None:
        none = jnp.zeros((0,) + skeleton.load.shape[2:])
        return none, none
    with jax.named_scope("multipliers"):
        points = _points_of(topology, now, skeleton)
        rows = 0.0
        for node in sorted(set(topology.parents[topology.n_links :]) | set(
            topology.children[topology.n_links :]
        )):
            if node == BASE:
                continue
            unit = unit_columns(topology, cuts, node, points[node])
            rows = rows + product(algebra.transpose(unit), response[node])

        def by_cut(values):
            return jnp.swapaxes(values, 0, 1).reshape((-1,) + values.shape[2:])

        correction = (
            -stabilisation.velocity_gain * cuts.rate - stabilisation.position_gain * cuts.residual
        )
        inverse = invert_closure(topology, rows[:, 1:])
        stabilising = apply(inverse, by_cut(correction))
        return stabilising - apply(inverse, by_cut(cuts.bias) + rows[:, 0]), stabilising


def _points_of(topology, now: Motion, skeleton: Skeleton) -> dict[int, Array]:
    """The point at which each node's response is given."""
    nodes = (*range(topology.n_links), *_branching(topology))
    points = {node: skeleton.point[:, i] for i, node in enumerate(nodes)}
    for i, k in enumerate(topology.carriers):
        points.setdefault(topology.n_links + k, now.carriers.point[:, i])
    return points


def _combine(columns, weights):
    """Sum of load columns (6, K): the applied loads' and those of the multipliers."""
    return columns[:, 0] if columns.shape[1] == 1 else apply(columns, weights)


def _loaded(topology, now: Motion, root, angular, linear):
    """Accelerations (3, N) of the free rfes in link axes, with those that carry joints replaced."""
    n = topology.n_links
    for i, k in enumerate(topology.carriers):
        velocity, where = now.carriers.velocity[:, i], now.carriers.point[:, i]
        turn = now.links.rotation[:, :, topology.link_of(n + k)]
        spin = velocity[:3]
        moved = root[n + k][3:] + cross(spin, velocity[3:] + cross(spin, where))
        column = np.arange(topology.n_rfes) == k
        column = column.reshape((1, -1) + (1,) * (angular.ndim - 2))
        turned = apply_transposed(turn, root[n + k][:3])
        angular = jnp.where(column, turned[:, None], angular)
        linear = jnp.where(column, apply_transposed(turn, moved)[:, None], linear)
    return angular, linear


def _classical(topology, now: Motion, skeleton: Skeleton, spatial):
    """Angular and linear accelerations (3, L) of the links' origins in link axes."""
    n = topology.n_links
    spin, velocity = skeleton.velocity[:3, :n], skeleton.velocity[3:, :n]
    arm = now.links.point - skeleton.point[:, :n]
    moved = spatial[3:] + cross(spatial[:3], arm) + cross(spin, velocity + cross(spin, arm))
    rotation = now.links.rotation
    return apply_transposed(rotation, spatial[:3]), apply_transposed(rotation, moved)


def _relative_accelerations(
    topology, now: Motion, inverse_rate, spin, root_angular, root_linear, angular, linear
):
    """Second derivatives (6, N) of the elastic coordinates from absolute accelerations."""
    with jax.named_scope("elastic_accelerations"):
        relative = now.relative
        spin, turn = spread(topology, spin), spread(topology, root_angular)
        u = (
            linear
            - spread(topology, root_linear)
            - cross(turn, relative.position)
            - cross(spin, cross(spin, relative.position) + 2.0 * relative.linear)
        )
        rotation = angular - turn - cross(spin, relative.angular) - relative.rate_bias
        return jnp.concatenate([u, apply(inverse_rate, rotation)])
