"""The perfect, undeformed mechanism in NumPy: where its bodies are, how far its loops are open.

Place in the pipeline: model -> **nominal_geometry** -> discretisation, the check of the step.

The questions before a simulation (does it close, what is its rank, which step is stable) concern rigid
geometry and a few numbers, so they are answered on the host, and nothing of it is traced or compiled.

Symbols: twists (angular, linear) at the global origin, in global axes; n_links L, nodes n, cut joints C.  Where shapes
have "*t", many positions are placed at once.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from rfem_jax.description.basics.joint_kinds import JointKind
from rfem_jax.mechanics.laws.couplings import CouplingLaw
from rfem_jax.mechanics.model.model import Model
from rfem_jax.mechanics.model.topology import BASE, Topology

SMALLEST_SINGULAR_VALUE = 1e-6  # of rows with lengths over the longest link: what is below says nothing


class NominalGeometry(NamedTuple):
    """Constants of the perfect mechanism: frames of all joints (J, 3, 3), (J, 3) in the nodes of their parents
    and children; rest [m]: x (N,) of the free rfes' middles in their links, of links with forms places (N, 3); scale
    [m]: the longest link; couplings: the ideal ones, in the order of their equations."""

    topology: Topology
    seat_rotation: Float[np.ndarray, "joints 3 3"]
    seat_position: Float[np.ndarray, "joints 3"]
    bore_rotation: Float[np.ndarray, "joints 3 3"]
    bore_position: Float[np.ndarray, "joints 3"]
    rest: Float[np.ndarray, " rfes *axes"]
    scale: float
    couplings: tuple[CouplingLaw, ...] = ()


class Placed(NamedTuple):
    """The mechanism at given joint coordinates: rotation (L, 3, 3) and origin (L, 3) of the links; of all joints the
    joint frame G on the parent (J, 3, 3), without the joint's motion, and its centre (J, 3), and the frame on the
    child and its centre, likewise; twists (F, 6) of unit rates of the tree joints' coordinates; joints: these."""

    rotation: Float[np.ndarray, "*t links 3 3"]
    origin: Float[np.ndarray, "*t links 3"]
    joint_rotation: Float[np.ndarray, "*t joints 3 3"]
    centre: Float[np.ndarray, "*t joints 3"]
    child_rotation: Float[np.ndarray, "*t joints 3 3"]
    child_centre: Float[np.ndarray, "*t joints 3"]
    twists: Float[np.ndarray, "*t freedoms 6"]
    joints: Float[np.ndarray, "*t numbers"]


class Gaps(NamedTuple):
    """Openings of the loops: residual, lengths over the longest link; alignment (C,) and angle (C,) [rad] as in
    `cut_joints.Closure`."""

    residual: Float[np.ndarray, "*t constraints"]
    alignment: Float[np.ndarray, "*t cuts"]
    angle: Float[np.ndarray, "*t cuts"]


def geometry_of(model: Model) -> NominalGeometry:
    """The constants of a model, whose numbers must not be traced."""
    topology = model.topology
    middles = [topology.fractions(l)[1][1:] for l in range(topology.n_links)]
    length = np.asarray(model.length)
    return NominalGeometry(
        topology=topology,
        seat_rotation=np.moveaxis(np.asarray(model.parent_rotation), 2, 0),
        seat_position=np.asarray(model.parent_position).T,
        bore_rotation=np.moveaxis(np.asarray(model.child_rotation), 2, 0),
        bore_position=np.asarray(model.child_position).T,
        rest=_rest(model, middles, length),
        scale=float(length.max()),
        couplings=_ideal_couplings(model),
    )


def _rest(
    model: Model, middles: Sequence[np.ndarray], length: Float[np.ndarray, " links"]
) -> Float[np.ndarray, " rfes *axes"]:
    if model.form is not None:
        return np.asarray(model.form.middles.position)[:, model.topology.n_links :].T
    return np.concatenate([x * part for x, part in zip(middles, length)])


def offset(
    geometry: NominalGeometry, rotation: Float[np.ndarray, "*t 3 3"], node: int
) -> Float[np.ndarray, "*t 3"] | float:
    """From the origin of a link with this rotation to the reference point of one of its nodes, in global axes."""
    n = geometry.topology.n_links
    if node < n:
        return 0.0
    rest = geometry.rest[node - n]
    return rotation[..., 0] * rest if rest.ndim == 0 else rotation @ rest


