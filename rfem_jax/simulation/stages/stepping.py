"""From the start of an interval of the time grid to its end, by any method.

Place in the pipeline: methods, solvers -> **stepping** -> integration.

Every method is a diffrax solver of the state (trajectory, squared maxima of loads); see `solvers`.  With adaptive
steps `diffrax.diffeqsolve` integrates each interval, so that saved times and the drive's jumps are ends of steps.
With fixed steps a loop over `solver.step` does, to which all transforms of JAX apply: `diffeqsolve` takes longer to
compile there, and runs the implicit method slower (measured in benchmarks/README.md).
"""

import dataclasses
from collections.abc import Callable
from typing import Any, NamedTuple

import diffrax
import equinox as eqx
import jax
import jax.numpy as jnp
from jax.core import Tracer
from jaxtyping import Array, Bool, Float, Int, PyTree, Shaped

from rfem_jax.description.methods import GeneralisedAlpha, Method
from rfem_jax.mechanics.forces.bush_contacts import require_memory
from rfem_jax.mechanics.forces.friction import require_implicit
from rfem_jax.mechanics.forces.nonsmooth_forces import depend_on_coming_motion
from rfem_jax.mechanics.model.inputs import Stabilisation
from rfem_jax.mechanics.model.model import Model
from rfem_jax.mechanics.model.with_errors import ModelWithErrors, with_structural_zeros
from rfem_jax.simulation.solvers.catalogue import IntervalSolver, observed_solver
from rfem_jax.simulation.solvers.contact_steps import follow_contacts, part_lengths
from rfem_jax.simulation.solvers.explicit import MOTION
from rfem_jax.simulation.solvers.generalised_alpha import GeneralisedAlphaSolver, StepState
from rfem_jax.simulation.solvers.implicit_step import SOLUTION, Memory
from rfem_jax.simulation.solvers.recorded_steps import RecordedSteps
from rfem_jax.simulation.system.driving import ActiveDrives, Drive, active_drives
from rfem_jax.simulation.system.equations import Conditions, Scalar, Trajectory
from rfem_jax.simulation.system.stabilisation import stabilisation_of
from rfem_jax.simulation.system.time_grid import TimeGrid, of_any_step, steps_of_parts

MAX_ADAPTIVE_STEPS = 100_000
MOST_LENGTHS = 64  # of steps, for which operators are formed at the start; of more, in every step


