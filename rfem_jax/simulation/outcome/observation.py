"""What a run records of one instant: loads, energies, residuals and balances (theory (11.8) to (11.12)).

Place in the pipeline: equations, generalised_alpha -> **observation** -> integration.
"""

from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from rfem_jax.mechanics.algebra import vectors
from rfem_jax.mechanics.dynamics import energy_and_momentum, loads
from rfem_jax.mechanics.dynamics.centre_lines import link_ends
from rfem_jax.mechanics.dynamics.dynamics import Accelerations
from rfem_jax.mechanics.dynamics.point_paths import PointMotion, point_motions
from rfem_jax.mechanics.elements.linear_validity import LinearRange, linear_range
from rfem_jax.mechanics.forces.bush_contacts import ContactState, contact_states
from rfem_jax.mechanics.forces.element_loads import FrameLoads
from rfem_jax.mechanics.forces.joint_forces import LawForces, by_coordinate
from rfem_jax.mechanics.implicit.residual import Evaluation
from rfem_jax.mechanics.kinematics.branches import assembly_modes
from rfem_jax.mechanics.kinematics.cut_joints import Closure, Constraints
from rfem_jax.mechanics.kinematics.motion import Motion, by_freedom, range_used
from rfem_jax.mechanics.laws.clearances import clearance_name
from rfem_jax.mechanics.model.inputs import DriveInput
from rfem_jax.mechanics.model.model import Coordinates, State
from rfem_jax.mechanics.model.topology import Topology
from rfem_jax.mechanics.model.with_errors import ModelWithErrors
from rfem_jax.simulation.outcome.run import CouplingHistory, Energy, PointHistory
from rfem_jax.simulation.system import equations
from rfem_jax.simulation.system.equations import Integrals


class Instant(NamedTuple):
    """The equations of motion at one instant: joint loads, and what their checks need.

    loads of all joints; base: wrench (6,) of the base at the global origin; accelerations of the coordinates; drift
    [m], drift_angle [rad]: closure errors of the cut joints; arm [m]: largest coordinate of a joint's centre;
    stabilising, multiplier [N]: largest part of a multiplier due to Baumgarte's terms, and largest multiplier;
    residual [N]: of the equations of motion as forces, none (n = 0) where these were solved for the accelerations;
    motion, closure: kinematics of the instant; laws: forces of springs and laws along joint coordinates; frame_loads:
    what force elements exert; wrenches: of all joints at the global origin; angular, linear (3, nodes): accelerations
    of the nodes in link axes.
    """

    loads: loads.JointLoads
    base: Float[Array, "6"]
    accelerations: Coordinates
    drift: Float[Array, ""]
    drift_angle: Float[Array, ""]
    arm: Float[Array, ""]
    stabilising: Float[Array, ""]
    multiplier: Float[Array, ""]
    residual: Float[Array, " n"]
    motion: Motion
    closure: Closure | None
    laws: LawForces | None
    frame_loads: FrameLoads | None
    wrenches: list[Float[Array, "6"]]
    angular: Float[Array, "3 nodes"]
    linear: Float[Array, "3 nodes"]


class Record(NamedTuple):
    """What is recorded at the end of every interval; fields with the names of `Run`'s are what that says.

    joints, joint_rates: positions of the tree joints (as `Coordinates.joints`) and their rates; drive_forces [N m, N]:
    as of `equations`; momentum_residual:
    largest components of the residual force [N] and moment [N m] of the momentum balance; largest_load [N, N m]: what
    they are divided by; hinge_residual [N m]: largest load along a free motion of a joint beyond that of its springs,
    zero (forces times `Instant.arm`); range_used: as `kinematics.range_used`; linear: as
    `linear_validity.linear_range`; square_integrals: of the resultant force
    and moment [N^2 s, (N m)^2 s]; squares: as of `equations.squared_loads`; friction_losses, contact_losses
    [J]: energy that every friction, every clearance has dissipated, None without any; asked: by the names of `records`;
    contacts: of the joints with clearance; points: motions of the points whose paths are followed; couplings: of
    joint coordinates.
    """

    joints: Float[Array, " numbers"]
    joint_rates: Float[Array, " freedoms"]
    drive_forces: tuple[Float[Array, ""], ...]
    loads: loads.JointLoads
    energy: Energy
    drift: Float[Array, ""]
    drift_angle: Float[Array, ""]
    momentum_residual: Float[Array, "2"]
    largest_load: Float[Array, "2"]
    hinge_residual: Float[Array, ""]
    stabilising: Float[Array, ""]
    multiplier: Float[Array, ""]
    range_used: Float[Array, ""]
    linear: LinearRange
    ends: Float[Array, "3 links"]
    branch: Float[Array, " cuts"]
    square_integrals: Float[Array, "2 joints"]
    residual: Float[Array, " n"]
    squares: Float[Array, "4 joints"]
    forces: dict[str, PointHistory]
    friction_losses: Float[Array, " frictions"] | None
    contact_losses: Float[Array, " clearances"] | None
    asked: dict[str, Any]
    contacts: dict[str, ContactState]
    points: dict[str, PointMotion]
    couplings: dict[str, CouplingHistory]


