"""Drives: a moment on a joint, or a prescribed angle of a joint, as functions of time.

Place in the pipeline: specified in a study; `mechanics` and `simulation` evaluate them inside compiled
code (jit, vmap, forward and reverse differentiation).

A drive may jump at its breakpoints, which are static (they divide the run into integrations).
Pieces are chosen by `phase`, the number of breakpoints passed, never by comparing t with a jump.
Values are float64 JAX arrays: new values do not compile anew.

Symbols: t [s]; moment [N m] about +y of the joint; change of the angle since the start [rad], rate
[rad/s], acceleration [rad/s^2]. Source: theory (3.5), (3.6).
"""

import abc
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.tree_util import Partial
from jaxtyping import Array, Float, Int

from rfem_jax.description.errors import ABSENT, Checks, InputError, require_name, subject
from rfem_jax.description.units import (
    Quantities,
    Quantity,
    non_negative_quantity,
    positive_quantity,
    quantity,
    sequence,
)

Scalar = Float[Array, ""]
Time = int | float | Float[Array | np.ndarray, ""]
Phase = Int[Array, ""] | int | np.integer
if TYPE_CHECKING:
    Law = Callable[..., Scalar]
    Name = str
else:
    Law = Name = Any  # what is no function, or no name, is refused in a sentence


class MomentDrive(eqx.Module):
    """A given moment on a joint."""

    joint: eqx.AbstractVar[str]

    @abc.abstractmethod
    def breakpoints(self) -> tuple[float, ...]:
        """Return the times [s] > 0 at which the moment jumps, increasing."""

    @abc.abstractmethod
    def moment_at(self, t: Time, phase: Phase) -> Scalar:
        """Return the moment [N m] about +y at the time t, in the piece `phase` (int, from 0)."""


class PrescribedDrive(eqx.Module):
    """A given angle of a joint; the moment that enforces it is a result."""

    joint: eqx.AbstractVar[str]

    @abc.abstractmethod
    def breakpoints(self) -> tuple[float, ...]:
        """Return the times [s] > 0 at which a derivative jumps, increasing."""

    @abc.abstractmethod
    def motion_at(self, t: Time, phase: Phase) -> tuple[Scalar, Scalar, Scalar]:
        """Return (change of the angle since the start, rate, acceleration) at t in the piece `phase`."""


class MomentRamp(MomentDrive):
    """M = moment * t / rise_time up to rise_time, then 0; theory (3.5).

    Args:
        joint: the joint's name.
        moment: [N m], reached at rise_time.
        rise_time: [s], > 0.
    """

    joint: str = eqx.field(static=True)
    moment: Scalar
    rise_time: float = eqx.field(static=True)

    def __init__(self, joint: Name, moment: Quantity, rise_time: Quantity):
        checks = _checks(self, joint)
        checks.set("moment", moment, _leaf, "moment", "moment")
        checks.set("rise_time", rise_time, positive_quantity, "time", "rise_time")
        checks.refuse()

    def breakpoints(self) -> tuple[float, ...]:
        return (self.rise_time,)

    def moment_at(self, t: Time, phase: Phase) -> Scalar:
        return jnp.where(_phase(phase) == 0, self.moment * (t / self.rise_time), 0.0)


class MomentTable(MomentDrive):
    """A moment given at times, linear in between, zero after the last time.

    Args:
        joint: the joint's name.
        times: [s], from 0, not decreasing; a time given twice is a jump.
        moments: [N m], as many as times.
    """

    joint: str = eqx.field(static=True)
    values: Float[Array, " times"]
    times: tuple[float, ...] = eqx.field(static=True)

    def __init__(self, joint: Name, times: Quantities, moments: Quantities):
        checks = _checks(self, joint)
        found = checks.value("times", times, table_times, False)
        checks.set("values", moments, _column, "moment", "moments", found)
        checks.refuse()
        self.times = found

    def _jump_rows(self) -> tuple[int, ...]:
        return tuple(i for i in range(1, len(self.times)) if self.times[i] == self.times[i - 1])

    def breakpoints(self) -> tuple[float, ...]:
        return (*(self.times[row] for row in self._jump_rows()), self.times[-1])

    def moment_at(self, t: Time, phase: Phase) -> Scalar:
        phase = _phase(phase)
        times, rows = jnp.asarray(self.times), self._jump_rows()
        first = jnp.asarray((0, *rows), jnp.int32)[phase]
        last = jnp.asarray((*(row - 1 for row in rows), len(self.times) - 1), jnp.int32)[phase]
        piece = jnp.clip(jnp.searchsorted(times, t, side="right") - 1, first, last - 1)
        fraction = (t - times[piece]) / (times[piece + 1] - times[piece])
        value = self.values[piece] + fraction * (self.values[piece + 1] - self.values[piece])
        return jnp.where(phase <= len(rows), value, 0.0)


