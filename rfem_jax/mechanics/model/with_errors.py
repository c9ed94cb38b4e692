"""The model with errors applied.

Place in the pipeline: model + errors -> **with_errors** -> kinematics, dynamics, loads.

`apply_errors` computes from model and errors the constants of the equations of motion: joint frames (theory (2.3) to
(2.6), every joint on both its sides), masses, inertias, stiffnesses. Everything that does not change in time is
computed here, once a simulation.
"""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float, Int

from rfem_jax.kernels import kernel
from rfem_jax.mechanics.algebra import vectors
from rfem_jax.mechanics.laws.clearances import clearance_name
from rfem_jax.mechanics.laws.frame_forces import FrameForce, NodeFrame
from rfem_jax.mechanics.laws.friction_laws import Friction
from rfem_jax.mechanics.laws.joint_laws import JointLaws
from rfem_jax.mechanics.laws.joint_springs import CompliantSpring
from rfem_jax.mechanics.laws.line_loads import LineLoad
from rfem_jax.mechanics.model.errors import AssemblyErrors, possible_errors
from rfem_jax.mechanics.model.form import (
    ActualForm,
    FormErrors,
    Held,
    Shaped,
    bodies_of,
    hinge_of,
    point_inertia,
    sde_stiffness,
    shaped,
    wave,
)
from rfem_jax.mechanics.model.model import CarriedPoint, Model
from rfem_jax.mechanics.model.superelements import Superelement
from rfem_jax.mechanics.model.topology import BASE, Topology


class FrameForceSet(eqx.Module):
    """All force elements of a mechanism, by their names; share: of their full wrenches, for load steps; lines: loads
    along links, which have their share likewise, None without any."""

    elements: dict[str, FrameForce]
    share: Float[Array, ""]
    lines: dict[str, LineLoad] | None = None


class ModelWithErrors(eqx.Module):
    """The constants of the equations of motion of one mechanism with its errors (SI units).

    seat_*, bore_*: frames of the joints relative to the parent's and the child's node (F E, F_c E_c).
    mass, centre, inertia: of all nodes; centre of mass relative to the node's reference point (link origin
        for rfe 0, middle of the segment for free rfes) and central inertia, both in the node's axes.
    inverse_inertia: inverse central inertia of the free rfes.
    rest: x of the free rfes' middles in the link frame, undeformed [m].
    stiffness: of the sde on the left of each free rfe, for du and dphi [N/m, N m/rad].
    damping: its time constant eta [s].
    lever_left, lever_right: x of the sde from the middles of its left and its right rfe [m].
    beam_middle: x of the middle of every rfe 0 [m].
    gravity: acceleration [m/s^2] in global axes.
    datum: the first base joint's nominal place, the zero level of gravity's energy [m].
    possible: 1, or 0 of errors that cannot be: these are then constants of the mechanism without errors.
    forces: along joint coordinates and of couplings of these, None without any; frame_forces: elements between frames
    on nodes, likewise; friction: in joints of the tree and cut ones, likewise; springs: of compliant joints, likewise;
    reaction_length: as of the model; points: whose paths are followed, likewise; bent: rotations about y and z [rad] of
    the sdes without load, None where links are straight; form: of links with forms, None where all are straight;
    superelements: of the links `Topology.reduced`, None without any. With forms rest and lever arms are vectors
    (3, rfes), and the stiffness a matrix (6, 6, rfes) in link axes.
    """

    topology: Topology = eqx.field(static=True)
    seat_rotation: Float[Array, "3 3 joints"]
    seat_position: Float[Array, "3 joints"]
    bore_rotation: Float[Array, "3 3 joints"]
    bore_position: Float[Array, "3 joints"]
    mass: Float[Array, " nodes"]
    centre: Float[Array, "3 nodes"]
    inertia: Float[Array, "3 3 nodes"]
    inverse_inertia: Float[Array, "3 3 rfes"]
    rest: Float[Array, " *axes rfes"]
    stiffness: Float[Array, "6 *deflections rfes"]
    damping: Float[Array, " rfes"]
    lever_left: Float[Array, " *axes rfes"]
    lever_right: Float[Array, " *axes rfes"]
    beam_middle: Float[Array, " links"]
    gravity: Float[Array, "3"]
    datum: Float[Array, "3"]
    possible: Float[Array, ""]
    forces: JointLaws | None = None
    frame_forces: FrameForceSet | None = None
    friction: dict[str, Friction] | None = None
    springs: dict[str, CompliantSpring] | None = None
    reaction_length: Float[Array, ""] | None = None
    points: dict[str, CarriedPoint] | None = None
    bent: Float[Array, "2 rfes"] | None = None
    form: ActualForm | None = None
    superelements: tuple[Superelement, ...] | None = None


