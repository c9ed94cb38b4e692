"""Assembly errors, and the model with errors applied.

Place in the pipeline: model + errors -> **with_errors** -> kinematics, dynamics, loads.

`AssemblyErrors` are the deviations from the nominal mechanism (all zero: perfect); `apply_errors` computes
from model and errors the constants of the equations of motion: joint frames (theory (2.3) to (2.6), every joint
on both its sides), masses, inertias, stiffnesses.  Everything that does not change in time
is computed here, once a simulation.
"""

import dataclasses
from collections.abc import Mapping
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jax.core import Tracer
from jaxtyping import ArrayLike, Bool, Float, Int

from rfem_jax.compilation.naming import Names
from rfem_jax.compilation.program import Program
from rfem_jax.description.basics.errors import InputError, suggestion
from rfem_jax.description.basics.units import quantity
from rfem_jax.description.tolerances.error_catalogue import error_dimension
from rfem_jax.kernels import kernel
from rfem_jax.mechanics.algebra import vectors
from rfem_jax.mechanics.algebra.reordering import rows
from rfem_jax.mechanics.laws.clearances import clearance_name
from rfem_jax.mechanics.laws.frame_forces import FrameForceSet, NodeFrame
from rfem_jax.mechanics.laws.friction_laws import Friction
from rfem_jax.mechanics.laws.joint_laws import JointLaws
from rfem_jax.mechanics.laws.joint_springs import CompliantSpring
from rfem_jax.mechanics.model.model import BASE, Model, Topology, rfe_fractions

HALF_TURN = np.pi * (1.0 + 1e-12)  # rad


class Owners(NamedTuple):
    """Names of the joints and links that errors belong to, in the order of the arrays."""

    joints: tuple[str, ...]
    links: tuple[str, ...]

    def renamed(self, names: Names) -> "Owners":
        """With other names; called by `compilation.naming`."""
        return Owners(tuple(map(names.of, self.joints)), tuple(map(names.of, self.links)))


class AssemblyErrors(eqx.Module):
    """Deviations from the nominal mechanism, all zero by default.

    seat, bore: (delta_x, delta_z [rad], d_x, d_y, d_z [m]) of every joint in its parent and child, and delta_y
    [rad] last where any joint may have it (`Topology.error_components`); pin: tilts [rad] about x and z of a crooked
    pin, on both sides at once; length [m] and twist [rad] of every link; parameters: deviations of numbers of the
    description from their values [SI units], by their full names, which `designed` adds to these; None without any.
    owners: whose errors these are, so that no other mechanism takes them for its own.
    """

    seat: Float[Array, "components joints"]
    bore: Float[Array, "components joints"]
    pin: Float[Array, "2 joints"]
    length: Float[Array, " links"]
    twist: Float[Array, " links"]
    parameters: dict[str, Float[Array, ""]] | None = None
    owners: Owners | None = eqx.field(static=True, default=None)


def assembly_errors(model: Model, values: Mapping[str, ArrayLike | str] | None = None) -> AssemblyErrors:
    """The errors with the given names, every other one zero.

    **Arguments:** `values`: name -> number in rad or m, array scalar (traced or not), or a string
    with a unit; names as "D.delta_x", "D.d_y", "C.child.delta_z", "C.pin_tilt_x", "coupler.length", or of any other
    parameter of the model (`rfem_jax.parameters`), which then deviates from its value by a number in its unit.

    **Raises:** `InputError` for a name that the model does not have.
    """
    topology = model.topology
    n_joints, n_links = len(topology.joints), topology.n_links
    parts = {
        "seat": np.zeros((len(topology.error_components), n_joints)),
        "bore": np.zeros((len(topology.error_components), n_joints)),
        "pin": np.zeros((2, n_joints)),
        "length": np.zeros(n_links),
        "twist": np.zeros(n_links),
    }
    traced, deviations = [], {}
    for name, value in (values or {}).items():
        if name not in topology.error_names and model.source is not None and name in model.source.blueprint.names:
            parameter = model.source.blueprint.names[name]
            number = quantity(value, parameter.dimension, f"error {name!r}") if isinstance(value, str) else value
            deviations[parameter.full] = jnp.asarray(number, jnp.float64)
            continue
        part, place = _locate(topology, name)
        if isinstance(value, str):
            value = quantity(value, error_dimension(name), f"error {name!r}")
        if isinstance(value, Tracer):
            traced.append((part, place, value))
        else:
            parts[part][place] = value
    arrays = {part: jnp.asarray(values, jnp.float64) for part, values in parts.items()}
    errors = AssemblyErrors(
        arrays["seat"], arrays["bore"], arrays["pin"], arrays["length"], arrays["twist"],
        owners=Owners(topology.joints, topology.links),
    )  # fmt: skip
    errors = _insert(errors, *zip(*traced)) if traced else errors
    return dataclasses.replace(errors, parameters=deviations) if deviations else errors


