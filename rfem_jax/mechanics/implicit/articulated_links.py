"""Articulated-body algorithm over links of which each is condensed to its frame and interfaces.

Place in the pipeline: condensation, kinematics -> **articulated_links** -> newton.

The tree of links is eliminated from the tips to the base with the inertias that the condensed links show at their
frames (Featherstone 2008, ch. 7; theory (7.11)); columns of loads are then solved for at once.

Rotations are not linearised about the undeformed shape: the rates of an interface's angles act about its
present axes.  Springs are so stiff over a long step that an error of a hundredth of a radian there would cost
Newton's method most of its rate of convergence.

Wrenches and accelerations are spatial vectors in global axes: of a link at the point of its island (see
`dynamics`), of an interface at its own point.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from rfem_jax.mechanics.algebra import vectors
from rfem_jax.mechanics.algebra.block_tridiagonal import Factored
from rfem_jax.mechanics.algebra.constrained_chain import ConstrainedChain, positive_inverse, solve
from rfem_jax.mechanics.algebra.vectors import (
    apply,
    apply_transposed,
    by_component,
    constant_product,
    cross,
    dot,
    outer,
    product,
    product_transposed,
    transpose,
    transposed_product,
)
from rfem_jax.mechanics.implicit.condensation import LinkOperator, root_inertia
from rfem_jax.mechanics.kinematics.motion import Motion
from rfem_jax.mechanics.model.topology import BASE, Topology
from rfem_jax.mechanics.model.with_errors import ModelWithErrors


class Outboard(NamedTuple):
    """The links outboard of a link's c interfaces: their articulated inertias (6 c, 6 c), and transmissibility
    (6 c, 6 c) = (stiffness + inertia)^-1 stiffness, or (1 + compliance inertia)^-1, by which these reduce the
    interfaces' accelerations."""

    inertia: Float[Array, "interfaces interfaces"]
    transmissibility: Float[Array, "interfaces interfaces"]


class InterfaceOperator(NamedTuple):
    """The c interfaces of a flexible link, in global axes at their own points.

    transfer (6, 6 c): wrench on the link frame per unit wrench on the interfaces; compliance (6 c, 6 c):
    accelerations per unit wrench; outboard: None where no links are.
    """

    transfer: Float[Array, "6 interfaces"]
    compliance: Float[Array, "interfaces interfaces"]
    outboard: Outboard | None


class Hinge(NamedTuple):
    """A joint coordinate that is not held: scaled (6,) = inertia . axis / pivot, pivot = axis . inertia . axis, plus
    the tangent of forces along it (theory (7.21))."""

    scaled: Float[Array, "6"]
    pivot: Float[Array, ""]


class ArticulatedLink(NamedTuple):
    """One link after the elimination of its subtree, at one position.

    point (3,): of its spatial vectors; inertia (6, 6): articulated, before its joint is eliminated; frame
    (6, 6): from wrenches in link axes at the link's origin to global ones at `point`; rotations: 2 c of (3, 3),
    from the second derivatives of an interface's angles and displacements to its accelerations; axes (6,): of
    its joint's coordinates; hinges: these, None for one that is held; interfaces: None where there are none.
    """

    point: Float[Array, "3"]
    inertia: Float[Array, "6 6"]
    frame: Float[Array, "6 6"]
    rotations: tuple[Float[Array, "3 3"], ...]
    axes: tuple[Float[Array, "6"], ...]
    hinges: tuple[Hinge | None, ...]
    interfaces: InterfaceOperator | None


class Response(NamedTuple):
    """Accelerations under K columns of loads, K last (or without this axis for one).

    loads (6, K) by link: of its subtree, condensed to it; joints (F, K); links (6, K) by link; interfaces
    (6 c, K) of the links that have any, and interface_wrenches (6 c, K): wrenches that the joints exert on
    them.
    """

    loads: tuple[Float[Array, " 6 *k"], ...]
    joints: Float[Array, " freedoms *k"]
    links: tuple[Float[Array, " 6 *k"], ...]
    interfaces: dict[int, Float[Array, " interfaces *k"]]
    interface_wrenches: dict[int, Float[Array, " interfaces *k"]]