class MomentFunction(MomentDrive):
    """A moment given by a Python function written in JAX.

    Args:
        joint: the joint's name.
        function: (t [s], phase) -> moment [N m], a float64 scalar; smooth within a phase. An
            `equinox.Module` with `__call__` may hold parameters to differentiate.
        breakpoints: times [s] > 0 at which the moment jumps, increasing.
    """

    joint: str = eqx.field(static=True)
    function: Callable[..., Scalar]
    times: tuple[float, ...] = eqx.field(static=True)

    def __init__(self, joint: Name, function: Law, breakpoints: Quantities = ()):
        checks = _checks(self, joint)
        checks.set("times", breakpoints, require_breakpoints)
        checks.set("function", function, as_tree)
        checks.refuse()
        _check_scalar(self.function, with_phase=True)

    def breakpoints(self) -> tuple[float, ...]:
        return self.times

    def moment_at(self, t: Time, phase: Phase) -> Scalar:
        return self.function(jnp.asarray(t, jnp.float64), _phase(phase))


class PrescribedRate(PrescribedDrive):
    """A rate that rises smoothly to a constant: rate * (3 x^2 - 2 x^3), x = t / rise_time <= 1.

    Args:
        joint: the joint's name.
        rate: [rad/s] about +y.
        rise_time: [s], >= 0; 0 moves at the full rate from the start.
    """

    joint: str = eqx.field(static=True)
    rate: Scalar
    rise_time: float = eqx.field(static=True)

    def __init__(self, joint: Name, rate: Quantity, rise_time: Quantity = 0.0):
        checks = _checks(self, joint)
        checks.set("rate", rate, _leaf, "rate", "rate")
        checks.set("rise_time", rise_time, non_negative_quantity, "time", "rise_time")
        checks.refuse()

    def breakpoints(self) -> tuple[float, ...]:
        return (self.rise_time,) if self.rise_time > 0.0 else ()

    def motion_at(self, t: Time, phase: Phase) -> tuple[Scalar, Scalar, Scalar]:
        if self.rise_time == 0.0:
            return self.rate * t, self.rate + 0.0 * t, 0.0 * self.rate * t
        x = t / self.rise_time
        rising = _phase(phase) == 0
        angle = jnp.where(rising, self.rise_time * x**3 * (1.0 - x / 2.0), t - self.rise_time / 2.0)
        rate = jnp.where(rising, x**2 * (3.0 - 2.0 * x), 1.0)
        acceleration = jnp.where(rising, 6.0 * x * (1.0 - x) / self.rise_time, 0.0)
        return self.rate * angle, self.rate * rate, self.rate * acceleration


class PrescribedSpinUp(PrescribedDrive):
    """A rate that rises to a constant with a continuous acceleration:
    rate * (x - sin(2 pi x) / (2 pi)), x = t / rise_time <= 1.

    The law of the spin-up beam of Simo and Vu-Quoc (J. Appl. Mech. 53 (1986) 855-863) and of Wu and
    Haug's slewing beam (Int. J. Numer. Methods Eng. 26 (1988) 2211-2226).

    Args:
        joint: the joint's name.
        rate: [rad/s] about +y, reached at rise_time.
        rise_time: [s], > 0.
    """

    joint: str = eqx.field(static=True)
    rate: Scalar
    rise_time: float = eqx.field(static=True)

    def __init__(self, joint: Name, rate: Quantity, rise_time: Quantity):
        checks = _checks(self, joint)
        checks.set("rate", rate, _leaf, "rate", "rate")
        checks.set("rise_time", rise_time, positive_quantity, "time", "rise_time")
        checks.refuse()

    def breakpoints(self) -> tuple[float, ...]:
        return (self.rise_time,)

    def motion_at(self, t: Time, phase: Phase) -> tuple[Scalar, Scalar, Scalar]:
        x, whole = t / self.rise_time, 2.0 * np.pi
        rising = _phase(phase) == 0
        angle = jnp.where(rising, x**2 / 2.0 + (jnp.cos(whole * x) - 1.0) / whole**2, x - 0.5)
        rate = jnp.where(rising, x - jnp.sin(whole * x) / whole, 1.0)
        acceleration = jnp.where(rising, 1.0 - jnp.cos(whole * x), 0.0)
        return (
            self.rate * self.rise_time * angle,
            self.rate * rate,
            self.rate * acceleration / self.rise_time,
        )


