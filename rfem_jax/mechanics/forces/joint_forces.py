"""Forces and moments along the coordinates of the tree joints, besides what holds their links together.

Place in the pipeline: inputs, joint_laws -> **joint_forces** -> dynamics, residual, loads, statics,
reference.formulation.

They are the moments and forces of drives, springs, dampers and laws of a joint's own position and rate, and couplings
of two coordinates, which act beside their joints as laws do, but have an energy and a dissipation (an ideal one has
neither, and its loads follow from its multiplier).  Springs
and dampers, those of compliant joints among them, are inside a joint: parts of its load.  Drives and laws act from
outside it and are not (theory (3.17)).
"""

from functools import reduce
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from rfem_jax.mechanics.algebra.vectors import Scalar, dot
from rfem_jax.mechanics.kinematics.ideal_couplings import ideal_laws, units_of
from rfem_jax.mechanics.kinematics.motion import Motion
from rfem_jax.mechanics.laws.couplings import CouplingLaw, Meshing
from rfem_jax.mechanics.laws.joint_springs import CompliantSpring, diagonal_tangent
from rfem_jax.mechanics.model.inputs import DriveInput
from rfem_jax.mechanics.model.model import Coordinates, State
from rfem_jax.mechanics.model.topology import Topology
from rfem_jax.mechanics.model.with_errors import ModelWithErrors

# Forces [N, N m] by cut joint, counted among these, and component: 0 to 2 of the force along the axes of L, 3 to 5 of
# the moment.
CutForces = dict[tuple[int, int], Float[Array, ""]]


class FrictionState(NamedTuple):
    """Friction along one motion of a joint: rate [rad/s, m/s], and that at which the friction is taken, which is
    another one at a start (theory (12.10)); normal load [N] (None where friction does not depend on it), force [N m, N]
    on the child."""

    rate: Float[Array, ""]
    sliding: Float[Array, ""]
    normal: Float[Array, ""] | None
    force: Float[Array, ""]


class LawForces(NamedTuple):
    """Forces of springs, dampers, friction and laws at one instant.

    inside, outside: forces [N, N m] by joint coordinate, of springs with dampers and friction, and of laws; dissipated,
    power [W]: of the dampers and friction, and of the laws whose work is not known by their positions; cuts: of
    friction in cut joints; friction: by its name; these are None without any friction; couplings: by their names,
    None without any, whose loads are beside those of the joints, as those of laws.
    """

    inside: dict[int, Float[Array, ""]]
    outside: dict[int, Float[Array, ""]]
    dissipated: Float[Array, ""]
    power: Float[Array, ""]
    cuts: CutForces | None = None
    friction: dict[str, FrictionState] | None = None
    couplings: dict[str, Meshing] | None = None


def law_forces(actual: ModelWithErrors, state: State) -> LawForces | None:
    """Forces of springs, dampers and laws at one instant; None for a mechanism without them."""
    springs = tree_springs(actual)
    if actual.forces is None and not springs:
        return None
    inside: dict[int, Array] = {}
    outside: dict[int, Array] = {}
    dissipated = power = jnp.zeros(())
    with jax.named_scope("joint_laws"):
        laws, share = ({}, 1.0) if actual.forces is None else (actual.forces.laws, actual.forces.share)
        for law in laws.values():
            position, rate = state.position.joints[law.place], state.velocity.joints[law.coordinate]
            force = share * law.force(position, rate)
            side = outside
            if law.inside:
                side = inside
                dissipated = dissipated + share * law.dissipation(rate)
            elif actual.topology.sprung or law.work(position) is None:
                if actual.topology.sprung:
                    rate = rate_about_axis(actual.topology, state, law.coordinate)
                power = power + force * rate
            side[law.coordinate] = side[law.coordinate] + force if law.coordinate in side else force
        meshes = coupling_meshes(actual, state)
        for name, mesh in meshes.items():
            dissipated = dissipated + mesh.dissipated
            for k, load in zip(_couplings(actual)[name].coordinates, mesh.loads):
                outside[k] = outside[k] + load if k in outside else load
        for spring in springs:
            position, rate = _spring_motion(spring, state)
            inside |= dict(zip(spring.coordinates, spring.along(position, rate)))
            dissipated = dissipated - dot(spring.along(position, rate) - spring.along(position, 0.0 * rate), rate)
    return LawForces(inside, outside, dissipated, power, couplings=meshes or None)