def solved_instant(actual: ModelWithErrors, result: Accelerations, drive: DriveInput, scale: vectors.Scalar) -> Instant:
    """An instant whose equations of motion were solved for the accelerations; `scale` [m] as in `closure`."""
    result, wrenches = loads.moving_wrenches(actual, result, result.angular, result.linear)
    drift, drift_angle = cut_drift(result.closure, scale)
    return Instant(
        loads=loads.loads_of_wrenches(actual.topology, result, wrenches, drive),
        base=loads.base_wrench(actual.topology, wrenches),
        accelerations=result.coordinates,
        drift=drift,
        drift_angle=drift_angle,
        arm=jnp.max(jnp.abs(result.motion.hinges.point)),
        stabilising=jnp.max(jnp.abs(result.stabilising), initial=0.0),
        multiplier=jnp.max(jnp.abs(result.multipliers), initial=0.0),
        residual=jnp.zeros((0,)),
        motion=result.motion,
        closure=result.closure,
        laws=result.laws,
        frame_loads=result.frame_loads,
        wrenches=wrenches,
        angular=result.angular,
        linear=result.linear,
    )


def evaluated_instant(
    topology: Topology,
    evaluation: Evaluation,
    accelerations: Coordinates,
    drive: DriveInput,
    scale: vectors.Scalar,
    residual: Float[Array, " n"],
) -> Instant:
    """An instant at which the equations of motion hold up to a residual [N]; `scale` [m] as in `closure`.

    The closure error follows from the tolerance of Newton's method and is not differentiated; the residual is: its
    derivative says how accurate derivatives are.
    """
    drift, drift_angle = jax.lax.stop_gradient(cut_drift(evaluation.closure, scale))
    return Instant(
        loads=loads.loads_of_wrenches(topology, evaluation, evaluation.wrenches, drive),
        base=loads.base_wrench(topology, evaluation.wrenches),
        accelerations=accelerations,
        drift=drift,
        drift_angle=drift_angle,
        arm=jnp.max(jnp.abs(evaluation.motion.hinges.point)),
        stabilising=jnp.zeros(()),
        multiplier=jnp.max(jnp.abs(evaluation.multipliers), initial=0.0),
        residual=residual,
        motion=evaluation.motion,
        closure=evaluation.closure,
        laws=evaluation.laws,
        frame_loads=evaluation.frame_loads,
        wrenches=evaluation.wrenches,
        angular=evaluation.angular,
        linear=evaluation.linear,
    )


def observe(
    actual: ModelWithErrors,
    state: State,
    drive: DriveInput,
    integrals: Integrals,
    instant: Instant,
    squares: Float[Array, "4 joints"],
) -> Record:
    """Record of one instant; `squares`: as of `equations.squared_loads`."""
    with jax.named_scope("observation"):
        topology = actual.topology
        joint, now = instant.loads, instant.motion
        force, moment = energy_and_momentum.momentum_residual(
            actual, state, instant.accelerations, instant.base, instant.frame_loads
        )
        largest_force = equations.safe_sqrt(jnp.max(jnp.sum(joint.force**2, axis=0)))
        largest_moment = equations.safe_sqrt(jnp.max(jnp.sum(joint.moment**2, axis=0)))
        largest_moment = largest_moment + largest_force * instant.arm
        return Record(
            joints=state.position.joints,
            joint_rates=state.velocity.joints,
            drive_forces=equations.drive_forces(topology, drive, joint, instant),
            loads=joint,
            energy=energy_at(actual, state, integrals.work, integrals.dissipation),
            drift=instant.drift,
            drift_angle=instant.drift_angle,
            momentum_residual=jnp.stack([jnp.max(jnp.abs(force)), jnp.max(jnp.abs(moment))]),
            largest_load=jnp.stack([largest_force, largest_moment]),
            hinge_residual=_load_along_free_motions(topology, instant, drive),
            stabilising=instant.stabilising,
            multiplier=instant.multiplier,
            range_used=range_used(topology, state.position),
            linear=linear_range(actual, state.position),
            ends=link_ends(actual, now)[0],
            branch=_branch(actual, instant),
            square_integrals=jnp.stack([integrals.axial_square + integrals.normal_square, integrals.moment_square]),
            residual=instant.residual,
            squares=squares,
            forces=_point_histories(topology, instant.frame_loads),
            friction_losses=integrals.friction,
            contact_losses=integrals.contacts,
            asked={},
            contacts=contact_states(actual, now),
            points=point_motions(actual, now, instant.angular, instant.linear),
            couplings=coupling_histories(instant.laws),
        )


