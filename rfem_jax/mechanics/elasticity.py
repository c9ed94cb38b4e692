"""Spring-damping elements: elastic energy, dissipated power, wrenches and generalised forces.

Place in the pipeline: kinematics -> **elasticity** -> dynamics, statics.

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

from rfem_jax.mechanics import exact_elements
from rfem_jax.mechanics.algebra import apply_transposed
from rfem_jax.mechanics.exact_elements import SpringBlocks, from_left, spring_blocks, to_left
from rfem_jax.mechanics.kinematics import RelativeMotion, relative_motion
from rfem_jax.mechanics.model import Coordinates, State
from rfem_jax.mechanics.realisation import Realisation
from rfem_jax.mechanics.reordering import reorder

# (a, b) of two vectors as (b_x, b_z, b_y, a_x, a_z, a_y); with these signs, of a vector's product with (1, 0, 0).
EXCHANGED = (3, 5, 4, 0, 2, 1)
PHI_CROSS_LEVER = np.array([0.0, 1.0, -1.0, 0.0, 0.0, 0.0])
LEVER_CROSS_FORCE = np.array([0.0, 0.0, 0.0, 0.0, -1.0, 1.0])


class ElasticLoads(NamedTuple):
    """What springs and dampers do: force [N] and moment [N m] (3, N) on every free rfe, at its middle
    in link axes, and the power that the dampers take out [W]."""

    force: Array
    moment: Array
    dissipated: Array


def elastic_loads(
    realised: Realisation, state: State, relative: RelativeMotion, inverse_rate: Array
) -> ElasticLoads:
    """Wrenches of springs and dampers; `inverse_rate` (3, 3, N): of `relative.rate_matrix`."""
    with jax.named_scope("spring_damping_elements"):
        if realised.topology.exact:
            now = exact_elements.deflections(realised, state.position.elastic[:3], relative)
            return ElasticLoads(
                *exact_elements.wrenches(realised, now), _dissipated(realised, now.rate)
            )
        stretch, rate = _linear_deflections(realised, state)
        generalised = _linear_forces(realised, stretch, rate)
        return ElasticLoads(
            generalised[:3],
            apply_transposed(inverse_rate, generalised[3:]),
            _dissipated(realised, rate),
        )


def generalised_forces(
    realised: Realisation, state: State, relative: RelativeMotion
) -> tuple[Array, Array]:
    """Generalised forces (6, N) [N, N m] of springs and dampers on the free rfes' coordinates, and the
    power that the dampers take out [W]."""
    with jax.named_scope("spring_damping_elements"):
        if realised.topology.exact:
            now = exact_elements.deflections(realised, state.position.elastic[:3], relative)
            force, moment = exact_elements.wrenches(realised, now)
            forces = jnp.concatenate([force, apply_transposed(relative.rate_matrix, moment)])
            return forces, _dissipated(realised, now.rate)
        stretch, rate = _linear_deflections(realised, state)
        return _linear_forces(realised, stretch, rate), _dissipated(realised, rate)


def deflections(realised: Realisation, state: State) -> tuple[Array, Array]:
    """(du, dphi) (6, N) [m, rad] of all sdes and their rates."""
    if not realised.topology.exact:
        return _linear_deflections(realised, state)
    relative = relative_motion(realised, state.position, state.velocity)
    now = exact_elements.deflections(realised, state.position.elastic[:3], relative)
    return now.stretch, now.rate


def elastic_energy(realised: Realisation, position: Coordinates) -> Array:
    """Energy of all springs [J]."""
    at_rest = State(position, jax.tree.map(jnp.zeros_like, position))
    stretch, _ = deflections(realised, at_rest)
    return 0.5 * jnp.sum(realised.stiffness * stretch**2, axis=(0, 1))


def stiffness_blocks(realised: Realisation) -> SpringBlocks:
    """Stiffness of the springs of undeformed links."""
    n = realised.topology.n_rfes
    units = jnp.broadcast_to(jnp.roll(jnp.eye(6), 3, axis=1)[:, :, None], (6, 6, n))

    def by_rfe(lever):
        return jax.vmap(lambda unit: _face(unit, lever))(units)

    return spring_blocks(realised, by_rfe(realised.lever_right), -by_rfe(realised.lever_left))


def dissipated_power(realised: Realisation, state: State) -> Array:
    """Power that all dampers take out [W]."""
    return _dissipated(realised, deflections(realised, state)[1])


def _dissipated(realised, rate):
    return jnp.sum(realised.stiffness * realised.damping[None] * rate**2, axis=(0, 1))


def _linear_deflections(realised, state: State):
    """Linear in the coordinates, so the same function gives their rates."""

    def between_faces(elastic):
        right = _face(elastic, realised.lever_right)
        return right - _face(from_left(realised, elastic), realised.lever_left)

    return between_faces(state.position.elastic), between_faces(state.velocity.elastic)


def _linear_forces(realised, stretch, rate):
    stress = realised.stiffness * (stretch + realised.damping[None] * rate)
    on_right = -_face_transposed(stress, realised.lever_right)
    return on_right + to_left(realised, _face_transposed(stress, realised.lever_left))


def _face(elastic, lever):
    """Motion of the face at x = lever from a rfe's middle: (u + phi x (lever, 0, 0), phi)."""
    return elastic + _signs(PHI_CROSS_LEVER, elastic) * lever[None] * reorder(elastic, EXCHANGED)


def _face_transposed(stress, lever):
    """The wrench at a rfe's middle of one at its face: (force, moment - force x (lever, 0, 0))."""
    return stress + _signs(LEVER_CROSS_FORCE, stress) * lever[None] * reorder(stress, EXCHANGED)


def _signs(signs, example):
    return signs.reshape((6,) + (1,) * (example.ndim - 1))