@kernel
def apply_errors(model: Model, errors: AssemblyErrors) -> ModelWithErrors:
    """Apply the errors to the model, into which `designed` has put the numbers that deviate."""
    with jax.named_scope("apply_errors"):
        topology = model.topology
        possible = possible_errors(model, errors)
        errors = jax.tree.map(lambda x: jnp.where(possible, x, 0.0), errors)
        length = model.length + errors.length
        scale = length / model.length
        form = _form_errors(model, errors, scale)
        seat, bore = _sides(model, errors, form, scale)
        # P and P_c of theory (2.4): a crooked pin stresses nothing at the start angle.
        pin = vectors.product(vectors.rotation_z(errors.pin[1]), vectors.rotation_x(errors.pin[0]))
        start = vectors.rotation_y(_start_angles(model))
        pin_in_child = vectors.transposed_product(start, vectors.product(pin, start))
        sides = (vectors.product(seat[0], pin), seat[1]), (vectors.product(bore[0], pin_in_child), bore[1])
        mass, centre, inertia = _bodies(model, form, length, scale)
        n = topology.n_links
        return ModelWithErrors(
            topology=topology,
            seat_rotation=sides[0][0],
            seat_position=sides[0][1],
            bore_rotation=sides[1][0],
            bore_position=sides[1][1],
            mass=mass,
            centre=centre,
            inertia=inertia,
            inverse_inertia=_inverse_inertia(topology, inertia[:, :, n:]),
            beam_middle=length * np.array([topology.fractions(l)[1][0] for l in range(n)]),
            gravity=model.gravity,
            datum=model.parent_position[:, topology.parents.index(BASE)],
            forces=_joint_laws(model),
            frame_forces=_frame_forces(model, form, scale, sides),
            friction=model.friction,
            springs=model.springs,
            reaction_length=model.reaction_length,
            points=_points(model, form, scale, bore[1]),
            possible=possible.astype(float),
            superelements=model.superelements,
            **(_spring_damping_elements(model, length) if form is None else _shaped_elements(model, form, length)),
        )


def _inverse_inertia(topology: Topology, inertia: Float[Array, "3 3 rfes"]) -> Float[Array, "3 3 rfes"]:
    """Inverse inertias; of the free rfes of superelements, which have none, of any."""
    if topology.reduced:
        inertia = inertia + np.asarray(vectors.IDENTITY)[:, :, None] * topology.reduced_rfes
    return vectors.invert_positive(inertia)


def _form_errors(model: Model, errors: AssemblyErrors, scale: Array) -> FormErrors | None:
    """Errors of form of links, zero of those without; None where no link has a form."""
    if model.form is None:
        return None
    n = model.topology.n_links
    bow = jnp.zeros((2, n)) if errors.bow is None else errors.bow
    twist = jnp.where(np.isin(np.arange(n), model.topology.formed), errors.twist, 0.0)
    return FormErrors(scale, bow, twist, model.length)


