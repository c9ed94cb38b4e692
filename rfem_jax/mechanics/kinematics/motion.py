"""Positions and velocities of all bodies at one instant.

Place in the pipeline: model with errors + state -> **kinematics** -> elasticity, cut_joints, dynamics, loads.

The relative motion of the free rfes (theory (2.7) to (2.10)) is taken for all of them at once in
their link frames; then the links are placed one after another from the base (theory (2.6) with both
errors, (2.14) to (2.16)).  Frames: link frame {p,0} = H (F_c E_c)^-1 with the hinge frame H = F E X_J(q), where X_J
is the product of the motions of the joint's kind.  The axes of H at a compliant joint are those before its tilts
(theory (13.1)).

Symbols: R rotation, w angular velocity; spatial velocities (6,) at the global origin.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from rfem_jax.mechanics.algebra import vectors
from rfem_jax.mechanics.algebra.reordering import repeat, sum_groups
from rfem_jax.mechanics.algebra.vectors import apply, columns, cross, product, scaled
from rfem_jax.mechanics.kinematics.ideal_couplings import CouplingRows, coupling_rows
from rfem_jax.mechanics.kinematics.slender_links import completed_state
from rfem_jax.mechanics.model.model import Coordinates, State
from rfem_jax.mechanics.model.orientations import rotation_of
from rfem_jax.mechanics.model.topology import BASE, Topology
from rfem_jax.mechanics.model.with_errors import ModelWithErrors

LINEAR_LIMIT = np.radians(60.0)
EXACT_LIMIT = np.radians(80.0)


class RelativeMotion(NamedTuple):
    """Motion of the free rfes relative to their link frames, in link axes.

    rotation (3, 3, N), position (3, N) of the segment's middle, rate_matrix (3, 3, N) with
    w = rate_matrix phi_dot, and at the given rates: angular and linear velocity (3, N) and rate_bias (3, N)
    = (d rate_matrix / dt) phi_dot; coordinates: (6, N) and their rates, of mechanisms with superelements.
    """

    rotation: Float[Array, "3 3 rfes"]
    position: Float[Array, "3 rfes"]
    rate_matrix: Float[Array, "3 3 rfes"]
    angular: Float[Array, "3 rfes"]
    linear: Float[Array, "3 rfes"]
    rate_bias: Float[Array, "3 rfes"]
    coordinates: tuple[Float[Array, "6 rfes"], Float[Array, "6 rfes"]] | None = None


class Frames(NamedTuple):
    """Rotation (3, 3, n), reference point (3, n) and spatial velocity (6, n) of n bodies in global axes; of
    one body without the last axis."""

    rotation: Float[Array, " 3 3 *n"]
    point: Float[Array, " 3 *n"]
    velocity: Float[Array, " 6 *n"]


class HingeFrames(NamedTuple):
    """Rotation (3, 3, n) and centre (3, n) of the frames H of n joints in global axes; of one joint without the
    last axis."""

    rotation: Float[Array, " 3 3 *n"]
    point: Float[Array, " 3 *n"]


class Motion(NamedTuple):
    """Positions and velocities of all bodies at one instant.

    relative: of the free rfes in their link frames; links: frames of the L links (rfes 0); interfaces: of the
    free rfes that carry a joint; hinges: frames H of the tree joints, where the child is; axis (6, F): spatial
    axes of the joint coordinates; axis_velocity (6, F): of the frames that these axes are fixed in; couplings: the
    equations of ideal couplings, None without any.
    """

    relative: RelativeMotion
    links: Frames
    interfaces: Frames
    hinges: HingeFrames
    axis: Float[Array, "6 freedoms"]
    axis_velocity: Float[Array, "6 freedoms"]
    couplings: CouplingRows | None = None


@jax.jit  # traced once for all its places
def motion_of(actual: ModelWithErrors, state: State) -> Motion:
    """Positions and velocities of all links and rfes at one instant."""
    topology = actual.topology
    with jax.named_scope("kinematics"):
        relative = relative_motion(actual, state.position, state.velocity)
        links: list[Frames] = []
        joints: list[_PlacedJoint] = []
        for index, node in enumerate(topology.parents[: topology.n_links]):
            parent = _parent_frame(topology, relative, links, node)
            link, joint = _place_link(actual, state, index, parent)
            links.append(link)
            joints.append(joint)
        stacked = _stack(links)
        return Motion(
            relative=relative,
            links=stacked,
            interfaces=_interface_frames(topology, relative, stacked),
            hinges=HingeFrames(*(jnp.stack(part, axis=-1) for part in zip(*(joint.hinge for joint in joints)))),
            axis=_spatial_columns([axis for joint in joints for axis in joint.axes]),
            axis_velocity=_spatial_columns([velocity for joint in joints for velocity in joint.velocities]),
            couplings=coupling_rows(actual, state),
        )


def relative_motion(actual: ModelWithErrors, position: Coordinates, velocity: Coordinates) -> RelativeMotion:
    """Motion of the free rfes in their link frames (theory (2.7), (2.8), (2.10)): R = R_z R_y R_x for
    linear elements, R_y R_z R_x for exact ones, so that in-plane bending has no limit."""
    if actual.topology.slender:
        completed = completed_state(actual, State(position, velocity))
        position, velocity = completed.position, completed.velocity
    u, phi = position.elastic[:3], position.elastic[3:]
    u_dot, rate = velocity.elastic[:3], velocity.elastic[3:]
    (cx, cy, cz), (sx, sy, sz) = jnp.cos(phi), jnp.sin(phi)
    zero = jnp.zeros_like(cx)
    # Columns a, b, c of the two outer rotations, written out: products of matrices make a whole step a third slower.
    if actual.topology.exact:
        last, middle = 1, 2
        a = jnp.stack([cy * cz, sz, -sy * cz])
        b = jnp.stack([-cy * sz, cz, sy * sz])
        c = jnp.stack([sy, zero, cy])
    else:
        last, middle = 2, 1
        a = jnp.stack([cz * cy, sz * cy, -sy])
        b = jnp.stack([-sz, cz, zero])
        c = jnp.stack([cz * sy, sz * sy, cy])
    # Axes about which the rfe is turned: the last one stays, it turns that of the middle, and both turn that of x.
    axes = {0: a, middle: (a, b, c)[middle], last: jnp.broadcast_to(vectors.IDENTITY[last][:, None], phi.shape)}
    about_last, about_middle, about_x = (scaled(rate[axis], axes[axis]) for axis in (last, middle, 0))
    about_both = about_last + about_middle
    rest = actual.rest if actual.topology.shaped else scaled(actual.rest, vectors.IDENTITY[0][:, None])
    return RelativeMotion(
        rotation=jnp.stack([a, scaled(sx, c) + scaled(cx, b), scaled(cx, c) - scaled(sx, b)], axis=1),
        position=rest + u,
        rate_matrix=jnp.stack([axes[axis] for axis in range(3)], axis=1),
        angular=about_both + about_x,
        linear=u_dot,
        rate_bias=cross(about_last, about_middle) + cross(about_both, about_x),
        coordinates=(position.elastic, velocity.elastic) if actual.topology.reduced else None,
    )


def range_used(topology: Topology, position: Coordinates) -> Float[Array, ""]:
    """Largest angle of the free rfes relative to their link frames over its limit: for linear
    elements phi_y and phi_z (inaccurate long before), for exact ones phi_z (singular at 90 deg)."""
    turned = position.elastic[3:]
    if topology.reduced:
        turned = jnp.where(topology.carriers[None], 0.0, turned)
    if topology.exact:
        return jnp.max(jnp.abs(turned[2]), initial=0.0) / EXACT_LIMIT
    return jnp.max(jnp.abs(turned[1:]), initial=0.0) / LINEAR_LIMIT


def _parent_frame(topology: Topology, relative: RelativeMotion, links: list[Frames], node: int) -> Frames:
    """Frame of the node that a link is joined to."""
    if node == BASE:
        return Frames(jnp.asarray(vectors.IDENTITY), jnp.zeros(3), jnp.zeros(6))
    if node < topology.n_links:
        return links[node]
    k = node - topology.n_links
    rfe = jax.tree.map(lambda x: x[..., k], _link_frame_motion(relative))
    return _rfe_frames(links[topology.link_of(node)], rfe)


def _link_frame_motion(relative: RelativeMotion) -> tuple[Array, Array, Array, Array]:
    """Rotation, position, angular and linear velocity."""
    return relative.rotation, relative.position, relative.angular, relative.linear


def _rfe_frames(link: Frames, in_link_frame: tuple[Array, Array, Array, Array]) -> Frames:
    """Frames of rfes from those of their links and their motion relative to these."""
    rotation, position, angular, linear = in_link_frame
    point = link.point + apply(link.rotation, position)
    velocity = link.velocity + vectors.motion_at_origin(
        apply(link.rotation, angular), apply(link.rotation, linear), point
    )
    return Frames(product(link.rotation, rotation), point, velocity)


def _interface_frames(topology: Topology, relative: RelativeMotion, links: Frames) -> Frames:
    owners = [topology.link_of(topology.n_links + k) for k in topology.interfaces]
    return _rfe_frames(
        jax.tree.map(lambda x: columns(x, owners), links),
        jax.tree.map(lambda x: columns(x, topology.interfaces), _link_frame_motion(relative)),
    )


class _PlacedJoint(NamedTuple):
    """Frame H of a tree joint; spatial axes of its coordinates, and velocities of the frames they are fixed in."""

    hinge: HingeFrames
    axes: list[Float[Array, "6"]]
    velocities: list[Float[Array, "6"]]


def _place_link(actual: ModelWithErrors, state: State, index: int, parent: Frames) -> tuple[Frames, _PlacedJoint]:
    """Link frame and joint of a link, from the frame of its parent's node."""
    topology = actual.topology
    turned = product(parent.rotation, actual.seat_rotation[:, :, index])
    centre = parent.point + apply(parent.rotation, actual.seat_position[:, index])
    velocity, axes, velocities = parent.velocity, [], []
    before, basis = velocity, turned
    at, kind = topology.positions[index], topology.kind(index)
    hinge = turned
    for n, (k, freedom) in enumerate(zip(topology.coordinates[index], kind.freedoms)):
        rate = state.velocity.joints[k]
        if freedom.first:
            before, basis = velocity, turned
        direction = basis[:, freedom.axis]
        if not freedom.rotation:
            axis = vectors.spatial(jnp.zeros_like(direction), direction)
            centre = centre + scaled(state.position.joints[at[n]], direction)
        else:
            axis = vectors.spatial(direction, cross(centre, direction))
            if freedom.any_axis and freedom.first:
                turned = product(turned, rotation_of(state.position.joints[at[n] : at[n] + 4]))
            elif not freedom.any_axis:
                turned = product(turned, vectors.rotation_about(freedom.axis, state.position.joints[at[n]]))
        axes.append(axis)
        velocities.append(before)
        velocity = velocity + scaled(rate, axis)
        if n < kind.to_hinge_frame:
            hinge = turned
    rotation = vectors.product_transposed(turned, actual.bore_rotation[:, :, index])
    origin = centre - apply(rotation, actual.bore_position[:, index])
    return Frames(rotation, origin, velocity), _PlacedJoint(HingeFrames(hinge, centre), axes, velocities)


