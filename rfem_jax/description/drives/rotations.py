"""Drives: forces and moments on free motions of joints, or prescribed motions of them, as functions of time.

Place in the pipeline: specified in a study; `mechanics` and `simulation` evaluate them inside compiled
code (jit, vmap, forward and reverse differentiation).  Here are those of rotations; `translation_drives` has those of
translations.

A drive may jump at its breakpoints, which are static (they divide the run into integrations).
Pieces are chosen by `phase`, the number of breakpoints passed, never by comparing t with a jump.
Values are float64 JAX arrays: new values do not compile anew.

Symbols: t [s]; moment [N m] about the axis of the motion; change of the angle since the start [rad], rate
[rad/s], acceleration [rad/s^2]. Source: theory (3.5), (3.6), (3.15).
"""

import abc
import copy
from collections.abc import Callable
from typing import TYPE_CHECKING, Any, ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.core import Tracer
from jaxtyping import Array, Float

from rfem_jax.description.basics.errors import InputError
from rfem_jax.description.basics.units import Quantities, Quantity, non_negative_quantity, positive_quantity
from rfem_jax.description.drives.arguments import (
    Phase,
    Scalar,
    Time,
    as_phase,
    checked_breakpoints,
    checked_function_of_time,
    column,
    drive_checks,
    function_of_time,
    leaf,
    table_changes,
    table_times,
)
from rfem_jax.description.drives.laws import (
    Motion,
    ramp,
    rise,
    rise_steps,
    spin_up,
    spline,
    spline_at,
    table_at,
    table_jumps,
)

if TYPE_CHECKING:
    Law = Callable[..., Scalar]
else:
    Law = Any  # what is no function is refused in a sentence


def _on_joint(drive: Any, joint: str) -> Any:
    other = copy.copy(drive)
    object.__setattr__(other, "joint", joint)
    return other


class GivenDrive(eqx.Module):
    """A given force or moment along one free motion of a joint of the tree; `motion` None: its only one."""

    joint: eqx.AbstractVar[str]
    motion: str | None = eqx.field(static=True, default=None, kw_only=True)
    rotation: ClassVar[bool | None] = None  # whether the motion is a rotation, or a translation; None: either

    def renamed(self, names: Any) -> Any:
        """On a joint of another name, `names.of(name)`."""
        return _on_joint(self, names.of(self.joint))

    @abc.abstractmethod
    def breakpoints(self) -> tuple[float, ...]:
        """Return the times [s] > 0 at which the force jumps, increasing."""

    def step_ends(self, interval: float) -> tuple[float, ...]:
        """Return the times [s] beside the breakpoints at which steps must end, so that they see how the drive changes:
        rows of a table, and places within a rise that is short beside intervals of a length [s]."""
        del interval
        return ()

    @abc.abstractmethod
    def force_at(self, t: Time, phase: Phase) -> Scalar:
        """Return the moment [N m] or force [N], positive as the motion, at t in the piece `phase` (int, from 0)."""


class MomentDrive(GivenDrive):
    """A given moment about the axis of a free motion of a joint."""

    rotation: ClassVar[bool | None] = True

    @abc.abstractmethod
    def breakpoints(self) -> tuple[float, ...]:
        """Return the times [s] > 0 at which the moment jumps, increasing."""

    @abc.abstractmethod
    def moment_at(self, t: Time, phase: Phase) -> Scalar:
        """Return the moment [N m], positive as the motion (about +y of a hinge), at the time t, in the piece `phase`
        (int, from 0)."""

    def force_at(self, t: Time, phase: Phase) -> Scalar:
        return self.moment_at(t, phase)


class PrescribedDrive(eqx.Module):
    """A given angle or displacement of a joint; the moment or force that enforces it is a result."""

    joint: eqx.AbstractVar[str]
    motion: str | None = eqx.field(static=True, default=None, kw_only=True)
    rotation: ClassVar[bool | None] = None  # as of `GivenDrive`

    def renamed(self, names: Any) -> Any:
        """On a joint of another name, `names.of(name)`."""
        return _on_joint(self, names.of(self.joint))

    @abc.abstractmethod
    def breakpoints(self) -> tuple[float, ...]:
        """Return the times [s] > 0 at which a derivative jumps, increasing."""

    def step_ends(self, interval: float) -> tuple[float, ...]:
        """Return the times [s] beside the breakpoints at which steps must end, so that they see how the drive changes:
        rows of a table, and places within a rise that is short beside intervals of a length [s]."""
        del interval
        return ()

    @abc.abstractmethod
    def motion_at(self, t: Time, phase: Phase) -> Motion:
        """Return (change of the angle or displacement since the start, rate, acceleration) at t in the piece
        `phase`."""


