"""Accelerations at one instant, by the structure of the rigid finite element method.

Place in the pipeline: kinematics, elasticity, closure -> **dynamics** -> loads, simulation.

A free rfe is held by elastic forces alone: its absolute acceleration is wrench over inertia, and its
articulated inertia seen from the link frame is zero (MODEL section 3).  What remains is the
*skeleton*: rfes 0, joined by hinges, and the free rfes that carry a joint.  Each island of the
skeleton is solved by Featherstone's articulated-body recursion (2008, ch. 7) for the applied loads
and for unit multipliers of the cut joints at once; the multipliers follow from equation (19), the
elastic accelerations from the absolute ones.  Cost and memory are linear in the number of rfes; no
mechanism-wide mass matrix is formed.

Wrenches and accelerations of rfes are in the axes of their link; those of the skeleton are spatial
vectors in global axes at one point of their island, where its root is at this instant (a common
point needs no transforms, a near one keeps the small inertias' digits).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from rfem_jax.mechanics import algebra, elasticity
from rfem_jax.mechanics.algebra import apply, apply_transposed, cross, dot, product
from rfem_jax.mechanics.closure import Closure, closures
from rfem_jax.mechanics.kinematics import Motion, motion, node_motion
from rfem_jax.mechanics.model import BASE, Coordinates, State, Topology
from rfem_jax.mechanics.realisation import Realisation


class DriveInput(NamedTuple):
    """What the drive does at one instant: a moment [N m] on the driven joint, or the joint's
    prescribed (angle, rate, acceleration); None for what it does not do."""

    moment: Array | None = None
    turn: tuple[Array, Array, Array] | None = None


class Stabilisation(NamedTuple):
    """Baumgarte's gains: Phi'' = -velocity_gain Phi' - position_gain Phi [1/s, 1/s^2], and the
    length [m] that scales the axis equations."""

    velocity_gain: Array
    position_gain: Array
    scale: Array


class Accelerations(NamedTuple):
    """Result of one instant.

    coordinates: second derivatives of the coordinates; multipliers (5 cuts,); stabilising (5 cuts,)
    their part due to Baumgarte's terms; angular, linear (3, nodes): absolute accelerations of all
    nodes' reference points in link axes; motion and closures are passed on.
    """

    coordinates: Coordinates
    multipliers: Array
    stabilising: Array
    angular: Array
    linear: Array
    motion: Motion
    closures: tuple[Closure, ...]


class LinkAxes(NamedTuple):
    """Gravity, angular velocity and rotation of the links, (3, L) and (3, 3, L), in link axes."""

    rotation: Array
    gravity: Array
    angular_velocity: Array


def impose(topology: Topology, state: State, drive: DriveInput) -> State:
    """The state with the driven joint's angle and rate replaced by the prescribed ones."""
    if drive.turn is None:
        return state
    driven = topology.driven
    angles = state.position.angles.at[driven].set(drive.turn[0])
    rates = state.velocity.angles.at[driven].set(drive.turn[1])
    return State(
        Coordinates(angles, state.position.elastic), Coordinates(rates, state.velocity.elastic)
    )


def accelerations(
    realised: Realisation, state: State, drive: DriveInput, stabilisation: Stabilisation
) -> Accelerations:
    """Accelerations of all coordinates and bodies, and the multipliers of the cut joints.

    `state` is taken with prescribed values already imposed (`impose`).
    """
    topology = realised.topology
    now = motion(realised, state)
    cuts = closures(realised, now, stabilisation.scale)
    axes = _link_axes(realised, now)
    inverse_rate = algebra.invert_block(now.relative.rate_matrix)
    force, moment = _elastic_wrenches(realised, state, inverse_rate)
    angular, linear = _free_accelerations(realised, now, axes, force, moment)
    skeleton = _skeleton(realised, now, force, moment)
    root, hinge_acceleration, multipliers, stabilising = _solve_skeleton(
        realised, state, now, cuts, skeleton, drive, stabilisation
    )
    root_angular, root_linear, angular, linear = _absolute(
        topology, now, skeleton, root, angular, linear
    )
    elastic = _relative_accelerations(
        topology, now, axes, inverse_rate, root_angular, root_linear, angular, linear
    )
    return Accelerations(
        coordinates=Coordinates(hinge_acceleration, elastic),
        multipliers=multipliers,
        stabilising=stabilising,
        angular=jnp.concatenate([root_angular, angular], axis=1),
        linear=jnp.concatenate([root_linear, linear], axis=1),
        motion=now,
        closures=cuts,
    )


