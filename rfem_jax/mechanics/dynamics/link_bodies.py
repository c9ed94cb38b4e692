"""The rigid finite elements of one link as bodies in global axes, and places on them.

Place in the pipeline: dynamics, loads -> **link_bodies** -> link_pieces, link_attachments, section_loads.

Places x [m] of sections are on the axis of an rfe, from its reference point.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from rfem_jax.mechanics.algebra import vectors
from rfem_jax.mechanics.algebra.vectors import apply, cross, product, product_transposed
from rfem_jax.mechanics.dynamics.slender_forces import Moving
from rfem_jax.mechanics.model.with_errors import ModelWithErrors


class LinkBodies(NamedTuple):
    """Kinematics of bodies in global axes: rotation, reference point, angular velocity, accelerations."""

    rotation: Float[Array, "3 3 n"]
    point: Float[Array, "3 n"]
    spin: Float[Array, "3 n"]
    angular: Float[Array, "3 n"]
    linear: Float[Array, "3 n"]

    def at(self, indices: Sequence[int]) -> "LinkBodies":
        """Some of the bodies, also repeatedly."""
        return LinkBodies(*(jnp.stack([part[..., i] for i in indices], axis=-1) for part in self))


def bodies_of_link(actual: ModelWithErrors, now: Moving, link: int) -> LinkBodies:
    """The rfes of a link."""
    topology = actual.topology
    a, b = topology.ranges[link]
    links, relative = now.motion.links, now.motion.relative
    axes, origin, spin = links.rotation[:, :, link, None], links.point[:, link, None], links.velocity[:3, link, None]
    free = slice(topology.n_links + a, topology.n_links + b)

    def of_nodes(values: Array) -> Array:
        return apply(axes, jnp.concatenate([values[:, link, None], values[:, free]], axis=1))

    return LinkBodies(
        rotation=jnp.concatenate([axes, product(axes, relative.rotation[:, :, a:b])], axis=2),
        point=jnp.concatenate([origin, origin + apply(axes, relative.position[:, a:b])], axis=1),
        spin=jnp.concatenate([spin, spin + apply(axes, relative.angular[:, a:b])], axis=1),
        angular=of_nodes(now.angular),
        linear=of_nodes(now.linear),
    )


def length_of(actual: ModelWithErrors, link: int) -> Array:
    """Length [m] of a link with its error."""
    return actual.beam_middle[link] / actual.topology.fractions(link)[1][0]


def middles_of(actual: ModelWithErrors, link: int, rfes: Sequence[int]) -> Array:
    """Places [m] of the reference points of rfes along the undeformed link."""
    first, _ = actual.topology.ranges[link]
    if actual.form is not None:
        middles = actual.topology.fractions(link)[1]
        return length_of(actual, link) * np.array([0.0 if rfe == 0 else middles[rfe] for rfe in rfes])
    return jnp.stack([jnp.zeros(()) if rfe == 0 else actual.rest[first + rfe - 1] for rfe in rfes])


def rests_of(actual: ModelWithErrors, link: int, rfes: Sequence[int]) -> Float[Array, "3 sections"]:
    """Reference points of rfes of a link with a form, undeformed, in its frame."""
    first, _ = actual.topology.ranges[link]
    return jnp.stack([jnp.zeros(3) if rfe == 0 else actual.rest[:, first + rfe - 1] for rfe in rfes], axis=1)


def inertial_wrench(actual: ModelWithErrors, bodies: LinkBodies, mass: Array, centre: Array, inertia: Array) -> Array:
    """Rate of momentum minus weight of bodies, as wrenches (6, n) at the global origin; `centre` (3, n) and central
    `inertia` (3, 3, n) in their axes."""
    rotation, point, spin, angular, linear = bodies
    arm = apply(rotation, centre)
    acceleration = linear + cross(angular, arm) + cross(spin, cross(spin, arm))
    force = mass[None] * (acceleration - actual.gravity[:, None])
    inertia = product_transposed(product(rotation, inertia), rotation)
    moment = apply(inertia, angular) + cross(spin, apply(inertia, spin))
    return vectors.wrench_at_origin(moment, force, point + arm)
