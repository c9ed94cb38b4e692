"""Stages of a simulation of one mechanism with its errors: assembly, integration, loads and balances.

Place in the pipeline: model, errors, drive, method -> **prepare, advance, conclude** -> simulating, cases, cycle.

    prepare   errors -> constants, start state, preload
    advance   the intervals of the time grid, by one compiled loop body (`stepping`)
    conclude  loads and balances at the ends of the intervals, metrics, status

With fixed steps all transforms of JAX apply (jit, vmap, forward and reverse mode, Hessians); reverse mode keeps the
state at the end of every interval, with an implicit method of every step, and computes again what lies between.
"""

import dataclasses
from collections.abc import Sequence
from functools import partial
from typing import NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Int

from rfem_jax.compilation.program import Program
from rfem_jax.description.basics.errors import InputError
from rfem_jax.description.drives.driven_motions import Drive
from rfem_jax.description.mechanism.mechanism import AS_GIVEN
from rfem_jax.description.methods import GeneralisedAlpha, Method
from rfem_jax.kernels import kernel
from rfem_jax.mechanics.algebra.reordering import rows
from rfem_jax.mechanics.dynamics import loads
from rfem_jax.mechanics.dynamics.centre_lines import link_lines
from rfem_jax.mechanics.forces.nonsmooth_forces import depend_on_coming_motion, with_memory
from rfem_jax.mechanics.model.errors import AssemblyErrors, assembly_errors
from rfem_jax.mechanics.model.model import Model, State
from rfem_jax.mechanics.model.status import (
    DESIGN_OUT_OF_RANGE,
    OK,
)
from rfem_jax.mechanics.model.with_errors import ModelWithErrors, apply_errors
from rfem_jax.mechanics.statics.assembly import held_angles, static_loads
from rfem_jax.mechanics.statics.equilibrium_stability import Stability
from rfem_jax.mechanics.statics.settling import settled_in_motion, stability
from rfem_jax.simulation.outcome.observation import Record, energy_at, observe
from rfem_jax.simulation.outcome.records import PerfectPath, asks_perfect_path, finished_records, instant_records
from rfem_jax.simulation.outcome.run import Energy
from rfem_jax.simulation.solvers.implicit_step import Memory
from rfem_jax.simulation.stages.balances import checks_of
from rfem_jax.simulation.stages.conclusion import Conclusion, ball_angles, load_summary
from rfem_jax.simulation.stages.stepping import Carry, Integration, entries_of, last_step, repeated
from rfem_jax.simulation.system import equations
from rfem_jax.simulation.system.batches import with_batch_axes
from rfem_jax.simulation.system.driving import active_drives, all_jumps, all_step_ends
from rfem_jax.simulation.system.equations import Conditions, Trajectory
from rfem_jax.simulation.system.time_grid import TimeGrid, divide_time, longest_interval


class Prepared(NamedTuple):
    """An assembled mechanism: constants, start state, joint loads at rest, status of the assembly, and how fast the
    equilibrium of its start is left, None of a given start."""

    actual: ModelWithErrors
    state: State
    preload: loads.JointLoads
    status: Int[Array, ""]
    stability: Stability | None = None


class IntervalEnd(NamedTuple):
    """The end of an interval: trajectory, and memory of an implicit method (None for others)."""

    trajectory: Trajectory
    memory: Memory | None


def grid_for(
    drive: Drive, duration: float, method: Method, save_every: float | None, model: Model | None = None
) -> tuple[TimeGrid, int]:
    """Time grid of a duration [s], with an interval of saved times [s], and the number of steps in an interval; `model`
    where its forces may jump.

    **Raises:** `InputError` for a method without a step or tolerances, and for times that cannot be used.
    """
    if method.step is None and not method.adaptive:
        raise InputError(
            f"Argument `method` must have a step or tolerances here, but {method.name!r} has neither; "
            "replace it by `choose_method(model, method, drive, duration)`, which chooses the step."
        )
    rows = all_step_ends(drive, model, longest_interval(duration, method.step, save_every))
    per_row = method.steps_per_row if isinstance(method, GeneralisedAlpha) else None
    from_start = model is not None and depend_on_coming_motion(model)
    return divide_time(
        duration, method.step, save_every, all_jumps(drive, model), method.implicit, from_start, rows, per_row
    )