class Carry(NamedTuple):
    """State of the integration between two intervals.

    trajectory; peaks: maxima of the squares of `equations.squared_loads`; exhausted: whether an adaptive method, or
    one that follows contacts, ran out of steps; last_step [s] of an adaptive method, or of intervals in parts; memory
    of an implicit method (None for others).
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
        """How often contacts have closed or opened; None if steps do not follow them."""
        following = None if self.memory is None else self.memory.following
        return None if following is None else following.changes

    def after(self, y: Any, memory: Any, step: Any) -> "Carry":
        """The carry after an interval: trajectory and maxima, memory of the solver (kept of an implicit method), length
        [s] of the last step (None where intervals have no parts)."""
        memory, exhausted = None if self.memory is None else memory, self.exhausted
        if memory is not None and memory.following is not None:
            exhausted = exhausted | memory.following.exhausted
        return Carry(y[0], y[1], exhausted, self.last_step if step is None else step, memory)


class Entry(NamedTuple):
    """An interval of the time grid: start [s], length [s], phase of the drive, index of the length among the distinct
    ones; lengths [s] and these indices of its parts, None where intervals have none."""

    start: Float[Array, ""]
    length: Float[Array, ""]
    phase: Int[Array, ""]
    kind: Int[Array, ""]
    parts: tuple[Float[Array, " parts"], Int[Array, " parts"]] | None


def entries_of(grid: TimeGrid) -> Entry:
    """All intervals of a grid, along a first axis."""
    parts = None if grid.parts is None else (jnp.asarray(grid.parts.lengths), jnp.asarray(grid.parts.kinds))
    starts, lengths, phases, kinds = (jnp.asarray(x) for x in (grid.starts, grid.lengths, grid.phases, grid.kinds))
    return Entry(starts, lengths, phases, kinds, parts)


def last_step(grid: TimeGrid, entry: Entry, steps: int | Float[Array, ""]) -> Float[Array, ""]:
    """Length [s] of the last step of an interval."""
    if grid.parts is None or entry.parts is None:
        return entry.length / steps
    lengths, kinds = entry.parts
    counts = jnp.asarray(steps_of_parts(grid.distinct, steps, grid.parts.least))[kinds]
    last = jnp.maximum(jnp.sum((counts > 0.0).astype(jnp.int32)) - 1, 0)
    return _row(lengths / jnp.maximum(counts, 1.0), last)


class Integration(eqx.Module):
    """What is integrated and how: a mechanism under its drives over the intervals of a grid, by a method.

    steps: their number in an interval, for methods with fixed steps; traced, it is one program for all steps (then not
    in reverse mode).
    """

    model: Model
    drive: Drive
    grid: TimeGrid
    method: Method
    steps: int | Float[Array, ""]

    @classmethod
    def of_any_step(
        cls, model: Model, drive: Drive, grid: TimeGrid, steps: int | Float[Array, ""], method: Method, given: PyTree
    ) -> "Integration":
        """What has one program for all steps where the method allows that and no number, of those that are `given`
        besides, is traced: not in reverse mode."""
        if not any(isinstance(x, Tracer) for x in jax.tree.leaves((model, drive, given))):
            method, grid, steps = of_any_step(method, grid, steps)
        return cls(model, drive, grid, method, steps)

    @property
    def own_names(self) -> tuple[str, ...]:
        """Names of the things that it has, for programs (`compilation.naming`)."""
        return self.model.own_names

    @property
    def solver(self) -> IntervalSolver:
        """The method's solver."""
        return observed_solver(self.method)

    @property
    def drives(self) -> ActiveDrives:
        """The drives, for which the model knows places."""
        return active_drives(self.model, self.drive)

    @property
    def stabilisation(self) -> Stabilisation:
        """What keeps the loops closed."""
        return stabilisation_of(self.model, self.method)

    @property
    def counts(self) -> int | Float[Array, "..."]:
        """Numbers of steps: in an interval, or in parts of each of the grid's lengths."""
        if self.grid.parts is None:
            return self.steps
        return jnp.asarray(steps_of_parts(self.grid.distinct, self.steps, self.grid.parts.least))

    def require_supported(self) -> None:
        """Raise InputError for a method that cannot integrate the model."""
        require_implicit(self.model, self.method.name, self.method.implicit)
        require_memory(self.model, self.method.name, self.method.implicit)

    def operators(self, actual: ModelWithErrors) -> PyTree:
        """Constants of steps of each distinct length; None if the steps compute them themselves."""
        lengths = jnp.asarray(self.grid.distinct)
        lengths = lengths / (self.counts if self.grid.parts is None else jnp.maximum(self.counts, 1.0))
        if lengths.shape[0] > MOST_LENGTHS:
            return None
        if contact_tolerance_of(self.model, self.method) is not None:
            return jax.vmap(lambda parts: self.solver.operators(actual, parts))(part_lengths(lengths))
        return self.solver.operators(actual, lengths)

    def over(
        self,
        actual: ModelWithErrors,
        operators: PyTree,
        carry: Carry,
        entry: Entry,
        adjoint: diffrax.AbstractAdjoint | None = None,
    ) -> Carry:
        """From the carry at the start of an interval to that at its end: in steps chosen by an error control, or in
        those of a schedule, whose number may be traced (then not in reverse mode) and which are divided where contacts
        need it (not in reverse mode, either)."""
        solver, conditions = self.solver, self._conditions(actual, entry)
        if self.method.adaptive:
            return _adaptive_in_parts(solver, carry, entry, conditions, self.method, adjoint)
        schedule, tolerance = self._schedule(entry, operators), contact_tolerance_of(self.model, self.method)

        def part(t0, t1, y, memory, operators):
            own = dataclasses.replace(conditions, operators=operators)
            y, _, _, memory, result = solver.step(TERMS, t0, t1, y, own, memory, jnp.asarray(False))
            return y, memory, result

        def step(index, state):
            y, memory, before = state
            t0, h, operators, place = schedule.step(index)
            if schedule.parts and isinstance(solver, GeneralisedAlphaSolver):
                y, memory = _step_start(solver, y, memory, before, h, place, tolerance)
                before = jnp.where(place >= 0.0, h, before)
            if tolerance is None:
                y, memory, _ = part(t0, t0 + h, y, memory, operators)
            else:
                y, memory = follow_contacts(part, conditions.actual, t0, h, y, memory, operators, tolerance)
            return y, memory, before

        def step_if_needed(state, index):
            if carry.memory is None and not schedule.parts:
                return step(index, state)
            return jax.lax.cond(schedule.needed(index), lambda: step(index, state), lambda: state)

        t0, h, first_operators, _ = schedule.step(jnp.zeros_like(entry.phase, jnp.float64))
        y, first = (carry.trajectory, carry.peaks), dataclasses.replace(conditions, operators=first_operators)
        memory = solver.resume(TERMS, t0, t0 + h, y, first, carry.memory)
        state = y, memory, carry.last_step if schedule.parts else None
        if isinstance(schedule.number, int):
            one = step_if_needed if carry.memory is None else repeated(step_if_needed)
            indices = jnp.arange(schedule.number, dtype=jnp.float64)
            state, _ = jax.lax.scan(lambda *args: (one(*args), None), state, indices)
        else:
            count = schedule.number.astype(jnp.int32)
            state = jax.lax.fori_loop(0, count, lambda i, state: step_if_needed(state, i.astype(jnp.float64)), state)
        return carry.after(*state)

    def _conditions(self, actual: ModelWithErrors, entry: Entry) -> Conditions:
        """Arguments of the equations of motion within an interval, without operators."""
        ahead = self.grid.longest_step(self.steps) if depend_on_coming_motion(self.model) else None
        actual = with_structural_zeros(actual)
        return Conditions(actual, self.drives, entry.phase, self.stabilisation, ahead=ahead)

    def _schedule(self, entry: Entry, operators: PyTree) -> "Schedule":
        """The steps of an interval, with `operators` for each of the grid's lengths."""

        def of_kind(kind):
            return jax.tree.map(lambda x: _row(x, kind), operators)

        if self.grid.parts is None:
            return _even_steps(entry, self.steps, of_kind(entry.kind))
        return _steps_in_parts(entry, self.counts, of_kind, self.steps, self.grid.parts.most)


