"""The perfect, undeformed mechanism in NumPy: where its bodies are, how far its loops are open.

Place in the pipeline: model -> **nominal_geometry** -> discretisation, the check of the step.

The questions before a simulation (does it close, what is its rank, which step is stable) concern rigid
geometry and a few numbers, so they are answered on the host, and nothing of it is traced or compiled.

Symbols: twists (angular, linear) at the global origin, in global axes; n_links L, nodes n, cut joints C.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from rfem_jax.mechanics.model import BASE, Model, Topology, rfe_fractions


class NominalGeometry(NamedTuple):
    """Constants of the perfect mechanism: frames of all joints (J, 3, 3), (J, 3) in the nodes of their parents
    and children; rest (N,) [m]: x of the free rfes' middles in their links; scale [m]: the longest link."""

    topology: Topology
    seat_rotation: Float[np.ndarray, "joints 3 3"]
    seat_position: Float[np.ndarray, "joints 3"]
    bore_rotation: Float[np.ndarray, "joints 3 3"]
    bore_position: Float[np.ndarray, "joints 3"]
    rest: Float[np.ndarray, " rfes"]
    scale: float


class Placed(NamedTuple):
    """The mechanism at given joint angles: rotation (L, 3, 3) and origin (L, 3) of the links; of all joints the
    joint frame G on the parent (J, 3, 3), without the joint's angle, and its centre (J, 3); of the cut joints
    the frame on the child (C, 3, 3) and its centre (C, 3)."""

    rotation: Float[np.ndarray, "links 3 3"]
    origin: Float[np.ndarray, "links 3"]
    joint_rotation: Float[np.ndarray, "joints 3 3"]
    centre: Float[np.ndarray, "joints 3"]
    right_rotation: Float[np.ndarray, "cuts 3 3"]
    right_centre: Float[np.ndarray, "cuts 3"]


class Gaps(NamedTuple):
    """How far the loops are open: residual (5 C,), lengths over the longest link, as in `cut_joints`; alignment
    (C,): y_L . y_P; angle (C,) [rad] from L to P about the hinge."""

    residual: Float[np.ndarray, " constraints"]
    alignment: Float[np.ndarray, " cuts"]
    angle: Float[np.ndarray, " cuts"]


def geometry_of(model: Model) -> NominalGeometry:
    """The constants of a model, whose numbers must not be traced."""
    topology = model.topology
    middles = [rfe_fractions(n)[1][1:] for n in topology.elements]
    length = np.asarray(model.length)
    return NominalGeometry(
        topology=topology,
        seat_rotation=np.moveaxis(np.asarray(model.parent_rotation), 2, 0),
        seat_position=np.asarray(model.parent_position).T,
        bore_rotation=np.moveaxis(np.asarray(model.child_rotation), 2, 0),
        bore_position=np.asarray(model.child_position).T,
        rest=np.concatenate([x * part for x, part in zip(middles, length)]),
        scale=float(length.max()),
    )


def place(geometry: NominalGeometry, angles: Float[np.ndarray, " links"]) -> Placed:
    """Links and joints at the angles [rad] of the tree joints, links undeformed."""
    topology = geometry.topology
    n, joints = topology.n_links, len(topology.joints)
    rotation, origin = np.empty((n, 3, 3)), np.empty((n, 3))
    joint_rotation, centre = np.empty((joints, 3, 3)), np.empty((joints, 3))

    def frame(node: int) -> tuple[np.ndarray, np.ndarray]:
        if node == BASE:
            return np.eye(3), np.zeros(3)
        link = topology.link_of(node)
        x = geometry.rest[node - n] if node >= n else 0.0
        return rotation[link], origin[link] + rotation[link, :, 0] * x

    for j in range(joints):
        parent_rotation, parent_point = frame(topology.parents[j])
        joint_rotation[j] = parent_rotation @ geometry.seat_rotation[j]
        centre[j] = parent_point + parent_rotation @ geometry.seat_position[j]
        if j < n:
            hinge_rotation = joint_rotation[j] @ _rotation_y(angles[j])
            rotation[j] = hinge_rotation @ geometry.bore_rotation[j].T
            origin[j] = centre[j] - rotation[j] @ geometry.bore_position[j]
    right = [frame(node) for node in topology.children[n:]]
    bores = zip(right, geometry.bore_rotation[n:], geometry.bore_position[n:])
    right = [(node @ r, point + node @ p) for (node, point), r, p in bores]
    return Placed(
        rotation, origin, joint_rotation, centre,
        np.array([r for r, _ in right]).reshape(-1, 3, 3), np.array([p for _, p in right]).reshape(-1, 3),
    )  # fmt: skip


