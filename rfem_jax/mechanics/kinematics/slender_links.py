"""Links whose segments neither stretch nor shear: the rotations of their rfes are all their coordinates.

Place in the pipeline: model with errors -> **slender_links** -> motion, residual, condensation, statics.

Without axial and shear deflections an sde is a ball joint with springs, and the displacements of a link's rfes follow
from their rotations, along the chain of lever arms, with both forms of elements (theory (1.28)):

    u = A g,     g_j = R_j e_x - e_x,

with a constant lower triangular matrix A of lever arms.  A state keeps six coordinates of every rfe; those of
displacement are put in wherever a motion is formed.  Forces in the sdes do no work; generalised forces on the rotations
are those of all rfes beyond, by the transpose of the same matrix (theory (1.30)).
"""

from typing import Protocol, runtime_checkable

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from rfem_jax.mechanics.algebra import vectors
from rfem_jax.mechanics.algebra.vectors import apply, apply_transposed, cross
from rfem_jax.mechanics.model.model import Coordinates, State
from rfem_jax.mechanics.model.topology import Topology
from rfem_jax.mechanics.model.with_errors import ModelWithErrors

AXIS = vectors.IDENTITY[0][:, None]


@runtime_checkable
class Turning(Protocol):
    """The part of the relative motion of rfes that rotations alone decide, as `motion.RelativeMotion`."""

    @property
    def rotation(self) -> Float[Array, "3 3 rfes"]: ...
    @property
    def rate_matrix(self) -> Float[Array, "3 3 rfes"]: ...
    @property
    def angular(self) -> Float[Array, "3 rfes"]: ...
    @property
    def rate_bias(self) -> Float[Array, "3 rfes"]: ...


def sums_along(topology: Topology, values: Float[Array, "k rfes"], reverse: bool = False) -> Float[Array, "k rfes"]:
    """Sums over the rfes of every slender link up to each, or from each on (`reverse`); zero in other links."""
    parts = [jnp.zeros_like(values[:, :0])]
    for l, (a, b) in enumerate(topology.ranges):
        part = values[:, a:b]
        parts.append(jax.lax.cumsum(part, axis=1, reverse=reverse) if l in topology.slender else jnp.zeros_like(part))
    return jnp.concatenate(parts, axis=1)


def _carried(actual: ModelWithErrors, turned: Array, other: Array) -> Array:
    """Displacements (3, N), or rates of them, by those of the lever arms' directions; `other`: of other links."""
    topology = actual.topology
    first = np.isin(np.arange(topology.n_rfes), [a for a, _ in topology.ranges])
    before = jnp.where(first, 0.0, jnp.roll(turned, 1, axis=1))
    apart = actual.lever_left[None] * before - actual.lever_right[None] * turned
    return jnp.where(topology.slender_rfes, sums_along(topology, apart), other)


def with_displacements(actual: ModelWithErrors, position: Coordinates) -> Coordinates:
    """A position with the displacements that follow from rotations."""
    if not actual.topology.slender:
        return position
    phi = position.elastic[3:]
    (_, cy, cz), (_, sy, sz) = jnp.cos(phi), jnp.sin(phi)
    axis = [cy * cz, sz, -sy * cz] if actual.topology.exact else [cz * cy, sz * cy, -sy]
    u = _carried(actual, jnp.stack(axis) - AXIS, position.elastic[:3])
    return Coordinates(position.joints, jnp.concatenate([u, phi]))


def completed_state(actual: ModelWithErrors, state: State) -> State:
    """A state with the displacements that follow from rotations, and their rates."""
    if not actual.topology.slender:
        return state
    position, velocity = state.position, state.velocity

    def elastic(values: Array) -> Array:
        return with_displacements(actual, Coordinates(position.joints, values)).elastic

    values, rates = jax.jvp(elastic, (position.elastic,), (velocity.elastic,))
    return State(Coordinates(position.joints, values), Coordinates(velocity.joints, rates))


def completed(actual: ModelWithErrors, relative: Turning, accelerations: Coordinates) -> Coordinates:
    """Second derivatives of the coordinates with those of the displacements that follow from the others."""
    if not actual.topology.slender:
        return accelerations
    u, phi = accelerations.elastic[:3], accelerations.elastic[3:]
    axis, spin = relative.rotation[:, 0], relative.angular
    turned = cross(apply(relative.rate_matrix, phi) + relative.rate_bias, axis) + cross(spin, cross(spin, axis))
    return Coordinates(accelerations.joints, jnp.concatenate([_carried(actual, turned, u), phi]))


def projected(
    actual: ModelWithErrors, relative: Turning, force: Float[Array, "3 rfes"], moment: Float[Array, "3 rfes"]
) -> tuple[Float[Array, "3 rfes"], Float[Array, "3 rfes"]]:
    """Generalised forces on the coordinates that are left of forces in link axes, and moments about the axes of the
    angles' rates, on every rfe: no force, and moments with those of the forces beyond."""
    if not actual.topology.slender:
        return force, moment
    topology = actual.topology
    carried = sums_along(topology, force, reverse=True)
    last = np.isin(np.arange(topology.n_rfes) + 1, [b for _, b in topology.ranges])
    next_ones = jnp.where(last, 0.0, jnp.roll(actual.lever_left[None] * carried, -1, axis=1))
    beyond = next_ones - actual.lever_right[None] * carried
    about = apply_transposed(relative.rate_matrix, cross(relative.rotation[:, 0], beyond))
    return jnp.where(topology.slender_rfes, 0.0, force), moment + about


def unit_rates(actual: ModelWithErrors, relative: Turning | None, link: int) -> Float[Array, "elastic rotations"]:
    """Rates (6 m, 3 m) of all coordinates of a slender link with m free rfes, angles first, by those of its angles,
    component by component; `relative`: None for the undeformed link."""
    a, b = actual.topology.ranges[link]
    m, right = b - a, actual.lever_right[a:b]
    to_next = jnp.concatenate([actual.lever_left[a + 1 : b], jnp.zeros(1)]) - right
    levers = jnp.where(np.eye(m, dtype=bool), -right[None], np.tri(m, k=-1) * to_next[None])
    turning = jnp.broadcast_to(jnp.asarray(-vectors.cross_matrix(jnp.asarray(AXIS))), (3, 3, m))
    if relative is not None:
        turning = -vectors.product(vectors.cross_matrix(relative.rotation[:, 0]), relative.rate_matrix)[:, :, a:b]
    by_angles = turning[:, None] * levers[None, :, None]
    return jnp.concatenate([jnp.eye(3 * m), by_angles.reshape(3 * m, 3 * m)])
