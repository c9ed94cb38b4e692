"""From a described mechanism to the arrays of a model, before its loops are closed.

Place in the pipeline: description, places, acting_laws -> **building** -> discretisation.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax import Array

from rfem_jax.description.basics.errors import InputError
from rfem_jax.description.basics.joint_kinds import KINDS, JointKind, compliant
from rfem_jax.description.basics.numbers import Number, array_of, rotation_of_angles, traced
from rfem_jax.description.mechanism.joints import Joint
from rfem_jax.description.mechanism.links import GRADIENTS, Link
from rfem_jax.description.mechanism.mechanism import EQUILIBRIUM, MINIMUM_NORM, Mechanism
from rfem_jax.description.mechanism.point_forces import AtPoint, BetweenPoints
from rfem_jax.description.mechanism.points import NamedPoint
from rfem_jax.description.mechanism.reduced_bodies import ReducedBody
from rfem_jax.description.mechanism.sections import CoupledSection, plane_edges, plane_names
from rfem_jax.description.parameters.parts import Parts, parts_of
from rfem_jax.mechanics.laws.bearings import bearing_capacities
from rfem_jax.mechanics.laws.clearances import clearance_name, pin_in_bush
from rfem_jax.mechanics.laws.frame_forces import NodeFrame
from rfem_jax.mechanics.model.acting_laws import (
    carried_points,
    coupling_laws,
    force_nodes,
    frame_forces,
    frictions,
    joint_laws,
    line_loads,
    springs,
)
from rfem_jax.mechanics.model.form import QUARTER, Attached, form_of, require_turned
from rfem_jax.mechanics.model.model import Model, Sections
from rfem_jax.mechanics.model.named_points import with_named_points
from rfem_jax.mechanics.model.orientations import quaternion_of_angles
from rfem_jax.mechanics.model.places import Attachment, DividedLinks, all_masses, masses_of, node_place, place_on
from rfem_jax.mechanics.model.profiles import profile_of, taper_of
from rfem_jax.mechanics.model.sources import ForceNodes, source_of
from rfem_jax.mechanics.model.superelements import TENSOR_ROWS, Superelement, reduced_link, superelement_of
from rfem_jax.mechanics.model.topology import BASE, Topology
from rfem_jax.mechanics.model.warmth import warmed


def build_model(mechanism: Mechanism, elements: dict[str, int], exact: bool = False) -> Model:
    """Arrays of a mechanism whose links have the given numbers of rfes (by name).

    The start coordinates are the description's approximate ones; `discretise` closes the loops.

    **Raises:** `InputError` if a tree joint does not lie on the first rfe of its link.
    """
    parts = parts_of(mechanism)
    structure = _structure_of(mechanism, parts, elements, exact)
    model = arrays_of(parts, structure)
    return replace(model, source=source_of(parts, mechanism.driven_motions, structure.points, structure.products))


class PartStructure(NamedTuple):
    """The part of a mechanism that does not change with its numbers: topology; points: nodes of the ends of the forces
    at points, and of the points whose paths are followed, by their names; products: whether point masses may have
    products of inertia."""

    topology: Topology
    points: ForceNodes
    products: bool


def _structure_of(mechanism: Mechanism, parts: Parts, elements: dict[str, int], exact: bool) -> PartStructure:
    """Topology of the parts: the rigid bodies, and the joints, masses and forces on each."""
    links = [mechanism.link(joint.child) for joint in mechanism.tree_joints]
    discretised = DividedLinks(tuple(links), tuple(elements[link.name] for link in links))
    tree = {joint.child: joint for joint in parts.joints if not joint.cut}
    joints = [tree[link.name] for link in links] + [j for j in parts.joints if j.cut]
    parents = [discretised.attach(j.parent, j.position, True) for j in joints]
    children = [discretised.attach(j.child, j.child_position, j.cut) for j in joints]
    _require_first_rfes(joints[: len(links)], children)
    masses = [(i, mass) for i, link in enumerate(links) for mass in masses_of(link)]
    acted = force_nodes(mechanism, discretised)
    ideal = [one for one in mechanism.couplings if one.ideal]
    shaped = any(link.course or link.form_errors for link in links) or any(
        isinstance(section, CoupledSection) for link in links for section in link.sections
    )
    followed = (
        (one.name, (discretised.attach(one.link, one.place, False).node,))
        for one in parts.points
        if not isinstance(one, NamedPoint)
    )
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
        masses=tuple(discretised.holder(i, mass) for i, mass in masses),
        minimum_norm=mechanism.redundant_reactions == MINIMUM_NORM,
        exact=exact,
        holders=tuple(sorted({node for _, nodes in acted for node in nodes if node >= len(links)})),
        sprung=tuple(j.sprung for j in joints) if any(j.compliance or j.clearance for j in joints) else (),
        clearances=tuple(n for n, j in enumerate(joints) if j.clearance),
        settles=mechanism.start == EQUILIBRIUM,
        plane=mechanism.plane,
        massless=tuple(i for i, link in enumerate(links) if link.mass == 0.0),
        ideal=tuple(one.name for one in ideal),
        stations=_stations(links, discretised) if any(link.stations for link in links) or shaped else (),
        slender=tuple(i for i, link in enumerate(links) if discretised.elements[i] > 1 and link.slender),
        coupled=tuple(sorted({_coordinate(joints, *motion) for one in ideal for motion in one.coordinates})),
        shaped=shaped,
        curved=tuple(i for i, link in enumerate(links) if link.course),
        reduced=tuple(
            reduced_link(i, link.body)
            for i, link in enumerate(links)
            if isinstance(link.body, ReducedBody) and discretised.elements[i] > 1
        ),
    )
    require_turned(links, mechanism.plane)
    _require_one_of(topology)
    return PartStructure(topology, (*acted, *followed), any(any(mass.products) for _, mass in masses))


def _require_one_of(topology: Topology) -> None:
    """Raise InputError for links that neither stretch nor shear beside links with forms: the kinematics of the former
    knows lever arms along the links alone."""
    if topology.slender and topology.shaped:
        names = ", ".join(f"`{topology.links[l]}`" for l in topology.slender)
        raise InputError(
            f"Argument `flexibility` of {names} must be left out in a mechanism in which a link has an axis, a bow or "
            'a section that couples directions, but is ["bending", "torsion"]; leave it out.'
        )


def _stations(links: Sequence[Link], discretised: DividedLinks) -> tuple[tuple[int, ...], ...]:
    """Of every link the rfes that hold its stations inside."""
    held = []
    for i, link in enumerate(links):
        n = discretised.elements[i]
        inside = [float(one.x) / link.length for one in link.stations if one.x is not None]
        held.append(tuple(0 if n == 1 else int(np.clip(x * (n - 1) + 0.5, 0, n - 1)) for x in inside))
    return tuple(held)


def arrays_of(parts: Parts, structure: PartStructure) -> Model:
    """Arrays of parts whose numbers may be traced, at their temperatures; the structure may come from other numbers."""
    topology, points, products = structure
    parts = warmed(parts)
    links = [parts.link(name) for name in topology.links]
    joints = [parts.joint(name) for name in topology.joints]
    seats = zip(joints, topology.parents, strict=True)
    bores = zip(joints, topology.children, strict=True)
    masses = all_masses(links)
    held = zip(topology.masses, masses, strict=True)
    start = [_start(j, topology.kind(l)) for l, j in enumerate(joints[: len(links)])]
    model = Model(
        topology=topology,
        length=_array([link.length for link in links]),
        section=_sections(links, parts.plane),
        parent_rotation=_rotations([j.orientation for j in joints], parts.plane),
        parent_position=_columns([node_place(topology, links, node, j.position, True) for j, node in seats]),
        child_rotation=_rotations([j.child_orientation for j in joints], parts.plane),
        child_position=_columns([node_place(topology, links, node, j.child_position, j.cut) for j, node in bores]),
        point_mass=_array([mass.mass for mass in masses]),
        point_position=_columns([node_place(topology, links, node, mass.position, False) for node, mass in held]),
        point_inertia=_columns([mass.inertia for mass in masses]),
        start_joints=_array([value for values in start for value in values]),
        cut_angles=_array([0.0] * (len(joints) - len(links))),
        gravity=_array(parts.gravity),
        forces=joint_laws(parts, topology) or None,
        couplings=coupling_laws(parts, topology) or None,
        point_products=_columns([mass.products for mass in masses]) if products else None,
        frame_forces=frame_forces(parts, topology, links, points) or None,
        friction=frictions(parts, topology) or None,
        springs=(springs(parts, topology) or None) if topology.sprung else None,
        bearings=bearing_capacities(joints) or None,
        start_rates=_start_rates(joints[: len(links)], topology),
        reaction_length=reaction_length(parts) if topology.minimum_norm else None,
        points=carried_points(parts, topology, links, points) or None,
        line_loads=line_loads(parts, topology) or None,
        shaking_point=None if parts.shaking_point is None else _array(parts.shaking_point),
        curvature=_curvatures(links),
        superelements=_superelements(links, topology),
    )
    profiles = tuple(profile_of(link, parts.plane, topology.shaped) for link in links)
    if topology.shaped:
        attached = _attached(parts, topology, links, joints, points)
        fractions = [topology.fractions(l) for l in range(topology.n_links)]
        form = form_of(links, parts.plane, fractions, attached)
        model = replace(model, profiles=profiles, form=form)
    elif any(profiles):
        ends = [np.cumsum([0.0, *topology.fractions(l)[0]]) for l in range(topology.n_links)]
        model = replace(model, profiles=profiles, taper=taper_of(links, ends, parts.plane))
    model = with_named_points(model, [one.name for one in parts.points if isinstance(one, NamedPoint)])
    return _with_clearances(model, joints) if topology.clearances else model


def _attached(
    parts: Parts, topology: Topology, links: Sequence[Link], joints: Sequence[Joint], points: ForceNodes
) -> Attached:
    """What is fixed to links whose forms count."""

    def held(node: int, position: Sequence[Number] | None, at_end: bool) -> tuple[int, Any]:
        if node == BASE:
            return BASE, None
        index = topology.link_of(node)
        return index, place_on(links[index], position, at_end)

    nodes = dict(points)
    return Attached(
        [held(node, joint.position, True) for joint, node in zip(joints, topology.parents, strict=True)],
        [held(node, joint.child_position, joint.cut) for joint, node in zip(joints, topology.children, strict=True)],
        [held(node, mass.position, False) for node, mass in zip(topology.masses, all_masses(links), strict=True)],
        {
            force.name: [held(node, place, False) for node, (_, place) in zip(nodes[force.name], force.ends())]
            for force in parts.forces
            if isinstance(force, AtPoint | BetweenPoints)
        },
    )


def reaction_length(parts: Parts) -> Array:
    """The length [m] over which moments count in the norm of reactions: the longest link unless given."""
    longest = array_of([link.length for link in parts.links]).max()
    return jnp.asarray(longest if parts.reaction_length is None else parts.reaction_length, jnp.float64)


def _with_clearances(model: Model, joints: Sequence[Joint]) -> Model:
    """The model with the contacts of its joints, which are elements between the frames on both sides."""
    topology, elements = model.topology, dict(model.frame_forces or {})
    for j in topology.clearances:
        clearance = joints[j].clearance
        assert clearance is not None
        seat = NodeFrame(topology.parents[j], model.parent_rotation[:, :, j], model.parent_position[:, j])
        bore = NodeFrame(topology.children[j], model.child_rotation[:, :, j], model.child_position[:, j])
        elements[clearance_name(joints[j].name)] = pin_in_bush(clearance, seat, bore)
    return replace(model, frame_forces=elements)


def _coordinate(joints: Sequence[Joint], joint: str, motion: str) -> int:
    """Index among the rates of a free motion about or along one axis; joints of the tree come first."""
    index = [one.name for one in joints].index(joint)
    # Motions about any axis come last, so that those before have one coordinate each.
    kinds = [compliant(KINDS[one.kind], one.sprung) for one in joints[: index + 1]]
    return sum(len(kind.freedoms) for kind in kinds[:index]) + kinds[index].motions.index(motion)


def _require_first_rfes(joints: Sequence[Joint], children: Sequence[Attachment]) -> None:
    """Raise InputError for the first tree joint that does not lie on rfe 0 of its link."""
    for joint, child in zip(joints, children):
        if child.node >= len(joints):
            raise InputError(
                f"Argument `child_position` of joint {joint.name!r} must lie on the first rigid "
                f"finite element of link {joint.child!r}, or at the first interface of its reduced body, but is "
                f"{joint.child_position}: a tree joint carries its link there. Swap the link's ends or cut "
                "this joint instead."
            )


def _start(joint: Joint, kind: JointKind) -> list[Number]:
    """Start of a tree joint as numbers of the position, zero along springs: its three angles as a quaternion if it
    turns about any axis."""
    values: list[Number] = [0.0] * len(kind.freedoms)
    for n, value in zip(kind.own, joint.start_values, strict=True):
        values[n] = value
    if not kind.ball:
        return values
    # No drive holds these angles: they are numbers of the description, not of a design.
    return [*values[:-3], *quaternion_of_angles(np.array(values[-3:], dtype=float)).tolist()]


def _start_rates(joints: Sequence[Joint], topology: Topology) -> Array | None:
    """Initial rates of the coordinates of the tree joints, zero where none is given; None for a mechanism without
    initial rates."""
    if all(rate is None for joint in joints for rate in joint.start_rates):
        return None
    values: list[Number] = [0.0] * topology.n_freedoms
    for at, joint in zip(topology.own_coordinates, joints, strict=True):
        for k, rate in zip(at, joint.start_rates, strict=True):
            values[k] = 0.0 if rate is None else rate
    return _array(values)


def _sections(links: Sequence[Link], plane: str) -> Sections:
    properties = [link.properties for link in links]
    y, z = plane_names(plane)  # along the hinges of the plane, and across them

    def row(name: str) -> Array:
        return _array([getattr(p, name) for p in properties])

    def rows(*names: str) -> Array:
        return jnp.asarray(array_of([[getattr(p, name) for p in properties] for name in names]), jnp.float64)

    return Sections(
        stiffness=rows("axial", f"shear_{y}", f"shear_{z}", "torsion", f"bending_{y}", f"bending_{z}"),
        line_density=_array(
            [link.beam_mass / link.length if link.stations else p.line_density for link, p in zip(links, properties)]
        ),
        rotary=rows("rotary_x", f"rotary_{y}", f"rotary_{z}"),
        damping=row("damping"),
        edges=tuple(_edge(link, plane) for link in links),
    )


def _curvatures(links: Sequence[Link]) -> Array | None:
    """Rotations about y and z per length (2, links) [1/m] by which links bend without load, as the temperature rises
    across them; None where no link says so (theory (2.21))."""
    if all(getattr(link, name) is None for link in links for name in GRADIENTS):
        return None

    def bend(link: Link, name: str) -> Number:
        gradient = getattr(link, name)
        return 0.0 if gradient is None or link.expansion is None else link.expansion * gradient

    y, z = GRADIENTS
    rows = [[bend(link, z) for link in links], [-bend(link, y) for link in links]]
    return jnp.asarray(array_of(rows), jnp.float64)


def _superelements(links: Sequence[Link], topology: Topology) -> tuple[Superelement, ...] | None:
    """The superelements of links with reduced bodies."""
    bodies = [links[one.link].body for one in topology.reduced]
    return tuple(superelement_of(body, body.damping) for body in bodies if isinstance(body, ReducedBody)) or None


def _array(values: Sequence[Number]) -> Array:
    """Numbers (n,)."""
    return jnp.asarray(array_of(list(values)), jnp.float64)  # with its type: without, JAX compiles a program


def _edge(link: Link, plane: str) -> Array | None:
    """Stresses at the edge of a link's section per unit of its loads; None if the section does not give its edge."""
    if not all(section.edge_stresses() for section in link.sections):
        return None
    if isinstance(link.body, ReducedBody) and link.body.stresses is not None and link.flexible:
        return jnp.zeros((TENSOR_ROWS, 1))
    points = () if link.section is None else plane_edges(link.section.edge_stresses(), plane)
    return jnp.asarray(array_of([list(point) for point in points]).T, jnp.float64) if points else None


def _columns(rows: Sequence[Sequence[Number]]) -> Array:
    """Vectors (3, n)."""
    return jnp.asarray(array_of([list(row) for row in rows]).reshape(-1, 3).T, jnp.float64)


def _rotations(orientations: Sequence[Sequence[Number]], plane: str) -> Array:
    """Rotations (3, 3, n) by angles about x, y, z, from the axes of joints in a plane (theory (2.22))."""
    rotations = [rotation_of_angles(angles) for angles in orientations]
    if plane == "xy":
        rotations = [rotation @ QUARTER for rotation in rotations]
    if traced(rotations):
        return jnp.stack([jnp.asarray(rotation) for rotation in rotations], axis=-1)
    return jnp.asarray(np.stack(rotations, axis=-1), jnp.float64)