def _rotation_y(angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])


def gaps(geometry: NominalGeometry, placed: Placed) -> Gaps:
    """The five equations of every cut joint (`cut_joints`, theory (5.1))."""
    n = geometry.topology.n_links
    left, right = placed.joint_rotation[n:], placed.right_rotation
    y = left[:, :, 1]
    apart = (placed.right_centre - placed.centre[n:]) / geometry.scale
    bend = np.einsum("ci,cij->cj", y, right[:, :, ::2])
    x = np.einsum("cij,ci->cj", left, right[:, :, 0])
    return Gaps(
        residual=np.concatenate([apart, bend], axis=1).reshape(-1),
        alignment=np.sum(y * right[:, :, 1], axis=1),
        angle=np.arctan2(-x[:, 2], x[:, 0]),
    )


def closure_rows(
    geometry: NominalGeometry, placed: Placed
) -> tuple[Float[np.ndarray, "cuts 5 6"], Float[np.ndarray, "cuts 5 6"]]:
    """Derivatives of the cut joints' residuals by the twists of L and of P."""
    n = geometry.topology.n_links
    y = placed.joint_rotation[n:, :, 1]
    ends = np.swapaxes(placed.right_rotation[:, :, ::2], 1, 2)
    couples = np.cross(ends, y[:, None])

    def rows(centre: np.ndarray) -> np.ndarray:
        of_centre = np.concatenate([-cross_matrix(centre), np.broadcast_to(np.eye(3), (len(y), 3, 3))], axis=2)
        of_axes = np.concatenate([couples, np.zeros_like(couples)], axis=2)
        return np.concatenate([of_centre / geometry.scale, of_axes], axis=1)

    return -rows(placed.centre[n:]), rows(placed.right_centre)


def cross_matrix(vectors: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3 3"]:
    """Matrices of the vector products v x of vectors v."""
    x, y, z = np.moveaxis(vectors, -1, 0)
    zero = np.zeros_like(x)
    rows = [np.stack(row, -1) for row in ((zero, -z, y), (z, zero, -x), (-y, x, zero))]
    return np.stack(rows, -2)


def closure_jacobian(geometry: NominalGeometry, placed: Placed) -> Float[np.ndarray, "constraints coordinates"]:
    """Jacobian of the residuals (5 C, L + 6 N), by the joint angles, then the free rfes' (x, y, z over the
    longest link, phi_x, phi_y, phi_z), rfe by rfe."""
    topology = geometry.topology
    n = topology.n_links
    left, right = closure_rows(geometry, placed)
    jacobian = np.zeros((topology.n_cuts, 5, n + 6 * topology.n_rfes))
    for cut, joint in enumerate(topology.cuts):
        ends = ((topology.parents[joint], left[cut]), (topology.children[joint], right[cut]))
        for node, rows in ends:
            while node != BASE:
                link = topology.link_of(node)
                if node >= n:
                    k = node - n
                    columns = slice(n + 6 * k, n + 6 * k + 6)
                    jacobian[cut, :, columns] += rows @ _elastic_twists(geometry, placed, link, k)
                y, centre = placed.joint_rotation[link, :, 1], placed.centre[link]
                axis = np.concatenate([y, np.cross(centre, y)])
                jacobian[cut, :, link] += rows @ axis
                node = topology.parents[link]
    return jacobian.reshape(5 * topology.n_cuts, n + 6 * topology.n_rfes)


def _elastic_twists(geometry: NominalGeometry, placed: Placed, link: int, rfe: int) -> np.ndarray:
    """Twists (6, 6) of unit rates of a free rfe's coordinates."""
    rotation = placed.rotation[link]
    point = placed.origin[link] + rotation[:, 0] * geometry.rest[rfe]
    twists = np.zeros((6, 6))
    twists[3:, :3] = rotation * geometry.scale
    twists[:3, 3:] = rotation
    twists[3:, 3:] = cross_matrix(point) @ rotation
    return twists
