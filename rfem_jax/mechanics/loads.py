"""Loads in all joints by Newton-Euler from the chains' ends to the base, energies and balances.

Place in the pipeline: dynamics -> **loads** -> simulation (metrics, Run).

A joint's load is the force and the moment that the parent side exerts on the child link, about the
hinge's centre, in the hinge frame (y along the hinge; in L at a cut joint), in N and N m (MODEL
section 7).  A drive that is a given moment is an external load and not part of it; the moment that
enforces a prescribed angle is.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from rfem_jax.mechanics import algebra, elasticity
from rfem_jax.mechanics.algebra import apply, apply_transposed, cross, dot
from rfem_jax.mechanics.dynamics import Accelerations, DriveInput
from rfem_jax.mechanics.kinematics import Motion, motion, node_frames
from rfem_jax.mechanics.model import BASE, Coordinates, State
from rfem_jax.mechanics.realisation import Realisation


class JointLoads(NamedTuple):
    """Force [N] and moment [N m] (3, joints) of all joints in their hinge frames."""

    force: Array
    moment: Array


class Energies(NamedTuple):
    """Kinetic, elastic and gravity energy [J]; gravity's zero level is the datum."""

    kinetic: Array
    elastic: Array
    gravity: Array


def joint_wrenches(realised: Realisation, result: Accelerations) -> list[Array]:
    """Wrenches (6,) at the global origin that the parent side of every joint exerts on the child,
    the moment of a drive included."""
    topology = realised.topology
    force, moment = _inertial_loads(realised, result)
    wrenches: dict[int, Array] = {}
    for i, j in enumerate(topology.cuts):
        multipliers = result.multipliers[5 * i : 5 * i + 5]
        origin = jnp.zeros_like(result.closures[i].centre)
        wrenches[j] = apply(result.closures[i].wrenches("child", origin), multipliers)
    for l in reversed(range(topology.n_links)):
        link, (a, b) = result.motion.links[l], topology.ranges[l]
        arms = result.motion.relative.position[:, a:b]
        n = topology.n_links
        total = force[:, l] + jnp.sum(force[:, n + a : n + b], axis=1)
        couple = moment[:, l] + jnp.sum(
            moment[:, n + a : n + b] + cross(arms, force[:, n + a : n + b]), axis=1
        )
        wrench = algebra.wrench_at_origin(
            apply(link.rotation, couple), apply(link.rotation, total), link.origin
        )
        for j in [*range(l + 1, n), *topology.cuts]:
            if topology.parents[j] != BASE and topology.link_of(topology.parents[j]) == l:
                wrench = wrench + wrenches[j]
        for j in topology.cuts:
            if topology.link_of(topology.children[j]) == l:
                wrench = wrench - wrenches[j]
        wrenches[l] = wrench
    return [wrenches[j] for j in range(len(topology.joints))]


def joint_loads(
    realised: Realisation, result: Accelerations, drive: DriveInput
) -> JointLoads:
    """Loads of all joints in their hinge frames."""
    with jax.named_scope("joint_loads"):
        topology = realised.topology
        forces, moments = [], []
        for j, wrench in enumerate(joint_wrenches(realised, result)):
            if j < topology.n_links:
                link = result.motion.links[j]
                rotation, centre = link.hinge_rotation, link.hinge_centre
            else:
                closure = result.closures[j - topology.n_links]
                rotation, centre = closure.rotation, closure.centre
            moment = apply_transposed(rotation, wrench[:3] - cross(centre, wrench[3:]))
            if j == topology.driven and drive.moment is not None:
                moment = jnp.stack([moment[0], moment[1] - drive.moment, moment[2]])
            forces.append(apply_transposed(rotation, wrench[3:]))
            moments.append(moment)
        return JointLoads(jnp.stack(forces, axis=1), jnp.stack(moments, axis=1))


