"""The equations of motion as the paper writes them, dense: what the recursive formulation is tested against.

Place in the pipeline: an alternative to `dynamics`; same inputs, same results, slow.

Theory (3.2): A_jk = sum tr(dB/dq_j H dB/dq_k^T), h_j = sum tr(dB/dq_j H (d2B/dt2 at qdd = 0)^T) with
the transforms B(q) of all rfes differentiated automatically, and theory (3.3), (3.4) as one dense
augmented system.  Nothing of the recursion is used: transforms, constraints, theory (5.1), and the second
derivatives of both are formed independently, by 4 x 4 matrices and automatic differentiation.
"""

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.flatten_util import ravel_pytree
from jax.typing import ArrayLike
from jaxtyping import Float

from rfem_jax.description.basics.joint_kinds import JointKind
from rfem_jax.mechanics.algebra.vectors import Scalar, pseudo_inverse
from rfem_jax.mechanics.elements import elasticity
from rfem_jax.mechanics.forces.joint_forces import applied_forces, law_forces
from rfem_jax.mechanics.laws.frame_forces import START, NodeFrame, Pose
from rfem_jax.mechanics.laws.joint_springs import CompliantSpring
from rfem_jax.mechanics.model.inputs import DriveInput, Stabilisation
from rfem_jax.mechanics.model.model import Coordinates, State
from rfem_jax.mechanics.model.topology import BASE, Topology, rfe_fractions
from rfem_jax.mechanics.model.with_errors import ModelWithErrors

NOT_MOVED: Any = np.eye(4)  # the transform of the base
OPEN = 1e-7  # of singular values: of combinations of closure equations that say nothing


def _transform(rotation: ArrayLike, position: ArrayLike) -> Array:
    top = jnp.concatenate([rotation, jnp.reshape(position, (3, 1))], axis=1)
    return jnp.concatenate([top, np.array([[0.0, 0.0, 0.0, 1.0]])])


def _rotation_about(axis: int, angle: Array) -> Array:
    """Rotation about a coordinate axis."""
    along, turning = np.zeros((3, 3)), np.zeros((3, 3))
    i, j = (axis + 1) % 3, (axis + 2) % 3
    along[axis, axis], turning[j, i], turning[i, j] = 1.0, 1.0, -1.0
    return jnp.cos(angle) * (np.eye(3) - along) + jnp.sin(angle) * turning + along


def _changed(topology: Topology, position: Coordinates, change: Coordinates) -> Coordinates:
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
        position = _changed(topology, position, change)
    seat = [_transform(actual.seat_rotation[:, :, j], actual.seat_position[:, j]) for j in range(len(topology.joints))]
    bore = [_transform(actual.bore_rotation[:, :, j], actual.bore_position[:, j]) for j in range(len(topology.joints))]
    frames: dict[int, Any] = {BASE: NOT_MOVED}
    for l, (a, b) in enumerate(topology.ranges):
        hinge = frames[topology.parents[l]] @ seat[l]
        at = topology.positions[l]
        for freedom, k in zip(topology.kind(l).freedoms[: topology.plain(l)], at):
            q = position.joints[k]
            along = _transform(np.eye(3), np.eye(3)[freedom.axis] * q)
            hinge = hinge @ (_transform(_rotation_about(freedom.axis, q), np.zeros(3)) if freedom.rotation else along)
        if topology.kind(l).ball:
            rotation = _turned(position.joints[at.stop - 4 : at.stop])
            if change is not None:
                stop = topology.coordinates[l].stop
                x, y, z = change.joints[stop - 3 : stop]
                skew = jnp.array([[0.0 * x, -z, y], [z, 0.0 * x, -x], [-y, x, 0.0 * x]])
                rotation = (jnp.eye(3) + skew + 0.5 * skew @ skew) @ rotation
            hinge = hinge @ _transform(rotation, np.zeros(3))
        frames[l] = hinge @ jnp.linalg.inv(bore[l])
        for k in range(a, b):
            x, y, z = _slender_place(actual, position, k) if l in topology.slender else position.elastic[:3, k]
            rotation = _rfe_rotation(topology, position.elastic[3:, k])
            rest = _along(actual.rest, k)
            relative = _transform(rotation, rest + jnp.stack([x, y, z]))
            frames[topology.n_links + k] = frames[l] @ relative
    return [frames[node] for node in range(topology.n_links + topology.n_rfes)]


