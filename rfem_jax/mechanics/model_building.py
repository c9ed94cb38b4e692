"""From a described mechanism to the arrays of a model, before its loops are closed.

Place in the pipeline: description -> **model_building** -> discretisation.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from rfem_jax.description.errors import InputError
from rfem_jax.description.forces import JointFriction
from rfem_jax.description.joint_kinds import KINDS, JointKind, compliant
from rfem_jax.description.joints import Joint
from rfem_jax.description.links import Link
from rfem_jax.description.mechanism import Mechanism
from rfem_jax.description.point_forces import AtPoint, BetweenPoints
from rfem_jax.mechanics.bearings import bearing_capacities
from rfem_jax.mechanics.frame_forces import FrameForce, NodeFrame
from rfem_jax.mechanics.friction_laws import Friction, friction_law
from rfem_jax.mechanics.joint_laws import JointLaw, joint_law
from rfem_jax.mechanics.joint_springs import CompliantSpring, compliant_spring
from rfem_jax.mechanics.model import BASE, Model, Sections, Topology, rfe_fractions
from rfem_jax.mechanics.orientations import quaternion_of_angles
from rfem_jax.mechanics.point_laws import load_at, spring_between


def build_model(mechanism: Mechanism, elements: dict[str, int], exact: bool = False) -> Model:
    """Arrays of a mechanism whose links have the given numbers of rfes (by name).

    The start coordinates are the description's approximate ones; `discretise` closes the loops.

    **Raises:** `InputError` if a tree joint does not lie on the first rfe of its link.
    """
    links = _links_in_tree_order(mechanism)
    discretised = _Links(tuple(links), tuple(elements[link.name] for link in links))
    tree = {joint.child: joint for joint in mechanism.joints if not joint.cut}
    joints = [tree[link.name] for link in links] + [j for j in mechanism.joints if j.cut]
    parents = [discretised.attach(j.parent, j.position, True) for j in joints]
    children = [discretised.attach(j.child, j.child_position, j.cut) for j in joints]
    _require_first_rfes(joints[: len(links)], children)
    masses = [(i, mass) for i, link in enumerate(links) for mass in _masses_of(link)]
    located = [discretised.locate(i, mass.position) for i, mass in masses]
    elements_between = _frame_forces(mechanism, discretised)
    topology = Topology(
        links=tuple(link.name for link in links),
        joints=tuple(j.name for j in joints),
        joint_order=tuple(j.name for j in mechanism.joints),
        error_names=tuple(mechanism.error_names),
        kinds=tuple(j.kind for j in joints),
        parents=tuple(p.node for p in parents),
        children=tuple(c.node for c in children),
        parent_at_end=tuple(p.at_end for p in parents),
        child_at_end=tuple(c.at_end for c in children),
        elements=discretised.elements,
        drives=tuple(_coordinate(joints, *motion) for motion in mechanism.driven_motions),
        masses=tuple(node for node, _ in located),
        minimum_norm=mechanism.redundant_reactions == "minimum_norm",
        exact=exact,
        holders=_holders(elements_between, len(links)),
        sprung=tuple(j.sprung for j in joints) if any(j.compliance for j in joints) else (),
    )
    return Model(
        topology=topology,
        length=jnp.asarray([link.length for link in links]),
        section=_sections(links),
        parent_rotation=_rotations([j.orientation for j in joints]),
        parent_position=_columns([p.position for p in parents]),
        child_rotation=_rotations([j.child_orientation for j in joints]),
        child_position=_columns([c.position for c in children]),
        point_mass=jnp.asarray(np.array([mass.mass for _, mass in masses], dtype=float)),
        point_position=_columns([position for _, position in located]),
        point_inertia=_columns([mass.inertia for _, mass in masses]),
        start_joints=jnp.asarray(
            np.concatenate([_start(j, topology.kind(l)) for l, j in enumerate(joints[: len(links)])])
        ),
        cut_angles=jnp.zeros(len(joints) - len(links)),
        gravity=jnp.asarray(mechanism.gravity, dtype=float),
        forces=_joint_laws(mechanism, topology) or None,
        point_products=_products([mass for _, mass in masses]),
        frame_forces=elements_between or None,
        friction=_frictions(mechanism, topology) or None,
        springs=_springs(joints, topology) if topology.sprung else None,
        bearings=bearing_capacities(joints) or None,
    )


class _Mass(NamedTuple):
    """A point mass, or a body: mass [kg], its centre [m] in the link frame, principal moments and products of inertia
    (J_xy, J_xz, J_yz) [kg m^2]."""

    mass: float
    position: Sequence[float]
    inertia: Sequence[float]
    products: Sequence[float] = (0.0, 0.0, 0.0)


def _masses_of(link: Link) -> list[_Mass]:
    """The body of a link, if it has one, and its point masses."""
    found = [_Mass(point.mass, point.position, point.inertia) for point in link.point_masses]
    if link.body is None:
        return found
    tensor = link.body.tensor
    products = (tensor[0, 1], tensor[0, 2], tensor[1, 2])
    return [_Mass(link.body.mass, link.body.centre, np.diag(tensor).tolist(), products), *found]


def _products(masses: Sequence[_Mass]) -> Array | None:
    """Products of inertia (3, masses), None where all are zero."""
    return _columns([mass.products for mass in masses]) if any(any(mass.products) for mass in masses) else None


def _coordinate(joints: Sequence[Joint], joint: str, motion: str) -> int:
    """Index among the rates of a free motion about or along one axis; joints of the tree come first."""
    index = [one.name for one in joints].index(joint)
    # Motions about any axis come last, so that those before have one coordinate each.
    kinds = [compliant(KINDS[one.kind], one.sprung) for one in joints[: index + 1]]
    return sum(len(kind.freedoms) for kind in kinds[:index]) + kinds[index].motions.index(motion)


def _joint_laws(mechanism: Mechanism, topology: Topology) -> dict[str, JointLaw]:
    """The forces along joint coordinates, by their names."""
    found = {}
    for force in mechanism.joint_forces:
        if isinstance(force, JointFriction):
            continue
        joint = topology.joints.index(force.joint)
        n = force.coordinate(mechanism.joint(force.joint))
        found[force.name] = joint_law(force, topology.own_coordinates[joint][n], topology.own_positions[joint][n])
    return found


def _frictions(mechanism: Mechanism, topology: Topology) -> dict[str, Friction]:
    """Friction in joints, by its names."""
    found = {}
    for force in mechanism.forces:
        if isinstance(force, JointFriction):
            joint, described = topology.joints.index(force.joint), mechanism.joint(force.joint)
            n, places = force.coordinate(described), (None, None)
            if not described.cut:
                places = topology.own_coordinates[joint][n], topology.own_positions[joint][n]
            found[force.name] = friction_law(force, described, joint, *places)
    return found


def _springs(joints: Sequence[Joint], topology: Topology) -> dict[str, CompliantSpring]:
    """The springs of compliant joints by names as "A.radial"."""
    found = {}
    for j, joint in enumerate(joints):
        for spring in joint.springs:
            if j < topology.n_links:
                named = list(enumerate(topology.kind(j).freedoms))
                at = [n for n, one in named if f"{'TR'[one.rotation]}_{'xyz'[one.axis]}" in spring.motions]
                rates, numbers = topology.coordinates[j], topology.positions[j]
                made = compliant_spring(spring, tuple(rates[n] for n in at), tuple(numbers[n] for n in at), ())
            else:
                made = compliant_spring(spring, (), (), _rows_of(topology, j, spring.motions))
            found[f"{joint.name}.{spring.name}"] = made
    return found


def _rows_of(topology: Topology, cut: int, motions: Sequence[str]) -> tuple[int, ...]:
    """Closure equations of a cut joint that are the laws of a spring on these motions."""
    nominal, rows = topology.kind(cut).nominal, topology.constraints[cut - topology.n_links]
    of_centre = rows[: len(nominal.across)]
    if motions[0][0] == "R":
        return tuple(rows[len(of_centre) :])
    return tuple(k for k, axis in zip(of_centre, nominal.across) if f"T_{'xyz'[axis]}" in motions)


def _frame_forces(mechanism: Mechanism, links: "_Links") -> dict[str, FrameForce]:
    """The forces at points and between them, by their names."""
    found: dict[str, FrameForce] = {}
    for force in mechanism.point_forces:
        frames = []
        for name, place in force.ends():
            node, position, _ = links.attach(name, place, False)
            frames.append(NodeFrame(node, jnp.eye(3), jnp.asarray(position, float)))
        if not isinstance(force, BetweenPoints):
            assert isinstance(force, AtPoint)
            found[force.name] = load_at(force, NodeFrame(BASE, jnp.eye(3), jnp.zeros(3)), frames[0])
            continue
        if frames[0].node == frames[1].node:
            raise InputError(
                f"Argument `points` of force `{force.name}` must move against each other, but both lie on one rigid "
                f"finite element of link `{force.links[0]}`; move them apart, or divide the link more finely."
            )
        found[force.name] = spring_between(force, *frames)
    return found


def _holders(elements: dict[str, FrameForce], n_links: int) -> tuple[int, ...]:
    """The free rfes that elements act on."""
    nodes = {end.node for element in elements.values() for end in (element.parent, element.child)}
    return tuple(sorted(node for node in nodes if node >= n_links))


class _Attachment(NamedTuple):
    """One side of a joint: its node, its place in the node's frame [m], whether that is the far end of a link."""

    node: int
    position: np.ndarray
    at_end: bool


