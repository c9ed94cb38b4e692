"""The matrix of the static equations, solved by the structure of the links.

Place in the pipeline: condensation, newton -> **static_matrix** -> statics.

Newton's matrix of an implicit step so long that inertia is next to nothing against the springs is that of
the static equations of a mechanism without loads, and is solved in a time proportional to the number of
rfes.  What is left of the inertia keeps the pivots of free hinges, about which no spring turns, from
being zero (theory (6.4)).
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jax import Array

from rfem_jax.mechanics import loads
from rfem_jax.mechanics.condensation import link_operators
from rfem_jax.mechanics.cut_joints import closure
from rfem_jax.mechanics.kinematics import motion
from rfem_jax.mechanics.model import Coordinates, Topology
from rfem_jax.mechanics.newton import NewtonMatrix, Residual, correction, newton_matrix
from rfem_jax.mechanics.realisation import Realisation

# Springs over inertia, by the stiffness of a link and the mass of all.  The larger, the less a change leaves over,
# but rounding grows with its square: in spatial loops, 1e6 would lead nowhere.
STIFFER = 3e2


class MatrixAtRest(NamedTuple):
    """Matrix of a step whose accelerations move the coordinates by `reach` [s^2] times themselves."""

    matrix: NewtonMatrix
    reach: Array


def matrix_at_rest(
    realised: Realisation, position: Coordinates, held: tuple[int, ...], scale: Array, stiffness: Array
) -> MatrixAtRest:
    """Matrix at one position with undeformed links, joints of the links `held` held; scale [m] as in `closure`,
    stiffness [N/m] of the mechanism."""
    reach = STIFFER * jnp.sum(realised.mass) / stiffness
    operators = link_operators(realised, reach, jnp.zeros(()))
    now = motion(realised, loads.static_state(position))
    matrix = newton_matrix(realised, operators, now, closure(realised, now, scale), held)
    return MatrixAtRest(matrix, reach)


def change_at_rest(topology: Topology, static: MatrixAtRest, left: Residual) -> tuple[Coordinates, Array]:
    """Change of coordinates and multipliers (5, C) that takes away what is left over of moments, forces and
    closure (`closing` in m); angles held do not change."""
    left = left._replace(closing=left.closing / static.reach)
    change = correction(topology, static.matrix, left)
    moved = jax.tree.map(lambda part: static.reach * part, change.accelerations)
    return moved, change.multipliers
