"""From the start of an interval of the time grid to its end, by any method.

Place in the pipeline: methods, solvers -> **stepping** -> integration.

Every method is a diffrax solver of the state (trajectory, squared maxima of loads); see `solvers`.  With adaptive
steps `diffrax.diffeqsolve` integrates each interval, so that saved times and the drive's jumps are ends of steps.
With fixed steps a loop over `solver.step` does, to which all transforms of JAX apply: `diffeqsolve` takes longer to
compile there, and runs the implicit method slower (measured in benchmarks/README.md).
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int, PyTree, Shaped

from rfem_jax.compilation.options import explicit_methods_scalarised
from rfem_jax.compilation.scalarisation import nothing_known, scalarised
from rfem_jax.description.methods import GeneralisedAlphaMethod, Method
from rfem_jax.mechanics.bush_contacts import require_memory
from rfem_jax.mechanics.derivative_rules import active_inputs
from rfem_jax.mechanics.friction import require_implicit
from rfem_jax.mechanics.model import Model
from rfem_jax.mechanics.model_with_errors import ModelWithErrors
from rfem_jax.simulation import equations
from rfem_jax.simulation.batches import like_batched
from rfem_jax.simulation.driving import Drive, active_drives
from rfem_jax.simulation.equations import Conditions, Scalar, Trajectory
from rfem_jax.simulation.solvers.catalogue import observed_solver
from rfem_jax.simulation.solvers.contact_steps import follow_contacts, part_lengths
from rfem_jax.simulation.solvers.implicit_step import SOLUTION, Memory
from rfem_jax.simulation.solvers.recorded_steps import RecordedSteps
from rfem_jax.simulation.stabilisation import stabilisation_of
from rfem_jax.simulation.time_grid import TimeGrid

MAX_ADAPTIVE_STEPS = 100_000
MOST_OPERATIONS = 20_000  # scalar operations of a right-hand side that compile within seconds


class Carry(NamedTuple):
    """State of the integration between two intervals.

    trajectory; peaks: maxima of the squares of `equations.squared_loads`; exhausted: whether an adaptive method, or
    one that follows contacts, ran out of steps; last_step [s] of an adaptive method; memory of an implicit method
    (None for others).
    """

    trajectory: Trajectory
    peaks: Float[Array, "4 joints"]
    exhausted: Bool[Array, ""]
    last_step: Float[Array, ""]
    memory: Memory | None

    @property
    def residual(self) -> Float[Array, ""]:
        """Largest force [N] that the residual of any implicit step had."""
        return jnp.zeros(()) if self.memory is None else self.memory.largest_residual

    @property
    def contact_changes(self) -> Float[Array, ""] | None:
        """How often contacts have closed or opened, None where steps do not follow them."""
        following = None if self.memory is None else self.memory.following
        return None if following is None else following.changes


# start [s], length [s], phase of the drive, and index of the length among the distinct ones, of an interval
Entry = tuple[Float[Array, ""], Float[Array, ""], Int[Array, ""], Int[Array, ""]]


def step_intervals(
    model: Model,
    actual: ModelWithErrors,
    drive: Drive,
    grid: TimeGrid,
    method: Method,
    steps: int | Float[Array, ""],
    adjoint: diffrax.AbstractAdjoint | None,
) -> Callable[[Carry, Entry], Carry]:
    """The function that integrates over one interval of the grid: from the carry at its start to that at its end."""
    require_implicit(model, method.name, method.implicit)
    require_memory(model, method.name, method.implicit)
    drives = active_drives(model, drive)
    stabilisation = stabilisation_of(model, method)
    solver = observed_solver(method)
    lengths = jnp.asarray(grid.distinct) / steps
    ahead = None if model.friction is None else grid.longest_step(steps)
    tolerance = contact_tolerance_of(model, method)
    if tolerance is not None:
        operators = jax.vmap(lambda parts: solver.operators(actual, parts))(part_lengths(lengths))
    else:
        operators = solver.operators(actual, lengths)

    def step_over(carry, entry):
        start, length, phase, kind = entry
        chosen = jax.tree.map(lambda x: _row(x, kind), operators)
        conditions = Conditions(actual, drives, phase, stabilisation, chosen, ahead)
        if method.adaptive:
            return _adaptive(solver, carry, start, length, conditions, method, adjoint)
        return _fixed(solver, carry, start, length, steps, conditions, tolerance)

    return step_over


def _row(values: Shaped[Array, "rows ..."], place: Int[Array, ""]) -> Shaped[Array, "..."]:
    """A row at a place that is not negative."""
    return jax.lax.dynamic_index_in_dim(values, place, keepdims=False, allow_negative_indices=False)


def contact_tolerance_of(model: Model, method: Method) -> float | None:
    """The tolerance with which steps are divided where contacts need it, None where they stay as they are."""
    if not model.topology.clearances or not isinstance(method, GeneralisedAlphaMethod):
        return None
    return method.contact_tolerance or None


@jax.custom_jvp
def _scalarised_rate(t, trajectory, conditions):
    zeros = False, nothing_known(trajectory), equations.structural_zeros(conditions)
    return scalarised(_batched_rate, zeros, MOST_OPERATIONS)(t, trajectory, conditions)


@functools.partial(_scalarised_rate.defjvp, symbolic_zeros=True)
def _differentiate_rate(primals, tangents):
    inputs, fixed, along = active_inputs(primals, tangents)
    return jax.jvp(lambda inputs: _batched_rate(*eqx.combine(inputs, fixed)), (inputs,), (along,))


def _batched_rate(t, trajectory, conditions):
    """The right-hand side, all its arrays with the same batch axes."""
    rate = equations.right_hand_side(t, trajectory, conditions)
    return like_batched(rate, *(x for x in jax.tree.leaves(rate) if x.size))


def vector_field(t: Scalar, y: tuple[Trajectory, PyTree], conditions: Conditions) -> tuple[Trajectory, PyTree]:
    """Time derivative of the state (trajectory, squared maxima of loads), zero for the maxima."""
    trajectory, peaks = y
    # Reverse mode recomputes a stage from its state: to store hundreds of intermediates costs more.
    rate_of = _scalarised_rate if explicit_methods_scalarised() else equations.right_hand_side
    rate = jax.checkpoint(rate_of)(t, trajectory, conditions)
    return rate, jax.tree.map(jnp.zeros_like, peaks)


def repeated(function: Callable) -> Callable:
    """The function, which reverse mode computes again instead of keeping its intermediate results; within a loop."""
    kept = jax.checkpoint_policies.save_only_these_names(SOLUTION)
    return jax.checkpoint(function, policy=kept, prevent_cse=False)


def _fixed(solver, carry: Carry, start, length, steps, conditions, tolerance=None) -> Carry:
    """One interval in steps of equal length; `steps` may be traced (then not in reverse mode).  With a `tolerance` they
    are divided where contacts need it (not in reverse mode, either)."""
    terms = diffrax.ODETerm(vector_field)
    h = length / steps

    def step(index, state):
        y, memory = state
        t0 = start + h * index
        if tolerance is not None:
            return follow_contacts(part, conditions.actual, t0, h, y, memory, conditions.operators, tolerance)
        y, _, _, memory, _ = solver.step(terms, t0, t0 + h, y, conditions, memory, jnp.asarray(False))
        return y, memory

    def part(t0, t1, y, memory, operators):
        own = dataclasses.replace(conditions, operators=operators)
        y, _, _, memory, result = solver.step(terms, t0, t1, y, own, memory, jnp.asarray(False))
        return y, memory, result == diffrax.RESULTS.successful

    def step_if_needed(state, index):
        if carry.memory is None:
            return step(index, state)
        # A step of length zero finds the memory at a start; in an interval of length zero one is enough.
        needed = (h > 0.0) | (index == steps - 1.0)
        return jax.lax.cond(needed, lambda: step(index, state), lambda: state)

    y = carry.trajectory, carry.peaks
    state = y, solver.resume(terms, start, start + h, y, conditions, carry.memory)
    if isinstance(steps, int):
        indices = jnp.arange(steps, dtype=jnp.float64)
        one = step_if_needed if carry.memory is None else repeated(step_if_needed)
        state, _ = jax.lax.scan(lambda *args: (one(*args), None), state, indices)
    else:
        count = steps.astype(jnp.int32)
        state = jax.lax.fori_loop(0, count, lambda i, state: step_if_needed(state, i.astype(jnp.float64)), state)
    (trajectory, peaks), memory = state
    memory = None if carry.memory is None else memory
    if memory is not None and memory.following is not None:
        carry = carry._replace(exhausted=carry.exhausted | memory.following.exhausted)
    return carry._replace(trajectory=trajectory, peaks=peaks, memory=memory)


def _adaptive(solver, carry: Carry, start, length, conditions, method, adjoint) -> Carry:
    """One interval in steps chosen by the error control."""
    moving = length > 0.0
    # In an interval of length zero one step is taken, and discarded below.
    end = start + jnp.where(moving, length, carry.last_step)
    y = (carry.trajectory, carry.peaks)

    def solve(y, conditions, controller, saveat, adjoint):
        return diffrax.diffeqsolve(
            diffrax.ODETerm(vector_field), solver, start, end, jnp.minimum(carry.last_step, end - start), y,
            conditions, stepsize_controller=controller, saveat=saveat, adjoint=adjoint,
            max_steps=MAX_ADAPTIVE_STEPS, throw=False,
        )  # fmt: skip

    controlled = diffrax.PIDController(rtol=method.rtol, atol=method.atol)
    at_end = diffrax.SaveAt(t1=True)
    if adjoint is None:
        found = solution = solve(y, conditions, controlled, at_end, diffrax.ForwardMode())
    else:
        ends = diffrax.SaveAt(steps=True, fn=lambda t, y, args: None)
        found = solve(*jax.lax.stop_gradient((y, conditions)), controlled, ends, diffrax.ForwardMode())
        solution = solve(y, conditions, RecordedSteps(jnp.asarray(found.ts)), at_end, adjoint)
    end_state = jax.tree.map(lambda a, b: jnp.where(moving, a[-1], b), solution.ys, y)
    failed = moving & (found.result != diffrax.RESULTS.successful)
    accepted = jnp.maximum(found.stats["num_accepted_steps"], 1).astype(jnp.float64)
    step = jnp.where(moving, jax.lax.stop_gradient(length / accepted), carry.last_step)
    return carry._replace(
        trajectory=end_state[0], peaks=end_state[1], exhausted=carry.exhausted | failed, last_step=step
    )