class PrescribedTable(PrescribedDrive):
    """Changes of the angle, given at times and joined by a cubic spline (C2, "not-a-knot" ends).

    Args:
        joint: the joint's name.
        times: [s], increasing from 0; at least two.
        angles: changes of the angle since the start [rad], as many as times, the first 0.
    """

    joint: str = eqx.field(static=True)
    knots: Float[Array, " times"]
    coefficients: Float[Array, "4 times-1"]
    end: float = eqx.field(static=True)

    def __init__(self, joint: Name, times: Quantities, angles: Quantities):
        checks = _checks(self, joint)
        knots = checks.value("times", times, table_times, True)
        changes = checks.value("angles", angles, _table_angles, knots)
        checks.refuse()
        # A third of a second that no other study needs to wait for.
        from scipy.interpolate import CubicSpline

        spline = CubicSpline(knots, changes)
        self.knots = jnp.asarray(knots)
        self.coefficients = jnp.asarray(spline.c)
        self.end = knots[-1]

    def breakpoints(self) -> tuple[float, ...]:
        return ()

    def motion_at(self, t: Time, phase: Phase) -> tuple[Scalar, Scalar, Scalar]:
        last = self.knots.shape[0] - 2
        piece = jnp.clip(jnp.searchsorted(self.knots, t, side="right") - 1, 0, last)
        a, b, c, d = self.coefficients[:, piece]
        x = t - self.knots[piece]
        angle = ((a * x + b) * x + c) * x + d
        return angle, (3.0 * a * x + 2.0 * b) * x + c, 6.0 * a * x + 2.0 * b


class PrescribedFunction(PrescribedDrive):
    """Change of the angle as a Python function written in JAX; its derivatives are taken by JAX.

    Args:
        joint: the joint's name.
        function: t [s] -> change of the angle [rad], a float64 scalar, 0 at t = 0 and twice
            differentiable; with breakpoints it is called as function(t, phase) instead.
        breakpoints: times [s] > 0 at which a derivative jumps, increasing.
    """

    joint: str = eqx.field(static=True)
    function: Callable[..., Scalar]
    times: tuple[float, ...] = eqx.field(static=True)

    def __init__(self, joint: Name, function: Law, breakpoints: Quantities = ()):
        checks = _checks(self, joint)
        checks.set("times", breakpoints, require_breakpoints)
        checks.set("function", function, as_tree)
        checks.refuse()
        _check_scalar(self.function, with_phase=bool(self.times))
        start = self._angle(jnp.zeros((), jnp.float64), 0)
        if not isinstance(start, Tracer) and not abs(float(start)) <= 1e-12:
            raise InputError(
                f"Argument `function` must be 0 at t = 0, but was {float(start)}; return the change "
                "of the angle since the start."
            )

    def breakpoints(self) -> tuple[float, ...]:
        return self.times

    def _angle(self, t: Time, phase: Phase) -> Scalar:
        return self.function(t, phase) if self.times else self.function(t)

    def motion_at(self, t: Time, phase: Phase) -> tuple[Scalar, Scalar, Scalar]:
        t, phase = jnp.asarray(t, jnp.float64), _phase(phase)
        one = jnp.ones_like(t)

        def angle_and_rate(time: Scalar) -> tuple[Scalar, Scalar]:
            return jax.jvp(lambda s: self._angle(s, phase), (time,), (one,))

        (angle, rate), (_, acceleration) = jax.jvp(angle_and_rate, (t,), (one,))
        return angle, rate, acceleration