def require_errors_of(topology: Topology, errors: AssemblyErrors) -> None:
    """Raise InputError for errors of a mechanism with other joints or links."""
    owners = Owners(topology.joints, topology.links) if errors.owners is None else errors.owners
    seats = len(topology.error_components), len(topology.joints)
    shapes = seats, seats, (2, len(topology.joints)), (topology.n_links,), (topology.n_links,)
    arrays = errors.seat, errors.bore, errors.pin, errors.length, errors.twist
    if (owners.joints, owners.links) == (topology.joints, topology.links) and shapes == tuple(map(jnp.shape, arrays)):
        return
    raise InputError(
        f"Argument `errors` must be errors of this mechanism, with joints {', '.join(topology.joints)} and links "
        f"{', '.join(topology.links)}, but is for joints {', '.join(owners.joints)} and links "
        f"{', '.join(owners.links)}; make it by assembly_errors(model, {{...}}) with the same model."
    )


def sum_of(errors: AssemblyErrors, more: AssemblyErrors) -> AssemblyErrors:
    """Sum of two sets of errors; a parameter may deviate in one of them alone."""
    first, second = errors.parameters or {}, more.parameters or {}
    both = {
        name: first.get(name, 0.0) + second.get(name, 0.0) for name in (*first, *(n for n in second if n not in first))
    }
    plain = (dataclasses.replace(one, parameters=None) for one in (errors, more))
    return dataclasses.replace(jax.tree.map(jnp.add, *plain), parameters=both or None)


@Program
def _insert(
    errors: AssemblyErrors,
    parts: tuple[str, ...],
    places: tuple[int | tuple[int, int], ...],
    values: tuple[Float[Array, ""], ...],
) -> AssemblyErrors:
    """The errors with `values` at `places` of the arrays named `parts`."""
    arrays = {field.name: getattr(errors, field.name) for field in dataclasses.fields(errors)}
    for part, place, value in zip(parts, places, values):
        arrays[part] = arrays[part].at[place].set(value)
    return AssemblyErrors(**arrays)


def _locate(topology: Topology, name: str) -> tuple[str, int | tuple[int, int]]:
    """Field of `AssemblyErrors` and place in it of a named error."""
    if name not in topology.error_names:
        raise InputError(
            f"Argument `errors` must name errors of the model, but {name!r} is not one; "
            f"{suggestion(name, topology.error_names)}"
        )
    owner, *middle, kind = name.split(".")
    if kind in ("length", "twist"):
        return kind, topology.links.index(owner)
    joint = topology.joints.index(owner)
    if kind.startswith("pin_tilt"):
        return "pin", (("pin_tilt_x", "pin_tilt_z").index(kind), joint)
    return ("bore" if middle else "seat"), (topology.error_components.index(kind), joint)


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
    forces: along joint coordinates, None without any; frame_forces: elements between frames on nodes, likewise;
    friction: in joints of the tree and cut ones, likewise; springs: of compliant joints, likewise; reaction_length: as
        of the model.
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
    rest: Float[Array, " rfes"]
    stiffness: Float[Array, "6 rfes"]
    damping: Float[Array, " rfes"]
    lever_left: Float[Array, " rfes"]
    lever_right: Float[Array, " rfes"]
    beam_middle: Float[Array, " links"]
    gravity: Float[Array, "3"]
    datum: Float[Array, "3"]
    possible: Float[Array, ""]
    forces: JointLaws | None = None
    frame_forces: FrameForceSet | None = None
    friction: dict[str, Friction] | None = None
    springs: dict[str, CompliantSpring] | None = None
    reaction_length: Float[Array, ""] | None = None


