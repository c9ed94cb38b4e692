"""Newton increments for implicit steps: the linearised equations of motion, solved by recursion over the links.

Place in the pipeline: residual, condensation -> **newton** -> statics, implicit integration.

The iteration matrix approximates the tangent: links have the inertia of their undeformed shape, and the
stiffness of springs and dampers but not that of gyroscopic and joint loads.  Every flexible link is then
condensed to its frame and interfaces (`condensation`), and the tree of links is solved by the
articulated-body algorithm (Featherstone 2008, ch. 7) with these inertias, for the residual and for unit
multipliers of the cut joints at once; the multipliers follow from the closure (theory (7.11) to (7.13)).
One matrix serves all iterations of a step.

Rotations are not linearised about the undeformed shape: the rates of an interface's angles act about its
present axes.  Springs are so stiff over a long step that an error of a hundredth of a radian there would cost
Newton's method most of its rate of convergence.

Wrenches and accelerations are spatial vectors in global axes: of a link at the point of its island (see
`dynamics`), of an interface at its own point.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float

from rfem_jax.mechanics import algebra
from rfem_jax.mechanics.algebra import (
    apply,
    apply_transposed,
    by_component,
    constant_product,
    cross,
    dot,
    product,
    transpose,
)
from rfem_jax.mechanics.cut_joints import Closure, invert_closure, unit_columns
from rfem_jax.mechanics.element_loads import ElementTangents
from rfem_jax.mechanics.friction import joint_wrenches
from rfem_jax.mechanics.implicit.block_tridiagonal import solve
from rfem_jax.mechanics.implicit.condensation import LinkOperator, root_inertia
from rfem_jax.mechanics.implicit.residual import Residual
from rfem_jax.mechanics.joint_forces import CutForces
from rfem_jax.mechanics.kinematics import Motion
from rfem_jax.mechanics.model import BASE, Coordinates, Topology
from rfem_jax.mechanics.model_with_errors import ModelWithErrors


class Outboard(NamedTuple):
    """The links outboard of a link's c interfaces: their articulated inertias (6 c, 6 c), and transmissibility
    (6 c, 6 c) = (stiffness + inertia)^-1 stiffness, by which these reduce the interfaces' accelerations."""

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


class ClosureMatrix(NamedTuple):
    """Of the cut joints: units, wrenches (6, constraints) of unit multipliers by node; responses to them; inverse
    of the multipliers' matrix; springs: of compliant cut joints, None without any.  Friction in cut joints has further
    columns (theory (12.7))."""

    units: dict[int, Float[Array, "6 multipliers"]]
    responses: Response
    inverse: Float[Array, "multipliers multipliers"]
    springs: "SpringRows | None" = None

    def solve(self, rows: Array, closing: Array) -> Float[Array, " multipliers"]:
        """Increments of the multipliers for which the closure equations vanish: `rows`, second derivatives of Phi by
        the increments of the accelerations without them, and `closing` (`Residual`)."""
        if self.springs is None:
            return -apply(self.inverse, closing + rows)
        sprung, root, matrix = self.springs
        exerted = jnp.where(sprung, -closing, 0.0)
        rows = rows + apply(matrix, exerted)
        return exerted - root * apply(self.inverse, root * rows + jnp.where(sprung, 0.0, closing))


class SpringRows(NamedTuple):
    """Which multipliers are those of springs; by row the root of the springs' tangent, 1 where there is none; the
    multipliers' matrix (theory (13.9))."""

    sprung: Bool[Array, " multipliers"]
    root: Float[Array, " multipliers"]
    matrix: Float[Array, "multipliers multipliers"]

    def scaled(self) -> Float[Array, "multipliers multipliers"]:
        """The matrix that is inverted."""
        return self.root[:, None] * self.matrix * self.root[None] + jnp.diag(self.sprung.astype(float))


class ElementMatrix(NamedTuple):
    """Of the force elements: units, wrenches (6, k) of unit forces and moments by node; responses to them; gain (k, k):
    what they exert per relative acceleration that there would be without them (theory (7.22))."""

    units: dict[int, Float[Array, "6 k"]]
    responses: Response
    gain: Float[Array, "k k"]


class IterationMatrix(NamedTuple):
    """Factored iteration matrix of one step; closure: None without cut joints; elements: None without force elements
    that have tangents."""

    operators: tuple[LinkOperator | None, ...]
    links: tuple[ArticulatedLink, ...]
    closure: ClosureMatrix | None
    elements: ElementMatrix | None = None


