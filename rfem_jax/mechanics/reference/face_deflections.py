"""Deflections of geometrically exact spring-damping elements from the transforms of their faces.

Place in the pipeline: node_transforms -> **face_deflections** -> formulation.

Theory (1.12), by the logarithm of the relative rotation.
"""

import jax
import jax.numpy as jnp
from jax import Array
from jaxtyping import Float

from rfem_jax.mechanics.model.with_errors import ModelWithErrors
from rfem_jax.mechanics.reference.node_transforms import axial, place_along, transform


def exact_deflections(actual: ModelWithErrors, frames: Float[Array, "nodes 4 4"]) -> Float[Array, "6 rfes"]:
    """(du, theta) of geometrically exact sdes, from the transforms of all nodes to those of the two faces of
    every sde."""
    topology = actual.topology
    if topology.n_rfes == 0:
        return jnp.zeros((6, 0))
    left, right, left_face, right_face = [], [], [], []
    for l, (a, b) in enumerate(topology.ranges):
        for k in range(a, b):
            right.append(topology.n_links + k)
            right_face.append(transform(jnp.eye(3), place_along(actual.lever_right, k)))
            # The first sde joins the link frame, whose face is at the sde's place at rest.
            left.append(l if k == a else topology.n_links + k - 1)
            at_rest = place_along(actual.rest, k) + place_along(actual.lever_right, k)
            left_face.append(transform(jnp.eye(3), at_rest if k == a else place_along(actual.lever_left, k)))
    left = frames[jnp.array(left)] @ jnp.stack(left_face)
    right = frames[jnp.array(right)] @ jnp.stack(right_face)
    return jax.vmap(_deflection, out_axes=1)(left, right)


def _deflection(left: Array, right: Array) -> Array:
    """(du, theta) (6,) of two faces: the logarithm of the relative rotation, and the gap in the frame midway
    between them."""
    rotation = left[:3, :3].T @ right[:3, :3]
    skew = 0.5 * (rotation - rotation.T)
    sine_axis = axial(skew)
    square = sine_axis @ sine_axis
    none = square < 1e-30
    sine = jnp.sqrt(jnp.where(none, 1.0, square))
    angle = jnp.where(none, 1.0, jnp.arctan2(sine, 0.5 * (jnp.trace(rotation) - 1.0)))
    theta = sine_axis * jnp.where(none, 1.0, angle / sine)
    # Rodrigues' formula for minus half the angle.
    unit = skew / sine
    back = -jnp.sin(0.5 * angle) * unit + (1.0 - jnp.cos(0.5 * angle)) * unit @ unit
    gap = left[:3, :3].T @ (right[:3, 3] - left[:3, 3])
    return jnp.concatenate([gap + back @ gap, theta])