def _rfe_rotation(topology: Topology, phi: Array) -> Array:
    """Rotation of an rfe in its link frame."""
    outer = _rotation_about(2, phi[2]) @ _rotation_about(1, phi[1])
    if topology.exact:
        outer = _rotation_about(1, phi[1]) @ _rotation_about(2, phi[2])
    return outer @ _rotation_about(0, phi[0])


def _slender_place(actual: ModelWithErrors, position: Coordinates, rfe: int) -> Array:
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


def constraints(
    actual: ModelWithErrors, position: Coordinates, scale: Scalar, change: Coordinates | None = None
) -> Float[Array, " constraints"]:
    """Theory (5.1), (5.14), (5.15) for all cut joints [m], and (16.7) for ideal couplings; `scale` [m] multiplies the
    equations of the axes and of coupled angles."""
    topology = actual.topology
    frames = transforms(actual, position, change)
    rows = [joint_rows(topology.kind(j), *joint_frames(actual, frames, j), scale) for j in topology.cuts]
    joints = position.joints if change is None else _changed(topology, position, change).joints
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
    seat = _transform(actual.seat_rotation[:, :, joint], actual.seat_position[:, joint])
    bore = _transform(actual.bore_rotation[:, :, joint], actual.bore_position[:, joint])
    return (NOT_MOVED if parent == BASE else frames[parent]) @ seat, frames[child] @ bore


def joint_rows(kind: JointKind, left: Float[Array, "4 4"], right: Float[Array, "4 4"], scale: Scalar) -> Array:
    """Closure equations [m] of one cut joint from the transforms of its frames."""
    relative = jnp.linalg.inv(left) @ right
    apart = right[:3, 3] - left[:3, 3] if kind.coincident else relative[jnp.array(kind.across, int), 3]
    return jnp.concatenate([apart, *(scale * relative[i, k][None] for i, k in kind.perpendicular)])


def exact_deflections(actual: ModelWithErrors, frames: Float[Array, "nodes 4 4"]) -> Float[Array, "6 rfes"]:
    """(du, theta) of geometrically exact sdes, from the transforms of all nodes to those of the two faces of
    every sde."""
    topology = actual.topology
    if topology.n_rfes == 0:
        return jnp.zeros((6, 0))
    left, right, left_face, right_face = [], [], [], []
    for l, (a, b) in enumerate(topology.ranges):
        for k in range(a, b):
            right.append(topology.n_links + k)
            right_face.append(_transform(jnp.eye(3), _along(actual.lever_right, k)))
            # The first sde joins the link frame, whose face is at the sde's place at rest.
            left.append(l if k == a else topology.n_links + k - 1)
            at_rest = _along(actual.rest, k) + _along(actual.lever_right, k)
            left_face.append(_transform(jnp.eye(3), at_rest if k == a else _along(actual.lever_left, k)))
    left = frames[jnp.array(left)] @ jnp.stack(left_face)
    right = frames[jnp.array(right)] @ jnp.stack(right_face)
    return jax.vmap(_deflection, out_axes=1)(left, right)


def _along(places: Array, k: int) -> Array:
    """Place k of several, of which the x, or all components, are known."""
    return places[:, k] if places.ndim == 2 else jnp.array([1.0, 0.0, 0.0]) * places[k]


def _work(actual: ModelWithErrors, strain: Array) -> Array:
    """Sum over the sdes of a strain times its stress."""
    if actual.topology.shaped:
        return jnp.einsum("ak,abk,bk->k", strain, actual.stiffness, strain)
    return actual.stiffness * strain**2


