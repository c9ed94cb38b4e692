"""Simulation of one mechanism with its errors: assembly, integration, loads, balances.

Place in the pipeline: model, errors, drive, method -> **prepare, advance, conclude** -> conclusion -> Run.

    prepare   errors -> constants, start state, preload
    advance   the intervals of the time grid, by one compiled loop body (`stepping`)
    conclude  loads and balances at the ends of the intervals, metrics, status

With fixed steps all transforms of JAX apply (jit, vmap, forward and reverse mode, Hessians); reverse mode keeps the
state at the end of every interval, with an implicit method of every step, and computes again what lies between.
"""

import dataclasses
from collections.abc import Iterable, Sequence
from functools import partial
from typing import NamedTuple

import diffrax
import jax
import jax.numpy as jnp
from jax.core import Tracer
from jaxtyping import Array, Float, Int

from rfem_jax.compilation.program import Program
from rfem_jax.description.basics.errors import InputError
from rfem_jax.description.drives.driven_motions import Drive
from rfem_jax.description.mechanism.mechanism import AS_GIVEN
from rfem_jax.description.methods import GeneralisedAlpha, Method
from rfem_jax.kernels import kernel
from rfem_jax.mechanics.algebra.reordering import rows
from rfem_jax.mechanics.dynamics import loads
from rfem_jax.mechanics.dynamics.centre_lines import link_lines
from rfem_jax.mechanics.forces.bush_contacts import with_memory
from rfem_jax.mechanics.model.model import Model, State
from rfem_jax.mechanics.model.status import (
    DESIGN_OUT_OF_RANGE,
    OK,
)
from rfem_jax.mechanics.model.with_errors import AssemblyErrors, ModelWithErrors, apply_errors, assembly_errors
from rfem_jax.mechanics.statics.assembly import held_angles, moving_equilibrium, static_loads
from rfem_jax.mechanics.statics.designs import Design, designed
from rfem_jax.simulation import equations
from rfem_jax.simulation.balances import checks_of
from rfem_jax.simulation.batches import like_batched
from rfem_jax.simulation.conclusion import Conclusion, ball_angles, load_summary, run_of, with_status
from rfem_jax.simulation.driving import active_drives, all_jumps, all_step_ends, drive_of_design
from rfem_jax.simulation.equations import Conditions, Trajectory
from rfem_jax.simulation.observation import Record, energy_at, observe
from rfem_jax.simulation.records import finished_records, instant_records, require_records
from rfem_jax.simulation.run import Energy, Run, of_model
from rfem_jax.simulation.solvers.catalogue import observed_solver
from rfem_jax.simulation.solvers.implicit_step import Memory
from rfem_jax.simulation.stabilisation import stabilisation_of
from rfem_jax.simulation.stepping import Carry, Intervals, entries_of, last_step, repeated
from rfem_jax.simulation.time_grid import TimeGrid, divide_time, longest_interval, of_any_step


class Prepared(NamedTuple):
    """An assembled mechanism: constants, start state, joint loads at rest, status of the assembly."""

    actual: ModelWithErrors
    state: State
    preload: loads.JointLoads
    status: Int[Array, ""]


class IntervalEnd(NamedTuple):
    """The end of an interval: trajectory, and memory of an implicit method (None for others)."""

    trajectory: Trajectory
    memory: Memory | None


def simulate_steps(
    model: Model,
    errors: AssemblyErrors,
    drive: Drive,
    grid: TimeGrid,
    method: Method,
    steps: int | Float[Array, ""],
    start: State | None = None,
    adjoint: diffrax.AbstractAdjoint | None = None,
    record: str | Iterable[str] = (),
    design: Design | None = None,
) -> Run:
    """As `simulate` of these, over a grid of `grid_for` whose number of steps in an interval may be traced (see
    `time_grid.of_any_step`)."""
    drive = drive if design is None else drive_of_design(model, drive, design)
    made = designed(model, design, errors)
    asked = require_records(made.model, record)
    if not any(isinstance(x, Tracer) for x in jax.tree.leaves((made, drive, start))):
        method, grid, steps = of_any_step(method, grid, steps)  # one program for all steps; none of reverse mode
    conclusion = _simulate(made.model, made.errors, drive, grid, start, method, steps, adjoint, asked)
    run = run_of(made.model, conclusion)
    return with_status(of_model(run, made.model, errors if made.errors is None else made.errors), made)


