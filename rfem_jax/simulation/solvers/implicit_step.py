"""One step of an implicit method as a differentiable function of its start.

Place in the pipeline: newton -> **implicit_step** -> generalised_alpha.

A step from a start x solves equations R(z, x) = 0 for the unknowns z, accelerations and multipliers at its end, by
Newton's method with an approximate Jacobian, the iteration matrix.  It is differentiated by the implicit function
theorem,

    dR/dz dz + dR/dx dx = 0,

not through the iterations.  This linear system is solved iteratively, too: increments with the iteration matrix
in place of dR/dz, as many as the accuracy asked of the loads needs (theory (7.17) to (7.20)).  The residual that
remains of it shows in the derivative of `Run.checks.equation_residual`.
"""

import functools
from collections.abc import Sequence
from typing import NamedTuple, Protocol, runtime_checkable

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.ad_checkpoint import checkpoint_name
from jaxtyping import Array, Bool, Float

from rfem_jax.kernels import kernel
from rfem_jax.mechanics.algebra.derivative_rules import active_inputs
from rfem_jax.mechanics.forces.nonsmooth_forces import ForceMemory
from rfem_jax.mechanics.implicit.condensation import LinkOperator
from rfem_jax.mechanics.implicit.newton import (
    IterationMatrix,
    NewtonIncrement,
    increment_and_wrenches,
)
from rfem_jax.mechanics.implicit.residual import Evaluation, residual_of
from rfem_jax.mechanics.model.model import Coordinates
from rfem_jax.simulation.system.batches import with_batch_axes
from rfem_jax.simulation.system.equations import Conditions, Integrals, Scalar, Trajectory

SOLUTION = "solution of an implicit step"  # what reverse mode keeps of a step
Unknowns = NewtonIncrement  # accelerations and multipliers, as the increments that are added to them


class Following(NamedTuple):
    """Record of how steps have followed contacts: changes, how often one has closed or opened; exhausted: whether a
    step was tried in too many parts; length [s] of the last part, zero at the start."""

    changes: Float[Array, ""]
    exhausted: Bool[Array, ""]
    length: Float[Array, ""]


class Memory(NamedTuple):
    """Memory of an implicit method from step to step, besides the trajectory.

    accelerations v' of the coordinates; auxiliary: the method's own accelerations a; multipliers [N]; rates: time
    derivatives of the integrals; residual [N]: largest force that the residual of the last step has, and
    largest_residual [N] that of all steps so far; forces: what forces remember; following: how steps have followed
    contacts, None where they do not; earlier: accelerations of the joints' coordinates a step before, None where the
    first guess does not go on from them.
    """

    accelerations: Coordinates
    auxiliary: Coordinates
    multipliers: Float[Array, " constraints"]
    rates: Integrals
    residual: Float[Array, ""]
    largest_residual: Float[Array, ""]
    forces: ForceMemory = ForceMemory()
    following: Following | None = None
    earlier: Float[Array, " freedoms"] | None = None


class StepStart(NamedTuple):
    """State and memory at the start of a step; a step is differentiated with respect to them."""

    conditions: Conditions
    trajectory: Trajectory
    memory: Memory


class StepConstants(NamedTuple):
    """Constants of a step, which have no derivatives: its end [s] and length [s]; largest_force [N] that a
    joint has carried so far."""

    end: Scalar
    length: Float[Array, ""]
    largest_force: Float[Array, ""]


class StepEnd(NamedTuple):
    """Results of a step."""

    trajectory: Trajectory
    memory: Memory


@runtime_checkable
class ImplicitMethod(Protocol):
    """An implicit method whose steps `solved_step` takes and differentiates; hashable, without arrays."""

    @property
    def tangent_increments(self) -> int:
        """Number of Newton increments that solve for the derivative of the unknowns."""
        ...

    def iteration_matrix(
        self, operators: tuple[LinkOperator | None, ...], constants: StepConstants, start: StepStart
    ) -> IterationMatrix:
        """The approximate Jacobian of the step's equations, factored."""
        ...

    def matrix_at(
        self,
        matrix: IterationMatrix,
        unknowns: Unknowns,
        evaluation: Evaluation,
        constants: StepConstants,
        start: StepStart,
    ) -> IterationMatrix:
        """The approximate Jacobian at the given unknowns, where it is better than the step's own for derivatives."""
        ...

    def solve(self, matrix: IterationMatrix, constants: StepConstants, start: StepStart) -> StepEnd:
        """Solve the equations of the step by Newton's method with the iteration matrix."""
        ...

    def predict(self, constants: StepConstants, start: StepStart) -> Unknowns:
        """Initial guess of the unknowns."""
        ...

    def evaluate(self, unknowns: Unknowns, constants: StepConstants, start: StepStart) -> tuple[Evaluation, StepEnd]:
        """The step's equations at given unknowns: their residual, and the end of the step if that is zero."""
        ...

    def end_from_wrenches(
        self,
        wrenches: Sequence[Float[Array, "6"]],
        unknowns: Unknowns,
        evaluation: Evaluation,
        constants: StepConstants,
        start: StepStart,
    ) -> StepEnd:
        """The end of the step at given unknowns and wrenches of the tree joints at the global origin, instead of
        those of the evaluation."""
        ...