class NewtonIncrement(NamedTuple):
    """Increments of the accelerations of the coordinates and of the multipliers [N]."""

    accelerations: Coordinates
    multipliers: Float[Array, " constraints"]


def iteration_matrix(
    actual: ModelWithErrors,
    operators: tuple[LinkOperator | None, ...],
    motion: Motion,
    cuts: Closure | None,
    held: tuple[int, ...] = (),
    joint_tangent: dict[int, Float[Array, ""]] | None = None,
    element_tangent: ElementTangents | None = None,
    row_tangent: Float[Array, " multipliers"] | None = None,
    cut_tangent: CutForces | None = None,
) -> IterationMatrix:
    """Factor the iteration matrix at one position; `held`: joint coordinates that are given; `joint_tangent`: minus the
    derivatives of forces along joint coordinates with respect to their accelerations; `element_tangent`: of force
    elements, `cut_tangent`: of friction in cut joints, likewise; `row_tangent`: of springs of cut joints, from
    `spring_row_tangent`."""
    with jax.named_scope("iteration_matrix"):
        topology = actual.topology
        links = _eliminate(actual, operators, motion, held, joint_tangent or {})
        elements = None
        if element_tangent is not None:
            elements = _element_matrix(topology, links, motion, element_tangent)
        if cuts is None:
            return IterationMatrix(operators, links, None, elements)
        points = _points(topology, motion)
        sides = topology.parents[topology.n_links :] + topology.children[topology.n_links :]
        units = {node: unit_columns(topology, cuts, node, points[node]) for node in sorted(set(sides)) if node != BASE}
        of_friction = _friction_columns(topology, cuts, points, cut_tangent or {})
        units = {node: jnp.concatenate([unit, *of_friction.get(node, ())], axis=1) for node, unit in units.items()}
        columns = topology.n_constraints + len(cut_tangent or {})
        joint_loads = jnp.zeros((topology.n_freedoms, columns))
        responses = _respond(topology, links, joint_loads, {}, {}, units, columns)
        responses = _with_elements(topology, elements, responses)
        rows = sum(product(transpose(unit), _of_node(topology, responses, node)) for node, unit in units.items())
        if cut_tangent:
            rows = rows + np.diag(np.arange(columns) >= topology.n_constraints).astype(float)
        rows = jnp.asarray(rows)
        springs = None if row_tangent is None else _spring_rows(topology, rows, row_tangent)
        inverse = invert_closure(topology, rows if springs is None else springs.scaled())
        return IterationMatrix(operators, links, ClosureMatrix(units, responses, inverse, springs), elements)


def _spring_rows(topology: Topology, rows: Array, row_tangent: Array) -> SpringRows:
    sprung = np.array(topology.sprung_rows)
    if (more := rows.shape[0] - topology.n_constraints) > 0:  # columns of friction come last
        sprung = np.append(sprung, np.zeros(more, bool))
        row_tangent = jnp.concatenate([row_tangent, jnp.zeros(more)])
    return SpringRows(jnp.asarray(sprung), jnp.where(sprung, jnp.sqrt(row_tangent), 1.0), rows)


def _element_matrix(
    topology: Topology, links: tuple[ArticulatedLink, ...], motion: Motion, tangents: ElementTangents
) -> ElementMatrix:
    """Force elements as a change of low rank of the mechanism without them (the formula of Sherman, Morrison and
    Woodbury): no stiffness is too large for it, nor zero too small."""
    points, k = _points(topology, motion), tangents.stiffness.shape[0]
    units = {
        node: algebra.spatial(wrench[:3] - cross(points[node][:, None], wrench[3:]), wrench[3:])
        for node, wrench in tangents.units.items()
    }
    responses = _respond(topology, links, jnp.zeros((topology.n_freedoms, k)), {}, {}, units, k)
    rows = sum(product(transpose(unit), _of_node(topology, responses, node)) for node, unit in units.items())
    stiffness = tangents.stiffness
    gain = -jnp.linalg.solve(jnp.eye(k) + product(stiffness, jnp.asarray(rows)), stiffness)
    return ElementMatrix(units, responses, gain)


def _with_elements(topology: Topology, elements: ElementMatrix | None, response: Response) -> Response:
    """The response (..., K) of a mechanism with its force elements, from that without them."""
    if elements is None:
        return response
    units, by_element, gain = elements
    rows = sum(product(transpose(unit), _of_node(topology, response, node)) for node, unit in units.items())
    exerted = product(gain, jnp.asarray(rows))
    return jax.tree.map(lambda a, b: a + product(b, exerted), response, by_element)


