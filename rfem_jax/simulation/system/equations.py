"""The first-order system that is integrated: the motion, and integrals of loads and powers.

Place in the pipeline: mechanics -> **equations** -> integration.

The integrals of squared loads, of the drive's power and of the dissipated power are further states of the same
system, so that the metrics of a run need no history (theory (3.12)).
"""

from typing import Protocol, runtime_checkable

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from rfem_jax.mechanics.dynamics import loads
from rfem_jax.mechanics.dynamics.dynamics import Accelerations, accelerations
from rfem_jax.mechanics.forces.element_loads import FrameLoads
from rfem_jax.mechanics.forces.joint_forces import LawForces, rate_about_axis
from rfem_jax.mechanics.forces.nonsmooth_forces import losses
from rfem_jax.mechanics.implicit.condensation import LinkOperator
from rfem_jax.mechanics.kinematics.motion import Motion
from rfem_jax.mechanics.kinematics.slender_links import completed_state
from rfem_jax.mechanics.model.inputs import DriveInput, Stabilisation, impose
from rfem_jax.mechanics.model.model import Coordinates, Model, State
from rfem_jax.mechanics.model.orientations import position_rate
from rfem_jax.mechanics.model.topology import Topology
from rfem_jax.mechanics.model.with_errors import ModelWithErrors
from rfem_jax.simulation.system.driving import ActiveDrives

Numbers = Array | np.ndarray  # of JAX within a computation, of NumPy in what it returned
Scalar = int | float | Float[Numbers, ""]


class Integrals(eqx.Module):
    """Integrals over time of squared loads (joints,) [N^2 s, (N m)^2 s]: axial (along the joint's axis) and
    normal force, resultant moment; work of drive and laws, and dissipated energy [J], of which every friction, by its
    name, and the contacts of every joint with clearance (None without any)."""

    axial_square: Float[Array, " joints"]
    normal_square: Float[Array, " joints"]
    moment_square: Float[Array, " joints"]
    work: Float[Array, ""]
    dissipation: Float[Array, ""]
    friction: Float[Array, " frictions"] | None = None
    contacts: Float[Array, " clearances"] | None = None


class Trajectory(eqx.Module):
    """The integrated state: position and velocity of the coordinates, and the integrals."""

    position: Coordinates
    velocity: Coordinates
    integrals: Integrals


class Conditions(eqx.Module):
    """Arguments of the equations of motion besides time and state.

    actual: constants of the mechanism with its errors; drives, and their phase (number of jumps passed); stabilisation:
    Baumgarte's gains; operators: of an implicit method, the condensed links for its step length (None: they are
    formed in every step); ahead [s]: by which an implicit method takes friction later at a start (None without any).
    """

    actual: ModelWithErrors
    drives: ActiveDrives
    phase: Int[Array, ""]
    stabilisation: Stabilisation
    operators: tuple[LinkOperator | None, ...] | None = None
    ahead: Float[Array, ""] | None = None


def at_instant(
    t: Scalar, trajectory: Trajectory, conditions: Conditions
) -> tuple[State, DriveInput, Accelerations, loads.JointLoads]:
    """State with the prescribed motion imposed, drive, accelerations and joint loads at the time t [s]."""
    actual = conditions.actual
    drive = conditions.drives.at(t, conditions.phase)
    state = impose(actual.topology, State(trajectory.position, trajectory.velocity), drive)
    state = completed_state(actual, state)
    result = accelerations(actual, state, drive, conditions.stabilisation)
    return state, drive, result, loads.joint_loads(actual, result, drive)


def right_hand_side(t: Scalar, trajectory: Trajectory, conditions: Conditions) -> Trajectory:
    """Time derivative of the integrated state at the time t [s]."""
    state, drive, result, joint = at_instant(t, trajectory, conditions)
    axial, normal, moment = squares(conditions.actual.topology, joint)
    lost = losses(conditions.actual.topology, result.laws, result.frame_loads)
    return Trajectory(
        position=position_rate(conditions.actual.topology, state.position, state.velocity),
        velocity=result.coordinates,
        integrals=Integrals(
            axial_square=axial,
            normal_square=normal,
            moment_square=moment,
            work=applied_power(conditions.actual.topology, state, drive, joint, result),
            dissipation=result.dissipated,
            friction=lost.friction,
            contacts=lost.contacts,
        ),
    )


