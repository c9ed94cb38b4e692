"""How far linear spring-damping elements are from the geometrically exact ones: an estimate of their error.

Place in the pipeline: elasticity -> **linear_validity** -> statics, observation.

Linear elements leave out what is of second order in the rotations of rfes relative to their link frame (theory (1.16)):
lever arms that become shorter, and the work that an axial force does as a bent link becomes shorter.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from rfem_jax.mechanics.algebra.vectors import apply_transposed
from rfem_jax.mechanics.elements import elasticity
from rfem_jax.mechanics.kinematics.motion import total
from rfem_jax.mechanics.model.model import Coordinates, State
from rfem_jax.mechanics.model.with_errors import ModelWithErrors

# Of the squared rotation at the tip of a cantilever, by which its deflection under a force there is too large.
ERROR_BY_ROTATION = 0.45
LEAST_BENDING = 1e-6  # over the energy that is stored by axial forces: a link that bends less does not bend
REMARKABLE_LINEAR_ERROR = 0.02


class LinearRange(NamedTuple):
    """Terms that linear elements neglect at one instant: rotation, relative to deflections, by rotations; shortening
    (links,) [J], twice the work of axial forces as links bend, beside stored (links,) [J], twice the energy of
    bending."""

    rotation: Float[Array, "*times"]
    shortening: Float[Array, "*times links"]
    stored: Float[Array, "*times links"]


def linear_range(actual: ModelWithErrors, position: Coordinates) -> LinearRange:
    """Terms that linear elements neglect at one position; zero with rigid links and geometrically exact elements.
    Slender links neglect no shortening, and their springs carry no axial force."""
    topology = actual.topology
    if topology.exact or not topology.n_rfes:
        return LinearRange(jnp.zeros(()), jnp.zeros((0,)), jnp.zeros((0,)))
    actual, position = jax.lax.stop_gradient((actual, position))
    phi = _in_section(actual, position.elastic[3:])
    if topology.reduced:  # amplitudes turn nothing
        phi = jnp.where(topology.carriers[None], 0.0, phi)
    bending, turned = jnp.sum(phi[1:] ** 2, axis=0), jnp.sum(phi**2, axis=0)
    at_rest = State(position, jax.tree.map(jnp.zeros_like, position))
    stretch, _ = elasticity.deflections(actual, at_rest)
    stress = elasticity.stress_of(actual, stretch)
    lengths = -2.0 * actual.lever_right  # of the rfes, whose left ends are sdes
    if topology.shaped:
        lengths = 2.0 * jnp.sqrt(jnp.sum(actual.lever_right**2, axis=0))
        stress, stretch = (
            jnp.concatenate([_in_section(actual, one[:3]), _in_section(actual, one[3:])]) for one in (stress, stretch)
        )
    weights = np.array([LEAST_BENDING, 1.0, 1.0, 1.0, 1.0, 1.0])[:, None]
    return LinearRange(
        rotation=ERROR_BY_ROTATION * jnp.max(jnp.sqrt(bending * turned)),
        shortening=total(topology, jnp.abs(stress[0]) * lengths * bending),
        stored=total(topology, jnp.sum(weights * stress * stretch, axis=0)),
    )


def _in_section(actual: ModelWithErrors, vector: Array) -> Array:
    """Vectors at the sdes in axes whose first one is along the link."""
    return vector if actual.form is None else apply_transposed(actual.form.axes, vector)


def linear_error(parts: LinearRange) -> Float[Array, ""]:
    """Estimated error of the deflections and loads of the link that is worst, relative to its largest deflections; of
    one position, or of several along a first axis."""
    several = parts if parts.rotation.ndim else LinearRange(*(part[None] for part in parts))
    shortening, stored = jnp.max(several.shortening, axis=0), jnp.max(several.stored, axis=0)
    by_force = shortening / jnp.where(stored > 0.0, stored, 1.0)
    return jnp.max(several.rotation) + jnp.max(by_force, initial=0.0)