def _inertial_loads(realised: Realisation, result: Accelerations):
    """Rate of momentum minus gravity of every node, at its reference point, in link axes."""
    topology, now = realised.topology, result.motion
    n = topology.n_links
    trailing = (1,) * (result.angular.ndim - 2)

    def like(values):
        return values.reshape(values.shape + trailing)

    link = topology.link_of_rfe.astype(int)
    rotation = jnp.stack([frame.rotation for frame in now.links], axis=2)
    spin = jnp.stack([frame.velocity[:3] for frame in now.links], axis=1)
    gravity = realised.gravity.reshape((3, 1) + trailing) + jnp.zeros_like(spin)
    spin, gravity = apply_transposed(rotation, spin), apply_transposed(rotation, gravity)
    spin = jnp.concatenate([spin, spin[:, link] + now.relative.angular], axis=1)
    gravity = jnp.concatenate([gravity, gravity[:, link]], axis=1)
    identity = jnp.asarray(algebra.IDENTITY).reshape((3, 3, 1) + trailing)
    roots = jnp.broadcast_to(identity, (3, 3, n) + rotation.shape[3:])
    turn = jnp.concatenate([roots, now.relative.rotation], axis=2)

    centre = apply(turn, like(realised.centre))
    acceleration = (
        result.linear + cross(result.angular, centre) + cross(spin, cross(spin, centre)) - gravity
    )
    force = like(realised.mass)[None] * acceleration
    body_spin, body_turn = apply_transposed(turn, spin), apply_transposed(turn, result.angular)
    inertia = like(realised.inertia)
    rate = apply(inertia, body_turn) + cross(body_spin, apply(inertia, body_spin))
    return force, apply(turn, rate) + cross(centre, force)


def velocities(realised: Realisation, now: Motion):
    """Rotation, centre of mass, its velocity and angular velocity (3, nodes) in global axes."""
    topology = realised.topology
    link = topology.link_of_rfe.astype(int)
    rotation, point = node_frames(realised, now)
    frames = rotation[:, :, : topology.n_links]
    spin = jnp.stack([frame.velocity[:3] for frame in now.links], axis=1)
    origin_velocity = jnp.stack([frame.velocity[3:] for frame in now.links], axis=1)
    spin_all = jnp.concatenate(
        [spin, spin[:, link] + apply(frames[:, :, link], now.relative.angular)], axis=1
    )
    carried = jnp.concatenate([origin_velocity, origin_velocity[:, link]], axis=1)
    carrier_spin = jnp.concatenate([spin, spin[:, link]], axis=1)
    relative = jnp.concatenate(
        [jnp.zeros_like(spin), apply(frames[:, :, link], now.relative.linear)], axis=1
    )
    arm = apply(rotation, realised.centre)
    velocity = carried + cross(carrier_spin, point) + relative + cross(spin_all, arm)
    return rotation, point + arm, velocity, spin_all


def momentum(realised: Realisation, state: State) -> tuple[Array, Array]:
    """Total linear momentum [N s] and angular momentum about the global origin [N m s]."""
    rotation, centre, velocity, spin = velocities(realised, motion(realised, state))
    linear = realised.mass[None] * velocity
    spin_momentum = apply(rotation, apply(realised.inertia, apply_transposed(rotation, spin)))
    return jnp.sum(linear, axis=1), jnp.sum(spin_momentum + cross(centre, linear), axis=1)


def energies(realised: Realisation, state: State) -> Energies:
    """Kinetic, elastic and gravity energy at one instant."""
    now = motion(realised, state)
    rotation, centre, velocity, spin = velocities(realised, now)
    body_spin = apply_transposed(rotation, spin)
    translation = realised.mass * dot(velocity, velocity)
    rotational = dot(body_spin, apply(realised.inertia, body_spin))
    above = centre - realised.datum[:, None]
    height = -dot(jnp.broadcast_to(realised.gravity[:, None], centre.shape), above)
    return Energies(
        kinetic=0.5 * jnp.sum(translation + rotational),
        elastic=elasticity.elastic_energy(realised, state.position),
        gravity=jnp.sum(realised.mass * height),
    )


def momentum_residual(
    realised: Realisation, state: State, result: Accelerations
) -> tuple[Array, Array]:
    """Base reactions + gravity - d/dt of the total momentum: force (3,) and moment (3,).

    The rate of momentum comes from differentiating the momenta along (q_dot, q_ddot), independently
    of the recursion that gives the reactions.
    """
    topology = realised.topology

    def along(position, velocity):
        return momentum(realised, State(position, velocity))

    tangents = (state.velocity, result.coordinates)
    _, (linear_rate, angular_rate) = jax.jvp(along, (state.position, state.velocity), tangents)
    wrenches = joint_wrenches(realised, result)
    base = sum(wrenches[j] for j in range(len(topology.joints)) if topology.parents[j] == BASE)
    _, centre, _, _ = velocities(realised, result.motion)
    weight = realised.mass[None] * realised.gravity[:, None]
    return (
        base[3:] + jnp.sum(weight, axis=1) - linear_rate,
        base[:3] + jnp.sum(cross(centre, weight), axis=1) - angular_rate,
    )


def static_state(position: Coordinates) -> State:
    """A state at rest."""
    return State(position, jax.tree.map(jnp.zeros_like, position))