def _deflection(left: Array, right: Array) -> Array:
    """(du, theta) (6,) of two faces: the logarithm of the relative rotation, and the gap in the frame midway
    between them."""
    rotation = left[:3, :3].T @ right[:3, :3]
    skew = 0.5 * (rotation - rotation.T)
    sine_axis = jnp.stack([skew[2, 1], skew[0, 2], skew[1, 0]])
    square = sine_axis @ sine_axis
    none = square < 1e-30
    sine = jnp.sqrt(jnp.where(none, 1.0, square))
    angle = jnp.where(none, 1.0, jnp.arctan2(sine, 0.5 * (jnp.trace(rotation) - 1.0)))
    theta = sine_axis * jnp.where(none, 1.0, angle / sine)
    # Rodrigues' formula for minus half the angle.
    unit = skew / sine
    back = -jnp.sin(0.5 * angle) * unit + (1.0 - jnp.cos(0.5 * angle)) * unit @ unit
    gap = left[:3, :3].T @ (right[:3, 3] - left[:3, 3])
    return jnp.concatenate([gap + back @ gap, theta])


def _spring_forces(actual: ModelWithErrors, state: State, unravel: Callable[[Array], Coordinates]) -> Array:
    """Generalised forces of the springs and dampers of joints, flat, by the energy that they store and the power that
    they dissipate: so both are compared with the forces."""
    still = jnp.zeros_like(ravel_pytree(state.velocity)[0])
    springs = [] if actual.forces is None else [law for law in actual.forces.laws.values() if law.inside]

    def potential(q):
        joints = _changed(actual.topology, state.position, unravel(q)).joints
        return sum((law.energy(joints[law.place]) for law in springs), jnp.zeros(()))

    force = -jax.grad(potential)(still)
    for law in springs:
        rate = state.velocity.joints[law.coordinate]
        moves = rate != 0.0
        damping = law.dissipation(rate) / jnp.where(moves, rate, 1.0)
        force = force.at[law.coordinate].add(-jnp.where(moves, damping, 0.0))
    return force


def _coupling_forces(
    actual: ModelWithErrors, state: State, qd: Array, unravel: Callable[[Array], Coordinates]
) -> Array:
    """Generalised forces of couplings: the work of their loads along the coordinates' deflections."""
    assert actual.forces is not None, "couplings are among the forces"
    still, total = jnp.zeros_like(qd), jnp.zeros_like(qd)
    for coupling in (one for one in actual.forces.couplings.values() if one.stiffness is not None):

        def deflection(q, coupling=coupling):
            joints = _changed(actual.topology, state.position, unravel(q)).joints
            return coupling.deflection(joints[np.array(coupling.places)])

        gradient = jax.grad(deflection)(still)
        total = total + gradient * coupling.load(deflection(still), gradient @ qd)[0]
    return actual.forces.share * total


def _joint_transforms(actual: ModelWithErrors, position: Coordinates, change: Coordinates) -> dict[str, Array]:
    """Transforms from the frame on the parent to that on the child, by the names of joints."""
    frames, topology, by_joint = [*transforms(actual, position, change), jnp.eye(4)], actual.topology, {}
    for j, name in enumerate(topology.joints):
        left = _transform(actual.seat_rotation[:, :, j], actual.seat_position[:, j])
        right = _transform(actual.bore_rotation[:, :, j], actual.bore_position[:, j])
        left, right = frames[topology.parents[j]] @ left, frames[topology.children[j]] @ right
        by_joint[name] = jnp.linalg.inv(left) @ right
    return by_joint


def _displacement(relative: Array, motions: tuple[str, ...], axis: int | None, universal: bool) -> Array:
    """Displacement of a compliant joint's spring, from the transform over the joint: displacements along the parent's
    axes; the vector of the tilt between two axes, as long as its angle; or one angle."""
    if motions[0][0] == "T":
        return jnp.stack([relative["xyz".index(motion[-1]), 3] for motion in motions])
    rotation = relative[:3, :3]
    if universal:
        return jnp.arcsin(rotation[1, 2])[None]
    if len(motions) == 2 and axis is not None:
        first, second = ((axis + n) % 3 for n in (1, 2))
        vector = jnp.stack([-rotation[second, axis], rotation[first, axis]])
        square = vector @ vector
        none = square < 1e-20
        sine = jnp.sqrt(jnp.where(none, 1.0, square))
        return vector * jnp.where(none, 1.0 + square / 6.0, jnp.arctan2(sine, rotation[axis, axis]) / sine)
    # One rotation: the angle of the next but one axis, or of the successive ones about x, y, z.
    about = "xyz".index(motions[0][-1])
    b, c = (about + 1) % 3, (about + 2) % 3
    if about == 0:
        return jnp.arctan2(-rotation[b, c], rotation[c, c])[None]
    sine, cosine = (rotation[0, 2], rotation[0, 0]) if about == 1 else (-rotation[0, 1], rotation[0, 0])
    return jnp.arcsin(sine)[None] if about == 1 else jnp.arctan2(sine, cosine)[None]


