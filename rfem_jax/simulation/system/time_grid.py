"""The intervals of a simulation: saved times and the drive's jumps are ends of steps.

Place in the pipeline: duration, step, jumps -> **time grid** -> integration.

All intervals are divided into the same number of steps, so that one compiled loop body serves them all; an interval
shortened by a jump has shorter steps.  The first interval has length zero, so that the same body records the start.

Steps also end where a law changes its slope, at the rows of tables over time.  These are no saved times, and there may
be thousands of them, so they divide intervals into parts, each with as many steps as its own length needs:

    |------- interval -------|------- interval -------|     saved times and jumps
    |---------|-|------------|------------------------|     parts: rows of tables
    |--|--|--|-|--|--|--|--|-|--|--|--|--|--|--|--|--|     steps
"""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Int

from rfem_jax.description.basics.errors import InputError
from rfem_jax.description.methods import Method

SAVED_BY_DEFAULT = 500  # intervals
STEPS_PER_ROW = 8  # in a pulse of two rows integrals of squares are then 0.8 % off
ROUNDING = 1e-9  # relative, of times that are meant to be equal


class Parts(eqx.Module):
    """Parts of all intervals, whose number is that of the interval with most; the last ones of others have length zero.

    lengths [s]; kinds: index of each length among the distinct ones of the grid, which has those of intervals that rows
    or jumps cut for themselves; least: number of steps that such a part has at least, 0 of others; most: steps in an
    interval, None where it is not known when programs are compiled.
    """

    lengths: Float[np.ndarray, "intervals parts"]
    kinds: Int[np.ndarray, "intervals parts"]
    least: Float[np.ndarray, " distinct"]
    most: int | None = eqx.field(static=True)


class TimeGrid(eqx.Module):
    """Intervals of a simulation.

    starts, lengths [s]; phases: number of the drive's jumps passed before; kinds: index of each length among the
    `distinct` ones [s], of which there are few; restarts: intervals of length zero after jumps, one of which may be the
    start, which are not saved; parts: of intervals that laws over time divide, whose lengths then are the distinct
    ones; None where none is.
    """

    starts: Float[np.ndarray, " intervals"]
    lengths: Float[np.ndarray, " intervals"]
    phases: Int[np.ndarray, " intervals"]
    kinds: Int[np.ndarray, " intervals"]
    distinct: Float[np.ndarray, " distinct"]
    restarts: tuple[int, ...] = eqx.field(static=True, default=())
    parts: Parts | None = None

    def longest_step(self, steps: int | Float[Array, ""]) -> Float[Array, ""]:
        """Length [s] of the longest step with a number of them in an interval, which may be traced."""
        return jnp.max(jnp.asarray(self.distinct)) / steps

    def shortest_step(self, steps: int | Float[Array, ""]) -> Float[Array, ""]:
        """Length [s] of the shortest step, likewise."""
        counts = steps if self.parts is None else steps_of_parts(self.distinct, steps, self.parts.least)
        lengths = jnp.asarray(self.distinct)
        return jnp.min(jnp.where(lengths > 0.0, lengths, jnp.inf) / jnp.maximum(jnp.asarray(counts, jnp.float64), 1.0))

    @property
    def saved(self) -> Int[np.ndarray, " saved"]:
        """Indices of the intervals whose ends are saved times."""
        return np.setdiff1d(np.arange(self.starts.shape[0]), self.restarts)

    def piece(self, first: int, size: int) -> "TimeGrid":
        """`size` intervals from `first`, padded with intervals of length zero at the end."""
        part = [x[first : first + size] for x in (self.starts, self.lengths, self.phases, self.kinds)]
        starts, lengths, phases, kinds = part
        missing = size - len(starts)
        zero_length = int(np.argmin(self.distinct))
        divided = None
        if self.parts is not None:
            rows = (missing, self.parts.lengths.shape[1])
            divided = Parts(
                np.append(self.parts.lengths[first : first + size], np.zeros(rows), axis=0),
                np.append(self.parts.kinds[first : first + size], np.full(rows, zero_length), axis=0).astype(np.int32),
                self.parts.least,
                self.parts.most,
            )
        return TimeGrid(
            np.append(starts, np.full(missing, starts[-1] + lengths[-1])),
            np.append(lengths, np.zeros(missing)),
            np.append(phases, np.full(missing, phases[-1])).astype(np.int32),
            np.append(kinds, np.full(missing, zero_length)).astype(np.int32),
            self.distinct,
            parts=divided,
        )

    @property
    def steps_per_row(self) -> int:
        """Number of steps between two rows, at least; 1 where rows cut no interval."""
        return 1 if self.parts is None else int(self.parts.least.max())

    def with_steps_per_row(self, least: int) -> "TimeGrid":
        """The grid with at least another number of steps between two rows, for programs that serve any step."""
        if self.parts is None:
            return self
        of_cut = np.where(self.parts.least > 0.0, float(least), 0.0)
        return dataclasses.replace(self, parts=dataclasses.replace(self.parts, least=of_cut, most=None))

    def of_any_step(self) -> "TimeGrid":
        """The grid without the entries that depend on the step, for programs that serve any step."""
        return self.with_steps_per_row(self.steps_per_row)

    def total_steps(self, steps: int | Float[Array, ""]) -> float:
        """Number of steps of a run, of intervals, or of the longest part, in a number of `steps` each."""
        if self.parts is None:
            return float(len(self.starts) * steps)
        counts = np.asarray(steps_of_parts(self.distinct, steps, self.parts.least))
        return float(np.maximum(counts[self.parts.kinds].sum(axis=1), 1.0).sum())