# Of a method's own functions, which transformations of the loops around them would trace again and again.
traced_once = functools.partial(jax.jit, static_argnums=0)


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def solved_step(method: ImplicitMethod, matrix: IterationMatrix, constants: StepConstants, start: StepStart) -> StepEnd:
    """The end of a step, differentiable with respect to its start."""
    end = method.solve(matrix, constants, start)
    return with_batch_axes(end, *_batched_accelerations(end.memory.accelerations))


@functools.partial(jax.custom_jvp, nondiff_argnums=(0,))
def _solution(method, matrix, constants, start):
    """The unknowns that solve the equations of a step."""
    return _unknowns_of(method.solve(matrix, constants, start))


def _batched_accelerations(accelerations: Coordinates) -> list[Array]:
    """Accelerations with the batch axes of a step: of joints, or of rfes where no joint has a free motion."""
    return [x for x in (accelerations.joints, accelerations.elastic) if x.size][:1]


def _unknowns_of(end: StepEnd) -> Unknowns:
    return Unknowns(end.memory.accelerations, end.memory.multipliers)


def _differentiate(method, primals, tangents):
    """Rule of `solved_step`: its value and its tangent."""
    matrix, constants, start = primals
    inputs, fixed, along = active_inputs(start, tangents[2])
    # Kept by name, so that reverse mode does not repeat Newton's method.
    solution = jax.tree.map(lambda x: checkpoint_name(x, SOLUTION), _solution(method, matrix, constants, start))
    end, tangent = _end_and_tangent(method, matrix, constants, solution, inputs, fixed, along)
    return with_batch_axes(end, *_batched_accelerations(solution.accelerations)), tangent


def _differentiate_solution(method, primals, tangents):
    """Rule of `_solution`, for derivatives of higher order."""
    end, tangent = _differentiate(method, primals, tangents)
    return _unknowns_of(end), _unknowns_of(tangent)


solved_step.defjvp(_differentiate, symbolic_zeros=True)
_solution.defjvp(_differentiate_solution, symbolic_zeros=True)


@traced_once
def _end_and_tangent(method, matrix, constants, solution, inputs, fixed, along):
    """End of a solved step, and its derivative along a tangent of the active inputs."""

    def at(unknowns, inputs):
        evaluation, end = method.evaluate(unknowns, constants, eqx.combine(inputs, fixed))
        return (residual_of(evaluation), end), evaluation

    def predicted(inputs):
        return method.predict(constants, eqx.combine(inputs, fixed))

    # One linearisation at the solution serves all increments.
    (_, end), linearised, evaluation = jax.linearize(at, solution, inputs, has_aux=True)
    start = eqx.combine(inputs, fixed)
    topology = start.conditions.actual.topology
    matrix = jax.lax.stop_gradient(method.matrix_at(matrix, solution, evaluation, constants, start))

    # What the last increment changes of the loads also follows from the iteration matrix, as accurately as the
    # increment itself; another evaluation of the linearised equations would cost half as much again.
    def end_at(wrenches, unknowns):
        return method.end_from_wrenches(wrenches, unknowns, evaluation, constants, start)

    tree_joints = list(evaluation.wrenches[: topology.n_links])
    predicted_by, end_by = jax.linearize(predicted, inputs)[1], jax.linearize(end_at, tree_joints, solution)[1]

    def tangent(along):
        # All increments in a loop, the last one, too: machine code of them is written once.
        def improved(found):
            residual, end_tangent = linearised(found, along)
            increment, wrenches = increment_and_wrenches(topology, matrix, residual)
            return jax.tree.map(jnp.add, found, increment), (end_tangent, wrenches, increment)

        first = predicted_by(along)
        unknown = jax.tree.map(lambda x: jnp.zeros(x.shape, x.dtype), jax.eval_shape(improved, first)[1])

        def turn(carry, _):
            return improved(carry[0]), None

        (_, last), _ = jax.lax.scan(turn, (first, unknown), None, length=method.tangent_increments)
        end_tangent, wrenches, increment = last
        return jax.tree.map(jnp.add, end_tangent, end_by(wrenches, increment))

    # A kernel of its own, which is entered once for every direction within that of the step.
    return end, kernel(tangent, name="tangent of a step")(along)