def axis_places(model: Model, link: int, shares: Float[np.ndarray, " points"]) -> Float[np.ndarray, "points 3"]:
    """Places [m] of a model, whose numbers must not be traced, at shares of a link's length, in its frame."""
    if model.form is None or link not in model.topology.curved:
        return float(model.length[link]) * shares[:, None] * np.eye(3)[:1]
    curve = jax.tree.map(np.asarray, model.form.curves[link])
    return np.asarray(curve.at(shares * curve.length).position).T


def _ideal_couplings(model: Model) -> tuple[CouplingLaw, ...]:
    """The laws of the ideal couplings, with their offsets at the start."""
    with jax.ensure_compile_time_eval():
        return tuple((model.couplings or {})[name].starting_at(model.start_joints) for name in model.topology.ideal)


def place(geometry: NominalGeometry, coordinates: Float[np.ndarray, "*t numbers"]) -> Placed:
    """Links and joints at the position of the tree joints (as `Coordinates.joints`), links undeformed."""
    topology, batch = geometry.topology, coordinates.shape[:-1]
    n, joints = topology.n_links, len(topology.joints)
    rotation, origin = np.empty((*batch, n, 3, 3)), np.empty((*batch, n, 3))
    joint_rotation, centre = np.empty((*batch, joints, 3, 3)), np.empty((*batch, joints, 3))
    child_rotation, child_centre = np.empty((*batch, joints, 3, 3)), np.empty((*batch, joints, 3))
    twists = np.zeros((*batch, topology.n_freedoms, 6))

    def frame(node: int) -> tuple[np.ndarray, np.ndarray]:
        if node == BASE:
            return np.eye(3), np.zeros(3)
        link = topology.link_of(node)
        return rotation[..., link, :, :], origin[..., link, :] + offset(geometry, rotation[..., link, :, :], node)

    for j in range(joints):
        parent_rotation, parent_point = frame(topology.parents[j])
        joint_rotation[..., j, :, :] = parent_rotation @ geometry.seat_rotation[j]
        centre[..., j, :] = parent_point + parent_rotation @ geometry.seat_position[j]
        if j >= n:
            continue
        turned, point = joint_rotation[..., j, :, :].copy(), centre[..., j, :].copy()
        at, basis = topology.positions[j], turned
        for m, (k, freedom) in enumerate(zip(topology.coordinates[j], topology.kind(j).freedoms)):
            if freedom.first:
                basis = turned
            direction = basis[..., freedom.axis]
            if not freedom.rotation:
                twists[..., k, 3:] = direction
                point = point + coordinates[..., at[m], None] * direction
                continue
            twists[..., k, :] = np.concatenate([direction, vector_product(point, direction)], axis=-1)
            if freedom.any_axis and freedom.first:
                turned = basis @ _rotation_of(coordinates[..., at[m] : at[m] + 4])
            elif not freedom.any_axis:
                turned = turned @ _rotation_about(freedom.axis, coordinates[..., at[m]])
        child_rotation[..., j, :, :], child_centre[..., j, :] = turned, point
        rotation[..., j, :, :] = turned @ geometry.bore_rotation[j].T
        origin[..., j, :] = point - rotation[..., j, :, :] @ geometry.bore_position[j]
    for j in topology.cuts:
        node_rotation, point = frame(topology.children[j])
        child_rotation[..., j, :, :] = node_rotation @ geometry.bore_rotation[j]
        child_centre[..., j, :] = point + node_rotation @ geometry.bore_position[j]
    return Placed(rotation, origin, joint_rotation, centre, child_rotation, child_centre, twists, coordinates)


def _rotation_about(axis: int, angle: Float[np.ndarray, "*t"]) -> Float[np.ndarray, "*t 3 3"]:
    c, s = np.cos(angle), np.sin(angle)
    i, j = (axis + 1) % 3, (axis + 2) % 3
    matrix = np.zeros((*np.shape(angle), 3, 3))
    matrix[..., axis, axis] = 1.0
    matrix[..., i, i] = matrix[..., j, j] = c
    matrix[..., i, j], matrix[..., j, i] = -s, s
    return matrix


