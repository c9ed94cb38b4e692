"""Forces in slender links, which keep their segments from stretching and shearing and follow from equilibrium.

Place in the pipeline: loads -> **slender_forces** -> section_loads.
"""

from typing import Protocol, runtime_checkable

import numpy as np
from jax import Array
from jaxtyping import Float

from rfem_jax.mechanics.algebra.vectors import apply_transposed
from rfem_jax.mechanics.dynamics import loads
from rfem_jax.mechanics.forces.element_loads import FrameLoads
from rfem_jax.mechanics.kinematics.motion import Motion
from rfem_jax.mechanics.kinematics.slender_links import sums_along
from rfem_jax.mechanics.model.with_errors import ModelWithErrors


@runtime_checkable
class Moving(Protocol):
    """A mechanism at one instant: motion, accelerations (3, nodes) of the nodes in link axes, wrenches of all joints at
    the global origin, and forces of the elements."""

    @property
    def motion(self) -> Motion: ...
    @property
    def angular(self) -> Float[Array, "3 nodes"]: ...
    @property
    def linear(self) -> Float[Array, "3 nodes"]: ...
    @property
    def wrenches(self) -> list[Float[Array, "6"]]: ...
    @property
    def frame_loads(self) -> FrameLoads | None: ...


def constraint_forces(actual: ModelWithErrors, now: Moving) -> Float[Array, "3 rfes"] | None:
    """Force [N] that the sde on the left of every free rfe exerts on it, in link axes: what all rfes from there to the
    end of the link need for their motion (theory (1.31)); zero in other links, None without slender ones."""
    topology, n = actual.topology, actual.topology.n_links
    if not topology.slender:
        return None
    inertial = loads.inertial_loads(actual, now.motion, now.angular, now.linear)
    needed = loads.loads_beyond_elements(inertial, now.frame_loads)[0][:, n:]
    for j, sides in enumerate(zip(topology.parents, topology.children, strict=True)):
        for node, sign in zip(sides, (-1.0, 1.0), strict=True):
            if node >= n:
                force = apply_transposed(now.motion.links.rotation[:, :, topology.link_of(node)], now.wrenches[j][3:])
                needed = needed - sign * force[:, None] * (np.arange(topology.n_rfes) == node - n)[None].astype(float)
    return sums_along(topology, needed, reverse=True)
