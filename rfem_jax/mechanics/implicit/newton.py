"""Newton increments for implicit steps: the linearised equations of motion, solved by recursion over the links.

Place in the pipeline: residual, articulated_links -> **newton** -> statics, implicit integration.

The iteration matrix approximates the tangent: links have the inertia of their undeformed shape, and the
stiffness of springs and dampers but not that of gyroscopic and joint loads.  Every flexible link is condensed to
its frame and interfaces (`condensation`), and the tree of links is solved (`articulated_links`) for the residual
and for unit multipliers of the cut joints at once; the multipliers follow from the closure (theory (7.11) to
(7.13)).  One matrix serves all iterations of a step.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Bool, Float

from rfem_jax.mechanics.algebra import vectors
from rfem_jax.mechanics.algebra.vectors import (
    apply,
    apply_transposed,
    by_component,
    constant_product,
    cross,
    product,
    transposed_product,
)
from rfem_jax.mechanics.forces.element_loads import ElementTangents
from rfem_jax.mechanics.forces.friction import joint_wrenches
from rfem_jax.mechanics.forces.joint_forces import CutForces
from rfem_jax.mechanics.forces.tangents import NO_FORCES, ForceTangents
from rfem_jax.mechanics.implicit.articulated_links import (
    ArticulatedLink,
    Response,
    elastic_accelerations,
    eliminate,
    node_points,
    of_node,
    respond,
    tree_wrenches,
)
from rfem_jax.mechanics.implicit.condensation import LinkOperator
from rfem_jax.mechanics.implicit.residual import Residual
from rfem_jax.mechanics.kinematics.cut_joints import Closure, unit_columns
from rfem_jax.mechanics.kinematics.motion import Motion
from rfem_jax.mechanics.kinematics.self_stress import inverse_closure, redundancy
from rfem_jax.mechanics.model.model import Coordinates
from rfem_jax.mechanics.model.topology import BASE, Topology
from rfem_jax.mechanics.model.with_errors import ModelWithErrors


class ClosureMatrix(NamedTuple):
    """Part of the closure in the iteration matrix: units, wrenches (6, constraints) of unit multipliers by node;
    responses to them; inverse of the multipliers' matrix; springs: those of compliant cut joints, None for models
    without them; joints: with ideal couplings, loads of unit multipliers along the joint coordinates. Friction in cut
    joints has further columns (theory (12.7))."""

    units: dict[int, Float[Array, "6 multipliers"]]
    responses: Response
    inverse: Float[Array, "multipliers multipliers"]
    springs: "SpringRows | None" = None
    joints: Float[Array, "freedoms multipliers"] | None = None

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
    """Rows of the closure that are laws of springs. sprung: whether a multiplier is one; root: by row the root
    of the springs' tangent, 1 in all other rows; matrix: that of the multipliers (theory (13.9))."""

    sprung: Bool[Array, " multipliers"]
    root: Float[Array, " multipliers"]
    matrix: Float[Array, "multipliers multipliers"]

    def scaled(self) -> Float[Array, "multipliers multipliers"]:
        """The matrix that is inverted."""
        return self.root[:, None] * self.matrix * self.root[None] + jnp.diag(self.sprung.astype(float))


class ElementMatrix(NamedTuple):
    """Part of the force elements in the iteration matrix: units, wrenches (6, k) of unit forces and moments by node;
    responses to them; gain (k, k): the forces per relative acceleration that there would be without them (theory
    (7.22)); joints: with couplings, units along the joint coordinates."""

    units: dict[int, Float[Array, "6 k"]]
    responses: Response
    gain: Float[Array, "k k"]
    joints: Float[Array, "freedoms k"] | None = None

    def relative(self, topology: Topology, response: Response) -> Array:
        """Relative accelerations (k, K) along the units of a response (..., K)."""
        rows = sum(transposed_product(unit, of_node(topology, response, node)) for node, unit in self.units.items())
        if self.joints is not None:
            rows = rows + transposed_product(self.joints, response.joints)
        return jnp.asarray(rows)


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