def _spring_force(actual: ModelWithErrors, state: State, qd: Array, unravel: Callable[[Array], Coordinates]) -> Array:
    """Generalised forces of the springs of compliant joints: what they are stretched by, and its rate, give the work
    that their forces do."""
    still, topology = jnp.zeros_like(qd), actual.topology
    springs = [(*name.split("."), spring) for name, spring in (actual.springs or {}).items()]
    kinds = {joint: topology.kind(topology.joints.index(joint)).nominal for joint, *_ in springs}

    def over(q):
        return _joint_transforms(actual, state.position, unravel(q))

    def stretches(q):
        found = over(q)
        return [
            _displacement(found[joint], kinds[joint].directions[name], kinds[joint].axis, kinds[joint].angles == 2)
            for joint, name, _ in springs
        ]

    def rates(qd):
        now, change = jax.jvp(over, (still,), (qd,))
        plain = jax.jvp(stretches, (still,), (qd,))[1]
        for n, (joint, name, _) in enumerate(springs):
            if name == "tilt" and kinds[joint].angles < 2:
                # The angular velocity across the parent's axis.
                spin = change[joint][:3, :3] @ now[joint][:3, :3].T
                vector = jnp.stack([spin[2, 1], spin[0, 2], spin[1, 0]])
                plain[n] = jnp.where(np.arange(3) == kinds[joint].axis, 0.0, vector)
        return plain

    pulls = [_pull(spring, at) for (*_, spring), at in zip(springs, stretches(still))]
    drags = [spring.damping * rate for (*_, spring), rate in zip(springs, rates(qd))]
    force = jnp.zeros_like(qd)
    for exerted, jacobian in zip((pulls, drags), (jax.jacfwd(stretches)(still), jax.jacfwd(rates)(qd))):
        force = force - sum(rows.T @ one for rows, one in zip(jacobian, exerted))
    return force


def _pull(spring: CompliantSpring, stretch: Array) -> Array:
    """Force that displaces a spring by a vector, or in one direction by a number of either sign."""
    size = stretch[0] if stretch.size == 1 else jnp.linalg.norm(stretch)
    x, f = spring.positions, spring.forces
    if x is None or f is None:
        return spring.stiffness * stretch
    row = jnp.clip(jnp.sum(x <= size) - 1, 0, x.size - 2)
    exerted = f[row] + (f[row + 1] - f[row]) / (x[row + 1] - x[row]) * (size - x[row])
    return exerted / size * stretch


def _joint_coordinate_forces(
    actual: ModelWithErrors, state: State, drive: DriveInput, unravel: Callable[[Array], Coordinates]
) -> Array:
    """Generalised forces of drives, springs, dampers and laws of joints, flat."""
    qd, _ = ravel_pytree(state.velocity)
    force = _spring_forces(actual, state, unravel)
    bare = eqx.tree_at(lambda a: a.springs, actual, None, is_leaf=lambda x: x is None)
    if actual.forces is not None and actual.forces.couplings:
        bare = eqx.tree_at(lambda a: a.forces.couplings, bare, {})
        force = force + _coupling_forces(actual, state, qd, unravel)
    laws = law_forces(bare, state)
    # Springs and dampers have been counted by their energy and their dissipation.
    outside = None if laws is None else laws._replace(inside={})
    for k, applied in applied_forces(actual.topology, state.position, drive, outside).items():
        force = force.at[k].add(applied)
    if actual.springs is not None:
        force = force + _spring_force(actual, state, qd, unravel)
    return force