def tree_wrenches(links: tuple[ArticulatedLink, ...], response: Response) -> list[Array]:
    """Wrenches (6,) at the global origin in the tree joints: articulated inertia times acceleration minus load."""
    wrenches = []
    for link, load, acceleration in zip(links, response.loads, response.links):
        wrench = apply(link.inertia, acceleration) - load
        wrenches.append(vectors.wrench_at_origin(wrench[:3], wrench[3:], link.point))
    return wrenches


def node_points(topology: Topology, motion: Motion) -> dict[int, Array]:
    """Point at which each node's spatial vectors are taken."""
    n = topology.n_links
    points = {n + k: motion.interfaces.point[:, i] for i, k in enumerate(topology.interfaces)}
    for l in range(n):
        root = topology.island_of(l)
        points[l] = points[root] if root >= n else motion.hinges.point[:, root]
    return points


def _wrench_transform(rotation: Array | np.ndarray, arm: Array) -> Float[Array, "6 6"]:
    """From wrenches in rotated axes at a point to wrenches at another, from which `arm` reaches to the first."""
    zeros = jnp.zeros_like(rotation)
    top = jnp.concatenate([rotation, product(vectors.cross_matrix(arm), rotation)], axis=1)
    return jnp.concatenate([top, jnp.concatenate([zeros, rotation], axis=1)])


def _rotated(rotations: Sequence[Array], columns: Array) -> Array:
    """Rows (3 k, n) of k vectors, each by its rotation."""
    return jnp.concatenate([product(r, columns[3 * i : 3 * i + 3]) for i, r in enumerate(rotations)])


def _rotated_back(rotations: Sequence[Array], wrench: Array) -> Array:
    """A flat vector (3 k,) of k vectors, each by the transpose of its rotation."""
    return jnp.concatenate([apply_transposed(r, wrench[3 * i : 3 * i + 3]) for i, r in enumerate(rotations)])


def _congruent(rotations: Sequence[Array], matrix: Array) -> Array:
    """A symmetric matrix (6 c, 6 c) with rows and columns rotated."""
    once = _rotated(rotations, matrix)
    both = [product_transposed(r, once[:, 3 * i : 3 * i + 3]) for i, r in enumerate(rotations)]
    return jnp.concatenate(both)


def _inverse_transposed(rotations: Sequence[Array]) -> tuple[Array, ...]:
    """The matrices that transform a stiffness where `rotations` transform the compliance; those of angles' rates
    are not orthogonal."""
    return tuple(transpose(vectors.invert_block(r)) for r in rotations)


def _interface_rotations(topology: Topology, motion: Motion, link: int) -> tuple[Array, ...]:
    rotation, rate_matrix = motion.links.rotation[:, :, link], motion.relative.rate_matrix
    pairs = [
        (product(rotation, rate_matrix[:, :, node - topology.n_links]), rotation)
        for node in _interfaces_of(topology, link)
    ]
    return tuple(rotation for pair in pairs for rotation in pair)


def _interfaces_of(topology: Topology, link: int) -> tuple[int, ...]:
    """Nodes of a link's interfaces."""
    first, last = topology.ranges[link]
    return tuple(topology.n_links + k for k in topology.interfaces if first <= k < last)


def eliminate(
    actual: ModelWithErrors,
    operators: tuple[LinkOperator | None, ...],
    motion: Motion,
    held: tuple[int, ...],
    joint_tangent: dict[int, Array],
) -> tuple[ArticulatedLink, ...]:
    """Articulated inertias, from the tips to the base."""
    topology = actual.topology
    n = topology.n_links
    points = node_points(topology, motion)
    outboard: dict[int, Array] = {}
    links: dict[int, ArticulatedLink] = {}
    for l in reversed(range(n)):
        rotation, operator = motion.links.rotation[:, :, l], operators[l]
        frame = _wrench_transform(rotation, motion.links.point[:, l] - points[l])
        in_link = root_inertia(actual, l) if operator is None else operator.inertia
        inertia = product_transposed(product(frame, in_link), frame)
        inertia = inertia + outboard.get(l, 0.0)
        interfaces, rotations = None, _interface_rotations(topology, motion, l)
        if operator is not None and rotations:
            interfaces = _interface_operator(topology, l, operator, frame, rotations, points, outboard)
            if interfaces.outboard is not None:
                transfer, reduced = interfaces.transfer, product(*interfaces.outboard)
                inertia = inertia + product_transposed(product(transfer, reduced), transfer)
        before, axes, hinges = inertia, [], []
        for k in reversed(topology.coordinates[l]):
            axis = vectors.spatial(motion.axis[:3, k], motion.axis[3:, k] + cross(motion.axis[:3, k], points[l]))
            hinge = None
            if k not in held:
                force_rows = apply(inertia, axis)
                pivot = dot(axis, force_rows)
                if k in joint_tangent:
                    pivot = pivot + joint_tangent[k]
                hinge = Hinge(force_rows / pivot[None], pivot)
                inertia = inertia - outer(force_rows, hinge.scaled)
            axes.append(axis)
            hinges.append(hinge)
        node = topology.parents[l]
        if node != BASE:
            outboard[node] = outboard.get(node, 0.0) + inertia
        axes, hinges = tuple(reversed(axes)), tuple(reversed(hinges))
        links[l] = ArticulatedLink(points[l], before, frame, rotations, axes, hinges, interfaces)
    return tuple(links[l] for l in range(n))