@functools.partial(jax.jit, static_argnames="held")  # as `motion_of`
def iteration_matrix(
    actual: ModelWithErrors,
    operators: tuple[LinkOperator | None, ...],
    motion: Motion,
    cuts: Closure | None,
    held: tuple[int, ...] = (),
    tangents: ForceTangents = NO_FORCES,
) -> IterationMatrix:
    """Factor the iteration matrix at one position; `held`: joint coordinates that are given; `tangents` of the forces
    of springs, laws, friction and force elements."""
    with jax.named_scope("iteration_matrix"):
        topology, cut_tangent = actual.topology, tangents.cuts
        links = eliminate(actual, operators, motion, held, tangents.joints)
        elements = None
        if tangents.elements is not None:
            elements = _element_matrix(topology, links, motion, tangents.elements)
        if cuts is None:
            return IterationMatrix(operators, links, None, elements)
        points = node_points(topology, motion)
        sides = topology.parents[topology.n_links :] + topology.children[topology.n_links :]
        units = {node: unit_columns(topology, cuts, node, points[node]) for node in sorted(set(sides)) if node != BASE}
        of_friction = _friction_columns(topology, cuts, points, cut_tangent)
        units = {node: jnp.concatenate([unit, *of_friction.get(node, ())], axis=1) for node, unit in units.items()}
        columns = topology.n_constraints + len(cut_tangent)
        joint_loads = jnp.zeros((topology.n_freedoms, columns))
        along = None
        if cuts.couplings is not None:
            before, ideal = topology.n_constraints - len(topology.ideal), cuts.couplings.along
            parts = joint_loads[:, :before], ideal, joint_loads[:, topology.n_constraints :]
            joint_loads = along = jnp.concatenate(parts, axis=1)
        responses = respond(topology, links, joint_loads, {}, {}, units, columns)
        responses = _with_elements(topology, elements, responses)
        rows = 0.0 if along is None else transposed_product(along, responses.joints)
        rows = sum((transposed_product(unit, of_node(topology, responses, at)) for at, unit in units.items()), rows)
        if cut_tangent:
            rows = rows + np.diag(np.arange(columns) >= topology.n_constraints).astype(float)
        rows = jnp.asarray(rows)
        springs = None if tangents.rows is None else _spring_rows(topology, rows, tangents.rows)
        left_open = redundancy(topology, motion, cuts)
        if left_open is not None:
            left_open = left_open.beside(columns - topology.n_constraints)
        inverse = inverse_closure(rows if springs is None else springs.scaled(), left_open)
        return IterationMatrix(operators, links, ClosureMatrix(units, responses, inverse, springs, along), elements)


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
    points, k = node_points(topology, motion), tangents.stiffness.shape[0]
    units = {
        node: vectors.spatial(wrench[:3] - cross(points[node][:, None], wrench[3:]), wrench[3:])
        for node, wrench in tangents.units.items()
    }
    along = jnp.zeros((topology.n_freedoms, k)) if tangents.joints is None else tangents.joints
    responses = respond(topology, links, along, {}, {}, units, k)
    matrix = ElementMatrix(units, responses, tangents.stiffness, tangents.joints)
    rows, stiffness = matrix.relative(topology, responses), tangents.stiffness
    return matrix._replace(gain=-jnp.linalg.solve(jnp.eye(k) + product(stiffness, rows), stiffness))


def _with_elements(topology: Topology, elements: ElementMatrix | None, response: Response) -> Response:
    """The response (..., K) of a mechanism with its force elements, from that without them."""
    if elements is None:
        return response
    exerted = product(elements.gain, elements.relative(topology, response))
    return jax.tree.map(lambda a, b: a + product(b, exerted), response, elements.responses)


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
                moved = vectors.spatial(wrench[:3] - cross(points[node], wrench[3:]), wrench[3:])
                sides[node] = sides.get(node, 0.0) + sign * moved
        for node in {*topology.parents[topology.n_links :], *topology.children[topology.n_links :]} - {BASE}:
            found.setdefault(node, []).append(sides.get(node, jnp.zeros(6))[:, None])
    return found


def newton_increment(topology: Topology, matrix: IterationMatrix, residual: Residual) -> NewtonIncrement:
    """Increments of accelerations and multipliers for which the linearised residual vanishes."""
    return increment_and_wrenches(topology, matrix, residual)[0]


@functools.partial(jax.jit, static_argnums=0)  # as `motion_of`
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
        applied = respond(topology, matrix.links, residual.hinge[:, None], on_links, of_interfaces, {}, 1)
        applied = _with_elements(topology, matrix.elements, applied)
        response = jax.tree.map(lambda x: x[:, 0], applied)
        multipliers = jnp.zeros_like(residual.closing)
        if matrix.closure is not None:
            units, by_multipliers, along = matrix.closure.units, matrix.closure.responses, matrix.closure.joints
            rows = 0.0 if along is None else apply_transposed(along, response.joints)
            rows = sum((apply_transposed(unit, of_node(topology, response, at)) for at, unit in units.items()), rows)
            closing = residual.closing
            if (more := matrix.closure.inverse.shape[0] - topology.n_constraints) > 0:
                closing = jnp.concatenate([closing, jnp.zeros(more)])
            multipliers = matrix.closure.solve(jnp.asarray(rows), closing)
            response = jax.tree.map(lambda a, b: a + apply(b, multipliers), response, by_multipliers)
            multipliers = multipliers[: topology.n_constraints] if more > 0 else multipliers
        elastic = elastic_accelerations(topology, operators, matrix.links, loads, response)
        increment = NewtonIncrement(Coordinates(response.joints, elastic), multipliers)
        return increment, tree_wrenches(matrix.links, response)