def _element_forces(
    actual: ModelWithErrors, drive: DriveInput, frames: Array, derivatives: Array, rates: Array
) -> Array:
    """Generalised forces of force elements, flat, by the principle of virtual work: the relative transform of their two
    frames and its derivatives by the coordinates, from those (nodes, 4, 4, n) of the transforms of all nodes."""
    total, forces = jnp.zeros_like(rates), actual.frame_forces
    if forces is None:
        return total
    for element in forces.elements.values():

        def relative(frames, element=element):
            frames = jnp.concatenate([frames, jnp.eye(4)[None]])
            parent, child = (_framed(frames, end) for end in (element.parent, element.child))
            return jnp.linalg.inv(parent) @ child

        now, along = jax.linearize(relative, frames)
        by_coordinates = jax.vmap(along, in_axes=3, out_axes=2)(derivatives)
        turns = _axial(jnp.einsum("abi,cb->aci", by_coordinates[:3, :3], now[:3, :3]))
        shifts = by_coordinates[:3, 3]
        pose = Pose(now[:3, 3], now[:3, :3], shifts @ rates, turns @ rates)
        wrench = element.wrench(pose, START if drive.time is None else drive.time)
        force, moment = (forces.share * part for part in wrench)
        total = total + force @ shifts + moment @ turns
    for node, place, force in _line_forces(actual, drive, frames):
        total = total + force @ (derivatives[node, :3, :3].transpose(2, 0, 1) @ place + derivatives[node, :3, 3].T).T
    return total


def _line_forces(actual: ModelWithErrors, drive: DriveInput, frames: Array) -> list[tuple[int, Array, Array]]:
    """Loads along links as forces at points: node, place in its frame [m], force [N] in global axes; at the two points
    of Gauss of each loaded piece of an rfe, which integrate the work of linear loads exactly."""
    topology, forces, found = actual.topology, actual.frame_forces, []
    if forces is None:
        return found
    for line in (forces.lines or {}).values():
        first, last = (forces.share * line.at(START if drive.time is None else drive.time)).T
        first_rfe = topology.n_links + topology.ranges[line.link][0]
        # Ends of the rfes: the start, the spring-damping elements, the end.
        shares, middles = rfe_fractions(topology.elements[line.link])
        length = actual.beam_middle[line.link] / middles[0]
        edge = jnp.zeros(())
        for i, share in enumerate(shares):
            node = line.link if i == 0 else first_rfe + i - 1
            low, high = (jnp.clip(x, line.begin, line.end) for x in (edge, edge + share * length))
            edge = edge + share * length
            for at, weight in _line_points(actual):
                x = low + at * (high - low)
                along = (x - line.begin) / (line.end - line.begin)
                force = weight * (high - low) * ((1.0 - along) * first + along * last)
                place = jnp.stack([x - (0.0 if i == 0 else middles[i] * length), *jnp.zeros(2)])
                if actual.form is not None:
                    rest = jnp.zeros(3) if i == 0 else actual.rest[:, topology.ranges[line.link][0] + i - 1]
                    place = actual.form.at(line.link, x[None]).position[:, 0] - rest
                found.append((node, place, frames[node, :3, :3] @ force if line.turning else force))
    return found


def _line_points(actual: ModelWithErrors) -> list[tuple[float, float]]:
    """Gauss's points and weights of a piece from 0 to 1: two, or of links with forms, whose lever arms are no
    polynomials, many."""
    nodes, weights = np.polynomial.legendre.leggauss(2 if actual.form is None else 12)
    return list(zip(0.5 + 0.5 * nodes, 0.5 * weights))


