"""The forces of a description as laws on the coordinates and nodes of a model.

Place in the pipeline: description, places, laws -> **acting_laws** -> building.
"""

from collections.abc import Sequence

import jax.numpy as jnp
import numpy as np

from rfem_jax.description.basics.errors import InputError
from rfem_jax.description.basics.numbers import array_of
from rfem_jax.description.mechanism.couplings import Coupling
from rfem_jax.description.mechanism.distributed_forces import DistributedForce
from rfem_jax.description.mechanism.forces import JointForce, JointFriction
from rfem_jax.description.mechanism.links import Link
from rfem_jax.description.mechanism.mechanism import Mechanism
from rfem_jax.description.mechanism.point_forces import AtPoint, BetweenPoints
from rfem_jax.description.mechanism.points import NamedPoint
from rfem_jax.description.parameters.parts import Parts
from rfem_jax.mechanics.laws.couplings import CouplingLaw, coupling_law
from rfem_jax.mechanics.laws.frame_forces import FrameForce, NodeFrame
from rfem_jax.mechanics.laws.friction_laws import Friction, friction_law
from rfem_jax.mechanics.laws.joint_laws import JointLaw, joint_law
from rfem_jax.mechanics.laws.joint_springs import CompliantSpring, compliant_spring
from rfem_jax.mechanics.laws.line_loads import LineLoad, line_load
from rfem_jax.mechanics.laws.point_laws import load_at, spring_between
from rfem_jax.mechanics.model.model import CarriedPoint
from rfem_jax.mechanics.model.places import DividedLinks, node_place
from rfem_jax.mechanics.model.sources import ForceNodes
from rfem_jax.mechanics.model.topology import BASE, Topology


def joint_laws(parts: Parts, topology: Topology) -> dict[str, JointLaw]:
    """The forces along joint coordinates, by their names."""
    laws = {}
    for force in parts.forces:
        if isinstance(force, JointFriction) or not isinstance(force, JointForce):
            continue
        joint = topology.joints.index(force.joint)
        n = force.coordinate(parts.joint(force.joint))
        laws[force.name] = joint_law(force, topology.own_coordinates[joint][n], topology.own_positions[joint][n])
    return laws


def coupling_laws(parts: Parts, topology: Topology) -> dict[str, CouplingLaw]:
    """The couplings of joint coordinates, by their names."""
    laws = {}
    for force in parts.forces:
        if isinstance(force, Coupling):
            joints = [topology.joints.index(name) for name in force.joints]
            own = [force.coordinate(side, parts.joint(name)) for side, name in enumerate(force.joints)]
            rates, places = (
                (one[joints[0]][own[0]], one[joints[1]][own[1]])
                for one in (topology.own_coordinates, topology.own_positions)
            )
            laws[force.name] = coupling_law(force, rates, places)
    return laws


def frictions(parts: Parts, topology: Topology) -> dict[str, Friction]:
    """Friction in joints, by its names."""
    frictions = {}
    for force in parts.forces:
        if isinstance(force, JointFriction):
            joint, described = topology.joints.index(force.joint), parts.joint(force.joint)
            n, places = force.coordinate(described), (None, None)
            if not described.cut:
                places = topology.own_coordinates[joint][n], topology.own_positions[joint][n]
            frictions[force.name] = friction_law(force, described, joint, *places)
    return frictions


def springs(parts: Parts, topology: Topology) -> dict[str, CompliantSpring]:
    """The springs of compliant joints by names as "A.radial"."""
    springs = {}
    for j, joint in enumerate(topology.joints):
        for spring in parts.springs_of(joint):
            if j < topology.n_links:
                named = list(enumerate(topology.kind(j).freedoms))
                at = [n for n, one in named if f"{'TR'[one.rotation]}_{'xyz'[one.axis]}" in spring.motions]
                rates, numbers = topology.coordinates[j], topology.positions[j]
                law = compliant_spring(spring, tuple(rates[n] for n in at), tuple(numbers[n] for n in at), ())
            else:
                law = compliant_spring(spring, (), (), _rows_of(topology, j, spring.motions))
            springs[f"{joint}.{spring.name}"] = law
    return springs


def _rows_of(topology: Topology, cut: int, motions: Sequence[str]) -> tuple[int, ...]:
    """Closure equations of a cut joint that are the laws of a spring on these motions."""
    nominal, rows = topology.kind(cut).nominal, topology.constraints[cut - topology.n_links]
    of_centre = rows[: len(nominal.across)]
    if motions[0][0] == "R":
        return tuple(rows[len(of_centre) :])
    return tuple(k for k, axis in zip(of_centre, nominal.across) if f"T_{'xyz'[axis]}" in motions)


def force_nodes(mechanism: Mechanism, links: DividedLinks) -> ForceNodes:
    """The nodes of the ends of all forces at points and between them, by the names of the forces."""
    named_nodes = []
    for force in mechanism.point_forces:
        nodes = tuple(links.attach(name, place, False).node for name, place in force.ends())
        if isinstance(force, BetweenPoints) and nodes[0] == nodes[1]:
            raise InputError(
                f"Argument `points` of force `{force.name}` must move against each other, but both lie on one rigid "
                f"finite element of link `{force.links[0]}`; move them apart, or divide the link more finely."
            )
        named_nodes.append((force.name, nodes))
    return tuple(named_nodes)


def frame_forces(parts: Parts, topology: Topology, links: Sequence[Link], points: ForceNodes) -> dict[str, FrameForce]:
    """The forces at points and between them, by their names."""
    elements: dict[str, FrameForce] = {}
    # Of NumPy, and with their type: for other arrays JAX compiles a program in every process.
    nodes, unit = dict(points), jnp.asarray(np.eye(3), jnp.float64)
    base = NodeFrame(BASE, unit, jnp.asarray(np.zeros(3), jnp.float64))
    for force in parts.forces:
        if not isinstance(force, AtPoint | BetweenPoints):
            continue
        frames = []
        for node, (_, place) in zip(nodes[force.name], force.ends(), strict=True):
            position = jnp.asarray(array_of(node_place(topology, links, node, place, False)), jnp.float64)
            frames.append(NodeFrame(node, unit, position))
        if isinstance(force, BetweenPoints):
            elements[force.name] = spring_between(force, *frames)
        else:
            elements[force.name] = load_at(force, base, frames[0])
    return elements


def line_loads(parts: Parts, topology: Topology) -> dict[str, LineLoad]:
    """The forces along links, by their names."""
    lines = [force for force in parts.forces if isinstance(force, DistributedForce)]
    return {force.name: line_load(force, topology.links.index(force.link), parts.link(force.link)) for force in lines}


def carried_points(
    parts: Parts, topology: Topology, links: Sequence[Link], nodes: ForceNodes
) -> dict[str, CarriedPoint]:
    """The points whose paths are followed, by their names."""
    carriers, carried = dict(nodes), {}
    for point in parts.points:
        if isinstance(point, NamedPoint):
            continue
        (node,) = carriers[point.name]
        position = jnp.asarray(array_of(node_place(topology, links, node, point.place, False)), jnp.float64)
        observer = BASE if point.relative_to == "base" else topology.links.index(point.relative_to)
        carried[point.name] = CarriedPoint(node, observer, position)
    return carried
