"""Simulation of one mechanism with its errors: assembly, integration, loads, balances.

Place in the pipeline: model, errors, drive, method -> **simulate** -> Run.

    prepare   errors -> constants, start state, preload
    advance   the intervals of the time grid, one compiled body for all
    conclude  metrics, balances, status

A fixed-step method is a scan over the steps of a diffrax solver, checkpointed by interval: it takes
every transform (jit, vmap, forward, reverse, Hessian).  An adaptive method solves each interval by
`diffrax.diffeqsolve`, so that saved times and the drive's jumps are ends of steps.
"""

from typing import NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jax import Array

from rfem_jax.description.drives import MomentDrive, PrescribedDrive
from rfem_jax.description.errors import InputError
from rfem_jax.description.methods import Method
from rfem_jax.mechanics import loads
from rfem_jax.mechanics.centre_lines import link_lines
from rfem_jax.mechanics.discretisation import require_double_precision
from rfem_jax.mechanics.dynamics import Stabilisation
from rfem_jax.mechanics.model import Model, State
from rfem_jax.mechanics.realisation import AssemblyErrors, Realisation, assembly_errors, realise
from rfem_jax.mechanics.statics import (
    Load,
    equilibrium,
    held_angles,
    length_scale,
    named,
    quasi_static_rates,
    static_loads,
)
from rfem_jax.mechanics.status import (
    DIVERGED,
    DRIFTED,
    NOT_CONVERGED,
    OK,
    OUT_OF_RANGE,
    STEPS_EXHAUSTED,
)
from rfem_jax.simulation import equations
from rfem_jax.simulation.equations import Conditions, Trajectory
from rfem_jax.simulation.generalised_alpha import SOLUTION, GeneralisedAlpha, Memory
from rfem_jax.simulation.observation import Record, observe, solved_instant
from rfem_jax.simulation.run import DrivenJoint, LoadIntegrals, Metrics, Run
from rfem_jax.simulation.solvers import PeakTracking, make_solver
from rfem_jax.simulation.time_grid import TimeGrid, divide_time

STABILISATION = 0.02
ADAPTIVE_STABILISATION_RATE = 1e3
DRIFT_LIMIT = 1e-6
RESIDUAL_LIMIT = 0.05
MAX_ADAPTIVE_STEPS = 100_000


class Prepared(NamedTuple):
    """A mechanism put together: constants, start state, joint loads at rest, assembly status."""

    realised: Realisation
    state: State
    preload: loads.JointLoads
    status: Array


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


def simulate(
    model: Model,
    errors: AssemblyErrors | None = None,
    *,
    drive: MomentDrive | PrescribedDrive | None,
    duration: float,
    method: Method,
    save_every: float | None = None,
    start: State | None = None,
    adjoint: diffrax.AbstractAdjoint | None = None,
) -> Run:
    """Assemble a mechanism with its errors and simulate its motion.

    **Arguments:** `errors` from `assembly_errors` (None: perfect); `drive`: moment or prescribed
    angle, or None; `duration` [s]; `method`; `save_every` [s]: interval of saved times (None: 500
    intervals); `start`: replaces the static assembly (the preload is then unknown, NaN);
    `adjoint`: diffrax's adjoint for adaptive methods only (None: forward mode; give
    `diffrax.RecursiveCheckpointAdjoint()` for reverse mode).

    **Returns:** `Run`.  Works under jit, vmap, jacfwd; with fixed-step methods also grad, jacrev and
    Hessians (memory in reverse mode: one trajectory state an interval, and the steps of one interval).

    **Raises:** `InputError`; what happens to a run is in its status, never raised.
    """
    require_double_precision()
    grid, steps = grid_for(drive, duration, method, save_every)
    errors = assembly_errors(model) if errors is None else errors
    return _simulate(model, errors, drive, grid, start, method, steps, adjoint)


def grid_for(drive, duration, method: Method, save_every) -> tuple[TimeGrid, int]:
    """Time grid and steps an interval of a method."""
    if method.step is None and not method.adaptive:
        raise InputError(
            f"Argument `method` must have a step or tolerances here, but {method.name!r} has none; "
            "replace it by `choose_method(model, method, drive, duration)`, which chooses the step."
        )
    jumps = () if drive is None else drive.breakpoints()
    return divide_time(duration, method.step, save_every, jumps, method.implicit)


@eqx.filter_jit
def _simulate(model, errors, drive, grid, start, method, steps, adjoint):
    prepared = prepare(model, errors, drive, start)
    carry = start_carry(model, prepared, drive, method)
    carry, record = advance(model, prepared.realised, drive, carry, grid, method, steps, adjoint)
    return conclude(model, prepared, carry, record, grid)


