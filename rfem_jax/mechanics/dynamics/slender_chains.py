"""Slender links in the reduced tree: chains of rfes joined by ball joints, eliminated in sweeps along them.

Place in the pipeline: kinematics, elasticity -> **slender_chains** -> dynamics.

A ball joint passes forces but no moments beyond those of its springs, which are applied loads here: what is beyond it
shows as a mass for each direction, a matrix (3, 3).  The articulated-body algorithm (theory (4.11) to (4.13);
Featherstone 2008, ch. 7) runs from the end of a link to its rfe 0, three coordinates a joint at once, in one scan, and
back.

Spatial vectors are in global axes, of every rfe at the joint on its left; the m rfes of a chain are the last axis, in
scans the first one.
"""

from collections.abc import Mapping
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from rfem_jax.mechanics.algebra import vectors
from rfem_jax.mechanics.algebra.vectors import (
    apply,
    apply_transposed,
    cross,
    outer,
    product,
    product_transposed,
    transposed_product,
)
from rfem_jax.mechanics.kinematics.motion import Motion
from rfem_jax.mechanics.model.with_errors import ModelWithErrors


class Chain(NamedTuple):
    """The free rfes of a slender link.

    interfaces: nodes of those that carry joints, by their places in the chain; first (3,): the first joint, from the
    island's point; arm (3, m): from every joint to the next, zero of the last; where (3, m): reference points, from
    the joints; velocity (6, m), inertia (6, 6, m) and load (6, m) as of `InterfaceTree`; bias (3, m): linear
    accelerations over the joints due to rates.
    """

    interfaces: dict[int, int]
    first: Float[Array, "3"]
    arm: Float[Array, "3 m"]
    where: Float[Array, "3 m"]
    velocity: Float[Array, "6 m"]
    inertia: Float[Array, "6 6 m"]
    load: Float[Array, "6 m"]
    bias: Float[Array, "3 m"]


class Eliminated(NamedTuple):
    """What is left of a chain: angular accelerations (m, 3, K) of its rfes; by_linear (m, 3, 3), by which linear
    ones of their joints reduce these; mass (3, 3) and force (3, K) that rfe 0 feels at the first joint."""

    angular: Float[Array, "m 3 columns"]
    by_linear: Float[Array, "m 3 3"]
    mass: Float[Array, "3 3"]
    force: Float[Array, "3 columns"]


def chain_of(actual: ModelWithErrors, motion: Motion, link: int, point: Array, wrenches: tuple[Array, Array]) -> Chain:
    """The chain of a link at its island's `point`, under forces and moments (3, N) on all free rfes in link axes."""
    topology, n = actual.topology, actual.topology.n_links
    a, b = topology.ranges[link]
    axes, origin = motion.links.rotation[:, :, link, None], motion.links.point[:, link, None]
    relative = jax.tree.map(lambda part: part[..., a:b], motion.relative)
    rotation = product(axes, relative.rotation)
    place = origin + apply(axes, relative.position)
    joints = place + vectors.scaled(actual.lever_right[a:b], rotation[:, 0])
    moving = vectors.motion_at_origin(apply(axes, relative.angular), apply(axes, relative.linear), place)
    of_link = motion.links.velocity[:, link, None]
    velocity = of_link + moving
    velocity = vectors.spatial(velocity[:3], velocity[3:] + cross(velocity[:3], joints))
    turning = velocity[:3] - jnp.concatenate([of_link[:3], velocity[:3, :-1]], axis=1)
    force, moment = (apply(axes, part[:, a:b]) for part in wrenches)
    applied = vectors.wrench_at_origin(moment, force, place - joints)
    nodes = np.arange(n + a, n + b)
    inertia, weight, gyroscopic = spatial_bodies(actual, nodes, rotation, place - joints, velocity)
    return Chain(
        interfaces={n + k: k - a for k in topology.interfaces if a <= k < b},
        first=joints[:, 0] - point,
        arm=jnp.concatenate([joints[:, 1:] - joints[:, :-1], jnp.zeros((3, 1))], axis=1),
        where=place - joints,
        velocity=velocity,
        inertia=inertia,
        load=applied + weight - gyroscopic,
        bias=cross(velocity[3:], turning),
    )


def spatial_bodies(
    actual: ModelWithErrors, nodes: np.ndarray, rotation: Array, where: Array, velocity: Array
) -> tuple[Float[Array, "6 6 n"], Float[Array, "6 n"], Float[Array, "6 n"]]:
    """Inertias, weights and gyroscopic wrenches of bodies (theory (4.1), (4.2)), at the points from which `where`
    reaches to their reference points."""
    centre = where + apply(rotation, actual.centre[:, nodes])
    inertia = product_transposed(product(rotation, actual.inertia[:, :, nodes]), rotation)
    mass = jnp.broadcast_to(actual.mass[nodes], inertia.shape[2:])
    inertia = vectors.spatial_inertia(mass, centre, inertia)
    gravity = vectors.scaled(mass, actual.gravity[:, None])
    weight = vectors.wrench_at_origin(jnp.zeros_like(gravity), gravity, centre)
    return inertia, weight, vectors.force_cross(velocity, apply(inertia, velocity))