def energy_at(actual: ModelWithErrors, state: State, work: Float[Array, ""], dissipation: Float[Array, ""]) -> Energy:
    """Energies [J] at one instant; the work follows from the integrals of the powers since the start, up to a
    constant."""
    tables = energy_and_momentum.table_work(actual, state)
    return Energy(*energy_and_momentum.energies(actual, state), work if tables is None else work + tables, dissipation)


def _point_histories(topology: Topology, at_nodes: FrameLoads | None) -> dict[str, PointHistory]:
    """Forces of the elements that are not contacts of joints, by their names."""
    exerted = {} if at_nodes is None else at_nodes.exerted
    contacts = {clearance_name(topology.joints[j]) for j in topology.clearances}
    return {name: PointHistory(*one) for name, one in exerted.items() if name not in contacts}


def coupling_histories(laws: LawForces | None) -> dict[str, CouplingHistory]:
    """Loads and deflections of the couplings, by their names."""
    meshes = {} if laws is None else laws.couplings or {}
    return {name: CouplingHistory(mesh.loads, mesh.deflection) for name, mesh in meshes.items()}


def _load_along_free_motions(topology: Topology, instant: Instant, drive: DriveInput) -> Float[Array, ""]:
    """Largest load along a free motion of a joint, but prescribed ones and beyond its springs: moment [N m], or force
    times the arm."""
    joint, hinges = instant.loads, instant.motion.hinges
    passive = np.ones(topology.n_freedoms)
    passive[list(drive.motions)] = 0.0
    revolute = np.array([kind == "revolute" for kind in topology.kinds])
    if topology.clearances:
        # What contacts exert along free motions is no error.
        joint = jax.tree.map(jnp.subtract, joint, loads.contact_loads(topology, instant))
    elif revolute.all() and instant.laws is None:
        return jnp.max(jnp.abs(joint.moment[1]) * jnp.asarray(np.append(passive, np.ones(topology.n_cuts))))
    n = topology.n_links
    force, moment = (vectors.apply(hinges.rotation, part[:, :n]) for part in joint)
    wrenches = vectors.wrench_at_origin(moment, force, hinges.point)
    along = vectors.dot(instant.motion.axis, by_freedom(topology, wrenches))
    if instant.laws is not None and instant.laws.inside:
        along = along - by_coordinate(topology, instant.laws.inside)
    along = jnp.abs(along)
    along = along * jnp.where(np.array(topology.slides, dtype=bool), instant.arm, 1.0)
    along = along * passive
    about_cuts = joint.moment[1, n:]
    for (at, component), force in ({} if instant.laws is None else instant.laws.cuts or {}).items():
        here = (np.arange(about_cuts.shape[0]) == at) & (component == 4)
        about_cuts = jnp.where(here, about_cuts - force[None], about_cuts)
    about_cuts = jnp.abs(about_cuts) * revolute[n:].astype(float)
    return jnp.max(jnp.concatenate([along, about_cuts]), initial=0.0)


def _branch(actual: ModelWithErrors, instant: Instant) -> Float[Array, " cuts"]:
    """Assembly modes of the cut joints."""
    if instant.closure is None or not instant.closure.groups:
        return jnp.zeros((0,))
    return assembly_modes(actual, instant.motion, instant.closure)


def cut_drift(cuts: Closure | None, scale: vectors.Scalar) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """Closure errors: largest distance [m] of two joint centres, or of an ideal coupling, angles times a length;
    largest axis equation [rad]."""
    if cuts is None:
        return jnp.zeros(()), jnp.zeros(())
    distances, turns = [], []
    for group in cuts.groups:
        of_centres, of_axes = _rigid_constraint_violations(group)
        distances.append(equations.safe_sqrt(jnp.max(jnp.sum(of_centres**2, axis=0))))
        if of_axes.shape[0]:
            turns.append(jnp.max(jnp.abs(of_axes)) / scale)
    if cuts.couplings is not None:
        distances.append(jnp.max(jnp.abs(cuts.couplings.residual)))
    return _largest(distances), _largest(turns)


def _rigid_constraint_violations(group: Constraints) -> tuple[Float[Array, "r n"], Float[Array, "s n"]]:
    """Residuals [m] of the equations of centres and of axes, without the equations that are laws of springs."""
    r = group.n_centres
    if not any(group.sprung):
        return group.residual[:r], group.residual[r:]
    rigid = np.flatnonzero(~np.array(group.sprung))
    return group.residual[rigid[rigid < r]], group.residual[rigid[rigid >= r]]


def _largest(values: list[Float[Array, ""]]) -> Float[Array, ""]:
    if not values:
        return jnp.zeros(())
    return values[0] if len(values) == 1 else jnp.max(jnp.stack(values))
