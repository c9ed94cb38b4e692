"""The reduced tree of *interface bodies*: the links' rfes 0, and the free rfes with links outboard.

Place in the pipeline: kinematics, elasticity, friction -> **reduced_tree** -> tree_recursion.

Its bodies carry what holds them: elastic forces of the free rfes, force elements, gravity and the forces in cut joints.
It falls into islands (`topology`); spatial vectors are in global axes at one point of their island, the place of its
root at this instant: a common point needs no transforms, and a near one loses no digits of small inertias.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from rfem_jax.mechanics.algebra import vectors
from rfem_jax.mechanics.algebra.vectors import apply, cross
from rfem_jax.mechanics.dynamics.slender_chains import spatial_bodies
from rfem_jax.mechanics.forces.element_loads import FrameLoads
from rfem_jax.mechanics.forces.friction import node_wrenches
from rfem_jax.mechanics.forces.joint_forces import LawForces
from rfem_jax.mechanics.kinematics.cut_joints import Closure
from rfem_jax.mechanics.kinematics.motion import Motion, by_freedom, node_frames, total
from rfem_jax.mechanics.model.model import State
from rfem_jax.mechanics.model.topology import Topology
from rfem_jax.mechanics.model.with_errors import ModelWithErrors


class InterfaceTree(NamedTuple):
    """The reduced tree: links (rfes 0) first, then the free rfes with links outboard; n bodies.

    point (3, n): of their islands; velocity (6, n), inertia (6, 6, n) and load (6, n) (applied minus
    gyroscopic wrench) at that point; axis, bias (6, F): axes of the joint coordinates, and accelerations due to
    their rates (Featherstone's c).
    """

    point: Float[Array, "3 n"]
    velocity: Float[Array, "6 n"]
    inertia: Float[Array, "6 6 n"]
    load: Float[Array, "6 n"]
    axis: Float[Array, "6 freedoms"]
    bias: Float[Array, "6 freedoms"]


def branching_rfes(topology: Topology) -> tuple[int, ...]:
    """Nodes of the free rfes with links outboard, but in slender links."""
    parents = {node for node in topology.parents[: topology.n_links] if node >= topology.n_links}
    return tuple(sorted(node for node in parents if not topology.is_slender(node)))


def interface_tree(
    actual: ModelWithErrors,
    state: State,
    motion: Motion,
    elastic: tuple[Array, Array],
    at_nodes: FrameLoads | None,
) -> InterfaceTree:
    """The reduced tree under the elastic forces and moments (3, N) on the free rfes and those of force elements."""
    with jax.named_scope("interface_tree"):
        topology, (force, moment) = actual.topology, elastic
        n = topology.n_links
        branching = branching_rfes(topology)
        nodes = (*range(n), *branching)
        rotation, where, velocity = node_frames(topology, motion, nodes)
        points = jnp.concatenate([motion.hinges.point, where[:, n:]], axis=1)
        rows = {node: i for i, node in enumerate(nodes)}
        point = jnp.stack([points[:, rows[topology.island_of(node)]] for node in rows], axis=1)
        velocity = _shifted(velocity, point)

        # Elastic wrenches act on a branching rfe, and minus their sum on rfe 0 of the link.
        arms = cross(motion.relative.position, force)
        applied_force = -total(topology, force)
        applied_moment = -total(topology, moment + arms)
        if at_nodes is not None:
            applied_force = applied_force + at_nodes.force[:, :n]
            applied_moment = applied_moment + at_nodes.moment[:, :n]
            force, moment = with_elements(topology, at_nodes, force, moment)
        owners = [*range(n), *(topology.link_of(node) for node in branching)]
        link_rotation = jnp.stack([motion.links.rotation[:, :, l] for l in owners], axis=2)
        for node in branching:
            k = node - n
            applied_force = jnp.concatenate([applied_force, force[:, k : k + 1]], axis=1)
            applied_moment = jnp.concatenate([applied_moment, moment[:, k : k + 1]], axis=1)
        applied = vectors.wrench_at_origin(
            apply(link_rotation, applied_moment), apply(link_rotation, applied_force), where - point
        )

        inertia, weight, gyroscopic = spatial_bodies(actual, np.array(nodes), rotation, where - point, velocity)
        at_joints = by_freedom(topology, point[:, :n])
        axis, axis_velocity = _shifted(motion.axis, at_joints), _shifted(motion.axis_velocity, at_joints)
        return InterfaceTree(
            point=point,
            velocity=velocity,
            inertia=inertia,
            load=applied + weight - gyroscopic,
            axis=axis,
            bias=vectors.motion_cross(axis_velocity, axis * state.velocity.joints[None]),
        )


def with_elements(topology: Topology, at_nodes: FrameLoads, force: Array, moment: Array) -> tuple[Array, Array]:
    """Forces and moments (3, N) on the free rfes together with those of force elements."""
    n = topology.n_links
    return force + at_nodes.force[:, n:], moment + at_nodes.moment[:, n:]


def with_cut_forces(
    topology: Topology, cuts: Closure | None, tree: InterfaceTree, laws: LawForces | None
) -> InterfaceTree:
    """The reduced tree under the forces in cut joints, too."""
    load = tree.load
    wrenches = node_wrenches(topology, cuts, None if laws is None else laws.cuts)
    for i, node in enumerate((*range(topology.n_links), *branching_rfes(topology))):
        if node in wrenches:
            wrench = wrench_at(wrenches[node], tree.point[:, i])
            load = jnp.where(np.arange(load.shape[1]) == i, load + wrench[:, None], load)
    return tree._replace(load=load)


def wrench_at(wrench: Array, point: Array) -> Array:
    """Wrench (6,) given at the global origin, at `point`."""
    return vectors.spatial(wrench[:3] - cross(point, wrench[3:]), wrench[3:])


def _shifted(motion: Array, point: Array) -> Array:
    """Spatial motion (6, ...) given at the global origin, at `point`."""
    return vectors.spatial(motion[:3], motion[3:] + cross(motion[:3], point))
