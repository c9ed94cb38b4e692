"""Transforms of all nodes, and the closure equations, as functions of the coordinates.

Place in the pipeline: model with errors -> **node_transforms** -> work_of_joints, work_of_elements, formulation.

4 x 4 matrices that are differentiated automatically; nothing of `kinematics` is used.
"""

from collections.abc import Mapping, Sequence
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.typing import ArrayLike
from jaxtyping import Float

from rfem_jax.description.basics.joint_kinds import JointKind
from rfem_jax.mechanics.algebra.vectors import Scalar
from rfem_jax.mechanics.model.model import Coordinates
from rfem_jax.mechanics.model.topology import BASE, Topology
from rfem_jax.mechanics.model.with_errors import ModelWithErrors

NOT_MOVED: Any = np.eye(4)  # the transform of the base


def transform(rotation: ArrayLike, position: ArrayLike) -> Array:
    """Transform (4, 4) of a rotation (3, 3) and a position (3,)."""
    top = jnp.concatenate([rotation, jnp.reshape(position, (3, 1))], axis=1)
    return jnp.concatenate([top, np.array([[0.0, 0.0, 0.0, 1.0]])])


def axial(skew: Array) -> Array:
    """Vector of a skew-symmetric matrix (3, 3, ...)."""
    return jnp.stack([skew[2, 1], skew[0, 2], skew[1, 0]])


def _rotation_about(axis: int, angle: Array) -> Array:
    """Rotation about a coordinate axis."""
    along, turning = np.zeros((3, 3)), np.zeros((3, 3))
    i, j = (axis + 1) % 3, (axis + 2) % 3
    along[axis, axis], turning[j, i], turning[i, j] = 1.0, 1.0, -1.0
    return jnp.cos(angle) * (np.eye(3) - along) + jnp.sin(angle) * turning + along


def changed(topology: Topology, position: Coordinates, change: Coordinates) -> Coordinates:
    """The position with its plain numbers changed."""
    chosen = np.zeros((position.joints.shape[0], change.joints.shape[0]))
    for l in range(topology.n_links):
        for k, rate in list(zip(topology.positions[l], topology.coordinates[l]))[: topology.plain(l)]:
            chosen[k, rate] = 1.0
    return Coordinates(position.joints + chosen @ change.joints, position.elastic + change.elastic)


def _turned(q: Array) -> Array:
    """Rotation of a quaternion: the products (0, e_i) with it on the left and its conjugate on the right."""
    w, x, y, z = q / jnp.sqrt(q @ q)
    left = jnp.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])
    right = jnp.array([[w, -x, -y, -z], [x, w, z, -y], [y, -z, w, x], [z, y, -x, w]])
    return (left @ right.T)[1:, 1:]


def transforms(
    actual: ModelWithErrors, position: Coordinates, change: Coordinates | None = None
) -> list[Float[Array, "4 4"]]:
    """Transforms of all nodes to the global frame, in the order of the nodes; `change`: of the coordinates from the
    position, of quaternions as a rotation vector, correct to second order."""
    topology = actual.topology
    if change is not None:
        position = changed(topology, position, change)
    seat = [transform(actual.seat_rotation[:, :, j], actual.seat_position[:, j]) for j in range(len(topology.joints))]
    bore = [transform(actual.bore_rotation[:, :, j], actual.bore_position[:, j]) for j in range(len(topology.joints))]
    frames: dict[int, Any] = {BASE: NOT_MOVED}
    for l, (a, b) in enumerate(topology.ranges):
        hinge = frames[topology.parents[l]] @ seat[l]
        at = topology.positions[l]
        for freedom, k in zip(topology.kind(l).freedoms[: topology.plain(l)], at):
            q = position.joints[k]
            along = transform(np.eye(3), np.eye(3)[freedom.axis] * q)
            hinge = hinge @ (transform(_rotation_about(freedom.axis, q), np.zeros(3)) if freedom.rotation else along)
        if topology.kind(l).ball:
            rotation = _turned(position.joints[at.stop - 4 : at.stop])
            if change is not None:
                stop = topology.coordinates[l].stop
                x, y, z = change.joints[stop - 3 : stop]
                skew = jnp.array([[0.0 * x, -z, y], [z, 0.0 * x, -x], [-y, x, 0.0 * x]])
                rotation = (jnp.eye(3) + skew + 0.5 * skew @ skew) @ rotation
            hinge = hinge @ transform(rotation, np.zeros(3))
        frames[l] = hinge @ jnp.linalg.inv(bore[l])
        for k in range(a, b):
            x, y, z = slender_place(actual, position, k) if l in topology.slender else position.elastic[:3, k]
            rotation = _rfe_rotation(topology, position.elastic[3:, k])
            rest = place_along(actual.rest, k)
            relative = transform(rotation, rest + jnp.stack([x, y, z]))
            frames[topology.n_links + k] = frames[l] @ relative
    return [frames[node] for node in range(topology.n_links + topology.n_rfes)]


