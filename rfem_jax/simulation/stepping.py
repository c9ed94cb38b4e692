"""From the start of an interval of the time grid to its end, by any method.

Place in the pipeline: methods, generalised_alpha, solvers -> **stepping** -> integration.

A fixed-step method is a scan over the steps of a diffrax solver, an implicit one over those of
`GeneralisedAlpha`: both take every transform.  An adaptive method solves the interval by
`diffrax.diffeqsolve`, so that saved times and the drive's jumps are ends of steps.
"""

import functools
from typing import NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array

from rfem_jax.compilation.scalars import in_scalars, nothing_known
from rfem_jax.compilation.whole_loops import explicit_in_scalars
from rfem_jax.description.methods import Method
from rfem_jax.mechanics.inputs import Stabilisation
from rfem_jax.mechanics.model import Model
from rfem_jax.mechanics.statics import length_scale
from rfem_jax.simulation import equations
from rfem_jax.simulation.equations import Conditions, Trajectory
from rfem_jax.simulation.generalised_alpha import GeneralisedAlpha, Memory
from rfem_jax.simulation.solvers import PeakTracking, make_solver
from rfem_jax.simulation.time_grid import TimeGrid

STABILISATION = 0.02
ADAPTIVE_STABILISATION_RATE = 1e3
MAX_ADAPTIVE_STEPS = 100_000
MOST_OPERATIONS = 20_000  # of a right-hand side in scalars: compiled within seconds


class Carry(NamedTuple):
    """What goes from interval to interval: trajectory; peaks: squared maxima (2, joints); exhausted: an
    adaptive method ran out of steps; last_step of an adaptive method [s]; memory of an implicit method;
    residual: largest force [N] left over in its equations."""

    trajectory: Trajectory
    peaks: Array
    exhausted: Array
    last_step: Array
    memory: Memory | None
    residual: Array


def step_intervals(model, realised, drive, grid: TimeGrid, method: Method, steps, adjoint):
    """The function that integrates over one interval."""
    drive = equations.with_start_angle(model, drive)
    stabilisation = stabilisation_of(model, method)
    if method.implicit:
        implicit = GeneralisedAlpha(method)
        operators = implicit.operators(realised, jnp.asarray(grid.distinct) / steps)
    else:
        solver = PeakTracking(make_solver(method), equations.peaks)

    def step_over(carry, entry):
        start, length, phase, kind = entry
        conditions = Conditions(realised, drive, phase, stabilisation)
        if method.implicit:
            chosen = jax.tree.map(lambda x: x[kind], operators)
            carry = _implicit(implicit, chosen, carry, start, length, steps, conditions)
        elif method.adaptive:
            carry = _adaptive(solver, carry, start, length, conditions, method, adjoint)
        else:
            carry = _fixed(solver, carry, start, length, steps, conditions)
        return carry, conditions, start + length

    return step_over


def _implicit(
    method: GeneralisedAlpha, operators, carry: Carry, start, length, steps, conditions
) -> Carry:
    """The implicit steps of one interval with equal length."""
    h = length / steps

    def step(index, state):
        trajectory, memory, peaks, residual = state
        t1 = start + h * (index + 1.0)
        largest = jnp.sqrt(jnp.max(jax.lax.stop_gradient(peaks)))
        trajectory, memory = method.step(
            conditions, operators, t1, h, trajectory, memory, largest
        )
        # Steps of length zero are iterations of one start, of which the last counts.
        counts = (h > 0.0) | (index == steps - 1.0)
        rates = memory.rates
        seen = jnp.stack([rates.axial_square, rates.normal_square])
        peaks = jnp.maximum(peaks, jnp.where(counts, seen, 0.0))
        left_over = jnp.where(counts, memory.instant.residual, 0.0)
        return trajectory, memory, peaks, jnp.maximum(residual, left_over)

    def step_or_stand(state, index):
        # Of the steps of length zero only the last is needed.
        needed = (h > 0.0) | (index == steps - 1.0)
        return jax.lax.cond(needed, lambda: step(index, state), lambda: state)

    state = (carry.trajectory, carry.memory, carry.peaks, carry.residual)
    if isinstance(steps, int):
        indices = jnp.arange(steps, dtype=jnp.float64)
        state, _ = jax.lax.scan(lambda *given: (step_or_stand(*given), None), state, indices)
    else:
        count = steps.astype(jnp.int32)
        state = jax.lax.fori_loop(
            0, count, lambda i, state: step_or_stand(state, i.astype(jnp.float64)), state
        )
    trajectory, memory, peaks, residual = state
    return carry._replace(trajectory=trajectory, memory=memory, peaks=peaks, residual=residual)