class MomentRamp(MomentDrive):
    """M = moment * t / rise_time up to rise_time, then 0; theory (3.5).

    Args:
        joint: the joint's name.
        moment: [N m], reached at rise_time.
        rise_time: [s], > 0.
        motion: which free motion of the joint, as "R_y" or "T_x" (a rotation about y, a translation along x); None =
            the joint's only one.
    """

    joint: str = eqx.field(static=True)
    moment: Scalar
    rise_time: float = eqx.field(static=True)

    def __init__(self, joint: str, moment: Quantity, rise_time: Quantity, motion: str | None = None):
        checks = drive_checks(self, joint, motion)
        checks.set("moment", moment, leaf, "moment", "moment")
        checks.set("rise_time", rise_time, positive_quantity, "time", "rise_time")
        checks.refuse()

    def breakpoints(self) -> tuple[float, ...]:
        return (self.rise_time,)

    def moment_at(self, t: Time, phase: Phase) -> Scalar:
        return ramp(self.moment, self.rise_time, t, phase)


class MomentTable(MomentDrive):
    """A moment given at times, linear in between, zero after the last time.

    Args:
        joint: the joint's name.
        times: [s], from 0, not decreasing; a time given twice is a jump.
        moments: [N m], as many as times.
        motion: which free motion of the joint, as "R_y" or "T_x" (a rotation about y, a translation along x); None =
            the joint's only one.
    """

    joint: str = eqx.field(static=True)
    values: Float[Array, " times"]
    times: tuple[float, ...] = eqx.field(static=True)

    def __init__(self, joint: str, times: Quantities, moments: Quantities, motion: str | None = None):
        checks = drive_checks(self, joint, motion)
        found = checks.value("times", times, table_times, False)
        checks.set("values", moments, column, "moment", "moments", found)
        checks.refuse()
        self.times = found

    def breakpoints(self) -> tuple[float, ...]:
        return table_jumps(self.times)

    def step_ends(self, interval: float) -> tuple[float, ...]:
        return self.times

    def moment_at(self, t: Time, phase: Phase) -> Scalar:
        return table_at(self.values, self.times, t, phase)


class MomentFunction(MomentDrive):
    """A moment given by a Python function written in JAX.

    Args:
        joint: the joint's name.
        function: (t [s], phase) -> moment [N m], a float64 scalar; smooth within a phase. It may
            close over what is differentiated; an `equinox.Module` that has it as arrays is compiled once for all
            values.
        breakpoints: times [s] > 0 at which the moment jumps, increasing.
        motion: which free motion of the joint, as "R_y" or "T_x" (a rotation about y, a translation along x); None =
            the joint's only one.
    """

    joint: str = eqx.field(static=True)
    function: Callable[..., Scalar]
    times: tuple[float, ...] = eqx.field(static=True)

    def __init__(self, joint: str, function: Law, breakpoints: Quantities = (), motion: str | None = None):
        checks = drive_checks(self, joint, motion)
        checks.set("times", breakpoints, checked_breakpoints)
        checks.set("function", function, function_of_time)
        checks.refuse()
        self.function = checked_function_of_time(self.function, with_phase=True)

    def breakpoints(self) -> tuple[float, ...]:
        return self.times

    def moment_at(self, t: Time, phase: Phase) -> Scalar:
        return self.function(jnp.asarray(t, jnp.float64), as_phase(phase))


class PrescribedRate(PrescribedDrive):
    """A rate that rises smoothly to a constant: rate * (3 x^2 - 2 x^3), x = t / rise_time <= 1.

    Args:
        joint: the joint's name.
        rate: [rad/s] about +y.
        rise_time: [s], >= 0; 0 moves at the full rate from the start.
        motion: which free motion of the joint, as "R_y" or "T_x" (a rotation about y, a translation along x); None =
            the joint's only one.
    """

    rotation: ClassVar[bool | None] = True
    joint: str = eqx.field(static=True)
    rate: Scalar
    rise_time: float = eqx.field(static=True)

    def __init__(self, joint: str, rate: Quantity, rise_time: Quantity = 0.0, motion: str | None = None):
        checks = drive_checks(self, joint, motion)
        checks.set("rate", rate, leaf, "rate", "rate")
        checks.set("rise_time", rise_time, non_negative_quantity, "time", "rise_time")
        checks.refuse()

    def breakpoints(self) -> tuple[float, ...]:
        return (self.rise_time,) if self.rise_time > 0.0 else ()

    def step_ends(self, interval: float) -> tuple[float, ...]:
        return rise_steps(self.rise_time, interval)

    def motion_at(self, t: Time, phase: Phase) -> Motion:
        return rise(self.rate, self.rise_time, t, phase)