def require_possible(model: Model, errors: AssemblyErrors) -> None:
    """Raise InputError for errors that leave a link no length, or that turn anything by more than half a turn, if they
    are concrete numbers; traced errors have a status instead."""
    topology = model.topology
    leaves = model.length, errors.length, errors.seat, errors.bore, errors.pin, errors.twist
    if any(isinstance(leaf, Tracer) for leaf in leaves):
        return
    length, change, seat, bore, pin, twist = map(np.asarray, leaves)
    for name, long, more in zip(topology.links, length, change):
        if more <= -long:
            raise InputError(
                f"Argument `errors` must leave link `{name}` longer than 0, but its length is {long:g} m and the error "
                f"{more:g} m; give a smaller error."
            )
    tilts = [k for k, name in enumerate(topology.error_components) if name.startswith("delta")]
    for names, values in (
        (topology.joints, np.concatenate([seat[tilts], bore[tilts], pin])),
        (topology.links, twist[None]),
    ):
        largest = np.abs(values).max(axis=0)
        if (largest > HALF_TURN).any():
            place = int(np.nanargmax(largest))
            raise InputError(
                f"Argument `errors` must turn nothing by more than half a turn, but turns `{names[place]}` by "
                f"{largest[place]:g} rad; check the number and its unit."
            )


def possible_errors(model: Model, errors: AssemblyErrors) -> Bool[Array, ""]:
    """Whether all links have a length, and nothing is turned by more than half a turn, with the errors; what is NaN is
    left to the checks of assembly."""
    is_turn = np.array([name.startswith("delta") for name in model.topology.error_components])
    turns = [rows(side, np.flatnonzero(is_turn)).ravel() for side in (errors.seat, errors.bore)]
    turned = jnp.any(jnp.abs(jnp.concatenate([*turns, errors.pin.ravel(), errors.twist])) > HALF_TURN)
    return ~(turned | jnp.any(errors.length <= -model.length))


@kernel
def apply_errors(model: Model, errors: AssemblyErrors) -> ModelWithErrors:
    """Apply the errors to the model; deviations of parameters are applied before, by `designed`."""
    assert not errors.parameters, "`designed` has not been called"
    with jax.named_scope("apply_errors"):
        topology = model.topology
        possible = possible_errors(model, errors)
        errors = jax.tree.map(lambda x: jnp.where(possible, x, 0.0), errors)
        length = model.length + errors.length
        scale = length / model.length
        seat = _side(
            model.parent_rotation,
            model.parent_position,
            errors.seat,
            topology.parents,
            topology.parent_at_end,
            scale,
            errors.twist,
            topology,
        )
        bore = _side(
            model.child_rotation,
            model.child_position,
            errors.bore,
            topology.children,
            topology.child_at_end,
            scale,
            errors.twist,
            topology,
        )
        # P and P_c of theory (2.4): a crooked pin stresses nothing at the start angle.
        pin = vectors.product(vectors.rotation_z(errors.pin[1]), vectors.rotation_x(errors.pin[0]))
        start = vectors.rotation_y(_start_angles(model))
        pin_in_child = vectors.transposed_product(start, vectors.product(pin, start))
        sides = (vectors.product(seat[0], pin), seat[1]), (vectors.product(bore[0], pin_in_child), bore[1])
        mass, centre, inertia = _bodies(model, length, scale)
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
            inverse_inertia=vectors.invert_positive(inertia[:, :, n:]),
            beam_middle=length * np.array([rfe_fractions(n)[1][0] for n in topology.elements]),
            gravity=model.gravity,
            datum=model.parent_position[:, topology.parents.index(BASE)],
            forces=None if model.forces is None else JointLaws(model.forces, jnp.ones(())),
            frame_forces=_frame_forces(model, scale, sides),
            friction=model.friction,
            springs=model.springs,
            reaction_length=model.reaction_length,
            possible=possible.astype(float),
            **_spring_damping_elements(model, length),
        )


