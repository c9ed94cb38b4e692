"""Generalised-alpha: an implicit method of order 2 whose steps follow the motion, not the stiffness.

Place in the pipeline: newton, newmark_formulas, step_boundaries -> **generalised_alpha** -> solvers, stepping.

The formulas of a step, from the start 0 to the end 1, are those of `newmark_formulas`:

    (7.1), (7.2) of theory,     equations of motion at (q1, v1, v1', lambda1, t1),     Phi(q1) = 0

v' are the accelerations of the motion, a the auxiliary ones of the method, lambda the multipliers.

    t0 ------------------------------- h ------------------------------> t1
    StepStart                                                            StepEnd
    q0, v0 (trajectory)           .----------------------------.         q1, v1, integrals (trajectory)
    a0, v0' (memory)              |                            |         a1, v1', lambda1 (memory)
         |                        v                            |             ^
         '-> predict ----> v1', lambda1 --> newmark: a1, q1, v1 --> evaluate -- converged
                                  ^                               | residual
                                  '------- Newton increment <-----' not small

Newton's method uses one iteration matrix a step, formed at the prediction, with friction by loads or contacts one an
increment.  It stops when the residual is a small
share of the largest joint force so far and the cut joints are closed, or after as many increments as are allowed;
the residual at the end is part of the result.  The joint loads come from v1' and lambda1, with which the equations
of motion hold at t1; integrals of squared loads and of powers are sums by the trapezoidal rule.

A step of length zero finds v' and lambda at a given state: with it the method starts, and restarts after a jump of
the drive.
"""

import dataclasses
import math
from collections.abc import Callable, Sequence
from typing import ClassVar

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, PyTree

from rfem_jax.description.basics.errors import InputError
from rfem_jax.description.methods import GeneralisedAlpha, Method
from rfem_jax.kernels import kernel
from rfem_jax.mechanics.forces import nonsmooth_forces
from rfem_jax.mechanics.forces.friction import FrictionTangent
from rfem_jax.mechanics.forces.nonsmooth_forces import SecantLines
from rfem_jax.mechanics.forces.tangents import NO_FRICTION, force_tangents
from rfem_jax.mechanics.implicit.condensation import LinkOperator, link_operators, operators_at
from rfem_jax.mechanics.implicit.newton import IterationMatrix, iteration_matrix, newton_increment
from rfem_jax.mechanics.implicit.residual import (
    Evaluation,
    evaluate_residual,
    residual_forces,
    residual_of,
    rounding_force,
    with_wrenches,
)
from rfem_jax.mechanics.kinematics.cut_joints import Closure, closure
from rfem_jax.mechanics.kinematics.motion import Motion, motion_of
from rfem_jax.mechanics.model.inputs import DriveInput
from rfem_jax.mechanics.model.model import Coordinates, State
from rfem_jax.mechanics.model.topology import Topology
from rfem_jax.mechanics.model.with_errors import ModelWithErrors
from rfem_jax.simulation.outcome.observation import Instant, cut_drift, evaluated_instant
from rfem_jax.simulation.outcome.run import RESIDUAL_LIMIT
from rfem_jax.simulation.solvers.implicit_step import (
    Following,
    Memory,
    StepConstants,
    StepEnd,
    StepStart,
    Unknowns,
    solved_step,
    traced_once,
)
from rfem_jax.simulation.solvers.newmark_formulas import NewmarkFormulas
from rfem_jax.simulation.solvers.step_boundaries import (
    force_delay,
    remembering,
    squared_moments,
    step_end,
    with_least_reactions,
)
from rfem_jax.simulation.system import equations
from rfem_jax.simulation.system.batches import with_batch_axes
from rfem_jax.simulation.system.equations import Conditions, Scalar, Trajectory

CLOSED = 1e-7  # drift of the cut joints that Newton's method may leave, relative to the longest link
# The residual acts as an error force in every step, and after a jump loads are a fraction of the largest so far: RMS
# loads err by up to this many times the tolerance, and derivatives need be no more accurate.  With one Newton
# increment derivatives err by 2e-3 at errors of practical size (twenty times that where the errors are so small that
# loads hardly depend on them), with every further one by a thirteenth, for steps of 2.5 ms; for 5 ms by 1e-2 and a
# ninth: table in benchmarks/README.md.
ACCURACY_OF_TOLERANCE = 30.0
ERROR_OF_FIRST_INCREMENT, REDUCTION_BY_INCREMENT = 5e-3, 1.0 / 13.0