def _row(values: Shaped[Array, "rows ..."], place: Int[Array, ""]) -> Shaped[Array, "..."]:
    """A row at a place that is not negative."""
    return jax.lax.dynamic_index_in_dim(values, place, keepdims=False, allow_negative_indices=False)


def contact_tolerance_of(model: Model, method: Method) -> float | None:
    """Tolerance by which steps are divided for contacts; None for methods and models whose steps stay whole."""
    if not model.topology.clearances or not isinstance(method, GeneralisedAlpha):
        return None
    return method.contact_tolerance or None


def _state_rate(t: Scalar, y: StepState, conditions: Conditions) -> StepState:
    """Time derivative of the state (trajectory, squared maxima of loads), zero for the maxima."""
    trajectory, peaks = y
    return MOTION.vf(t, trajectory, conditions), jnp.zeros_like(peaks)


TERMS = diffrax.ODETerm(_state_rate)


def repeated(function: Callable) -> Callable:
    """The function, which reverse mode computes again instead of keeping its intermediate results; within a loop."""
    kept = jax.checkpoint_policies.save_only_these_names(SOLUTION)
    return jax.checkpoint(function, policy=kept, prevent_cse=False)


class Schedule(NamedTuple):
    """The steps of an interval.

    step: start [s], length [s], operators and place within its part of the step of an index; needed: whether the step
    of an index is one of a method that remembers; number: of the steps, or more where it is to be static; parts:
    whether lengths may differ.
    """

    step: Callable[[Float[Array, ""]], tuple[Float[Array, ""], Float[Array, ""], PyTree, Float[Array, ""]]]
    needed: Callable[[Float[Array, ""]], Any]
    number: int | Float[Array, ""]
    parts: bool