class PrescribedSpinUp(PrescribedDrive):
    """A rate that rises to a constant with a continuous acceleration:
    rate * (x - sin(2 pi x) / (2 pi)), x = t / rise_time <= 1.

    The law of the spin-up beam of Simo and Vu-Quoc (J. Appl. Mech. 53 (1986) 855-863) and of Wu and
    Haug's slewing beam (Int. J. Numer. Methods Eng. 26 (1988) 2211-2226).

    Args:
        joint: the joint's name.
        rate: [rad/s] about +y, reached at rise_time.
        rise_time: [s], > 0.
        motion: which free motion of the joint, as "R_y" or "T_x" (a rotation about y, a translation along x); None =
            the joint's only one.
    """

    rotation: ClassVar[bool | None] = True
    joint: str = eqx.field(static=True)
    rate: Scalar
    rise_time: float = eqx.field(static=True)

    def __init__(self, joint: str, rate: Quantity, rise_time: Quantity, motion: str | None = None):
        checks = drive_checks(self, joint, motion)
        checks.set("rate", rate, leaf, "rate", "rate")
        checks.set("rise_time", rise_time, positive_quantity, "time", "rise_time")
        checks.refuse()

    def breakpoints(self) -> tuple[float, ...]:
        return (self.rise_time,)

    def step_ends(self, interval: float) -> tuple[float, ...]:
        return rise_steps(self.rise_time, interval)

    def motion_at(self, t: Time, phase: Phase) -> Motion:
        return spin_up(self.rate, self.rise_time, t, phase)


class PrescribedTable(PrescribedDrive):
    """Changes of the angle, given at times and joined by a cubic spline (C2, "not-a-knot" ends).

    Args:
        joint: the joint's name.
        times: [s], increasing from 0; at least two.
        angles: changes of the angle since the start [rad], as many as times, the first 0.
        motion: which free motion of the joint, as "R_y" or "T_x" (a rotation about y, a translation along x); None =
            the joint's only one.
    """

    rotation: ClassVar[bool | None] = True
    joint: str = eqx.field(static=True)
    knots: Float[Array, " times"]
    coefficients: Float[Array, "4 times-1"]
    times: tuple[float, ...] = eqx.field(static=True)

    def __init__(self, joint: str, times: Quantities, angles: Quantities, motion: str | None = None):
        checks = drive_checks(self, joint, motion)
        knots = checks.value("times", times, table_times, True)
        changes = checks.value("angles", angles, table_changes, "angle", "angles", knots)
        checks.refuse()
        self.times = knots
        self.knots, self.coefficients = spline(knots, changes)

    def breakpoints(self) -> tuple[float, ...]:
        return ()

    def step_ends(self, interval: float) -> tuple[float, ...]:
        return self.times

    def motion_at(self, t: Time, phase: Phase) -> Motion:
        return spline_at(self.knots, self.coefficients, t)


class PrescribedFunction(PrescribedDrive):
    """Change of the angle, or displacement, as a Python function written in JAX; its derivatives are taken by JAX.

    Args:
        joint: the joint's name.
        function: t [s] -> change of the angle [rad] or displacement [m], a float64 scalar, 0 at t = 0 and twice
            differentiable; with breakpoints it is called as function(t, phase) instead.
        breakpoints: times [s] > 0 at which a derivative jumps, increasing.
        motion: which free motion of the joint, as "R_y" or "T_x" (a rotation about y, a translation along x); None =
            the joint's only one.
    """

    joint: str = eqx.field(static=True)
    function: Callable[..., Scalar]
    times: tuple[float, ...] = eqx.field(static=True)

    def __init__(self, joint: str, function: Law, breakpoints: Quantities = (), motion: str | None = None):
        checks = drive_checks(self, joint, motion)
        checks.set("times", breakpoints, checked_breakpoints)
        checks.set("function", function, function_of_time)
        checks.refuse()
        function_with_leaves = checked_function_of_time(self.function, with_phase=bool(self.times))
        start = self._angle(jnp.zeros((), jnp.float64), 0)
        if not isinstance(start, Tracer) and not abs(float(start)) <= 1e-12:
            raise InputError(
                f"Argument `function` must be 0 at t = 0, but was {float(start)}; return the change "
                "of the angle or displacement since the start."
            )
        self.function = function_with_leaves

    def breakpoints(self) -> tuple[float, ...]:
        return self.times

    def _angle(self, t: Time, phase: Phase) -> Scalar:
        return self.function(t, phase) if self.times else self.function(t)

    def motion_at(self, t: Time, phase: Phase) -> Motion:
        t, phase = jnp.asarray(t, jnp.float64), as_phase(phase)
        one = jnp.ones_like(t)

        def angle_and_rate(time: Scalar) -> tuple[Scalar, Scalar]:
            return jax.jvp(lambda s: self._angle(s, phase), (time,), (one,))

        (angle, rate), (_, acceleration) = jax.jvp(angle_and_rate, (t,), (one,))
        return angle, rate, acceleration