def _frame_forces(
    model: Model, scale: Array, sides: tuple[tuple[Array, Array], tuple[Array, Array]]
) -> FrameForceSet | None:
    """The force elements, whose frames lie on links that are `scale` times as long, or are those of joints: rotations
    (3, 3, joints) and positions (3, joints) on both `sides`."""
    if model.frame_forces is None:
        return None
    elements, topology = {}, model.topology
    at_joints = {clearance_name(topology.joints[j]): j for j in topology.clearances}
    for name, element in model.frame_forces.items():
        if name in at_joints:
            j, ends = at_joints[name], (element.parent, element.child)
            frames = [NodeFrame(end.node, side[0][:, :, j], side[1][:, j]) for end, side in zip(ends, sides)]
        else:
            frames = [_scaled_frame(topology, frame, scale) for frame in (element.parent, element.child)]
        elements[name] = eqx.tree_at(lambda one: (one.parent, one.child), element, tuple(frames))
    return FrameForceSet(elements, jnp.ones(()))


def _scaled_frame(topology: Topology, frame: NodeFrame, scale: Array) -> NodeFrame:
    """A frame on a link that became `scale` times as long."""
    if frame.node == BASE:
        return frame
    x = frame.position[:1] * scale[topology.link_of(frame.node)]
    return NodeFrame(frame.node, frame.rotation, jnp.concatenate([x, frame.position[1:]]))


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

    A segment's centre of mass lies on its axis and its inertia is diagonal, unless it has a point mass.
    """
    topology = actual.topology
    n, nodes = topology.n_links, topology.n_links + topology.n_rfes
    plain = ~np.isin(np.arange(nodes), topology.masses)
    off_axis = np.array([False, True, True])[:, None] & plain
    off_axis[0, n:] = plain[n:]
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
    at_end: tuple[bool, ...],
    scale: Array,
    twist: Array,
    topology: Topology,
) -> tuple[Float[Array, "3 3 joints"], Float[Array, "3 joints"]]:
    """Frames of all joints on one side: nominal frame, stretched and twisted link, error."""
    # F' of theory (2.5): x grows with the link, and the frames at its end turn with the twist.
    link = np.array([0 if node < 0 else topology.link_of(node) for node in nodes])
    on_link = np.array([node >= 0 for node in nodes])
    stretch = jnp.where(on_link, _link_values(scale, link), 1.0)
    position = jnp.concatenate([position[:1] * stretch[None], position[1:]])
    twisted = vectors.rotation_x(jnp.where(on_link & np.array(at_end), _link_values(twist, link), 0.0))
    rotation = vectors.product(twisted, rotation)
    # F' E with E = [R_z(delta_z) R_y(delta_y) R_x(delta_x), (d_x, d_y, d_z)] of theory (2.3), (2.17).
    tilt = vectors.rotation_x(error[0])
    if "delta_y" in topology.error_components:
        tilt = vectors.product(vectors.rotation_y(error[5]), tilt)
    tilt = vectors.product(vectors.rotation_z(error[1]), tilt)
    return vectors.product(rotation, tilt), position + vectors.apply(rotation, error[2:5])


def _bodies(
    model: Model, length: Array, scale: Array
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
    beam_centre = _x_vectors(axial)

    holder = np.array(topology.masses, dtype=int)
    holder_link = np.array([topology.link_of(node) for node in topology.masses], dtype=int)
    point = jnp.concatenate(
        [model.point_position[:1] * _link_values(scale, holder_link)[None], model.point_position[1:]]
    )
    # Sums at the nodes that hold them, by products: additions at places would be scatters.
    onto = (holder[:, None] == np.arange(nodes)).astype(float)
    total = mass + model.point_mass @ onto
    moment = mass[None] * beam_centre
    moment = moment + (model.point_mass[None] * point) @ onto
    centre = moment / total[None]
    if topology.massless:
        there = total > 0.0
        centre = jnp.where(there[None], moment / jnp.where(there, total, 1.0)[None], 0.0)

    def steiner(m, r):
        identity = jnp.asarray(vectors.IDENTITY)[:, :, None]
        return m[None, None] * (vectors.dot(r, r)[None, None] * identity - r[:, None] * r[None])

    def diagonal(entries):
        return jnp.asarray(vectors.IDENTITY)[:, :, None] * entries[:, None]

    inertia = diagonal(principal) + steiner(mass, beam_centre - centre)
    added = diagonal(model.point_inertia) + steiner(model.point_mass, point - centre[:, holder])
    if model.point_products is not None:
        added = added + _off_diagonal(model.point_products)
    return total, centre, inertia + added @ onto


def _off_diagonal(products: Float[Array, "3 masses"]) -> Float[Array, "3 3 masses"]:
    """Symmetric matrices of J_xy, J_xz, J_yz, with zeros on the diagonal."""
    xy, xz, yz = products
    zero = jnp.zeros_like(xy)
    rows = (zero, xy, xz), (xy, zero, yz), (xz, yz, zero)
    return jnp.stack([jnp.stack(row) for row in rows])


def _node_fractions(topology: Topology) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Link, share of its length and middle of every node, in the order of the nodes."""
    fractions = [rfe_fractions(n) for n in topology.elements]
    link = np.concatenate([np.arange(topology.n_links), topology.link_of_rfe])
    share, middle = (np.concatenate([[f[k][0] for f in fractions], *[f[k][1:] for f in fractions]]) for k in (0, 1))
    return link.astype(int), share, middle


