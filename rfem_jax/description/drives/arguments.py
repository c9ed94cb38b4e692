"""The arguments of drives: how they are checked, and made arrays or static times.

Place in the pipeline: units, errors, own_functions -> **arguments** -> family.
"""

from collections.abc import Callable
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Int

from rfem_jax.description.basics.errors import ABSENT, Checks, InputError, require_choice, require_name, subject
from rfem_jax.description.basics.joint_kinds import KINDS
from rfem_jax.description.basics.numbers import number
from rfem_jax.description.basics.own_functions import as_tree, checked_function
from rfem_jax.description.basics.precision import require_float64
from rfem_jax.description.basics.units import Quantities, sequence

Scalar = Float[Array, ""]
Time = int | float | Float[Array | np.ndarray, ""]
Phase = Int[Array, ""] | int | np.integer


def as_phase(phase: Phase) -> Int[Array, ""]:
    """The number of breakpoints passed, as an array."""
    return jnp.asarray(phase, jnp.int32)


def drive_checks(drive: object, joint: object, motion: object) -> Checks:
    """Checks of the arguments of a drive, of which those of its joint and motion are done."""
    require_float64()
    checks = Checks(drive)
    checks.set("joint", joint, require_name, "`joint` of the drive")
    checks.set("motion", motion, _motion)
    return checks


def _motion(motion: Any) -> str | None:
    """The name of a free motion that some kind of joint has, or None."""
    known = dict.fromkeys(motion for kind in KINDS.values() for motion in kind.motions)
    return None if motion is None else require_choice(motion, known, "`motion` of the drive")


def leaf(value: Any, dimension: str, where: str) -> Scalar:
    """A float64 scalar array; a traced value stays traced, so that it can be differentiated."""
    found = number(value, dimension, where)
    return found if isinstance(found, Tracer) else jnp.asarray(np.asarray(found, float), jnp.float64)


def column(values: Any, dimension: str, where: str, times: Any) -> Float[Array, " times"]:
    """The column of a table with these times (ABSENT where they are wrong)."""
    if not _is_traced_column(values):
        values = jnp.asarray(sequence(values, dimension, where), jnp.float64)
    if times is not ABSENT and values.shape[0] != len(times):
        raise InputError(
            f"{subject(where)} must have as many entries as `times` ({len(times)}), but has "
            f"{values.shape[0]}; give one for each time."
        )
    return values


def table_changes(values: Any, dimension: str, where: str, times: Any) -> Float[np.ndarray, " times"]:
    """The column of the changes of an angle or a displacement since the start."""
    changes = np.asarray(column(values, dimension, where, times))
    if changes.size and changes[0] != 0.0:
        raise InputError(
            f"{subject(where)} must start with 0, but starts with {changes[0]}; give the "
            f"changes of the {where.removesuffix('s')} since the start."
        )
    return changes


def _is_traced_column(values: object) -> bool:
    return isinstance(values, Tracer) and values.dtype == jnp.float64 and values.ndim == 1


def table_times(times: Quantities, strictly: bool) -> tuple[float, ...]:
    """The times of a table from 0, increasing `strictly` or with jumps."""
    times = sequence(times, "time", "times")
    if len(times) < 2 or times[0] != 0.0:
        raise InputError(
            f"Argument `times` must hold at least two times, the first 0, but was {list(times)}; "
            "start the table at t = 0."
        )
    steps = np.diff(times)
    if np.any(steps < 0.0) or (strictly and np.any(steps == 0.0)):
        raise InputError(
            f"Argument `times` must be increasing, but {times[int(np.argmin(steps)) + 1]} follows "
            f"{times[int(np.argmin(steps))]}; sort the table and remove repeated times."
        )
    repeated = steps == 0.0
    if np.any(repeated[1:] & repeated[:-1]) or (repeated.size and (repeated[0] or repeated[-1])):
        raise InputError(
            "Argument `times` must repeat a time (a jump) only once and neither the first nor the "
            "last time, but does; remove the superfluous rows (the moment or force is 0 after the last)."
        )
    return times


def checked_breakpoints(breakpoints: Quantities) -> tuple[float, ...]:
    """Increasing times above 0."""
    times = sequence(breakpoints, "time", "breakpoints")
    if any(later <= earlier for earlier, later in zip((0.0, *times), times)):
        raise InputError(
            f"Argument `breakpoints` must be increasing times above 0, but was {list(times)}; "
            "sort them and leave out 0."
        )
    return times


def function_of_time(function: object) -> Any:
    """A function as a pytree."""
    return as_tree(function, "`function`", "time", "pass for example lambda t: 0.6 * t")


def checked_function_of_time(function: Callable[..., Any], with_phase: bool) -> Any:
    """A function of time, and of the phase, that returns a float64 scalar."""
    if with_phase:
        return checked_function(function, "`function`", "t, phase", ("float64", "int32"))
    return checked_function(function, "`function`", "t", ("float64",))