def grid_for(
    drive: Drive, duration: float, method: Method, save_every: float | None, model: Model | None = None
) -> tuple[TimeGrid, int]:
    """Time grid of a duration [s], with an interval of saved times [s], and the number of steps in an interval; `model`
    where its forces may jump.

    **Raises:** `InputError` for a method without a step or tolerances, and for times that cannot be used.
    """
    if method.step is None and not method.adaptive:
        raise InputError(
            f"Argument `method` must have a step or tolerances here, but {method.name!r} has none; "
            "replace it by `choose_method(model, method, drive, duration)`, which chooses the step."
        )
    rows = all_step_ends(drive, model, longest_interval(duration, method.step, save_every))
    per_row = method.steps_per_row if isinstance(method, GeneralisedAlpha) else None
    from_start = model is not None and model.friction is not None
    return divide_time(
        duration, method.step, save_every, all_jumps(drive, model), method.implicit, from_start, rows, per_row
    )


@partial(Program, nameless=True)
def _simulate(model, errors, drive, grid, start, method, steps, adjoint, record):
    prepared, carry, ends = integrated(model, errors, drive, grid, start, method, steps, adjoint)
    return conclude(model, prepared, drive, carry, ends, grid, method, steps, record)


def integrated(
    model: Model,
    errors: AssemblyErrors,
    drive: Drive,
    grid: TimeGrid,
    start: State | None,
    method: Method,
    steps: int | Float[Array, ""],
    adjoint: diffrax.AbstractAdjoint | None,
) -> tuple[Prepared, Carry, IntervalEnd]:
    """A simulation before its conclusion."""
    prepared = prepare(model, errors, drive, start)
    carry = start_carry(model, prepared, drive, method)
    return prepared, *advance(model, prepared.actual, drive, carry, grid, method, steps, adjoint)


@partial(kernel, name="assembly", in_parts=True)
def prepare(model: Model, errors: AssemblyErrors, drive: Drive, start: State | None) -> Prepared:
    """Assemble the mechanism by static equilibrium, or take the given start."""
    with jax.named_scope("assembly"):
        actual = apply_errors(model, errors)
        joints = len(model.topology.joints)
        if start is not None:
            unknown = jnp.full((3, joints), jnp.nan)
            preload = loads.JointLoads(unknown, unknown)
            status = jnp.where(actual.possible > 0.0, OK, DESIGN_OUT_OF_RANGE).astype(jnp.int32)
            return Prepared(actual, start, preload, status)
        held = held_angles(model, None if model.topology.settles else AS_GIVEN)
        first = active_drives(model, drive).at(jnp.zeros(()), jnp.asarray(0, jnp.int32)).motions
        held |= {k: position for k, (position, _, _) in first.items()}
        given = {} if model.start_rates is None else {k: model.start_rates[k] for k in model.topology.rated}
        rates = given | {k: rate for k, (_, rate, _) in first.items()}
        state, multipliers, status = moving_equilibrium(model, actual, held, rates)
        resting = loads.static_state(model.topology, state.position)
        return Prepared(actual, state, static_loads(model, actual, resting, multipliers), status)


def start_carry(model: Model, prepared: Prepared, drive: Drive, method: Method) -> Carry:
    """The state of the integration before the first interval."""
    joints = prepared.preload.force.shape[1]
    frictions, clearances = len(model.friction or {}), len(model.topology.clearances)
    trajectory = equations.start_trajectory(prepared.state, joints, frictions, clearances)
    drives = active_drives(model, drive)
    phase, stabilisation = jnp.asarray(0, jnp.int32), stabilisation_of(model, method)
    conditions = Conditions(prepared.actual, drives, phase, stabilisation)
    peaks, memory = jnp.zeros((4, joints)), observed_solver(method).start(conditions, trajectory)
    # The batch axes of all that goes around, and tangents of all that a step gives tangents to.
    sources = [x for x in jax.tree.leaves(prepared.state) if x.size]
    exhausted, last_step = like_batched((jnp.zeros((), bool), jnp.asarray(1e-7)), *sources)
    trajectory, peaks, memory = like_batched((trajectory, peaks, memory), *sources, differentiated=True)
    return Carry(trajectory, peaks, exhausted, last_step, memory)


def advance(
    model: Model,
    actual: ModelWithErrors,
    drive: Drive,
    carry: Carry,
    grid: TimeGrid,
    method: Method,
    steps: int | Float[Array, ""],
    adjoint: diffrax.AbstractAdjoint | None,
) -> tuple[Carry, IntervalEnd]:
    """Integrate over the intervals of a grid, each in a number of steps (fixed-step methods), which may be traced as in
    `advance_unobserved`.

    **Returns:** the carry at the end, and the ends of all intervals, whose arrays have a first axis of intervals.
    """
    operators = Intervals(model, drive, grid, method, steps, adjoint).operators(actual)

    def interval_of(model, actual, drive, grid, steps, operators):
        intervals = Intervals(model, drive, grid, method, steps, adjoint)

        def interval(carry, entry):
            carry = intervals.over(actual, operators, carry, entry)
            return carry, IntervalEnd(carry.trajectory, carry.memory)

        return interval

    def in_one_loop(carry, entries, *others):
        return jax.lax.scan(interval_of(*others), carry, entries)

    def by_intervals(carry, entries, *others):
        return jax.lax.scan(kernel(interval_of(*others), name="interval"), carry, entries)

    def adaptively(carry, entries, *others):
        return jax.lax.scan(repeated(interval_of(*others)), carry, entries)

    advanced = adaptively if method.adaptive else kernel(in_one_loop, name="steps", reverse=by_intervals)
    return advanced(carry, entries_of(grid), model, actual, drive, grid, steps, operators)


