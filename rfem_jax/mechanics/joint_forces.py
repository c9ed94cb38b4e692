"""Moments that act about the hinges of the tree joints, besides what holds their links together.

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


def hinge_moment(topology: Topology, drive: DriveInput, link: int) -> Float[Array, ""] | None:
    """Moment [N m] on a link about the hinge of its tree joint, None where nothing acts."""
    return drive.moment if link == topology.driven else None


def hinge_moments(topology: Topology, drive: DriveInput) -> Float[Array, " links"] | None:
    """`hinge_moment` of all links, zero where nothing acts; None where that is everywhere."""
    if drive.moment is None:
        return None
    return jnp.where(np.arange(topology.n_links) == topology.driven, drive.moment[None], 0.0)
