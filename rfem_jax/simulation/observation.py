"""What a run records of one instant: loads, energies, balances.

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
from rfem_jax.mechanics.cut_joints import assembly_modes, closure
from rfem_jax.mechanics.dynamics import Accelerations
from rfem_jax.mechanics.inputs import DriveInput
from rfem_jax.mechanics.kinematics import Motion, motion, range_used
from rfem_jax.mechanics.model import Coordinates, State, Topology
from rfem_jax.mechanics.realisation import Realisation
from rfem_jax.simulation import equations
from rfem_jax.simulation.equations import Integrals
from rfem_jax.simulation.run import Energy


class Instant(NamedTuple):
    """Joint loads and what else the solution of one instant's equations gives.

    loads: of all joints; base (6,): wrench of the base at the origin; accelerations of the coordinates;
    drift [m], drift_angle [rad] of the cut joints; arm [m]: largest coordinate of a hinge; stabilising,
    multiplier: largest multipliers [N]; residual [N]: force left over in the equations of motion;
    dissipated [W]: power of the dampers.
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
    dissipated: Array


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


def solved_instant(
    realised: Realisation, result: Accelerations, drive: DriveInput, scale: Array
) -> Instant:
    """An instant whose accelerations were solved for."""
    joint, base = loads.chain_loads(realised, result, result.angular, result.linear, drive)
    drift, drift_angle = _drift(result.closure, scale)
    return Instant(
        loads=joint,
        base=base,
        accelerations=result.coordinates,
        drift=drift,
        drift_angle=drift_angle,
        arm=jnp.max(jnp.abs(result.motion.hinges.point)),
        stabilising=jnp.max(jnp.abs(result.stabilising), initial=0.0),
        multiplier=jnp.max(jnp.abs(result.multipliers), initial=0.0),
        residual=jnp.zeros(()),
        dissipated=result.dissipated,
    )


def balanced_instant(
    topology: Topology,
    left: Balance,
    accelerations: Coordinates,
    drive: DriveInput,
    scale: Array,
    left_over: Array,
) -> Instant:
    """An instant whose accelerations were found by balancing the equations up to a force [N] left over.

    What is left over, in forces and in the closure, is the solver's and has no derivative."""
    drift, drift_angle = jax.lax.stop_gradient(_drift(left.closure, scale))
    return Instant(
        loads=loads.loads_of_wrenches(topology, left, left.wrenches, drive),
        base=loads.base_wrench(topology, left.wrenches),
        accelerations=accelerations,
        drift=drift,
        drift_angle=drift_angle,
        arm=jnp.max(jnp.abs(left.motion.hinges.point)),
        stabilising=jnp.zeros(()),
        multiplier=jnp.max(jnp.abs(left.multipliers), initial=0.0),
        residual=jax.lax.stop_gradient(left_over),
        dissipated=left.dissipated,
    )


def observe(
    realised: Realisation,
    state: State,
    drive: DriveInput,
    integrals: Integrals,
    instant: Instant,
    scale: Array,
) -> Record:
    """Record of one instant."""
    with jax.named_scope("observation"):
        topology = realised.topology
        joint, now = instant.loads, motion(realised, state)
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
            branch=_branch(realised, now, scale),
            square_integrals=jnp.stack(
                [integrals.axial_square + integrals.normal_square, integrals.moment_square]
            ),
        )


def _branch(realised: Realisation, now: Motion, scale):
    """Assembly modes of the cut joints (C,)."""
    cuts = closure(realised, now, scale)
    return jnp.zeros((0,)) if cuts is None else assembly_modes(realised, now, cuts)


def _drift(cuts, scale):
    """Largest distance [m] of two joint centres, and largest axis equation [rad]."""
    if cuts is None:
        return jnp.zeros(()), jnp.zeros(())
    distance = equations.guarded_root(jnp.max(jnp.sum(cuts.residual[:3] ** 2, axis=0)))
    return distance, jnp.max(jnp.abs(cuts.residual[3:])) / scale
