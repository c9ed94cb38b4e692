"""The functions of time that drives are made of, the same for rotations and translations.

Place in the pipeline: arguments -> **laws** -> family.

Symbols: t [s]; phase: number of breakpoints passed; a motion is (change of the coordinate since the start, rate,
acceleration).  Source: theory (3.5), (3.6).
"""

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from rfem_jax.description.drives.arguments import Phase, Scalar, Time, as_phase

Motion = tuple[Scalar, Scalar, Scalar]
STEPS_IN_RISE = 8


def ramp(size: Scalar, rise_time: float, t: Time, phase: Phase) -> Scalar:
    """size * t / rise_time up to rise_time, then 0."""
    return jnp.where(as_phase(phase) == 0, size * (t / rise_time), 0.0)


def _jump_rows(times: tuple[float, ...]) -> tuple[int, ...]:
    return tuple(i for i in range(1, len(times)) if times[i] == times[i - 1])


def table_jumps(times: tuple[float, ...]) -> tuple[float, ...]:
    """Times [s] at which a table jumps: those given twice, and the last."""
    return (*(times[row] for row in _jump_rows(times)), times[-1])


def rise_steps(rise_time: float, interval: float) -> tuple[float, ...]:
    """Times [s] at which steps end within a rise that is shorter than as many intervals of a length [s]: its
    acceleration vanishes at both ends, so that steps from one to the other do not see it."""
    if rise_time >= STEPS_IN_RISE * interval:
        return ()
    return tuple(rise_time * i / STEPS_IN_RISE for i in range(1, STEPS_IN_RISE))


def row_at(knots: Float[Array, " knots"], t: Time) -> Int[Array, ""]:
    """The last of increasing knots that is not above a number, the first one if all are; by bisection."""
    last, row = knots.shape[0] - 1, jnp.zeros((), jnp.int32)
    for bit in reversed(range(last.bit_length())):
        tried = jnp.minimum(row + 2**bit, last)
        row = jnp.where(knots[tried] <= t, tried, row)
    return row


def table_at(values: Float[Array, " times"], times: tuple[float, ...], t: Time, phase: Phase) -> Scalar:
    """Linear between the rows of a table, zero after the last."""
    phase = as_phase(phase)
    knots, rows = jnp.asarray(times), _jump_rows(times)
    first = jnp.asarray((0, *rows), jnp.int32)[phase]
    last = jnp.asarray((*(row - 1 for row in rows), len(times) - 1), jnp.int32)[phase]
    piece = jnp.clip(row_at(knots, t), first, last - 1)
    fraction = (t - knots[piece]) / (knots[piece + 1] - knots[piece])
    value = values[piece] + fraction * (values[piece + 1] - values[piece])
    return jnp.where(phase <= len(rows), value, 0.0)


def rise(rate: Scalar, rise_time: float, t: Time, phase: Phase) -> Motion:
    """A rate that rises smoothly to a constant: rate * (3 x^2 - 2 x^3), x = t / rise_time <= 1."""
    if rise_time == 0.0:
        return rate * t, rate + 0.0 * t, 0.0 * rate * t
    x = t / rise_time
    rising = as_phase(phase) == 0
    change = jnp.where(rising, rise_time * x**3 * (1.0 - x / 2.0), t - rise_time / 2.0)
    share = jnp.where(rising, x**2 * (3.0 - 2.0 * x), 1.0)
    acceleration = jnp.where(rising, 6.0 * x * (1.0 - x) / rise_time, 0.0)
    return rate * change, rate * share, rate * acceleration


def spin_up(rate: Scalar, rise_time: float, t: Time, phase: Phase) -> Motion:
    """A rate that rises to a constant with a continuous acceleration: rate * (x - sin(2 pi x) / (2 pi))."""
    x, whole = t / rise_time, 2.0 * np.pi
    rising = as_phase(phase) == 0
    change = jnp.where(rising, x**2 / 2.0 + (jnp.cos(whole * x) - 1.0) / whole**2, x - 0.5)
    share = jnp.where(rising, x - jnp.sin(whole * x) / whole, 1.0)
    acceleration = jnp.where(rising, 1.0 - jnp.cos(whole * x), 0.0)
    return rate * rise_time * change, rate * share, rate * acceleration / rise_time


def spline(
    times: tuple[float, ...], changes: Float[np.ndarray, " times"]
) -> tuple[Float[Array, " times"], Float[Array, "4 times-1"]]:
    """Knots [s] and coefficients of a cubic spline (C2, "not-a-knot" ends)."""
    # A third of a second that no other study needs to wait for.
    from scipy.interpolate import CubicSpline

    return jnp.asarray(times), jnp.asarray(CubicSpline(times, changes).c)


def spline_at(knots: Float[Array, " times"], coefficients: Float[Array, "4 times-1"], t: Time) -> Motion:
    """Value of a cubic spline and its derivatives."""
    last = knots.shape[0] - 2
    piece = jnp.clip(row_at(knots, t), 0, last)
    a, b, c, d = coefficients[:, piece]
    x = t - knots[piece]
    value = ((a * x + b) * x + c) * x + d
    return value, (3.0 * a * x + 2.0 * b) * x + c, 6.0 * a * x + 2.0 * b
