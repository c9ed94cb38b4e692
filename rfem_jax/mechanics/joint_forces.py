"""Moments that act about the axes of the tree joints, besides what holds their links together.

Place in the pipeline: inputs -> **joint_forces** -> dynamics, residual, loads, reference_formulation.

The drive's moment is the only one so far.  A spring or friction in a hinge belongs here, and would need the
state as a further argument.
"""

import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from rfem_jax.mechanics.inputs import DriveInput
from rfem_jax.mechanics.model import Topology


def joint_force(topology: Topology, drive: DriveInput, coordinate: int) -> Float[Array, ""] | None:
    """Generalised force [N m] of one joint coordinate, None where nothing acts."""
    return drive.moment if coordinate == topology.driven_coordinate else None


def joint_forces_of(topology: Topology, drive: DriveInput) -> Float[Array, " freedoms"] | None:
    """`joint_force` of all joint coordinates, zero where nothing acts; None where that is everywhere."""
    if drive.moment is None:
        return None
    return jnp.where(np.arange(topology.n_freedoms) == topology.driven_coordinate, drive.moment[None], 0.0)


def hinge_moments(topology: Topology, drive: DriveInput) -> Float[Array, " links"] | None:
    """Given moments [N m] about y of the tree joints, zero where none acts; None where that is everywhere."""
    if drive.moment is None:
        return None
    return jnp.where(np.arange(topology.n_links) == topology.driven, drive.moment[None], 0.0)
