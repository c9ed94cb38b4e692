"""The tangent of the static equations, solved by recursion over the links.

Place in the pipeline: condensation, newton -> **tangent** -> assembly.

The iteration matrix of an implicit step so long that inertia is negligible against the springs approximates
the tangent of the static equations of a mechanism without loads, and is solved in a time proportional to the
number of rfes.  What remains of the inertia keeps the pivots of free hinges, about which no spring acts, from
being zero (theory (6.4)).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from rfem_jax.mechanics.algebra.vectors import Scalar
from rfem_jax.mechanics.dynamics import loads
from rfem_jax.mechanics.forces.tangents import force_tangents
from rfem_jax.mechanics.implicit.condensation import link_operators
from rfem_jax.mechanics.implicit.newton import IterationMatrix, iteration_matrix, newton_increment
from rfem_jax.mechanics.implicit.residual import Residual
from rfem_jax.mechanics.kinematics.cut_joints import closure
from rfem_jax.mechanics.kinematics.motion import motion_of
from rfem_jax.mechanics.model.model import Coordinates
from rfem_jax.mechanics.model.topology import Topology
from rfem_jax.mechanics.model.with_errors import ModelWithErrors

# Springs over inertia, by the stiffness of a link and the mass of all.  The larger, the smaller the residual of a
# solution, but rounding grows with its square: in spatial loops, 1e6 would not converge.
STIFFNESS_RATIO = 3e2


class StaticTangent(NamedTuple):
    """Iteration matrix of a step in which coordinates change by q_factor [s^2] times the accelerations."""

    matrix: IterationMatrix
    q_factor: Float[Array, ""]


def static_tangent(
    actual: ModelWithErrors,
    position: Coordinates,
    held: tuple[int, ...],
    scale: Scalar,
    stiffness: Scalar,
) -> StaticTangent:
    """Tangent at one position with undeformed links, the joint coordinates `held` held; scale [m] as in
    `closure`, stiffness [N/m] of the mechanism."""
    q_factor = STIFFNESS_RATIO * jnp.sum(actual.mass) / stiffness
    operators = link_operators(actual, q_factor, jnp.zeros(()))
    state = loads.static_state(actual.topology, position)
    motion = motion_of(actual, state)
    cuts = closure(actual, motion, scale)
    tangents = force_tangents(actual, state, motion, cuts, None, scale, (q_factor, 0.0))
    matrix = iteration_matrix(actual, operators, motion, cuts, held, tangents)
    return StaticTangent(matrix, q_factor)


def static_increment(
    topology: Topology, tangent: StaticTangent, residual: Residual
) -> tuple[Coordinates, Float[Array, " constraints"]]:
    """Increments of coordinates and multipliers for which the linearised residual (`closing` in m, of springs in N)
    vanishes; coordinates held do not change."""
    sprung = topology.sprung_rows
    unit = jnp.where(np.array(sprung), 1.0, tangent.q_factor) if sprung else tangent.q_factor
    residual = residual._replace(closing=residual.closing / unit)
    increment = newton_increment(topology, tangent.matrix, residual)
    coordinates = jax.tree.map(lambda part: tangent.q_factor * part, increment.accelerations)
    return coordinates, increment.multipliers