def _rotation_of(q: Float[np.ndarray, "*t 4"]) -> Float[np.ndarray, "*t 3 3"]:
    """Rotation of a quaternion."""
    skew = cross_matrix(q[..., 1:])
    size = np.sum(q * q, axis=-1)[..., None, None]
    return np.eye(3) + 2.0 / size * (q[..., :1, None] * skew + skew @ skew)


def moved(
    topology: Topology, position: Float[np.ndarray, "... numbers"], change: Float[np.ndarray, "... freedoms"]
) -> Float[np.ndarray, "... numbers"]:
    """`orientations.moved` of the joints; a change may have fewer axes in front than the position."""
    found = np.array(position, dtype=float)
    for l, (at, rates) in enumerate(zip(topology.positions, topology.coordinates, strict=True)):
        n = topology.plain(l)
        found[..., at.start : at.start + n] += change[..., rates.start : rates.start + n]
        if topology.kind(l).ball:
            theta, q = change[..., rates.start + n : rates.stop], found[..., at.start + n : at.stop]
            half = 0.5 * np.linalg.norm(theta, axis=-1, keepdims=True)
            w, v = np.cos(half), 0.5 * np.sinc(half / np.pi) * theta
            scalar, vector = q[..., :1], q[..., 1:]
            first = w * scalar - np.sum(v * vector, axis=-1, keepdims=True)
            turned = np.concatenate([first, w * vector + scalar * v + vector_product(v, vector)], axis=-1)
            found[..., at.start + n : at.stop] = turned / np.linalg.norm(turned, axis=-1, keepdims=True)
    return found


def gaps(geometry: NominalGeometry, placed: Placed) -> Gaps:
    """The equations of all cut joints (`cut_joints`, theory (5.1), (5.14), (5.15)), of the kinds without springs, and
    those of ideal couplings."""
    topology, n = geometry.topology, geometry.topology.n_links
    batch = placed.centre.shape[:-2]
    residual, alignment = [np.zeros((*batch, 0))], np.zeros((*batch, topology.n_cuts))
    for i, joint in enumerate(topology.cuts):
        kind = topology.kind(joint).nominal
        left, right = placed.joint_rotation[..., joint, :, :], placed.child_rotation[..., joint, :, :]
        apart = (placed.child_centre[..., joint, :] - placed.centre[..., joint, :]) / geometry.scale
        products = np.einsum("...ki,...kj->...ij", left, right)
        residual.append(apart if kind.coincident else np.einsum("...ki,...k->...i", left[..., kind.across], apart))
        residual += [products[..., i, j, None] for i, j in kind.perpendicular]
        alignment[..., i] = _alignment(kind, products)
    x = np.einsum("...cij,...ci->...cj", placed.joint_rotation[..., n:, :, :], placed.child_rotation[..., n:, :, 0])
    residual += [_coupling_gap(geometry, law, placed.joints)[0][..., None] for law in geometry.couplings]
    return Gaps(np.concatenate(residual, axis=-1), alignment, np.arctan2(-x[..., 2], x[..., 0]))


def _coupling_gap(
    geometry: NominalGeometry, law: CouplingLaw, joints: Float[np.ndarray, "*t numbers"]
) -> tuple[Float[np.ndarray, "*t"], Float[np.ndarray, "*t"]]:
    """g of an ideal coupling, a length over the longest link, and its derivative by its first coordinate."""
    assert law.offset is not None, "couplings of a geometry have one"
    first, second = (joints[..., k] for k in law.places)
    with jax.ensure_compile_time_eval():
        value, slope = jax.vmap(law.transmitted)(jnp.asarray(first.reshape(-1)))
    unit = geometry.scale if geometry.topology.slides[law.coordinates[1]] else 1.0
    value, slope = (np.asarray(one).reshape(first.shape) for one in (value, slope))
    return np.asarray((second - value - float(law.offset)) / unit), np.asarray(-slope / unit)