def _interface_operator(
    topology: Topology,
    link: int,
    operator: LinkOperator,
    frame: Array,
    rotations: tuple[Array, ...],
    points: dict[int, Array],
    outboard: dict[int, Array],
) -> InterfaceOperator:
    """Rows and columns of a link's interfaces in global axes at their own points; `outboard`: articulated
    inertias by node."""
    nodes, identity = _interfaces_of(topology, link), np.eye(3)
    shift = jnp.concatenate([_wrench_transform(identity, points[k] - points[link]) for k in nodes], axis=1)
    frame_to_interface = _rotated(rotations, operator.frame_to_interface)
    transfer = shift - product_transposed(frame, frame_to_interface)
    compliance = _congruent(rotations, operator.compliance)
    if not any(node in outboard for node in nodes):
        return InterfaceOperator(transfer, compliance, None)
    inertia = _block_diagonal([outboard.get(node) for node in nodes])
    if operator.stiffness is None:
        assert operator.interface_motions is not None, "slender links have them"
        motions = _rotated(rotations, operator.interface_motions)
        return InterfaceOperator(transfer, compliance, _of_slender(operator.factored, motions, inertia))
    stiffness = _congruent(_inverse_transposed(rotations), operator.stiffness)
    transmissibility = product(vectors.invert_positive(stiffness + inertia), stiffness)
    return InterfaceOperator(transfer, compliance, Outboard(inertia, transmissibility))


def _of_slender(factored: Factored | ConstrainedChain, motions: Array, inertia: Array) -> Outboard:
    """The links outboard of a slender link, whose interfaces move by `motions` alone (theory (7.24))."""
    assert isinstance(factored, ConstrainedChain)
    loaded = product(inertia, motions)
    gain = positive_inverse(factored.matrix + transposed_product(motions, loaded))
    reduced = product_transposed(product(motions, gain), loaded)
    return Outboard(inertia, jnp.eye(len(reduced)) - reduced)


def _block_diagonal(blocks: Sequence[Array | None]) -> Array:
    zeros = jnp.zeros((6, 6))
    filled = [zeros if block is None else block for block in blocks]
    rows = [
        jnp.concatenate([block if i == j else zeros for j in range(len(filled))], axis=1)
        for i, block in enumerate(filled)
    ]
    return jnp.concatenate(rows)


def respond(
    topology: Topology,
    links: tuple[ArticulatedLink, ...],
    joint_loads: Array,
    on_links: dict[int, Array],
    of_interfaces: dict[int, Array],
    units: dict[int, Array],
    columns: int,
) -> Response:
    """Response to K columns of loads: generalised forces (F, K) of the joint coordinates; by link wrenches (6,) on
    the links in their axes, and second derivatives (6 c,) of the interfaces' coordinates due to the residual; and by
    node wrenches `units` (6, K)."""
    n = topology.n_links
    zeros = jnp.zeros((6, columns))
    loads: dict[int, Array] = dict(units)
    subtree_loads: dict[int, Array] = {}
    joint_torques: dict[int, Array] = {}
    interface_wrenches: dict[int, Array] = {}
    free_accelerations: dict[int, Array] = {}
    for l in reversed(range(n)):
        link, interfaces = links[l], links[l].interfaces
        load = loads.get(l, zeros)
        if l in on_links:
            load = load + apply(link.frame, on_links[l])[:, None]
        if interfaces is not None:
            wrench = jnp.concatenate([loads.get(node, zeros) for node in _interfaces_of(topology, l)])
            free = product(interfaces.compliance, wrench)
            if l in of_interfaces:
                free = free + _rotated(link.rotations, of_interfaces[l][:, None])
            if interfaces.outboard is not None:
                # Accelerations with the links outboard, whose inertia loads the interfaces; link frame at rest.
                free = product(interfaces.outboard.transmissibility, free)
                wrench = wrench - product(interfaces.outboard.inertia, free)
            free_accelerations[l] = free
            load = load + product(interfaces.transfer, wrench)
            interface_wrenches[l] = wrench
        subtree_loads[l] = load
        for k, axis, hinge in zip(reversed(topology.coordinates[l]), reversed(link.axes), reversed(link.hinges)):
            torque = joint_loads[k] + apply_transposed(load, axis)
            joint_torques[k] = torque
            if hinge is not None:
                load = load - outer(hinge.scaled, torque)
        node = topology.parents[l]
        if node != BASE:
            loads[node] = loads.get(node, 0.0) + load
    return _accelerate(topology, links, subtree_loads, joint_torques, free_accelerations, interface_wrenches, zeros)