def advance_unobserved(
    model: Model,
    actual: ModelWithErrors,
    drive: Drive,
    carry: Carry,
    grid: TimeGrid,
    method: Method,
    steps: int | Float[Array, ""],
) -> tuple[Carry, Energy]:
    """Integrate without records but the energies at the ends of the intervals; `steps`, in an interval, may be traced
    with an implicit method (then not in reverse mode)."""
    operators = Intervals(model, drive, grid, method, steps, None).operators(actual)

    def in_one_loop(carry, entries, model, actual, drive, grid, steps, operators):
        intervals = Intervals(model, drive, grid, method, steps, None)

        def interval(carry, entry):
            carry = intervals.over(actual, operators, carry, entry)
            state, integrals = State(carry.trajectory.position, carry.trajectory.velocity), carry.trajectory.integrals
            return carry, energy_at(actual, state, integrals.work, integrals.dissipation)

        return jax.lax.scan(interval, carry, entries)

    advanced = in_one_loop if method.adaptive else kernel(in_one_loop, name="steps")
    return advanced(carry, entries_of(grid), model, actual, drive, grid, steps, operators)


def observe_ends(
    model: Model,
    actual: ModelWithErrors,
    drive: Drive,
    ends: IntervalEnd,
    grid: TimeGrid,
    method: Method,
    steps: int | Float[Array, ""],
    asked: Sequence[str] = (),
) -> Record:
    """Records of the ends of intervals, with a first axis of intervals; `asked`: names as in `simulation.records`."""
    solver = observed_solver(method)

    def record_of(model, actual, drive, grid, steps):
        drives, stabilisation = active_drives(model, drive), stabilisation_of(model, method)

        def record(entry, end):
            here = actual
            if end.memory is not None and end.memory.contacts is not None:
                here = with_memory(actual, end.memory.contacts)
            conditions = Conditions(here, drives, entry.phase, stabilisation)
            t, h = entry.start + entry.length, last_step(grid, entry, steps)
            squares, state, now, instant = solver.instant(t, h, end.trajectory, end.memory, conditions)
            seen = observe(here, state, now, end.trajectory.integrals, instant, squares)
            return seen._replace(asked=instant_records(model, actual, state, instant, asked)) if asked else seen

        return kernel(record, name="record")

    def in_one_loop(entries, ends, *others):
        return jax.lax.map(lambda both: record_of(*others)(*both), (entries, ends))

    return kernel(in_one_loop, name="records", reverse=in_one_loop)(
        entries_of(grid), ends, model, actual, drive, grid, steps
    )


@partial(kernel, name="conclusion", in_parts=True)
def conclude(
    model: Model,
    prepared: Prepared,
    drive: Drive,
    carry: Carry,
    ends: IntervalEnd,
    grid: TimeGrid,
    method: Method,
    steps: int | Float[Array, ""],
    asked: Sequence[str] = (),
) -> Conclusion:
    """Loads, metrics, balances and status from the last carry and all ends of intervals; `asked`: as `observe_ends`."""
    record = observe_ends(model, prepared.actual, drive, ends, grid, method, steps, asked)
    # The maxima are taken at the starts of steps: the last instant is still missing.
    carry = carry._replace(peaks=jnp.maximum(carry.peaks, jnp.max(record.squares, axis=0)))
    record, positions = jax.tree.map(lambda x: rows(x, grid.saved), (record, ends.trajectory.position))
    times = rows(jnp.asarray(grid.starts + grid.lengths), grid.saved)
    # Since the start: the work of tables over position is known up to a constant.
    energy = dataclasses.replace(record.energy, work=record.energy.work - record.energy.work[0])
    shortest = grid.shortest_step(steps)
    checks, status = checks_of(model, prepared.actual, prepared.status, carry, record, energy, times[-1], shortest)
    return Conclusion(
        times=times,
        record=record._replace(energy=energy),
        preload=prepared.preload,
        summary=load_summary(model, carry, times[-1]),
        checks=checks,
        status=status,
        contact_changes=carry.contact_changes,
        ball_angles=ball_angles(model, record),
        centre_lines=link_lines(model, prepared.actual, prepared.state.position),
        nominal_lines=link_lines(model, apply_errors(model, assembly_errors(model)), model.start_coordinates()),
        recorded=finished_records(model, prepared.actual, record.asked, record.friction_losses, asked),
        positions=positions,
    )
