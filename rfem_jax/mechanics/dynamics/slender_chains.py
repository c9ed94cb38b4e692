"""Slender links in the reduced tree: chains of rfes joined by ball joints, eliminated in sweeps along them.

Place in the pipeline: kinematics, elasticity -> **slender_chains** -> dynamics.

A ball joint with springs passes forces but no moments beyond those of its springs, which are applied loads here.  The
articulated-body algorithm (theory (4.11), (4.12); Featherstone 2008, ch. 7) runs from the end of a link to its rfe 0,
three coordinates a joint at once, in one scan, and back.

Spatial vectors are in global axes at the point of the link's island; the m rfes of a chain are the last axis, in scans
the first one.
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

    interfaces: nodes of those that carry joints, by their places in the chain; where (3, m): reference points, from the
    island's point; velocity (6, m), inertia (6, 6, m) and load (6, m) as of `InterfaceTree`; axes (6, 3, m): of unit
    rotations about the joints on their left; bias (6, m): accelerations over these due to rates.
    """

    interfaces: dict[int, int]
    where: Float[Array, "3 m"]
    velocity: Float[Array, "6 m"]
    inertia: Float[Array, "6 6 m"]
    load: Float[Array, "6 m"]
    axes: Float[Array, "6 3 m"]
    bias: Float[Array, "6 m"]


class Eliminated(NamedTuple):
    """What the sweep back needs of every joint: rate (m, 3, K) of its rotation without accelerations of its left rfe,
    and by_acceleration (m, 3, 6), by which these reduce it."""

    rate: Float[Array, "m 3 columns"]
    by_acceleration: Float[Array, "m 3 6"]


def chain_of(actual: ModelWithErrors, motion: Motion, link: int, point: Array, wrenches: tuple[Array, Array]) -> Chain:
    """The chain of a link at its island's `point`, under forces and moments (3, N) on all free rfes in link axes."""
    topology, n = actual.topology, actual.topology.n_links
    a, b = topology.ranges[link]
    axes, origin = motion.links.rotation[:, :, link, None], motion.links.point[:, link, None]
    relative = jax.tree.map(lambda part: part[..., a:b], motion.relative)
    rotation = product(axes, relative.rotation)
    place = origin + apply(axes, relative.position)
    moving = vectors.motion_at_origin(apply(axes, relative.angular), apply(axes, relative.linear), place)
    of_link = motion.links.velocity[:, link, None]
    left, velocity = (_shifted(one, point[:, None]) for one in (of_link, of_link + moving))
    where = place - point[:, None]
    force, moment = (apply(axes, part[:, a:b]) for part in wrenches)
    applied = vectors.wrench_at_origin(moment, force, where)
    inertia, load = spatial_bodies(actual, np.arange(n + a, n + b), rotation, where, velocity, applied)
    face = where + vectors.scaled(actual.lever_right[a:b], rotation[:, 0])
    before = jnp.concatenate([left[:3], velocity[:3, :-1]], axis=1)
    of_face = velocity[3:] + cross(velocity[:3], face)
    turning = jnp.broadcast_to(jnp.asarray(vectors.IDENTITY[:, :, None]), (3, 3, b - a))
    return Chain(
        interfaces={n + k: k - a for k in topology.interfaces if a <= k < b},
        where=where,
        velocity=velocity,
        inertia=inertia,
        load=load,
        axes=jnp.concatenate([turning, vectors.cross_matrix(face)]),
        bias=vectors.spatial(jnp.zeros_like(face), cross(of_face, velocity[:3] - before)),
    )


