"""Positions and velocities of all bodies and joints at one instant.

Place in the pipeline: realisation + state -> **kinematics** -> elasticity, closure, dynamics, loads.

The relative motion of the free rfes (MODEL equations (2) to (4)) is taken for all of them at once in
their link frames; then the links are placed one after another from the base (equation (6) with both
errors).  Frames: link frame {p,0} = H (F_c E_c)^-1 with the hinge frame H = F E R_y(phi).

Symbols: R rotation, w angular velocity, u_dot translation rate; spatial velocities (6,) at the
global origin.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from rfem_jax.mechanics import algebra
from rfem_jax.mechanics.algebra import apply, apply_transposed, cross, product
from rfem_jax.mechanics.model import BASE, Coordinates, State
from rfem_jax.mechanics.realisation import Realisation


class RelativeMotion(NamedTuple):
    """Motion of the free rfes relative to their link frames, in link axes.

    rotation (3, 3, N), position (3, N) of the segment's middle, rate_matrix (3, 3, N) with
    w = rate_matrix phi_dot, and at the given rates: angular, linear (3, N) and rate_bias (3, N) =
    (d rate_matrix / dt) phi_dot.
    """

    rotation: Array
    position: Array
    rate_matrix: Array
    angular: Array
    linear: Array
    rate_bias: Array


class LinkMotion(NamedTuple):
    """Motion of one link frame and its hinge in global axes.

    rotation (3, 3), origin (3,), velocity (6,) of the link frame; hinge_rotation, hinge_centre of
    the hinge frame H; axis (6,) the hinge's spatial axis; parent_velocity (6,).
    """

    rotation: Array
    origin: Array
    velocity: Array
    hinge_rotation: Array
    hinge_centre: Array
    axis: Array
    parent_velocity: Array


class Motion(NamedTuple):
    """Everything that the other stages read of one instant's positions and velocities."""

    relative: RelativeMotion
    links: tuple[LinkMotion, ...]


def motion(realised: Realisation, state: State) -> Motion:
    """Positions and velocities of all links and rfes at one instant."""
    topology = realised.topology
    with jax.named_scope("kinematics"):
        relative = relative_motion(realised, state.position, state.velocity)
        links: list[LinkMotion] = []
        for index, node in enumerate(topology.parents[: topology.n_links]):
            parent = node_motion(topology, relative, links, node)
            links.append(_place_link(realised, state, index, parent))
        return Motion(relative, tuple(links))


def relative_motion(
    realised: Realisation, position: Coordinates, velocity: Coordinates
) -> RelativeMotion:
    """Motion of the free rfes in their link frames (equation (4) and its rate)."""
    u, phi = position.elastic[:3], position.elastic[3:]
    u_dot, rate = velocity.elastic[:3], velocity.elastic[3:]
    c, s = jnp.cos(phi), jnp.sin(phi)
    (cx, cy, cz), (sx, sy, sz) = c, s
    zero, one = jnp.zeros_like(cx), jnp.ones_like(cx)
    rotation = jnp.stack(
        [
            jnp.stack([cz * cy, cz * sy * sx - sz * cx, cz * sy * cx + sz * sx]),
            jnp.stack([sz * cy, sz * sy * sx + cz * cx, sz * sy * cx - cz * sx]),
            jnp.stack([-sy, cy * sx, cy * cx]),
        ]
    )
    rate_matrix = jnp.stack(
        [
            jnp.stack([cz * cy, -sz, zero]),
            jnp.stack([sz * cy, cz, zero]),
            jnp.stack([-sy, zero, one]),
        ]
    )
    # w = phi_x' e_x + phi_y' e_y + phi_z' z: e_x turns with the rates about y and z, e_y about z.
    about_z = jnp.stack([zero, zero, rate[2]])
    about_y = jnp.stack([-sz, cz, zero]) * rate[1][None]
    about_x = rate_matrix[:, 0] * rate[0][None]
    rate_bias = cross(about_z, about_y) + cross(about_z + about_y, about_x)
    rest = jnp.stack([realised.rest, 0.0 * realised.rest, 0.0 * realised.rest])
    return RelativeMotion(
        rotation=rotation,
        position=rest + u,
        rate_matrix=rate_matrix,
        angular=about_z + about_y + about_x,
        linear=u_dot,
        rate_bias=rate_bias,
    )