def _link_axes(realised: Realisation, now: Motion) -> LinkAxes:
    rotation = jnp.stack([link.rotation for link in now.links], axis=2)
    spin = jnp.stack([link.velocity[:3] for link in now.links], axis=1)
    gravity = realised.gravity.reshape((3, 1) + (1,) * (rotation.ndim - 3))
    gravity = gravity + jnp.zeros_like(spin)
    return LinkAxes(rotation, apply_transposed(rotation, gravity), apply_transposed(rotation, spin))


def _elastic_wrenches(realised: Realisation, state: State, inverse_rate: Array):
    """Force and moment (3, N) of springs and dampers on every free rfe, at its middle."""
    generalised = elasticity.forces(realised, state.position, state.velocity)
    return generalised[:3], apply_transposed(inverse_rate, generalised[3:])


def _free_accelerations(realised, now: Motion, axes: LinkAxes, force, moment):
    """Absolute accelerations (3, N) of free bodies under the given wrenches and gravity."""
    with jax.named_scope("free_rfes"):
        topology = realised.topology
        link, n = topology.link_of_rfe.astype(int), topology.n_links
        relative = now.relative
        spin = axes.angular_velocity[:, link] + relative.angular
        body_spin = apply_transposed(relative.rotation, spin)
        body_centre = _like(realised.centre[:, n:], spin)
        body_moment = apply_transposed(relative.rotation, moment) - cross(
            body_centre, apply_transposed(relative.rotation, force)
        )
        gyroscopic = cross(body_spin, apply(_like(realised.inertia[:, :, n:], spin), body_spin))
        angular = apply(
            relative.rotation,
            apply(_like(realised.inverse_inertia, spin), body_moment - gyroscopic),
        )
        centre = apply(relative.rotation, body_centre)
        of_centre = force / _like(realised.mass[n:], spin)[None] + axes.gravity[:, link]
        return angular, of_centre - cross(angular, centre) - cross(spin, cross(spin, centre))


def _like(values: Array, example: Array) -> Array:
    """Trailing axes of length one for a constant that later axes of `example` broadcast over."""
    return values.reshape(values.shape + (1,) * (example.ndim - 2)) if example.ndim > 2 else values


class Skeleton(NamedTuple):
    """By node: the island's point (3,), velocity (6,), spatial inertia (6, 6) and applied minus
    gyroscopic wrench (6,) at that point."""

    point: dict[int, Array]
    velocity: dict[int, Array]
    inertia: dict[int, Array]
    wrench: dict[int, Array]


def _skeleton(realised: Realisation, now: Motion, force: Array, moment: Array) -> Skeleton:
    with jax.named_scope("skeleton"):
        topology = realised.topology
        n = topology.n_links
        nodes = _skeleton_nodes(topology)
        frames = [node_motion(topology, now.relative, now.links, node) for node in nodes]
        points = _island_points(topology, now, dict(zip(nodes, frames)))
        applied = []
        for link, (a, b), point in zip(now.links, topology.ranges, points):
            arms = now.relative.position[:, a:b]
            total = jnp.sum(force[:, a:b], axis=1)
            couple = jnp.sum(moment[:, a:b] + cross(arms, force[:, a:b]), axis=1)
            applied.append(-_in_global_axes(link, couple, total, link.origin - point))
        for k, (_, where, _), point in zip(topology.carriers, frames[n:], points[n:]):
            link = now.links[topology.link_of(n + k)]
            applied.append(_in_global_axes(link, moment[:, k], force[:, k], where - point))
        rotation, where, velocity = (jnp.stack(part, axis=-1) for part in zip(*frames))
        point = jnp.stack(points, axis=1)
        velocity = _shifted(velocity, point)
        centre = where - point + apply(rotation, _take(realised.centre, nodes, where))
        own = _take(realised.inertia, nodes, where)
        central = algebra.product_transposed(product(rotation, own), rotation)
        mass = jnp.broadcast_to(_take(realised.mass, nodes, where), central.shape[2:])
        inertia = algebra.spatial_inertia(mass, centre, central)
        gravity = mass[None] * _like(realised.gravity[:, None], centre)
        wrench = (
            jnp.stack(applied, axis=1)
            + algebra.wrench_at_origin(jnp.zeros_like(gravity), gravity, centre)
            - algebra.force_cross(velocity, apply(inertia, velocity))
        )
        parts = (point, velocity, inertia, wrench)
        return Skeleton(*[{v: x[..., i] for i, v in enumerate(nodes)} for x in parts])