def _accelerate(
    topology: Topology,
    links: tuple[ArticulatedLink, ...],
    subtree_loads: dict[int, Array],
    joint_torques: dict[int, Array],
    free_accelerations: dict[int, Array],
    wrenches: dict[int, Array],
    zeros: Array,
) -> Response:
    """Accelerations, from the base to the tips."""
    n = topology.n_links
    rates, of_links = [], []
    of_interfaces: dict[int, Array] = {}
    interface_wrenches: dict[int, Array] = {}
    at: dict[int, Array] = {}
    for l in range(n):
        link, interfaces, node = links[l], links[l].interfaces, topology.parents[l]
        acceleration = zeros if node == BASE else at[node]
        for k, axis, hinge in zip(topology.coordinates[l], link.axes, link.hinges):
            rate = jnp.zeros_like(zeros[0])
            if hinge is not None:
                rate = joint_torques[k] / hinge.pivot[None] - apply_transposed(acceleration, hinge.scaled)
                acceleration = acceleration + outer(axis, rate)
            rates.append(rate)
        of_links.append(acceleration)
        at[l] = acceleration
        if interfaces is None:
            continue
        with_frame = transposed_product(interfaces.transfer, acceleration)
        wrench = wrenches[l]
        if interfaces.outboard is not None:
            with_frame = product(interfaces.outboard.transmissibility, with_frame)
            wrench = wrench - product(interfaces.outboard.inertia, with_frame)
        of_interfaces[l] = free_accelerations[l] + with_frame
        interface_wrenches[l] = wrench
        for i, interface in enumerate(_interfaces_of(topology, l)):
            at[interface] = of_interfaces[l][6 * i : 6 * i + 6]
    loads = tuple(subtree_loads[l] for l in range(n))
    joints = jnp.stack(rates) if rates else zeros[:0]
    return Response(loads, joints, tuple(of_links), of_interfaces, interface_wrenches)


def of_node(topology: Topology, response: Response, node: int) -> Array:
    """Acceleration (6, ...) of a link or an interface."""
    if node < topology.n_links:
        return response.links[node]
    l = topology.link_of(node)
    i = _interfaces_of(topology, l).index(node)
    return response.interfaces[l][6 * i : 6 * i + 6]


def elastic_accelerations(
    topology: Topology,
    operators: tuple[LinkOperator | None, ...],
    links: tuple[ArticulatedLink, ...],
    loads: Array,
    response: Response,
) -> Array:
    """Second derivatives (6, N) of the elastic coordinates under loads (6, N)."""
    parts = [jnp.zeros((6, 0))]
    for l, (operator, (a, b)) in enumerate(zip(operators, topology.ranges)):
        if operator is None:
            continue
        link = links[l]
        acceleration = apply_transposed(link.frame, response.links[l])
        free = by_component(solve(operator.factored, loads[:, a:b]))
        y = free - constant_product(operator.rigid_response, acceleration)
        if l in response.interface_wrenches:
            wrench = _rotated_back(link.rotations, response.interface_wrenches[l])
            y = y + constant_product(operator.interface_rows.T, wrench)
        parts.append(y.reshape((6, b - a)))
    y = jnp.concatenate(parts, axis=1)
    return jnp.concatenate([y[3:], y[:3]])
