"""Accelerations at one instant of mechanisms with slender links, whose rfes are joined by constraints.

Place in the pipeline: residual, condensation, newton -> **slender_dynamics** -> simulation.

`dynamics` takes a free rfe as a body of its own, since springs alone hold it.  In a slender link forces between rfes
depend on the accelerations.  The equations of motion are linear in accelerations and multipliers, so that one increment
of Newton's method solves them, from zero, with links condensed for their masses alone (theory (4.11)).
"""

import jax.numpy as jnp
import numpy as np
from jax import Array

from rfem_jax.mechanics.dynamics import dynamics
from rfem_jax.mechanics.dynamics.dynamics import Accelerations
from rfem_jax.mechanics.forces.tangents import force_tangents
from rfem_jax.mechanics.implicit.condensation import mass_operators
from rfem_jax.mechanics.implicit.newton import IterationMatrix, iteration_matrix, newton_increment
from rfem_jax.mechanics.implicit.residual import Evaluation, Residual, evaluate_residual
from rfem_jax.mechanics.kinematics.slender_links import completed
from rfem_jax.mechanics.model.inputs import DriveInput, Stabilisation
from rfem_jax.mechanics.model.model import Coordinates, State
from rfem_jax.mechanics.model.with_errors import ModelWithErrors


def accelerations(
    actual: ModelWithErrors, state: State, drive: DriveInput, stabilisation: Stabilisation
) -> Accelerations:
    """Accelerations of all coordinates and bodies, and the multipliers of the cut joints, of any mechanism.

    `state` is taken with prescribed values already imposed (`impose`).
    """
    topology, scale = actual.topology, stabilisation.scale
    if not topology.slender:
        return dynamics.accelerations(actual, state, drive, stabilisation)
    joints, still = jnp.zeros(topology.n_freedoms), jnp.zeros((6, topology.n_rfes))
    for k, (_, _, acceleration) in drive.motions.items():
        joints = jnp.where(np.arange(topology.n_freedoms) == k, acceleration[None], joints)
    none = Coordinates(joints, still), jnp.zeros(topology.n_constraints)
    at = evaluate_residual(actual, state, *none, drive, scale)
    zero = jnp.zeros(())
    tangents = force_tangents(actual, state, at.motion, at.closure, drive.time, scale, (zero, zero))
    operators = mass_operators(actual, at.motion.relative)
    matrix = iteration_matrix(actual, operators, at.motion, at.closure, tuple(drive.motions), tangents)
    baumgarte = _baumgarte(at, stabilisation)
    residual = Residual(at.hinge, at.force, at.moment, at.closing_acceleration - baumgarte)
    increment = newton_increment(topology, matrix, residual)
    found = Coordinates(joints + increment.accelerations.joints, increment.accelerations.elastic)
    found = completed(actual, at.motion.relative, found)
    solved = evaluate_residual(actual, state, found, increment.multipliers, drive, scale)
    return Accelerations(
        coordinates=found,
        multipliers=increment.multipliers,
        stabilising=_stabilising(matrix, baumgarte),
        angular=solved.angular,
        linear=solved.linear,
        spatial=jnp.zeros((6, topology.n_links)),
        motion=solved.motion,
        closure=solved.closure,
        interface_tree=None,
        dissipated=solved.dissipated,
        laws=solved.laws,
        frame_loads=solved.frame_loads,
    )


def _baumgarte(at: Evaluation, stabilisation: Stabilisation) -> Array:
    """Second derivatives of the closure equations that stabilise them; zero for springs' laws."""
    if at.closure is None:
        return at.closing
    gains = stabilisation.velocity_gain, stabilisation.position_gain
    wanted = -gains[0] * at.closure.rate - gains[1] * at.closure.residual
    sprung = at.closure.sprung_rows
    return jnp.where(np.array(sprung), 0.0, wanted) if sprung else wanted


def _stabilising(matrix: IterationMatrix, baumgarte: Array) -> Array:
    """Multipliers due to stabilisation alone."""
    if matrix.closure is None:
        return baumgarte
    return matrix.closure.solve(jnp.zeros_like(baumgarte), -baumgarte)