def _island_points(topology: Topology, now: Motion, frames) -> list[Array]:
    """The point of each skeleton node's island: its base hinge, or its carrier's middle."""
    roots = [_island(topology, node) for node in frames]
    return [
        now.links[root].hinge_centre if root < topology.n_links else frames[root][1]
        for root in roots
    ]


def _shifted(motion: Array, point: Array) -> Array:
    """Spatial motion (6, ...) given at the global origin, at `point`."""
    return algebra.spatial(motion[:3], motion[3:] + cross(motion[:3], point))


def _in_global_axes(link, moment, force, point):
    """Wrench at the global origin of a moment and a force in link axes that acts at `point`."""
    return algebra.wrench_at_origin(
        apply(link.rotation, moment), apply(link.rotation, force), point
    )


def _take(values, nodes, example):
    return _like(values[..., jnp.asarray(nodes)], example)


def _solve_skeleton(realised, state, now, cuts, skeleton, drive, stabilisation):
    """Accelerations (6,) of the skeleton's nodes and of the hinges, and the multipliers."""
    topology = realised.topology
    with jax.named_scope("articulated_bodies"):
        loads = _load_columns(topology, cuts, skeleton)
        response, hinges = _recursion(topology, state, now, skeleton, loads, drive)
    if not cuts:
        none = jnp.zeros((0,) + hinges[0].shape[1:])
        return {v: a[:, 0] for v, a in response.items()}, jnp.stack([h[0] for h in hinges]), none, none
    with jax.named_scope("multipliers"):
        multipliers, stabilising = _multipliers(topology, cuts, skeleton, response, stabilisation)
        weights = jnp.concatenate([jnp.ones_like(multipliers[:1]), multipliers])
        accelerations = {
            node: a[:, 0] if a.shape[1] == 1 else apply(a, weights) for node, a in response.items()
        }
        rates = [h[0] if h.shape[0] == 1 else dot(h, weights) for h in hinges]
        return accelerations, jnp.stack(rates), multipliers, stabilising


def _skeleton_nodes(topology: Topology) -> list[int]:
    return list(range(topology.n_links)) + [topology.n_links + k for k in topology.carriers]


def _island(topology: Topology, node: int) -> int:
    """The node that roots the island of hinged bodies to which `node` belongs."""
    while node < topology.n_links and topology.parents[node] != BASE:
        node = topology.parents[node]
    return node


def _load_columns(topology, cuts, skeleton: Skeleton):
    """Columns of wrenches on each node: applied loads, then unit multipliers in loaded islands."""
    sides = [(topology.parents[j], topology.children[j]) for j in topology.cuts]
    loaded = {_island(topology, node) for pair in sides for node in pair if node != BASE}
    loads = {}
    for node, wrench in skeleton.wrench.items():
        columns = [wrench[:, None]]
        if _island(topology, node) in loaded:
            point = skeleton.point[node]
            for (left, right), cut in zip(sides, cuts):
                on_right = cut.wrenches("child", point) if node == right else 0.0
                on_left = cut.wrenches("parent", point) if node == left else 0.0
                shape = (6, 5) + wrench.shape[1:]
                columns.append(jnp.zeros(shape) + on_right - on_left)
        loads[node] = jnp.concatenate(columns, axis=1)
    return loads