def _even_steps(entry: Entry, steps: int | Float[Array, ""], operators: PyTree) -> Schedule:
    """Steps of equal length."""
    h = entry.length / steps

    def step(index):
        return entry.start + h * index, h, operators, index

    # A step of length zero finds the memory at a start; in an interval of length zero one is enough.
    return Schedule(step, lambda index: (h > 0.0) | (index == steps - 1.0), steps, False)


def _steps_in_parts(
    entry: Entry, counts, of_kind: Callable, steps: int | Float[Array, ""], most: int | None
) -> Schedule:
    """Steps of an interval in parts, with `counts` of the distinct lengths."""
    assert entry.parts is not None, "of a grid with parts"
    lengths, kinds = entry.parts
    numbers = counts[kinds]
    behind, begins = jnp.cumsum(numbers), entry.start + jnp.cumsum(lengths) - lengths
    total = jnp.maximum(behind[-1], 1.0)

    def step(index):
        part = jnp.minimum(jnp.sum((index >= behind).astype(jnp.int32)), len(lengths) - 1)
        number = _row(numbers, part)
        h, place = _row(lengths, part) / jnp.maximum(number, 1.0), index - (_row(behind, part) - number)
        return _row(begins, part) + h * place, h, of_kind(_row(kinds, part)), place

    count = total if most is None or not isinstance(steps, int) else most
    return Schedule(step, lambda index: index < total, count, True)


def _step_start(solver: GeneralisedAlphaSolver, y, memory: Memory, before, h, place, tolerance):
    """State and memory at the start of a step, whose length may differ from that of the step before."""
    trajectory, peaks = y
    if tolerance is not None and memory.following is not None:
        before = jnp.where(place == 0.0, memory.following.length, h)
        h = jnp.where(place == 0.0, 0.0, h)  # contacts move the method's accelerations to the length of each part
    trajectory, memory = solver.formulas.at_new_length(trajectory, memory, before, h)
    return (trajectory, peaks), memory


def _adaptive_in_parts(solver, carry: Carry, entry: Entry, conditions, method, adjoint) -> Carry:
    """One interval in steps chosen by the error control, which end where its parts do."""
    if entry.parts is None:
        return _adaptive(solver, carry, entry.start, entry.length, conditions, method, adjoint)
    lengths = entry.parts[0]

    def over(carry, part):
        begin, length = part
        return _adaptive(solver, carry, begin, length, conditions, method, adjoint), None

    return jax.lax.scan(over, carry, (entry.start + jnp.cumsum(lengths) - lengths, lengths))[0]


def _adaptive(solver, carry: Carry, start, length, conditions, method, adjoint) -> Carry:
    """One interval in steps chosen by the error control."""
    moving = length > 0.0
    # In an interval of length zero one step is taken, and discarded below.
    end = start + jnp.where(moving, length, carry.last_step)
    y = (carry.trajectory, carry.peaks)

    def solve(y, conditions, controller, saveat, adjoint):
        return diffrax.diffeqsolve(
            TERMS, solver, start, end, jnp.minimum(carry.last_step, end - start), y,
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