def inboard(
    chain: Chain,
    inertias: Mapping[int, Array],
    loads: Mapping[int, Array],
    first: Float[Array, " columns"],
) -> tuple[Eliminated, Float[Array, "6 6"], Float[Array, "6 columns"]]:
    """Eliminate a chain for K columns of loads, of which the `first` is that of the applied ones: what remains, and the
    inertia and the load that rfe 0 gets; `inertias` (those that are not zero) and `loads`: of joints and of what is
    outboard, by interfaces, at the island's point."""
    m = chain.where.shape[1]
    inertia, load = jnp.moveaxis(chain.inertia, 2, 0), chain.load.T[:, :, None] * first[None, None]
    joints = chain.first[:, None] + jnp.cumsum(chain.arm, axis=1) - chain.arm
    for node, place in chain.interfaces.items():
        here, back = (np.arange(m) == place)[:, None, None], -joints[:, place]
        if node in inertias:
            inertia = jnp.where(here, inertia + _moved_inertia(inertias[node], back)[None], inertia)
        load = jnp.where(here, load + _moved_load(loads[node], back)[None], load)

    def eliminate(beyond, body):
        (mass, force), (inertia, load, arm, bias) = beyond, body
        moved = cross(arm[:, None], mass)
        coupling = inertia[:3, 3:] + moved
        inverse = vectors.invert_block(inertia[:3, :3] + cross(arm[:, None], moved.T))
        by_linear = product(inverse, coupling)
        angular = product(inverse, load[:3] + cross(arm[:, None], force))
        passed = inertia[3:, 3:] + mass - transposed_product(coupling, by_linear)
        force = load[3:] + force - outer(apply(passed, bias), first) - transposed_product(coupling, angular)
        return (passed, force), (angular, by_linear)

    nothing = jnp.zeros((3, 3)), jnp.zeros((3, len(first)))
    bodies = inertia, load, chain.arm.T, chain.bias.T
    (mass, force), (angular, by_linear) = jax.lax.scan(eliminate, nothing, bodies, reverse=True)
    at_first = jnp.concatenate([jnp.zeros((3, 6)), jnp.concatenate([jnp.zeros((3, 3)), mass], axis=1)])
    passed = jnp.concatenate([jnp.zeros_like(force), force])
    remaining = Eliminated(angular, by_linear, mass, force)
    return remaining, _moved_inertia(at_first, chain.first), _moved_load(passed, chain.first)


def _moved_load(load: Float[Array, "6 columns"], arm: Float[Array, "3"]) -> Float[Array, "6 columns"]:
    """Loads at the point from which `arm` reaches to where they are given."""
    return jnp.concatenate([load[:3] + cross(arm[:, None], load[3:]), load[3:]])


def _moved_inertia(inertia: Float[Array, "6 6"], arm: Float[Array, "3"]) -> Float[Array, "6 6"]:
    """An inertia at the point from which `arm` reaches to where it is given."""
    return _moved_load(_moved_load(inertia, arm).T, arm)


def outboard(
    chain: Chain, remaining: Eliminated, acceleration: Float[Array, "6 columns"], first: Float[Array, " columns"]
) -> Float[Array, "m 6 columns"]:
    """Accelerations of the rfes of a chain, at their joints, from that of rfe 0."""

    def accelerate(linear, joint):
        free, by_linear, arm, bias = joint
        linear = linear + outer(bias, first)
        angular = free - product(by_linear, linear)
        return linear + cross(angular, arm[:, None]), jnp.concatenate([angular, linear])

    joints = remaining.angular, remaining.by_linear, chain.arm.T, chain.bias.T
    return jax.lax.scan(accelerate, _at_first(chain, acceleration), joints)[1]


def _at_first(chain: Chain, acceleration: Float[Array, "6 columns"]) -> Float[Array, "3 columns"]:
    """Linear acceleration of rfe 0 at the first joint."""
    return acceleration[3:] + cross(acceleration[:3], chain.first[:, None])


def on_interface(chain: Chain, place: int, found: Float[Array, "m 6 columns"]) -> Float[Array, "6 columns"]:
    """The acceleration of an rfe of a chain at the island's point."""
    joint = chain.first + jnp.sum(chain.arm[:, :place], axis=1)
    angular, linear = found[place, :3], found[place, 3:]
    return jnp.concatenate([angular, linear - cross(angular, joint[:, None])])


def chain_wrench(
    chain: Chain, remaining: Eliminated, acceleration: Float[Array, "6"], weights: Float[Array, " columns"]
) -> Float[Array, "6"]:
    """Wrench at the island's point that rfe 0 exerts on a chain, for an acceleration of rfe 0 that all columns of loads
    with their `weights` cause."""
    at_first = _at_first(chain, acceleration[:, None])[:, 0]
    force = apply(remaining.mass, at_first) - apply(remaining.force, weights[: remaining.force.shape[1]])
    return vectors.wrench_at_origin(jnp.zeros(3), force, chain.first)


def classical(motion: Motion, chain: Chain, link: int, spatial: Float[Array, "6 m"]) -> tuple[Array, Array]:
    """Angular and linear accelerations (3, m) of the reference points in link axes, from the spatial ones."""
    spin, axes = chain.velocity[:3], motion.links.rotation[:, :, link, None]
    linear = spatial[3:] + cross(spatial[:3], chain.where)
    linear = linear + cross(spin, chain.velocity[3:] + cross(spin, chain.where))
    return apply_transposed(axes, spatial[:3]), apply_transposed(axes, linear)
