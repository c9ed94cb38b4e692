"""What a run records of one instant: loads, energies, balances (theory (11.8) to (11.12)).

Place in the pipeline: equations, generalised_alpha -> **observation** -> integration.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import Array

from rfem_jax.mechanics import loads
from rfem_jax.mechanics.balance import Balance
from rfem_jax.mechanics.centre_lines import link_ends
from rfem_jax.mechanics.cut_joints import Closure, assembly_modes
from rfem_jax.mechanics.dynamics import Accelerations
from rfem_jax.mechanics.inputs import DriveInput
from rfem_jax.mechanics.kinematics import Motion, range_used
from rfem_jax.mechanics.model import Coordinates, State, Topology
from rfem_jax.mechanics.realisation import Realisation
from rfem_jax.simulation import equations
from rfem_jax.simulation.equations import Integrals
from rfem_jax.simulation.run import Energy


class Instant(NamedTuple):
    """Joint loads and what else the solution of one instant's equations gives.

    loads: of all joints; base (6,): wrench of the base at the origin; accelerations of the coordinates;
    drift [m], drift_angle [rad] of the cut joints; arm [m]: largest coordinate of a hinge; stabilising,
    multiplier: largest multipliers [N]; residual (n,) [N]: forces left over in the equations of motion, none
    where these were solved for the accelerations; motion, closure: kinematics of the instant.
    """

    loads: loads.JointLoads
    base: Array
    accelerations: Coordinates
    drift: Array
    drift_angle: Array
    arm: Array
    stabilising: Array
    multiplier: Array
    residual: Array
    motion: Motion
    closure: Closure | None


class Record(NamedTuple):
    """What is recorded at the end of every interval."""

    angles: Array
    rates: Array
    drive_moment: Array
    loads: loads.JointLoads
    energy: Energy
    drift: Array
    drift_angle: Array
    momentum_residual: Array
    largest_load: Array
    hinge_residual: Array
    stabilising: Array
    multiplier: Array
    range_used: Array
    ends: Array
    branch: Array
    square_integrals: Array
    residual: Array
    squares: Array


def solved_instant(
    realised: Realisation, result: Accelerations, drive: DriveInput, scale: Array
) -> Instant:
    """An instant whose accelerations were solved for."""
    joint, base = loads.chain_loads(realised, result, result.angular, result.linear, drive)
    drift, drift_angle = cut_drift(result.closure, scale)
    return Instant(
        loads=joint,
        base=base,
        accelerations=result.coordinates,
        drift=drift,
        drift_angle=drift_angle,
        arm=jnp.max(jnp.abs(result.motion.hinges.point)),
        stabilising=jnp.max(jnp.abs(result.stabilising), initial=0.0),
        multiplier=jnp.max(jnp.abs(result.multipliers), initial=0.0),
        residual=jnp.zeros((0,)),
        motion=result.motion,
        closure=result.closure,
    )


def balanced_instant(
    topology: Topology,
    left: Balance,
    accelerations: Coordinates,
    drive: DriveInput,
    scale: Array,
    residual: Array,
) -> Instant:
    """An instant whose accelerations were found by balancing the equations up to forces [N] (n,).

    The drift of the closure is the solver's and has no derivative; the residual keeps its own, which says
    how accurate the derivatives are."""
    drift, drift_angle = jax.lax.stop_gradient(cut_drift(left.closure, scale))
    return Instant(
        loads=loads.loads_of_wrenches(topology, left, left.wrenches, drive),
        base=loads.base_wrench(topology, left.wrenches),
        accelerations=accelerations,
        drift=drift,
        drift_angle=drift_angle,
        arm=jnp.max(jnp.abs(left.motion.hinges.point)),
        stabilising=jnp.zeros(()),
        multiplier=jnp.max(jnp.abs(left.multipliers), initial=0.0),
        residual=residual,
        motion=left.motion,
        closure=left.closure,
    )


def observe(
    realised: Realisation,
    state: State,
    drive: DriveInput,
    integrals: Integrals,
    instant: Instant,
    squares: Array,
) -> Record:
    """Record of one instant; squares (2, joints): of axial and normal forces."""
    with jax.named_scope("observation"):
        topology = realised.topology
        joint, now = instant.loads, instant.motion
        parts = loads.energies(realised, state)
        force, moment = loads.momentum_residual(
            realised, state, instant.accelerations, instant.base
        )
        largest_force = equations.guarded_root(jnp.max(jnp.sum(joint.force**2, axis=0)))
        largest_moment = equations.guarded_root(jnp.max(jnp.sum(joint.moment**2, axis=0)))
        largest_moment = largest_moment + largest_force * instant.arm
        passive = np.ones(len(topology.joints))
        if drive.turn is not None:
            passive[topology.driven] = 0.0
        return Record(
            angles=state.position.angles,
            rates=state.velocity.angles,
            drive_moment=equations.drive_moment(topology, drive, joint),
            loads=joint,
            energy=Energy(*parts, integrals.work, integrals.dissipation),
            drift=instant.drift,
            drift_angle=instant.drift_angle,
            momentum_residual=jnp.stack([jnp.max(jnp.abs(force)), jnp.max(jnp.abs(moment))]),
            largest_load=jnp.stack([largest_force, largest_moment]),
            hinge_residual=jnp.max(jnp.abs(joint.moment[1]) * jnp.asarray(passive)),
            stabilising=instant.stabilising,
            multiplier=instant.multiplier,
            range_used=range_used(topology, state.position),
            ends=link_ends(realised, now)[0],
            branch=_branch(realised, instant),
            square_integrals=jnp.stack(
                [integrals.axial_square + integrals.normal_square, integrals.moment_square]
            ),
            residual=instant.residual,
            squares=squares,
        )


def _branch(realised: Realisation, instant: Instant) -> Array:
    """Assembly modes of the cut joints (C,)."""
    if instant.closure is None:
        return jnp.zeros((0,))
    return assembly_modes(realised, instant.motion, instant.closure)


def cut_drift(cuts, scale):
    """Of the cut joints: largest distance [m] of two joint centres, and largest axis equation [rad]."""
    if cuts is None:
        return jnp.zeros(()), jnp.zeros(())
    distance = equations.guarded_root(jnp.max(jnp.sum(cuts.residual[:3] ** 2, axis=0)))
    return distance, jnp.max(jnp.abs(cuts.residual[3:])) / scale
