"""From the start of an interval of the time grid to its end, by any method.

Place in the pipeline: methods, solvers -> **stepping** -> integration.

Every method is a diffrax solver of the state (trajectory, squared maxima of forces); see `solvers`.  With
adaptive steps `diffrax.diffeqsolve` integrates an interval, so that saved times and the drive's jumps are ends
of steps; with fixed steps one loop over `solver.step`, which takes every transform: `diffeqsolve` takes longer to
compile there, and runs the implicit method slower (measured in benchmarks/README.md).
"""

import functools
from typing import NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array

from rfem_jax.compilation.options import explicit_methods_scalarised
from rfem_jax.compilation.scalarisation import nothing_known, scalarised
from rfem_jax.description.methods import Method
from rfem_jax.simulation import equations
from rfem_jax.simulation.batches import like_batched
from rfem_jax.simulation.equations import Conditions, Trajectory
from rfem_jax.simulation.generalised_alpha import Memory
from rfem_jax.simulation.recorded_steps import RecordedSteps
from rfem_jax.simulation.solvers import observed_solver
from rfem_jax.simulation.stabilisation import stabilisation_of
from rfem_jax.simulation.time_grid import TimeGrid

MAX_ADAPTIVE_STEPS = 100_000
MOST_OPERATIONS = 20_000  # of a right-hand side in scalars: compiled within seconds


class Carry(NamedTuple):
    """What goes from interval to interval: trajectory; peaks: squared maxima (2, joints); exhausted: an
    adaptive method ran out of steps; last_step of an adaptive method [s]; memory of a method that remembers
    past steps (None)."""

    trajectory: Trajectory
    peaks: Array
    exhausted: Array
    last_step: Array
    memory: Memory | None

    @property
    def residual(self) -> Array:
        """Largest force [N] left over in the equations of any implicit step."""
        return jnp.zeros(()) if self.memory is None else self.memory.largest_residual


def step_intervals(model, actual, drive, grid: TimeGrid, method: Method, steps, adjoint):
    """The function that integrates over one interval (start, length, phase, kind): a carry to that at the end."""
    drive = equations.with_start_angle(model, drive)
    stabilisation = stabilisation_of(model, method)
    solver = observed_solver(method)
    operators = solver.operators(actual, jnp.asarray(grid.distinct) / steps)

    def step_over(carry, entry):
        start, length, phase, kind = entry
        chosen = jax.tree.map(lambda x: x[kind], operators)
        conditions = Conditions(actual, drive, phase, stabilisation, chosen)
        if method.adaptive:
            return _adaptive(solver, carry, start, length, conditions, method, adjoint)
        return _fixed(solver, carry, start, length, steps, conditions)

    return step_over


@jax.custom_jvp
def _scalarised_rate(t, trajectory, conditions):
    zeros = False, nothing_known(trajectory), equations.structural_zeros(conditions)
    return scalarised(_batched_rate, zeros, MOST_OPERATIONS)(t, trajectory, conditions)


@functools.partial(_scalarised_rate.defjvp, symbolic_zeros=True)
def _differentiate_rate(primals, tangents):
    inputs, fixed, along = equations.active_inputs(primals, tangents)
    return jax.jvp(lambda inputs: _batched_rate(*eqx.combine(inputs, fixed)), (inputs,), (along,))


def _batched_rate(t, trajectory, conditions):
    """The right-hand side, batched alike in all its parts."""
    rate = equations.right_hand_side(t, trajectory, conditions)
    return like_batched(rate, *(x for x in jax.tree.leaves(rate) if x.size))


def vector_field(t, y, conditions: Conditions):
    """Rate of the state (trajectory, squared maxima of forces): that of the maxima is zero."""
    trajectory, peaks = y
    # Reverse mode recomputes a stage from its state: storing hundreds of intermediates costs more.
    rate_of = _scalarised_rate if explicit_methods_scalarised() else equations.right_hand_side
    rate = jax.checkpoint(rate_of)(t, trajectory, conditions)
    return rate, jax.tree.map(jnp.zeros_like, peaks)


def _fixed(solver, carry: Carry, start, length, steps, conditions) -> Carry:
    """The steps of one interval with equal length; `steps` may be traced (forward mode only)."""
    terms = diffrax.ODETerm(vector_field)
    h = length / steps

    def step(index, state):
        y, memory = state
        t0 = start + h * index
        y, _, _, memory, _ = solver.step(terms, t0, t0 + h, y, conditions, memory, jnp.asarray(False))
        return y, memory

    def step_or_stand(state, index):
        if carry.memory is None:
            return step(index, state)
        # Steps of length zero find the memory of a start: one is enough.
        needed = (h > 0.0) | (index == steps - 1.0)
        return jax.lax.cond(needed, lambda: step(index, state), lambda: state)

    y = carry.trajectory, carry.peaks
    state = y, solver.resume(terms, start, start + h, y, conditions, carry.memory)
    if isinstance(steps, int):
        indices = jnp.arange(steps, dtype=jnp.float64)
        state, _ = jax.lax.scan(lambda *given: (step_or_stand(*given), None), state, indices)
    else:
        count = steps.astype(jnp.int32)
        state = jax.lax.fori_loop(0, count, lambda i, state: step_or_stand(state, i.astype(jnp.float64)), state)
    (trajectory, peaks), memory = state
    memory = None if carry.memory is None else memory
    return carry._replace(trajectory=trajectory, peaks=peaks, memory=memory)


def _adaptive(solver, carry: Carry, start, length, conditions, method, adjoint) -> Carry:
    """One interval with steps from the error control."""
    moving = length > 0.0
    # An interval of length zero takes one step, which does not count.
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
        solution = solve(y, conditions, RecordedSteps(found.ts), at_end, adjoint)
    end_state = jax.tree.map(lambda a, b: jnp.where(moving, a[-1], b), solution.ys, y)
    failed = moving & (found.result != diffrax.RESULTS.successful)
    accepted = jnp.maximum(found.stats["num_accepted_steps"], 1).astype(jnp.float64)
    step = jnp.where(moving, jax.lax.stop_gradient(length / accepted), carry.last_step)
    return carry._replace(
        trajectory=end_state[0], peaks=end_state[1], exhausted=carry.exhausted | failed, last_step=step
    )