def _phase(phase: Phase) -> Int[Array, ""]:
    return jnp.asarray(phase, jnp.int32)


def _checks(drive: object, joint: object) -> Checks:
    """Checks of the arguments of a drive, of which that of its joint is done."""
    if not jax.config.jax_enable_x64:  # pyright: ignore[reportAttributeAccessIssue]  # JAX adds it at run time
        raise InputError(
            "A drive must be built in double precision, but JAX is set to single precision; paste "
            'jax.config.update("jax_enable_x64", True) at the start of your program.'
        )
    checks = Checks(drive)
    checks.set("joint", joint, require_name, "`joint` of the drive")
    return checks


def _leaf(value: Any, dimension: str, where: str) -> Scalar:
    """A float64 scalar array; a traced value stays traced, so that it can be differentiated."""
    if isinstance(value, Tracer):
        if value.shape != () or value.dtype != jnp.float64:
            raise InputError(
                f"{subject(where)} must be a float64 scalar, but has the type {value.dtype} and "
                f"the shape {value.shape}; convert it first."
            )
        return value
    return jnp.asarray(quantity(value, dimension, where), jnp.float64)


def _column(values: Any, dimension: str, where: str, times: Any) -> Float[Array, " times"]:
    """The column of a table with these times (ABSENT where they are wrong)."""
    if not _is_traced_column(values):
        values = jnp.asarray(sequence(values, dimension, where), jnp.float64)
    if times is not ABSENT and values.shape[0] != len(times):
        raise InputError(
            f"{subject(where)} must have as many entries as `times` ({len(times)}), but has "
            f"{values.shape[0]}; give one for each time."
        )
    return values


def _table_angles(values: Any, times: Any) -> Float[np.ndarray, " times"]:
    angles = np.asarray(_column(values, "angle", "angles", times))
    if angles.size and angles[0] != 0.0:
        raise InputError(
            f"Argument `angles` must start with 0, but starts with {angles[0]}; give the "
            "changes of the angle since the start."
        )
    return angles


def _is_traced_column(values: object) -> bool:
    return isinstance(values, Tracer) and values.dtype == jnp.float64 and values.ndim == 1


def table_times(times: Quantities, strictly: bool) -> tuple[float, ...]:
    """Return the times [s] of a table as floats, from 0 and not decreasing (`strictly`: increasing), a time given twice
    being a jump; else raise InputError."""
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
            "last time, but does; remove the superfluous rows (the moment is 0 after the last)."
        )
    return times


def require_breakpoints(times: Quantities) -> tuple[float, ...]:
    """Return times [s] above 0, increasing, as floats; else raise InputError."""
    times = sequence(times, "time", "breakpoints")
    if any(later <= earlier for earlier, later in zip((0.0, *times), times)):
        raise InputError(
            f"Argument `breakpoints` must be increasing times above 0, but was {list(times)}; "
            "sort them and leave out 0."
        )
    return times


def as_tree(function: object) -> Any:
    """A function as a pytree: an equinox Module keeps its leaves, a plain function is static."""
    if not callable(function):
        raise InputError(
            f"Argument `function` must be a function of time, but was {function!r}; pass for example lambda t: 0.6 * t."
        )
    return function if isinstance(function, (eqx.Module, Partial)) else Partial(function)


def _check_scalar(function: Callable[..., Any], with_phase: bool) -> None:
    t, phase = jax.ShapeDtypeStruct((), jnp.float64), jax.ShapeDtypeStruct((), jnp.int32)
    signature = "(t, phase)" if with_phase else "(t)"
    try:
        result = eqx.filter_eval_shape(function, *((t, phase) if with_phase else (t,)))
    except Exception as error:
        raise InputError(
            f"Argument `function` must be callable as function{signature} in JAX, but raised "
            f"{type(error).__name__}: {error}; use jax.numpy and these arguments."
        ) from error
    if getattr(result, "shape", None) != () or result.dtype != jnp.float64:
        raise InputError(
            f"Argument `function` must return a float64 scalar, but returned {result}; return one jax.numpy value."
        )
