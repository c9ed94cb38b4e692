"""Spring-damping elements: elastic energy, dissipated power, wrenches and generalised forces.

Place in the pipeline: kinematics, exact_elements -> **elasticity** -> dynamics, residual, statics.

Sde k joins free rfe k (its right neighbour) to rfe k-1 of the same link, or to the link frame.
Classical linear form (theory (1.8) to (1.11)): with the lever arms s from the rfes' middles
to the sde,

    du = (u_right + phi_right x s_right) - (u_left + phi_left x s_left),  dphi = phi_right - phi_left.

Valid for small deflections relative to the link frame.  The Kelvin-Voigt damper acts on the rates
of du and dphi with eta times the stiffness.  The geometrically exact form is in `exact_elements`.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from rfem_jax.mechanics.algebra.reordering import reorder
from rfem_jax.mechanics.algebra.vectors import apply_transposed, cross, invert_block, product
from rfem_jax.mechanics.elements import exact_elements
from rfem_jax.mechanics.elements.deformed_bodies import spring_energy, spring_forces
from rfem_jax.mechanics.elements.exact_elements import (
    SpringBlocks,
    from_left,
    spring_blocks,
    stress_of,
    to_left,
    unbent,
)
from rfem_jax.mechanics.kinematics.motion import RelativeMotion, relative_motion
from rfem_jax.mechanics.model.model import Coordinates, State
from rfem_jax.mechanics.model.with_errors import ModelWithErrors

# (a, b) of two vectors as (b_x, b_z, b_y, a_x, a_z, a_y); with these signs, of a vector's product with (1, 0, 0).
EXCHANGED = (3, 5, 4, 0, 2, 1)
PHI_CROSS_LEVER = np.array([0.0, 1.0, -1.0, 0.0, 0.0, 0.0])
LEVER_CROSS_FORCE = np.array([0.0, 0.0, 0.0, 0.0, -1.0, 1.0])


class ElasticLoads(NamedTuple):
    """Force [N] and moment [N m] of springs and dampers on every free rfe, at its middle in link axes, and the
    power [W] that the dampers dissipate."""

    force: Float[Array, "3 rfes"]
    moment: Float[Array, "3 rfes"]
    dissipated: Float[Array, ""]


def elastic_loads(
    actual: ModelWithErrors, state: State, relative: RelativeMotion, inverse_rate: Float[Array, "3 3 rfes"]
) -> ElasticLoads:
    """Wrenches of springs and dampers; `inverse_rate`: the inverse of `relative.rate_matrix`."""
    with jax.named_scope("spring_damping_elements"):
        if actual.topology.exact:
            deflected = exact_elements.deflections(actual, state.position.elastic[:3], relative)
            return ElasticLoads(*exact_elements.wrenches(actual, deflected), _dissipated(actual, deflected.rate))
        stretch, rate = _linear_deflections(actual, state)
        generalised = _linear_forces(actual, stretch, rate)
        return ElasticLoads(
            generalised[:3],
            apply_transposed(inverse_rate, generalised[3:]),
            _dissipated(actual, rate),
        )


def generalised_forces(
    actual: ModelWithErrors, state: State, relative: RelativeMotion
) -> tuple[Float[Array, "6 rfes"], Float[Array, ""]]:
    """Generalised forces [N, N m] of springs and dampers on the free rfes' coordinates, and the power [W]
    that the dampers dissipate."""
    with jax.named_scope("spring_damping_elements"):
        if actual.topology.exact:
            deflected = exact_elements.deflections(actual, state.position.elastic[:3], relative)
            force, moment = exact_elements.wrenches(actual, deflected)
            forces = jnp.concatenate([force, apply_transposed(relative.rate_matrix, moment)])
            dissipated = _dissipated(actual, deflected.rate)
        else:
            stretch, rate = _linear_deflections(actual, state)
            forces, dissipated = _linear_forces(actual, stretch, rate), _dissipated(actual, rate)
        if actual.superelements is None:
            return forces, dissipated
        of_bodies, also = spring_forces(actual, relative)
        return forces + of_bodies, dissipated + also


def deflections(actual: ModelWithErrors, state: State) -> tuple[Float[Array, "6 rfes"], Float[Array, "6 rfes"]]:
    """(du, dphi) [m, rad] of all sdes and their rates."""
    if not actual.topology.exact:
        return _linear_deflections(actual, state)
    relative = relative_motion(actual, state.position, state.velocity)
    deflected = exact_elements.deflections(actual, state.position.elastic[:3], relative)
    return deflected.stretch, deflected.rate


def section_loads(
    actual: ModelWithErrors, state: State, relative: RelativeMotion, carried: Array | None = None
) -> Float[Array, "6 rfes"]:
    """Force [N] and moment [N m] that the right side of every sde exerts on its left one, in the element's own axes
    (linear elements: those of the link); `carried` (3, N) [N]: as of `constraint_forces`."""
    if actual.topology.exact:
        deflected = exact_elements.deflections(actual, state.position.elastic[:3], relative)
        loads = exact_elements.section_loads(actual, deflected)
        carried = None if carried is None else product(deflected.midway, carried[:, None])[:, 0]
    else:
        stretch, rate = _linear_deflections(actual, state)
        loads = stress_of(actual, stretch + actual.damping[None] * rate)
    return loads if carried is None else loads - jnp.concatenate([carried, jnp.zeros_like(carried)])


def wrenches_of_left(
    actual: ModelWithErrors, state: State, relative: RelativeMotion, carried: Array | None = None
) -> tuple[Float[Array, "3 rfes"], Float[Array, "3 rfes"]]:
    """Force [N] and moment [N m] that the sde on the left of every free rfe exerts on its middle, in link axes;
    `carried` (3, N) [N]: as of `constraint_forces`."""
    if actual.topology.exact:
        deflected = exact_elements.deflections(actual, state.position.elastic[:3], relative)
        force, moments = exact_elements.on_both_rfes(actual, deflected)
        force, moment = -force, moments[:, 0]
        if carried is None:
            return force, moment
        return force + carried, moment + cross(deflected.arms[:, 0], carried)
    on_right = -_face_transposed(section_loads(actual, state, relative, carried), actual.lever_right)
    return on_right[:3], apply_transposed(invert_block(relative.rate_matrix), on_right[3:])


def elastic_energy(actual: ModelWithErrors, position: Coordinates) -> Float[Array, ""]:
    """Energy of all springs [J]."""
    at_rest = State(position, jax.tree.map(jnp.zeros_like, position))
    stretch, _ = deflections(actual, at_rest)
    if actual.topology.shaped:
        energy = 0.5 * jnp.sum(stress_of(actual, stretch) * stretch, axis=(0, 1))
        return energy if actual.superelements is None else energy + spring_energy(actual, position)
    return 0.5 * jnp.sum(actual.stiffness * stretch**2, axis=(0, 1))


def stiffness_blocks(actual: ModelWithErrors) -> SpringBlocks:
    """Stiffness of the springs of undeformed links, in both forms of the elements."""
    n = actual.topology.n_rfes
    units = jnp.broadcast_to(jnp.roll(jnp.eye(6), 3, axis=1)[:, :, None], (6, 6, n))

    def by_rfe(lever):
        return jax.vmap(lambda unit: _face(unit, lever))(units)

    return spring_blocks(actual, by_rfe(actual.lever_right), -by_rfe(actual.lever_left))


def dissipated_power(actual: ModelWithErrors, state: State) -> Float[Array, ""]:
    """Power that all dampers dissipate [W]."""
    dissipated = _dissipated(actual, deflections(actual, state)[1])
    if actual.superelements is None:
        return dissipated
    return dissipated + spring_forces(actual, relative_motion(actual, state.position, state.velocity))[1]


def _dissipated(actual: ModelWithErrors, rate: Array) -> Array:
    if actual.topology.shaped:
        return jnp.sum(actual.damping[None] * stress_of(actual, rate) * rate, axis=(0, 1))
    return jnp.sum(actual.stiffness * actual.damping[None] * rate**2, axis=(0, 1))


def _linear_deflections(actual: ModelWithErrors, state: State) -> tuple[Array, Array]:
    """(du, dphi) and their rates, by the same function since it is linear in the coordinates."""

    def between_faces(elastic):
        right = _face(elastic, actual.lever_right)
        return right - _face(from_left(actual, elastic), actual.lever_left)

    return unbent(actual, between_faces(state.position.elastic)), between_faces(state.velocity.elastic)


def _linear_forces(actual: ModelWithErrors, stretch: Array, rate: Array) -> Array:
    stress = stress_of(actual, stretch + actual.damping[None] * rate)
    on_right = -_face_transposed(stress, actual.lever_right)
    return on_right + to_left(actual, _face_transposed(stress, actual.lever_left))


def _face(elastic: Array, lever: Array) -> Array:
    """Motion of the face at x = lever from a rfe's middle: (u + phi x (lever, 0, 0), phi); or at a vector from it."""
    if lever.ndim == 2:
        return jnp.concatenate([elastic[:3] + cross(elastic[3:], lever), elastic[3:]])
    return elastic + PHI_CROSS_LEVER[:, None] * lever[None] * reorder(elastic, EXCHANGED)


def _face_transposed(stress: Array, lever: Array) -> Array:
    """Wrench at the middle of a rfe that is equivalent to one at its face: (force, moment - force x (lever, 0, 0)); or
    with a vector to it."""
    if lever.ndim == 2:
        return jnp.concatenate([stress[:3], stress[3:] + cross(lever, stress[:3])])
    return stress + LEVER_CROSS_FORCE[:, None] * lever[None] * reorder(stress, EXCHANGED)