def node_motion(topology, relative: RelativeMotion, links, node: int):
    """Rotation, reference point and spatial velocity of a node in global axes."""
    if node == BASE:
        return jnp.asarray(algebra.IDENTITY), jnp.zeros(3), jnp.zeros(6)
    if node < topology.n_links:
        return links[node].rotation, links[node].origin, links[node].velocity
    k = node - topology.n_links
    link = links[topology.link_of(node)]
    point = link.origin + apply(link.rotation, relative.position[:, k])
    angular = apply(link.rotation, relative.angular[:, k])
    linear = apply(link.rotation, relative.linear[:, k])
    velocity = link.velocity + algebra.motion_at_origin(angular, linear, point)
    return product(link.rotation, relative.rotation[:, :, k]), point, velocity


def _place_link(realised: Realisation, state: State, index: int, parent) -> LinkMotion:
    rotation, point, velocity = parent
    joint_rotation = product(rotation, realised.seat_rotation[:, :, index])
    turn = algebra.rotation_y(state.position.angles[index])
    hinge_rotation = product(joint_rotation, turn)
    centre = point + apply(rotation, realised.seat_position[:, index])
    link_rotation = algebra.product_transposed(hinge_rotation, realised.bore_rotation[:, :, index])
    origin = centre - apply(link_rotation, realised.bore_position[:, index])
    y = joint_rotation[:, 1]
    axis = algebra.spatial(y, cross(centre, y))
    return LinkMotion(
        rotation=link_rotation,
        origin=origin,
        velocity=velocity + axis * state.velocity.angles[index][None],
        hinge_rotation=hinge_rotation,
        hinge_centre=centre,
        axis=axis,
        parent_velocity=velocity,
    )


def side_frame(realised: Realisation, motion: Motion, joint: int, side: str):
    """Frame of a joint on its "parent" (L) or "child" (P) side: rotation, centre and the spatial
    velocity of the node it is fixed to."""
    topology = realised.topology
    node = (topology.parents if side == "parent" else topology.children)[joint]
    rotation, point, velocity = node_motion(topology, motion.relative, motion.links, node)
    if side == "parent":
        turn, shift = realised.seat_rotation, realised.seat_position
    else:
        turn, shift = realised.bore_rotation, realised.bore_position
    return (
        product(rotation, turn[:, :, joint]),
        point + apply(rotation, shift[:, joint]),
        velocity,
    )


def node_frames(realised: Realisation, motion: Motion) -> tuple[Array, Array]:
    """Rotations (3, 3, nodes) and reference points (3, nodes) of all nodes in global axes."""
    link_of = realised.topology.link_of_rfe.astype(int)
    rotations = jnp.stack([link.rotation for link in motion.links], axis=-1)
    origins = jnp.stack([link.origin for link in motion.links], axis=-1)
    of_rfes = product(rotations[:, :, link_of], motion.relative.rotation)
    points = origins[:, link_of] + apply(rotations[:, :, link_of], motion.relative.position)
    return (
        jnp.concatenate([rotations, of_rfes], axis=-1),
        jnp.concatenate([origins, points], axis=-1),
    )


def closing_angle(realised: Realisation, motion: Motion, cut: int) -> Array:
    """Angle of a cut joint: from L to P about the hinge."""
    left, _, _ = side_frame(realised, motion, cut, "parent")
    right, _, _ = side_frame(realised, motion, cut, "child")
    x = apply_transposed(left, right[:, 0])
    return jnp.arctan2(-x[2], x[0])
