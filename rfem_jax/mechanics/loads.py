"""Loads in all joints, energies and the balance of momentum.

Place in the pipeline: dynamics -> **loads** -> simulation (metrics, Run).

A joint's load is the force and the moment that the parent side exerts on the child link, about the
hinge's centre, in the hinge frame (y along the hinge; in L at a cut joint), in N and N m (theory
(8.1) to (8.3)).  A drive that is a given moment is an external load and not part of it; the moment that
enforces a prescribed angle is.

There are two ways to them, and every run compares them with the balance of momentum: `chain_loads`
is Newton-Euler over all rfes from the chains' ends to the base; `joint_loads` uses the equations of
the rfes 0 alone, whose elastic wrenches the accelerations needed anyway.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from rfem_jax.mechanics import algebra, elasticity
from rfem_jax.mechanics.algebra import apply, apply_transposed, cross, dot
from rfem_jax.mechanics.cut_joints import Closure
from rfem_jax.mechanics.dynamics import Accelerations, link_axes
from rfem_jax.mechanics.inputs import DriveInput
from rfem_jax.mechanics.kinematics import Motion, all_frames, motion, spread, total
from rfem_jax.mechanics.model import BASE, Coordinates, State, Topology
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


class Resting(NamedTuple):
    """What `chain_loads` reads of a mechanism at rest."""

    motion: Motion
    closure: Closure | None
    multipliers: Array


def joint_loads(realised: Realisation, result: Accelerations, drive: DriveInput) -> JointLoads:
    """Loads of all joints by the equations of motion of the rfes 0 (theory (8.4))."""
    with jax.named_scope("joint_loads"):
        topology, skeleton = realised.topology, result.skeleton
        n = topology.n_links
        own = apply(skeleton.inertia[:, :, :n], result.spatial) - skeleton.load[:, :n]
        wrenches: dict[int, Array] = {}
        for l in reversed(range(n)):
            wrench, point = own[:, l], skeleton.point[:, l]
            for j in range(l + 1, n):
                if topology.parents[j] == l:
                    wrench = wrench + wrenches[j]
            for i, j in enumerate(topology.cuts):
                if topology.parents[j] == l:
                    unit = result.closure.wrenches(i, "parent", point)
                    wrench = wrench + apply(unit, result.multipliers[:, i])
                if topology.children[j] == l:
                    unit = result.closure.wrenches(i, "child", point)
                    wrench = wrench - apply(unit, result.multipliers[:, i])
            wrenches[l] = wrench
        links = jnp.stack([wrenches[l] for l in range(n)], axis=1)
        hinges = result.motion.hinges
        moment = links[:3] - cross(hinges.point - skeleton.point[:, :n], links[3:])
        return _in_hinge_frames(topology, result, links[3:], moment, drive)


def chain_loads(
    realised: Realisation, result: Accelerations | Resting, angular, linear, drive: DriveInput
) -> tuple[JointLoads, Array]:
    """Loads of all joints by Newton-Euler over all rfes from the chains' ends to the base, for
    accelerations (3, nodes) in link axes, and the wrench (6,) at the origin that the base exerts."""
    with jax.named_scope("chain_loads"):
        inertial = inertial_loads(realised, result.motion, angular, linear)
        wrenches = chain_wrenches(
            realised, result.motion, result.closure, result.multipliers, inertial
        )
        loads = loads_of_wrenches(realised.topology, result, wrenches, drive)
        return loads, base_wrench(realised.topology, wrenches)


def loads_of_wrenches(topology: Topology, result, wrenches, drive: DriveInput) -> JointLoads:
    """Loads of all joints from the wrenches at the global origin of `chain_wrenches`."""
    links = jnp.stack(wrenches[: topology.n_links], axis=1)
    moment = links[:3] - cross(result.motion.hinges.point, links[3:])
    return _in_hinge_frames(topology, result, links[3:], moment, drive)


def _in_hinge_frames(topology: Topology, result, force, moment, drive: DriveInput) -> JointLoads:
    """Forces and moments (3, L) of the tree joints about their centres, in hinge frames; cut joints
    from the multipliers."""
    rotation = result.motion.hinges.rotation
    force, moment = apply_transposed(rotation, force), apply_transposed(rotation, moment)
    if drive.moment is not None:
        is_driven = jnp.arange(topology.n_links) == topology.driven
        is_driven = is_driven.reshape((-1,) + (1,) * (force.ndim - 2))
        about_hinge = moment[1] - jnp.where(is_driven, drive.moment[None], 0.0)
        moment = jnp.stack([moment[0], about_hinge, moment[2]])
    cuts = result.closure
    if cuts is not None:
        arm = cuts.right_centre - cuts.centre
        couple = dot(jnp.swapaxes(cuts.couples, 0, 1), result.multipliers[3:, None])
        couple = couple + cross(arm, result.multipliers[:3])
        force = jnp.concatenate(
            [force, apply_transposed(cuts.rotation, result.multipliers[:3])], axis=1
        )
        moment = jnp.concatenate([moment, apply_transposed(cuts.rotation, couple)], axis=1)
    return JointLoads(force, moment)


def chain_wrenches(
    realised: Realisation, now: Motion, cuts: Closure | None, multipliers: Array, inertial
) -> list[Array]:
    """Wrenches (6,) at the global origin that the parent side of every joint exerts on the child,
    the moment of a drive included; `inertial` from `inertial_loads`."""
    topology = realised.topology
    n = topology.n_links
    force, moment = inertial
    arms = cross(now.relative.position, force[:, n:])
    own_force = force[:, :n] + total(topology, force[:, n:])
    own_moment = moment[:, :n] + total(topology, moment[:, n:] + arms)
    own = algebra.wrench_at_origin(
        apply(now.links.rotation, own_moment),
        apply(now.links.rotation, own_force),
        now.links.point,
    )
    wrenches = dict(zip(topology.cuts, cut_wrenches(cuts, multipliers)))
    for l in reversed(range(n)):
        wrench = own[:, l]
        for j in [*range(l + 1, n), *topology.cuts]:
            if topology.parents[j] != BASE and topology.link_of(topology.parents[j]) == l:
                wrench = wrench + wrenches[j]
        for j in topology.cuts:
            if topology.link_of(topology.children[j]) == l:
                wrench = wrench - wrenches[j]
        wrenches[l] = wrench
    return [wrenches[j] for j in range(len(topology.joints))]


def cut_wrenches(cuts: Closure | None, multipliers: Array) -> list[Array]:
    """Wrenches (6,) at the global origin that the parent sides of the cut joints exert on the children."""
    if cuts is None:
        return []
    origin = jnp.zeros_like(cuts.centre[:, 0])
    return [
        apply(cuts.wrenches(i, "child", origin), multipliers[:, i]) for i in range(multipliers.shape[1])
    ]


def inertial_loads(realised: Realisation, now: Motion, angular: Array, linear: Array):
    """Rate of momentum minus gravity of every node: force and moment (3, nodes) at its reference
    point, in link axes; accelerations (3, nodes) likewise."""
    topology = realised.topology
    spin, gravity = link_axes(realised, now)
    spin = jnp.concatenate([spin, spread(topology, spin) + now.relative.angular], axis=1)
    gravity = jnp.concatenate([gravity, spread(topology, gravity)], axis=1)
    identity = jnp.broadcast_to(
        jnp.asarray(algebra.IDENTITY)[:, :, None], (3, 3, topology.n_links)
    )
    turn = jnp.concatenate([identity, now.relative.rotation], axis=2)
    centre = apply(turn, realised.centre)
    of_centre = linear + cross(angular, centre) + cross(spin, cross(spin, centre))
    force = realised.mass[None] * (of_centre - gravity)
    body_spin, body_turn = apply_transposed(turn, spin), apply_transposed(turn, angular)
    inertia = realised.inertia
    rate = apply(inertia, body_turn) + cross(body_spin, apply(inertia, body_spin))
    return force, apply(turn, rate) + cross(centre, force)


def velocities(realised: Realisation, now: Motion):
    """Rotation, centre of mass, its velocity and angular velocity (3, nodes) in global axes."""
    topology = realised.topology
    rotation, point = all_frames(topology, now)
    of_links = spread(topology, now.links.rotation)
    spin, at_origin = now.links.velocity[:3], now.links.velocity[3:]
    carrier_spin = jnp.concatenate([spin, spread(topology, spin)], axis=1)
    carrier = jnp.concatenate([at_origin, spread(topology, at_origin)], axis=1)
    none = jnp.zeros_like(spin)
    turning = jnp.concatenate([none, apply(of_links, now.relative.angular)], axis=1)
    moving = jnp.concatenate([none, apply(of_links, now.relative.linear)], axis=1)
    arm = apply(rotation, realised.centre)
    velocity = carrier + cross(carrier_spin, point) + moving + cross(carrier_spin + turning, arm)
    return rotation, point + arm, velocity, carrier_spin + turning


def momentum(realised: Realisation, state: State) -> tuple[Array, Array]:
    """Total linear momentum [N s] and angular momentum about the global origin [N m s]."""
    rotation, centre, velocity, spin = velocities(realised, motion(realised, state))
    linear = realised.mass[None] * velocity
    spin_momentum = apply(rotation, apply(realised.inertia, apply_transposed(rotation, spin)))
    return jnp.sum(linear, axis=1), jnp.sum(spin_momentum + cross(centre, linear), axis=1)


def energies(realised: Realisation, state: State) -> Energies:
    """Kinetic, elastic and gravity energy at one instant."""
    rotation, centre, velocity, spin = velocities(realised, motion(realised, state))
    body_spin = apply_transposed(rotation, spin)
    translation = realised.mass * dot(velocity, velocity)
    rotational = dot(body_spin, apply(realised.inertia, body_spin))
    above = centre - realised.datum[:, None]
    return Energies(
        kinetic=0.5 * jnp.sum(translation + rotational),
        elastic=elasticity.elastic_energy(realised, state.position),
        gravity=-jnp.sum(realised.mass * dot(realised.gravity[:, None], above)),
    )


def base_wrench(topology: Topology, wrenches) -> Array:
    """Wrench (6,) at the global origin that the base exerts, from those of all joints."""
    return sum(w for w, parent in zip(wrenches, topology.parents) if parent == BASE)


def momentum_residual(
    realised: Realisation, state: State, accelerations: Coordinates, base: Array
) -> tuple[Array, Array]:
    """Base reactions + gravity - d/dt of the total momentum: force (3,) and moment (3,).

    The rate of momentum comes from differentiating the momenta along (q_dot, q_ddot), independently
    of the equations that give the reactions `base` (6,).
    """

    def along(position, velocity):
        return momentum(realised, State(position, velocity))

    tangents = (state.velocity, accelerations)
    _, (linear_rate, angular_rate) = jax.jvp(along, (state.position, state.velocity), tangents)
    _, centre, _, _ = velocities(realised, motion(realised, state))
    weight = realised.mass[None] * realised.gravity[:, None]
    return (
        base[3:] + jnp.sum(weight, axis=1) - linear_rate,
        base[:3] + jnp.sum(cross(centre, weight), axis=1) - angular_rate,
    )


def static_state(position: Coordinates) -> State:
    """A state at rest."""
    return State(position, jax.tree.map(jnp.zeros_like, position))
