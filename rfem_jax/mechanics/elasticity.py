"""Spring-damping elements: elastic energy, dissipated power and generalised forces.

Place in the pipeline: kinematics -> **elasticity** -> dynamics, statics.

Classical linear form (MODEL section 2, equation (16)): sde k joins free rfe k (its right
neighbour) to rfe k-1 of the same link, or to the link frame.  With the lever arms s from the rfes'
middles to the sde,

    du = (u_right + phi_right x s_right) - (u_left + phi_left x s_left),  dphi = phi_right - phi_left.

Valid for small deflections relative to the link frame.  The Kelvin-Voigt damper acts on the rates
of du and dphi with eta times the stiffness.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from rfem_jax.mechanics.model import Coordinates
from rfem_jax.mechanics.realisation import Realisation


def deflections(realised: Realisation, elastic: Array) -> Array:
    """(du, dphi) (6, N) [m, rad] of all sdes; linear in the coordinates, so of rates likewise."""
    right = _face(elastic, realised.lever_right)
    left = _face(_from_left(realised, elastic), realised.lever_left)
    return right - left


def forces(realised: Realisation, position: Coordinates, velocity: Coordinates) -> Array:
    """Generalised forces (6, N) [N, N m] of springs and dampers on the free rfes' coordinates."""
    with jax.named_scope("spring_damping_elements"):
        stretch = deflections(realised, position.elastic)
        rate = deflections(realised, velocity.elastic)
        stress = realised.stiffness * (stretch + realised.damping[None] * rate)
        on_right = -_face_transposed(stress, realised.lever_right)
        on_left = _face_transposed(stress, realised.lever_left)
        return on_right + _to_left(realised, on_left)


def elastic_energy(realised: Realisation, position: Coordinates) -> Array:
    """Energy of all springs [J]."""
    stretch = deflections(realised, position.elastic)
    return 0.5 * jnp.sum(realised.stiffness * stretch**2, axis=(0, 1))


def dissipated_power(realised: Realisation, velocity: Coordinates) -> Array:
    """Power that all dampers take out [W]."""
    rate = deflections(realised, velocity.elastic)
    return jnp.sum(realised.stiffness * realised.damping[None] * rate**2, axis=(0, 1))


def _face(elastic, lever):
    """Motion of the face at x = lever from a rfe's middle: (u + phi x (lever, 0, 0), phi)."""
    u, phi = elastic[:3], elastic[3:]
    return jnp.concatenate([u + _lever_cross(phi, lever), phi])


def _face_transposed(stress, lever):
    force, moment = stress[:3], stress[3:]
    return jnp.concatenate([force, moment - _lever_cross(force, lever)])


def _lever_cross(vector, lever):
    """vector x (lever, 0, 0)."""
    return jnp.stack([0.0 * vector[0], vector[2] * lever, -vector[1] * lever])


def _is_inner(realised: Realisation) -> np.ndarray:
    """Which free rfes have another free rfe of their link on their left."""
    inner = np.ones(realised.topology.n_rfes)
    inner[[a for a, b in realised.topology.ranges if b > a]] = 0.0
    return inner


def _from_left(realised, values):
    inner = _expand(_is_inner(realised), values)
    return inner * jnp.roll(values, 1, axis=1)


def _to_left(realised, values):
    inner = _expand(_is_inner(realised), values)
    return jnp.roll(inner * values, -1, axis=1)


def _expand(inner, values):
    return jnp.asarray(inner).reshape((1, -1) + (1,) * (values.ndim - 2))
