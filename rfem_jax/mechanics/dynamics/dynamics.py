"""Accelerations at one instant, in a time proportional to the number of rfes.

Place in the pipeline: reduced_tree, tree_recursion, closing_multipliers -> **dynamics** -> loads, simulation.

A free rfe is held by elastic forces alone: its absolute acceleration is wrench over inertia, and the
articulated inertia that it passes to its link frame is zero (docs/theory/4_recursion.md).  What remains is the
reduced tree of *interface bodies*, whose islands the articulated-body algorithm solves for the applied loads and for
unit multipliers of the cut joints at once; the multipliers follow from theory (5.6), the elastic accelerations from
the absolute ones.  Cost and memory are linear in the number of rfes; no mechanism-wide mass matrix is formed.

Wrenches and accelerations of rfes are in the axes of their link.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from rfem_jax.mechanics.algebra import vectors
from rfem_jax.mechanics.algebra.vectors import apply, apply_transposed, cross
from rfem_jax.mechanics.dynamics.closing_multipliers import cut_rfe_responses, solved_multipliers
from rfem_jax.mechanics.dynamics.reduced_tree import InterfaceTree, interface_tree, with_cut_forces, with_elements
from rfem_jax.mechanics.dynamics.slender_chains import chain_of, chain_wrench, classical
from rfem_jax.mechanics.dynamics.tree_recursion import articulated_bodies, joint_columns, load_columns
from rfem_jax.mechanics.elements.elasticity import elastic_loads
from rfem_jax.mechanics.forces.element_loads import FrameLoads, frame_loads
from rfem_jax.mechanics.forces.friction import cut_friction, node_wrenches, tree_friction, with_friction
from rfem_jax.mechanics.forces.joint_forces import LawForces, applied_forces, law_forces, with_ideal_couplings
from rfem_jax.mechanics.kinematics.cut_joints import Closure, closure
from rfem_jax.mechanics.kinematics.motion import Motion, motion_of, spread
from rfem_jax.mechanics.model.inputs import DriveInput, Stabilisation
from rfem_jax.mechanics.model.model import Coordinates, State
from rfem_jax.mechanics.model.topology import Topology
from rfem_jax.mechanics.model.with_errors import ModelWithErrors


class Accelerations(NamedTuple):
    """The solution of one instant.

    coordinates: second derivatives of the coordinates; multipliers [N] of the closure equations; stabilising [N]:
    their part due to Baumgarte's terms; angular, linear (3, nodes): absolute accelerations of all nodes'
    reference points in link axes; spatial (6, L): accelerations of the links at their islands' points;
    motion, closure, interface_tree: what they were computed from; dissipated [W]: power that the dampers
    dissipate; laws: forces of springs and laws along joint coordinates, None without any; frame_loads: what force
    elements exert, likewise; chain_wrenches: by slender link what its rfe 0 exerts on the next rfe, at its point.
    """

    coordinates: Coordinates
    multipliers: Float[Array, " constraints"]
    stabilising: Float[Array, " constraints"]
    angular: Float[Array, "3 nodes"]
    linear: Float[Array, "3 nodes"]
    spatial: Float[Array, "6 links"]
    motion: Motion
    closure: Closure | None
    interface_tree: InterfaceTree
    dissipated: Float[Array, ""]
    laws: LawForces | None
    frame_loads: FrameLoads | None = None
    chain_wrenches: dict[int, Float[Array, "6"]] = {}  # noqa: RUF012 - never changed


@jax.jit  # traced once for all its places
def accelerations(
    actual: ModelWithErrors, state: State, drive: DriveInput, stabilisation: Stabilisation
) -> Accelerations:
    """Accelerations of all coordinates and bodies, and the multipliers of the cut joints.

    `state` is taken with prescribed values already imposed (`impose`).
    """
    topology = actual.topology
    motion = motion_of(actual, state)
    cuts = closure(actual, motion, stabilisation.scale)
    inverse_rate = vectors.invert_block(motion.relative.rate_matrix)
    force, moment, dissipated = elastic_loads(actual, state, motion.relative, inverse_rate)
    spin, gravity = link_axes(actual, motion)
    at_nodes = frame_loads(actual, motion, drive.time)
    free = (force, moment) if at_nodes is None else with_elements(topology, at_nodes, force, moment)
    angular, linear = _free_accelerations(actual, motion, spin, gravity, *free)
    tree = interface_tree(actual, state, motion, (force, moment), at_nodes)
    chains = {l: chain_of(actual, motion, l, tree.point[:, l], free) for l in topology.slender}
    found = tree_friction(actual, state, motion, None) | cut_friction(actual, motion, cuts, None)
    laws = with_friction(actual, law_forces(actual, state), found)
    tree = with_cut_forces(topology, cuts, tree, laws)
    in_cuts = node_wrenches(topology, cuts, None if laws is None else laws.cuts) if chains else {}
    forces = applied_forces(topology, state.position, drive, laws)
    columns, along = load_columns(topology, cuts, tree, in_cuts), joint_columns(topology, cuts)
    responses, rates, swept = articulated_bodies(topology, tree, chains, columns, drive, forces, along)
    responses |= cut_rfe_responses(actual, motion, cuts, angular, linear, laws)
    of_joints = sum((along[k][1:, None] * rates[k][None] for k in along), start=0.0)
    multipliers, stabilising = solved_multipliers(topology, cuts, motion, tree, responses, of_joints, stabilisation)
    laws = with_ideal_couplings(actual, laws, motion, multipliers, stabilisation.scale)
    weights = jnp.concatenate([jnp.ones((1,)), multipliers])
    solved = {node: _combine(columns, weights) for node, columns in responses.items()}
    angular, linear = _with_interfaces(topology, motion, solved, angular, linear)
    for l, chain in chains.items():
        (a, b), spatial = topology.ranges[l], _combine(jnp.moveaxis(swept[l][1], 0, 2), weights[:, None])
        found = classical(motion, chain, l, spatial)
        angular, linear = (
            jnp.concatenate([one[:, :a], new, one[:, b:]], axis=1) for one, new in zip((angular, linear), found)
        )
    spatial = jnp.stack([solved[l] for l in range(topology.n_links)], axis=1)
    root_angular, root_linear = _link_accelerations(topology, motion, tree, spatial)
    elastic = _elastic_accelerations(topology, motion, inverse_rate, spin, root_angular, root_linear, angular, linear)
    joints = jnp.stack([_combine(rate[None], weights)[0] for rate in rates]) if rates else jnp.zeros((0,))
    return Accelerations(
        coordinates=Coordinates(joints, elastic),
        multipliers=multipliers,
        stabilising=stabilising,
        angular=jnp.concatenate([root_angular, angular], axis=1),
        linear=jnp.concatenate([root_linear, linear], axis=1),
        spatial=spatial,
        motion=motion,
        closure=cuts,
        interface_tree=tree,
        dissipated=total_dissipated(dissipated, laws, at_nodes, cuts),
        laws=laws,
        frame_loads=at_nodes,
        chain_wrenches={l: chain_wrench(chains[l], swept[l][0], spatial[:, l], weights) for l in chains},
    )


def total_dissipated(
    of_links: Float[Array, ""], laws: LawForces | None, at_nodes: FrameLoads | None, cuts: Closure | None
) -> Array:
    """Power [W] that the dampers of links, joints, force elements and compliant cut joints dissipate."""
    dissipated = of_links
    for forces in (laws, at_nodes, None if cuts is None else cuts.springs):
        dissipated = dissipated if forces is None else dissipated + forces.dissipated
    return dissipated


def link_axes(actual: ModelWithErrors, motion: Motion) -> tuple[Float[Array, "3 links"], Float[Array, "3 links"]]:
    """Angular velocities [rad/s] of the links and gravity [m/s^2], in the axes of each link."""
    spin = apply_transposed(motion.links.rotation, motion.links.velocity[:3])
    gravity = actual.gravity[:, None]
    return spin, apply_transposed(motion.links.rotation, jnp.broadcast_to(gravity, spin.shape))


def _free_accelerations(
    actual: ModelWithErrors, motion: Motion, spin: Array, gravity: Array, force: Array, moment: Array
) -> tuple[Array, Array]:
    """Absolute angular and linear accelerations (3, N), in link axes, of the rfes as free bodies under the given
    wrenches and gravity."""
    with jax.named_scope("free_rfes"):
        topology, relative = actual.topology, motion.relative
        n = topology.n_links
        spin = spread(topology, spin) + relative.angular
        body_spin = apply_transposed(relative.rotation, spin)
        body_centre = actual.centre[:, n:]
        centre = apply(relative.rotation, jnp.broadcast_to(body_centre, spin.shape))
        body_moment = apply_transposed(relative.rotation, moment - cross(centre, force))
        gyroscopic = cross(body_spin, apply(actual.inertia[:, :, n:], body_spin))
        angular = apply(relative.rotation, apply(actual.inverse_inertia, body_moment - gyroscopic))
        of_centre = force / actual.mass[n:][None] + spread(topology, gravity)
        return angular, of_centre - cross(angular, centre) - cross(spin, cross(spin, centre))


def _combine(columns: Array, weights: Array) -> Array:
    """Sum of columns (6, K): the response to the applied loads, and those to the multipliers."""
    return columns[:, 0] if columns.shape[1] == 1 else apply(columns, weights)


def _with_interfaces(
    topology: Topology, motion: Motion, solved: dict[int, Array], angular: Array, linear: Array
) -> tuple[Array, Array]:
    """Accelerations (3, N) of the free rfes in link axes, those of the interfaces put in."""
    n = topology.n_links
    for i, k in enumerate(topology.interfaces):
        if n + k not in solved or topology.is_slender(n + k):  # it carries no joint, or is of a chain
            continue
        velocity, where = motion.interfaces.velocity[:, i], motion.interfaces.point[:, i]
        of_link = motion.links.rotation[:, :, topology.link_of(n + k)]
        spin = velocity[:3]
        classical = solved[n + k][3:] + cross(spin, velocity[3:] + cross(spin, where))
        column = (np.arange(topology.n_rfes) == k)[None]
        angular = jnp.where(column, apply_transposed(of_link, solved[n + k][:3])[:, None], angular)
        linear = jnp.where(column, apply_transposed(of_link, classical)[:, None], linear)
    return angular, linear


def _link_accelerations(topology: Topology, motion: Motion, tree: InterfaceTree, spatial: Array) -> tuple[Array, Array]:
    """Angular and linear accelerations (3, L) of the links' origins in link axes, from the spatial ones."""
    n = topology.n_links
    spin, velocity = tree.velocity[:3, :n], tree.velocity[3:, :n]
    arm = motion.links.point - tree.point[:, :n]
    classical = spatial[3:] + cross(spatial[:3], arm) + cross(spin, velocity + cross(spin, arm))
    rotation = motion.links.rotation
    return apply_transposed(rotation, spatial[:3]), apply_transposed(rotation, classical)


def _elastic_accelerations(
    topology: Topology,
    motion: Motion,
    inverse_rate: Array,
    spin: Array,
    root_angular: Array,
    root_linear: Array,
    angular: Array,
    linear: Array,
) -> Array:
    """Second derivatives (6, N) of the elastic coordinates from the absolute accelerations of links and rfes."""
    with jax.named_scope("elastic_accelerations"):
        relative = motion.relative
        spin, of_link = spread(topology, spin), spread(topology, root_angular)
        u = (
            linear
            - spread(topology, root_linear)
            - cross(of_link, relative.position)
            - cross(spin, cross(spin, relative.position) + 2.0 * relative.linear)
        )
        rotation = angular - of_link - cross(spin, relative.angular) - relative.rate_bias
        return jnp.concatenate([u, apply(inverse_rate, rotation)])
