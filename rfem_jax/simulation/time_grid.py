"""The intervals of a simulation: saved times and the drive's jumps are ends of steps.

Place in the pipeline: duration, step, jumps -> **time grid** -> integration.

All intervals are divided into the same number of steps, so that one compiled loop body serves them all; an interval
shortened by a jump has shorter steps.  The first interval has length zero, so that the same body records the start.
"""

import dataclasses

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Int

from rfem_jax.description.errors import InputError
from rfem_jax.description.methods import Method

SAVED_BY_DEFAULT = 500  # intervals
ROUNDING = 1e-9  # relative, of times that are meant to be equal


class TimeGrid(eqx.Module):
    """Intervals of a simulation.

    starts, lengths [s]; phases: number of the drive's jumps passed before; kinds: index of each length among the
    `distinct` ones [s], of which there are few; restarts: intervals of length zero after jumps, one of which may be the
    start, which are not saved.
    """

    starts: Float[np.ndarray, " intervals"]
    lengths: Float[np.ndarray, " intervals"]
    phases: Int[np.ndarray, " intervals"]
    kinds: Int[np.ndarray, " intervals"]
    distinct: Float[np.ndarray, " distinct"]
    restarts: tuple[int, ...] = eqx.field(static=True, default=())

    def longest_step(self, steps: int | Float[Array, ""]) -> Float[Array, ""]:
        """Length [s] of the longest step with a number of them in an interval, which may be traced."""
        return jnp.max(jnp.asarray(self.distinct)) / steps

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
        return TimeGrid(
            np.append(starts, np.full(missing, starts[-1] + lengths[-1])),
            np.append(lengths, np.zeros(missing)),
            np.append(phases, np.full(missing, phases[-1])).astype(np.int32),
            np.append(kinds, np.full(missing, zero_length)).astype(np.int32),
            self.distinct,
        )


def divide_time(
    duration: float,
    step: float | None,
    save_every: float | None,
    jumps: tuple[float, ...],
    restarting: bool = False,
    from_start: bool = False,
) -> tuple[TimeGrid, int]:
    """Divide a duration [s] into intervals and steps.

    **Arguments:** `step` [s], at most (None: adaptive); `save_every` [s] (None: 500 intervals); `jumps` [s] of the
    drive, increasing; `restarting`: the method carries a memory, and needs an interval of length zero after a jump;
    `from_start`: and another one at the start, which counts as a jump.

    **Returns:** the intervals, and the number of steps in each (1 for adaptive methods).

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
    distinct, kinds = np.unique(np.round(lengths / duration, 12), return_inverse=True)
    kinds = kinds.astype(np.int32)
    return TimeGrid(starts, lengths, phases, kinds, distinct * duration, restarts), steps


def longest_interval(duration: float, step: float | None, save_every: float | None) -> float:
    """Time [s] between saved times, with the arguments of `divide_time`: never less than a step."""
    save_every = duration / SAVED_BY_DEFAULT if save_every is None else save_every
    return step if step is not None and save_every < step * (1.0 - ROUNDING) else save_every


def of_any_step(method: Method, grid: TimeGrid, steps: int | Float[Array, ""]) -> tuple[Method, int | Float[Array, ""]]:
    """The method and the number of steps in an interval as programs take them that serve any step: traced, where the
    method allows that. Not for reverse mode."""
    if not method.implicit or method.adaptive or not isinstance(steps, int):
        return method, steps
    return dataclasses.replace(method, step=float(np.max(grid.lengths))), jnp.asarray(steps, jnp.float64)
