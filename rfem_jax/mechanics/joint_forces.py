"""Forces and moments along the coordinates of the tree joints, besides what holds their links together.

Place in the pipeline: inputs, joint_laws -> **joint_forces** -> dynamics, residual, loads, statics,
reference_formulation.

They are the moments and forces of drives, and springs, dampers and laws of a joint's own position and rate.  Springs
and dampers are inside a joint: parts of its load.  Drives and laws act from outside it and are not (theory (3.17)).
"""

from functools import reduce
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from rfem_jax.mechanics.algebra import Scalar
from rfem_jax.mechanics.inputs import DriveInput
from rfem_jax.mechanics.joint_laws import SpringLaw
from rfem_jax.mechanics.model import Coordinates, State, Topology
from rfem_jax.mechanics.model_with_errors import ModelWithErrors

# Forces [N, N m] by cut joint, counted among these, and component: 0 to 2 of the force along the axes of L, 3 to 5 of
# the moment.
CutForces = dict[tuple[int, int], Float[Array, ""]]


class FrictionState(NamedTuple):
    """Friction along one motion of a joint: rate [rad/s, m/s], normal load [N] (None where friction does not depend on
    it), force [N m, N] on the child."""

    rate: Float[Array, ""]
    normal: Float[Array, ""] | None
    force: Float[Array, ""]


class LawForces(NamedTuple):
    """What springs, dampers, friction and laws exert at one instant.

    inside, outside: forces [N, N m] by joint coordinate, of springs with dampers and friction, and of laws; dissipated,
    power [W]: of the dampers and friction, and of the laws; cuts: of friction in cut joints; friction: by its name;
    these are None without any friction.
    """

    inside: dict[int, Float[Array, ""]]
    outside: dict[int, Float[Array, ""]]
    dissipated: Float[Array, ""]
    power: Float[Array, ""]
    cuts: CutForces | None = None
    friction: dict[str, FrictionState] | None = None


def law_forces(actual: ModelWithErrors, state: State) -> LawForces | None:
    """Forces of springs, dampers and laws at one instant; None for a mechanism without them."""
    if actual.forces is None:
        return None
    inside: dict[int, Array] = {}
    outside: dict[int, Array] = {}
    dissipated = power = jnp.zeros(())
    with jax.named_scope("joint_laws"):
        for law in actual.forces.laws.values():
            position, rate = state.position.joints[law.place], state.velocity.joints[law.coordinate]
            force = actual.forces.share * law.force(position, rate)
            side = outside
            if isinstance(law, SpringLaw):
                side = inside
                dissipated = dissipated + actual.forces.share * law.damping * rate**2
            else:
                power = power + force * rate
            side[law.coordinate] = side[law.coordinate] + force if law.coordinate in side else force
    return LawForces(inside, outside, dissipated, power)


def applied_forces(drive: DriveInput, laws: LawForces | None) -> dict[int, Float[Array, ""]]:
    """Generalised forces [N m, N] by joint coordinate, where any acts."""
    found: dict[int, Array] = dict(drive.forces)
    for side in () if laws is None else (laws.inside, laws.outside):
        for k, force in side.items():
            found[k] = found[k] + force if k in found else force
    return found


def by_coordinate(topology: Topology, forces: dict[int, Float[Array, ""]]) -> Float[Array, " freedoms"]:
    """Forces, of which there is at least one, of all joint coordinates, zero where none acts."""
    rows = np.arange(topology.n_freedoms)
    return reduce(jnp.add, [jnp.where(rows == k, force[None], 0.0) for k, force in forces.items()])


def hinge_moments(topology: Topology, drive: DriveInput) -> Float[Array, " links"] | None:
    """Moments [N m] of drives about the hinges of the tree, zero where none acts; None where that is everywhere."""
    links = np.arange(topology.n_links)
    about = [
        jnp.where(links == topology.link_of_freedom[k], moment[None], 0.0)
        for k, moment in drive.forces.items()
        if topology.about_hinge(k)
    ]
    return reduce(jnp.add, about) if about else None


def outside_forces(topology: Topology, drive: DriveInput, laws: LawForces | None) -> list[tuple[int, Float[Array, ""]]]:
    """Joint coordinates and the forces [N, N m] of laws, and of drives on others than hinges, which are no part of the
    joints' loads."""
    of_laws = [] if laws is None else list(laws.outside.items())
    return of_laws + [(k, force) for k, force in drive.forces.items() if not topology.about_hinge(k)]


def law_energy(actual: ModelWithErrors, position: Coordinates) -> Float[Array, ""]:
    """Potential energy [J] of the springs of joints."""
    springs = [] if actual.forces is None else actual.forces.laws.values()
    energies = [law.energy(position.joints[law.place]) for law in springs if isinstance(law, SpringLaw)]
    return jnp.asarray(sum(energies)) * (1.0 if actual.forces is None else actual.forces.share)


def law_tangent(
    actual: ModelWithErrors, state: State, q_factor: Scalar, v_factor: Scalar
) -> dict[int, Float[Array, ""]]:
    """Minus the derivatives of the forces of springs, dampers and laws with respect to the accelerations of their
    coordinates, for the given derivatives of position [s^2] and rate [s]; at least zero, so that what they are added to
    stays positive."""
    found: dict[int, Array] = {}
    for law in [] if actual.forces is None else actual.forces.laws.values():
        position, rate = state.position.joints[law.place], state.velocity.joints[law.coordinate]
        along = [jnp.asarray(factor, float) for factor in (q_factor, v_factor)]
        value = jnp.maximum(-jax.jvp(law.force, (position, rate), tuple(along))[1], 0.0)
        found[law.coordinate] = found[law.coordinate] + value if law.coordinate in found else value
    return found
