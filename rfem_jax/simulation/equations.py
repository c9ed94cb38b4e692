"""The first-order system that is integrated: motion, and what is summed along with it.

Place in the pipeline: mechanics -> **equations** -> integration.

The integrals of squared loads, of the drive's power and of the dissipated power are states of the
same integration, so that a run needs no history for its metrics (theory (3.12)).
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array
from jax.custom_derivatives import SymbolicZero
from jaxtyping import Float, Int

from rfem_jax.compilation.scalars import nothing_known
from rfem_jax.description.drives import MomentDrive, PrescribedDrive
from rfem_jax.mechanics import loads, realisation
from rfem_jax.mechanics.condensation import LinkOperator
from rfem_jax.mechanics.dynamics import Accelerations, accelerations
from rfem_jax.mechanics.inputs import DriveInput, Stabilisation, impose
from rfem_jax.mechanics.model import Coordinates, State, Topology
from rfem_jax.mechanics.realisation import Realisation


class Integrals(eqx.Module):
    """Integrals over time of squared loads (joints,) [N^2 s, (N m)^2 s]: axial (along the hinge) and
    normal force, resultant moment; work of the drive and dissipated energy [J]."""

    axial_square: Float[Array, "joints"]
    normal_square: Float[Array, "joints"]
    moment_square: Float[Array, "joints"]
    work: Float[Array, ""]
    dissipation: Float[Array, ""]


class Trajectory(eqx.Module):
    """The integrated state: position and velocity of the coordinates, and the integrals."""

    position: Coordinates
    velocity: Coordinates
    integrals: Integrals


class Conditions(eqx.Module):
    """What the equations of motion read besides the state: the constants of the mechanism, the drive
    and its phase (jumps passed), the stabilisation; for implicit methods the links' operators for the step
    length (None: formed when they are needed)."""

    realised: Realisation
    drive: MomentDrive | PrescribedDrive | None
    phase: Int[Array, ""]
    stabilisation: Stabilisation
    operators: tuple[LinkOperator | None, ...] | None = None


def structural_zeros(conditions: Conditions) -> Conditions:
    """Entries of the conditions that are zero for all numbers: boolean arrays, or False."""
    known = realisation.structural_zeros(conditions.realised.topology)
    return eqx.tree_at(lambda tree: tree.realised, nothing_known(conditions), known)


def moving_parts(primals, tangents):
    """Leaves that have a tangent, the other leaves, and the tangents: most constants of a mechanism do not
    depend on the errors asked for, and are not linearised."""
    moves = jax.tree.map(
        lambda x, dx: eqx.is_inexact_array(x) and not isinstance(dx, SymbolicZero), primals, tangents
    )
    inputs, fixed = eqx.partition(primals, moves)
    return inputs, fixed, eqx.filter(tangents, moves)


def drive_input(drive, t, phase) -> DriveInput:
    """What the drive does at a time of one phase."""
    if isinstance(drive, MomentDrive):
        return DriveInput(moment=drive.moment(t, phase))
    if isinstance(drive, PrescribedDrive):
        return DriveInput(turn=drive.turn(t, phase))
    return DriveInput()


def at_instant(
    t: Array, trajectory: Trajectory, conditions: Conditions
) -> tuple[State, DriveInput, Accelerations, loads.JointLoads]:
    """State with prescribed values imposed, drive, accelerations and joint loads at one time."""
    realised = conditions.realised
    drive = drive_input(conditions.drive, t, conditions.phase)
    state = impose(realised.topology, State(trajectory.position, trajectory.velocity), drive)
    result = accelerations(realised, state, drive, conditions.stabilisation)
    return state, drive, result, loads.joint_loads(realised, result, drive)


def right_hand_side(t: Array, trajectory: Trajectory, conditions: Conditions) -> Trajectory:
    """Rate of the integrated state."""
    state, drive, result, joint = at_instant(t, trajectory, conditions)
    axial, normal, moment = squares(joint)
    return Trajectory(
        position=state.velocity,
        velocity=result.coordinates,
        integrals=Integrals(
            axial_square=axial,
            normal_square=normal,
            moment_square=moment,
            work=drive_power(conditions.realised.topology, state, drive, joint),
            dissipation=result.dissipated,
        ),
    )


def squares(joint: loads.JointLoads) -> tuple[Array, Array, Array]:
    """Squared axial force, normal force and resultant moment (joints,)."""
    x, y, z = joint.force
    return y**2, x**2 + z**2, jnp.sum(joint.moment**2, axis=0)


def drive_power(topology: Topology, state: State, drive: DriveInput, joint) -> Array:
    """Power [W] that the drive puts in."""
    return drive_moment(topology, drive, joint) * (
        0.0 if topology.driven is None else state.velocity.angles[topology.driven]
    )


def drive_moment(topology: Topology, drive: DriveInput, joint: loads.JointLoads) -> Array:
    """Moment [N m] of the drive about the driven joint's hinge: given, or what enforces the angle."""
    if drive.moment is not None:
        return drive.moment
    if drive.turn is not None:
        return joint.moment[1, topology.driven]
    return jnp.zeros(joint.moment.shape[2:])


def start_trajectory(state: State, joints: int) -> Trajectory:
    """The integrated state at the start."""
    zero = jnp.zeros((joints,))
    none = jnp.zeros(())
    return Trajectory(state.position, state.velocity, Integrals(zero, zero, zero, none, none))


def with_start_angle(model, drive):
    """A prescribed drive whose turn is counted from the driven joint's start angle."""
    if not isinstance(drive, PrescribedDrive):
        return drive
    return _FromStart(drive, model.start_angles[model.topology.driven])


class _FromStart(PrescribedDrive):
    drive: PrescribedDrive
    start: Float[Array, ""]

    @property
    def joint(self):
        return self.drive.joint

    def breakpoints(self):
        return self.drive.breakpoints()

    def turn(self, t, phase):
        angle, rate, acceleration = self.drive.turn(t, phase)
        return self.start + angle, rate, acceleration


def peaks(rate: Trajectory) -> Array:
    """Squared axial and normal forces (2, joints), of which runs keep the maxima."""
    return jnp.stack([rate.integrals.axial_square, rate.integrals.normal_square])


def guarded_root(square: Array) -> Array:
    """Square root with derivative zero at zero, where the root is a cone; NaN stays NaN."""
    none = square <= 0.0
    return jnp.where(none, 0.0, jnp.sqrt(jnp.where(none, 1.0, square)))
