"""The equations of motion as a balance: what is left over for given accelerations and multipliers.

Place in the pipeline: kinematics, elasticity, cut_joints, loads -> **balance** -> implicit methods.

`dynamics` solves for the accelerations; here they are given, and the joint loads follow by
Newton-Euler from the chains' ends to the base.  What does not balance is the moment about every
hinge, the generalised forces on every free rfe, and the closure of every cut joint
(theory (3.11)).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from rfem_jax.mechanics import algebra, loads
from rfem_jax.mechanics.algebra import apply, apply_transposed, cross, dot
from rfem_jax.mechanics.cut_joints import Closure, closure
from rfem_jax.mechanics.elasticity import generalised_forces
from rfem_jax.mechanics.inputs import DriveInput
from rfem_jax.mechanics.kinematics import Motion, motion, spread
from rfem_jax.mechanics.model import BASE, Coordinates, State
from rfem_jax.mechanics.realisation import Realisation


class Balance(NamedTuple):
    """What is left over at one instant.

    hinge (L,): drive minus moment about every tree joint's hinge [N m]; force, moment (3, N): on the
    free rfes at their middles, in link axes and about the axes of the angles' rates [N, N m]; closing,
    closing_rate, closing_acceleration (5, C): Phi and its derivatives; angular, linear (3, nodes):
    accelerations of the nodes in link axes; wrenches: of all joints at the global origin; motion, closure,
    multipliers: passed on; dissipated: power of the dampers [W].
    """

    hinge: Array
    force: Array
    moment: Array
    closing: Array
    closing_rate: Array
    closing_acceleration: Array
    angular: Array
    linear: Array
    motion: Motion
    closure: Closure | None
    multipliers: Array
    wrenches: list[Array]
    dissipated: Array


def evaluate_balance(
    realised: Realisation,
    state: State,
    accelerations: Coordinates,
    multipliers: Array,
    drive: DriveInput,
    scale: Array,
) -> Balance:
    """What is left over for given accelerations of the coordinates and multipliers (5, C) [N].

    `state` is taken with prescribed values already imposed; `scale` [m] as in `closure`.
    """
    with jax.named_scope("balance"):
        topology = realised.topology
        n = topology.n_links
        now = motion(realised, state)
        cuts = closure(realised, now, scale)
        spatial, carried = _spatial_accelerations(realised, now, state, accelerations)
        angular, linear = _node_accelerations(topology, now, spatial, accelerations)
        inertial = loads.inertial_loads(realised, now, angular, linear)
        wrenches = loads.chain_wrenches(realised, now, cuts, multipliers, inertial)
        hinge = -dot(now.axis, jnp.stack(wrenches[:n], axis=1))
        if drive.moment is not None:
            driven = (np.arange(n) == topology.driven).reshape((-1,) + (1,) * (hinge.ndim - 1))
            hinge = hinge + jnp.where(driven, drive.moment[None], 0.0)
        elastic, dissipated = generalised_forces(realised, state, now.relative)
        on_force, on_moment = _carried_loads(topology, now, wrenches)
        moment = apply_transposed(now.relative.rate_matrix, on_moment - inertial[1][:, n:])
        nothing = jnp.zeros((5, 0) + hinge.shape[1:])
        return Balance(
            hinge=hinge,
            force=elastic[:3] + on_force - inertial[0][:, n:],
            moment=elastic[3:] + moment,
            closing=nothing if cuts is None else cuts.residual,
            closing_rate=nothing if cuts is None else cuts.rate,
            closing_acceleration=nothing
            if cuts is None
            else cuts.bias + _along_closure(topology, cuts, {**spatial, **carried}),
            angular=angular,
            linear=linear,
            motion=now,
            closure=cuts,
            multipliers=multipliers,
            wrenches=wrenches,
            dissipated=dissipated,
        )


def _spatial_accelerations(realised, now: Motion, state: State, accelerations: Coordinates):
    """Spatial accelerations (6,) at the global origin of the links and of the carriers, by node."""
    topology = realised.topology
    n = topology.n_links
    bias = algebra.motion_cross(now.hinges.velocity, now.axis * state.velocity.angles[None])
    along = now.axis * accelerations.angles[None] + bias
    links: dict[int, Array] = {}
    carried: dict[int, Array] = {}

    def of(node: int):
        if node == BASE:
            return 0.0
        if node < n:
            return links[node]
        if node not in carried:
            carried[node] = _carrier_acceleration(topology, now, links, node, accelerations)
        return carried[node]

    for l in range(n):
        links[l] = of(topology.parents[l]) + along[:, l]
    for k in topology.carriers:
        of(n + k)
    return links, carried


def _carrier_acceleration(topology, now: Motion, links, node: int, accelerations: Coordinates):
    """Spatial acceleration of a free rfe at the global origin."""
    k, l = node - topology.n_links, topology.link_of(node)
    rotation, origin = now.links.rotation[:, :, l], now.links.point[:, l]
    relative = jax.tree.map(lambda x: x[..., k], now.relative)
    turn = (
        apply(relative.rate_matrix, accelerations.elastic[3:, k]) + relative.rate_bias
    )
    moved = (
        accelerations.elastic[:3, k]
        - cross(turn, relative.position)
        - cross(relative.angular, relative.linear)
    )
    turn = apply(rotation, turn)
    rate = algebra.spatial(turn, apply(rotation, moved) + cross(origin, turn))
    own = now.carriers.velocity[:, topology.carriers.index(k)] - now.links.velocity[:, l]
    return links[l] + algebra.motion_cross(now.links.velocity[:, l], own) + rate


def _node_accelerations(topology, now: Motion, spatial, accelerations: Coordinates):
    """Angular and linear accelerations (3, nodes) of the reference points, in link axes."""
    of_links = jnp.stack([spatial[l] for l in range(topology.n_links)], axis=1)
    rotation, origin = now.links.rotation, now.links.point
    spin, velocity = now.links.velocity[:3], now.links.velocity[3:]
    moved = of_links[3:] + cross(of_links[:3], origin)
    moved = moved + cross(spin, velocity + cross(spin, origin))
    root_angular = apply_transposed(rotation, of_links[:3])
    root_linear = apply_transposed(rotation, moved)
    spin = spread(topology, apply_transposed(rotation, spin))
    turn = spread(topology, root_angular)
    relative = now.relative
    linear = (
        spread(topology, root_linear)
        + cross(turn, relative.position)
        + cross(spin, cross(spin, relative.position) + 2.0 * relative.linear)
        + accelerations.elastic[:3]
    )
    angular = (
        turn
        + cross(spin, relative.angular)
        + relative.rate_bias
        + apply(relative.rate_matrix, accelerations.elastic[3:])
    )
    return (
        jnp.concatenate([root_angular, angular], axis=1),
        jnp.concatenate([root_linear, linear], axis=1),
    )


def _carried_loads(topology, now: Motion, wrenches):
    """Forces and moments (3, N) of the joints on the free rfes at their middles, in link axes."""
    n = topology.n_links
    columns = [jnp.zeros((3,) + now.relative.linear.shape[2:])] * topology.n_rfes
    forces, moments = list(columns), list(columns)
    for j, sides in enumerate(zip(topology.parents, topology.children)):
        for node, sign in zip(sides, (-1.0, 1.0)):
            # A tree joint acts on rfe 0 of its child, which has no equation here.
            if node < n:
                continue
            k = node - n
            turn = now.links.rotation[:, :, topology.link_of(node)]
            where = now.carriers.point[:, topology.carriers.index(k)]
            force = sign * wrenches[j][3:]
            moment = sign * wrenches[j][:3] - cross(where, force)
            forces[k] = forces[k] + apply_transposed(turn, force)
            moments[k] = moments[k] + apply_transposed(turn, moment)
    if not columns:
        return jnp.zeros_like(now.relative.linear), jnp.zeros_like(now.relative.linear)
    return jnp.stack(forces, axis=1), jnp.stack(moments, axis=1)


def _along_closure(topology, cuts: Closure, spatial) -> Array:
    """Phi_q q_ddot (5, C): accelerations of the joint centres, and powers of unit couples on the
    angular ones, right side minus left."""
    columns = []
    for i, j in enumerate(topology.cuts):
        along = jnp.zeros_like(cuts.residual[:, i])
        for node, centre, sign in (
            (topology.children[j], cuts.right_centre[:, i], 1.0),
            (topology.parents[j], cuts.centre[:, i], -1.0),
        ):
            if node != BASE:
                turn = spatial[node][:3]
                moved = spatial[node][3:] + cross(turn, centre)
                about = dot(cuts.couples[:, :, i], turn[:, None])
                along = along + sign * jnp.concatenate([moved, about])
        columns.append(along)
    return jnp.stack(columns, axis=1)