def element_wrenches(
    actual: ModelWithErrors, drive: DriveInput, frames: Float[Array, "nodes 4 4"], rates: Float[Array, "nodes 4 4"]
) -> list[tuple[int, Float[Array, "6"]]]:
    """Nodes, and the wrenches at the global origin that force elements exert on them, from the transforms of all nodes
    and their rates."""
    wrenches, forces = [], actual.frame_forces
    if forces is None:
        return wrenches
    for element in forces.elements.values():

        def placed(frames, element=element):
            frames = jnp.concatenate([frames, jnp.eye(4)[None]])
            parent, child = (_framed(frames, end) for end in (element.parent, element.child))
            return jnp.linalg.inv(parent) @ child, parent, child

        (now, parent, child), (change, *_) = jax.jvp(placed, (frames,), (rates,))
        pose = Pose(now[:3, 3], now[:3, :3], change[:3, 3], _axial(change[:3, :3] @ now[:3, :3].T))
        wrench = element.wrench(pose, START if drive.time is None else drive.time)
        force, moment = (forces.share * parent[:3, :3] @ part for part in wrench)
        at_origin = jnp.concatenate([moment + jnp.cross(child[:3, 3], force), force])
        wrenches += [(element.child.node, at_origin), (element.parent.node, -at_origin)]
    for node, place, force in _line_forces(actual, drive, frames):
        point = frames[node, :3, :3] @ place + frames[node, :3, 3]
        wrenches.append((node, jnp.concatenate([jnp.cross(point, force), force])))
    return wrenches


def _framed(frames: Array, end: NodeFrame) -> Array:
    """Transform of a frame on a node, of which the last of `frames` is the base."""
    return frames[end.node] @ _transform(end.rotation, end.position)


def _axial(skew: Array) -> Array:
    """Vector of a skew-symmetric matrix (3, 3, ...)."""
    return jnp.stack([skew[2, 1], skew[0, 2], skew[1, 0]])


def reference_accelerations(
    actual: ModelWithErrors,
    state: State,
    drive: DriveInput,
    stabilisation: Stabilisation,
    applied: Float[Array, " coordinates"] | None = None,
) -> tuple[Coordinates, Float[Array, " constraints"]]:
    """Second derivatives of the coordinates, and multipliers [N] without those of springs, from the dense system;
    `applied`: more forces, flat."""
    topology = actual.topology
    qd, unravel = ravel_pytree(state.velocity)
    # Changes from the present position are coordinates of which there are as many as rates.
    q = jnp.zeros_like(qd)
    pseudo_inertia = pseudo_inertias(actual)

    # Jitted: traced once for all derivatives.
    @jax.jit
    def matrices(q):
        return jnp.stack(transforms(actual, state.position, unravel(q)))

    def rate(q):
        return jax.jvp(matrices, (q,), (qd,))[1]

    derivatives = jax.jacfwd(matrices)(q)
    bias = jax.jvp(rate, (q,), (qd,))[1]
    mass = jnp.einsum("nabi,nbc,nacj->ij", derivatives, pseudo_inertia, derivatives) + _without_effect(topology)
    inertial = jnp.einsum("nabi,nbc,nac->i", derivatives, pseudo_inertia, bias)

    def potential(frames, q):
        weights = jnp.einsum("nabc,nc->nab", frames[:, :3, None, :], pseudo_inertia[:, :, 3])
        of_gravity = -jnp.sum(weights[:, :, 0] @ actual.gravity)
        if topology.exact:
            stretch = exact_deflections(actual, frames)
            return of_gravity + 0.5 * jnp.sum(_work(actual, stretch))
        return of_gravity + elasticity.elastic_energy(actual, _changed(topology, state.position, unravel(q)))

    def rayleigh(qd):
        """Rayleigh's dissipation function: half the power that the dampers dissipate."""
        if topology.exact:
            frame_rates = jnp.einsum("nabi,i->nab", derivatives, qd)
            faces = partial(exact_deflections, actual)
            rate = jax.jvp(faces, (matrices(q),), (frame_rates,))[1]
            return 0.5 * jnp.sum(_work(actual, jnp.sqrt(actual.damping)[None] * rate))
        return 0.5 * elasticity.dissipated_power(actual, State(state.position, unravel(qd)))

    by_frames, directly = jax.grad(potential, (0, 1))(matrices(q), q)
    force = -inertial - jnp.einsum("nab,nabi->i", by_frames, derivatives) - directly - jax.grad(rayleigh)(qd)
    force = force + _joint_coordinate_forces(actual, state, drive, unravel) + (0.0 if applied is None else applied)
    force = force + _element_forces(actual, drive, matrices(q), derivatives, qd)

    phi = jax.jit(lambda q: constraints(actual, state.position, stabilisation.scale, unravel(q)))

    def phi_rate(q):
        return jax.jvp(phi, (q,), (qd,))[1]

    jacobian = jax.jacfwd(phi)(q)
    gamma = -jax.jvp(phi_rate, (q,), (qd,))[1]
    gamma = gamma - stabilisation.velocity_gain * phi_rate(q) - stabilisation.position_gain * phi(q)
    found, multipliers = _solve_augmented(mass, jacobian, force, gamma, drive, topology.minimum_norm)
    return _displaced(actual, state, unravel(found)), multipliers[: topology.n_constraints - sum(topology.sprung_rows)]