def _couplings(actual: ModelWithErrors) -> dict[str, CouplingLaw]:
    """The couplings by a mesh."""
    couplings = {} if actual.forces is None else actual.forces.couplings
    return {name: one for name, one in couplings.items() if one.stiffness is not None}


def with_ideal_couplings(
    actual: ModelWithErrors,
    laws: LawForces | None,
    motion: Motion,
    multipliers: Float[Array, " constraints"],
    scale: Scalar,
) -> LawForces | None:
    """The forces with those of ideal couplings, whose multipliers [N] are the last; `scale` [m] as in `closure`."""
    if motion.couplings is None:
        return laws
    assert laws is not None, "couplings are among the forces"
    outside, meshes = dict(laws.outside), dict(laws.couplings or {})
    first = multipliers.shape[0] - len(actual.topology.ideal)
    for i, (name, law) in enumerate(ideal_laws(actual).items()):
        load = multipliers[first + i] * units_of(actual, law, scale)
        of_both = jnp.stack([motion.couplings.along[k, i] * load for k in law.coordinates])
        meshes[name] = Meshing(motion.couplings.residual[i], of_both, jnp.zeros(()))
        for k, one in zip(law.coordinates, of_both):
            outside[k] = outside[k] + one if k in outside else one
    return laws._replace(outside=outside, couplings=meshes)


def coupling_meshes(actual: ModelWithErrors, state: State) -> dict[str, Meshing]:
    """What the couplings exert at one instant, by their names."""
    meshes = {}
    for name, coupling in _couplings(actual).items():
        assert actual.forces is not None
        mesh, share = coupling.meshing(*_coupled(coupling, state)), actual.forces.share
        meshes[name] = Meshing(mesh.deflection, share * mesh.loads, share * mesh.dissipated)
    return meshes


def _coupled(coupling: CouplingLaw, state: State) -> tuple[Array, Array]:
    """Positions and rates of the two coordinates of a coupling."""
    joints, rates = state.position.joints, state.velocity.joints
    return jnp.stack([joints[k] for k in coupling.places]), jnp.stack([rates[k] for k in coupling.coordinates])


def coupling_tangents(
    actual: ModelWithErrors, state: State, q_factor: Scalar, v_factor: Scalar
) -> tuple[Float[Array, "freedoms couplings"], Float[Array, " couplings"]] | None:
    """Directions of the loads of all couplings along the joint coordinates, and their tangents, as
    `CouplingLaw.tangent`; None without any."""
    found = []
    for coupling in _couplings(actual).values():
        assert actual.forces is not None
        direction, stiffness = coupling.tangent(*_coupled(coupling, state), q_factor, v_factor)
        rows = np.arange(actual.topology.n_freedoms)
        along = sum(jnp.where(rows == k, one, 0.0) for k, one in zip(coupling.coordinates, direction))
        found.append((jnp.asarray(along), actual.forces.share * stiffness))
    if not found:
        return None
    directions, tangents = zip(*found)
    return jnp.stack(directions, axis=1), jnp.stack(tangents)


def tree_springs(actual: ModelWithErrors) -> list[CompliantSpring]:
    """The springs of compliant joints of the tree."""
    return [spring for spring in (actual.springs or {}).values() if spring.coordinates]


def _spring_motion(spring: CompliantSpring, state: State) -> tuple[Array, Array]:
    """Position and rate of the coordinates of a spring."""
    joints, rates = state.position.joints, state.velocity.joints
    return jnp.stack([joints[k] for k in spring.places]), jnp.stack([rates[k] for k in spring.coordinates])