def _friction_columns(
    topology: Topology, cuts: Closure, points: dict[int, Array], cut_tangent: CutForces
) -> dict[int, list[Array]]:
    """Columns (6, 1) of forces in cut joints by node, times the square roots of their tangents.

    With force f = -D a for a relative acceleration a = u^T A of tangent D, the scaled force f / sqrt(D) is a further
    multiplier of u sqrt(D), whose row has a one on the diagonal; D may be zero.
    """
    found: dict[int, list[Array]] = {}
    for key, tangent in cut_tangent.items():
        joint, wrench = next(iter(joint_wrenches(topology, cuts, {key: jnp.sqrt(tangent)}).items()))
        sides: dict[int, Array] = {}
        for node, sign in ((topology.parents[joint], -1.0), (topology.children[joint], 1.0)):
            if node != BASE:
                moved = algebra.spatial(wrench[:3] - cross(points[node], wrench[3:]), wrench[3:])
                sides[node] = sides.get(node, 0.0) + sign * moved
        for node in {*topology.parents[topology.n_links :], *topology.children[topology.n_links :]} - {BASE}:
            found.setdefault(node, []).append(sides.get(node, jnp.zeros(6))[:, None])
    return found


def newton_increment(topology: Topology, matrix: IterationMatrix, residual: Residual) -> NewtonIncrement:
    """Increments of accelerations and multipliers for which the linearised residual vanishes."""
    return increment_and_wrenches(topology, matrix, residual)[0]


def increment_and_wrenches(
    topology: Topology, matrix: IterationMatrix, residual: Residual
) -> tuple[NewtonIncrement, list[Float[Array, "6"]]]:
    """`newton_increment`, and the increments of the wrenches at the global origin in the tree joints."""
    with jax.named_scope("newton_increment"):
        operators = matrix.operators
        loads = jnp.concatenate([residual.moment, residual.force])
        on_rfes = tuple(by_component(loads[:, a:b]) for a, b in topology.ranges)
        flexible = {l: operator for l, operator in enumerate(operators) if operator is not None}
        on_links = {l: -constant_product(op.rigid_response.T, on_rfes[l]) for l, op in flexible.items()}
        of_interfaces = {l: constant_product(op.interface_rows, on_rfes[l]) for l, op in flexible.items()}
        applied = _respond(topology, matrix.links, residual.hinge[:, None], on_links, of_interfaces, {}, 1)
        applied = _with_elements(topology, matrix.elements, applied)
        response = jax.tree.map(lambda x: x[:, 0], applied)
        multipliers = jnp.zeros_like(residual.closing)
        if matrix.closure is not None:
            units, by_multipliers = matrix.closure.units, matrix.closure.responses
            rows = sum(apply_transposed(unit, _of_node(topology, response, node)) for node, unit in units.items())
            closing = residual.closing
            if (more := matrix.closure.inverse.shape[0] - topology.n_constraints) > 0:
                closing = jnp.concatenate([closing, jnp.zeros(more)])
            multipliers = matrix.closure.solve(jnp.asarray(rows), closing)
            response = jax.tree.map(lambda a, b: a + apply(b, multipliers), response, by_multipliers)
            multipliers = multipliers[: topology.n_constraints] if more > 0 else multipliers
        elastic = _elastic_accelerations(topology, matrix, loads, response)
        increment = NewtonIncrement(Coordinates(response.joints, elastic), multipliers)
        return increment, _wrenches(matrix.links, response)


def _wrenches(links: tuple[ArticulatedLink, ...], response: Response) -> list[Array]:
    """Wrenches (6,) at the global origin in the tree joints: articulated inertia times acceleration minus load."""
    wrenches = []
    for link, load, acceleration in zip(links, response.loads, response.links):
        wrench = apply(link.inertia, acceleration) - load
        wrenches.append(algebra.wrench_at_origin(wrench[:3], wrench[3:], link.point))
    return wrenches


def _points(topology: Topology, motion: Motion) -> dict[int, Array]:
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
    top = jnp.concatenate([rotation, product(algebra.cross_matrix(arm), rotation)], axis=1)
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
    return _rotated(rotations, transpose(once))


def _inverse_transposed(rotations: Sequence[Array]) -> tuple[Array, ...]:
    """The matrices that transform a stiffness where `rotations` transform the compliance; those of angles' rates
    are not orthogonal."""
    return tuple(transpose(algebra.invert_block(r)) for r in rotations)


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