def _solve_augmented(
    mass: Array, jacobian: Array, force: Array, gamma: Array, drive: DriveInput, least: bool
) -> tuple[Array, Array]:
    """Accelerations and multipliers [N], those of prescribed motions last; `least`: where these are not unique, of
    least norm."""
    for k, (_, _, acceleration) in drive.motions.items():
        jacobian = jnp.concatenate([jacobian, jnp.eye(force.size)[k : k + 1]])
        gamma = jnp.concatenate([gamma, jnp.reshape(acceleration, (1,))])
    n, c = force.size, gamma.size
    corner = jnp.zeros((c, c))
    if least:
        corner = _open_rows(jacobian)
        gamma = gamma - corner @ gamma
    system = jnp.block([[mass, -jacobian.T], [jacobian, corner]])
    solution = jnp.linalg.solve(system, jnp.concatenate([force, gamma]))
    return solution[:n], solution[n:]


def _displaced(actual: ModelWithErrors, state: State, accelerations: Coordinates) -> Coordinates:
    """Second derivatives of the coordinates with those of displacements in slender links."""
    if not actual.topology.slender:
        return accelerations

    def place(values: Array) -> Array:
        at = Coordinates(state.position.joints, values)
        slender = np.flatnonzero(actual.topology.slender_rfes)
        return values.at[:3, slender].set(jnp.stack([_slender_place(actual, at, k) for k in slender.tolist()], axis=1))

    values, rates = state.position.elastic, state.velocity.elastic
    bias = jax.jvp(lambda values: jax.jvp(place, (values,), (rates,))[1], (values,), (rates,))[1]
    return Coordinates(accelerations.joints, jax.jvp(place, (values,), (accelerations.elastic,))[1] + bias)


def _without_effect(topology: Topology) -> Float[Array, "n n"]:
    """Unit masses of displacements in slender links, which are no coordinates and stay without forces."""
    displacements = np.concatenate([np.tile(topology.slender_rfes, (3, 1)), np.zeros((3, topology.n_rfes))])
    return jnp.diag(ravel_pytree(Coordinates(jnp.zeros(topology.n_freedoms), jnp.asarray(displacements)))[0])


def open_multipliers(actual: ModelWithErrors, state: State, scale: Scalar) -> Float[Array, "constraints constraints"]:
    """Projector onto the multipliers that do no work on any motion of the tree."""
    still, unravel = ravel_pytree(jax.tree.map(jnp.zeros_like, state.velocity))
    return _open_rows(jax.jacfwd(lambda q: constraints(actual, state.position, scale, unravel(q)))(still))


def _open_rows(jacobian: Array) -> Array:
    """Projector onto combinations of rows that vanish."""
    return jnp.eye(jacobian.shape[0]) - jacobian @ pseudo_inverse(jacobian, OPEN)


def pseudo_inertias(actual: ModelWithErrors) -> Array:
    """H (nodes, 4, 4) of theory (3.1) about every node's reference point."""
    identity = jnp.eye(3)
    blocks = []
    for node in range(actual.mass.size):
        m, c = actual.mass[node], actual.centre[:, node]
        central = actual.inertia[:, :, node]
        second = 0.5 * jnp.trace(central) * identity - central + m * jnp.outer(c, c)
        top = jnp.concatenate([second, (m * c)[:, None]], axis=1)
        bottom = jnp.concatenate([m * c, m[None]])[None]
        blocks.append(jnp.concatenate([top, bottom]))
    return jnp.stack(blocks)
