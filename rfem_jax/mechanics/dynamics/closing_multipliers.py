"""The multipliers of the cut joints, from what the bodies do under the applied loads and under unit multipliers.

Place in the pipeline: tree_recursion, self_stress -> **closing_multipliers** -> dynamics.

Theory (5.6), and (13.8) where springs of compliant joints give some of them.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from rfem_jax.mechanics.algebra import vectors
from rfem_jax.mechanics.algebra.vectors import apply, cross, product
from rfem_jax.mechanics.dynamics.reduced_tree import InterfaceTree, branching_rfes, wrench_at
from rfem_jax.mechanics.forces.friction import node_wrenches
from rfem_jax.mechanics.forces.joint_forces import LawForces
from rfem_jax.mechanics.kinematics.cut_joints import Closure, unit_columns
from rfem_jax.mechanics.kinematics.motion import Motion, node_frames
from rfem_jax.mechanics.kinematics.self_stress import Redundancy, inverse_closure, redundancy
from rfem_jax.mechanics.model.inputs import Stabilisation
from rfem_jax.mechanics.model.topology import BASE, Topology
from rfem_jax.mechanics.model.with_errors import ModelWithErrors


def _cut_rfes(topology: Topology) -> tuple[int, ...]:
    """Nodes of the free rfes that carry cut joints only, but in slender links."""
    sides = topology.parents[topology.n_links :] + topology.children[topology.n_links :]
    nodes = {node for node in sides if node >= topology.n_links and not topology.is_slender(node)}
    return tuple(sorted(nodes - set(branching_rfes(topology))))


def cut_rfe_responses(
    actual: ModelWithErrors,
    motion: Motion,
    cuts: Closure | None,
    angular: Array,
    linear: Array,
    laws: LawForces | None,
) -> dict[int, Array]:
    """Accelerations (6, 1 + constraints) at their middles of the free rfes that carry cut joints only: under the
    applied loads, and for unit multipliers."""
    topology = actual.topology
    nodes = _cut_rfes(topology)
    if cuts is None or not nodes:
        return {}
    with jax.named_scope("cut_rfes"):
        rotation, where, velocity = node_frames(topology, motion, nodes)
        indices = np.array(nodes)
        inverse = vectors.product_transposed(
            product(rotation, actual.inverse_inertia[:, :, indices - topology.n_links]), rotation
        )
        centre = apply(rotation, actual.centre[:, indices])
        mobility = vectors.spatial_mobility(jnp.broadcast_to(actual.mass[indices], where.shape[1:]), centre, inverse)
        spin = velocity[:3]
        centripetal = cross(spin, velocity[3:] + cross(spin, where))
        responses = {}
        in_cuts = node_wrenches(topology, cuts, None if laws is None else laws.cuts)
        for i, node in enumerate(nodes):
            k = node - topology.n_links
            of_link = motion.links.rotation[:, :, topology.link_of(node)]
            applied = vectors.spatial(apply(of_link, angular[:, k]), apply(of_link, linear[:, k]) - centripetal[:, i])
            if node in in_cuts:
                applied = applied + apply(mobility[:, :, i], wrench_at(in_cuts[node], where[:, i]))
            unit = unit_columns(topology, cuts, node, where[:, i])
            response = product(mobility[:, :, i], unit)
            responses[node] = jnp.concatenate([applied[:, None], response], axis=1)
        return responses


def solved_multipliers(
    topology: Topology,
    cuts: Closure | None,
    motion: Motion,
    tree: InterfaceTree,
    responses: dict[int, Array],
    of_joints: Array | float,
    stabilisation: Stabilisation,
) -> tuple[Array, Array]:
    """Multipliers of theory (5.6), cut by cut, and their part due to stabilisation; `of_joints`: second derivatives of
    the equations of ideal couplings by all columns of loads."""
    if cuts is None:
        zeros = jnp.zeros((0,))
        return zeros, zeros
    with jax.named_scope("multipliers"):
        points = _points_of(topology, motion, tree)
        sides = set(topology.parents[topology.n_links :]) | set(topology.children[topology.n_links :])
        units = ((node, unit_columns(topology, cuts, node, points[node])) for node in sorted(sides) if node != BASE)
        rows = sum((vectors.transposed_product(unit, responses[node]) for node, unit in units), start=of_joints)
        rows = jnp.asarray(rows)

        baumgarte = -stabilisation.velocity_gain * cuts.rate - stabilisation.position_gain * cuts.residual
        left_open = redundancy(topology, motion, cuts)
        if cuts.springs is not None:
            return _multipliers_given_springs(topology, cuts.springs.multipliers, rows, cuts.bias, baumgarte, left_open)
        inverse = inverse_closure(rows[:, 1:], left_open)
        stabilising = apply(inverse, baumgarte)
        return stabilising - apply(inverse, cuts.bias + rows[:, 0]), stabilising


def _multipliers_given_springs(
    topology: Topology, springs: Array, rows: Array, bias: Array, baumgarte: Array, left_open: Redundancy | None
) -> tuple[Array, Array]:
    """`solved_multipliers` where those of springs are given: the others hold what these leave (theory (13.8))."""
    sprung = np.array(topology.sprung_rows)
    if sprung.all():
        return springs, jnp.zeros_like(springs)
    rigid = np.flatnonzero(~sprung)
    onto = jnp.asarray(np.eye(len(sprung))[rigid])
    loaded = bias + rows[:, 0] + apply(rows[:, 1:], springs)
    matrix = jnp.stack([jnp.stack([rows[i, 1 + j] for j in rigid]) for i in rigid])
    inverse = inverse_closure(matrix, None if left_open is None else left_open.among(rigid))
    stabilising = apply(onto.T, apply(inverse, apply(onto, baumgarte)))
    return springs + stabilising - apply(onto.T, apply(inverse, apply(onto, loaded))), stabilising


def _points_of(topology: Topology, motion: Motion, tree: InterfaceTree) -> dict[int, Array]:
    """The point at which each node's response is given."""
    nodes = (*range(topology.n_links), *branching_rfes(topology))
    points = {node: tree.point[:, i] for i, node in enumerate(nodes)}
    for node in (topology.n_links + k for k in topology.interfaces if topology.is_slender(topology.n_links + k)):
        points[node] = tree.point[:, topology.link_of(node)]
    for i, k in enumerate(topology.interfaces):
        points.setdefault(topology.n_links + k, motion.interfaces.point[:, i])
    return points