def _sides(
    model: Model, errors: AssemblyErrors, form: FormErrors | None, scale: Array
) -> list[tuple[Float[Array, "3 3 joints"], Float[Array, "3 joints"]]]:
    """Frames of all joints on both sides."""
    topology = model.topology
    given = (
        (model.parent_rotation, model.parent_position, errors.seat, topology.parents, topology.parent_at_end, "seats"),
        (model.child_rotation, model.child_position, errors.bore, topology.children, topology.child_at_end, "bores"),
    )
    found = []
    for rotation, position, error, nodes, at_end, name in given:
        held: Held | None = None if model.form is None else getattr(model.form, name)
        turn = _turns(topology, errors.twist, nodes, at_end, held)
        found.append(
            _side(rotation, _displaced(model, form, position, nodes, held), error, nodes, scale, turn, topology)
        )
    return found


def _turns(
    topology: Topology, twist: Array, nodes: tuple[int, ...], at_end: tuple[bool, ...], held: Held | None
) -> Float[Array, " joints"]:
    """Angles [rad] by which the twists of links turn the frames of joints: evenly growing along links with errors of
    form (theory (1.32)), at the ends of others (2.5)."""
    link = np.array([0 if node < 0 else topology.link_of(node) for node in nodes])
    on_link = np.array([node >= 0 for node in nodes])
    part: Any = np.array(at_end, dtype=float)
    if topology.formed:
        assert held is not None, "such a model has a form"
        part = jnp.where(np.isin(link, topology.formed), held.share, part)
    return jnp.where(on_link, _link_values(twist, link) * part, 0.0)


def _displaced(
    model: Model,
    form: FormErrors | None,
    position: Float[Array, "3 n"],
    nodes: Sequence[int],
    held: Held | None,
) -> Float[Array, "3 n"]:
    """Places in frames of nodes with the twists, bows and cambers of their links; on links with an axis y and z as much
    longer as x becomes in what follows (theory (1.26), (1.32), (1.33))."""
    if form is None or model.form is None or held is None or not len(nodes):
        return position
    topology = model.topology
    link = np.array([0 if node == BASE else topology.link_of(node) for node in nodes])
    on_link = np.array([node != BASE for node in nodes])
    curved = np.isin(link, topology.curved) & on_link
    middles, of_nodes = model.form.middles, np.maximum(np.array(nodes), 0)
    apart = wave(jnp.asarray(held.share)) - wave(_link_values(jnp.asarray(middles.share), of_nodes))
    across = _link_values(form.bow, link) * apart[None]
    if middles.camber is not None and held.camber is not None:
        across = across + held.camber[:2] - _link_values(jnp.asarray(middles.camber[:2]), of_nodes)
    across = jnp.where(on_link[None], across, 0.0)
    longer = jnp.where(curved, _link_values(form.scale, link), 1.0)
    if topology.formed:
        turn = jnp.where(on_link, _link_values(form.twist, link) * held.share, 0.0)
        position = vectors.apply(vectors.rotation_x(turn), position)
    return jnp.concatenate([position[:1], position[1:] * longer[None] + across])


def _frame_forces(
    model: Model, form: FormErrors | None, scale: Array, sides: tuple[tuple[Array, Array], tuple[Array, Array]]
) -> FrameForceSet | None:
    """The force elements, whose frames lie on links that are `scale` times as long, or are those of joints: rotations
    (3, 3, joints) and positions (3, joints) on both `sides`."""
    if model.frame_forces is None and model.line_loads is None:
        return None
    elements, topology = {}, model.topology
    at_joints = {clearance_name(topology.joints[j]): j for j in topology.clearances}
    for name, element in (model.frame_forces or {}).items():
        if name in at_joints:
            j, ends = at_joints[name], (element.parent, element.child)
            frames = [NodeFrame(end.node, side[0][:, :, j], side[1][:, j]) for end, side in zip(ends, sides)]
        else:
            ends = (element.parent, element.child)
            if model.form is not None and name in model.form.elements:
                held = model.form.elements[name]
                several = [jax.tree.map(lambda x, k=k: x[..., k : k + 1], held) for k in range(held.share.shape[0])]
                ends = [_displaced_frame(model, form, *end) for end in zip(ends, [None, *several][-2:])]
            frames = [_scaled_frame(topology, frame, scale) for frame in ends]
        elements[name] = eqx.tree_at(lambda one: (one.parent, one.child), element, tuple(frames))
    return FrameForceSet(elements, jnp.ones(()), _line_loads(model, scale))


