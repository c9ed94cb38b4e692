"""Where a step of the implicit method begins and ends: what it remembers, loads, integrals.

Place in the pipeline: equations, implicit_step, loads -> **step_boundaries** -> generalised_alpha.

Integrals are sums by the trapezoidal rule, joint loads those with which the equations of motion hold at the end.
"""

import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from rfem_jax.mechanics.dynamics import loads
from rfem_jax.mechanics.forces import nonsmooth_forces
from rfem_jax.mechanics.implicit.residual import Evaluation, residual_forces
from rfem_jax.mechanics.kinematics.slender_links import completed_state
from rfem_jax.mechanics.model.inputs import DriveInput
from rfem_jax.mechanics.model.model import Coordinates, State
from rfem_jax.mechanics.model.with_errors import ModelWithErrors
from rfem_jax.simulation.solvers.implicit_step import Memory, StepConstants, StepEnd, StepStart, Unknowns
from rfem_jax.simulation.system import equations
from rfem_jax.simulation.system.equations import Integrals, Scalar, Trajectory


def step_end(
    evaluation: Evaluation,
    unknowns: Unknowns,
    state: State,
    auxiliary: Coordinates,
    drive: DriveInput,
    h: Float[Array, ""],
    start: StepStart,
) -> StepEnd:
    """Trajectory and memory at the end: loads from the evaluation, integrals by the trapezoidal rule."""
    conditions, trajectory, memory = start
    actual, scale = conditions.actual, conditions.stabilisation.scale
    accelerations, multipliers = unknowns
    residual = jnp.max(jnp.abs(residual_forces(actual, evaluation, drive, scale)), initial=0.0)
    residual = jax.lax.stop_gradient(residual)
    evaluation = with_least_reactions(actual, evaluation)
    joint = loads.loads_of_wrenches(actual.topology, evaluation, evaluation.wrenches, drive)
    axial, normal, moment = equations.squares(actual.topology, joint)
    work = equations.applied_power(actual.topology, state, drive, joint, evaluation)
    lost = nonsmooth_forces.losses(actual.topology, evaluation.laws, evaluation.frame_loads)
    rates = Integrals(axial, normal, moment, work, evaluation.dissipated, *lost)
    integrals = jax.tree.map(
        lambda sum, old, new: sum + 0.5 * h * (old + new),
        trajectory.integrals,
        memory.rates,
        rates,
    )
    most = jnp.maximum(memory.largest_residual, residual)
    earlier = memory.earlier
    if earlier is not None:  # after a step of length zero, as at a start, there is none
        earlier = jnp.where(h > 0.0, memory.accelerations.joints, accelerations.joints)
    state = completed_state(actual, state)
    return StepEnd(
        Trajectory(state.position, state.velocity, integrals),
        memory._replace(
            accelerations=accelerations,
            auxiliary=auxiliary,
            multipliers=multipliers,
            rates=rates,
            residual=residual,
            largest_residual=most,
            forces=nonsmooth_forces.after_step(memory.forces),
            earlier=earlier,
        ),
    )


def with_least_reactions(actual: ModelWithErrors, evaluation: Evaluation) -> Evaluation:
    """The evaluation with the smallest redundant reactions; Newton's method leaves them as they were."""
    evaluation, wrenches = loads.with_least_reactions(actual, evaluation, evaluation.wrenches)
    return evaluation._replace(wrenches=wrenches)


def force_delay(constants: StepConstants, start: StepStart) -> Float[Array, ""] | None:
    """Time [s] by which forces are taken later in this step, None where none are."""
    return nonsmooth_forces.delay(start.memory.forces, start.conditions.ahead, constants.length)


def remembering(start: StepStart) -> StepStart:
    """The start of a step whose forces remember how they began."""
    conditions, trajectory, memory = start
    state = State(trajectory.position, trajectory.velocity)
    actual, forces = nonsmooth_forces.remembered(conditions.actual, state, memory.forces)
    return StepStart(dataclasses.replace(conditions, actual=actual), trajectory, memory._replace(forces=forces))


def squared_moments(trajectory: Trajectory, memory: Memory, t: Scalar) -> Float[Array, ""]:
    """Largest squared moment [N^2 m^2] of a joint in the last step, or its mean square so far: friction may be the only
    load."""
    mean = trajectory.integrals.moment_square / jnp.where(t > 0.0, t, 1.0)
    return jnp.max(jnp.maximum(memory.rates.moment_square, mean))
