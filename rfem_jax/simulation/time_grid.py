"""The intervals of a simulation: saved times and the drive's jumps are ends of steps.

Place in the pipeline: duration, step, jumps -> **time grid** -> integration.

All intervals are divided into the same number of steps, so that one compiled body serves them all;
an interval that a jump shortens has shorter steps.  The first interval has length zero: it records
the start with the same body.
"""

from typing import NamedTuple

import jax
import numpy as np

from rfem_jax.description.errors import InputError

SAVED_BY_DEFAULT = 500
ROUNDING = 1e-9


class TimeGrid(NamedTuple):
    """starts, lengths (intervals,) [s]; phases (intervals,): jumps of the drive already passed."""

    starts: np.ndarray
    lengths: np.ndarray
    phases: np.ndarray


def divide_time(
    duration: float, step: float | None, save_every: float | None, jumps: tuple[float, ...]
) -> tuple[TimeGrid, int]:
    """Intervals, and the number of steps in each (1 for adaptive methods, step None).

    **Raises:** `InputError` if a time is not positive or not a concrete number.
    """
    for name, value in (("duration", duration), ("step", step), ("save_every", save_every)):
        if isinstance(value, jax.core.Tracer):
            raise InputError(
                f"Argument `{name}` must be a concrete number, but is traced; the number of steps "
                "follows from it, so keep it out of jit's and vmap's arguments."
            )
        if value is not None and not (np.isfinite(value) and value > 0.0):
            raise InputError(f"Argument `{name}` must be positive, but is {value}; give seconds.")
    save_every = duration / SAVED_BY_DEFAULT if save_every is None else save_every
    if step is not None and save_every < step * (1.0 - ROUNDING):
        save_every = step
    count = int(np.ceil(duration / save_every * (1.0 - ROUNDING)))
    edges = np.append(np.arange(count) * save_every, duration)
    jumps = np.array([jump for jump in jumps if 0.0 < jump < duration * (1.0 - ROUNDING)])
    for jump in jumps:
        edges = edges[np.abs(edges - jump) > ROUNDING * duration]
    edges = np.sort(np.concatenate([edges, jumps]))
    starts = np.concatenate([[0.0], edges[:-1]])
    lengths = np.concatenate([[0.0], np.diff(edges)])
    phases = np.searchsorted(jumps, starts + ROUNDING * duration).astype(np.int32)
    steps = 1 if step is None else int(np.ceil(lengths.max() / step * (1.0 - ROUNDING)))
    return TimeGrid(starts, lengths, phases), steps