def _eliminate(
    actual: ModelWithErrors,
    operators: tuple[LinkOperator | None, ...],
    motion: Motion,
    held: tuple[int, ...],
    joint_tangent: dict[int, Array],
) -> tuple[ArticulatedLink, ...]:
    """Articulated inertias, from the tips to the base."""
    topology = actual.topology
    n = topology.n_links
    points = _points(topology, motion)
    outboard: dict[int, Array] = {}
    links: dict[int, ArticulatedLink] = {}
    for l in reversed(range(n)):
        rotation, operator = motion.links.rotation[:, :, l], operators[l]
        frame = _wrench_transform(rotation, motion.links.point[:, l] - points[l])
        in_link = root_inertia(actual, l) if operator is None else operator.inertia
        inertia = algebra.product_transposed(product(frame, in_link), frame)
        inertia = inertia + outboard.get(l, 0.0)
        interfaces, rotations = None, _interface_rotations(topology, motion, l)
        if operator is not None and rotations:
            interfaces = _interface_operator(topology, l, operator, frame, rotations, points, outboard)
            if interfaces.outboard is not None:
                transfer, reduced = interfaces.transfer, product(*interfaces.outboard)
                inertia = inertia + product(product(transfer, reduced), transpose(transfer))
        before, axes, hinges = inertia, [], []
        for k in reversed(topology.coordinates[l]):
            axis = algebra.spatial(motion.axis[:3, k], motion.axis[3:, k] + cross(motion.axis[:3, k], points[l]))
            hinge = None
            if k not in held:
                force_rows = apply(inertia, axis)
                pivot = dot(axis, force_rows)
                if k in joint_tangent:
                    pivot = pivot + joint_tangent[k]
                hinge = Hinge(force_rows / pivot[None], pivot)
                inertia = inertia - force_rows[:, None] * hinge.scaled[None]
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
    transfer = shift - product(frame, transpose(frame_to_interface))
    compliance = _congruent(rotations, operator.compliance)
    if not any(node in outboard for node in nodes):
        return InterfaceOperator(transfer, compliance, None)
    inertia = _block_diagonal([outboard.get(node) for node in nodes])
    stiffness = _congruent(_inverse_transposed(rotations), operator.stiffness)
    transmissibility = product(algebra.invert_positive(stiffness + inertia), stiffness)
    return InterfaceOperator(transfer, compliance, Outboard(inertia, transmissibility))


def _block_diagonal(blocks: Sequence[Array | None]) -> Array:
    zeros = jnp.zeros((6, 6))
    filled = [zeros if block is None else block for block in blocks]
    rows = [
        jnp.concatenate([block if i == j else zeros for j in range(len(filled))], axis=1)
        for i, block in enumerate(filled)
    ]
    return jnp.concatenate(rows)


def _respond(
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
            torque = joint_loads[k] + dot(axis[:, None], load)
            joint_torques[k] = torque
            if hinge is not None:
                load = load - hinge.scaled[:, None] * torque[None]
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
                rate = joint_torques[k] / hinge.pivot[None] - dot(hinge.scaled[:, None], acceleration)
                acceleration = acceleration + axis[:, None] * rate[None]
            rates.append(rate)
        of_links.append(acceleration)
        at[l] = acceleration
        if interfaces is None:
            continue
        with_frame = product(transpose(interfaces.transfer), acceleration)
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


def _of_node(topology: Topology, response: Response, node: int) -> Array:
    """Acceleration (6, ...) of a link or an interface."""
    if node < topology.n_links:
        return response.links[node]
    l = topology.link_of(node)
    i = _interfaces_of(topology, l).index(node)
    return response.interfaces[l][6 * i : 6 * i + 6]


def _elastic_accelerations(topology: Topology, matrix: IterationMatrix, loads: Array, response: Response) -> Array:
    """Second derivatives (6, N) of the elastic coordinates under loads (6, N)."""
    parts = [jnp.zeros((6, 0))]
    for l, (operator, (a, b)) in enumerate(zip(matrix.operators, topology.ranges)):
        if operator is None:
            continue
        link = matrix.links[l]
        acceleration = apply_transposed(link.frame, response.links[l])
        free = by_component(solve(operator.factored, loads[:, a:b]))
        y = free - constant_product(operator.rigid_response, acceleration)
        if l in response.interface_wrenches:
            wrench = _rotated_back(link.rotations, response.interface_wrenches[l])
            y = y + constant_product(operator.interface_rows.T, wrench)
        parts.append(y.reshape((6, b - a)))
    y = jnp.concatenate(parts, axis=1)
    return jnp.concatenate([y[3:], y[:3]])