def steps_of_parts(
    distinct: Float[Array | np.ndarray, " distinct"],
    steps: int | Float[Array, ""],
    least: Float[Array | np.ndarray, " distinct"],
) -> Float[Array | np.ndarray, " distinct"]:
    """Number of steps in parts of several lengths [s]: `steps` in the longest, at least `least` in each, 0 in a part of
    length zero."""
    # Numbers stay numbers while a program is traced around.
    xp = np if all(isinstance(x, (int, float, np.ndarray)) for x in (distinct, steps, least)) else jnp
    share = distinct / xp.max(distinct)
    counts = xp.ceil(share * steps * (1.0 - ROUNDING))
    return xp.where(share > 0.0, xp.maximum(counts, least), 0.0)


def divide_time(
    duration: float,
    step: float | None,
    save_every: float | None,
    jumps: tuple[float, ...],
    restarting: bool = False,
    from_start: bool = False,
    rows: tuple[float, ...] = (),
    per_row: int | None = None,
) -> tuple[TimeGrid, int]:
    """Divide a duration [s] into intervals and steps.

    **Arguments:** `step` [s], at most (None: adaptive); `save_every` [s] (None: 500 intervals); `jumps` [s] of the
    drive, increasing; `restarting`: the method carries a memory, and needs an interval of length zero after a jump;
    `from_start`: and another one at the start, which counts as a jump; `rows` [s]: other times that are ends of steps;
    `per_row`: number of steps between two of these, at least (None: up to `STEPS_PER_ROW`, as long as there are not
    more of these steps than of all others).

    **Returns:** the intervals, and the number of steps in each, or in the longest part where rows divide them (1 for
    adaptive methods).

    **Raises:** `InputError` if a time is not positive or not a concrete number.
    """
    for name, value in (("duration", duration), ("step", step), ("save_every", save_every)):
        if isinstance(value, Tracer):
            raise InputError(
                f"Argument `{name}` must be a concrete number, but is traced; the number of steps "
                "follows from it, so keep it out of jit's and vmap's arguments."
            )
        if value is not None and not (np.isfinite(value) and value > 0.0):
            raise InputError(f"Argument `{name}` must be positive, but is {value}; give seconds.")
    save_every = longest_interval(duration, step, save_every)
    count = int(np.ceil(duration / save_every * (1.0 - ROUNDING)))
    edges = np.append(np.arange(count) * save_every, duration)
    passed = np.array([jump for jump in jumps if 0.0 < jump < duration * (1.0 - ROUNDING)])
    for jump in passed:
        edges = edges[np.abs(edges - jump) > ROUNDING * duration]
    edges = np.sort(np.concatenate([edges, passed]))
    starts = np.concatenate([[0.0], edges[:-1]])
    lengths = np.concatenate([[0.0], np.diff(edges)])
    phases = np.searchsorted(passed, starts + ROUNDING * duration).astype(np.int32)
    steps = 1 if step is None else int(np.ceil(lengths.max() / step * (1.0 - ROUNDING)))
    restarts: tuple[int, ...] = ()
    if restarting:
        after = 1 + np.flatnonzero(np.diff(phases))
        if from_start:
            after = np.append(1, after)
        starts = np.insert(starts, after, starts[after])
        lengths = np.insert(lengths, after, 0.0)
        phases = np.insert(phases, after, phases[after])
        restarts = tuple(int(i) for i in after + np.arange(len(after)))
    distinct, kinds = _distinct(lengths, duration)
    grid = TimeGrid(starts, lengths, phases, kinds, distinct, restarts)
    return _divided(grid, duration, step, steps, rows, per_row)


