"""Coordinates and rates of joints that turn about any axis: unit quaternions and angular velocities.

Place in the pipeline: model -> **orientations** -> kinematics, statics, loads, simulation.

A spherical or free joint's rotation has no three coordinates without a singular orientation. Its position is a
quaternion (w, x, y, z) of H in the frame that its other motions lead to, its rates are the angular velocity in the
axes of that frame (theory (2.18) to (2.20)). Rotations are formed of q / |q|, so that the length of an integrated
quaternion does not matter. All other coordinates are plain numbers, of which there are as many as rates; where a
mechanism has no others, these functions add and copy, nothing else.

Symbols: q quaternion, theta rotation vector [rad], w angular velocity [rad/s].
"""

import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from rfem_jax.mechanics.algebra import vectors
from rfem_jax.mechanics.algebra.vectors import cross, dot
from rfem_jax.mechanics.model.model import Coordinates
from rfem_jax.mechanics.model.topology import Topology

SERIES = 1e-3  # of the squared angle, below which the exponential is a power series


def rotation_of(q: Float[Array, " 4 *k"]) -> Float[Array, "3 3 *k"]:
    """Rotation of a quaternion of any length but zero (theory (2.18))."""
    scalar, vector = q[0], q[1:]
    skew = vectors.cross_matrix(vector)
    identity = jnp.asarray(vectors.IDENTITY).reshape((3, 3) + (1,) * scalar.ndim)
    return identity + (2.0 / dot(q, q))[None, None] * (scalar[None, None] * skew + vectors.product(skew, skew))


def product(p: Float[Array, " 4 *k"], q: Float[Array, " 4 *k"]) -> Float[Array, " 4 *k"]:
    """Product of quaternions: first the rotation q, then p."""
    scalar = p[0] * q[0] - dot(p[1:], q[1:])
    vector = p[:1] * q[1:] + q[:1] * p[1:] + cross(p[1:], q[1:])
    return jnp.concatenate([scalar[None], vector])


def exponential(theta: Float[Array, " 3 *k"]) -> Float[Array, " 4 *k"]:
    """Quaternion of a rotation vector (theory (2.20)), with its derivatives at zero."""
    square = dot(theta, theta)
    small = square < SERIES
    angle = jnp.sqrt(jnp.where(small, 1.0, square))
    x = jnp.where(small, square, 0.0)
    cosine = 1.0 + x * (-1.0 / 8.0 + x * (1.0 / 384.0 + x * (-1.0 / 46080.0 + x / 10321920.0)))
    factor = 0.5 + x * (-1.0 / 48.0 + x * (1.0 / 3840.0 + x * (-1.0 / 645120.0 + x / 185794560.0)))
    cosine = jnp.where(small, cosine, jnp.cos(0.5 * angle))
    factor = jnp.where(small, factor, jnp.sin(0.5 * angle) / angle)
    return jnp.concatenate([cosine[None], factor[None] * theta])


def moved(topology: Topology, position: Coordinates, change: Coordinates) -> Coordinates:
    """Position after a finite change of the coordinates, of quaternions by a rotation vector in the axes of their
    frame."""
    elastic = position.elastic + change.elastic
    if not topology.balls:
        return Coordinates(position.joints + change.joints, elastic)

    def turned(q, theta):
        return product(exponential(theta), q)

    return Coordinates(_map_joints(topology, position.joints, change.joints, jnp.add, turned), elastic)


def position_rate(topology: Topology, position: Coordinates, velocity: Coordinates) -> Coordinates:
    """Time derivative of the position: of quaternions (0, w) q / 2 (theory (2.19))."""
    if not topology.balls:
        return velocity

    def rate(q, w):
        return 0.5 * product(jnp.concatenate([jnp.zeros_like(w[:1]), w]), q)

    joints = _map_joints(topology, position.joints, velocity.joints, lambda _, v: v, rate)
    return Coordinates(joints, velocity.elastic)


def rates_of(topology: Topology, position: Coordinates, derivative: Coordinates) -> Coordinates:
    """Rates of the coordinates from the time derivative of the position: the inverse of `position_rate`."""
    if not topology.balls:
        return derivative

    def rate(q, q_dot):
        inverse = jnp.concatenate([q[:1], -q[1:]]) / dot(q, q)
        return 2.0 * product(q_dot, inverse)[1:]

    parts = []
    for l in range(topology.n_links):
        at = topology.positions[l]
        plain, ball = at[: topology.plain(l)], at[topology.plain(l) :]
        parts.append(derivative.joints[plain.start : plain.stop])
        if ball:
            parts.append(rate(position.joints[ball.start : ball.stop], derivative.joints[ball.start : ball.stop]))
    return Coordinates(jnp.concatenate(parts), derivative.elastic)


def _map_joints(topology: Topology, position: Array, tangent: Array, of_plain, of_ball) -> Array:
    """Joint by joint `of_plain`(position, tangent) of plain numbers, `of_ball`(quaternion, three rates) of the
    others, of all in one vector."""
    parts = []
    for l in range(topology.n_links):
        at, rates, n = topology.positions[l], topology.coordinates[l], topology.plain(l)
        parts.append(of_plain(position[at.start : at.start + n], tangent[rates.start : rates.start + n]))
        if topology.kind(l).ball:
            parts.append(of_ball(position[at.start + n : at.stop], tangent[rates.start + n : rates.stop]))
    return jnp.concatenate(parts)


def quaternion_of_angles(angles: Float[np.ndarray, "3"]) -> Float[np.ndarray, "4"]:
    """Quaternion of R_z R_y R_x by angles about x, y, z [rad], in NumPy."""
    (cx, cy, cz), (sx, sy, sz) = np.cos(0.5 * np.asarray(angles)), np.sin(0.5 * np.asarray(angles))
    return np.array(
        [
            cx * cy * cz + sx * sy * sz,
            sx * cy * cz - cx * sy * sz,
            cx * sy * cz + sx * cy * sz,
            cx * cy * sz - sx * sy * cz,
        ]
    )


def angles_of(q: Float[Array, "*times 4"]) -> Float[Array, "*times 3"]:
    """Angles about x, y, z [rad] of R_z R_y R_x, for people to read: singular where the second is 90 deg."""
    rotation = rotation_of(jnp.moveaxis(q, -1, 0))
    x = jnp.arctan2(rotation[2, 1], rotation[2, 2])
    y = jnp.arctan2(-rotation[2, 0], jnp.sqrt(rotation[2, 1] ** 2 + rotation[2, 2] ** 2))
    return jnp.stack([x, y, jnp.arctan2(rotation[1, 0], rotation[0, 0])], axis=-1)