def _spatial_columns(vectors: list[Float[Array, "6"]]) -> Float[Array, "6 n"]:
    return jnp.stack(vectors, axis=1) if vectors else jnp.zeros((6, 0))


def _stack(frames: list[Frames]) -> Frames:
    return Frames(*(jnp.stack(part, axis=at) for part, at in zip(zip(*frames), (2, 1, 1))))


def node_frames(topology: Topology, motion: Motion, nodes: Sequence[int]) -> Frames:
    """Frames of links, interfaces or the base (static node numbers), one column each."""
    n = topology.n_links
    place = {k: i for i, k in enumerate(topology.interfaces)}
    if all(BASE != node < n for node in nodes):
        return Frames(*(columns(part, nodes) for part in motion.links))
    if all(node >= n for node in nodes):
        return Frames(*(columns(part, [place[node - n] for node in nodes]) for part in motion.interfaces))

    def column(part: str, node: int) -> Array:
        if node == BASE:
            base = {"rotation": vectors.IDENTITY, "point": np.zeros(3), "velocity": np.zeros(6)}
            return jnp.asarray(base[part])
        if node < n:
            return getattr(motion.links, part)[..., node]
        return getattr(motion.interfaces, part)[..., place[node - n]]

    return Frames(*(jnp.stack([column(part, node) for node in nodes], axis=-1) for part in Frames._fields))


def spread(topology: Topology, values: Float[Array, "*k links"]) -> Float[Array, "*k rfes"]:
    """Values by link repeated for every free rfe of the link."""
    return repeat(values, [n - 1 for n in topology.elements])


def by_freedom(topology: Topology, values: Float[Array, "*k links"]) -> Float[Array, "*k freedoms"]:
    """Values by link repeated for every coordinate of the link's joint."""
    owners = topology.link_of_freedom
    return values if owners == tuple(range(topology.n_links)) else columns(values, owners)


def total(topology: Topology, values: Float[Array, "*k rfes"]) -> Float[Array, "*k links"]:
    """Sums over the free rfes of every link."""
    return sum_groups(values, [n - 1 for n in topology.elements])


def all_frames(topology: Topology, motion: Motion) -> tuple[Float[Array, "3 3 nodes"], Float[Array, "3 nodes"]]:
    """Rotations and reference points of all nodes in global axes."""
    rotation = spread(topology, motion.links.rotation)
    points = spread(topology, motion.links.point) + apply(rotation, motion.relative.position)
    return (
        jnp.concatenate([motion.links.rotation, product(rotation, motion.relative.rotation)], axis=-1),
        jnp.concatenate([motion.links.point, points], axis=-1),
    )