def _recursion(topology, state, now, skeleton: Skeleton, loads, drive):
    """Articulated-body recursion for several load columns (6, K) at once."""
    inertias, loads = dict(skeleton.inertia), dict(loads)
    record, accelerations, hinges = {}, {}, []
    for l in reversed(range(topology.n_links)):
        link, node, inertia, load = now.links[l], topology.parents[l], inertias[l], loads[l]
        point = skeleton.point[l]
        axis = _shifted(link.axis, point)
        carrying = _shifted(link.parent_velocity, point)
        bias = algebra.motion_cross(carrying, axis * state.velocity.angles[l][None])
        first = jnp.asarray(np.eye(1, load.shape[1])[0].reshape((-1,) + (1,) * (load.ndim - 2)))
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
            rate = push / dot(axis, u)[None]
            record[l] = (axis, bias[:, None] * first[None], rate, scaled)
            inertia = inertia - u[:, None] * scaled[None]
            passed = (
                load - apply(inertia, bias)[:, None] * first[None] - scaled[:, None] * push[None]
            )
        if node != BASE:
            inertias[node] = inertias[node] + inertia
            loads[node] = loads[node] + passed
    for k in topology.carriers:
        node = topology.n_links + k
        accelerations[node] = product(algebra.invert_positive(inertias[node]), loads[node])
    for l in range(topology.n_links):
        node = topology.parents[l]
        axis, bias, rate, scaled = record[l]
        carried = bias if node == BASE else bias + accelerations[node]
        if scaled is not None:
            rate = rate - dot(scaled[:, None], carried)
            carried = carried + axis[:, None] * rate[None]
        accelerations[l] = carried
        hinges.append(rate)
    return accelerations, hinges


def _multipliers(topology, cuts, skeleton: Skeleton, response, stabilisation: Stabilisation):
    """Multipliers (5 cuts,) of equation (19), and their part that is due to stabilisation."""
    rows = []
    for j, cut in zip(topology.cuts, cuts):
        left, right = topology.parents[j], topology.children[j]
        unit = algebra.transpose(cut.wrenches("child", skeleton.point[right]))
        row = product(unit, response[right])
        if left != BASE:
            unit = algebra.transpose(cut.wrenches("parent", skeleton.point[left]))
            row = row - product(unit, response[left])
        rows.append(row)
    rows = jnp.concatenate(rows)
    bias = jnp.concatenate([cut.bias for cut in cuts]) + rows[:, 0]
    correction = jnp.concatenate(
        [
            -stabilisation.velocity_gain * cut.rate - stabilisation.position_gain * cut.residual
            for cut in cuts
        ]
    )
    inverse = _invert(topology, rows[:, 1:])
    stabilising = apply(inverse, correction)
    return stabilising - apply(inverse, bias), stabilising


def _invert(topology: Topology, matrix):
    if not topology.minimum_norm:
        return algebra.invert_positive(matrix)
    last = jnp.moveaxis(matrix, (0, 1), (-2, -1))
    inverse = jnp.linalg.pinv(last, rtol=RANK_TOLERANCE, hermitian=True)
    return jnp.moveaxis(inverse, (-2, -1), (0, 1))


RANK_TOLERANCE = 1e-9


def _absolute(topology, now: Motion, skeleton: Skeleton, root, angular, linear):
    """Classical accelerations of all nodes' reference points in link axes; carriers replaced."""

    def classical(node):
        link = now.links[topology.link_of(node)]
        _, where, _ = node_motion(topology, now.relative, now.links, node)
        arm, velocity = where - skeleton.point[node], skeleton.velocity[node]
        spin = velocity[:3]
        moved = (
            root[node][3:]
            + cross(root[node][:3], arm)
            + cross(spin, velocity[3:] + cross(spin, arm))
        )
        turned = apply_transposed(link.rotation, root[node][:3])
        return turned, apply_transposed(link.rotation, moved)

    n = topology.n_links
    roots = [classical(l) for l in range(n)]
    for k in topology.carriers:
        turned, moved = classical(n + k)
        angular, linear = angular.at[:, k].set(turned), linear.at[:, k].set(moved)
    return (
        jnp.stack([a for a, _ in roots], axis=1),
        jnp.stack([a for _, a in roots], axis=1),
        angular,
        linear,
    )


def _relative_accelerations(
    topology, now: Motion, axes, inverse_rate, root_angular, root_linear, angular, linear
):
    """Second derivatives (6, N) of the elastic coordinates from absolute accelerations."""
    with jax.named_scope("elastic_accelerations"):
        link = topology.link_of_rfe.astype(int)
        relative = now.relative
        spin, turn = axes.angular_velocity[:, link], root_angular[:, link]
        u = (
            linear
            - root_linear[:, link]
            - cross(turn, relative.position)
            - cross(spin, cross(spin, relative.position) + 2.0 * relative.linear)
        )
        rotation = angular - turn - cross(spin, relative.angular) - relative.rate_bias
        return jnp.concatenate([u, apply(inverse_rate, rotation)])