def _spring_damping_elements(model: Model, length: Array) -> dict[str, Array]:
    """Rest position of every free rfe; stiffness, damping and lever arms of the sde on its left (theory (1.7),
    (1.8))."""
    topology = model.topology
    link = topology.link_of_rfe.astype(int)
    count = np.array(topology.elements, dtype=float)[link] - 1.0
    index = np.concatenate([np.arange(n - 1) for n in topology.elements]).astype(int)
    middles = [rfe_fractions(n)[1] for n in topology.elements]
    left = np.concatenate([x[:-1] for x in middles]) if middles else np.zeros(0)
    right = np.concatenate([x[1:] for x in middles]) if middles else np.zeros(0)
    place = (index + 0.5) / np.maximum(count, 1.0)
    extent = _link_values(length, link)
    return {
        "rest": jnp.asarray(right) * extent,
        "stiffness": _link_values(model.section.stiffness, link) * (count / extent)[None],
        "damping": _link_values(model.section.damping, link),
        "lever_left": jnp.asarray(place - left) * extent,
        "lever_right": jnp.asarray(place - right) * extent,
    }


def _link_values(values: Float[Array, "*k links"], links: Int[np.ndarray, " n"]) -> Float[Array, "*k n"]:
    """Values of given links, by a product: the transpose of an index would be an addition at places."""
    return values @ (np.arange(values.shape[-1])[:, None] == links).astype(float)


def _x_vectors(values: Array) -> Array:
    """Vectors (3, n) along x."""
    zero = jnp.zeros_like(values)
    return jnp.stack([values, zero, zero])