class _Links(NamedTuple):
    """The links in the order of the model, and their numbers of rfes."""

    links: tuple[Link, ...]
    elements: tuple[int, ...]

    def locate(self, index: int, position: Sequence[float]) -> tuple[int, np.ndarray]:
        """Node that holds a point of a link, and the point in the node's frame."""
        link, n = self.links[index], self.elements[index]
        _, middles = rfe_fractions(n)
        edge = np.clip(position[0] / link.length * (n - 1) + 0.5, 0, n - 1)
        i = 0 if n == 1 else int(min(edge, n - 1))
        if i == 0:
            return index, np.asarray(position)
        before = sum(n - 1 for n in self.elements[:index])
        return len(self.links) + before + i - 1, np.asarray(position) - [middles[i] * link.length, 0.0, 0.0]

    def attach(self, owner: str, position: Sequence[float] | None, at_end: bool) -> _Attachment:
        """One side of a joint; without a position it is at the link's end (`at_end`) or its start."""
        if owner == "base":
            return _Attachment(BASE, np.asarray((0.0, 0.0, 0.0) if position is None else position), False)
        index = [link.name for link in self.links].index(owner)
        link = self.links[index]
        if position is None:
            position = (link.length if at_end else 0.0, 0.0, 0.0)
        ends_there = abs(position[0] - link.length) <= 1e-12 * link.length
        return _Attachment(*self.locate(index, position), ends_there)


