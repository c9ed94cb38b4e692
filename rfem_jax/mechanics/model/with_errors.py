"""The model with errors applied.

Place in the pipeline: model + errors -> **with_errors** -> kinematics, dynamics, loads.

`apply_errors` computes from model and errors the constants of the equations of motion: joint frames (theory (2.3) to
(2.6), every joint on both its sides), masses, inertias, stiffnesses. Everything that does not change in time is
computed here, once a simulation.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax import Array
from jaxtyping import Float

from rfem_jax.kernels import kernel
from rfem_jax.mechanics.algebra import vectors
from rfem_jax.mechanics.laws.friction_laws import Friction
from rfem_jax.mechanics.laws.joint_laws import JointLaws
from rfem_jax.mechanics.laws.joint_springs import CompliantSpring
from rfem_jax.mechanics.model.carried_frames import FrameForceSet, placed_frame_forces, placed_points
from rfem_jax.mechanics.model.elements_with_errors import shaped_elements, spring_damping_elements
from rfem_jax.mechanics.model.errors import AssemblyErrors, possible_errors
from rfem_jax.mechanics.model.form import ActualForm, FormErrors
from rfem_jax.mechanics.model.frames_with_errors import joint_sides
from rfem_jax.mechanics.model.masses_with_errors import inverse_inertia, node_bodies, places_of_masses
from rfem_jax.mechanics.model.model import CarriedPoint, Model
from rfem_jax.mechanics.model.superelements import Superelement
from rfem_jax.mechanics.model.topology import BASE, Topology


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
        seat, bore = joint_sides(model, errors, form, scale)
        # P and P_c of theory (2.4): a crooked pin stresses nothing at the start angle.
        pin = vectors.product(vectors.rotation_z(errors.pin[1]), vectors.rotation_x(errors.pin[0]))
        start = vectors.rotation_y(_start_angles(model))
        pin_in_child = vectors.transposed_product(start, vectors.product(pin, start))
        sides = (vectors.product(seat[0], pin), seat[1]), (vectors.product(bore[0], pin_in_child), bore[1])
        mass, centre, inertia = node_bodies(model, form, length, scale)
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
            inverse_inertia=inverse_inertia(topology, inertia[:, :, n:]),
            beam_middle=length * np.array([topology.fractions(l)[1][0] for l in range(n)]),
            gravity=model.gravity,
            datum=model.parent_position[:, topology.parents.index(BASE)],
            forces=_joint_laws(model),
            frame_forces=placed_frame_forces(model, form, scale, sides),
            friction=model.friction,
            springs=model.springs,
            reaction_length=model.reaction_length,
            points=placed_points(model, form, scale, bore[1]),
            possible=possible.astype(float),
            superelements=model.superelements,
            **(spring_damping_elements(model, length) if form is None else shaped_elements(model, form, length)),
        )


def _form_errors(model: Model, errors: AssemblyErrors, scale: Array) -> FormErrors | None:
    """Errors of form of links, zero of those without; None where no link has a form."""
    if model.form is None:
        return None
    n = model.topology.n_links
    bow = jnp.zeros((2, n)) if errors.bow is None else errors.bow
    twist = jnp.where(np.isin(np.arange(n), model.topology.formed), errors.twist, 0.0)
    return FormErrors(scale, bow, twist, model.length)


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


def point_places(model: Model, actual: ModelWithErrors) -> Float[Array, "3 masses"]:
    """Places [m] of point masses in the frames of their nodes, with the errors of their links."""
    middles = np.array([model.topology.fractions(l)[1][0] for l in range(model.topology.n_links)])
    scale = actual.beam_middle / middles / model.length
    return places_of_masses(model, None if actual.form is None else actual.form.errors, scale)