def _displaced_frame(model: Model, form: FormErrors | None, frame: NodeFrame, held: Held | None) -> NodeFrame:
    if held is None:
        return frame
    moved = _displaced(model, form, frame.position[:, None], [frame.node], held)
    return NodeFrame(frame.node, frame.rotation, moved[:, 0])


def _line_loads(model: Model, scale: Array) -> dict[str, LineLoad] | None:
    """The loads along links that became `scale` times as long."""
    if model.line_loads is None:
        return None
    stretched = {}
    for name, line in model.line_loads.items():
        ends = line.begin * scale[line.link], line.end * scale[line.link]
        stretched[name] = eqx.tree_at(lambda one: (one.begin, one.end), line, ends)
    return stretched


def _scaled_frame(topology: Topology, frame: NodeFrame, scale: Array) -> NodeFrame:
    """A frame on a link that became `scale` times as long."""
    if frame.node == BASE:
        return frame
    return NodeFrame(frame.node, frame.rotation, _stretched(topology, frame.node, frame.position, scale))


def _stretched(topology: Topology, node: int, position: Float[Array, "3"], scale: Array) -> Float[Array, "3"]:
    """A place on a link that became `scale` times as long."""
    return jnp.concatenate([position[:1] * scale[topology.link_of(node)], position[1:]])


def _points(
    model: Model, form: FormErrors | None, scale: Array, centres: Float[Array, "3 joints"]
) -> dict[str, CarriedPoint] | None:
    """The points whose paths are followed, on links that became `scale` times as long; `centres` of the joints on
    their children."""
    if model.points is None:
        return None

    def place(one: CarriedPoint) -> Array:
        if form is None or model.form is None or one.node == BASE:
            return one.position
        # Of straight links alone, which may have errors of form.
        link = model.topology.link_of(one.node)
        share = jnp.clip(model.form.middles.share[one.node] + one.position[0] / model.length[link], 0.0, 1.0)[None]
        _, camber = model.form.lines.of(link)
        held = Held(share, None if camber is None else camber.at(share * model.length[link]))
        return _displaced(model, form, one.position[:, None], [one.node], held)[:, 0]

    return {
        name: CarriedPoint(
            one.node,
            one.observer,
            _stretched(model.topology, one.node, place(one), scale) if one.joint is None else centres[:, one.joint],
            one.joint,
        )
        for name, one in model.points.items()
    }


def _joint_laws(model: Model) -> JointLaws | None:
    """Forces along joint coordinates, and couplings of these as they mesh at the start."""
    if model.forces is None and model.couplings is None:
        return None
    couplings = {name: one.starting_at(model.start_joints) for name, one in (model.couplings or {}).items()}
    return JointLaws(model.forces or {}, jnp.ones(()), couplings)


def _start_angles(model: Model) -> Float[Array, " joints"]:
    """Angles [rad] of all joints about y at the start, 0 of tree joints that are not revolute and have no pins."""
    topology, zero = model.topology, jnp.zeros(())
    if set(topology.kinds[: topology.n_links]) == {"revolute"} and not topology.sprung:
        return jnp.concatenate([model.start_joints, model.cut_angles])
    revolute = [topology.kinds[l] == "revolute" for l in range(topology.n_links)]
    angles = [model.start_joints[at[0]] if turns else zero for turns, at in zip(revolute, topology.own_positions)]
    return jnp.concatenate([jnp.stack(angles), model.cut_angles])