def spatial_bodies(
    actual: ModelWithErrors, nodes: np.ndarray, rotation: Array, where: Array, velocity: Array, applied: Array
) -> tuple[Float[Array, "6 6 n"], Float[Array, "6 n"]]:
    """Inertias of bodies, and what acts on them apart from joints less the gyroscopic wrench (theory (4.1), (4.2)), at
    the points from which `where` reaches to their reference points; `applied`: wrenches (6, n) there."""
    centre = where + apply(rotation, actual.centre[:, nodes])
    inertia = product_transposed(product(rotation, actual.inertia[:, :, nodes]), rotation)
    mass = jnp.broadcast_to(actual.mass[nodes], inertia.shape[2:])
    inertia = vectors.spatial_inertia(mass, centre, inertia)
    gravity = vectors.scaled(mass, actual.gravity[:, None])
    weight = vectors.wrench_at_origin(jnp.zeros_like(gravity), gravity, centre)
    gyroscopic = vectors.force_cross(velocity, apply(inertia, velocity))
    return inertia, applied + weight - gyroscopic


def _shifted(motion: Array, point: Array) -> Array:
    return vectors.spatial(motion[:3], motion[3:] + cross(motion[:3], point))


def inboard(
    chain: Chain, inertias: Mapping[int, Array], loads: Mapping[int, Array], first: Float[Array, " columns"]
) -> tuple[Eliminated, Float[Array, "6 6"], Float[Array, "6 columns"]]:
    """Eliminate a chain for K columns of loads, of which the `first` is that of the applied ones: the joints, and the
    inertia and the load that rfe 0 gets; `inertias` and `loads`: of joints and what is outboard, by interfaces."""
    inertia, load = jnp.moveaxis(chain.inertia, 2, 0), outer(chain.load.reshape(-1), first)
    load = jnp.moveaxis(load.reshape((6, len(inertia), len(first))), 1, 0)
    for node, place in chain.interfaces.items():
        here = (np.arange(len(inertia)) == place)[:, None, None]
        inertia = jnp.where(here, inertia + inertias[node][None], inertia)
        load = jnp.where(here, load + loads[node][None], load)

    def eliminate(beyond, body):
        inertia, load = beyond[0] + body[0], beyond[1] + body[1]
        axes, bias = body[2:]
        force = product(inertia, axes)
        inverse = vectors.invert_block(transposed_product(axes, force))
        by_acceleration = product_transposed(inverse, force)
        rate = product(inverse, transposed_product(axes, load))
        passed = inertia - product(force, by_acceleration)
        load = load - outer(apply(passed, bias), first) - product(force, rate)
        return (passed, load), Eliminated(rate, by_acceleration)

    nothing = jnp.zeros((6, 6)), jnp.zeros((6, len(first)))
    bodies = inertia, load, jnp.moveaxis(chain.axes, 2, 0), chain.bias.T
    (inertia, load), eliminated = jax.lax.scan(eliminate, nothing, bodies, reverse=True)
    return eliminated, inertia, load


def outboard(
    chain: Chain, eliminated: Eliminated, acceleration: Float[Array, "6 columns"], first: Float[Array, " columns"]
) -> Float[Array, "m 6 columns"]:
    """Accelerations of the rfes of a chain from that of rfe 0."""

    def accelerate(acceleration, joint):
        (rate, by_acceleration), axes, bias = joint
        given = acceleration + outer(bias, first)
        acceleration = given + product(axes, rate - product(by_acceleration, given))
        return acceleration, acceleration

    joints = eliminated, jnp.moveaxis(chain.axes, 2, 0), chain.bias.T
    return jax.lax.scan(accelerate, acceleration, joints)[1]


def classical(motion: Motion, chain: Chain, link: int, spatial: Float[Array, "6 m"]) -> tuple[Array, Array]:
    """Angular and linear accelerations (3, m) of the reference points in link axes, from the spatial ones."""
    spin, axes = chain.velocity[:3], motion.links.rotation[:, :, link, None]
    linear = spatial[3:] + cross(spatial[:3], chain.where)
    linear = linear + cross(spin, chain.velocity[3:] + cross(spin, chain.where))
    return apply_transposed(axes, spatial[:3]), apply_transposed(axes, linear)