def _require_first_rfes(joints: Sequence[Joint], children: Sequence[_Attachment]) -> None:
    """Raise InputError for the first tree joint that does not lie on rfe 0 of its link."""
    for joint, (node, _, _) in zip(joints, children):
        if node >= len(joints):
            raise InputError(
                f"Argument `child_position` of joint {joint.name!r} must lie on the first rigid "
                f"finite element of link {joint.child!r}, but is {joint.child_position}: a tree "
                "joint carries its link there. Swap the link's ends or cut this joint instead."
            )


def _start(joint: Joint, kind: JointKind) -> np.ndarray:
    """Start of a tree joint as numbers of the position, zero along springs: its three angles as a quaternion if it
    turns about any axis."""
    values = np.zeros(len(kind.freedoms))
    values[list(kind.own)] = joint.start_values
    if not kind.ball:
        return values
    return np.concatenate([values[:-3], quaternion_of_angles(values[-3:])])


def _links_in_tree_order(mechanism: Mechanism) -> list[Link]:
    """By depth in the tree, else in the order of the description (`Mechanism.tree_joints` goes down to a link's
    children before its siblings)."""
    parent = {j.child: j.parent for j in mechanism.joints if not j.cut}

    def depth(name: str) -> int:
        return 0 if parent[name] == "base" else 1 + depth(parent[name])

    return sorted(mechanism.links, key=lambda link: depth(link.name))


def _sections(links: Sequence[Link]) -> Sections:
    properties = [link.properties for link in links]

    def rows(*names: str) -> Array:
        return jnp.asarray(np.array([[getattr(p, name) for p in properties] for name in names], dtype=float))

    return Sections(
        stiffness=rows("axial", "shear_y", "shear_z", "torsion", "bending_y", "bending_z"),
        line_density=rows("line_density")[0],
        rotary=rows("rotary_x", "rotary_y", "rotary_z"),
        damping=rows("damping")[0],
        edges=tuple(_edge(link) for link in links),
    )


def _edge(link: Link) -> Array | None:
    """Stresses at the edge of a link's section per unit of its loads; None where the edge is not known."""
    points = () if link.section is None else link.section.edge_stresses()
    return jnp.asarray(np.array(points, dtype=float).T) if points else None


def _orientation(angles: Sequence[float]) -> np.ndarray:
    """R = R_z R_y R_x of three angles about x, y, z."""
    cx, cy, cz = np.cos(angles)
    sx, sy, sz = np.sin(angles)
    rx = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]])
    ry = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]])
    rz = np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]])
    return rz @ ry @ rx


def _columns(rows: Sequence[Sequence[float] | np.ndarray]) -> Array:
    """Vectors (3, n)."""
    return jnp.asarray(np.array(rows, dtype=float).reshape(-1, 3).T)


def _rotations(orientations: Sequence[Sequence[float]]) -> Array:
    """Rotations (3, 3, n) by angles about x, y, z."""
    return jnp.asarray(np.stack([_orientation(o) for o in orientations], axis=-1))