def with_structural_zeros(actual: ModelWithErrors) -> ModelWithErrors:
    """The constants with entries that are zero for all numbers and errors as constants of the program: a kernel leaves
    out the products with them.

    A segment's centre of mass lies on its axis, in its middle unless links have stations, and its inertia is diagonal,
    unless it has a point mass.
    """
    topology = actual.topology
    if topology.shaped:  # anything may be off the axis
        return actual
    n, nodes = topology.n_links, topology.n_links + topology.n_rfes
    plain = ~np.isin(np.arange(nodes), topology.masses)
    off_axis = np.array([False, True, True])[:, None] & plain
    off_axis[0, n:] = plain[n:] & (not topology.stations)
    off_diagonal = ~np.eye(3, dtype=bool)[:, :, None] & plain
    zeros = off_axis, off_diagonal, off_diagonal[:, :, n:]
    changed = actual.centre, actual.inertia, actual.inverse_inertia
    known = [jnp.where(zero, 0.0, x) for zero, x in zip(zeros, changed)]
    return eqx.tree_at(lambda m: (m.centre, m.inertia, m.inverse_inertia), actual, known)


def _side(
    rotation: Array,
    position: Array,
    error: Array,
    nodes: tuple[int, ...],
    scale: Array,
    turn: Float[Array, " joints"],
    topology: Topology,
) -> tuple[Float[Array, "3 3 joints"], Float[Array, "3 joints"]]:
    """Frames of all joints on one side: nominal frame, stretched and twisted link, error."""
    # F' of theory (2.5): x grows with the link, and frames turn with the twist.
    link = np.array([0 if node < 0 else topology.link_of(node) for node in nodes])
    on_link = np.array([node >= 0 for node in nodes])
    stretch = jnp.where(on_link, _link_values(scale, link), 1.0)
    position = jnp.concatenate([position[:1] * stretch[None], position[1:]])
    rotation = vectors.product(vectors.rotation_x(turn), rotation)
    # F' E with E = [R_z(delta_z) R_y(delta_y) R_x(delta_x), (d_x, d_y, d_z)] of theory (2.3), (2.17).
    tilt = vectors.rotation_x(error[0])
    if "delta_y" in topology.error_components:
        tilt = vectors.product(vectors.rotation_y(error[5]), tilt)
    tilt = vectors.product(vectors.rotation_z(error[1]), tilt)
    return vectors.product(rotation, tilt), position + vectors.apply(rotation, error[2:5])


def _bodies(
    model: Model, form: FormErrors | None, length: Array, scale: Array
) -> tuple[Float[Array, " nodes"], Float[Array, "3 nodes"], Float[Array, "3 3 nodes"]]:
    """Mass, centre of mass and central inertia of all nodes, point masses included."""
    topology = model.topology
    n_links, nodes = topology.n_links, topology.n_links + topology.n_rfes
    link, share, middle = _node_fractions(topology)
    lengths = _link_values(length, link)
    extent = share * lengths
    density, rotary = _link_values(model.section.line_density, link), _link_values(model.section.rotary, link)
    mass = density * extent
    slender = jnp.asarray(np.array([0.0, 1.0, 1.0]))[:, None] * (mass * extent**2 / 12.0)[None]
    principal = slender + rotary * extent[None]
    is_root = np.arange(nodes) < n_links
    axial = jnp.where(is_root, middle * lengths, 0.0)
    if model.taper is not None:  # theory (1.18), of the link as long as it is
        longer = _link_values(scale, link)
        mass, axial = model.taper.mass * longer, model.taper.centre * longer
        slender = jnp.asarray(np.array([0.0, 1.0, 1.0]))[:, None] * (model.taper.spread * longer**3)[None]
        principal = slender + model.taper.rotary * longer[None]
    beam_centre, of_beam = _x_vectors(axial), None
    if form is not None:
        mass, beam_centre, of_beam = _shaped_bodies(model, form)

    holder = np.array(topology.masses, dtype=int)
    point = _point_places(model, form, scale)
    # Sums at the nodes that hold them, by products: additions at places would be scatters.
    onto = (holder[:, None] == np.arange(nodes)).astype(float)
    total = mass + model.point_mass @ onto
    moment = mass[None] * beam_centre
    moment = moment + (model.point_mass[None] * point) @ onto
    if topology.massless or topology.reduced:
        there = total > 0.0
        centre = jnp.where(there[None], moment / jnp.where(there, total, 1.0)[None], 0.0)
    else:
        centre = moment / total[None]

    def steiner(m, r):
        identity = jnp.asarray(vectors.IDENTITY)[:, :, None]
        return m[None, None] * (vectors.dot(r, r)[None, None] * identity - r[:, None] * r[None])

    def diagonal(entries):
        return jnp.asarray(vectors.IDENTITY)[:, :, None] * entries[:, None]

    inertia = (diagonal(principal) if of_beam is None else of_beam) + steiner(mass, beam_centre - centre)
    added = diagonal(model.point_inertia) + steiner(model.point_mass, point - centre[:, holder])
    if model.point_products is not None:
        added = added + _off_diagonal(model.point_products)
    return total, centre, inertia + added @ onto