def applied_forces(
    topology: Topology, position: Coordinates, drive: DriveInput, laws: LawForces | None
) -> dict[int, Float[Array, ""]]:
    """Generalised forces [N m, N] by joint coordinate, where any acts."""
    forces: dict[int, Array] = dict(drive.forces)
    for side in () if laws is None else (laws.inside, laws.outside):
        for k, force in side.items():
            forces[k] = forces[k] + force if k in forces else force
    for side in [] if not topology.sprung else [drive.forces, {} if laws is None else laws.outside]:
        for k, force in side.items():
            if (tilted := topology.tilted(k)) is not None:
                share = jnp.sin(position.joints[tilted[0]]) * force
                forces[tilted[1]] = forces[tilted[1]] + share if tilted[1] in forces else share
    return forces


def rate_about_axis(topology: Topology, state: State, k: int) -> Float[Array, ""]:
    """Rate [rad/s, m/s] about or along the axis on the parent of a joint coordinate: its own, and what the second axis
    of a sprung tilt, which the first angle turns, has of it (theory (13.5))."""
    rate, tilted = state.velocity.joints[k], topology.tilted(k)
    if tilted is None:
        return rate
    return rate + jnp.sin(state.position.joints[tilted[0]]) * state.velocity.joints[tilted[1]]


def loads_about_parent_axes(
    topology: Topology, position: Coordinates, hinge: Float[Array, " freedoms"]
) -> Float[Array, " freedoms"]:
    """Loads along the joint coordinates, with those of the second axes of sprung tilts resolved about the parents'
    axes, so that a moment that holds an angle is one about the parent's axis, without a part of its tilt (theory
    (13.5))."""
    for k in range(topology.n_freedoms if topology.sprung else 0):
        if (tilted := topology.tilted(k)) is not None:
            place, second = tilted
            share = jnp.where(np.arange(topology.n_freedoms) == second, jnp.sin(position.joints[place]), 0.0)
            hinge = hinge - share * hinge[k]
    return hinge


def by_coordinate(topology: Topology, forces: dict[int, Float[Array, ""]]) -> Float[Array, " freedoms"]:
    """Array of forces by joint coordinate, zero for coordinates without a force; `forces` has at least one."""
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
    """Potential energy [J] of the springs of the joints of the tree, and of couplings of these."""
    springs = [] if actual.forces is None else actual.forces.laws.values()
    energies = [law.energy(position.joints[law.place]) for law in springs if law.inside]
    for coupling in _couplings(actual).values():
        energies.append(coupling.energy(jnp.stack([position.joints[k] for k in coupling.places])))
    energy = jnp.asarray(sum(energies)) * (1.0 if actual.forces is None else actual.forces.share)
    for spring in tree_springs(actual):
        energy = energy + spring.energy(jnp.stack([position.joints[k] for k in spring.places]))
    return energy


def law_work(actual: ModelWithErrors, position: Coordinates) -> list[Float[Array, ""]]:
    """Works [J] of the laws that depend on a joint's position alone, from any fixed one; none where a sprung tilt turns
    what a law acts about."""
    if actual.forces is None or actual.topology.sprung:
        return []
    works = [law.work(position.joints[law.place]) for law in actual.forces.laws.values() if not law.inside]
    return [actual.forces.share * work for work in works if work is not None]


def law_tangent(
    actual: ModelWithErrors, state: State, q_factor: Scalar, v_factor: Scalar
) -> dict[int, Float[Array, ""]]:
    """Minus the derivatives of the forces of springs, dampers and laws with respect to the accelerations of their
    coordinates, for the given derivatives of position [s^2] and rate [s]; at least zero, so that what they are added to
    stays positive."""
    tangent: dict[int, Array] = {}
    for law in [] if actual.forces is None else actual.forces.laws.values():
        position, rate = state.position.joints[law.place], state.velocity.joints[law.coordinate]
        along = [jnp.asarray(factor, float) for factor in (q_factor, v_factor)]
        value = jnp.maximum(-jax.jvp(law.force, (position, rate), tuple(along))[1], 0.0)
        tangent[law.coordinate] = tangent[law.coordinate] + value if law.coordinate in tangent else value
    for spring in tree_springs(actual):
        values = diagonal_tangent(spring.along, *_spring_motion(spring, state), q_factor, v_factor)
        tangent |= dict(zip(spring.coordinates, values))
    return tangent