def _alignment(kind: JointKind, products: Float[np.ndarray, "*t 3 3"]) -> Float[np.ndarray, "*t"]:
    """`cut_joints.Closure.alignment` from the products of the axes of L and P."""
    if kind.angles == 0:
        return np.asarray(0.5 * (np.trace(products, axis1=-2, axis2=-1) - 1.0))
    axis = next(freedom.axis for freedom in kind.freedoms if freedom.rotation)
    return np.ones(products.shape[:-2]) if kind.angles == 3 else products[..., axis, axis]


def closure_rows(geometry: NominalGeometry, placed: Placed, rigid: bool = True) -> list[tuple[np.ndarray, np.ndarray]]:
    """Derivatives (k, 6) of the k residuals of every cut joint by the twists of L and of P; `rigid`: of the kinds
    without springs, else without the sprung directions of compliant joints."""
    topology, pairs = geometry.topology, []
    for joint in topology.cuts:
        kind = topology.kind(joint).nominal if rigid else topology.kind(joint)
        left, right = placed.joint_rotation[joint], placed.child_rotation[joint]
        forces = np.eye(3) if kind.coincident else left[:, kind.across].T
        couples = np.array([vector_product(right[:, j], left[:, i]) for i, j in kind.perpendicular]).reshape(-1, 3)
        centre = placed.child_centre[joint]

        def rows(point, forces=forces, couples=couples):
            of_centre = np.concatenate([vector_product(point, forces), forces], axis=1)
            of_axes = np.concatenate([couples, np.zeros_like(couples)], axis=1)
            return np.concatenate([of_centre / geometry.scale, of_axes])

        pairs.append((-rows(placed.centre[joint] if kind.coincident else centre), rows(centre)))
    return pairs


def node_place(geometry: NominalGeometry, placed: Placed, node: int) -> tuple[np.ndarray, np.ndarray]:
    """Rotation (3, 3) and point (3,) of a node in global axes, links undeformed."""
    if node == BASE:
        return np.eye(3), np.zeros(3)
    owner = geometry.topology.link_of(node)
    rotation = placed.rotation[owner]
    return rotation, placed.origin[owner] + offset(geometry, rotation, node)


def vector_product(a: Float[np.ndarray, "... 3"], b: Float[np.ndarray, "... 3"]) -> Float[np.ndarray, "... 3"]:
    """a x b of vectors in the last axis, without what NumPy's own does for other axes: single ones are many here."""
    x, y, z = a[..., 0], a[..., 1], a[..., 2]
    u, v, w = b[..., 0], b[..., 1], b[..., 2]
    return np.stack([y * w - z * v, z * u - x * w, x * v - y * u], axis=-1)


def cross_matrix(vectors: Float[np.ndarray, "*n 3"]) -> Float[np.ndarray, "*n 3 3"]:
    """Matrices of the vector products v x of vectors v."""
    x, y, z = np.moveaxis(vectors, -1, 0)
    zero = np.zeros_like(x)
    rows = [np.stack(row, -1) for row in ((zero, -z, y), (z, zero, -x), (-y, x, zero))]
    return np.stack(rows, -2)


def closure_jacobian(
    geometry: NominalGeometry, placed: Placed, rigid: bool = True
) -> Float[np.ndarray, "constraints coordinates"]:
    """Jacobian of the residuals (constraints, F + 6 N), by the joint coordinates (displacements over the longest
    link), then the free rfes' (x, y, z over the longest link, phi_x, phi_y, phi_z), rfe by rfe; `rigid` as in
    `closure_rows`."""
    topology = geometry.topology
    n, freedoms = topology.n_links, topology.n_freedoms
    sides = closure_rows(geometry, placed, rigid)
    rows = sum(len(left) for left, _ in sides) + len(geometry.couplings)
    jacobian = np.zeros((rows, freedoms + 6 * topology.n_rfes))
    units = joint_units(geometry)
    stop = 0
    for joint, (left, right) in zip(topology.cuts, sides, strict=True):
        start, stop = stop, stop + len(left)
        block = jacobian[start:stop]
        for node, rows in ((topology.parents[joint], left), (topology.children[joint], right)):
            for one, link in topology.to_base(node):
                if one >= n:
                    k = freedoms + 6 * (one - n)
                    block[:, k : k + 6] += rows @ _elastic_twists(geometry, placed, link, one - n)
                for k in topology.coordinates[link]:
                    block[:, k] += units[k] * (rows @ placed.twists[k])
    if topology.slender:
        jacobian = jacobian @ _coordinate_rates(geometry)
    for row, law in zip(jacobian[stop:], geometry.couplings, strict=True):
        (first, second), of_second = law.coordinates, geometry.topology.slides[law.coordinates[1]]
        row[first] += units[first] * float(_coupling_gap(geometry, law, placed.joints)[1])
        row[second] += units[second] / (geometry.scale if of_second else 1.0)
    return jacobian