MadeJump = bool | Bool[Array | np.ndarray, ""]
StepState = tuple[Trajectory, Float[Array, "4 joints"]]


class GeneralisedAlphaSolver(diffrax.AbstractSolver[Memory]):
    """The method as a diffrax solver of the equations of motion.

    It reads the mechanism itself instead of the vector field of its terms, so it solves these equations only:

        diffrax.diffeqsolve(terms, GeneralisedAlphaSolver(method), t0, t1, h, y0, args=conditions, ...)

    with y0 = (`Trajectory`, squared maxima (2, joints) so far of axial and normal forces), args = `Conditions`
    of one phase of the drive, terms = `stepping.TERMS`.  One call integrates between two jumps of the drive.  Steps may
    vary; if all have one length, and the `operators` of the conditions are those of this length, they are not formed in
    every step.  A step in which Newton's method fails has the result `nonlinear_max_steps_reached`.

    **Arguments:** `method`: an implicit `Method`.

    Attributes: formulas of a step; max_increments: largest number of Newton increments in a step; tolerance: largest
    residual, as a share of the largest joint force; contact_tolerance: with which the caller divides steps
    (`contact_steps`), 0 if it does not.

    **Raises:** `InputError` for a method that is not implicit.
    """

    term_structure: ClassVar = diffrax.AbstractTerm
    interpolation_cls: ClassVar[Callable] = diffrax.LocalLinearInterpolation
    # diffrax's adjoints look at it: a step takes every transform.
    scan_kind: ClassVar[str] = "bounded"

    formulas: NewmarkFormulas = eqx.field(static=True)
    max_increments: int = eqx.field(static=True)
    tolerance: float = eqx.field(static=True)
    contact_tolerance: float = eqx.field(static=True)

    def __init__(self, method: Method):
        if not isinstance(method, GeneralisedAlpha):
            raise InputError(f'Argument `method` must be "generalised_alpha", but is {method.name!r}.')
        self.formulas = NewmarkFormulas.of_radius(method.spectral_radius)
        self.max_increments = method.corrections
        self.tolerance = method.tolerance
        self.contact_tolerance = method.contact_tolerance

    @property
    def tangent_increments(self) -> int:
        """Number of Newton increments of a derivative, from the tolerance."""
        wanted = ACCURACY_OF_TOLERANCE * self.tolerance
        further = math.log(wanted / ERROR_OF_FIRST_INCREMENT) / math.log(REDUCTION_BY_INCREMENT)
        return max(1, 1 + math.ceil(further))

    def order(self, terms: PyTree) -> int:
        return 2

    def func(self, terms: diffrax.AbstractTerm, t0: Scalar, y0: StepState, args: Conditions) -> StepState:
        return terms.vf(t0, y0, args)

    def init(self, terms: diffrax.AbstractTerm, t0: Scalar, t1: Scalar, y0: StepState, args: Conditions) -> Memory:
        """Accelerations and multipliers at the start, by a step of length zero."""
        del t1
        return self.step(terms, t0, t0, y0, args, self.start(args, y0[0]), False)[3]

    def start(self, conditions: Conditions, trajectory: Trajectory) -> Memory:
        """Memory before the first step, all zero: that step must have length zero."""
        multipliers = jnp.zeros(conditions.actual.topology.n_constraints)
        zeros = jax.tree.map(jnp.zeros_like, trajectory.velocity)
        rates = jax.tree.map(jnp.zeros_like, trajectory.integrals)
        actual = conditions.actual
        forces = nonsmooth_forces.first_memory(actual, State(trajectory.position, trajectory.velocity))
        following = None
        if self.follows(actual):
            following = Following(jnp.zeros(()), jnp.zeros((), bool), jnp.zeros(()))
        # Forces that jump are no trend.
        earlier = None if nonsmooth_forces.change_within_steps(actual) else zeros.joints
        none = jnp.zeros(())
        return Memory(zeros, zeros, multipliers, rates, none, none, forces, following, earlier)

    def follows(self, actual: ModelWithErrors) -> bool:
        """Whether the steps of a mechanism are parts that follow contacts."""
        return bool(actual.topology.clearances) and self.contact_tolerance > 0.0

    def resume(
        self,
        terms: diffrax.AbstractTerm,
        t0: Scalar,
        t1: Scalar,
        y0: StepState,
        args: Conditions,
        memory: Memory,
    ) -> Memory:
        """Memory at the start of an interval: that at the end of the one before."""
        del terms, t0, t1, y0, args
        return memory

    def step(
        self,
        terms: diffrax.AbstractTerm,
        t0: Scalar,
        t1: Scalar,
        y0: StepState,
        args: Conditions,
        solver_state: Memory,
        made_jump: MadeJump,
    ) -> tuple[StepState, None, dict[str, StepState], Memory, diffrax.RESULTS]:
        """One step; of length zero: accelerations and multipliers at the given state.

        After a jump of the drive the caller takes a step of length zero, so `made_jump` is not read.
        """
        del terms, made_jump
        h, (trajectory, peaks) = jnp.asarray(t1 - t0), y0
        operators = args.operators
        if operators is None:
            operators = jax.tree.map(lambda x: x[0], self.operators(args.actual, h[None]))
        start = remembering(StepStart(dataclasses.replace(args, operators=None), trajectory, solver_state))
        seen = jnp.maximum(peaks, equations.squared_loads(solver_state.rates))
        largest = equations.largest_component(seen)
        if nonsmooth_forces.may_be_only_loads(args.actual):
            largest = jnp.maximum(largest, squared_moments(trajectory, solver_state, t1) / args.stabilisation.scale**2)
        constants = StepConstants(t1, h, jnp.sqrt(largest))
        operators, constants, fixed = jax.lax.stop_gradient((operators, constants, start))
        matrix = self.iteration_matrix(operators, constants, fixed)
        trajectory, memory = solved_step(self, matrix, constants, start)
        y1 = trajectory, jnp.maximum(peaks, equations.squared_loads(memory.rates))
        allowed = RESIDUAL_LIMIT * jnp.sqrt(equations.largest_component(jax.lax.stop_gradient(y1[1])))
        if nonsmooth_forces.may_be_only_loads(args.actual):
            allowed = jnp.maximum(allowed, RESIDUAL_LIMIT * constants.largest_force)
        rounding = rounding_force(args.actual, args.stabilisation.scale, h)
        allowed = jnp.maximum(allowed, RESIDUAL_LIMIT * jax.lax.stop_gradient(rounding))
        result = diffrax.RESULTS.where(
            memory.residual <= allowed,
            diffrax.RESULTS.successful,
            diffrax.RESULTS.nonlinear_max_steps_reached,  # pyright: ignore[reportArgumentType] # an enumeration's item
        )
        return y1, None, {"y0": y0, "y1": y1}, memory, result

    def operators(self, actual: ModelWithErrors, lengths: Float[Array, " lengths"]) -> tuple[LinkOperator | None, ...]:
        """Condensed links for steps of several lengths [s], which are the first axis of the result."""
        condensed = kernel(lambda actual, h: link_operators(actual, *self.formulas.factors(h)), name="condensed links")
        return jax.vmap(condensed, in_axes=(None, 0))(actual, lengths)

    def instant(
        self, t: Scalar, h: Float[Array, ""], trajectory: Trajectory, memory: Memory, conditions: Conditions
    ) -> tuple[Float[Array, "4 joints"], State, DriveInput, Instant]:
        """At the end t of a step of length h [s]: squared loads, state, drive, and the instant."""
        scale = conditions.stabilisation.scale
        state = State(trajectory.position, trajectory.velocity)
        drive = conditions.drives.at(t, conditions.phase)
        accelerations, multipliers = memory.accelerations, memory.multipliers
        evaluation = evaluate_residual(conditions.actual, state, accelerations, multipliers, drive, scale)
        forces = residual_forces(conditions.actual, self.formulas.closing_as_acceleration(evaluation, h), drive, scale)
        topology = conditions.actual.topology
        evaluation = with_least_reactions(conditions.actual, evaluation)
        instant = evaluated_instant(topology, evaluation, accelerations, drive, scale, forces)
        return equations.squared_loads(memory.rates), state, drive, instant

    @traced_once
    def solve(self, matrix: IterationMatrix, constants: StepConstants, start: StepStart) -> StepEnd:
        """Newton's method from the prediction, by increments with the iteration matrix."""
        conditions, trajectory, memory = start
        topology = conditions.actual.topology
        drift = CLOSED * conditions.stabilisation.scale
        predicted = self.predict(constants, start)
        evaluation = self.evaluate(predicted, constants, start)[0]

        renewed = nonsmooth_forces.change_within_steps(conditions.actual)
        # Contacts converge an increment later; a step that is not solved is repeated in quarters, which costs more.
        most = self.max_increments + self.follows(conditions.actual)

        def kept(evaluation):
            # The matrix is formed again for every increment then, from all of the evaluation.
            return evaluation if renewed else residual_of(evaluation)

        def unconverged(carry):
            count, converged, *_ = carry
            return (count == 0) | ((count < most) & ~converged)

        def improve(carry):
            count, _, unknowns, residual, lines, _ = carry
            present = matrix
            if renewed:
                lines = nonsmooth_forces.secant_lines(conditions.actual, residual.laws, lines, count)
                present = self.matrix_at(matrix, unknowns, residual, constants, start, lines)
                residual = residual_of(residual)
            increment = newton_increment(topology, present, residual)
            unknowns = jax.tree.map(jnp.add, unknowns, increment)
            evaluation, end = self.evaluate(unknowns, constants, start)
            closed = cut_drift(evaluation.closure, conditions.stabilisation.scale)[0] <= drift
            converged = (end.memory.residual <= self.tolerance * constants.largest_force) & closed
            return count + 1, converged, unknowns, kept(evaluation), lines, end

        # The first increment is always made, so the end of the step at the prediction is not needed.
        count, converged = with_batch_axes(
            (jnp.zeros((), jnp.int32), jnp.zeros((), bool)), *(x for x in jax.tree.leaves(predicted) if x.size)
        )
        lines = nonsmooth_forces.secant_lines(conditions.actual, evaluation.laws)
        carry = count, converged, predicted, kept(evaluation), lines, StepEnd(trajectory, memory)
        return jax.lax.while_loop(unconverged, improve, carry)[-1]

    @traced_once
    def iteration_matrix(
        self, operators: tuple[LinkOperator | None, ...], constants: StepConstants, start: StepStart
    ) -> IterationMatrix:
        """Approximate Jacobian of the residual, formed at the prediction; the solution does not depend on it."""
        h, (conditions, trajectory, memory) = constants.length, start
        actual, scale = conditions.actual, conditions.stabilisation.scale
        drive = conditions.drives.at(constants.end, conditions.phase)
        accelerations, _ = self.predict(constants, start)
        state, _ = self.formulas.end_of_step(h, trajectory, memory, accelerations, actual.topology, drive)
        now = motion_of(actual, state)
        operators = operators_at(actual, operators, now.relative, *self.formulas.factors(h))
        return self._matrix(operators, state, now, closure(actual, now, scale), h, conditions, drive)

    def matrix_at(
        self,
        matrix: IterationMatrix,
        unknowns: Unknowns,
        evaluation: Evaluation,
        constants: StepConstants,
        start: StepStart,
        lines: SecantLines | None = None,
    ) -> IterationMatrix:
        """The iteration matrix at other unknowns than the prediction, where tangents of forces change much within a
        step; `lines` instead of tangents, where they are given (theory (12.6), (12.9))."""
        h, (conditions, trajectory, memory) = constants.length, start
        actual = conditions.actual
        if not nonsmooth_forces.change_within_steps(actual):
            return matrix
        drive = conditions.drives.at(constants.end, conditions.phase)
        state, _ = self.formulas.end_of_step(h, trajectory, memory, unknowns.accelerations, actual.topology, drive)
        ahead = force_delay(constants, start)
        factor = self.formulas.factors(h)[1] + (0.0 if ahead is None else ahead)
        friction = nonsmooth_forces.tangent(actual, evaluation.laws, factor, lines)
        return self._matrix(
            matrix.operators, state, evaluation.motion, evaluation.closure, h, conditions, drive, friction
        )

    def _matrix(
        self,
        operators: tuple[LinkOperator | None, ...],
        state: State,
        motion: Motion,
        cuts: Closure | None,
        h: Float[Array, ""],
        conditions: Conditions,
        drive: DriveInput,
        friction: FrictionTangent = NO_FRICTION,
    ) -> IterationMatrix:
        """The iteration matrix at a state and its motion."""
        actual, scale = conditions.actual, conditions.stabilisation.scale
        tangents = force_tangents(actual, state, motion, cuts, drive.time, scale, self.formulas.factors(h), friction)
        return iteration_matrix(actual, operators, motion, cuts, conditions.drives.prescribed, tangents)

    def predict(self, constants: StepConstants, start: StepStart) -> Unknowns:
        """Accelerations and multipliers of the last step as a first guess; those of the joints' coordinates change by
        as much as in the last step (theory, before (7.6)).

        Geometrically exact links keep their shape instead: their matrix is formed at the prediction, and
        accelerations of stiff vibrations, carried on over a long step, would bend them far.
        """
        h, (conditions, trajectory, memory) = constants.length, start
        topology = conditions.actual.topology
        drive = conditions.drives.at(constants.end, conditions.phase)
        accelerations = memory.accelerations
        if topology.exact:
            elastic = self.formulas.keeping_shape(h, trajectory.velocity.elastic, memory)
            accelerations = Coordinates(accelerations.joints, elastic)
        if memory.earlier is not None:
            joints = jnp.where(h > 0.0, 2.0 * accelerations.joints - memory.earlier, accelerations.joints)
            accelerations = Coordinates(joints, accelerations.elastic)
        return Unknowns(_with_prescribed(topology, drive, accelerations), memory.multipliers)

    def evaluate(self, unknowns: Unknowns, constants: StepConstants, start: StepStart) -> tuple[Evaluation, StepEnd]:
        """Residual at given unknowns (its `closing` as an acceleration), and the end of the step if it is zero."""
        h, (conditions, trajectory, memory) = constants.length, start
        actual, scale = conditions.actual, conditions.stabilisation.scale
        drive = conditions.drives.at(constants.end, conditions.phase)
        accelerations, multipliers = unknowns
        state, auxiliary = self.formulas.end_of_step(h, trajectory, memory, accelerations, actual.topology, drive)
        ahead = force_delay(constants, start)
        evaluation = evaluate_residual(actual, state, accelerations, multipliers, drive, scale, ahead)
        evaluation = self.formulas.closing_as_acceleration(evaluation, h)
        return evaluation, step_end(evaluation, unknowns, state, auxiliary, drive, h, start)

    def end_from_wrenches(
        self,
        wrenches: Sequence[Float[Array, "6"]],
        unknowns: Unknowns,
        evaluation: Evaluation,
        constants: StepConstants,
        start: StepStart,
    ) -> StepEnd:
        """The end of the step at given unknowns and wrenches of the tree joints, for those of the evaluation."""
        h, (conditions, trajectory, memory) = constants.length, start
        actual = conditions.actual
        drive = conditions.drives.at(constants.end, conditions.phase)
        accelerations, topology = unknowns.accelerations, actual.topology
        state, auxiliary = self.formulas.end_of_step(h, trajectory, memory, accelerations, topology, drive)
        scale, ahead = conditions.stabilisation.scale, force_delay(constants, start)
        evaluation = with_wrenches(evaluation, wrenches, actual, state, *unknowns, drive, scale, ahead)
        return step_end(evaluation, unknowns, state, auxiliary, drive, h, start)


def _with_prescribed(topology: Topology, drive: DriveInput, accelerations: Coordinates) -> Coordinates:
    """The accelerations with the prescribed ones put in."""
    joints = accelerations.joints
    for k, (_, _, acceleration) in drive.motions.items():
        joints = jnp.where(np.arange(topology.n_freedoms) == k, acceleration[None], joints)
    return Coordinates(joints, accelerations.elastic)