def _rfe_rotation(topology: Topology, phi: Array) -> Array:
    """Rotation of an rfe in its link frame."""
    outer = _rotation_about(2, phi[2]) @ _rotation_about(1, phi[1])
    if topology.exact:
        outer = _rotation_about(1, phi[1]) @ _rotation_about(2, phi[2])
    return outer @ _rotation_about(0, phi[0])


def slender_place(actual: ModelWithErrors, position: Coordinates, rfe: int) -> Array:
    """Displacement of an rfe of a slender link, whose faces meet: from face to face, beginning at rfe 0."""
    topology, x = actual.topology, jnp.array([1.0, 0.0, 0.0])

    def moved(k: int, lever: Array) -> Array:
        phi = position.elastic[3:, k]
        return lever * (_rfe_rotation(topology, phi) @ x - x)

    place = jnp.zeros(3)
    first = topology.ranges[topology.link_of(topology.n_links + rfe)][0]
    for k in range(first, rfe + 1):
        place = place - moved(k, actual.lever_right[k])
        if k < rfe:
            place = place + moved(k, actual.lever_left[k + 1])
    return place


def place_along(places: Array, k: int) -> Array:
    """Place k of several, of which the x, or all components, are known."""
    return places[:, k] if places.ndim == 2 else jnp.array([1.0, 0.0, 0.0]) * places[k]


def constraints(
    actual: ModelWithErrors, position: Coordinates, scale: Scalar, change: Coordinates | None = None
) -> Float[Array, " constraints"]:
    """Theory (5.1), (5.14), (5.15) for all cut joints [m], and (16.7) for ideal couplings; `scale` [m] multiplies the
    equations of the axes and of coupled angles."""
    topology = actual.topology
    frames = transforms(actual, position, change)
    rows = [joint_rows(topology.kind(j), *joint_frames(actual, frames, j), scale) for j in topology.cuts]
    joints = position.joints if change is None else changed(topology, position, change).joints
    for name in topology.ideal:
        assert actual.forces is not None, "couplings are among the forces"
        law = actual.forces.couplings[name]
        apart = law.deflection(joints[np.array(law.places)])
        rows.append(jnp.reshape(apart if topology.slides[law.coordinates[1]] else scale * apart, (1,)))
    return jnp.concatenate(rows) if rows else jnp.zeros(0)


def joint_frames(
    actual: ModelWithErrors, frames: Sequence[Array] | Mapping[int, Array], joint: int
) -> tuple[Float[Array, "4 4"], Float[Array, "4 4"]]:
    """Transforms of a joint's frames on its parent and on its child, errors included; `frames` of the nodes."""
    parent, child = actual.topology.parents[joint], actual.topology.children[joint]
    seat = transform(actual.seat_rotation[:, :, joint], actual.seat_position[:, joint])
    bore = transform(actual.bore_rotation[:, :, joint], actual.bore_position[:, joint])
    return (NOT_MOVED if parent == BASE else frames[parent]) @ seat, frames[child] @ bore


def joint_rows(kind: JointKind, left: Float[Array, "4 4"], right: Float[Array, "4 4"], scale: Scalar) -> Array:
    """Closure equations [m] of one cut joint from the transforms of its frames."""
    relative = jnp.linalg.inv(left) @ right
    apart = right[:3, 3] - left[:3, 3] if kind.coincident else relative[jnp.array(kind.across, int), 3]
    return jnp.concatenate([apart, *(scale * relative[i, k][None] for i, k in kind.perpendicular)])