def perfect_paths(
    integration: Integration,
    record: Sequence[str],
    start: State | None = None,
    adjoint: diffrax.AbstractAdjoint | None = None,
) -> dict[str, PerfectPath]:
    """Motions of the points of the mechanism without errors at the saved times, if any record asks for them.

    Nothing of it depends on errors: in a batch of errors it is one simulation.
    """
    if not asks_perfect_path(record):
        return {}
    prepared = prepare(integration.model, assembly_errors(integration.model), integration.drive, start)
    _, ends = advance(integration, prepared.actual, start_carry(integration, prepared), adjoint)
    observed = observe_ends(integration, prepared.actual, ends)
    saved = jax.tree.map(lambda x: rows(x, integration.grid.saved), observed)
    topology = integration.model.topology
    drive = 2 * (jnp.zeros(saved.joints.shape[0]),)
    if topology.drives:
        drive = saved.joints[:, topology.driven_position], saved.joint_rates[:, topology.driven_coordinate]
    return {name: PerfectPath(path, *drive) for name, path in saved.points.items()}


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
        state, found = settled_in_motion(model, actual, held, rates)
        resting = loads.static_state(model.topology, state.position)
        preload = static_loads(model, actual, resting, found.multipliers)
        leaving = stability(model, actual, held, resting, found.tangent, preload)
        return Prepared(actual, state, preload, found.status, leaving)


def start_carry(integration: Integration, prepared: Prepared) -> Carry:
    """The state of the integration before the first interval."""
    model, joints = integration.model, prepared.preload.force.shape[1]
    trajectory = equations.start_trajectory(model, prepared.state)
    phase = jnp.asarray(0, jnp.int32)
    conditions = Conditions(prepared.actual, integration.drives, phase, integration.stabilisation)
    peaks, memory = jnp.zeros((4, joints)), integration.solver.start(conditions, trajectory)
    # The batch axes of all that goes around, and tangents of all that a step gives tangents to.
    sources = [x for x in jax.tree.leaves(prepared.state) if x.size]
    exhausted, last_step = with_batch_axes((jnp.zeros((), bool), jnp.asarray(1e-7)), *sources)
    trajectory, peaks, memory = with_batch_axes((trajectory, peaks, memory), *sources, differentiated=True)
    return Carry(trajectory, peaks, exhausted, last_step, memory)


@partial(Program, nameless=True)
def prepare_batch(integration: Integration, errors: AssemblyErrors) -> tuple[Prepared, Carry]:
    """Assembled mechanisms with a batch of errors, and the integrator's states at their starts."""

    def one(errors):
        prepared = prepare(integration.model, errors, integration.drive, None)
        return prepared, start_carry(integration, prepared)

    return jax.vmap(jax.jit(one))(errors)


def advance(
    integration: Integration,
    actual: ModelWithErrors,
    carry: Carry,
    adjoint: diffrax.AbstractAdjoint | None = None,
) -> tuple[Carry, IntervalEnd]:
    """Integrate over all intervals; `adjoint`: of adaptive methods.

    **Returns:** the carry at the end, and the ends of all intervals, whose arrays have a first axis of intervals.

    **Raises:** `InputError` for a method that cannot integrate the model.
    """
    integration.require_supported()
    operators = integration.operators(actual)

    def interval_of(integration, actual, operators):
        def interval(carry, entry):
            carry = integration.over(actual, operators, carry, entry, adjoint)
            return carry, IntervalEnd(carry.trajectory, carry.memory)

        return interval

    def in_one_loop(carry, entries, *constants):
        return jax.lax.scan(interval_of(*constants), carry, entries)

    def by_intervals(carry, entries, *constants):
        return jax.lax.scan(kernel(interval_of(*constants), name="interval"), carry, entries)

    def adaptively(carry, entries, *constants):
        return jax.lax.scan(repeated(interval_of(*constants)), carry, entries)

    fixed = kernel(in_one_loop, name="steps", reverse=by_intervals)
    advanced = adaptively if integration.method.adaptive else fixed
    return advanced(carry, entries_of(integration.grid), integration, actual, operators)