@jax.custom_jvp
def _rate_in_scalars(t, trajectory, conditions):
    zeros = False, nothing_known(trajectory), equations.structural_zeros(conditions)
    return in_scalars(_batched_rate, zeros, MOST_OPERATIONS)(t, trajectory, conditions)


@functools.partial(_rate_in_scalars.defjvp, symbolic_zeros=True)
def _differentiate_rate(primals, tangents):
    inputs, fixed, along = equations.moving_parts(primals, tangents)
    return jax.jvp(
        lambda inputs: _batched_rate(*eqx.combine(inputs, fixed)), (inputs,), (along,)
    )


def _batched_rate(t, trajectory, conditions):
    """The right-hand side with the trajectory's batch axis also where nothing depends on it: JAX takes the
    axes of a batch in a function and in its rule for the same."""
    angle = trajectory.position.angles[0]

    def independent(rate):
        sums = rate.integrals
        return rate.position.angles, rate.velocity.angles, sums.work, sums.dissipation

    rate = equations.right_hand_side(t, trajectory, conditions)
    return eqx.tree_at(independent, rate, replace_fn=lambda x: x + (angle - angle))


def _field(t, y, conditions):
    trajectory, peaks = y
    # Reverse mode recomputes a stage from its state: storing hundreds of intermediates costs more.
    rate_of = _rate_in_scalars if explicit_in_scalars() else equations.right_hand_side
    rate = jax.checkpoint(rate_of)(t, trajectory, conditions)
    return rate, jax.tree.map(jnp.zeros_like, peaks)


def _fixed(solver, carry: Carry, start, length, steps, conditions) -> Carry:
    """The steps of one interval with equal length."""
    terms = diffrax.ODETerm(_field)
    h = length / steps

    def step(state, index):
        y, solver_state = state
        t0 = start + h * index
        y, _, _, solver_state, _ = solver.step(
            terms, t0, t0 + h, y, conditions, solver_state, jnp.asarray(False)
        )
        return (y, solver_state), None

    y = (carry.trajectory, carry.peaks)
    memory = solver.init(terms, start, start + h, y, conditions)
    (y, _), _ = jax.lax.scan(step, (y, memory), jnp.arange(steps, dtype=jnp.float64))
    return carry._replace(trajectory=y[0], peaks=y[1])


def _adaptive(solver, carry: Carry, start, length, conditions, method, adjoint) -> Carry:
    """One interval with steps from the error control."""
    moving = length > 0.0
    # An interval of length zero takes one step, which does not count.
    end = start + jnp.where(moving, length, carry.last_step)
    y = (carry.trajectory, carry.peaks)
    solution = diffrax.diffeqsolve(
        diffrax.ODETerm(_field),
        solver,
        t0=start,
        t1=end,
        dt0=jnp.minimum(carry.last_step, end - start),
        y0=y,
        args=conditions,
        stepsize_controller=diffrax.PIDController(rtol=method.rtol, atol=method.atol),
        saveat=diffrax.SaveAt(t1=True),
        adjoint=diffrax.ForwardMode() if adjoint is None else adjoint,
        max_steps=MAX_ADAPTIVE_STEPS,
        throw=False,
    )
    end_state = jax.tree.map(lambda a, b: jnp.where(moving, a[-1], b), solution.ys, y)
    failed = moving & (solution.result != diffrax.RESULTS.successful)
    accepted = jnp.maximum(solution.stats["num_accepted_steps"], 1).astype(jnp.float64)
    step = jnp.where(moving, jax.lax.stop_gradient(length / accepted), carry.last_step)
    return carry._replace(
        trajectory=end_state[0], peaks=end_state[1], exhausted=carry.exhausted | failed, last_step=step
    )


def stabilisation_of(model: Model, method: Method) -> Stabilisation:
    """Baumgarte's gains of a method, tied to its step: rate = stabilisation / step, critically
    damped; adaptive methods use a fixed rate."""
    share = STABILISATION if method.stabilisation is None else method.stabilisation
    rate = share / STABILISATION * ADAPTIVE_STABILISATION_RATE
    if method.step is not None:
        rate = share / method.step
    return Stabilisation(2.0 * rate, rate**2, length_scale(model))