def squares(
    topology: Topology, joint: loads.JointLoads
) -> tuple[Float[Array, " joints"], Float[Array, " joints"], Float[Array, " joints"]]:
    """Squared axial force, normal force [N^2] and resultant moment [(N m)^2].

    Axial is along the axis of the joint's kind; the force of a kind without an axis counts as normal.
    """
    axes = [topology.kind(j).axis for j in range(len(topology.joints))]
    moment = jnp.sum(joint.moment**2, axis=0)
    if set(axes) == {1}:
        x, y, z = joint.force
        return y**2, x**2 + z**2, moment
    square, along = joint.force**2, np.array([[axis == i for axis in axes] for i in range(3)])
    return jnp.sum(jnp.where(along, square, 0.0), axis=0), jnp.sum(jnp.where(along, 0.0, square), axis=0), moment


@runtime_checkable
class Along(Protocol):
    """Motion at a solved instant, with the forces of springs and laws along joint coordinates, and of elements on
    nodes."""

    @property
    def motion(self) -> Motion: ...
    @property
    def laws(self) -> LawForces | None: ...
    @property
    def frame_loads(self) -> FrameLoads | None: ...


def applied_power(
    topology: Topology, state: State, drive: DriveInput, joint: loads.JointLoads, solved: Along
) -> Float[Array, ""]:
    """Power [W] of the drives, and of the laws of joints and the force elements that act from outside."""
    forces = drive_forces(topology, drive, joint, solved)
    power = forces[0] * (rate_about_axis(topology, state, topology.drives[0]) if topology.drives else 0.0)
    for k, force in zip(topology.drives[1:], forces[1:], strict=True):
        power = power + force * rate_about_axis(topology, state, k)
    for acting in (solved.laws, solved.frame_loads):
        power = power if acting is None else power + acting.power
    return power


def drive_forces(
    topology: Topology, drive: DriveInput, joint: loads.JointLoads, solved: Along
) -> tuple[Float[Array, ""], ...]:
    """Moments [N m] and forces [N] of the drives on the driven coordinates, one zero if no coordinate is driven. A
    force that enforces a prescribed motion is the joint's load without the part of its springs."""

    def force(k: int) -> Float[Array, ""]:
        if k in drive.forces:
            return drive.forces[k]
        if k not in drive.motions:
            return jnp.zeros(())
        along = loads.load_along(topology, solved.motion, joint, k)
        inside = {} if solved.laws is None else solved.laws.inside
        return along - inside[k] if k in inside else along

    return tuple(force(k) for k in topology.drives) or (jnp.zeros(()),)


def start_trajectory(model: Model, state: State) -> Trajectory:
    """The integrated state at the start: all integrals zero."""
    by_joint, total = jnp.zeros((len(model.topology.joints),)), jnp.zeros(())
    counts = len(model.friction or {}), len(model.topology.clearances)
    by_friction, by_contact = (jnp.zeros((count,)) if count else None for count in counts)
    integrals = Integrals(by_joint, by_joint, by_joint, total, total, by_friction, by_contact)
    return Trajectory(state.position, state.velocity, integrals)


def squared_loads(rates: Integrals) -> Float[Array, "4 joints"]:
    """Squares whose maxima a run keeps: of the axial, the normal and the resultant force [N^2], and of the resultant
    moment [(N m)^2]; from the rates of the integrals."""
    axial, normal = rates.axial_square, rates.normal_square
    return jnp.stack([axial, normal, axial + normal, rates.moment_square])


def peaks(rate: Trajectory) -> Float[Array, "4 joints"]:
    """`squared_loads` from the rate of the integrated state."""
    return squared_loads(rate.integrals)


def largest_component(peaks: Float[Array, "4 joints"]) -> Float[Array, ""]:
    """The largest squared axial or normal force [N^2] of any joint: what residual forces are compared with."""
    return jnp.max(peaks[:2])


def safe_sqrt(square: Float[Numbers, "*shape"]) -> Float[Array, "*shape"]:
    """Square root whose derivative is zero at zero, where the root has a kink; NaN stays NaN."""
    is_zero = square <= 0.0
    return jnp.where(is_zero, 0.0, jnp.sqrt(jnp.where(is_zero, 1.0, square)))