def advance_unobserved(integration: Integration, actual: ModelWithErrors, carry: Carry) -> tuple[Carry, Energy]:
    """Integrate without records but the energies at the ends of the intervals.

    **Raises:** `InputError` as `advance`.
    """
    integration.require_supported()
    operators = integration.operators(actual)

    def in_one_loop(carry, entries, integration, actual, operators):
        def interval(carry, entry):
            carry = integration.over(actual, operators, carry, entry)
            state, integrals = State(carry.trajectory.position, carry.trajectory.velocity), carry.trajectory.integrals
            return carry, energy_at(actual, state, integrals.work, integrals.dissipation)

        return jax.lax.scan(interval, carry, entries)

    advanced = in_one_loop if integration.method.adaptive else kernel(in_one_loop, name="steps")
    return advanced(carry, entries_of(integration.grid), integration, actual, operators)


def observe_ends(
    integration: Integration, actual: ModelWithErrors, ends: IntervalEnd, asked: Sequence[str] = ()
) -> Record:
    """Records of the ends of intervals, with a first axis of intervals; `asked`: names as in `outcome.records`."""

    def record_of(integration, actual):
        solver, drives, stabilisation = integration.solver, integration.drives, integration.stabilisation

        def record(entry, end):
            here = actual
            if end.memory is not None:
                here = with_memory(actual, end.memory.forces)
            conditions = Conditions(here, drives, entry.phase, stabilisation)
            t, h = entry.start + entry.length, last_step(integration.grid, entry, integration.steps)
            squares, state, now, instant = solver.instant(t, h, end.trajectory, end.memory, conditions)
            seen = observe(here, state, now, end.trajectory.integrals, instant, squares)
            if not asked:
                return seen
            return seen._replace(asked=instant_records(integration.model, actual, state, instant, asked))

        return kernel(record, name="record")

    def in_one_loop(entries, ends, *constants):
        return jax.lax.map(lambda both: record_of(*constants)(*both), (entries, ends))

    observed = kernel(in_one_loop, name="records", reverse=in_one_loop)
    return observed(entries_of(integration.grid), ends, integration, actual)


@partial(kernel, name="conclusion", in_parts=True)
def conclude(
    integration: Integration,
    prepared: Prepared,
    carry: Carry,
    ends: IntervalEnd,
    asked: Sequence[str] = (),
    perfect: dict[str, PerfectPath] | None = None,
) -> Conclusion:
    """Loads, metrics, balances and status from the last carry and all ends of intervals; `asked`: as `observe_ends`;
    `perfect`: motions of the points of the perfect mechanism, if asked for."""
    model, grid = integration.model, integration.grid
    record = observe_ends(integration, prepared.actual, ends, asked)
    # The maxima are taken at the starts of steps: the last instant is still missing.
    carry = carry._replace(peaks=jnp.maximum(carry.peaks, jnp.max(record.squares, axis=0)))
    record, positions = jax.tree.map(lambda x: rows(x, grid.saved), (record, ends.trajectory.position))
    times = rows(jnp.asarray(grid.starts + grid.lengths), grid.saved)
    # Since the start: the work of tables over position is known up to a constant.
    energy = dataclasses.replace(record.energy, work=record.energy.work - record.energy.work[0])
    shortest = grid.shortest_step(integration.steps)
    judged = model, prepared.actual, prepared.status, carry, record, energy, times[-1], shortest
    # What judges the numbers has no derivatives, but the residual, which says how accurate derivatives are.
    checks, status = checks_of(*jax.tree.map(lambda x: jax.lax.stop_gradient(x) if eqx.is_array(x) else x, judged))
    checks = dataclasses.replace(checks, equation_residual=record.residual, start_stability=prepared.stability)
    return Conclusion(
        times=times,
        record=record._replace(energy=energy),
        preload=prepared.preload,
        summary=load_summary(model, carry, times[-1]),
        checks=checks,
        status=status,
        contact_changes=carry.contact_changes,
        ball_angles=ball_angles(model, record.joints),
        centre_lines=link_lines(model, prepared.actual, prepared.state.position),
        nominal_lines=link_lines(model, apply_errors(model, assembly_errors(model)), model.start_coordinates()),
        recorded=finished_records(model, prepared.actual, record.asked, record.friction_losses, asked, perfect or {}),
        positions=positions,
    )