def _on_nodes(form: FormErrors, links: np.ndarray) -> FormErrors:
    """The errors of the links of nodes, as `form.shaped` takes them."""
    return FormErrors(*(_link_values(one, links) for one in form))


def _references(model: Model, form: FormErrors) -> Shaped:
    """The reference points of all nodes in the frames of their links."""
    assert model.form is not None
    whole = _on_nodes(form, _node_fractions(model.topology)[0])
    return shaped(model.form.middles, whole, hinge_of(model.topology.plane))


def _point_places(model: Model, form: FormErrors | None, scale: Array) -> Float[Array, "3 masses"]:
    held = None if model.form is None else model.form.masses
    point = _displaced(model, form, model.point_position, model.topology.masses, held)
    link = np.array([model.topology.link_of(node) for node in model.topology.masses], dtype=int)
    return jnp.concatenate([point[:1] * _link_values(scale, link)[None], point[1:]])


def point_places(model: Model, actual: ModelWithErrors) -> Float[Array, "3 masses"]:
    """Places [m] of point masses in the frames of their nodes, with the errors of their links."""
    middles = np.array([model.topology.fractions(l)[1][0] for l in range(model.topology.n_links)])
    scale = actual.beam_middle / middles / model.length
    return _point_places(model, None if actual.form is None else actual.form.errors, scale)


def _shaped_bodies(
    model: Model, form: FormErrors
) -> tuple[Float[Array, " nodes"], Float[Array, "3 nodes"], Float[Array, "3 3 nodes"]]:
    """Mass, centre from the reference point, and central inertia of the beams of all nodes."""
    assert model.form is not None
    whole = _on_nodes(form, _node_fractions(model.topology)[0])
    about = _references(model, form).position
    mass, moment, inertia = bodies_of(model.form.bodies, whole, about, hinge_of(model.topology.plane))
    there = mass > 0.0
    centre = jnp.where(there[None], moment / jnp.where(there, mass, 1.0)[None], 0.0)
    return mass, centre, inertia - point_inertia(mass, centre)


def _off_diagonal(products: Float[Array, "3 masses"]) -> Float[Array, "3 3 masses"]:
    """Symmetric matrices of J_xy, J_xz, J_yz, with zeros on the diagonal."""
    xy, xz, yz = products
    zero = jnp.zeros_like(xy)
    rows = (zero, xy, xz), (xy, zero, yz), (xz, yz, zero)
    return jnp.stack([jnp.stack(row) for row in rows])