def prepare(model: Model, errors: AssemblyErrors, drive, start: State | None) -> Prepared:
    """Put the mechanism together, or take the given start."""
    with jax.named_scope("assembly"):
        realised = realise(model, errors)
        joints = len(model.topology.joints)
        if start is not None:
            unknown = jnp.full((3, joints), jnp.nan)
            preload = loads.JointLoads(unknown, unknown)
            return Prepared(realised, start, preload, jnp.asarray(OK, jnp.int32))
        drive = equations.with_start_angle(model, drive)
        held = held_angles(model, None)
        first = equations.drive_input(drive, jnp.zeros(()), jnp.asarray(0, jnp.int32))
        if first.turn is not None:
            held = {model.topology.driven: first.turn[0]}
        position, multipliers, status = equilibrium(model, realised, held)
        state = loads.static_state(position)
        preload = static_loads(model, realised, state, multipliers)
        if first.turn is not None:
            rates = quasi_static_rates(model, realised, held, first.turn[1])
            state = State(position, rates)
        return Prepared(realised, state, preload, status)


def start_carry(model: Model, prepared: Prepared, drive, method: Method) -> Carry:
    """The carry before the first interval."""
    joints = prepared.preload.force.shape[1]
    trajectory = equations.start_trajectory(prepared.state, joints)
    memory = None
    if method.implicit:
        drive = equations.with_start_angle(model, drive)
        phase, stabilisation = jnp.asarray(0, jnp.int32), stabilisation_of(model, method)
        conditions = Conditions(prepared.realised, drive, phase, stabilisation)
        memory = GeneralisedAlpha(method).start(conditions, trajectory)
    return Carry(
        trajectory=trajectory,
        peaks=jnp.zeros((2, joints)),
        exhausted=jnp.zeros((), bool),
        last_step=jnp.asarray(1e-7),
        memory=memory,
        residual=jnp.zeros(()),
    )


def advance(model, realised, drive, carry, grid: TimeGrid, method: Method, steps, adjoint):
    """Integrate over the intervals of a grid; returns the carry and a `Record` of each end."""
    step_over = _stepping(model, realised, drive, grid, method, steps, adjoint)

    def interval(carry, entry):
        carry, conditions, end = step_over(carry, entry)
        return _record(carry, end, conditions)

    kept = jax.checkpoint_policies.save_only_these_names(SOLUTION)
    return jax.lax.scan(jax.checkpoint(interval, policy=kept), carry, _entries(grid))


def advance_unobserved(model, realised, drive, carry, grid: TimeGrid, method: Method, steps):
    """Integrate without records; with an implicit method `steps` may be traced (forward mode only)."""
    step_over = _stepping(model, realised, drive, grid, method, steps, None)
    return jax.lax.scan(lambda carry, entry: (step_over(carry, entry)[0], None), carry, _entries(grid))[0]


def _entries(grid: TimeGrid):
    return tuple(jnp.asarray(x) for x in (grid.starts, grid.lengths, grid.phases, grid.kinds))


def _stepping(model, realised, drive, grid: TimeGrid, method: Method, steps, adjoint):
    """The function that integrates over one interval."""
    drive = equations.with_start_angle(model, drive)
    stabilisation = stabilisation_of(model, method)
    if method.implicit:
        implicit = GeneralisedAlpha(method)
        operators = implicit.operators(model, jnp.asarray(grid.distinct) / steps)
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


def _record(carry: Carry, t, conditions: Conditions):
    """Carry with the peaks of this instant, and its record."""
    trajectory, realised = carry.trajectory, conditions.realised
    if carry.memory is None:
        state, drive, result, _ = equations.at_instant(t, trajectory, conditions)
        instant = solved_instant(realised, result, drive, conditions.stabilisation.scale)
        axial, normal, _ = equations.squares(instant.loads)
        seen = jnp.stack([axial, normal])
        carry = carry._replace(peaks=jnp.maximum(carry.peaks, seen))
    else:
        drive = equations.drive_input(conditions.drive, t, conditions.phase)
        state = State(trajectory.position, trajectory.velocity)
        instant = carry.memory.instant
    scale = conditions.stabilisation.scale
    return carry, observe(realised, state, drive, trajectory.integrals, instant, scale)


def _implicit(
    method: GeneralisedAlpha, operators, carry: Carry, start, length, steps, conditions
) -> Carry:
    """The implicit steps of one interval with equal length."""
    h = length / steps

    def step(index, state):
        trajectory, memory, peaks, residual = state
        t1 = start + h * (index + 1.0)
        trajectory, memory = method.step(conditions, operators, t1, h, trajectory, memory)
        # Steps of length zero are iterations of one start, of which the last counts.
        counts = (h > 0.0) | (index == steps - 1.0)
        rates = memory.rates
        seen = jnp.stack([rates.axial_square, rates.normal_square])
        peaks = jnp.maximum(peaks, jnp.where(counts, seen, 0.0))
        left_over = jnp.where(counts, memory.instant.residual, 0.0)
        return trajectory, memory, peaks, jnp.maximum(residual, left_over)

    state = (carry.trajectory, carry.memory, carry.peaks, carry.residual)
    if isinstance(steps, int):
        indices = jnp.arange(steps, dtype=jnp.float64)
        state, _ = jax.lax.scan(lambda state, index: (step(index, state), None), state, indices)
    else:
        count = steps.astype(jnp.int32)
        state = jax.lax.fori_loop(
            0, count, lambda i, state: step(i.astype(jnp.float64), state), state
        )
    trajectory, memory, peaks, residual = state
    return carry._replace(trajectory=trajectory, memory=memory, peaks=peaks, residual=residual)