def _coordinate_rates(geometry: NominalGeometry) -> Float[np.ndarray, "motions coordinates"]:
    """Rates of all coordinates by those of the coordinates: displacements in slender links, over the longest link,
    follow from angles (theory (1.28))."""
    topology, freedoms = geometry.topology, geometry.topology.n_freedoms
    rates = np.eye(freedoms + 6 * topology.n_rfes)
    for l in topology.slender:
        a, b = topology.ranges[l]
        apart = geometry.rest[b - 1] / (b - a - 0.25)  # of the sdes, of which the first stands at half of it
        for k in range(a, b):
            u = freedoms + 6 * k + np.arange(3)
            rates[u, u] = 0.0
            for j in range(a, k + 1):
                arm = apart if j < k else geometry.rest[k] - (k - a + 0.5) * apart
                angles = freedoms + 6 * j + 3 + np.arange(3)
                rates[np.ix_(u, angles)] = -cross_matrix(np.array([arm / geometry.scale, 0.0, 0.0]))
    return rates


def rank(matrix: Float[np.ndarray, "m n"]) -> int:
    """Rank of a matrix whose entries that say something are of size one: what rounding leaves of a matrix that says
    nothing, as of a door on two hinges in line, is not compared with itself."""
    return int(np.sum(_singular_values(matrix) > SMALLEST_SINGULAR_VALUE * largest_singular_value(matrix)))


def null_space(matrix: Float[np.ndarray, "m n"]) -> Float[np.ndarray, "n k"]:
    """Orthonormal columns that such a matrix takes to zero."""
    if 0 in matrix.shape:
        return np.eye(matrix.shape[1])
    rows = np.linalg.svd(matrix, full_matrices=matrix.shape[0] < matrix.shape[1])[2]
    return rows[rank(matrix) :].T


def largest_singular_value(matrices: Float[np.ndarray, "*t m n"]) -> Float[np.ndarray, "*t"]:
    """The largest singular value of such matrices, at least one."""
    return np.asarray(np.max(_singular_values(matrices), axis=-1, initial=1.0))


def _singular_values(matrices: np.ndarray) -> np.ndarray:
    return np.linalg.svd(matrices, compute_uv=False) if 0 not in matrices.shape else np.zeros((*matrices.shape[:-2], 0))


def shortest(
    matrices: Float[np.ndarray, "*t m n"], values: Float[np.ndarray, "*t m"], smallest: float
) -> Float[np.ndarray, "*t n"]:
    """The shortest least-squares solutions of such equations, singular values below a share of the largest left out."""
    left, singular, right = np.linalg.svd(matrices, full_matrices=False)
    there = singular > smallest * largest_singular_value(matrices)[..., None]
    along = np.einsum("...mk,...m->...k", left, values)
    return np.einsum("...kn,...k->...n", right, np.where(there, along / np.where(there, singular, 1.0), 0.0))


def joint_units(geometry: NominalGeometry) -> Float[np.ndarray, " freedoms"]:
    """1 rad, or the longest link [m], of every joint coordinate."""
    return np.where(np.array(geometry.topology.slides, dtype=bool), geometry.scale, 1.0)


def _elastic_twists(geometry: NominalGeometry, placed: Placed, link: int, rfe: int) -> np.ndarray:
    """Twists (6, 6) of unit rates of a free rfe's coordinates."""
    rotation = placed.rotation[link]
    point = placed.origin[link] + offset(geometry, rotation, geometry.topology.n_links + rfe)
    twists = np.zeros((6, 6))
    twists[3:, :3] = rotation * geometry.scale
    twists[:3, 3:] = rotation
    twists[3:, 3:] = cross_matrix(point) @ rotation
    return twists