def _node_fractions(topology: Topology) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Link, share of its length and middle of every node, in the order of the nodes."""
    fractions = [topology.fractions(l) for l in range(topology.n_links)]
    link = np.concatenate([np.arange(topology.n_links), topology.link_of_rfe])
    share, middle = (np.concatenate([[f[k][0] for f in fractions], *[f[k][1:] for f in fractions]]) for k in (0, 1))
    return link.astype(int), share, middle


def _spring_damping_elements(model: Model, length: Array) -> dict[str, Any]:
    """Rest position of every free rfe; stiffness, damping and lever arms of the sde on its left (theory (1.7),
    (1.8))."""
    topology = model.topology
    link = topology.link_of_rfe.astype(int)
    count = np.array(topology.elements, dtype=float)[link] - 1.0
    index = np.concatenate([np.arange(n - 1) for n in topology.elements]).astype(int)
    middles = [topology.fractions(l)[1] for l in range(topology.n_links)]
    left = np.concatenate([x[:-1] for x in middles]) if middles else np.zeros(0)
    right = np.concatenate([x[1:] for x in middles]) if middles else np.zeros(0)
    place = (index + 0.5) / np.maximum(count, 1.0)
    extent = _link_values(length, link)
    stiffness = _link_values(model.section.stiffness, link) * (count / extent)[None]
    if model.taper is not None:  # theory (1.17)
        stiffness = model.taper.stiffness * _link_values(model.length / length, link)[None]
    if topology.slender:  # the forces that keep their segments from stretching are no springs'
        stiffness = jnp.where((np.arange(6) < 3)[:, None] & topology.slender_rfes, 0.0, stiffness)
    return {
        "rest": jnp.asarray(right) * extent,
        "stiffness": stiffness,
        "damping": _link_values(model.section.damping, link),
        "lever_left": jnp.asarray(place - left) * extent,
        "lever_right": jnp.asarray(place - right) * extent,
        **_bends(model, link, extent / np.maximum(count, 1.0)),
    }


def _shaped_elements(model: Model, errors: FormErrors, length: Array) -> dict[str, Any]:
    """As `_spring_damping_elements`, of links with forms; places and lever arms are vectors (theory (1.22) to
    (1.24))."""
    topology, form, hinge = model.topology, model.form, hinge_of(model.topology.plane)
    assert form is not None
    link = topology.link_of_rfe.astype(int)
    whole, middles = _on_nodes(errors, link), _references(model, errors).position
    rest, inner = middles[:, topology.n_links :], np.ones(topology.n_rfes, dtype=bool)
    inner[[a for a, b in topology.ranges if b > a]] = False
    before = jnp.where(inner[None], jnp.roll(rest, 1, axis=1), 0.0)
    sdes = shaped(form.sdes, whole, hinge)
    begin, end = (shaped(one, whole, hinge).position for one in (form.begins, form.ends))
    count = np.array(topology.elements, dtype=float)[link] - 1.0
    return {
        "rest": rest,
        "stiffness": sde_stiffness(form.segments, whole, (sdes.position, begin, end), hinge, topology.reduced_rfes),
        "damping": _link_values(model.section.damping, link),
        "lever_left": sdes.position - before,
        "lever_right": sdes.position - rest,
        "form": ActualForm(form.lines, errors, sdes.axes, hinge),
        **_bends(model, link, _link_values(length, link) / np.maximum(count, 1.0)),
    }


def _bends(model: Model, link: Int[np.ndarray, " rfes"], apart: Array) -> dict[str, Array]:
    """Rotations of sdes, which are as far `apart` [m], on links that are bent without load."""
    return {} if model.curvature is None else {"bent": _link_values(model.curvature, link) * apart[None]}


def _link_values(values: Float[Array, "*k links"], links: Int[np.ndarray, " n"]) -> Float[Array, "*k n"]:
    """Values of given links, by a product: the transpose of an index would be an addition at places."""
    return values @ (np.arange(values.shape[-1])[:, None] == links).astype(float)


def _x_vectors(values: Array) -> Array:
    """Vectors (3, n) along x."""
    zero = jnp.zeros_like(values)
    return jnp.stack([values, zero, zero])