def _field(t, y, conditions):
    trajectory, peaks = y
    # Reverse mode recomputes a stage from its state: storing hundreds of intermediates costs more.
    rate = jax.checkpoint(equations.right_hand_side)(t, trajectory, conditions)
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


def conclude(model: Model, prepared: Prepared, carry: Carry, record: Record, grid) -> Run:
    """Metrics, balances and status from the last carry and all records."""
    record = jax.tree.map(lambda x: x[grid.saved], record)
    times = jnp.asarray(grid.starts + grid.lengths)[grid.saved]
    driven = model.topology.driven
    energy = record.energy
    balance = energy.total - energy.work + energy.dissipation
    error = jnp.max(jnp.abs(balance - balance[0])) / _safe(jnp.max(jnp.abs(energy.total)))
    drift = jnp.max(record.drift)
    residual = carry.residual / _safe(jnp.max(record.largest_load[:, 0]))
    relative = jnp.max(record.momentum_residual, axis=0) / _safe(jnp.max(record.largest_load, axis=0))
    nothing = jnp.zeros_like(times)
    angle = nothing if driven is None else record.angles[:, driven]
    rate = nothing if driven is None else record.rates[:, driven]
    return Run(
        times=times,
        angle=angle,
        rate=rate,
        drive_moment=record.drive_moment,
        angles={name: record.angles[:, l] for l, name in enumerate(_tree_joints(model))},
        loads={
            name: Load(record.loads.force[:, :, j], record.loads.moment[:, :, j])
            for name, j in _joints(model)
        },
        preload=named(model, prepared.preload),
        energy=energy,
        metrics=metrics_of(model, carry, times[-1]),
        driven_joint=DrivenJoint(angle[-1], rate[-1]),
        energy_balance_error=error,
        closure_drift=drift,
        closure_drift_angle=jnp.max(record.drift_angle),
        momentum_balance_error=jnp.max(relative),
        hinge_moment_error=jnp.max(record.hinge_residual) / _safe(jnp.max(record.largest_load[:, 1])),
        stabilisation_share=jnp.max(record.stabilising) / _safe(jnp.max(record.multiplier)),
        solution_residual=residual,
        status=_status(
            model, prepared, carry, error, drift, jnp.max(record.range_used), residual
        ),
        ends={name: record.ends[:, :, l] for l, name in enumerate(model.link_names)},
        branch={
            model.topology.joints[j]: record.branch[:, i] for i, j in enumerate(model.topology.cuts)
        },
        integrals=LoadIntegrals(
            force_square={name: record.square_integrals[:, 0, j] for name, j in _joints(model)},
            moment_square={name: record.square_integrals[:, 1, j] for name, j in _joints(model)},
        ),
        centre_lines=link_lines(model, prepared.realised, prepared.state.position),
        nominal_lines=link_lines(
            model, realise(model, assembly_errors(model)), model.start_coordinates()
        ),
    )


def metrics_of(model: Model, carry: Carry, duration) -> Metrics:
    """Mean squares, RMS values and maxima by joint."""
    integrals = carry.trajectory.integrals
    force = (integrals.axial_square + integrals.normal_square) / duration
    moment = integrals.moment_square / duration
    highest = equations.guarded_root(carry.peaks)

    def by_name(values):
        return {name: values[j] for name, j in _joints(model)}

    return Metrics(
        mean_square_force=by_name(force),
        mean_square_moment=by_name(moment),
        rms_force=by_name(equations.guarded_root(force)),
        rms_moment=by_name(equations.guarded_root(moment)),
        max_axial_force=by_name(highest[0]),
        max_normal_force=by_name(highest[1]),
    )


def _status(model, prepared: Prepared, carry: Carry, error, drift, used, residual):
    finite = jnp.isfinite(error) & jnp.all(jnp.isfinite(carry.peaks))
    for leaf in jax.tree.leaves(carry.trajectory):
        finite = finite & jnp.all(jnp.isfinite(leaf))
    code = jnp.where(drift < DRIFT_LIMIT * length_scale(model), OK, DRIFTED)
    code = jnp.where(residual < RESIDUAL_LIMIT, code, NOT_CONVERGED)
    code = jnp.where(used < 1.0, code, OUT_OF_RANGE)
    code = jnp.where(carry.exhausted, STEPS_EXHAUSTED, code)
    code = jnp.where(finite, code, DIVERGED)
    return jnp.where(prepared.status == OK, code, prepared.status).astype(jnp.int32)


def _safe(value):
    return jnp.where(value > 0.0, value, 1.0)


def _tree_joints(model):
    return model.topology.joints[: model.topology.n_links]


def _joints(model):
    return [(name, model.topology.joints.index(name)) for name in model.joint_names]