def _distinct(lengths: np.ndarray, duration: float) -> tuple[np.ndarray, np.ndarray]:
    """Distinct lengths [s], and the index of each among them."""
    distinct, kinds = np.unique(np.round(lengths / duration, 12), return_inverse=True)
    return distinct * duration, kinds.reshape(lengths.shape).astype(np.int32)


def _divided(
    grid: TimeGrid, duration: float, step: float | None, steps: int, rows: tuple[float, ...], per_row: int | None
) -> tuple[TimeGrid, int]:
    """The grid with intervals in parts at those rows [s] that are no ends of intervals, and the number of steps."""
    near, ends = ROUNDING * duration, grid.starts + grid.lengths
    inside = np.unique([time for time in rows if near < time < duration - near])
    inside = inside[np.diff(inside, prepend=-np.inf) > near]
    place = np.searchsorted(ends, inside)
    inside = inside[(ends[place] - inside > near) & (inside - grid.starts[place] > near)]
    if not inside.size:
        return grid, steps
    interval = np.searchsorted(ends, inside)
    counts = np.bincount(interval, minlength=len(ends))
    edges = np.repeat(ends[:, None], counts.max() + 1, axis=1)
    edges[interval, np.arange(len(inside)) - (np.cumsum(counts) - counts)[interval]] = inside
    lengths = np.diff(edges, axis=1, prepend=grid.starts[:, None])
    # What is cut is marked by its sign, so that it is a kind of its own.
    cut = (counts > 0) | (grid.lengths < grid.lengths.max() * (1.0 - ROUNDING))
    distinct, kinds = _distinct(np.where(cut[:, None], -lengths, lengths), duration)
    of_cut, distinct = distinct < 0.0, np.abs(distinct)
    steps = 1 if step is None else int(np.ceil(distinct.max() / step * (1.0 - ROUNDING)))
    if per_row is None:
        numbers = np.asarray(steps_of_parts(distinct, steps, np.zeros(len(distinct))))[kinds]
        few = np.sum((numbers < STEPS_PER_ROW) & of_cut[kinds])
        per_row = int(np.clip(numbers.sum() // max(few, 1), 1, STEPS_PER_ROW))
    least = np.where(of_cut, float(per_row), 0.0)
    most = int(np.asarray(steps_of_parts(distinct, steps, least))[kinds].sum(axis=1).max())
    parts = Parts(lengths, kinds, least, most)
    return TimeGrid(grid.starts, grid.lengths, grid.phases, kinds[:, 0], distinct, grid.restarts, parts), steps


def longest_interval(duration: float, step: float | None, save_every: float | None) -> float:
    """Time [s] between saved times, with the arguments of `divide_time`: never less than a step."""
    save_every = duration / SAVED_BY_DEFAULT if save_every is None else save_every
    return step if step is not None and save_every < step * (1.0 - ROUNDING) else save_every


def of_any_step(
    method: Method, grid: TimeGrid, steps: int | Float[Array, ""]
) -> tuple[Method, TimeGrid, int | Float[Array, ""]]:
    """The method, the grid and the number of steps in an interval as programs take them that serve any step: traced,
    where the method allows that. Not for reverse mode."""
    if not method.implicit or method.adaptive or not isinstance(steps, int):
        return method, grid, steps
    longest = float(np.max(grid.lengths))
    return dataclasses.replace(method, step=longest), grid.of_any_step(), jnp.asarray(steps, jnp.float64)
