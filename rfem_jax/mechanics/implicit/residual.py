"""The residual of the equations of motion for given accelerations and multipliers (inverse dynamics).

Place in the pipeline: kinematics, elasticity, cut_joints, joint_forces, loads -> **residual** -> newton,
implicit methods.

`dynamics` solves for the accelerations; here they are given, and the joint loads follow by the recursive
Newton-Euler algorithm.  The residual is the moment about every hinge, the generalised forces on every free
rfe, and the constraint equations of every cut joint (theory (3.11)).
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from rfem_jax.mechanics.algebra import vectors
from rfem_jax.mechanics.algebra.vectors import Scalar, apply, apply_transposed, cross, dot
from rfem_jax.mechanics.dynamics import loads
from rfem_jax.mechanics.dynamics.dynamics import total_dissipated
from rfem_jax.mechanics.elements.elasticity import dissipated_power, generalised_forces
from rfem_jax.mechanics.forces.element_loads import FrameLoads, frame_loads
from rfem_jax.mechanics.forces.friction import (
    Ahead,
    FrictionStates,
    cut_forces,
    cut_friction,
    tree_friction,
    with_friction,
)
from rfem_jax.mechanics.forces.joint_forces import (
    LawForces,
    applied_forces,
    by_coordinate,
    law_forces,
    with_ideal_couplings,
)
from rfem_jax.mechanics.kinematics.cut_joints import Closure, closure, spring_residual
from rfem_jax.mechanics.kinematics.motion import Motion, by_freedom, motion_of, spread
from rfem_jax.mechanics.kinematics.self_stress import redundancy
from rfem_jax.mechanics.kinematics.slender_links import completed, projected
from rfem_jax.mechanics.model.inputs import DriveInput
from rfem_jax.mechanics.model.model import Coordinates, State
from rfem_jax.mechanics.model.topology import BASE, Topology
from rfem_jax.mechanics.model.with_errors import ModelWithErrors

ROUNDING = 2e-13  # of a position over the longest link, with a margin for sums


class Residual(NamedTuple):
    """Residual of the equations of motion: hinge (F,) [N m, N]; force [N], moment [N m] (3, N) on the free rfes;
    closing [m/s^2]: second derivative of Phi, zero in a solution; in the places of springs of cut joints multipliers
    less what these exert [N]."""

    hinge: Float[Array, " freedoms"]
    force: Float[Array, "3 rfes"]
    moment: Float[Array, "3 rfes"]
    closing: Float[Array, " constraints"]


class Evaluation(NamedTuple):
    """The residual at one instant, and what was computed with it.

    hinge (F,): drive minus load along every coordinate of the tree joints [N m, N]; force, moment (3, N): on the
    free rfes at their middles, in link axes and about the axes of the angles' rates [N, N m]; closing,
    closing_rate, closing_acceleration: Phi [m] and its derivatives, but in closing and closing_acceleration multipliers
    less what springs of cut joints exert [N] in the places of these; angular, linear (3, nodes):
    accelerations of the nodes in link axes; motion, closure, multipliers: what it was computed from;
    wrenches (6,): of all joints at the global origin; dissipated [W]: power of the dampers; laws: forces of springs
    and laws along joint coordinates, None without any; frame_loads: what force elements exert, likewise.
    """

    hinge: Float[Array, " freedoms"]
    force: Float[Array, "3 rfes"]
    moment: Float[Array, "3 rfes"]
    closing: Float[Array, " constraints"]
    closing_rate: Float[Array, " constraints"]
    closing_acceleration: Float[Array, " constraints"]
    angular: Float[Array, "3 nodes"]
    linear: Float[Array, "3 nodes"]
    motion: Motion
    closure: Closure | None
    multipliers: Float[Array, " constraints"]
    wrenches: list[Float[Array, "6"]]
    dissipated: Float[Array, ""]
    laws: LawForces | None
    frame_loads: FrameLoads | None = None


def residual_of(evaluation: Evaluation) -> Residual:
    """The part that a Newton increment makes vanish, with `closing` as it stands in the evaluation."""
    return Residual(evaluation.hinge, evaluation.force, evaluation.moment, evaluation.closing)


def residual_forces(
    actual: ModelWithErrors, evaluation: Evaluation, drive: DriveInput, scale: Scalar
) -> Float[Array, " n"]:
    """The residual as forces [N]: on the rfes, along the joint coordinates, and to close the cut joints.

    **Arguments:** `scale`: a length [m] of the mechanism; the closing of the evaluation is an acceleration.
    """
    hinge = evaluation.hinge
    if drive.motions:
        # Along a prescribed coordinate this is the force that enforces the motion, no residual.
        hinge = jnp.where(np.isin(np.arange(hinge.shape[0]), list(drive.motions)), 0.0, hinge)
    slides = actual.topology.slides
    moment, hinge = (
        evaluation.moment / scale,
        hinge / (jnp.where(np.array(slides), 1.0, scale) if any(slides) else scale),
    )
    closing = jnp.sum(actual.mass)
    if sprung := actual.topology.sprung_rows:
        closing = jnp.where(np.array(sprung), 1.0, closing)
    found = redundancy(actual.topology, evaluation.motion, evaluation.closure)
    # Nothing gives way to what is open in redundant directions: it is drift, no force.
    closes = evaluation.closing if found is None else found.closed() @ evaluation.closing
    parts = evaluation.force, moment, hinge, closes * closing
    return jnp.concatenate([part.reshape(-1) for part in parts])


def rounding_force(actual: ModelWithErrors, scale: Scalar, h: Scalar) -> Float[Array, ""]:
    """The force [N] that moves the mechanism within a step of length h [s] by no more than positions are rounded by:
    a residual below it says nothing, also where no other force acts."""
    moving = jnp.asarray(h) > 0.0
    return jnp.where(moving, ROUNDING * jnp.sum(actual.mass) * scale / jnp.where(moving, h, 1.0) ** 2, 0.0)


@jax.jit  # traced once for all its places
def evaluate_residual(
    actual: ModelWithErrors,
    state: State,
    accelerations: Coordinates,
    multipliers: Float[Array, " constraints"],
    drive: DriveInput,
    scale: Scalar,
    ahead: Scalar | None = None,
) -> Evaluation:
    """Residual for given accelerations of the coordinates and multipliers [N].

    `state` is taken with prescribed values already imposed; `scale` [m] as in `closure`; `ahead` [s]: by which friction
    is taken later, None for not.
    """
    with jax.named_scope("residual"):
        topology, n = actual.topology, actual.topology.n_links
        motion = motion_of(actual, state)
        cuts = closure(actual, motion, scale)
        accelerations = completed(actual, motion.relative, accelerations)
        spatial = spatial_accelerations(actual, motion, state, accelerations)
        angular, linear = _node_accelerations(topology, motion, spatial, accelerations)
        at_nodes = frame_loads(actual, motion, drive.time)
        inertial = loads.inertial_loads(actual, motion, angular, linear, accelerations)
        inertial = loads.loads_beyond_elements(inertial, at_nodes)
        later = None if ahead is None else Ahead(ahead, accelerations.joints, spatial)
        in_cuts = cut_friction(actual, motion, cuts, multipliers, later)
        wrenches = loads.chain_wrenches(actual, motion, cuts, multipliers, inertial, cut_forces(actual, in_cuts))
        hinge = -dot(motion.axis, by_freedom(topology, jnp.stack(wrenches[:n], axis=1)))
        laws = _forces_at_joints(actual, state, motion, wrenches, multipliers, scale, in_cuts, later)
        applied = applied_forces(topology, state.position, drive, laws)
        if applied:
            hinge = hinge + by_coordinate(topology, applied)
        elastic, dissipated = generalised_forces(actual, state, motion.relative)
        if actual.superelements is not None:
            of_bodies = loads.superelement_loads(actual, motion, angular, linear, accelerations)
            elastic = elastic - of_bodies.generalised
        on_force, on_moment = _interface_loads(topology, motion, wrenches)
        moment = apply_transposed(motion.relative.rate_matrix, on_moment - inertial[1][:, n:])
        force = elastic[:3] + on_force - inertial[0][:, n:]
        force, moment = projected(actual, motion.relative, force, elastic[3:] + moment)
        closing, closing_rate, closing_acceleration = _closings(topology, cuts, multipliers, spatial, accelerations)
        return Evaluation(
            hinge=hinge,
            force=force,
            moment=moment,
            closing=closing,
            closing_rate=closing_rate,
            closing_acceleration=closing_acceleration,
            angular=angular,
            linear=linear,
            motion=motion,
            closure=cuts,
            multipliers=multipliers,
            wrenches=wrenches,
            dissipated=total_dissipated(dissipated, laws, at_nodes, cuts),
            laws=laws,
            frame_loads=at_nodes,
        )


def with_wrenches(
    evaluation: Evaluation,
    wrenches: Sequence[Float[Array, "6"]],
    actual: ModelWithErrors,
    state: State,
    accelerations: Coordinates,
    multipliers: Float[Array, " constraints"],
    drive: DriveInput,
    scale: Scalar,
    ahead: Scalar | None = None,
) -> Evaluation:
    """The evaluation with wrenches of the tree joints at the global origin that are given, and all forces that go with
    these and with the state; the others as of `evaluate_residual`."""
    motion, cuts = motion_of(actual, state), evaluation.closure
    later = None
    if ahead is not None:
        accelerations = completed(actual, motion.relative, accelerations)
        later = Ahead(ahead, accelerations.joints, spatial_accelerations(actual, motion, state, accelerations))
    in_cuts = cut_friction(actual, motion, cuts, multipliers, later)
    laws = _forces_at_joints(actual, state, motion, wrenches, multipliers, scale, in_cuts, later)
    at_nodes = frame_loads(actual, motion, drive.time)
    now = closure(actual, motion, scale)
    of_cuts = loads.cut_wrenches(actual.topology, cuts, multipliers, cut_forces(actual, in_cuts))
    return evaluation._replace(
        multipliers=multipliers,
        wrenches=[*wrenches, *of_cuts],
        dissipated=total_dissipated(dissipated_power(actual, state), laws, at_nodes, now),
        laws=laws,
        frame_loads=at_nodes,
    )


def _forces_at_joints(
    actual: ModelWithErrors,
    state: State,
    motion: Motion,
    wrenches: Sequence[Float[Array, "6"]],
    multipliers: Float[Array, " constraints"],
    scale: Scalar,
    in_cuts: FrictionStates,
    later: Ahead | None,
) -> LawForces | None:
    """Forces of springs, laws, couplings and friction at joints; `in_cuts`: friction in cut joints."""
    in_tree = tree_friction(actual, state, motion, wrenches, later)
    laws = with_friction(actual, law_forces(actual, state), in_cuts | in_tree)
    return with_ideal_couplings(actual, laws, motion, multipliers, scale)


def spatial_accelerations(
    actual: ModelWithErrors, motion: Motion, state: State, accelerations: Coordinates
) -> dict[int, Array]:
    """Spatial accelerations (6,) at the global origin of the links and of the interfaces, by node."""
    topology = actual.topology
    n = topology.n_links
    bias = vectors.motion_cross(motion.axis_velocity, motion.axis * state.velocity.joints[None])
    over_joint = motion.axis * accelerations.joints[None] + bias
    links: dict[int, Array] = {}
    interfaces: dict[int, Array] = {}

    def of(node: int) -> Array:
        if node == BASE:
            return jnp.zeros((6,))
        if node < n:
            return links[node]
        if node not in interfaces:
            interfaces[node] = _interface_acceleration(topology, motion, links, node, accelerations)
        return interfaces[node]

    for l in range(n):
        acceleration = of(topology.parents[l])
        for k in topology.coordinates[l]:
            acceleration = acceleration + over_joint[:, k]
        links[l] = acceleration
    for k in topology.interfaces:
        of(n + k)
    return {**links, **interfaces}


def _interface_acceleration(
    topology: Topology, motion: Motion, links: dict[int, Array], node: int, accelerations: Coordinates
) -> Array:
    """Spatial acceleration (6,) of a free rfe at the global origin."""
    k, l = node - topology.n_links, topology.link_of(node)
    rotation, origin = motion.links.rotation[:, :, l], motion.links.point[:, l]
    relative = jax.tree.map(lambda x: x[..., k], motion.relative)
    angular = apply(relative.rate_matrix, accelerations.elastic[3:, k]) + relative.rate_bias
    linear = accelerations.elastic[:3, k] - cross(angular, relative.position) - cross(relative.angular, relative.linear)
    angular = apply(rotation, angular)
    in_link = vectors.spatial(angular, apply(rotation, linear) + cross(origin, angular))
    velocity = motion.interfaces.velocity[:, topology.interfaces.index(k)] - motion.links.velocity[:, l]
    return links[l] + vectors.motion_cross(motion.links.velocity[:, l], velocity) + in_link


def _node_accelerations(
    topology: Topology, motion: Motion, spatial: dict[int, Array], accelerations: Coordinates
) -> tuple[Array, Array]:
    """Angular and linear accelerations (3, nodes) of the reference points, in link axes."""
    of_links = jnp.stack([spatial[l] for l in range(topology.n_links)], axis=1)
    rotation, origin = motion.links.rotation, motion.links.point
    spin, velocity = motion.links.velocity[:3], motion.links.velocity[3:]
    classical = of_links[3:] + cross(of_links[:3], origin)
    classical = classical + cross(spin, velocity + cross(spin, origin))
    root_angular = apply_transposed(rotation, of_links[:3])
    root_linear = apply_transposed(rotation, classical)
    spin = spread(topology, apply_transposed(rotation, spin))
    of_link = spread(topology, root_angular)
    relative = motion.relative
    linear = (
        spread(topology, root_linear)
        + cross(of_link, relative.position)
        + cross(spin, cross(spin, relative.position) + 2.0 * relative.linear)
        + accelerations.elastic[:3]
    )
    angular = (
        of_link
        + cross(spin, relative.angular)
        + relative.rate_bias
        + apply(relative.rate_matrix, accelerations.elastic[3:])
    )
    return (
        jnp.concatenate([root_angular, angular], axis=1),
        jnp.concatenate([root_linear, linear], axis=1),
    )


def _interface_loads(
    topology: Topology, motion: Motion, wrenches: Sequence[Float[Array, "6"]]
) -> tuple[Float[Array, "3 rfes"], Float[Array, "3 rfes"]]:
    """Forces [N] and moments [N m] of the joints on the free rfes at their middles, in link axes, from the
    wrenches of all joints at the global origin."""
    n = topology.n_links
    columns = [jnp.zeros((3,))] * topology.n_rfes
    forces, moments = list(columns), list(columns)
    for j, sides in enumerate(zip(topology.parents, topology.children)):
        for node, sign in zip(sides, (-1.0, 1.0)):
            # A tree joint acts on rfe 0 of its child, which has no equation here.
            if node < n:
                continue
            k = node - n
            rotation = motion.links.rotation[:, :, topology.link_of(node)]
            where = motion.interfaces.point[:, topology.interfaces.index(k)]
            force = sign * wrenches[j][3:]
            moment = sign * wrenches[j][:3] - cross(where, force)
            forces[k] = forces[k] + apply_transposed(rotation, force)
            moments[k] = moments[k] + apply_transposed(rotation, moment)
    if not columns:
        return jnp.zeros_like(motion.relative.linear), jnp.zeros_like(motion.relative.linear)
    return jnp.stack(forces, axis=1), jnp.stack(moments, axis=1)


def _closings(
    topology: Topology,
    cuts: Closure | None,
    multipliers: Float[Array, " constraints"],
    spatial: dict[int, Array],
    accelerations: Coordinates,
) -> tuple[Array, Array, Array]:
    """Phi and its derivatives, as of `Evaluation`."""
    if cuts is None:
        none = jnp.zeros((0,))
        return none, none, none
    second = cuts.bias + _closing_acceleration(topology, cuts, spatial, accelerations)
    closing = spring_residual(topology, cuts, multipliers, cuts.residual)
    return closing, cuts.rate, spring_residual(topology, cuts, multipliers, second)


def _closing_acceleration(
    topology: Topology, cuts: Closure, spatial: dict[int, Array], accelerations: Coordinates
) -> Array:
    """Phi_q q_ddot: powers of the unit multipliers on the spatial accelerations, right side minus left."""
    parts = []
    for i, j in enumerate(topology.cuts):
        group, place = cuts.place_of(i)
        total = jnp.zeros_like(group.residual[:, place])
        for node, point, sign in (
            (topology.children[j], group.right_point[:, place], 1.0),
            (topology.parents[j], group.left_point[:, place], -1.0),
        ):
            if node != BASE:
                angular = spatial[node][:3]
                linear = spatial[node][3:] + cross(angular, point)
                along = linear if group.forces is None else dot(group.forces[:, :, place], linear[:, None])
                about_axes = dot(group.couples[:, :, place], angular[:, None])
                total = total + sign * jnp.concatenate([along, about_axes])
        parts.append(total)
    if cuts.couplings is not None:
        parts.append(apply_transposed(cuts.couplings.along, accelerations.joints))
    return jnp.concatenate(parts)
